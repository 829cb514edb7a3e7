"""Closing fingers, an object that gives way between them, and the lift: known answers on boxes and wedges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from graspmatch.config import GripConfig
from graspmatch.geometry import se3
from graspmatch.gripper.load import load_gripper
from graspmatch.kernels import warp_reach
from graspmatch.kernels.fields import in_blocks
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.hold import GRAVITY, HeldAt, Touchable, drives, hold_at, touchable
from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import convex_hull
from graspmatch.types import Gripper

Z = np.array([0.0, 0.0, 1.0])
DOWN = np.diag([1.0, -1.0, -1.0])
SIZE = (0.06, 0.04, 0.06)
MIDDLE = (0.0, 0.0, 0.03)
CONFIG = GripConfig()
MIDDLING = 0.3


@pytest.fixture(scope="module")
def franka() -> Gripper:
    return load_gripper("franka_hand")


@pytest.fixture(params=["franka", "toy"])
def hand(request) -> Gripper:
    return request.getfixturevalue(request.param)


def wedge(bottom: float, top: float, *, length=0.06, height=0.06) -> Scene:
    """A block on the table whose sides along y are so wide at the bottom and at the top [m]."""
    ends = [(x, y * width / 2, z) for x in (-0.5, 0.5) for y in (-1, 1) for width, z in ((bottom, 0), (top, height))]
    return Scene.from_mesh(convex_hull(np.array(ends) * [length, 1, 1]), table=0.0)


def box(length=SIZE[0], width=SIZE[1], height=SIZE[2]) -> Scene:
    return wedge(width, width, length=length, height=height)


@pytest.fixture(scope="module")
def target() -> Touchable:
    return touchable(box(), CONFIG.points, "cpu")


def above(gripper: Gripper, *at, turn=0.0) -> Candidates:
    """The open hand from straight above, its tool centre point at these places, turned about the approach [rad]."""
    R = DOWN @ se3.rotation_exp(turn * gripper.approach)
    at = np.array(at, dtype=float).reshape(-1, 3)
    T = se3.from_parts(np.tile(R, (len(at), 1, 1)), at - R @ gripper.tool_centre_point)
    return Candidates(np.zeros(len(at), dtype=int), T)


def closed_on(
    target: Touchable,
    hands: Candidates,
    gripper: Gripper,
    friction: float | Sequence[float] | np.ndarray = MIDDLING,
    config: GripConfig = CONFIG,
) -> HeldAt:
    each = np.broadcast_to(np.asarray(friction, dtype=float), len(hands)).copy()
    return hold_at(hands, each, target, gripper, config, "cpu")


def contacts(held: HeldAt, i: int, g: int):
    """Points and pushes of what g touches."""
    return held.point[i, g, : held.count[i, g]], held.push[i, g, : held.count[i, g]]


def around(gripper: Gripper, rng: np.random.Generator, count: int) -> Candidates:
    """Hands from above that grasp the box somewhere, somehow turned."""
    hands = above(gripper, *(MIDDLE + rng.normal(size=(count, 3)) * [0.012, 0.006, 0.008]))
    turn = se3.from_parts(se3.rotation_exp(rng.normal(size=(count, 3)) * 0.25), np.zeros((count, 3)))
    tcp = gripper.tool_centre_point
    return replace(hands, T_world_gripper=hands.T_world_gripper @ se3.translation(tcp) @ turn @ se3.translation(-tcp))


# --- contacts --------------------------------------------------------------------------------------------------------


def test_contacts_are_on_the_faces_between_the_pads_and_push_along_the_closing_axis(hand, target):
    found = closed_on(target, above(hand, MIDDLE), hand)
    faces = []
    for f in range(2):
        point, push = contacts(found, 0, f)
        assert len(point) >= 3
        faces.append((point @ hand.closing).mean())
        np.testing.assert_allclose(point @ hand.closing, faces[-1], atol=1e-3)
        assert np.abs((point - hand.tool_centre_point) @ np.cross(hand.closing, hand.approach)).max() < 0.013
        np.testing.assert_allclose(push, np.tile(-np.sign(faces[-1]) * hand.closing, (len(push), 1)), atol=0.03)
    assert np.ptp(faces) == pytest.approx(SIZE[1], abs=1e-3)
    assert abs(sum(faces)) <= 2 * found.pushed[0] + 1e-3
    assert np.all(found.count[0, 2:] == 0)  # the palm is far, and what is lifted is off the table


@pytest.mark.parametrize("height", [0.045, 0.052, 0.058])
def test_contacts_near_an_edge_push_along_the_way_of_the_finger(franka, target, height):
    found = closed_on(target, above(franka, (0, 0, height)), franka)
    for f in range(2):
        _, push = contacts(found, 0, f)
        assert len(push) > 1
        assert np.abs(push @ franka.closing).min() > 0.85


@pytest.mark.parametrize("width", [0.02, 0.04, 0.07])
def test_fingers_close_until_they_meet_the_box(franka, width):
    found = closed_on(touchable(box(width=width), CONFIG.points, "cpu"), above(franka, MIDDLE), franka)
    assert found.fraction.mean() == pytest.approx(1 - width / franka.opening, abs=0.02)


def test_a_box_near_the_palm_touches_it(franka, target):
    found = closed_on(target, above(franka, (0, 0, 0.018)), franka)
    point, push = contacts(found, 0, 2)
    assert len(point) >= 4
    np.testing.assert_allclose(push, np.tile(franka.approach, (len(push), 1)), atol=1e-3)
    np.testing.assert_allclose(point @ franka.approach, 0.1034 - (SIZE[2] - 0.018), atol=1e-3)


@pytest.mark.parametrize(("width", "aside"), [(0.04, 0.0), (0.04, 0.01), (0.07, 0.0), (0.07, 0.004), (0.079, 0.0)])
def test_a_box_far_from_the_palm_does_not_touch_it(franka, width, aside):
    """The palm is 66 mm from the hand's origin, the box 33 mm farther; the open fingers are beside it."""
    narrow = touchable(box(width=width), CONFIG.points, "cpu")
    found = closed_on(narrow, above(franka, (0, aside, 0.055)), franka)
    assert np.all(found.count[0, :2] > 0)
    assert found.count[0, 2] == 0


