"""Captures in ROS bags and MCAP files, written here by another library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from depth_scenes import SHAPE, Box, K, Setting, camera_at, noisy, render
from graspmatch.apps.capture import read_scene
from graspmatch.apps.options import Capture
from graspmatch.errors import GraspmatchError
from graspmatch.scene.bag import is_bag, read_bag

pytest.importorskip("rosbags")
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

Array = np.ndarray

SETTING = Setting((Box(-0.05, 0, (0.08, 0.1, 0.12), 0.3),), camera=camera_at(45, 0.7))
DEPTH = np.round(1000 * noisy(render(SETTING)[0], np.random.default_rng(0))).astype(np.uint16)
KINDS = ("ros1", "mcap", "db3")


class Recorder:
    """Writes messages of one camera to a bag of any kind."""

    def __init__(self, folder: Path, kind: str) -> None:
        self.is_ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE)
        self.path = folder / ("capture.bag" if self.is_ros1 else "capture")
        if self.is_ros1:
            self.writer: Any = rosbag1.Writer(self.path)
        else:
            plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
            self.writer = rosbag2.Writer(self.path, version=9, storage_plugin=plugin)

    def message(self, kind: str, **values: Any) -> Any:
        return self.store.types[f"sensor_msgs/msg/{kind}"](header=self.header(), **values)

    def header(self) -> Any:
        types = self.store.types
        stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
        sequence = {"seq": 0} if self.is_ros1 else {}
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera", **sequence)

    def record(self, **messages: Any) -> Path:
        """One message on each topic; `__` stands for the slash in its name."""
        with self.writer:
            for name, message in messages.items():
                topic, kind = "/" + name.replace("__", "/"), message.__msgtype__
                connection = self.writer.add_connection(topic, kind, typestore=self.store)
                serialize = self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
                self.writer.write(connection, 1, serialize(message, kind))
        return self.path

    def image(self, values: Array, encoding: str) -> Any:
        height, width = values.shape[:2]
        data = np.frombuffer(values.tobytes(), dtype=np.uint8)
        step = len(data) // height
        return self.message(
            "Image", height=height, width=width, encoding=encoding, is_bigendian=0, step=step, data=data
        )

    def camera_info(self) -> Any:
        region = self.store.types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        matrices = {"D": np.zeros(5), "K": K.ravel(), "R": np.eye(3).ravel(), "P": np.zeros(12)}
        named = {key if self.is_ros1 else key.lower(): value for key, value in matrices.items()}
        common = {
            "height": SHAPE[0],
            "width": SHAPE[1],
            "distortion_model": "plumb_bob",
            "binning_x": 0,
            "binning_y": 0,
        }
        return self.message("CameraInfo", roi=region, **common, **named)

    def cloud(self, points: Array) -> Any:
        """x y z and a colour, 16 bytes each."""
        field = self.store.types["sensor_msgs/msg/PointField"]
        fields = [field(name=name, offset=4 * i, datatype=7, count=1) for i, name in enumerate(["x", "y", "z", "rgb"])]
        height, width = points.shape[:2]
        table = np.zeros((height, width, 4), dtype=np.float32)
        table[:, :, :3] = points
        return self.message(
            "PointCloud2",
            height=height,
            width=width,
            fields=fields,
            is_bigendian=False,
            point_step=16,
            row_step=16 * width,
            data=np.frombuffer(table.tobytes(), dtype=np.uint8),
            is_dense=False,
        )


@pytest.mark.parametrize("kind", KINDS)
def test_a_depth_image_and_its_camera_are_read(kind: str, tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, kind)
    colour = recorder.image(np.zeros((*SHAPE, 3), dtype=np.uint8), "rgb8")
    depth, info = recorder.image(DEPTH, "16UC1"), recorder.camera_info()
    path = recorder.record(
        camera__color__image_raw=colour, camera__depth__image_raw=depth, camera__depth__camera_info=info
    )
    assert is_bag(path)
    frame = read_bag(path)
    assert frame.topic == "/camera/depth/image_raw"
    np.testing.assert_array_equal(frame.depth, DEPTH)
    assert frame.camera is not None
    np.testing.assert_array_equal(frame.camera.K, K)
    assert frame.camera.size == (640, 480)


@pytest.mark.parametrize("kind", KINDS)
def test_a_cloud_is_read_with_its_rows(kind: str, tmp_path: Path) -> None:
    points = np.random.default_rng(0).random((5, 7, 3)).astype(np.float32)
    recorder = Recorder(tmp_path, kind)
    frame = read_bag(recorder.record(points=recorder.cloud(points)))
    assert frame.cloud is not None
    assert frame.cloud.shape == (5, 7)
    np.testing.assert_array_equal(frame.cloud.points.reshape(5, 7, 3), points)


def test_a_bag_becomes_a_scene(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, "mcap")
    path = recorder.record(depth__image=recorder.image(DEPTH, "16UC1"), depth__camera_info=recorder.camera_info())
    for given in (path, next(path.glob("*.mcap"))):
        scene = read_scene(given, Capture(), table="auto", unit="auto", obstacles=None)
        assert np.ptp(scene.target.points, axis=0).max() == pytest.approx(0.155, abs=0.02)
        assert any("/depth/image" in note for note in scene.notes)


def test_several_clouds_need_a_topic(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, "mcap")
    first, second = (recorder.cloud(np.full((1, 3, 3), value, dtype=np.float32)) for value in (1.0, 2.0))
    path = recorder.record(left=first, right=second)
    with pytest.raises(GraspmatchError, match="--topic"):
        read_bag(path)
    cloud = read_bag(path, topic="/right").cloud
    assert cloud is not None
    assert np.all(cloud.points == 2.0)
    with pytest.raises(GraspmatchError, match="Possible: /left, /right"):
        read_bag(path, topic="/middle")


def test_bags_that_hold_nothing_of_use_are_refused(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, "mcap")
    path = recorder.record(image=recorder.image(np.zeros((4, 5, 3), dtype=np.uint8), "rgb8"))
    with pytest.raises(GraspmatchError, match="no depth images and no clouds"):
        read_bag(path)
    torn = tmp_path / "torn.bag"
    torn.write_bytes(b"#ROSBAG V2.0\nnothing")
    with pytest.raises(GraspmatchError, match="could not be read as a bag"):
        read_bag(torn)
    with pytest.raises(GraspmatchError, match="No such bag"):
        read_bag(tmp_path / "missing.mcap")
