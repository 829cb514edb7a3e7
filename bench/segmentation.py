"""Segmentation of real captures: agreement with labels made by others, and the time from a depth image to the scene.

The labels of `mosd` are hand-made. Those of `6dof_graspnet` are the clouds that its authors cut out themselves, which
leave out the foot of each object: agreement with them is also given for what is 2 cm above the table.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Shaped
from rich.console import Console
from rich.table import Table

from graspmatch.apps.bench.machine import machine
from graspmatch.scene.camera import Camera, camera
from graspmatch.scene.depth import depth_image
from graspmatch.scene.pcd import read_pcd
from graspmatch.scene.read import CloudFile, read_cloud
from graspmatch.scene.scene import Scene
from graspmatch.scene.segment import Segmentation, segment
from graspmatch.scene.view import View, view_of_cloud, view_of_depth

Array = np.ndarray

CAPTURES = Path(__file__).parents[1] / ".." / "shared" / "data" / "scenes"
KINECT = np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])
FIRST_OBJECT = 20
"""Labels of mosd from here on are objects."""
FOOT = 0.02
"""[m]"""


@dataclass(frozen=True)
class Labelled:
    """A capture, and the points of each object in it as others marked them."""

    name: str
    view: View
    objects: tuple[Bool[Array, "n"], ...]
    depth: Shaped[Array, "h w"] | None = None
    camera: Camera | None = None


def captures(folder: Path = CAPTURES) -> list[Labelled]:
    """All captures of a table: of the two of gpd nobody made labels, and one is of a can alone."""
    files = sorted((folder / "6dof_graspnet").glob("*.npz"))
    found = [_of_graspnet(path) for path in files] + [
        _of_mosd(path) for path in sorted((folder / "mosd").glob("*.pcd"))
    ]
    mug = read_cloud(folder / "gpd" / "table_mug.pcd")
    return [*found, Labelled("table_mug", view_of_cloud(mug, source="table_mug.pcd"), ())]


def agreement(found: Segmentation, theirs: Bool[Array, "n"], counted: Bool[Array, "n"]) -> float:
    """Largest intersection over union of any found object with a marked one, over the points that count."""
    best = 0.0
    for index in range(len(found)):
        ours = (found.labels == index) & counted
        union = np.count_nonzero(ours | (theirs & counted))
        best = max(best, np.count_nonzero(ours & theirs) / union if union else 0.0)
    return best


def above(found: Segmentation, view: View, height: float) -> Bool[Array, "n"]:
    """Which points are so high above the table [m]."""
    assert found.table is not None
    with np.errstate(invalid="ignore"):
        return view.points @ found.table.normal - found.table.offset > height


def milliseconds(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Least and median wall time, warm."""
    work()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        times.append(1000 * (time.perf_counter() - begin))
    return float(np.min(times)), float(np.median(times))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--captures", type=Path, default=CAPTURES)
    parser.add_argument("--repeats", type=int, default=20)
    arguments = parser.parse_args()

    table = Table(title="Objects found in captures, and their agreement with others' labels (IoU)")
    for column in ("capture", "found", "marked", "IoU", "IoU above 2 cm", "segment ms", "depth to scene ms"):
        table.add_column(column, justify="left" if column == "capture" else "right")
    for each in captures(arguments.captures):
        found = segment(each.view)
        everywhere = each.view.is_seen
        high = above(found, each.view, FOOT)
        ious = [(agreement(found, theirs, everywhere), agreement(found, theirs, high)) for theirs in each.objects]
        timing = ["-", "-"]
        if each.depth is not None and each.camera is not None:
            timing = [
                f"{least:.0f} ({median:.0f})" for least, median in _times(each.depth, each.camera, arguments.repeats)
            ]
        scores = [" ".join(f"{iou[column]:.3f}" for iou in ious) or "-" for column in (0, 1)]
        table.add_row(each.name, str(len(found)), str(len(each.objects) or "-"), *scores, *timing)
    console = Console(width=120)
    console.print(table)
    console.print(f"Least (median) of {arguments.repeats} warm runs on {machine()}.")


def _times(depth: Shaped[Array, "h w"], of: Camera, repeats: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """From the depth image to the segmentation, and to the scene with its normals [ms]."""
    return (
        milliseconds(lambda: segment(view_of_depth(depth_image(depth, of))), repeats),
        milliseconds(lambda: Scene.from_depth(depth, of), repeats),
    )


def _of_graspnet(path: Path) -> Labelled:
    content = np.load(path)
    depth, of = content["depth"], camera(content["K"])
    columns, rows, _ = np.rint(of.K @ (content["object_points"] / content["object_points"][:, 2:]).T).astype(int)
    marked = np.zeros(depth.shape, dtype=bool)
    marked[rows, columns] = True
    return Labelled(path.stem, view_of_depth(depth_image(depth, of)), (marked.ravel(),), depth, of)


def _of_mosd(path: Path) -> Labelled:
    pcd = read_pcd(path)
    labels = pcd.fields["label"]
    shape = (pcd.height, pcd.width)
    view = view_of_cloud(CloudFile(pcd.points, shape=shape), sensor_origin=np.zeros(3), source=path.name)
    seen = np.isfinite(pcd.points[:, 2])
    marked = tuple((labels == value) & seen for value in np.unique(labels[labels >= FIRST_OBJECT]))
    depth = pcd.points[:, 2].reshape(shape).astype(np.float32)
    return Labelled(path.stem, view, marked, depth, camera(KINECT, size=(pcd.width, pcd.height)))


if __name__ == "__main__":
    main()
