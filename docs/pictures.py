"""Make the pictures of the README and of the pages: screenshots of the viewer, and the gallery.

python docs/pictures.py viewer     needs chromium and playwright
python docs/pictures.py gallery
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from graspmatch.apps.hand import Hand, load_hand
from graspmatch.apps.picture import picture_of_grasps
from graspmatch.apps.speech import Speech
from graspmatch.config import PlannerConfig
from graspmatch.planner.plan import plan
from graspmatch.planner.recording import Recording
from graspmatch.scene.household import OBJECTS
from graspmatch.scene.scene import Scene

IMAGES = Path(__file__).parent / "images"
CONFIG = PlannerConfig()
GALLERY = (
    ("franka_hand", "banana"),
    ("franka_hand", "hammer"),
    ("robotiq_2f85", "can"),
    ("robotiq_2f85", "spray_bottle"),
    ("barrett_bh282", "bottle"),
    ("barrett_bh282", "box"),
    ("kinova_kg3", "ball"),
    ("kinova_kg3", "mug"),
)
"""A hand and an object made by code."""


def scene_and_hand(hand: str, thing: str) -> tuple[Scene, Hand]:
    """What a picture shows."""
    scene = replace(Scene.from_mesh(OBJECTS[thing]().mesh), source=thing)
    return scene, load_hand(hand, None, CONFIG, Speech(quiet=True))


def gallery() -> None:
    """One picture of each pair, the hand at the surest grasp."""
    for name, thing in GALLERY:
        scene, hand = scene_and_hand(name, thing)
        grasps = plan(scene, hand.gripper, CONFIG)
        path = IMAGES / "gallery" / f"{name}-{thing}.png"
        path.parent.mkdir(exist_ok=True)
        picture_of_grasps(scene, hand.gripper, grasps, path, link_poses=hand.link_poses, count=1, size=(480, 360))
        print(path, len(grasps))


def viewer() -> None:
    """The page at a grasp, with many hands, and in the middle of the search."""
    from playwright.sync_api import sync_playwright

    from graspmatch.apps.viewer.command import page_of
    from graspmatch.apps.viewer.shown import shown_of

    scene, hand = scene_and_hand("franka_hand", "mug")
    recording = Recording()
    shown = shown_of(hand, plan(scene, hand.gripper, CONFIG, recording=recording), scene, recording, CONFIG.device)
    flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with page_of(shown, CONFIG, port=8700) as page, sync_playwright() as play:
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        tab = browser.new_page(viewport={"width": 1100, "height": 640})
        tab.goto(f"http://127.0.0.1:{page.server.get_port()}")
        tab.get_by_text("20 grasps").wait_for(timeout=60_000)
        tab.wait_for_timeout(5000)
        close_notice(tab)
        shoot(tab, "viewer")
        page.panel.also.value = 12
        shoot(tab, "viewer-hands")
        page.panel.also.value = 0
        tab.get_by_role("tab", name="Search").click()
        page.panel.particles.value = True
        for name, iteration in (("start", 0), ("spread", 15), ("end", len(page.search) - 1)):
            page.panel.iteration.value = iteration
            shoot(tab, f"viewer-search-{name}")
        page.panel.particles.value = False
        page.panel.rejected.value = True
        shoot(tab, "viewer-rejected")
        tab.get_by_role("tab", name="Plan").click()
        page.panel.rejected.value = False
        page.panel.hand.value, page.panel.scene.value = "barrett_bh282", "bottle"
        page.replan()
        page.panel.also.value = 3
        shoot(tab, "viewer-plan")
        browser.close()


def close_notice(tab: Any) -> None:
    """That the browser draws without a graphics card need not be in the picture."""
    notice = tab.locator(".mantine-Notification-closeButton")
    if notice.count():
        notice.first.click()


def shoot(tab: Any, name: str) -> None:
    """A screenshot once the scene is drawn."""
    tab.wait_for_timeout(4000)
    path = IMAGES / f"{name}.png"
    tab.screenshot(path=str(path), timeout=120_000)
    print(path)


if __name__ == "__main__":
    {"viewer": viewer, "gallery": gallery}[sys.argv[1]]()
