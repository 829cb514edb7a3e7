"""Contacts of closed fingers and the wrench that they resist: closed forms, a certified reference, invariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial import ConvexHull

from graspmatch.config import GripConfig
from graspmatch.geometry import se3
from graspmatch.gripper.load import load_gripper
from graspmatch.kernels import reference, warp_grip
from graspmatch.kernels.launch import launch
from graspmatch.kernels.reference import Grip
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.contacts import Touchable, contacts_of, touchable
from graspmatch.planner.grip import DESCENTS, DIRECTIONS, margins, most_force, robust_margins
from graspmatch.planner.slide import slide
from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import convex_hull
from graspmatch.types import Gripper

X, Y, Z = np.eye(3)
CORNERS = np.array([[0, 0, 0], [0, 1, 1], [0, 1, -1], [0, -1, 1], [0, -1, -1]])
NO_PALM = GripConfig(palm_reach=0.0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


# --- contacts given ---------------------------------------------------------------------------------------------------


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def held(arms, pushes, *, friction=0.5, torsion=0.0, most=1.0, load=(0.0, 0.0, 0.0), palm=None) -> Grip:
    """A grasp whose fingers have the contacts of `arms`, one array each; the palm, if any, comes last."""
    arms, pushes = [*arms, *([palm[0]] if palm else [])], [*pushes, *([palm[1]] if palm else [])]
    fingers = len(arms) - (palm is not None)
    return Grip(
        presser=np.repeat(np.arange(len(arms)), [len(arm) for arm in arms]),
        arm=np.concatenate(arms).astype(float),
        push=np.concatenate(pushes).astype(float),
        least=np.where(np.arange(len(arms)) < fingers, 1.0, 0.0),
        most=np.full(len(arms), most),
        friction=friction,
        torsion=torsion,
        load=np.asarray(load, dtype=float),
    )


def pinch(patch=0.0, **options) -> Grip:
    """Two fingers that press along x on opposite sides, 1 from the centre, with points or square patches."""
    corners = patch * CORNERS if patch else np.zeros((1, 3))
    return held([X + corners, -X + corners], [np.tile(-X, (len(corners), 1)), np.tile(X, (len(corners), 1))], **options)


def cage(**options) -> Grip:
    """Three fingers that press inwards in the plane z = 0, every third of a turn."""
    angle = 2 * np.pi * np.arange(3) / 3
    arms = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)[:, None]
    return held(arms, -arms, **options)


def drawn(rng, fingers, contacts, most, load=0.05, friction=0.3, torsion=0.1) -> Grip:
    """Fingers around an uneven ball, each with a patch of contacts."""
    angle = 2 * np.pi * np.arange(fingers) / fingers + 0.2 * rng.normal(size=fingers)
    around = np.stack([np.cos(angle), np.sin(angle), 0.2 * rng.normal(size=fingers)], axis=-1)
    arms = unit(around[:, None] + 0.25 * rng.normal(size=(fingers, contacts, 3)))
    pushes = unit(-arms + 0.1 * rng.normal(size=arms.shape))
    options = {"most": most, "friction": friction, "torsion": torsion}
    return held(arms, pushes, load=load * unit(rng.normal(size=3)), **options)


def margin_of(
    *grips: Grip, device="cpu", directions=DIRECTIONS, steps=DESCENTS, length=1.0, centre=(0.0, 0.0, 0.0), turn=None
) -> np.ndarray:
    """The kernel's margins; the same grasps of objects `length` times the size, elsewhere and turned, on request."""
    fingers = max(int(np.sum(grip.least > 0)) for grip in grips)
    turn = np.eye(3) if turn is None else turn
    shape = len(grips), fingers + 1, warp_grip.CORNERS
    count, point, push = np.zeros(shape[:2], dtype=int), np.zeros((*shape, 3)), np.zeros((*shape, 3))
    for i, grip in enumerate(grips):
        for p in range(len(grip.least)):
            own = grip.presser == p
            column = p if grip.least[p] > 0 else fingers
            count[i, column] = own.sum()
            point[i, column, : own.sum()] = length * grip.arm[own] @ turn.T + centre
            push[i, column, : own.sum()] = grip.push[own] @ turn.T
    grip = warp_grip.Grip()
    grip.count = wp.array(count, dtype=wp.int32, device=device)
    grip.point, grip.push = (wp.array(a, dtype=wp.vec3, device=device) for a in (point, push))
    grip.centre = wp.array(np.tile(centre, (len(grips), 1)), dtype=wp.vec3, device=device)
    grip.length, grip.friction, grip.torsion = length, grips[0].friction, grips[0].torsion
    grip.most = float(grips[0].most[0])
    load = wp.array(np.array([g.load for g in grips]) @ turn.T, dtype=wp.vec3, device=device)
    d = wp.array(directions, dtype=wp.spatial_vector, device=device)
    margin = wp.empty(len(grips), dtype=wp.float32, device=device)
    launch(warp_grip.wrench_margin, len(grips), [fingers, grip, d, steps, load], [margin], device)
    return margin.numpy().astype(float)


