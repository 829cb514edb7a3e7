"""From a raw capture to grasps: how long it takes, and pictures of what comes out.

    python bench/captures.py --gripper franka_hand --pictures docs/images/captures

Captures are read from ../shared/data/scenes; nothing tells the program which object is the target.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from graspmatch.apps.bench.machine import machine
from graspmatch.apps.picture import (
    OBJECT,
    OBSTACLE,
    Body,
    Panel,
    camera_around,
    contact_sheet,
    hand_bodies,
    point_cloud_bodies,
    render,
)
from graspmatch.config import PlannerConfig, fast
from graspmatch.geometry.cloud import voxel_downsample
from graspmatch.geometry.se3 import rotation_facing
from graspmatch.gripper.kinematics import load_hand, pose_links
from graspmatch.gripper.load import load_gripper
from graspmatch.gripper.zoo import card_path
from graspmatch.planner.order import plan_all
from graspmatch.planner.plan import plan
from graspmatch.scene.every import scenes_of_view
from graspmatch.scene.read import CloudFile, read_cloud
from graspmatch.scene.scene import Scene
from graspmatch.scene.view import view_of_cloud
from graspmatch.types import GraspSet, Gripper

CAPTURES = Path(__file__).parents[1] / ".." / "shared" / "data" / "scenes"
PICTURED = 5
PANEL = (400, 320)
COLOURS = 64
ASIDE = 25.0
"""The pictures are taken so far beside the sensor [degrees]."""
SPHERES = 0.004
"""Distance of the spheres that stand for a cloud [m]."""


def captures(folder: Path = CAPTURES) -> dict[str, Callable[[], Scene]]:
    """For each capture what makes its scene from the raw arrays, which are in memory."""
    found: dict[str, Callable[[], Scene]] = {}
    for path in sorted((folder / "6dof_graspnet").glob("*.npz")):
        with np.load(path) as content:
            depth, K = content["depth"], content["K"]
        found[path.stem] = lambda depth=depth, K=K: Scene.from_depth(depth, K)
    for path in (folder / "mosd" / "test0.pcd", folder / "mosd" / "test11.pcd", folder / "gpd" / "table_mug.pcd"):
        found[path.stem] = partial(scene_of_cloud, read_cloud(path), path.name)
    can = read_cloud(folder / "gpd" / "krylon.pcd").points  # the can alone: there is no table to cut it from
    found["krylon"] = lambda: Scene.from_cloud(can, table=None, sensor_origin=np.zeros(3))
    return found


def scene_of_cloud(cloud: CloudFile, name: str, number: int | None = None) -> Scene:
    """One object of a cloud of a whole scene; none: that of which most is seen."""
    return Scene.from_view(view_of_cloud(cloud, source=name), object=number)


def measure(make: Callable[[], Scene], gripper: Gripper, config: PlannerConfig, repeats: int) -> dict[str, Any]:
    """Scene, grasps, and times of all repeats but the first [ms]: wall times, and the processor time of all threads, of
    which the wall time of a machine that does nothing else is not more."""
    times = []
    for _ in range(repeats + 1):
        begin, busy = time.perf_counter(), time.process_time()
        scene = make()
        between = time.perf_counter()
        grasps = plan(scene, gripper, config)
        end = time.perf_counter()
        times.append([between - begin, end - between, end - begin, time.process_time() - busy])
    milliseconds = 1000 * np.array(times[1:])
    least, median = (
        dict(zip(("scene", "plan", "both", "processor"), values.round(1).tolist(), strict=True))
        for values in (milliseconds.min(axis=0), np.median(milliseconds, axis=0))
    )
    return {"scene": scene, "grasps": grasps, "least_ms": least, "median_ms": median}


def draw(scene: Scene, grasps: GraspSet, gripper: Gripper, path: Path) -> None:
    """A sheet of the best grasps from the side of the sensor: what was seen, and not what it is hollow behind."""
    model = load_hand(card_path(gripper.name))
    things = [cloud_body(scene.target.points, OBJECT)]
    things += [cloud_body(scene.obstacles.points, OBSTACLE)] if len(scene.obstacles.points) else []
    up = np.array([0.0, -1.0, 0.0]) if scene.table is None else scene.table.normal
    panels = [panel(things, [], scene, up, "what was seen of the target, and of the rest")]
    for i in range(min(PICTURED, len(grasps))):
        T_gripper_link = pose_links(model, grasps.grasp_joints[i])
        hand = hand_bodies(gripper, grasps.T_world_gripper[i], T_gripper_link)
        panels.append(panel(things, hand, scene, up, f"{i + 1}   score {grasps.score[i]:.2f}"))
    sheet = Image.fromarray(contact_sheet(panels, columns=3))
    sheet.quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


def panel(things: list[Body], hand: list[Body], scene: Scene, up: Float[np.ndarray, "3"], caption: str) -> Panel:
    """One view of target and hand, from where the sensor is, a little from the side."""
    R = rotation_facing(up, np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0]))
    assert scene.sensor_origin is not None  # all captures have one
    x, y, _ = (scene.sensor_origin - scene.centre_of_mass) @ R
    azimuth = float(np.degrees(np.arctan2(y, x))) + ASIDE
    camera = camera_around([things[0], *hand], azimuth, 30.0, up=up, aspect=PANEL[0] / PANEL[1])
    return Panel(render([*things, *hand], camera=camera, size=PANEL, table=scene.table), caption)


def cloud_body(points: Float[np.ndarray, "n 3"], rgba: tuple[float, float, float, float]) -> Body:
    """A cloud as spheres that nearly touch."""
    return point_cloud_bodies(voxel_downsample(points, SPHERES)[0], 0.6 * SPHERES, rgba)


def with_first_pick(
    make: Callable[[], Scene], gripper: Gripper, config: PlannerConfig
) -> tuple[Callable[[], Scene], int]:
    """The same with the object that would be picked first, and its number: of several, the largest may fit no hand."""
    if not (isinstance(make, partial) and make.func is scene_of_cloud):
        return make, 0
    scenes = scenes_of_view(view_of_cloud(make.args[0], source=make.args[1]))
    number = plan_all(scenes, gripper, config)[0].number
    return partial(make, number=number), number


def main() -> None:
    """Measure and draw all captures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gripper", default="franka_hand")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--slow", action="store_true", help="without --fast: refined grasps")
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each")
    parser.add_argument("--output", type=Path, help="JSON file for the figures")
    options = parser.parse_args()
    config = PlannerConfig(device="cpu") if options.slow else fast(PlannerConfig(device="cpu"))
    gripper = load_gripper(options.gripper)
    results = {}
    for name, make in captures().items():
        make, number = with_first_pick(make, gripper, config)
        found = measure(make, gripper, config, options.repeats)
        scene, grasps = found.pop("scene"), found.pop("grasps")
        found |= {
            "object": number,
            "grasps": len(grasps),
            "score": grasps.score[:PICTURED].round(2).tolist(),
            "tally": grasps.tally,
        }
        results[name] = found
        times = ", ".join(f"{part} {value:.0f}" for part, value in found["least_ms"].items())
        print(
            f"{name:12s} {len(grasps):3d} grasps, score {grasps.score.max(initial=0):.2f}; least ms: {times}",
            flush=True,
        )
        if options.pictures:
            options.pictures.mkdir(parents=True, exist_ok=True)
            draw(scene, grasps, gripper, options.pictures / f"{name}.png")
    if options.output:
        record = {"machine": machine(), "gripper": options.gripper, "repeats": options.repeats, "captures": results}
        options.output.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
