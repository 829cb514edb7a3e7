"""The wrench that contacts resist: closed forms, certified references in NumPy, and what must not change it."""

# pyright: reportInvalidTypeForm=false
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial import ConvexHull

from graspmatch.geometry import se3
from graspmatch.kernels import reference, warp_wrench
from graspmatch.kernels.launch import launch
from graspmatch.kernels.reference import Grip
from graspmatch.kernels.warp_queue import Queue, take
from graspmatch.kernels.warp_wrench import REACTION, Contacts, Pressure, lay_out, least_wrench, wrench_margin
from graspmatch.planner.hold import DESCENTS, DIRECTIONS, SEARCHES, room_for_contacts

X, Y, Z = np.eye(3)
CORNERS = np.array([[0, 0, 0], [0, 1, 1], [0, 1, -1], [0, -1, 1], [0, -1, -1]])
ALONE, SHARED = [0, 1], [0, 0]
"""For each finger the first of its drive."""


@wp.kernel
def shortest(
    queue: Queue,
    contacts: Contacts,
    pressure: Pressure,
    tolerance: float,
    steps: int,
    load_in: wp.array(dtype=wp.vec3),
    wrench_out: wp.array(dtype=wp.spatial_vector),
):
    """What `least_wrench` finds for each grasp."""
    i = take(queue, wp.tid())
    if i < 0:
        return
    load = wp.spatial_vector(load_in[i], wp.vec3(0.0, 0.0, 0.0))
    lay_out(contacts, pressure, i)
    wrench_out[i] = least_wrench(contacts, pressure, i, load, load, tolerance, steps)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


# --- contacts --------------------------------------------------------------------------------------------------------


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def held(
    arms, pushes, *, drive=None, friction=0.5, torsion=0.0, most=1.0, load=(0.0, 0.0, 0.0), palm=None, table=None
) -> Grip:
    """A grasp whose fingers have the contacts of `arms`, one array each; then those of palm and table, if any."""
    fingers = len(arms)
    drive = np.arange(fingers) if drive is None else np.array(drive)
    size = np.bincount(drive, minlength=fingers)
    nothing = np.zeros((0, 3))
    others = [part or (nothing, nothing) for part in (palm, table)]
    arms, pushes = ([*given, *(other[k] for other in others)] for k, given in enumerate((arms, pushes)))
    return Grip(
        toucher=np.repeat(np.arange(len(arms)), [len(arm) for arm in arms]),
        arm=np.concatenate(arms).astype(float),
        push=np.concatenate(pushes).astype(float),
        presser=np.r_[drive, fingers, fingers + 1],
        least=np.r_[size, 0, 0].astype(float),
        most=np.r_[np.where(size == 1, most, size), REACTION, REACTION].astype(float),
        friction=friction,
        torsion=torsion,
        load=np.asarray(load, dtype=float),
    )


def pinch(patch=0.0, drive=SHARED, **options) -> Grip:
    """Two fingers that press along x on opposite sides, 1 from the centre, with points or square patches."""
    corners = patch * CORNERS if patch else np.zeros((1, 3))
    pushes = [np.tile(-X, (len(corners), 1)), np.tile(X, (len(corners), 1))]
    return held([X + corners, -X + corners], pushes, drive=drive, **options)


def cage(**options) -> Grip:
    """Three fingers that press inwards in the plane z = 0, every third of a turn."""
    angle = 2 * np.pi * np.arange(3) / 3
    arms = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)[:, None]
    return held(arms, -arms, **options)


def one_sided(**options) -> Grip:
    """Two fingers beside each other that push along x."""
    arms = [np.array([[-1.0, 0.5, 0.0]]), np.array([[-1.0, -0.5, 0.0]])]
    return held(arms, [X[None], X[None]], torsion=0.1, **options)


def drawn(rng, fingers, contacts, most, load=0.05, friction=0.3, torsion=0.1, **options) -> Grip:
    """Fingers around an uneven ball, each with a patch of contacts."""
    angle = 2 * np.pi * np.arange(fingers) / fingers + 0.2 * rng.normal(size=fingers)
    around = np.stack([np.cos(angle), np.sin(angle), 0.2 * rng.normal(size=fingers)], axis=-1)
    arms = unit(around[:, None] + 0.25 * rng.normal(size=(fingers, contacts, 3)))
    pushes = unit(-arms + 0.1 * rng.normal(size=arms.shape))
    options |= {"most": most, "friction": friction, "torsion": torsion}
    return held(arms, pushes, load=load * unit(rng.normal(size=3)), **options)