def forces(vectors):
    """Directions in the space of wrenches that are pure forces."""
    return np.concatenate([vectors, np.zeros_like(vectors)], axis=-1)


@pytest.mark.parametrize("most", [1.0, 2.0])
def test_points_without_torsion_do_not_resist_a_turn_about_their_line(most, device):
    assert margin_of(pinch(most=most), device=device)[0] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("torsion", [0.02, 0.1])
def test_torsion_of_two_points_resists_four_times_itself(torsion, device):
    """Both press twice as hard; a push along the line on top lowers it by the cosine of an angle of tangent torsion."""
    grip = pinch(torsion=torsion, most=2.0)
    expected = 4 * torsion / np.sqrt(1 + torsion**2)
    assert reference.wrench_margin(grip, np.random.default_rng(0)) == pytest.approx(expected, rel=0.01)
    assert expected - 1e-6 < margin_of(grip, device=device)[0] < 1.02 * expected


@pytest.mark.parametrize("size", [0.02, 0.1])
def test_patches_resist_the_turn_that_points_do_not(size, device):
    """Friction at the corners, as torsion above: its lever is the corners' distance from the line."""
    lever = 0.5 * np.sqrt(2) * size
    expected = 4 * lever / np.sqrt(1 + lever**2)
    assert expected - 1e-6 < margin_of(pinch(patch=size, most=2.0), device=device)[0] < 1.02 * expected


def test_given_forces_of_two_fingers_do_not_resist_a_push_along_their_line(device):
    """What presses with a given force gives way to any more."""
    assert margin_of(pinch(patch=0.1, torsion=0.1), device=device)[0] == pytest.approx(0.0, abs=1e-6)


def test_smooth_cage_resists_pushes_in_its_plane_and_none_out_of_it(device):
    """Fingers of force 1 to 2 at angles of 120 degrees: a hexagon of forces, its inradius the sine of 60 degrees."""
    angle = np.radians(np.arange(0, 360, 5))
    in_plane = forces(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1))
    smooth = cage(friction=0.0, most=2.0)
    found = margin_of(smooth, directions=in_plane, steps=0, device=device)[0]
    assert found == pytest.approx(np.sqrt(3) / 2, abs=1e-5)
    assert margin_of(smooth, device=device)[0] == pytest.approx(0.0, abs=1e-6)


def test_rough_cage_resists_every_wrench(device):
    grip = cage(friction=0.5, torsion=0.1, most=2.0)
    least = reference.wrench_margin(grip, np.random.default_rng(0))
    assert least > 1.0
    assert least - 1e-3 < margin_of(grip, device=device)[0] < 1.2 * least


def test_fingers_on_one_side_miss_their_whole_force(device):
    arms = [np.array([[-1.0, 0.5, 0.0]]), np.array([[-1.0, -0.5, 0.0]])]
    grip = held(arms, [X[None], X[None]], torsion=0.1)
    assert margin_of(grip, device=device)[0] == pytest.approx(-2.0, abs=1e-4)
    assert reference.missing_wrench(grip) == pytest.approx(2.0, abs=1e-5)


def test_a_palm_against_two_fingers_on_one_side_makes_up_for_what_they_push(device):
    arms = [np.array([[-1.0, 0.5, 0.0]]), np.array([[-1.0, -0.5, 0.0]])]
    palm = X + 0.5 * CORNERS, np.tile(-X, (5, 1))
    grip = held(arms, [X[None], X[None]], torsion=0.1, most=3.0, palm=palm)
    without = held(arms, [X[None], X[None]], torsion=0.1, most=3.0)
    least = reference.wrench_margin(grip, np.random.default_rng(0))
    assert least > 0.5
    assert least - 1e-3 < margin_of(grip, device=device)[0] < 1.2 * least
    assert margin_of(without, device=device)[0] == pytest.approx(-2.0, abs=1e-4)


