"""The viewer in a real browser: it loads, its controls move the hand, it plans again, and nothing goes wrong."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from trimesh import creation

from browser import Visit, browsing
from graspmatch.apps.hand import load_hand
from graspmatch.apps.speech import Speech
from graspmatch.config import PlannerConfig, RankingConfig
from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import mug

pytest.importorskip("viser", reason="needs viser: pip install 'graspmatch[view]'")

from graspmatch.apps.viewer.command import catalogue_of, page_of
from graspmatch.apps.viewer.page import Page
from graspmatch.apps.viewer.shown import Catalogue, planned

CONFIG = PlannerConfig(device="cpu", ranking=RankingConfig(count=8))


@pytest.fixture(scope="module")
def served() -> Iterator[tuple[Page, Visit]]:
    hand = load_hand("franka_hand", None, CONFIG, Speech(quiet=True))
    scene = Scene.from_mesh(mug())
    catalogue = Catalogue({"franka_hand": lambda: hand}, {"mug": lambda: scene}, CONFIG)
    shown = planned(catalogue, "franka_hand", "mug", 0, 8)
    with (
        page_of(shown, CONFIG, port=8190) as page,
        browsing(f"http://127.0.0.1:{page.server.get_port()}", width=960) as visit,
    ):
        visit.page.get_by_text("8 grasps").wait_for(timeout=60_000)
        yield page, visit


def place_of(page: Page) -> np.ndarray:
    """Of the hand [m]."""
    assert page.hand is not None
    return np.array(page.hand.root.position)


def eventually(holds: Callable[[], bool], visit: Visit, seconds: float = 60.0) -> bool:
    """Whether something comes true in time; the browser goes on meanwhile."""
    end = time.monotonic() + seconds
    while not holds() and time.monotonic() < end:
        visit.page.wait_for_timeout(100)
    return holds()


def rendered(visit: Visit) -> np.ndarray:
    """The part of the picture that no controls cover."""
    return visit.picture()[170:, :620].astype(int)


def changes(visit: Visit, before: np.ndarray) -> bool:
    """Whether at least 1 % of the pixels come to look different."""
    return eventually(lambda: (np.abs(rendered(visit) - before).max(axis=-1) > 30).mean() > 0.01, visit, 30)


def test_page_shows_the_mug_and_the_hand(served: tuple[Page, Visit]) -> None:
    page, visit = served
    warm = lambda p: (p[..., 0] - p[..., 2] > 50).mean()  # noqa: E731  the mug
    cool = lambda p: (p[..., 2] - p[..., 0] > 25).mean()  # noqa: E731  the hand at the surest grasp
    assert eventually(lambda: warm(rendered(visit)) > 0.01 and cool(rendered(visit)) > 0.01, visit)
    assert page.hand is not None
    np.testing.assert_allclose(place_of(page), page.shown.grasps.T_world_gripper[0, :3, 3], atol=1e-6)


def test_slider_moves_the_hand(served: tuple[Page, Visit]) -> None:
    page, visit = served
    assert page.hand is not None
    before, place = rendered(visit), place_of(page)
    visit.page.get_by_role("slider").first.press("ArrowRight")
    assert eventually(lambda: page.index == 1, visit)
    assert eventually(lambda: not np.allclose(place_of(page), place), visit)
    np.testing.assert_allclose(place_of(page), page.shown.grasps.T_world_gripper[1, :3, 3], atol=1e-6)
    assert changes(visit, before)
    visit.page.get_by_text(f"{page.shown.grasps.score[1]:.3f}").wait_for()


def test_play_goes_from_the_pregrasp_to_the_lift(served: tuple[Page, Visit]) -> None:
    page, visit = served
    places = []
    stage = page.stage
    assert stage is not None
    page.panel.moment.on_update(lambda _: places.append(place_of(page)))
    visit.page.get_by_role("button", name="Play the grasp").click()
    assert eventually(lambda: page.panel.moment.value == 1.0, visit)
    assert eventually(lambda: stage.object.position[2] > 0.11, visit)
    np.testing.assert_allclose(places[0], page.shown.grasps.T_world_pregrasp[page.index, :3, 3], atol=2e-2)
    assert len(places) > 10


def test_particles_and_rejected_candidates_are_drawn(served: tuple[Page, Visit]) -> None:
    page, visit = served
    particles = page.particles
    assert particles is not None
    visit.page.get_by_role("tab", name="Search").click()
    visit.page.get_by_label("Particles", exact=True).check()
    assert eventually(lambda: particles.visible, visit)
    before, lines = rendered(visit), np.array(particles.points)
    visit.page.get_by_role("slider").first.press("End")
    assert eventually(lambda: page.panel.iteration.value == len(page.search) - 1, visit)
    assert eventually(lambda: not np.allclose(particles.points, lines), visit)
    assert changes(visit, before)
    visit.page.get_by_label("Particles", exact=True).uncheck()
    visit.page.get_by_label("Rejected", exact=True).check()
    assert eventually(lambda: all(node.visible for node in page.rejected.values()), visit)
    visit.page.get_by_label("Rejected", exact=True).uncheck()


def test_replanning_changes_the_grasps(served: tuple[Page, Visit]) -> None:
    page, visit = served
    before = page.shown
    visit.page.get_by_role("tab", name="Plan").click()
    visit.page.get_by_label("Object", exact=True).click()
    visit.page.get_by_role("option", name="can", exact=True).click()
    visit.page.get_by_role("button", name="Plan", exact=True).click()
    assert eventually(lambda: page.shown is not before, visit)
    visit.page.get_by_text("Planned in").wait_for(timeout=60_000)
    assert page.shown.scene is not before.scene
    assert not np.allclose(page.shown.grasps.T_world_gripper[0], before.grasps.T_world_gripper[0])
    np.testing.assert_allclose(place_of(page), page.shown.grasps.T_world_gripper[0, :3, 3], atol=1e-6)


def test_what_no_hand_can_grasp_is_explained_on_the_page(served: tuple[Page, Visit]) -> None:
    page, visit = served
    assert isinstance(page.catalogue.scenes, dict)
    page.catalogue.scenes["block"] = lambda: Scene.from_mesh(creation.box((0.2, 0.2, 0.2)))
    page.panel.scene.options = (*page.panel.scene.options, "block")
    page.panel.scene.value = "block"
    page.replan()
    visit.page.get_by_text("0 grasps").first.wait_for(timeout=60_000)
    assert page.hand is None
    assert not page.panel.plan.disabled


def test_nothing_went_wrong_in_the_browser_and_nothing_left_the_machine(served: tuple[Page, Visit]) -> None:
    _, visit = served
    assert visit.complaints == []
    assert visit.requests == []


def test_the_catalogue_has_all_hands_and_the_scene_that_is_shown(served: tuple[Page, Visit]) -> None:
    page, _ = served
    catalogue, scene = catalogue_of(page.shown, CONFIG)
    assert {"franka_hand", "barrett_bh282"} <= set(catalogue.hands)
    assert scene in catalogue.scenes
