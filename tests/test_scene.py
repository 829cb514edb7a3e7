"""Scenes move with their input, survive bad points, and say what is wrong with bad files."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from graspmatch.geometry.mesh import TriangleMesh, sample_surface
from graspmatch.geometry.se3 import rotation_exp
from graspmatch.scene import scene as scene_module
from graspmatch.scene.pcd import lzf_decompress, read_pcd
from graspmatch.scene.read import read_cloud, read_object
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspmatchError, Plane, PointCloud

SIZE = np.array([0.06, 0.08, 0.12])
SPACING = 0.0025


def box(shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> TriangleMesh:
    made = trimesh.creation.box(SIZE)
    return TriangleMesh(np.array(made.vertices) + shift, np.array(made.faces))


def box_cloud(n: int = 20_000, seed: int = 3) -> np.ndarray:
    return sample_surface(box(), n / 0.0432, np.random.default_rng(seed))[0]


def normals_of(scene: Scene) -> np.ndarray:
    assert scene.target.normals is not None
    return scene.target.normals


def table_of(scene: Scene) -> Plane:
    assert scene.table is not None
    return scene.table


def distance_between(a: np.ndarray, b: np.ndarray) -> float:
    """Largest distance from a point of one cloud to the other cloud (Hausdorff)."""
    return float(max(KDTree(a).query(b)[0].max(), KDTree(b).query(a)[0].max()))


# Meshes


def test_a_mesh_becomes_a_surface_without_holes_and_with_outward_normals():
    scene = Scene.from_mesh(box())
    points, normals = scene.target.points, normals_of(scene)
    assert normals is not None
    on_surface = np.abs(np.abs(points) / (SIZE / 2) - 1).min(axis=1)
    assert on_surface.max() < 1e-9  # each point is the centroid of samples of one face
    axis = np.argmax(np.abs(normals), axis=1)
    rows = np.arange(len(points))
    assert np.allclose(points[rows, axis], SIZE[axis] / 2 * np.sign(normals[rows, axis]))
    everywhere = box_cloud(100_000)
    assert KDTree(points).query(everywhere)[0].max() < 1.5 * SPACING


def test_table_and_centre_of_a_box_are_where_they_are():
    scene = Scene.from_mesh(box(shift=(0.5, -0.2, 0.3)))
    assert np.array_equal(table_of(scene).normal, [0, 0, 1])
    assert table_of(scene).offset == pytest.approx(0.3 - SIZE[2] / 2, abs=1e-12)
    assert np.allclose(scene.centre_of_mass, [0.5, -0.2, 0.3])
    assert len(scene.obstacles.points) == 0
    assert scene.source == "array"


def test_centre_of_an_open_mesh_is_that_of_its_surface():
    whole = box()
    top = (whole.vertices[whole.faces][:, :, 2] > 0).all(axis=1)
    scene = Scene.from_mesh(TriangleMesh(whole.vertices, whole.faces[~top]))
    x, y, z = SIZE
    walls, bottom = 2 * (x + y) * z, x * y
    assert np.allclose(scene.centre_of_mass, [0, 0, -bottom * z / 2 / (walls + bottom)], atol=1e-9)


def test_the_centre_is_that_of_the_volume_not_of_the_vertices():
    cone = trimesh.creation.cone(radius=0.04, height=0.12, sections=64)
    scene = Scene.from_mesh(cone)
    assert np.allclose(scene.centre_of_mass, [0, 0, 0.03], atol=1e-6)


def test_a_mesh_with_its_faces_inside_out_is_turned():
    mesh = box()
    scene = Scene.from_mesh(TriangleMesh(mesh.vertices, mesh.faces[:, ::-1].copy()))
    assert np.einsum("ni,ni->n", normals_of(scene), scene.target.points).min() > 0
    assert any("inside out" in note for note in scene.notes)


def test_both_sides_of_a_thin_shell_are_kept():
    made = trimesh.creation.box((0.1, 0.1, 0.0008))
    scene = Scene.from_mesh(made)
    up = normals_of(scene)[:, 2]
    assert np.mean(up > 0.99) > 0.4
    assert np.mean(up < -0.99) > 0.4
    assert np.allclose(scene.target.points[up > 0.99, 2], 0.0004)


def test_small_objects_get_closer_points_and_large_ones_no_more_than_the_limit():
    bead = Scene.from_mesh(trimesh.creation.icosphere(3, 0.005))
    assert len(bead.target.points) > 300
    crate = Scene.from_mesh(trimesh.creation.box((1.0, 1.0, 1.0)))
    assert 10_000 < len(crate.target.points) <= 60_000


def test_a_scene_moves_with_its_mesh():
    scene, shift = Scene.from_mesh(box()), np.array([0.31, -1.7, 0.42])
    moved = Scene.from_mesh(box(tuple(shift)))
    assert np.allclose(scene.target.points + shift, moved.target.points, atol=1e-9)
    assert np.allclose(normals_of(scene), normals_of(moved), atol=1e-6)
    assert np.allclose(scene.centre_of_mass + shift, moved.centre_of_mass)
    assert table_of(moved).offset == pytest.approx(table_of(scene).offset + shift[2])


def test_a_scene_turns_with_its_mesh_about_the_vertical():
    R = rotation_exp(np.array([0, 0, 0.7]))
    mesh = box()
    scene, turned = Scene.from_mesh(mesh), Scene.from_mesh(TriangleMesh(mesh.vertices @ R.T, mesh.faces))
    assert distance_between(scene.target.points @ R.T, turned.target.points) < SPACING
    assert np.allclose(R @ scene.centre_of_mass, turned.centre_of_mass, atol=1e-12)
    assert table_of(turned).offset == pytest.approx(table_of(scene).offset)


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1000.0), ("cm", 100.0), ("m", 1.0)])
def test_a_unit_scales_everything_that_is_given_in_it(unit, factor):
    obstacle = np.array([[0.2, 0, 0], [0.3, 0.1, 0]])
    expected = Scene.from_mesh(box(), table=-0.1, obstacles=obstacle)
    mesh = box()
    scaled = TriangleMesh(mesh.vertices * factor, mesh.faces)
    scene = Scene.from_mesh(scaled, unit=unit, table=-0.1 * factor, obstacles=obstacle * factor)
    assert np.allclose(scene.target.points, expected.target.points, atol=1e-9)
    assert np.allclose(scene.obstacles.points, expected.obstacles.points)
    assert table_of(scene).offset == pytest.approx(-0.1)
    cloud = Scene.from_cloud(box_cloud() * factor, unit=unit, sensor_origin=np.array([0, 0, factor]))
    assert np.allclose(cloud.target.points, Scene.from_cloud(box_cloud()).target.points, atol=1e-9)
    assert cloud.sensor_origin is not None
    assert np.allclose(cloud.sensor_origin, [0, 0, 1])


def test_the_parts_of_a_trimesh_scene_stay_in_their_places():
    parts = trimesh.Scene()
    parts.add_geometry(trimesh.creation.box(SIZE), transform=trimesh.transformations.translation_matrix([0.5, 0, 0]))
    parts.add_geometry(trimesh.creation.box(SIZE))
    scene = Scene.from_mesh(parts)
    assert scene.target.points[:, 0].max() == pytest.approx(0.53, abs=1e-3)
    assert scene.target.points[:, 0].min() == pytest.approx(-0.03, abs=1e-3)


# Clouds


def test_a_cloud_keeps_its_frame_and_gets_outward_normals():
    centre = np.array([1.0, 2.0, 3.0])
    scene = Scene.from_cloud(box_cloud() + centre)
    assert np.allclose(scene.centre_of_mass, centre, atol=1e-3)
    assert np.einsum("ni,ni->n", normals_of(scene), scene.target.points - centre).min() > 0
    assert distance_between(scene.target.points, box_cloud() + centre) < 2 * SPACING
    assert table_of(scene).offset == pytest.approx(3 - SIZE[2] / 2)


def test_the_order_of_the_points_changes_nothing():
    points = np.concatenate([box_cloud(), box_cloud()[:500], [[0.3, 0, 0]], [[np.nan, 0, 0]]])
    shuffled = points[np.random.default_rng(0).permutation(len(points))]
    a, b = Scene.from_cloud(points), Scene.from_cloud(shuffled)
    assert np.array_equal(a.target.points, b.target.points)
    assert np.array_equal(normals_of(a), normals_of(b))
    assert a.notes == b.notes


def test_a_cloud_scene_moves_and_turns_with_its_points():
    points, shift = box_cloud(), np.array([0.2, -0.9, 0.5])
    R = rotation_exp(np.array([0, 0, 2.0]))
    scene, moved, turned = (Scene.from_cloud(p) for p in (points, points + shift, points @ R.T))
    assert np.allclose(scene.target.points + shift, moved.target.points, atol=1e-9)
    assert np.allclose(normals_of(scene), normals_of(moved), atol=1e-6)
    assert distance_between(scene.target.points @ R.T, turned.target.points) < SPACING
    assert np.allclose(R @ scene.centre_of_mass, turned.centre_of_mass, atol=5e-4)


def test_small_clouds_scale_their_scene():
    half, quarter = Scene.from_cloud(box_cloud() * 0.4), Scene.from_cloud(box_cloud() * 0.2)
    assert np.allclose(half.target.points, 2 * quarter.target.points, atol=1e-12)
    assert np.allclose(normals_of(half), normals_of(quarter), atol=1e-6)


def test_bad_points_are_dropped_and_counted():
    good = box_cloud()
    bad = np.array([[np.nan, 0, 0], [np.inf, -np.inf, 0], [0, 0, -np.inf], [1e30, 0, 0], [0, 0, -0.5]])
    scene = Scene.from_cloud(np.concatenate([good, good[:7], bad]))
    clean = Scene.from_cloud(good)
    assert np.array_equal(scene.target.points, clean.target.points)
    assert table_of(scene).offset == table_of(clean).offset  # the speck under the object does not lower the table
    text = " ".join(scene.notes)
    for expected in ("3 of", "7 of", f"1 of {len(good) + 12} points were over a kilometre", "isolated specks"):
        assert expected in text
    assert clean.notes == ()


def test_given_normals_are_kept_and_missing_ones_taken_from_beside():
    points, normals = sample_surface(box(), 20_000 / 0.0432, np.random.default_rng(3))
    normals = -3.0 * normals  # pointing in and not of unit length: the caller's word is taken for the direction
    normals[::50], normals[1::50] = np.nan, 0.0
    scene = Scene.from_cloud(points, normals=normals)
    assert np.allclose(np.linalg.norm(normals_of(scene), axis=1), 1)
    assert np.einsum("ni,ni->n", normals_of(scene), scene.target.points).max() < 0


def test_normals_that_are_all_missing_are_estimated():
    scene = Scene.from_cloud(box_cloud(), normals=np.full((len(box_cloud()), 3), np.nan))
    assert np.allclose(normals_of(scene), normals_of(Scene.from_cloud(box_cloud())), atol=1e-3)


def test_normals_turn_to_the_sensor_and_a_sensor_below_means_that_z_is_not_up():
    sensor = np.array([0.0, 0.0, -0.5])
    scene = Scene.from_cloud(box_cloud(), sensor_origin=sensor)
    assert np.einsum("ni,ni->n", normals_of(scene), sensor - scene.target.points).min() >= 0
    assert scene.table is None
    assert any("no table" in note for note in scene.notes)
    assert Scene.from_cloud(box_cloud(), sensor_origin=-sensor).table is not None


def test_obstacles_are_thinned_and_never_mixed_with_the_target():
    wall = np.random.default_rng(0).uniform([0.1, -0.2, 0], [0.1, 0.2, 0.3], size=(50_000, 3))
    wall[0] = np.nan
    for given in (wall, PointCloud(wall)):
        scene = Scene.from_cloud(box_cloud(), obstacles=given)
        assert np.isfinite(scene.obstacles.points).all()
        assert 0.4 * 0.3 / SPACING**2 * 0.8 < len(scene.obstacles.points) < 0.4 * 0.3 / SPACING**2 * 1.2
        assert np.allclose(scene.obstacles.points[:, 0], 0.1)
        assert np.array_equal(scene.target.points, Scene.from_cloud(box_cloud()).target.points)


# Tables


@pytest.mark.parametrize("z", [-0.06, -5.0, -0.055])
def test_a_table_under_or_barely_in_the_object_is_taken(z):
    scene = Scene.from_mesh(box(), table=z)
    assert np.array_equal(table_of(scene).normal, [0, 0, 1])
    assert table_of(scene).offset == z


def test_a_plane_is_made_unit_and_none_means_no_table():
    scene = Scene.from_mesh(box(), table=Plane(np.array([0.0, 0.0, 2.0]), -0.2))
    assert np.array_equal(table_of(scene).normal, [0, 0, 1])
    assert table_of(scene).offset == -0.1
    assert Scene.from_mesh(box(), table=None).table is None


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (0.2, "140 mm above the top of the object"),
        (-0.03, "reaches 30 mm below the table"),
        (float("nan"), "Possible: auto"),
        (Plane(np.zeros(3), 0.0), "normal that is not zero"),
    ],
)
def test_an_impossible_table_is_refused(table, message):
    with pytest.raises(GraspmatchError, match=message):
        Scene.from_mesh(box(), table=table)


def test_unknown_words_are_answered_with_the_known_ones():
    with pytest.raises(GraspmatchError, match="Known: auto, m, cm, mm"):
        scene_module._metres("ft")


# Sizes


def test_a_mesh_in_millimetres_is_noticed(tmp_path):
    path = tmp_path / "mug.stl"
    trimesh.creation.cylinder(radius=40, height=97).export(path)
    with pytest.raises(GraspmatchError) as error:
        Scene.read(path)
    assert str(error.value) == ('mug.stl is 97 m tall: it is probably in millimetres; pass unit="mm" (--unit mm).')
    assert np.ptp(Scene.read(path, unit="mm").target.points[:, 2]) == pytest.approx(0.097, abs=1e-3)


def test_tiny_and_huge_clouds_are_noticed_and_a_far_speck_is_no_size():
    with pytest.raises(GraspmatchError, match="no hand can grasp"):
        Scene.from_cloud(box_cloud() * 0.001)
    with pytest.raises(GraspmatchError, match="probably in millimetres"):
        Scene.from_cloud(box_cloud() * 1000)
    with pytest.raises(GraspmatchError, match="whole scene"):
        Scene.from_cloud(box_cloud() * 50)
    assert len(Scene.from_cloud(np.concatenate([box_cloud(), [[9.0, 0, 0]]])).target.points) > 1000


# Files


def literal_lzf(data: bytes) -> bytes:
    """The simplest valid LZF: literal runs of at most 32 bytes."""
    runs = [data[i : i + 32] for i in range(0, len(data), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def write_pcd(path: Path, table: np.ndarray, fields: str, encoding: str, width: int, height: int = 1) -> None:
    names = fields.split()
    header = (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\n"
        f"SIZE {'4 ' * len(names)}\nTYPE {'F ' * len(names)}\nCOUNT {'1 ' * len(names)}\n"
        f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0.5 1 0 0 0\nPOINTS {len(table)}\nDATA {encoding}\n"
    )
    values = table.astype("<f4")
    if encoding == "ascii":
        body = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in values).encode()
    elif encoding == "binary":
        body = values.tobytes()
    else:
        columns = values.T.tobytes()
        packed = literal_lzf(columns)
        body = struct.pack("<II", len(packed), len(columns)) + packed
    path.write_bytes(header.encode() + body)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_every_encoding_of_pcd_reads_back(tmp_path, encoding):
    rng = np.random.default_rng(0)
    table = rng.normal(size=(60, 7)).astype(np.float32)
    table[5, 1:4] = np.nan
    write_pcd(tmp_path / "a.pcd", table, "label x y z normal_x normal_y normal_z", encoding, 12, 5)
    pcd = read_pcd(tmp_path / "a.pcd")
    assert (pcd.width, pcd.height) == (12, 5)
    assert np.allclose(pcd.points, table[:, 1:4], rtol=1e-7, atol=0, equal_nan=True)
    assert pcd.normals is not None
    assert np.allclose(pcd.normals, table[:, 4:], rtol=1e-7, atol=0)
    assert pcd.viewpoint is not None
    assert np.array_equal(pcd.viewpoint, [0, 0, 0.5])


def test_pcd_fields_may_be_mixed_repeated_and_padded(tmp_path):
    layout = np.dtype([("x", "<f8"), ("_1", "u1", 3), ("y", "<f4"), ("z", "<f4"), ("f", "<i2", 2), ("_2", "u1")])
    table = np.zeros(4, dtype=layout)
    table["x"], table["y"], table["z"] = np.arange(4), 0.5, -2
    table["f"] = np.arange(8).reshape(4, 2)
    header = (
        "FIELDS x _ y z f _\nSIZE 8 1 4 4 2 1\nTYPE F U F F I U\nCOUNT 1 3 1 1 2 1\n"
        "WIDTH 4\nHEIGHT 1\nPOINTS 4\nDATA binary\n"
    )
    (tmp_path / "a.pcd").write_bytes(header.encode() + table.tobytes())
    pcd = read_pcd(tmp_path / "a.pcd")
    assert np.array_equal(pcd.points, np.stack([np.arange(4), np.full(4, 0.5), np.full(4, -2)], axis=-1))
    assert np.array_equal(pcd.fields["f"], table["f"])
    assert pcd.normals is None
    assert pcd.viewpoint is None


def test_lzf_copies_runs_that_overlap_themselves():
    assert lzf_decompress(b"\x01ab" + bytes([0b011_00000, 1]), 7) == b"ababab" + b"a"  # five bytes from two back
    assert lzf_decompress(b"\x00x" + bytes([0b111_00000, 20, 0]), 30) == b"x" * 30  # 7 + 20 + 2 bytes from one back
    for damaged in (b"\x01ab" + bytes([0b011_00000, 2]), b"\x05ab"):
        with pytest.raises(ValueError, match="compressed block"):
            lzf_decompress(damaged, 6)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"VERSION 0.7\nFIELDS x y z\n", "no DATA line"),
        (b"FIELDS x y z\nDATA ascii\n", "no SIZE, TYPE, WIDTH, HEIGHT"),
        (b"FIELDS x y\nSIZE 4 4\nTYPE F F\nWIDTH 1\nHEIGHT 1\nDATA ascii\n1 2\n", "no fields x, y and z"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nDATA binary\n123456789012", "1 of 2 points"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nDATA ascii\n1 2 3\n", "announces 2 points"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nDATA morse\n1 2 3\n", "'morse'. Known: ascii"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nDATA binary_compressed\n\x01\x00", "sizes of the"),
    ],
)
def test_damaged_pcd_files_say_what_is_wrong(tmp_path, content, message):
    (tmp_path / "a.pcd").write_bytes(content)
    with pytest.raises(GraspmatchError, match=message):
        read_pcd(tmp_path / "a.pcd")


def write_cloud(path: Path, points: np.ndarray) -> None:
    if path.suffix == ".ply":
        trimesh.PointCloud(points).export(path)
    elif path.suffix == ".pcd":
        write_pcd(path, points, "x y z", "binary_compressed", len(points))
    elif path.suffix == ".obj":
        path.write_text("".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in points))
    elif path.suffix == ".npy":
        np.save(path, points)
    elif path.suffix == ".npz":
        np.savez(path, pts=points, other=np.zeros(3))
    else:
        path.write_text("# x, y, z\n" + "\n".join(f"{x:.9g}, {y:.9g}; {z:.9g}" for x, y, z in points))


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".obj", ".npy", ".npz", ".xyz", ".TXT"])
def test_every_cloud_file_gives_the_scene_of_its_array(tmp_path, suffix):
    points = box_cloud(4000).astype(np.float32)
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, points)
    scene, expected = Scene.read(path), Scene.from_cloud(points)
    assert scene.source == path.name
    assert scene.mesh is None
    assert np.allclose(scene.target.points, expected.target.points, atol=1e-6)
    with pytest.raises(GraspmatchError, match="no faces"):
        Scene.from_mesh(path)


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".glb", ".gltf", ".ply", ".off"])
def test_every_mesh_file_gives_the_scene_of_its_mesh(tmp_path, suffix):
    path = tmp_path / f"box{suffix}"
    trimesh.creation.box(SIZE).export(path)
    scene = Scene.read(path)
    assert scene.mesh is not None
    assert len(scene.mesh.faces) == 12
    assert np.allclose(scene.centre_of_mass, 0, atol=1e-6)
    assert distance_between(scene.target.points, Scene.from_mesh(box()).target.points) < SPACING
    assert bool(scene.notes) == (suffix in (".glb", ".gltf"))  # they are usually y up
    with pytest.raises(GraspmatchError, match=r"Scene\.from_mesh"):
        Scene.from_cloud(path)


def test_normals_are_read_from_files_that_have_them(tmp_path):
    points, normals = sample_surface(box(), 4000 / 0.0432, np.random.default_rng(3))
    table = np.concatenate([points, normals], axis=1)
    np.save(tmp_path / "a.npy", table)
    np.savez(tmp_path / "a.npz", points=points, normals=normals, obstacles=points + 1)
    write_pcd(tmp_path / "a.pcd", table, "x y z normal_x normal_y normal_z", "binary", len(table))
    header = "ply\nformat ascii 1.0\nelement vertex {n}\n{properties}end_header\n"
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    rows = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in table)
    (tmp_path / "a.ply").write_text(header.format(n=len(table), properties=properties) + rows)
    for suffix in ("npy", "npz", "pcd", "ply"):
        content = read_cloud(tmp_path / f"a.{suffix}")
        assert content.normals is not None
        assert np.allclose(content.normals, normals, atol=1e-6)
    assert len(Scene.read(tmp_path / "a.npz").obstacles.points) > 100
    colours = np.concatenate([points, np.random.default_rng(0).integers(0, 255, points.shape)], axis=1)
    np.save(tmp_path / "colours.npy", colours)
    assert read_cloud(tmp_path / "colours.npy").normals is None


def bad_files(folder: Path) -> dict[str, str]:
    """Files that cannot be used, by name, and what their error must say."""
    np.savez(folder / "two.npz", points=np.zeros((20, 3)), xyz=np.zeros((20, 3)))
    np.savez(folder / "none.npz", depth=np.zeros((4, 4)))
    np.save(folder / "wide.npy", np.zeros((480, 640, 3)))
    np.save(folder / "nan.npy", np.full((50, 3), np.nan))
    np.save(folder / "one.npy", np.ones((50, 3)))
    np.save(folder / "empty.npy", np.zeros((0, 3)))
    np.save(folder / "pickle.npy", np.array([{}], dtype=object), allow_pickle=True)
    for name in ("text.stl", "text.obj", "text.glb", "text.xyz", "text.npz", "text.docx", "text.ply", "text.off"):
        (folder / name).write_text("hello world\n")
    (folder / "nothing.stl").write_text("")
    (folder / "nothing.xyz").write_text("")
    return {
        "two.npz": r"several clouds \(points, xyz\)",
        "none.npz": "no cloud among depth.*points, xyz, pts, object_points",
        "wide.npy": r"\(480, 640, 3\)",
        "nan.npy": "50 points, all of them NaN",
        "one.npy": "only 1 usable of 50 points; at least 10",
        "empty.npy": "no points",
        "pickle.npy": "could not be read as NPY",
        "text.stl": "no faces and no points|could not be read",
        "text.obj": "no faces and no points",
        "text.glb": "could not be read as GLB",
        "text.ply": "could not be read as PLY",
        "text.off": "could not be read as OFF",
        "text.xyz": "not columns of numbers",
        "text.npz": "could not be read as NPZ",
        "text.docx": "unknown kind of file '.docx'. Known: .stl, .obj",
        "nothing.stl": "no faces and no points|could not be read",
        "nothing.xyz": "nothing.xyz is empty",
        "missing.stl": "No such file",
        ".": "is a directory",
    }


def test_files_that_cannot_be_used_say_why_in_one_line(tmp_path):
    for name, message in bad_files(tmp_path).items():
        with pytest.raises(GraspmatchError, match=message) as error:
            Scene.read(tmp_path / name)
        assert "\n" not in str(error.value), name


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cloud": np.zeros((40, 2))}, r"shape \(40, 2\); \(n, 3\) is needed"),
        ({"cloud": np.zeros((4, 5, 3))}, "organised cloud"),
        ({"cloud": np.array([["a", "b", "c"]])}, "array of numbers"),
        ({"cloud": box_cloud(), "normals": np.zeros((3, 3))}, "but 3 normals"),
        ({"cloud": box_cloud(), "sensor_origin": np.zeros(2)}, "sensor_origin must be three"),
        ({"cloud": box_cloud(), "obstacles": np.zeros((3, 2))}, "the obstacle cloud has shape"),
    ],
)
def test_wrong_arrays_are_refused(arguments, message):
    with pytest.raises(GraspmatchError, match=message):
        Scene.from_cloud(**arguments)


def test_wrong_meshes_are_refused():
    corners = np.eye(3)
    for faces, message in (
        (np.zeros((0, 3), dtype=int), "no faces"),
        (np.array([[0, 1, 5]]), "indices of its 3 vertices"),
        (np.array([[0, 1, 1]]), "no face with an area"),
    ):
        with pytest.raises(GraspmatchError, match=message):
            Scene.from_mesh(TriangleMesh(corners, faces))
    corners[0] = np.nan
    with pytest.raises(GraspmatchError):
        Scene.from_mesh(TriangleMesh(corners, np.array([[0, 1, 2]])))


def test_importing_the_scene_loads_numpy_only():
    heavy = "[m for m in ('scipy', 'trimesh', 'warp', 'mujoco', 'matplotlib') if m in sys.modules]"
    code = f"import sys, graspmatch.scene.scene; print({heavy})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# Real data


@pytest.mark.parametrize(
    "name",
    [
        "paper/Cat",
        "paper/Spray",
        "paper/Mug",
        "ycb/006_mustard_bottle",
        "ycb/024_bowl",
        "ycb/029_plate",
        "ycb/062_dice",
        "contactdb/knife",
    ],
)
def test_real_objects_become_scenes(shared_data, name):
    path = shared_data / "objects" / name / "mesh.stl"
    scene, mesh = Scene.read(path), trimesh.load(path)
    assert isinstance(mesh, trimesh.Trimesh)
    everywhere, _ = sample_surface(
        TriangleMesh(np.array(mesh.vertices), np.array(mesh.faces)), 1e6, np.random.default_rng(5)
    )
    assert KDTree(scene.target.points).query(everywhere)[0].max() < 1.5 * SPACING
    assert table_of(scene).offset == pytest.approx(mesh.bounds[0, 2])
    assert (scene.centre_of_mass > mesh.bounds[0]).all()
    assert (scene.centre_of_mass < mesh.bounds[1]).all()
    if mesh.is_watertight:
        assert np.allclose(scene.centre_of_mass, mesh.center_mass, atol=1e-6)
    assert 1000 < len(scene.target.points) <= 60_000


@pytest.mark.parametrize("name", ["test0", "test11"])
def test_organised_compressed_captures_project_onto_their_own_pixels(shared_data, name):
    pcd = read_pcd(shared_data / "scenes" / "mosd" / f"{name}.pcd")
    assert (pcd.width, pcd.height, len(pcd.points)) == (640, 480, 307_200)
    index = np.flatnonzero(np.isfinite(pcd.points).all(axis=1))
    assert 150_000 < len(index) < 250_000
    x, y, z = pcd.points[index].T
    assert 0.3 < z.min() < z.max() < 2
    assert np.abs(525 * x / z + 319.5 - index % 640).max() < 1e-3
    assert np.abs(525 * y / z + 239.5 - index // 640).max() < 1e-3
    labels = pcd.fields["label"]
    assert {0, 1, 20, 30} <= set(np.unique(labels))
    target = pcd.points[(labels == 20)]
    scene = Scene.from_cloud(target, obstacles=pcd.points[labels != 20], sensor_origin=np.zeros(3))
    assert scene.table is None
    assert np.ptp(scene.target.points, axis=0).max() < 0.4
    assert len(scene.obstacles.points) > 1000


def test_ascii_captures_have_their_points(shared_data):
    can = read_object(shared_data / "scenes" / "gpd" / "krylon.pcd")
    assert not isinstance(can, TriangleMesh)
    assert len(can.points) == 4467
    assert can.sensor_origin is None
    assert np.allclose(np.ptp(can.points, axis=0), [0.057, 0.055, 0.105], atol=2e-3)
    table_mug = read_pcd(shared_data / "scenes" / "gpd" / "table_mug.pcd")
    assert len(table_mug.points) == 104_444
    assert np.isfinite(table_mug.points).all()
    scene = Scene.read(shared_data / "scenes" / "gpd" / "krylon.pcd")
    assert len(scene.target.points) > 2000


@pytest.mark.parametrize("name", ["blue_mug", "white_bowl", "mustard"])
def test_segmented_captures_are_clouds_in_the_camera_frame(shared_data, name):
    scene = Scene.read(shared_data / "scenes" / "6dof_graspnet" / f"{name}.npz")
    assert scene.sensor_origin is not None
    assert np.array_equal(scene.sensor_origin, np.zeros(3))
    assert scene.table is None
    assert any("no table" in note for note in scene.notes)
    assert np.einsum("ni,ni->n", normals_of(scene), -scene.target.points).min() >= 0
    assert 0.05 < np.ptp(scene.target.points, axis=0).max() < 0.25