@pytest.mark.parametrize("weight", [0.5, 0.9])
def test_friction_carries_a_weight_that_is_less_than_its_capacity(weight, device):
    grip = pinch(patch=0.1, load=-weight * Z)
    upwards = forces(np.array([Z, Z]))
    assert margin_of(grip, directions=upwards, steps=0, device=device)[0] == pytest.approx(1.0 - weight, abs=1e-6)
    assert margin_of(grip, device=device)[0] == pytest.approx(0.0, abs=1e-6)
    assert reference.missing_wrench(grip) == 0.0


@pytest.mark.parametrize("weight", [1.1, 3.0])
def test_weight_beyond_the_friction_capacity_is_what_is_missing(weight, device):
    """Two fingers of force 1 and friction 0.5 carry 1."""
    grip = pinch(patch=0.1, load=-weight * Z)
    assert margin_of(grip, device=device)[0] == pytest.approx(1.0 - weight, abs=1e-4)
    assert reference.missing_wrench(grip) == pytest.approx(weight - 1.0, abs=1e-5)


def test_without_contacts_the_weight_is_missing(device):
    nothing = held([np.zeros((0, 3))] * 2, [np.zeros((0, 3))] * 2, load=-0.3 * Z)
    assert margin_of(nothing, device=device)[0] == pytest.approx(-0.3, abs=1e-4)


@pytest.mark.parametrize("knob", ["friction", "torsion"])
def test_more_friction_never_lowers_the_support(rng, knob):
    """Along given directions; the search from them could end elsewhere."""
    grips = [drawn(rng, *shape) for shape in ((2, 5, 1.0), (3, 4, 2.0), (4, 3, 3.0)) for _ in range(5)]
    d = unit(rng.normal(size=(200, 6)))
    for grip in grips:
        values = [margin_of(replace(grip, **{knob: v}), directions=d, steps=0)[0] for v in (0.0, 0.1, 0.3, 0.8)]
        assert np.all(np.diff(values) >= -1e-6)
        assert values[-1] > values[0]


@pytest.mark.parametrize(("fingers", "contacts", "most"), [(2, 5, 1.0), (3, 4, 1.0), (3, 5, 2.0), (4, 3, 3.0)])
def test_margin_is_at_or_a_little_above_the_least_of_many_directions(rng, fingers, contacts, most, device):
    """A search never finds less than the least; how much more it finds is bounded here, in shares of all force."""
    grips = [grip for grip in (drawn(rng, fingers, contacts, most) for _ in range(24)) if is_balanced(grip)][:12]
    assert len(grips) >= 6
    least = np.array([reference.wrench_margin(grip, rng) for grip in grips])
    excess = (margin_of(*grips, device=device) - least) / (fingers * most)
    assert excess.min() > -0.01  # the reference is a search too
    assert np.median(excess) < 0.015
    assert excess.max() < 0.06


@pytest.mark.parametrize(("fingers", "contacts", "most"), [(2, 5, 1.0), (3, 4, 1.0)])
def test_margin_is_above_its_certified_lower_bound(rng, fingers, contacts, most, device):
    grips = [grip for grip in (drawn(rng, fingers, contacts, most) for _ in range(12)) if is_balanced(grip)][:4]
    assert len(grips) == 4
    for grip, found in zip(grips, margin_of(*grips, device=device), strict=True):
        lower, upper = reference.margin_bounds(grip, gap=0.02)
        assert lower - 1e-5 < found < upper + 0.05 * fingers * most


def is_balanced(grip: Grip) -> bool:
    return reference.missing_wrench(grip) == 0.0


@pytest.mark.parametrize(("fingers", "contacts", "most"), [(2, 5, 1.0), (3, 4, 1.0), (3, 5, 2.0)])
def test_what_is_missing_is_the_distance_to_the_nearest_wrench(rng, fingers, contacts, most, device):
    """Below zero the search has one valley and goes to its bottom."""
    grips = [drawn(rng, fingers, contacts, most, load=load) for load in (1.0, 2.0, 4.0) for _ in range(8)]
    missing = np.array([reference.missing_wrench(grip) for grip in grips])
    grips = [grip for grip, length in zip(grips, missing, strict=True) if length > 0.05]
    missing = missing[missing > 0.05]
    assert len(grips) >= 8
    excess = margin_of(*grips, device=device) + missing
    assert excess.min() > -1e-4
    assert np.median(excess) < 0.01
    assert np.all(excess < 0.05 + 0.05 * missing)


