"""What baking makes of a hand: fields against closed forms, samples on the inside, a cache that is never trusted."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspmatch.config import BakingConfig
from graspmatch.geometry import grid as grids
from graspmatch.geometry.mesh import TriangleMesh
from graspmatch.gripper import cache
from graspmatch.gripper.bake import link_field
from graspmatch.gripper.load import load_gripper
from graspmatch.types import GraspmatchError, Gripper
from toy_hand import CARD, COARSE, write_toy


@pytest.fixture
def toy(tmp_path, monkeypatch) -> Gripper:
    monkeypatch.setenv("GRASPMATCH_CACHE", str(tmp_path / "cache"))
    return load_gripper(write_toy(tmp_path), baking=COARSE)


def box_distance(points, centre, half):
    q = np.abs(points - centre) - half
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


def hand_distance(points, closing=0.0):
    """The toy hand's signed distance in closed form."""
    boxes = [
        ((0, 0, -0.01), (0.02, 0.05, 0.01)),
        ((0, 0.035 - 0.03 * closing, 0.03), (0.01, 0.005, 0.03)),
        ((0, -0.035 + 0.03 * closing, 0.03), (0.01, 0.005, 0.03)),
    ]
    return np.min([box_distance(points, np.array(c), np.array(h)) for c, h in boxes], axis=0)


def test_distance_field_of_a_sphere_matches_the_closed_form():
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    field = link_field(TriangleMesh(np.array(sphere.vertices), np.array(sphere.faces)), BakingConfig())
    points = np.random.default_rng(0).uniform(-0.045, 0.045, size=(2000, 3))
    expected = np.linalg.norm(points, axis=-1) - 0.03
    away = np.abs(np.linalg.norm(points, axis=-1)) > 0.004  # the field has its kink in the middle
    np.testing.assert_allclose(grids.interpolate(field, points)[away], expected[away], atol=3e-4)


def test_distance_field_of_an_open_mesh_has_the_right_sign():
    box = trimesh.creation.box(extents=[0.06, 0.06, 0.06])
    lidless = TriangleMesh(np.array(box.vertices), np.array(box.faces)[np.array(box.face_normals)[:, 2] < 0.5])
    field = link_field(lidless, BakingConfig())
    deep, outside = [[0.0, 0.0, -0.015], [0.01, 0.01, -0.01]], [[0.0, 0.0, 0.045], [0.045, 0.0, 0.0]]
    assert np.all(grids.interpolate(field, np.array(deep)) < 0)
    assert np.all(grids.interpolate(field, np.array(outside)) > 0)


def test_link_that_is_inside_out_is_solid_all_the_same(tmp_path, monkeypatch):
    monkeypatch.setenv("GRASPMATCH_CACHE", str(tmp_path / "cache"))
    box = trimesh.creation.box(extents=[0.04, 0.1, 0.02])
    box.apply_translation([0, 0, -0.01])
    box.invert()
    box.export(tmp_path / "palm.stl")
    card = write_toy(tmp_path)
    asset = '<asset><mesh name="palm" file="palm.stl"/></asset><worldbody>'
    description = (tmp_path / "toy.xml").read_text().replace("<worldbody>", asset)
    old = '<geom type="box" size="0.02 0.05 0.01" pos="0 0 -0.01"/>'
    assert old in description
    (tmp_path / "toy.xml").write_text(description.replace(old, '<geom type="mesh" mesh="palm"/>'))
    preshape = load_gripper(card, baking=COARSE).preshapes[0]
    assert grids.interpolate(preshape.hand, np.array([[0.0, 0.0, -0.01]]))[0] < -0.005


def test_changed_mesh_is_seen_in_a_running_process(tmp_path, monkeypatch):
    monkeypatch.setenv("GRASPMATCH_CACHE", str(tmp_path / "cache"))
    card = write_toy(tmp_path)
    asset = '<asset><mesh name="palm" file="palm.stl"/></asset><worldbody>'
    description = (tmp_path / "toy.xml").read_text().replace("<worldbody>", asset)
    old = '<geom type="box" size="0.02 0.05 0.01" pos="0 0 -0.01"/>'
    (tmp_path / "toy.xml").write_text(description.replace(old, '<geom type="mesh" mesh="palm"/>'))
    thick = []
    for height in (0.02, 0.04):
        box = trimesh.creation.box(extents=[0.04, 0.1, height])
        box.apply_translation([0, 0, -height / 2])
        box.export(tmp_path / "palm.stl")
        preshape = load_gripper(card, baking=COARSE).preshapes[0]
        thick.append(-preshape.outline[:, 2].min())
    np.testing.assert_allclose(thick, [0.02, 0.04], atol=1e-6)


def test_hand_field_matches_the_closed_form(toy):
    points = np.random.default_rng(1).uniform([-0.03, -0.06, -0.03], [0.03, 0.06, 0.07], size=(3000, 3))
    for preshape in toy.preshapes:
        error = grids.interpolate(preshape.hand, points) - hand_distance(points, preshape.joints[0] / 0.03)
        assert np.abs(error).mean() < 5e-4
        assert np.abs(error).max() < COARSE.grid_spacing


def test_corridor_is_the_hand_swept_back_along_its_approach(toy):
    preshape = toy.preshapes[0]
    points = np.random.default_rng(2).uniform([-0.03, -0.06, -0.12], [0.03, 0.06, 0.07], size=(2000, 3))
    way = np.linspace(0, COARSE.approach_distance, 151)
    swept = np.min([hand_distance(points + s * toy.approach) for s in way], axis=0)
    found = grids.interpolate(preshape.corridor, points)
    assert np.abs(found - swept).max() < COARSE.grid_spacing
    behind = np.array([[0.0, 0.03, -0.1]])
    assert grids.interpolate(preshape.corridor, behind)[0] < 0 < grids.interpolate(preshape.hand, behind)[0]