@pytest.mark.parametrize("table", [0.0, None])
def test_fingers_around_nothing_touch_nothing_and_hold_nothing(franka, table):
    scene = box() if table is not None else replace(box(), table=None)
    found = closed_on(touchable(scene, CONFIG.points, "cpu"), above(franka, (0, 0, 0.2), (0.3, 0, 0.03)), franka)
    assert np.all(found.fraction == 2.0)
    assert np.all(found.contacts == 0)
    assert not found.held.any()
    assert np.all(found.margin < 0)
    assert np.all(found.pushed == 0)


def test_fingers_of_one_joint_share_a_drive(franka):
    assert drives(franka) == [0, 0]
    assert drives(load_gripper("barrett_bh282")) == [0, 1, 2]


# --- on the way ------------------------------------------------------------------------------------------------------


def test_a_centred_pinch_neither_moves_nor_turns_the_box(hand, target):
    found = closed_on(target, above(hand, MIDDLE, (0, 0, 0.04), (0.01, 0, 0.03)), hand)
    assert found.held.all()
    assert np.all(found.margin > 0)
    most = 0.0 if hand.name == "franka_hand" else CONFIG.step  # the toy's fields tell its fingers' places to 5 mm
    assert np.all(found.pushed <= most)
    assert np.all(found.slipped == 0)


@pytest.mark.parametrize("offset", [-0.012, -0.004, 0.004, 0.008, 0.016])
def test_a_pinch_off_to_one_side_pushes_the_box_to_the_middle(franka, target, offset):
    found = closed_on(target, above(franka, (0, offset, 0.03)), franka)
    assert found.held[0]
    assert found.pushed[0] == pytest.approx(abs(offset), abs=2 * CONFIG.step)
    middle = np.mean([contacts(found, 0, f)[0].mean(axis=0) @ franka.closing for f in range(2)])
    assert abs(middle) < 1.5 * CONFIG.step


@pytest.mark.parametrize("turn", [-10, 10])
@pytest.mark.parametrize("friction", [0.1, 0.3])
def test_a_box_that_is_turned_a_little_is_held_no_more_turned(franka, target, turn, friction):
    found = closed_on(target, above(franka, MIDDLE, turn=np.radians(turn)), franka, friction)
    assert found.held[0]
    for f in range(2):
        _, push = contacts(found, 0, f)
        assert np.abs(push[0] @ franka.closing) > np.cos(np.radians(13))