def test_neither_size_nor_place_nor_attitude_of_the_object_matters(rng, device):
    grips = [drawn(rng, 3, 5, 2.0) for _ in range(10)]
    at_home = margin_of(*grips, device=device, steps=0)
    np.testing.assert_allclose(margin_of(*grips, length=0.03, device=device, steps=0), at_home, atol=1e-5)
    np.testing.assert_allclose(margin_of(*grips, centre=(0.3, -0.2, 0.1), device=device, steps=0), at_home, atol=1e-5)
    turn = se3.rotation_exp(np.array([0.4, -1.0, 0.3]))
    d = np.concatenate([DIRECTIONS[:, :3] @ turn.T, DIRECTIONS[:, 3:] @ turn.T], axis=-1)
    turned = margin_of(*grips, turn=turn, directions=d, device=device)
    np.testing.assert_allclose(turned, margin_of(*grips, device=device), atol=1e-3)


# --- the reference ----------------------------------------------------------------------------------------------------


def test_three_definitions_of_the_margin_agree(rng):
    grip = drawn(rng, 3, 4, 1.0)
    lower, upper = reference.margin_bounds(grip, gap=0.005)
    assert 0.03 < lower <= reference.wrench_margin(grip, rng) < upper + 0.005
    loaded = replace(grip, load=3 * Z)
    assert reference.wrench_margin(loaded, rng) == pytest.approx(-reference.missing_wrench(loaded), abs=1e-4)


def test_wrenches_of_a_contact_are_on_the_border_of_its_friction_cone(rng):
    grip = drawn(rng, 2, 3, 1.0)
    wrenches = reference.contact_wrenches(grip, unit(rng.normal(size=(50, 6))))
    force, torque = wrenches[..., :3], wrenches[..., 3:] - np.cross(grip.arm, wrenches[..., :3])
    normal = np.sum(force * grip.push, axis=-1)
    np.testing.assert_allclose(normal, 1.0)
    slide = np.linalg.norm(force - normal[..., None] * grip.push, axis=-1) / grip.friction
    twist = np.sum(torque * grip.push, axis=-1) / grip.torsion
    np.testing.assert_allclose(torque, np.sum(torque * grip.push, axis=-1, keepdims=True) * grip.push, atol=1e-12)
    np.testing.assert_allclose(slide**2 + twist**2, 1.0)


def test_smooth_margin_is_the_ball_in_the_hull_of_all_corners():
    """Without friction the wrenches are a polytope: its corners, enumerated, against the search for its facets."""
    rng = np.random.default_rng(4)
    arms = unit(rng.normal(size=(6, 2, 3)))
    pushes = unit(-arms + 0.8 * rng.normal(size=arms.shape))
    screws = np.concatenate([pushes, np.cross(arms, pushes)], axis=-1)
    corners = np.concatenate([screws, 3 * screws], axis=1)
    choices = np.stack(np.meshgrid(*[np.arange(4)] * 6, indexing="ij"), axis=-1).reshape(-1, 6)
    nearest = -ConvexHull(sum(corners[f, choices[:, f]] for f in range(6))).equations[:, -1].max()
    assert nearest > 0.3
    assert reference.wrench_margin(held(arms, pushes, friction=0.0, most=3.0), rng) == pytest.approx(nearest, rel=0.01)


# --- a hand on a box --------------------------------------------------------------------------------------------------


SIZE = np.array([0.06, 0.04, 0.06])
DOWN = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def franka() -> Gripper:
    return load_gripper("franka_hand")


def box(size=SIZE) -> Scene:
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * size
    return Scene.from_mesh(convex_hull(corners + size[2] / 2 * Z))


@pytest.fixture(scope="module")
def target() -> Touchable:
    return touchable(box(), 4000, "cpu")


def above(franka: Gripper, *at, about_approach=0.0) -> Candidates:
    """The open hand from straight above, its fingertips' meeting points at these places."""
    R = DOWN @ se3.rotation_exp(about_approach * franka.approach)
    at = np.array(at, dtype=float).reshape(-1, 3)
    T = se3.from_parts(np.tile(R, (len(at), 1, 1)), at - R @ franka.tool_centre_point)
    return Candidates(np.zeros(len(at), dtype=int), T)


