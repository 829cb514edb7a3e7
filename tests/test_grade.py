"""How sure a grasp is, which are tried at all, and what moving them a little brings."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graspmatch.config import PlannerConfig, RefiningConfig
from graspmatch.geometry import se3
from graspmatch.gripper.load import load_gripper
from graspmatch.kernels.warp_hold import LOST_MARGIN
from graspmatch.planner.avoid import point_clearance, table_clearance, upload_space
from graspmatch.planner.candidates import Candidates, Closed, Graded
from graspmatch.planner.close import contact_joints
from graspmatch.planner.grade import (
    CALIBRATION,
    GUESS_SCALE,
    Trials,
    clear_share,
    confidence,
    draw_errors,
    draw_trials,
    foremost,
    grade,
    middling,
    pooled,
    stopped,
    sure_of,
)
from graspmatch.planner.hold import hold, touchable
from graspmatch.planner.match import prepare
from graspmatch.planner.refine import HARDLY_SURER, Judge, confirm, judge_of, refine, roomiest
from graspmatch.planner.tally import Tally
from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import convex_hull
from graspmatch.types import Gripper

DOWN = np.diag([1.0, -1.0, -1.0])
CONFIG = PlannerConfig()
NEVER_ENOUGH = replace(CONFIG, refining=replace(CONFIG.refining, enough=1.0))
MIDDLE = np.array([0.0, 0.0, 0.03])


@pytest.fixture(scope="module")
def franka() -> Gripper:
    return load_gripper("franka_hand")


def box_scene() -> Scene:
    """A box of 60 x 40 x 60 mm on a table."""
    corners = np.stack(np.meshgrid([-0.03, 0.03], [-0.02, 0.02], [0.0, 0.06], indexing="ij"), axis=-1).reshape(-1, 3)
    return Scene.from_mesh(convex_hull(corners), table=0.0)


@pytest.fixture(scope="module")
def judge(franka) -> Judge:
    scene = box_scene()
    problem = prepare(scene, franka, CONFIG.matching, np.random.default_rng(0), "cpu")
    return judge_of(scene, franka, upload_space(scene, franka, "cpu"), problem, CONFIG, "cpu")


def without_verdict(graded: Graded) -> Closed:
    """The grasps as they come to be judged."""
    return Closed(**{entry.name: getattr(graded, entry.name) for entry in fields(Closed)})


def around(judge: Judge, count: int, seed: int = 0, spread: float = 1.0) -> Closed:
    """Hands from above that close on the box somewhere, somehow turned; the first is centred, every fifth misses."""
    rng, gripper = np.random.default_rng(seed), judge.gripper
    at = MIDDLE + spread * rng.normal(size=(count, 3)) * [0.012, 0.006, 0.008]
    w = spread * rng.normal(size=(count, 3)) * 0.2
    at[4::5] += [0.0, 0.0, 0.15]
    at[0], w[0] = MIDDLE, 0.0
    R = DOWN @ se3.rotation_exp(w)
    poses = Candidates(np.zeros(count, dtype=int), se3.from_parts(R, at - R @ gripper.tool_centre_point))
    config = judge.config.grip
    fraction = hold(poses, np.full(count, 0.3), judge.target, gripper, config, "cpu").fraction
    return Closed(
        **vars(poses),
        matching_error=np.zeros(count),
        loss=np.zeros(count),
        is_free=np.ones(count, dtype=bool),
        matched_preshape=poses.preshape,
        clearance=np.full(count, 0.002),
        retreat=np.zeros(count),
        closing_fraction=fraction,
        grasp_joints=contact_joints(poses.preshape, fraction, gripper),
    )


def test_confidence_grows_with_the_margin_and_with_the_share_that_holds_and_falls_with_the_loss():
    axes = np.linspace(-1, 2, 31), np.linspace(0, 1, 7), np.linspace(0, 0.02, 5), np.linspace(-1, 1, 5), np.arange(6.0)
    values = confidence(*(a.ravel() for a in np.meshgrid(*axes, indexing="ij"))).reshape(31, 7, 5, 5, 6)
    assert np.all((values > 0) & (values < 1))
    assert np.all(np.diff(values, axis=0) > 0)
    assert np.all(np.diff(values, axis=1) > 0)
    assert np.all(np.diff(values, axis=2) < 0)
    assert np.all(np.diff(values, axis=3) > 0)
    assert np.all(np.diff(values, axis=4) > 0)
    assert confidence(*np.zeros((5, 1)))[0] == pytest.approx(1 / (1 + np.exp(-CALIBRATION[0])))


@pytest.mark.parametrize("count", [12, 96])
def test_errors_have_the_covariance_asked_for_and_all_one_size(count):
    position, angle = 0.003, np.radians(3.0)
    errors = draw_errors(count, position, angle, np.random.default_rng(0))
    shift, turn = errors[:, :3, 3], Rotation.from_matrix(errors[:, :3, :3]).as_rotvec()
    drawn = np.concatenate([shift / position, turn / angle], axis=-1)
    np.testing.assert_allclose(drawn.T @ drawn / count, np.eye(6), atol=1e-9)
    np.testing.assert_allclose(drawn.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(np.sum(drawn**2, axis=-1), 6)


def test_the_trials_are_as_many_as_asked_for_and_the_frictions_take_turns():
    trials = draw_trials(CONFIG.grip, 0)
    assert len(trials) == len(trials.error) == CONFIG.grip.trials
    assert len(trials.way_in) == CONFIG.grip.ways_in
    assert set(trials[:3].friction) == set(CONFIG.grip.frictions)


def test_the_same_seed_tries_the_same(franka, judge):
    first, again, other = (draw_trials(CONFIG.grip, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.error, again.error)
    assert not np.array_equal(first.error, other.error)
    closed = around(judge, 6)
    no_loss = np.zeros(6)
    a, b, c = (
        grade(closed, no_loss, no_loss, t, judge.space, judge.target, CONFIG.grip) for t in (first, again, other)
    )
    np.testing.assert_array_equal(a.confidence, b.confidence)
    assert not np.array_equal(a.confidence, c.confidence)


def test_grades_are_shares_of_the_trials_and_means_of_their_margins(franka, judge):
    closed = around(judge, 24)
    graded = judge.grade(closed, judge.first)
    share = graded.held_share * CONFIG.grip.first_trials
    np.testing.assert_allclose(share, np.round(share), atol=1e-9)
    assert np.all(graded.held_share[4::5] == 0)
    assert graded.held_share[0] == 1
    np.testing.assert_allclose(graded.margin[graded.held_share == 0], LOST_MARGIN)
    np.testing.assert_array_equal(
        graded.confidence,
        confidence(graded.margin, graded.held_share, graded.final_loss, graded.standing, graded.contacts),
    )
    assert graded.confidence[0] > np.median(graded.confidence)


def test_without_errors_every_trial_is_the_plan(franka, judge):
    closed, n = around(judge, 8), 8
    unmoved = np.tile(np.eye(4), (3, 1, 1))
    trials = Trials(unmoved, unmoved, np.full(3, middling(CONFIG.grip)), clearance=0.0, inexact=1.0)
    graded = grade(closed, np.zeros(n), np.zeros(n), trials, judge.space, judge.target, CONFIG.grip)
    planned = hold(closed, np.full(n, middling(CONFIG.grip)), judge.target, franka, CONFIG.grip, "cpu")
    clearance = np.minimum(point_clearance(closed, judge.space), table_clearance(closed, judge.space))
    assert 0 < planned.held.sum() < n
    np.testing.assert_array_equal(graded.held_share, planned.held)
    np.testing.assert_allclose(graded.margin, np.where(planned.held, planned.margin, LOST_MARGIN))
    assert 0 < np.sum(clearance > 0) < n
    np.testing.assert_array_equal(graded.clear_share, clearance > 0)
    np.testing.assert_array_equal(graded.contacts, planned.contacts)


def test_what_is_guessed_is_the_less_sure_the_farther_it_is_from_what_was_seen(franka, judge):
    scene, closed = box_scene(), around(judge, 12)
    side = scene.target.points[:, 1]
    seen = [scene, *(replace(scene, is_guessed=side < least) for least in (-0.01, 0.01, 0.0199))]
    targets = [touchable(each, CONFIG.grip.points, "cpu") for each in seen]
    graded = [replace(judge, target=target).grade(closed, judge.first) for target in targets]
    held = graded[0].held_share == 1
    np.testing.assert_array_equal(graded[0].seen_share, 1.0)
    np.testing.assert_array_equal(graded[0].sureness, graded[0].clear_share * graded[0].confidence)
    assert held.sum() >= 3
    for surer, less_sure in pairwise(graded):
        np.testing.assert_array_equal(surer.confidence, less_sure.confidence)
        assert np.all(less_sure.seen_share[held] < surer.seen_share[held])
    assert graded[-1].seen_share[0] == pytest.approx(sure_of(np.array([0.04]))[0], abs=0.03)
    assert sure_of(np.zeros(1)) == 1
    assert sure_of(np.array([GUESS_SCALE])) == pytest.approx(np.exp(-1))


def test_tries_are_pooled_by_how_many_they_are(judge):
    half = replace(box_scene(), is_guessed=box_scene().target.points[:, 1] < 0)
    unsure = replace(judge, target=touchable(half, CONFIG.grip.points, "cpu"))
    closed = around(judge, 8)
    first, others, both = (unsure.grade(closed, slice(*part)) for part in ((0, 6), (6, 18), (0, 18)))
    pool = pooled(first, others)
    for name in ("margin", "held_share", "contacts", "seen_share", "tries", "confidence", "sureness"):
        np.testing.assert_allclose(getattr(pool, name), getattr(both, name), atol=1e-9)
    assert np.any(pool.seen_share < 1)


def test_an_arrival_keeps_its_clearance_and_some_are_inexact(judge):
    closed = around(judge, 8)
    unmoved = np.tile(np.eye(4), (2, 1, 1))
    coarse = replace(judge.space, points=judge.space.coarse)
    clearance = np.minimum(point_clearance(closed, coarse), table_clearance(closed, judge.space))
    wanted = float(np.sort(clearance)[4] + np.sort(clearance)[5]) / 2
    trials = replace(judge.trials, way_in=unmoved, clearance=wanted, inexact=1.0)
    np.testing.assert_array_equal(clear_share(closed, trials, judge.space), clearance > wanted)
    inexact = clear_share(closed, replace(judge.trials, inexact=1.0), judge.space)
    assert inexact.min() < 0.9
    some = clear_share(closed, replace(judge.trials, inexact=0.25), judge.space)
    np.testing.assert_allclose(some, 0.75 + 0.25 * inexact)
    np.testing.assert_array_equal(clear_share(closed, replace(judge.trials, inexact=0.0), judge.space), 1.0)


def test_a_hand_where_nobody_knows_what_is_there_is_less_sure(franka, judge):
    closed = around(judge, 1)
    side = closed.T_world_gripper[0, :3, :3] @ franka.closing
    finger = np.arange(0.0, 0.03, 0.003)[:, None] * np.array([0.0, 0.0, 1.0]) + 0.047 * side + [0.0, 0.0, 0.02]
    scene = replace(box_scene(), doubtful=finger)
    space = upload_space(scene, franka, "cpu")
    trials = draw_trials(CONFIG.grip, 0, is_exact=False)
    assert clear_share(closed, trials, judge.space)[0] > 0.9
    assert clear_share(closed, trials, space)[0] < 0.3
    assert point_clearance(closed, space) == point_clearance(closed, judge.space)  # it may be free all the same


def test_what_a_camera_sees_is_inexact():
    mesh, view = (draw_trials(CONFIG.grip, 0, is_exact=is_exact).inexact for is_exact in (True, False))
    assert mesh < view == 1.0
    config = replace(CONFIG.grip, inexact=0.5)
    assert draw_trials(config, 0, is_exact=True).inexact == draw_trials(config, 0, is_exact=False).inexact == 0.5


def test_a_hand_that_barely_fits_is_less_sure_than_one_with_room(franka, judge):
    centred = around(judge, 1)
    aside = replace(centred, T_world_gripper=centred.T_world_gripper.copy())
    aside.T_world_gripper[:, :3, 3] += 0.019 * (centred.T_world_gripper[:, :3, :3] @ franka.closing)  # of 20 mm of room
    inexact = replace(judge, trials=replace(judge.trials, inexact=1.0))
    room, tight = (inexact.grade(closed, judge.first) for closed in (centred, aside))
    assert room.clear_share[0] > 0.9
    assert 0.2 < tight.clear_share[0] < 0.8
    np.testing.assert_allclose(tight.clear_share, clear_share(aside, inexact.trials, judge.space))
    np.testing.assert_array_equal(tight.sureness, tight.clear_share * tight.confidence)
    assert tight.sureness[0] < 0.9 * room.sureness[0]


def test_fingers_end_where_they_hold_the_object(franka, judge):
    closed = around(judge, 5)
    elsewhere = replace(closed, closing_fraction=np.full((5, 2), 0.1))
    graded = stopped(judge.grade(elsewhere, judge.first), judge.target, franka, CONFIG.grip, "cpu")
    np.testing.assert_allclose(graded.closing_fraction[0], 0.5, atol=0.02)  # 40 of 80 mm
    np.testing.assert_allclose(graded.grasp_joints[0], 0.02, atol=0.001)
    np.testing.assert_array_equal(graded.closing_fraction[4], 0.1)  # holds nothing


def test_none_are_graded_without_an_error(judge):
    graded = judge.grade(around(judge, 1).select(np.zeros(0, dtype=int)), judge.first)
    assert graded.confidence.shape == graded.held_share.shape == (0,)
    assert len(refine(graded, judge)) == 0


def test_the_foremost_hold_and_the_tally_adds_up(franka, judge):
    closed = around(judge, 40)
    tally = Tally(40)
    chosen = foremost(closed, 10, judge.trials, judge.space, judge.target, CONFIG.grip, tally)
    dropped = sum(count for reason, count in tally.counts.items() if reason != "candidates")
    assert len(chosen) == 10
    assert len(chosen) + dropped == 40
    held = [
        hold(some, np.full(len(some), middling(CONFIG.grip)), judge.target, franka, CONFIG.grip, "cpu").held
        for some in (chosen, closed)
    ]
    assert held[0].all()
    assert not held[1].all()


def test_a_hand_arrives_in_the_wider_preshape_that_has_more_room(franka, judge):
    closed = around(judge, 6)
    names = [preshape.name for preshape in franka.preshapes]
    narrow = replace(closed, preshape=np.full(6, names.index("close_30")))  # 50 mm for an object of 40 mm
    wide, share = roomiest(narrow, judge)
    before, after = (clear_share(some, judge.trials, judge.space) for some in (narrow, wide))
    assert len(wide) == 6
    np.testing.assert_array_equal(share, after)
    assert np.all(after >= before)
    assert after[0] > before[0]
    assert names[wide.preshape[0]] < "close_30"
    np.testing.assert_array_equal(wide.T_world_gripper, narrow.T_world_gripper)
    np.testing.assert_allclose(wide.grasp_joints[0], 0.02, atol=0.001)  # where they meet the object
    must_not = replace(judge, config=replace(CONFIG, collision=replace(CONFIG.collision, may_open=False)))
    np.testing.assert_array_equal(roomiest(narrow, must_not)[0].preshape, narrow.preshape)


def test_refining_makes_the_surest_surer(judge):
    aside = around(judge, 16, seed=3, spread=1.5).select(np.arange(1, 16))  # without the centred hand, which is sure
    graded = judge.grade(aside, judge.first)
    assert graded.sureness.max() < HARDLY_SURER
    refined = refine(graded, replace(judge, config=NEVER_ENOUGH))
    assert len(refined) == len(graded)
    before, after = (judge.grade(without_verdict(g), slice(None)).sureness for g in (graded, refined))
    assert after.max() >= before.max()
    assert np.sort(after)[-CONFIG.refining.count :].mean() > np.sort(before)[-CONFIG.refining.count :].mean()
    moved = ~np.isin(refined.T_world_gripper[:, 0, 3], graded.T_world_gripper[:, 0, 3])
    assert 0 < moved.sum() <= CONFIG.refining.count
    assert np.all(refined.clearance[moved] > 0.98 * CONFIG.collision.clearance)
    confirmed = refined.tries == CONFIG.grip.trials
    assert confirmed.sum() >= CONFIG.grip.leaders
    np.testing.assert_allclose(after[confirmed], refined.sureness[confirmed], rtol=1e-6)  # judged as they now are


def test_nothing_is_moved_where_a_grasp_can_hardly_get_surer(judge):
    graded = judge.grade(around(judge, 10, spread=0.5), judge.first)
    assert graded.sureness.max() > HARDLY_SURER
    assert graded.sureness.min() < CONFIG.refining.enough
    refined = refine(graded, replace(judge, config=NEVER_ENOUGH))
    np.testing.assert_array_equal(refined.T_world_gripper, graded.T_world_gripper)


def test_a_grasp_that_is_sure_enough_is_not_refined(judge):
    graded = judge.grade(around(judge, 10, spread=0.5), judge.first)
    refined = refine(graded, judge)
    assert refined.sureness.max() >= CONFIG.refining.enough
    np.testing.assert_array_equal(refined.T_world_gripper, graded.T_world_gripper)


@pytest.mark.parametrize("off", [RefiningConfig(count=0), RefiningConfig(rounds=0)])
def test_refining_can_be_turned_off(judge, off):
    graded = judge.grade(around(judge, 4), judge.first)
    same = refine(graded, replace(judge, config=replace(CONFIG, refining=off)))
    np.testing.assert_array_equal(same.T_world_gripper, graded.T_world_gripper)


def test_confirming_tries_all_that_lead_as_often_as_wanted(judge):
    graded = judge.grade(around(judge, 20), judge.first)
    confirmed = confirm(graded, judge)
    np.testing.assert_array_equal(confirmed.T_world_gripper, graded.T_world_gripper)
    every = judge.grade(without_verdict(graded), slice(None))
    leaders = np.argsort(-confirmed.sureness, kind="stable")[: CONFIG.grip.leaders]
    np.testing.assert_allclose(confirmed.confidence[leaders], every.confidence[leaders])
    np.testing.assert_allclose(confirmed.held_share[leaders], every.held_share[leaders])
    others = ~np.isclose(confirmed.margin, every.margin)
    np.testing.assert_array_equal(confirmed.margin[others], graded.margin[others])


def test_there_is_nothing_to_confirm_when_all_trials_are_the_first(judge):
    config = replace(CONFIG, grip=replace(CONFIG.grip, trials=6))
    graded = judge.grade(around(judge, 4), judge.first)
    np.testing.assert_array_equal(confirm(graded, replace(judge, config=config)).margin, graded.margin)