def on_device(grips, device="cpu", *, length=1.0, centre=(0.0, 0.0, 0.0), turn=None):
    """Contacts, pressure and loads of grasps as kernels take them; of objects `length` times the size, elsewhere and
    turned, on request."""
    turn = np.eye(3) if turn is None else turn
    fingers = len(grips[0].presser) - 2
    shape = len(grips), fingers + 2, warp_wrench.CORNERS
    count, point, push = np.zeros(shape[:2], dtype=int), np.zeros((*shape, 3)), np.zeros((*shape, 3))
    for i, grip in enumerate(grips):
        for g in range(fingers + 2):
            own = grip.toucher == g
            count[i, g] = own.sum()
            point[i, g, : own.sum()] = length * grip.arm[own] @ turn.T + centre
            push[i, g, : own.sum()] = grip.push[own] @ turn.T
    contacts = room_for_contacts(len(grips), fingers, device)
    contacts.count = wp.array(count, dtype=wp.int32, device=device)
    contacts.point, contacts.push = (wp.array(a, dtype=wp.vec3, device=device) for a in (point, push))
    contacts.centre = wp.array(np.tile(centre, (len(grips), 1)), dtype=wp.vec3, device=device)
    drive = grips[0].presser[:fingers]
    pressure = Pressure()
    pressure.drive = wp.array(drive, dtype=wp.int32, device=device)
    pressure.share = wp.array(np.bincount(drive)[drive], dtype=wp.float32, device=device)
    pressure.most = float(grips[0].most[drive].max())
    pressure.friction = wp.array([grip.friction for grip in grips], dtype=wp.float32, device=device)
    pressure.torsion, pressure.length = length * grips[0].torsion, length
    load = wp.array(np.array([grip.load for grip in grips]) @ turn.T, dtype=wp.vec3, device=device)
    return contacts, pressure, load


def margin_of(*grips: Grip, device="cpu", directions=DIRECTIONS, steps=DESCENTS, **where) -> np.ndarray:
    """The kernel's margins."""
    contacts, pressure, load = on_device(grips, device, **where)
    d = wp.array(directions, dtype=wp.spatial_vector, device=device)
    margin = wp.empty(len(grips), dtype=wp.float32, device=device)
    launch(wrench_margin, len(grips), [contacts, pressure, d, steps, load], [margin], device)
    return margin.numpy().astype(float)


def shortest_of(*grips: Grip, device="cpu", tolerance=0.03, steps=SEARCHES) -> np.ndarray:
    """The kernel's shortest wrenches."""
    contacts, pressure, load = on_device(grips, device)
    wrench = wp.empty(len(grips), dtype=wp.spatial_vector, device=device)
    launch(shortest, len(grips), [contacts, pressure, tolerance, steps, load], [wrench], device)
    return wrench.numpy().astype(float)


def forces(vectors):
    """Directions in the space of wrenches that are pure forces."""
    return np.concatenate([vectors, np.zeros_like(vectors)], axis=-1)


# --- closed forms ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("drive", [ALONE, SHARED])
def test_points_without_torsion_do_not_resist_a_turn_about_their_line(drive, device):
    assert margin_of(pinch(drive=drive), device=device)[0] == pytest.approx(0.0, abs=1e-6)


def test_fingers_of_one_drive_resist_a_push_along_their_line_up_to_twice_a_fingers_force(device):
    """As the object pushes back on one of them, it takes over what the other gives up."""
    both_ways = forces(np.array([X, -X]))
    for friction in (0.0, 0.5):
        grip = pinch(patch=0.1, friction=friction)
        assert margin_of(grip, directions=both_ways, steps=0, device=device)[0] == pytest.approx(2.0, abs=1e-6)
        pushed = [replace(grip, load=push * X) for push in (0.5, 1.9, 2.5)]
        assert [reference.missing_wrench(g) for g in pushed] == pytest.approx([0.0, 0.0, 0.5], abs=1e-5)
        found = shortest_of(*pushed, device=device)
        np.testing.assert_allclose(found, [[0] * 6, [0] * 6, [0.5, 0, 0, 0, 0, 0]], atol=1e-3)


def test_given_forces_of_two_fingers_do_not_resist_a_push_along_their_line(device):
    """What presses with a given force gives way to any more."""
    assert margin_of(pinch(patch=0.1, torsion=0.1, drive=ALONE), device=device)[0] == pytest.approx(0.0, abs=1e-6)