@pytest.mark.parametrize("turn", [20, 30])
def test_pads_turn_a_smooth_box_towards_flush(franka, target, turn):
    """As far as patches that are 2 mm deep tell: those that reach from one border of the pad to the other stop it."""
    found = closed_on(target, above(franka, MIDDLE, turn=np.radians(turn)), franka, 0.05)
    for f in range(2):
        _, push = contacts(found, 0, f)
        assert np.abs(push[0] @ franka.closing) > np.cos(np.radians(14))


@pytest.mark.parametrize(("friction", "held"), [(0.05, False), (0.15, False), (0.5, True), (0.7, True)])
def test_a_wedge_that_narrows_towards_the_palm_slips_out_of_smooth_fingers(franka, friction, held):
    """Its sides lean by a third: the friction that holds it."""
    found = closed_on(touchable(wedge(0.06, 0.02), CONFIG.points, "cpu"), above(franka, MIDDLE), franka, friction)
    assert found.held[0] == held


def test_a_wedge_that_widens_towards_the_palm_stays_in_smooth_fingers(franka):
    found = closed_on(touchable(wedge(0.02, 0.06), CONFIG.points, "cpu"), above(franka, MIDDLE), franka, 0.1)
    assert found.held[0]


def test_what_lies_on_nothing_does_not_fall_before_it_is_lifted(franka):
    floating = touchable(replace(box(), table=None), CONFIG.points, "cpu")
    found = closed_on(floating, above(franka, MIDDLE, (0, 0.01, 0.03)), franka, [0.0, 0.3])
    assert found.pushed[0] == 0.0
    assert found.pushed[1] == pytest.approx(0.01, abs=2 * CONFIG.step)
    height = contacts(found, 1, 0)[0] @ franka.approach
    assert found.held[1]
    assert 0.085 < height.min() < height.max() < 0.12  # between the pads, as it was


# --- the lift --------------------------------------------------------------------------------------------------------


CAPACITY = 2 * MIDDLING * 40.0 / GRAVITY
"""Mass that two fingers of 40 N carry by a friction of 0.3 [kg]."""


@pytest.mark.parametrize("mass", [0.1, 0.3])
def test_nothing_is_lifted_without_friction(franka, target, mass):
    found = closed_on(target, above(franka, MIDDLE, (0.015, 0, 0.03)), franka, 0.0, replace(CONFIG, mass=mass))
    assert not found.held.any()


@pytest.mark.parametrize(("share", "held"), [(0.5, True), (0.9, True), (1.2, False), (1.5, False), (3.0, False)])
def test_as_much_is_lifted_as_friction_carries(franka, target, share, held):
    found = closed_on(target, above(franka, MIDDLE), franka, MIDDLING, replace(CONFIG, mass=share * CAPACITY))
    assert found.held[0] == held


def test_more_friction_never_loses_a_centred_pinch(hand, target):
    friction = np.array([0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8, 1.2])
    hands = above(hand, *[MIDDLE] * len(friction))
    found = closed_on(target, hands, hand, friction)
    assert np.all(np.diff(found.held.astype(int)) >= 0)
    assert found.held[-1]


def test_a_pinch_off_the_centre_of_mass_has_a_smaller_margin_if_the_box_is_heavy(franka, target):
    found = closed_on(target, above(franka, MIDDLE, (0.012, 0, 0.03)), franka, config=replace(CONFIG, mass=1.5))
    assert found.margin[0] > found.margin[1] + 0.01


def test_what_is_held_is_in_balance(franka, target):
    """A margin below zero is a proof that it is not: some wrench is missing."""
    hands = around(franka, np.random.default_rng(0), 150)
    for friction in (0.15, 0.45):
        found = closed_on(target, hands, franka, friction)
        assert 20 < found.held.sum() < 150
        assert np.all(found.margin[found.held] >= -CONFIG.balanced)


# --- what nobody saw --------------------------------------------------------------------------------------------------


def half_seen(scene: Scene, least: float) -> Scene:
    """The same, but that only what is at y >= `least` was seen [m]."""
    return replace(scene, is_guessed=scene.target.points[:, 1] < least)


def test_all_of_a_mesh_counts_as_seen(franka, target):
    assert not box().beyond.any()
    assert not closed_on(target, around(franka, np.random.default_rng(0), 20), franka).beyond.any()