CENTRED = (0, 0, 0.03)


def test_contacts_are_on_the_faces_between_the_pads_and_push_along_the_closing_axis(franka, target):
    contacts = contacts_of(above(franka, CENTRED), target, franka, GripConfig(), "cpu")
    assert np.all(contacts.count[0, :2] >= 4)
    for f, side in enumerate(np.sign(contacts.point[0, :2, 0] @ franka.closing)):
        point = contacts.point[0, f, : contacts.count[0, f]]
        push = contacts.push[0, f, : contacts.count[0, f]]
        np.testing.assert_allclose(point @ franka.closing, side * SIZE[1] / 2, atol=1e-3)
        assert np.abs((point - franka.tool_centre_point) @ np.cross(franka.closing, franka.approach)).max() < 0.012
        np.testing.assert_allclose(push, np.tile(-side * franka.closing, (len(push), 1)), atol=1e-3)
    assert contacts.point[0, 0, 0] @ franka.closing * (contacts.point[0, 1, 0] @ franka.closing) < 0


@pytest.mark.xfail(strict=True, reason="points of the face beside the touched one count as contacts of the finger")
def test_contacts_near_an_edge_push_along_the_way_of_the_finger(franka, target):
    contacts = contacts_of(above(franka, (0, 0, 0.058)), target, franka, GripConfig(), "cpu")
    for f in range(2):
        push = contacts.push[0, f, : contacts.count[0, f]]
        assert len(push) > 1
        assert np.abs(push @ franka.closing).min() > 0.5


@pytest.mark.parametrize("width", [0.02, 0.04, 0.07])
def test_fingers_close_until_they_meet_the_box(franka, width):
    scene = box(np.array([0.06, width, 0.06]))
    contacts = contacts_of(above(franka, CENTRED), touchable(scene, 4000, "cpu"), franka, GripConfig(), "cpu")
    np.testing.assert_allclose(contacts.fraction, 1 - width / franka.opening, atol=0.02)


def test_fingers_around_nothing_touch_nothing(franka, target):
    contacts = contacts_of(above(franka, (0, 0, 0.2)), target, franka, GripConfig(), "cpu")
    assert np.all(contacts.count == 0)
    assert np.all(contacts.fraction > 1)


def test_a_box_near_the_palm_touches_it(franka, target):
    contacts = contacts_of(above(franka, (0, 0, 0.018)), target, franka, GripConfig(), "cpu")
    assert contacts.count[0, 2] >= 4
    point, push = (a[0, 2, : contacts.count[0, 2]] for a in (contacts.point, contacts.push))
    np.testing.assert_allclose(push, np.tile(franka.approach, (len(push), 1)), atol=1e-3)
    np.testing.assert_allclose(point @ franka.approach, 0.1034 - (SIZE[2] - 0.018), atol=1e-3)


@pytest.mark.xfail(strict=True, reason="points beside the open fingers count as near to the palm")
def test_a_box_far_from_the_palm_does_not_touch_it(franka, target):
    """The palm is 66 mm from the hand's origin, the box 33 mm farther."""
    contacts = contacts_of(above(franka, (0, 0, 0.055)), target, franka, GripConfig(), "cpu")
    assert np.all(contacts.count[0, :2] > 0)
    assert contacts.count[0, 2] == 0


@pytest.mark.xfail(strict=True, reason="given forces resist no push along the pads' line: all pinches have margin zero")
def test_pinch_off_the_centre_of_mass_has_a_smaller_margin(franka, target):
    margin = margins(above(franka, CENTRED, (0, 0, 0.05), (0.015, 0, 0.03)), target, franka, NO_PALM, "cpu")
    assert margin[0] > margin[1] + 0.01
    assert margin[0] > margin[2] + 0.01


def test_heavy_box_held_off_its_centre_misses_more(franka, target):
    heavy = replace(NO_PALM, mass=3.0)
    margin = margins(above(franka, CENTRED, (0.01, 0, 0.03), (0.022, 0, 0.03)), target, franka, heavy, "cpu")
    capacity = 2 * heavy.friction - 3.0 * 9.81 / franka.finger_force
    assert margin[0] == pytest.approx(capacity, abs=0.02)
    assert margin[0] > margin[1] > margin[2] + 0.01