def test_one_finger_of_a_drive_has_the_force_of_all(device):
    arms = [np.array([-X]), np.zeros((0, 3))]
    for drive, force in ((ALONE, 1.0), (SHARED, 2.0)):
        grip = held(arms, [np.array([X]), np.zeros((0, 3))], drive=drive, friction=0.0)
        np.testing.assert_allclose(shortest_of(grip, device=device)[0, :3], force * X, atol=1e-5)


@pytest.mark.parametrize("torsion", [0.02, 0.1])
def test_torsion_of_two_points_resists_four_times_itself(torsion, device):
    """Both press twice as hard; a push along the line on top lowers it by the cosine of an angle of tangent torsion."""
    grip = pinch(torsion=torsion, drive=ALONE, most=2.0)
    expected = 4 * torsion / np.sqrt(1 + torsion**2)
    assert reference.wrench_margin(grip, np.random.default_rng(0)) == pytest.approx(expected, rel=0.01)
    assert expected - 1e-6 < margin_of(grip, device=device)[0] < 1.02 * expected


@pytest.mark.parametrize("torsion", [0.02, 0.1])
def test_torsion_of_a_shared_pinch_resists_twice_itself(torsion, device):
    """As above, but the two fingers share a force of two instead of pressing twice as hard each."""
    grip = pinch(torsion=torsion)
    expected = 2 * torsion / np.sqrt(1 + torsion**2)
    assert reference.wrench_margin(grip, np.random.default_rng(0)) == pytest.approx(2 * torsion, rel=0.01)
    assert expected - 1e-6 < margin_of(grip, device=device)[0] < 1.03 * 2 * torsion


@pytest.mark.parametrize("size", [0.02, 0.1])
def test_patches_resist_the_turn_that_points_do_not(size, device):
    """Friction at the corners, as torsion above: its lever is the corners' distance from the line."""
    lever = 0.5 * np.sqrt(2) * size
    expected = 4 * lever / np.sqrt(1 + lever**2)
    grip = pinch(patch=size, drive=ALONE, most=2.0)
    assert expected - 1e-6 < margin_of(grip, device=device)[0] < 1.02 * expected


def test_smooth_cage_resists_pushes_in_its_plane_and_none_out_of_it(device):
    """Fingers of force 1 to 2 at angles of 120 degrees: a hexagon of forces, its inradius the sine of 60 degrees."""
    angle = np.radians(np.arange(0, 360, 5))
    in_plane = forces(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1))
    smooth = cage(friction=0.0, most=2.0)
    found = margin_of(smooth, directions=in_plane, steps=0, device=device)[0]
    assert found == pytest.approx(np.sqrt(3) / 2, abs=1e-5)
    assert margin_of(smooth, device=device)[0] == pytest.approx(0.0, abs=1e-6)


def test_smooth_cage_of_one_drive_resists_by_the_triangle_of_its_forces(device):
    """Three times the triangle of the three pushes, whose inradius is a half."""
    angle = np.radians(np.arange(0, 360, 5))
    in_plane = forces(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1))
    grip = cage(friction=0.0, drive=[0, 0, 0])
    assert margin_of(grip, directions=in_plane, steps=0, device=device)[0] == pytest.approx(1.5, abs=1e-5)


@pytest.mark.parametrize("drive", [[0, 1, 2], [0, 0, 0]])
def test_rough_cage_resists_every_wrench(drive, device):
    grip = cage(friction=0.5, torsion=0.1, most=2.0, drive=drive)
    least = reference.wrench_margin(grip, np.random.default_rng(0))
    assert least > 0.9
    assert least - 1e-3 < margin_of(grip, device=device)[0] < 1.2 * least


def test_fingers_on_one_side_miss_their_whole_force(device):
    for drive in (ALONE, SHARED):
        grip = one_sided(drive=drive)
        assert margin_of(grip, device=device)[0] == pytest.approx(-2.0, abs=1e-4)
        assert reference.missing_wrench(grip) == pytest.approx(2.0, abs=1e-5)


