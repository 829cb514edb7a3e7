"""ROS 1 and ROS 2 bags and MCAP files, read without ROS: the first depth image with its camera, or the first cloud."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Shaped

from graspmatch.scene.camera import Camera
from graspmatch.scene.camera_file import camera_of
from graspmatch.scene.read import CloudFile
from graspmatch.types import GraspmatchError

Array = np.ndarray

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
IMAGE, COMPRESSED, INFO, CLOUD = (
    f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo", "PointCloud2")
)
ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
COMPRESSED_HEADER = 12
"""Bytes before the PNG in what compressed_depth_image_transport sends."""


@dataclass(frozen=True)
class BagFrame:
    """One capture of a bag: a depth image with its camera, or a cloud."""

    topic: str
    depth: Shaped[Array, "h w"] | None = None
    camera: Camera | None = None
    cloud: CloudFile | None = None


def is_bag(path: str | os.PathLike[str]) -> bool:
    """Whether the path names a bag: a file of one, or the folder that ROS 2 writes."""
    path = Path(path)
    return path.suffix.lower() in BAG_SUFFIXES or (path / "metadata.yaml").is_file()


def read_bag(path: str | os.PathLike[str], *, topic: str | None = None) -> BagFrame:
    """The first capture of a topic; without a topic, of the one depth image, or else of the one cloud in the bag.

    The unit of depths and the frame of clouds are the bag's own: transforms are not read.
    """
    path = Path(path)
    if not path.exists():
        raise GraspmatchError(f"No such bag: {path}.")
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise GraspmatchError(f"Reading {path.name} needs rosbags: pip install 'graspmatch[bags]'.") from error
    try:
        # ROS 2 bags of before 2023 do not say what their messages are made of.
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            return _frame(reader, topic, path.name)
    except GraspmatchError:
        raise
    except Exception as error:  # damaged bags raise whatever sqlite, the decompressors and parsers do
        reason = " ".join(str(error).split()) or type(error).__name__
        raise GraspmatchError(f"{path.name} could not be read as a bag: {reason}.") from error


def _frame(reader: Any, topic: str | None, name: str) -> BagFrame:
    kinds = {connection.topic: connection.msgtype for connection in reader.connections}
    if topic is not None and kinds.get(topic) not in (IMAGE, COMPRESSED, CLOUD):
        known = [known for known, kind in kinds.items() if kind in (IMAGE, COMPRESSED, CLOUD)]
        raise GraspmatchError(f"{name} has no images or clouds on {topic}. Possible: {', '.join(known) or 'none'}.")
    chosen = [topic] if topic is not None else sorted(kinds, key=lambda each: "depth" not in each)
    depths = {each: image for each in chosen if (image := _first_depth(reader, each, kinds[each])) is not None}
    if depths:
        best = _only([each for each in depths if "depth" in each] or list(depths), "depth images", name)
        return BagFrame(best, depth=depths[best], camera=_camera(reader, best, kinds, name))
    clouds = [each for each in chosen if kinds[each] == CLOUD]
    if not clouds:
        raise GraspmatchError(f"{name} has no depth images and no clouds. Its topics: {', '.join(sorted(kinds))}.")
    best = _only(clouds, "clouds", name)
    message = next(_messages(reader, best), None)
    if message is None:
        raise GraspmatchError(f"{name} has no message on {best}.")
    return BagFrame(best, cloud=_cloud(message))


def _messages(reader: Any, topic: str) -> Iterator[Any]:
    connections = [connection for connection in reader.connections if connection.topic == topic]
    for connection, _, raw in reader.messages(connections=connections):
        yield reader.deserialize(raw, connection.msgtype)


def _only(topics: list[str], what: str, name: str) -> str:
    if len(topics) > 1:
        raise GraspmatchError(f"{name} has {what} on {len(topics)} topics; name one (--topic): {', '.join(topics)}.")
    return topics[0]


def _first_depth(reader: Any, topic: str, kind: str) -> Shaped[Array, "h w"] | None:
    """The first image of a topic, if it is one of depths."""
    if kind not in (IMAGE, COMPRESSED):
        return None
    message = next(_messages(reader, topic), None)
    if message is None:
        return None
    if kind == COMPRESSED:
        return _unpacked(message) if "compressedDepth" in message.format else None
    if message.encoding not in ENCODINGS:
        return None
    number = np.dtype((">" if message.is_bigendian else "<") + ENCODINGS[message.encoding])
    rows = np.frombuffer(bytes(message.data), dtype=np.uint8).reshape(message.height, message.step)
    pixels = np.ascontiguousarray(rows[:, : message.width * number.itemsize]).view(number)
    return pixels.astype(number.newbyteorder("="))


def _unpacked(message: Any) -> Shaped[Array, "h w"]:
    """The image of compressed_depth_image_transport: 16 bit integers as they are, floats as quantised inverses."""
    from PIL import Image

    data = bytes(message.data)
    with Image.open(io.BytesIO(data[COMPRESSED_HEADER:])) as image:
        values = np.array(image)
    if not message.format.strip().startswith("32FC1"):
        return values.astype(np.uint16)
    a, b = np.frombuffer(data, dtype="<f4", offset=4, count=2)
    depth = np.full(values.shape, np.nan, dtype=np.float32)
    np.divide(a, values - b, out=depth, where=values > 0, casting="unsafe")
    return depth


def _camera(reader: Any, topic: str, kinds: dict[str, str], name: str) -> Camera | None:
    """The camera of the info topic that shares most of its name with the image's; None if there is none."""
    infos = [each for each, kind in kinds.items() if kind == INFO]
    if not infos:
        return None
    shared = {each: _shared_words(each.split("/"), topic.split("/")) for each in infos}
    best = [each for each in infos if shared[each] == max(shared.values())]
    info = next(_messages(reader, _only(best, "camera_info", name)), None)
    if info is None:
        return None
    record = {key.lower(): getattr(info, key) for key in ("K", "D", "k", "d") if hasattr(info, key)}
    record |= {key: getattr(info, key) for key in ("width", "height", "distortion_model")}
    return camera_of(record, best[0])


def _shared_words(a: list[str], b: list[str]) -> int:
    """With how many equal words two names begin."""
    return next((i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))


def _cloud(message: Any) -> CloudFile:
    """x, y, z of a PointCloud2, whatever else its points have."""
    order = ">" if message.is_bigendian else "<"
    fields = {field.name: field for field in message.fields}
    if not {"x", "y", "z"} <= set(fields):
        raise GraspmatchError(f"The cloud has no fields x, y and z. Its fields: {', '.join(fields)}.")
    layout = np.dtype(
        {
            "names": list("xyz"),
            "formats": [order + FIELD_TYPES[fields[axis].datatype] for axis in "xyz"],
            "offsets": [fields[axis].offset for axis in "xyz"],
            "itemsize": message.point_step,
        }
    )
    rows = np.frombuffer(bytes(message.data), dtype=np.uint8).reshape(message.height, message.row_step)
    packed = np.ascontiguousarray(rows[:, : message.width * message.point_step])
    table = packed.view(layout).reshape(-1)
    return CloudFile(_columns(table), shape=(message.height, message.width) if message.height > 1 else None)


def _columns(table: Shaped[Array, "n"]) -> Float32[Array, "n 3"]:
    return np.stack([table[axis].astype(np.float32) for axis in "xyz"], axis=-1)