def test_arrival_is_when_the_finger_covers_the_point(toy):
    """The left pad's face is at y = 0.03 - 0.03 u: it covers y at u = 1 - y / 0.03."""
    preshape = toy.preshapes[0]
    u = np.array([[0.0, y, z] for y in (0.006, 0.015, 0.024) for z in (0.02, 0.04)])
    node = np.rint((u - preshape.hand.origin) / preshape.hand.spacing).astype(int)
    on_node = preshape.hand.origin + node * preshape.hand.spacing
    found = preshape.arrival[0][tuple(node.T)]
    np.testing.assert_allclose(found, 1 - on_node[:, 1] / 0.03, atol=0.03)
    assert np.all(preshape.arrival[1][tuple(node.T)] > found)


def test_arrival_is_never_where_no_finger_comes(toy):
    preshape = toy.preshapes[0]
    far = np.rint((np.array([0.0, 0.0, 0.072]) - preshape.hand.origin) / preshape.hand.spacing).astype(int)
    assert preshape.arrival[0][tuple(far)] > 1


@pytest.mark.parametrize("method", ["mesh", "camera"])
def test_samples_lie_on_the_inner_surface_only(tmp_path, monkeypatch, method):
    monkeypatch.setenv("GRASPMATCH_CACHE", str(tmp_path / "cache"))
    gripper = load_gripper(write_toy(tmp_path, CARD.replace('"mesh"', f'"{method}"')), baking=COARSE)
    samples = gripper.preshapes[0].samples
    assert samples.normals is not None
    np.testing.assert_allclose(hand_distance(samples.points), 0.0, atol=1e-5)
    on_palm = np.abs(samples.points[:, 2]) < 1e-5
    on_pads = np.abs(np.abs(samples.points[:, 1]) - 0.03) < 1e-5
    # Between pads and palm nothing else can be seen, and every surface looks inwards.
    assert np.all(on_palm | on_pads)
    np.testing.assert_allclose(samples.normals[on_palm], np.tile([0, 0, 1], (on_palm.sum(), 1)), atol=1e-6)
    inwards = -np.sign(samples.points[on_pads & ~on_palm, 1])
    np.testing.assert_allclose(samples.normals[on_pads & ~on_palm, 1], inwards, atol=1e-6)
    # 2 pads of 20 x 60 mm and a palm of 40 x 60 to 100 mm, at 5 mm: about 2 x 48 and 96 to 160, and corners.
    assert 180 < len(samples.points) < 300


def test_tool_centre_point_is_the_weighted_centre_of_the_samples(toy):
    for preshape in toy.preshapes:
        centre = np.average(preshape.samples.points, axis=0, weights=preshape.weights)
        np.testing.assert_allclose(preshape.tool_centre_point, centre, atol=1e-12)
        assert preshape.hand.origin.shape == (3,)


def test_second_load_comes_from_the_cache_and_is_the_same(toy, tmp_path, monkeypatch):
    monkeypatch.setattr("graspmatch.gripper.load.bake_gripper", None)  # would fail if it were called
    again = load_gripper(tmp_path / "card.toml", baking=COARSE)
    for a, b in zip(toy.preshapes, again.preshapes, strict=True):
        np.testing.assert_array_equal(a.hand.values, b.hand.values)
        np.testing.assert_array_equal(a.arrival, b.arrival)
        np.testing.assert_array_equal(a.samples.points, b.samples.points)
        assert a.name == b.name
    assert (again.fingers, again.joint_names) == (toy.fingers, toy.joint_names)


@pytest.mark.parametrize("damage", ["truncated", "flipped", "directory", "garbage", "empty"])
def test_damaged_cache_is_baked_anew(toy, tmp_path, damage):
    (file,) = (tmp_path / "cache").glob("*.npz")
    content = bytearray(file.read_bytes())
    if damage == "truncated":
        content = content[: len(content) // 2]
    elif damage == "flipped":
        # In the middle of a large array, where the zip's own check is not enough for a cautious reader.
        content[len(content) // 2] ^= 0xFF
    elif damage == "directory":
        at = content.rindex(b"PK\x01\x02")
        content[at + 4 : at + 12] = b"\xff" * 8
    elif damage == "garbage":
        content = bytearray(b"PK\x03\x04 not an archive")
    else:
        content = bytearray()
    file.write_bytes(content)
    assert cache.read_gripper(file.stem) is None
    again = load_gripper(tmp_path / "card.toml", baking=COARSE)
    assert np.array_equal(again.preshapes[0].hand.values, toy.preshapes[0].hand.values)
    assert cache.read_gripper(file.stem) is not None


def test_changed_values_in_a_valid_archive_are_not_trusted(toy, tmp_path):
    (file,) = (tmp_path / "cache").glob("*.npz")
    with np.load(file) as stored:
        arrays = dict(stored)
    arrays["preshape0.hand.values"] = arrays["preshape0.hand.values"] + 1.0
    np.savez(file, **arrays)
    assert cache.read_gripper(file.stem) is None


def test_changed_card_is_baked_anew(toy, tmp_path):
    wider = CARD.replace("steps = 3", "steps = 4")
    assert len(load_gripper(write_toy(tmp_path, wider), baking=COARSE).preshapes) == len(toy.preshapes) + 1


def test_tool_centre_point_off_the_palm_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setenv("GRASPMATCH_CACHE", str(tmp_path / "cache"))
    lost = CARD.replace("tool_centre_point = [0, 0, 0.045]", "tool_centre_point = [0.5, 0.5, -0.5]")
    with pytest.raises(GraspmatchError, match="no palm behind the tool centre point"):
        load_gripper(write_toy(tmp_path, lost), baking=COARSE)