@pytest.mark.parametrize("drive", [ALONE, SHARED])
def test_a_palm_against_two_fingers_on_one_side_makes_up_for_what_they_push(drive, device):
    grip = one_sided(drive=drive, most=3.0, palm=(X + 0.5 * CORNERS, np.tile(-X, (5, 1))))
    least = reference.wrench_margin(grip, np.random.default_rng(0))
    assert least > 0.5
    assert least - 1e-3 < margin_of(grip, device=device)[0] < 1.4 * least  # another valley of the search
    assert margin_of(one_sided(drive=drive, most=3.0), device=device)[0] == pytest.approx(-2.0, abs=1e-4)


def test_a_table_carries_up_to_its_reaction(device):
    table = (-Z + CORNERS[:, [1, 2, 0]], np.tile(Z, (5, 1)))
    nothing = [np.zeros((0, 3))] * 2
    loads = [0.5, REACTION - 1, REACTION + 1]
    grips = [held(nothing, nothing, load=-weight * Z, table=table) for weight in loads]
    assert [reference.missing_wrench(grip) for grip in grips] == pytest.approx([0.0, 0.0, 1.0], abs=1e-4)
    found = shortest_of(*grips, device=device)
    np.testing.assert_allclose(found, [[0] * 6, [0] * 6, [0, 0, -1, 0, 0, 0]], atol=1e-3)


@pytest.mark.parametrize("weight", [0.5, 0.9])
@pytest.mark.parametrize("drive", [ALONE, SHARED])
def test_friction_carries_a_weight_that_is_less_than_its_capacity(weight, drive, device):
    grip = pinch(patch=0.1, load=-weight * Z, drive=drive)
    upwards = forces(np.array([Z, Z]))
    assert margin_of(grip, directions=upwards, steps=0, device=device)[0] == pytest.approx(1.0 - weight, abs=1e-6)
    assert reference.missing_wrench(grip) == 0.0
    assert np.all(shortest_of(grip, device=device) == 0.0)


@pytest.mark.parametrize("weight", [1.1, 3.0])
@pytest.mark.parametrize("drive", [ALONE, SHARED])
def test_weight_beyond_the_friction_capacity_is_what_is_missing(weight, drive, device):
    """Two fingers of force 1 and friction 0.5 carry 1."""
    grip = pinch(patch=0.1, load=-weight * Z, drive=drive)
    assert margin_of(grip, device=device)[0] == pytest.approx(1.0 - weight, abs=1e-4)
    assert reference.missing_wrench(grip) == pytest.approx(weight - 1.0, abs=1e-5)
    length = np.linalg.norm(shortest_of(grip, device=device)[0])
    assert weight - 1.0 - 1e-4 < length < (weight - 1.0) / (1 - warp_wrench.GAP) + 1e-4


def test_without_contacts_the_weight_is_missing(device):
    nothing = held([np.zeros((0, 3))] * 2, [np.zeros((0, 3))] * 2, load=-0.3 * Z)
    assert margin_of(nothing, device=device)[0] == pytest.approx(-0.3, abs=1e-4)
    np.testing.assert_allclose(shortest_of(nothing, device=device)[0], [0, 0, -0.3, 0, 0, 0], atol=1e-6)


# --- against the reference -------------------------------------------------------------------------------------------


SHAPES = [((0, 1), 5, 1.0), ((0, 0), 5, 1.0), ((0, 1, 2), 4, 1.0), ((0, 1, 2), 5, 2.0), ((0, 1, 2, 3), 3, 3.0)]
"""Drives, contacts of each finger, most force."""
IDS = [f"{drive} x {contacts}" for drive, contacts, _ in SHAPES]


def some(rng, shape, count, load=0.05, **options):
    drive, contacts, most = shape
    return [drawn(rng, len(drive), contacts, most, load, drive=drive, **options) for _ in range(count)]


def is_balanced(grip: Grip) -> bool:
    return reference.missing_wrench(grip) == 0.0


@pytest.mark.parametrize("knob", ["friction", "torsion"])
def test_more_friction_never_lowers_the_support(rng, knob):
    """Along given directions; the search from them could end elsewhere."""
    d = unit(rng.normal(size=(200, 6)))
    for grip in (grip for shape in SHAPES for grip in some(rng, shape, 3)):
        values = [margin_of(replace(grip, **{knob: v}), directions=d, steps=0)[0] for v in (0.0, 0.1, 0.3, 0.8)]
        assert np.all(np.diff(values) >= -1e-6)
        assert values[-1] > values[0]