@pytest.mark.parametrize("config", [GripConfig(), NO_PALM])
def test_pinch_turned_about_the_approach_has_a_smaller_margin(franka, target, config):
    straight = margins(above(franka, CENTRED), target, franka, config, "cpu")
    turned = margins(above(franka, CENTRED, about_approach=np.radians(20)), target, franka, config, "cpu")
    assert turned < straight - 0.05


def test_moving_or_turning_the_world_about_the_vertical_changes_nothing(franka, target):
    hands = above(franka, CENTRED, (0.01, 0, 0.05), (0, 0.01, 0.04), (0.02, -0.005, 0.045))
    world = se3.from_parts(se3.rotation_exp(0.9 * Z), np.array([0.7, -0.4, 0.2]))
    R = world[:3, :3]
    moved = replace(
        target,
        points=wp.array(target.points.numpy() @ R.T, dtype=wp.vec3, device="cpu"),
        normals=wp.array(target.normals.numpy() @ R.T, dtype=wp.vec3, device="cpu"),
        centre_of_mass=se3.apply(world, target.centre_of_mass[None])[0],
    )
    config = replace(GripConfig(), mass=1.0)
    before = margins(hands, target, franka, config, "cpu")
    after = margins(Candidates(hands.preshape, world @ hands.T_world_gripper), moved, franka, config, "cpu")
    np.testing.assert_allclose(after, before, atol=1e-3)


def test_order_of_the_points_does_not_matter(franka, target, rng):
    hands = above(franka, CENTRED, (0.01, 0, 0.05), (0, 0.01, 0.04))
    order = rng.permutation(len(target.points))
    shuffled = replace(
        target,
        points=wp.array(target.points.numpy()[order], dtype=wp.vec3, device="cpu"),
        normals=wp.array(target.normals.numpy()[order], dtype=wp.vec3, device="cpu"),
    )
    first, second = (margins(hands, cloud, franka, GripConfig(), "cpu") for cloud in (target, shuffled))
    np.testing.assert_allclose(second, first, atol=2e-3)  # of points that are equally far out, the first counts


def test_errors_of_the_pose_do_not_better_a_good_pinch_and_come_from_the_generator(franka, target):
    hands = above(franka, CENTRED, (0, 0, 0.035))
    robust, again, other = (
        robust_margins(hands, target, franka, GripConfig(), np.random.default_rng(seed), "cpu") for seed in (0, 0, 1)
    )
    nominal = margins(hands, target, franka, GripConfig(), "cpu")
    assert np.all(robust < nominal + 0.02)
    np.testing.assert_array_equal(robust, again)
    assert not np.array_equal(robust, other)


def test_no_error_of_the_pose_leaves_the_margin_as_it_is(franka, target, rng):
    hands = above(franka, CENTRED)
    exact = replace(GripConfig(), position_error=0.0, angle_error=0.0)
    nominal = margins(hands, target, franka, exact, "cpu")
    np.testing.assert_allclose(robust_margins(hands, target, franka, exact, rng, "cpu"), nominal, atol=1e-4)


def test_fingers_push_the_box_to_their_middle(franka, target):
    """A hand 8 mm beside the box: one finger comes first and carries it along until the other touches."""
    hands = above(franka, CENTRED, (0, 0.008, 0.03))
    pushed = slide(hands, target, franka, GripConfig(), "cpu")
    assert np.linalg.norm(pushed[0]) < 0.003
    moved = hands.T_world_gripper[1, :3, :3] @ pushed[1]
    np.testing.assert_allclose(moved, [0, 0.008, 0], atol=0.003)


def test_no_candidates_have_no_contacts_and_no_margins(franka, target, rng):
    nothing = Candidates(np.zeros(0, dtype=int), np.zeros((0, 4, 4)))
    assert contacts_of(nothing, target, franka, GripConfig(), "cpu").fraction.shape == (0, 2)
    assert margins(nothing, target, franka, GripConfig(), "cpu").shape == (0,)
    assert robust_margins(nothing, target, franka, GripConfig(), rng, "cpu").shape == (0,)
    assert slide(nothing, target, franka, GripConfig(), "cpu").shape == (0, 3)


def test_fingers_with_drives_of_their_own_press_as_hard_as_all_others(franka):
    assert most_force(franka) == 1.0
    assert most_force(load_gripper("barrett_bh282")) == 2.0