def test_a_finger_on_a_guessed_side_is_as_far_from_what_was_seen_as_the_object_is_wide(franka):
    seen_from_the_left = half_seen(box(), SIZE[1] / 2 - 1e-6)
    np.testing.assert_allclose(
        seen_from_the_left.beyond, SIZE[1] / 2 - seen_from_the_left.target.points[:, 1], atol=2.5e-3
    )
    found = closed_on(touchable(seen_from_the_left, CONFIG.points, "cpu"), above(franka, MIDDLE), franka)
    assert found.held.all()
    assert found.beyond[0] == pytest.approx(SIZE[1], abs=2e-3)


def test_fingers_on_sides_that_were_seen_are_sure_of_them_whatever_is_between(franka):
    scene = box()
    inside = np.abs(scene.target.points[:, 1]) < SIZE[1] / 2 - 0.004
    found = closed_on(touchable(replace(scene, is_guessed=inside), CONFIG.points, "cpu"), above(franka, MIDDLE), franka)
    assert found.held.all()
    assert found.beyond[0] < 1e-3


# --- what must not matter --------------------------------------------------------------------------------------------


def with_arrays(body: warp_reach.Body, change) -> warp_reach.Body:
    """The body with `change(name, values)` in place of each of its arrays."""
    other = warp_reach.Body()
    for name in warp_reach.Body.vars:
        value = getattr(body, name)
        is_array = isinstance(value, wp.array)
        setattr(other, name, wp.array(change(name, value.numpy()), dtype=value.dtype) if is_array else value)
    other.blocks = wp.array(in_blocks(other.points.numpy()).ravel(), dtype=wp.float32)
    return other


def test_moving_or_turning_the_world_about_the_vertical_changes_nothing(franka, target):
    still = above(franka, MIDDLE, (0, 0, 0.045), (0.01, 0, 0.03), (-0.012, 0, 0.025))
    hands = Candidates(
        np.zeros(64, dtype=int),
        np.concatenate([still.T_world_gripper, around(franka, np.random.default_rng(1), 60).T_world_gripper]),
    )
    world = se3.from_parts(se3.rotation_exp(0.9 * Z), np.array([0.7, -0.4, 0.2]))
    turned = with_arrays(target.body, lambda _, a: a @ world[:3, :3].T if a.ndim == 2 else a)
    moved = replace(target, body=turned, centre_of_mass=se3.apply(world, target.centre_of_mass[None])[0])
    before = closed_on(target, hands, franka)
    after = closed_on(moved, replace(hands, T_world_gripper=world @ hands.T_world_gripper), franka)
    apart = np.abs(after.margin - before.margin)
    np.testing.assert_allclose(apart[:4], 0.0, atol=1e-3)
    assert after.held[:4].all()
    assert np.mean(after.held == before.held) > 0.85  # on the way, steps add up what rounding differs by
    assert np.median(apart) < 0.005


def test_order_of_the_points_hardly_matters(franka, target):
    hands = around(franka, np.random.default_rng(2), 60)
    n = len(target.body.points)
    order = np.random.default_rng(3).permutation(n)
    shuffled = replace(target, body=with_arrays(target.body, lambda _, a: a[order] if len(a) == n else a))
    config = replace(CONFIG, reachable_points=n)  # else others are left out
    first, second = (closed_on(body, hands, franka, config=config) for body in (target, shuffled))
    assert np.mean(first.held == second.held) > 0.95
    assert np.mean(np.abs(first.margin - second.margin) < 0.05) > 0.9


def test_number_of_threads_does_not_matter(franka, target, monkeypatch):
    hands, results = around(franka, np.random.default_rng(4), 40), []
    for threads in ("1", "2", "4"):
        monkeypatch.setenv("GRASPMATCH_THREADS", threads)
        results.append(closed_on(target, hands, franka))
    for other in results[1:]:
        for name in ("held", "margin", "fraction", "count", "pushed", "slipped"):
            np.testing.assert_array_equal(getattr(other, name), getattr(results[0], name))


def test_other_candidates_do_not_matter(franka, target):
    hands = around(franka, np.random.default_rng(5), 20)
    together, alone = closed_on(target, hands, franka), closed_on(target, hands.select(np.array([7])), franka)
    assert together.margin[7] == alone.margin[0]
    assert together.held[7] == alone.held[0]


def test_no_candidates_are_no_error(franka, target):
    nothing = closed_on(target, Candidates(np.zeros(0, dtype=int), np.zeros((0, 4, 4))), franka)
    assert nothing.fraction.shape == (0, 2)
    assert nothing.held.shape == nothing.margin.shape == (0,)