@pytest.mark.parametrize("shape", SHAPES, ids=IDS)
def test_margin_is_at_or_a_little_above_the_least_of_many_directions(rng, shape, device):
    """A search never finds less than the least; how much more it finds is bounded here, in shares of all force."""
    grips = [grip for grip in some(rng, shape, 20) if is_balanced(grip)][:10]
    assert len(grips) >= 6
    least = np.array([reference.wrench_margin(grip, rng, directions=2000, steps=200) for grip in grips])
    excess = (margin_of(*grips, device=device) - least) / (len(shape[0]) * shape[2])
    assert excess.min() > -0.01  # the reference is a search too
    assert np.median(excess) < 0.015
    assert excess.max() < 0.06


@pytest.mark.parametrize("shape", SHAPES[:3], ids=IDS[:3])
def test_margin_is_above_its_certified_lower_bound(rng, shape, device):
    grips = [grip for grip in some(rng, shape, 12) if is_balanced(grip)][:4]
    assert len(grips) == 4
    for grip, found in zip(grips, margin_of(*grips, device=device), strict=True):
        lower, upper = reference.margin_bounds(grip, gap=0.02)
        assert lower - 1e-5 < found < upper + 0.05 * len(shape[0])


@pytest.mark.parametrize("shape", SHAPES[:4], ids=IDS[:4])
def test_what_is_missing_is_the_distance_to_the_nearest_wrench(rng, shape, device):
    """Below zero the search has one valley and goes to its bottom."""
    grips = [grip for load in (1.0, 2.0, 4.0) for grip in some(rng, shape, 8, load=load)]
    missing = np.array([reference.missing_wrench(grip) for grip in grips])
    grips = [grip for grip, length in zip(grips, missing, strict=True) if length > 0.05]
    missing = missing[missing > 0.05]
    assert len(grips) >= 8
    excess = margin_of(*grips, device=device) + missing
    assert excess.min() > -1e-4
    assert np.median(excess) < 0.015
    assert np.all(excess < 0.12)


@pytest.mark.parametrize("shape", SHAPES[:4], ids=IDS[:4])
def test_the_shortest_wrench_is_about_as_short_as_can_be(rng, shape, device):
    """Never shorter than what is missing; zero where nothing is, and only there but for what is hard to tell."""
    grips = [grip for load in (0.08, 1.0, 2.0, 4.0) for grip in some(rng, shape, 15, load=load)]
    missing = np.array([reference.missing_wrench(grip) for grip in grips])
    length = np.linalg.norm(shortest_of(*grips, device=device), axis=-1)
    moves = length > 0
    assert not moves[missing == 0].any()
    assert moves[missing > 0.25].all()
    assert np.mean(moves[missing > 0.04]) > 0.8
    assert np.all(length[moves] > missing[moves] - 1e-4)
    assert np.median(length[moves] / missing[moves]) < 1 / (1 - warp_wrench.GAP)


def test_neither_size_nor_place_nor_attitude_of_the_object_matters(rng, device):
    grips = [drawn(rng, 3, 5, 2.0) for _ in range(10)]
    at_home = margin_of(*grips, device=device, steps=0)
    np.testing.assert_allclose(margin_of(*grips, length=0.03, device=device, steps=0), at_home, atol=1e-5)
    np.testing.assert_allclose(margin_of(*grips, centre=(0.3, -0.2, 0.1), device=device, steps=0), at_home, atol=1e-5)
    turn = se3.rotation_exp(np.array([0.4, -1.0, 0.3]))
    d = np.concatenate([DIRECTIONS[:, :3] @ turn.T, DIRECTIONS[:, 3:] @ turn.T], axis=-1)
    turned = margin_of(*grips, turn=turn, directions=d, device=device)
    np.testing.assert_allclose(turned, margin_of(*grips, device=device), atol=1e-3)


# --- the reference ---------------------------------------------------------------------------------------------------


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


def test_smooth_margin_of_one_drive_is_the_ball_in_the_hull_of_its_wrenches():
    rng = np.random.default_rng(5)
    arms = unit(rng.normal(size=(16, 2, 3)))
    pushes = unit(-arms + 0.8 * rng.normal(size=arms.shape))
    screws = np.concatenate([pushes, np.cross(arms, pushes)], axis=-1).reshape(-1, 6)
    nearest = -16 * ConvexHull(screws).equations[:, -1].max()
    assert nearest > 0.3
    grip = held(arms, pushes, friction=0.0, drive=[0] * 16)
    assert reference.wrench_margin(grip, rng) == pytest.approx(nearest, rel=0.01)
