"""Convex parts stand for their mesh: they are convex, they cover it, they keep its hollows, and they are made once."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspmatch.geometry.mesh import TriangleMesh, concatenate
from graspmatch.scene.shapes import mug
from graspmatch.simulate.convex import ConvexParts, convex_parts
from graspmatch.simulate.decompose import CONCAVITY, CoacdSettings, run_coacd, settings_for
from graspmatch.simulate.fidelity import fidelity, signed_distance
from graspmatch.simulate.mend import WALL, close_small_holes, closed_bodies, connected_bodies, open_edges, thickened
from graspmatch.types import GraspmatchError


@pytest.fixture(autouse=True)
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Nothing is remembered from one test to the next."""
    monkeypatch.setenv("GRASPMATCH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def as_mesh(solid: trimesh.Trimesh) -> TriangleMesh:
    return TriangleMesh(np.array(solid.vertices, dtype=float), np.array(solid.faces, dtype=int))


def box(*extents: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> TriangleMesh:
    solid = trimesh.creation.box(extents=extents)
    solid.apply_translation(centre)
    return as_mesh(solid)


def extruded(outline: list[tuple[float, float]], triangles: list[tuple[int, int, int]], height: float) -> TriangleMesh:
    """A prism over a triangulated outline (counter-clockwise) [m]: one closed body."""
    n = len(outline)
    flat = np.array(outline)
    vertices = np.concatenate([np.column_stack([flat, np.full(n, z)]) for z in (0.0, height)])
    top = np.array(triangles) + n
    a = np.arange(n)
    b = (a + 1) % n
    sides = [np.column_stack([a, b, b + n]), np.column_stack([a, b + n, a + n])]
    return TriangleMesh(vertices, np.concatenate([np.array(triangles)[:, ::-1], top, *sides]))


def u_shape() -> TriangleMesh:
    """60 mm wide, 60 mm deep, 30 mm high; its slot is 30 mm wide and 45 mm deep."""
    outline = [(0, 0), (60, 0), (60, 60), (45, 60), (45, 15), (15, 15), (15, 60), (0, 60)]
    triangles = [(0, 5, 7), (5, 6, 7), (0, 1, 5), (1, 4, 5), (1, 2, 4), (2, 3, 4)]
    return extruded([(x / 1000, y / 1000) for x, y in outline], triangles, 0.03)


def open_cup() -> TriangleMesh:
    """The outside of a cup, 80 mm wide and 80 mm high, as a scan has it: one sheet, open above."""
    solid = trimesh.creation.cylinder(radius=0.04, height=0.08, sections=16)
    keep = ~np.all(np.abs(solid.vertices[solid.faces][:, :, 2] - 0.04) < 1e-9, axis=1)
    return as_mesh(trimesh.Trimesh(solid.vertices, solid.faces[keep], process=True))


def is_inside(convex: ConvexParts, *point: float) -> bool:
    return bool(signed_distance(concatenate(list(convex.parts)), np.array([point]))[0] < 0)


def assert_convex(convex: ConvexParts) -> None:
    for part in convex.parts:
        solid = trimesh.Trimesh(part.vertices, part.faces)
        assert solid.is_watertight
        assert solid.is_winding_consistent
        assert solid.volume > 0
        heights = part.vertices @ solid.face_normals.T - np.sum(solid.face_normals * solid.triangles[:, 0], axis=1)
        assert heights[:, solid.area_faces > 1e-10].max() < 1e-6


def equal_parts(one: ConvexParts, other: ConvexParts) -> bool:
    return len(one.parts) == len(other.parts) and all(
        np.array_equal(a.vertices, b.vertices) and np.array_equal(a.faces, b.faces)
        for a, b in zip(one.parts, other.parts, strict=True)
    )


def test_a_box_is_one_part_that_fits_exactly() -> None:
    convex = convex_parts(box(0.05, 0.06, 0.07))
    assert len(convex.parts) == 1
    assert convex.fidelity.largest_bulge < 1e-6
    assert convex.fidelity.largest_gap < 1e-6


def test_a_hull_within_tolerance_needs_no_coacd(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspmatch.simulate.decompose.run_coacd", lambda *_: pytest.fail("CoACD was called"))
    dented = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    dented.vertices[0] *= 1 - 0.0008 / 0.04
    assert 0 < convex_parts(as_mesh(dented)).fidelity.largest_bulge < 0.001


@pytest.mark.parametrize("turned", range(3))
def test_finely_divided_flat_faces_do_not_cost_a_body(turned: int) -> None:
    """Their points lie in rows, up to rounding: Qhull's facets between them have gaps."""
    solid = trimesh.creation.cylinder(radius=0.04, height=0.11, sections=40)
    solid.apply_transform(trimesh.transformations.random_rotation_matrix(np.random.default_rng(turned).random(3)))
    whole = solid.volume
    for _ in range(3):
        solid = solid.subdivide()
    fine = TriangleMesh(solid.vertices.astype(np.float32).astype(float), np.array(solid.faces, dtype=int))
    convex = convex_parts(concatenate([fine, box(0.01, 0.01, 0.01, centre=(0.0, 0.0, 0.2))]))
    assert_convex(convex)
    assert len(convex.parts) == 2
    assert convex.fidelity.largest_gap < 1e-6
    assert trimesh.Trimesh(convex.parts[0].vertices, convex.parts[0].faces).volume == pytest.approx(whole, rel=1e-6)


def test_separate_convex_bodies_are_their_own_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspmatch.simulate.decompose.run_coacd", lambda *_: pytest.fail("CoACD was called"))
    hammer = concatenate([box(0.02, 0.2, 0.02), box(0.1, 0.03, 0.03, centre=(0.0, 0.1, 0.0))])
    convex = convex_parts(hammer)
    assert len(convex.parts) == 2
    assert convex.fidelity.largest_bulge < 1e-6


def test_specks_around_a_scan_are_no_parts_and_count_as_missing() -> None:
    specks = [box(0.0005, 0.0005, 0.0005, centre=(0.04, 0.0, 0.001 * i)) for i in range(20)]
    convex = convex_parts(concatenate([box(0.05, 0.05, 0.05), *specks]))
    assert len(convex.parts) == 1
    assert convex.fidelity.largest_gap == pytest.approx(0.01525, abs=1e-4)


def test_a_u_keeps_its_slot() -> None:
    convex = convex_parts(u_shape())
    assert_convex(convex)
    assert not is_inside(convex, 0.03, 0.04, 0.015)
    assert all(
        is_inside(convex, *point) for point in [(0.008, 0.05, 0.015), (0.052, 0.05, 0.015), (0.03, 0.008, 0.015)]
    )
    assert convex.fidelity.largest_bulge < 0.001
    assert convex.fidelity.largest_gap < 0.001


def test_a_mug_stays_hollow_and_its_handle_open() -> None:
    convex = convex_parts(mug())
    assert_convex(convex)
    assert 4 < len(convex.parts) <= 44
    assert not is_inside(convex, 0.0, 0.0, 0.05)
    assert not is_inside(convex, 0.02, 0.0, 0.08)
    assert not is_inside(convex, 0.045, 0.0, 0.045)  # between handle and wall
    assert is_inside(convex, 0.0, 0.0, 0.002)
    assert convex.bulge < 0.002
    assert convex.fidelity.largest_gap < 0.001


def test_an_open_sheet_becomes_a_thin_wall() -> None:
    sheet = open_cup()
    convex = convex_parts(sheet)
    assert_convex(convex)
    assert not is_inside(convex, 0.0, 0.0, 0.0)
    assert not is_inside(convex, 0.0, 0.0, 0.039)
    assert convex.bulge < WALL + CONCAVITY
    assert convex.fidelity.largest_gap < 0.001


def test_the_same_mesh_gives_the_same_parts_and_the_cache_gives_them_at_once(empty_cache: Path) -> None:
    first = convex_parts(u_shape())
    stored = list(empty_cache.iterdir())
    assert [path.suffix for path in stored] == [".npz"]
    begin = time.perf_counter()
    again = convex_parts(u_shape())
    assert time.perf_counter() - begin < 0.2
    stored[0].unlink()
    anew = convex_parts(u_shape())
    assert equal_parts(first, again)
    assert equal_parts(first, anew)
    assert first.fidelity == again.fidelity == anew.fidelity


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 no archive", None])
def test_a_damaged_cache_is_made_anew(empty_cache: Path, damage: bytes | None) -> None:
    good = convex_parts(box(0.05, 0.06, 0.07))
    path = next(empty_cache.iterdir())
    if damage is None:  # a readable archive whose content has changed
        with np.load(path) as file:
            arrays = dict(file)
        arrays["vertices"] = arrays["vertices"] * 2
        np.savez(path, allow_pickle=False, **arrays)
    else:
        path.write_bytes(damage)
    assert equal_parts(convex_parts(box(0.05, 0.06, 0.07)), good)


def test_a_cache_that_cannot_be_written_costs_nothing_but_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("GRASPMATCH_CACHE", str(tmp_path / "file" / "cache"))
    assert len(convex_parts(box(0.05, 0.06, 0.07)).parts) == 1


def test_other_meshes_have_other_cache_entries(empty_cache: Path) -> None:
    small, large = convex_parts(box(0.05, 0.06, 0.07)), convex_parts(box(0.05, 0.06, 0.08))
    assert np.ptp(small.parts[0].vertices, axis=0)[2] == pytest.approx(0.07)
    assert np.ptp(large.parts[0].vertices, axis=0)[2] == pytest.approx(0.08)
    assert len(list(empty_cache.iterdir())) == 2


def write_parts(folder: Path, parts: list[TriangleMesh]) -> Path:
    folder.mkdir()
    for i, part in enumerate(parts):
        trimesh.Trimesh(part.vertices, part.faces).export(folder / f"{i:02d}.stl")
    return folder


def test_a_folder_of_parts_wins_over_decomposition(tmp_path: Path) -> None:
    halves = [box(0.05, 0.03, 0.07, centre=(0.0, side * 0.015, 0.0)) for side in (-1.0, 1.0)]
    folder = write_parts(tmp_path / "convex", halves)
    whole = box(0.05, 0.06, 0.07)
    convex = convex_parts(whole, folder=folder)
    assert len(convex.parts) == 2
    assert [part.vertices[:, 1].mean() < 0 for part in convex.parts] == [True, False]
    assert convex.fidelity.largest_bulge < 1e-6
    assert len(convex_parts(whole).parts) == 1


def test_changed_files_of_a_folder_are_read_again(tmp_path: Path) -> None:
    whole = box(0.05, 0.06, 0.07)
    folder = write_parts(tmp_path / "convex", [whole])
    assert convex_parts(whole, folder=folder).fidelity.largest_bulge < 1e-6
    trimesh.creation.box(extents=(0.05, 0.06, 0.09)).export(folder / "00.stl")
    assert convex_parts(whole, folder=folder).fidelity.largest_bulge == pytest.approx(0.01, abs=1e-4)


def test_figures_say_how_far_parts_reach_beyond_and_stay_short() -> None:
    whole, short = box(0.05, 0.06, 0.07), box(0.05, 0.06, 0.05)
    missing = fidelity(whole, [short])
    assert missing.largest_gap == pytest.approx(0.01, abs=2e-4)
    assert missing.largest_bulge < 1e-6  # what is short of the mesh is inside it
    beyond = fidelity(short, [whole])
    assert beyond.largest_bulge == pytest.approx(0.01, abs=2e-4)
    assert beyond.largest_gap < 1e-6
    stacked = fidelity(whole, [box(0.05, 0.06, 0.035, centre=(0, 0, side * 0.0175)) for side in (-1, 1)])
    assert stacked.largest_bulge < 1e-6  # where parts touch each other, neither is exposed


def test_a_filled_cup_is_seen_in_the_bulge() -> None:
    cup = mug()
    filled = as_mesh(trimesh.Trimesh(cup.vertices, cup.faces).convex_hull)
    assert fidelity(cup, [filled]).largest_bulge > 0.02
    assert fidelity(open_cup(), [as_mesh(trimesh.creation.cylinder(0.04, 0.08))], is_open=True).largest_bulge > 0.02


def test_small_holes_are_closed_and_large_ones_are_not() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
    pierced = TriangleMesh(np.array(sphere.vertices), np.array(sphere.faces)[3:])
    assert len(open_edges(pierced.faces)) > 0
    assert len(open_edges(close_small_holes(pierced).faces)) == 0
    assert len(open_edges(close_small_holes(open_cup()).faces)) == 16
    assert closed_bodies(pierced)[1] is False
    assert closed_bodies(open_cup())[1] is True


def test_a_thickened_sheet_is_a_closed_wall_behind_it() -> None:
    wall = trimesh.Trimesh(**vars(thickened(open_cup())), process=False)
    assert wall.is_watertight
    assert wall.is_winding_consistent
    assert wall.volume == pytest.approx(0.0015 * open_area(), rel=0.2)  # thinner along the lower edge
    assert np.allclose(wall.bounds, [[-0.04, -0.04, -0.04], [0.04, 0.04, 0.04]])


def open_area() -> float:
    sheet = open_cup()
    return float(trimesh.Trimesh(sheet.vertices, sheet.faces).area)


def test_bodies_come_apart_whole() -> None:
    one, other = box(0.02, 0.02, 0.02), box(0.03, 0.03, 0.03, centre=(0.1, 0.0, 0.0))
    first, second = connected_bodies(concatenate([one, other]))
    assert np.array_equal(first.vertices[first.faces], one.vertices[one.faces])
    assert np.array_equal(second.vertices[second.faces], other.vertices[other.faces])


def test_faces_that_are_but_an_edge_open_no_hole() -> None:
    whole = box(0.05, 0.06, 0.07)
    flat = TriangleMesh(whole.vertices, np.concatenate([whole.faces, [[0, 1, 0]]]))
    (body,), is_open = closed_bodies(flat)
    assert not is_open
    assert len(body.faces) == len(whole.faces)


def test_coacd_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    body = u_shape()
    assert run_coacd(body, settings_for(body, 10))
    assert capfd.readouterr() == ("", "")


def test_parts_that_leave_a_gap_are_made_again_from_a_remeshed_body(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def half_missing(body: TriangleMesh, settings: CoacdSettings) -> list[TriangleMesh]:
        asked.append(settings.preprocess_mode)
        return [box(0.06, 0.015, 0.03, centre=(0.03, 0.0075, 0.015))] if settings.preprocess_mode == "off" else [body]

    monkeypatch.setattr("graspmatch.simulate.decompose.run_coacd", half_missing)
    assert convex_parts(u_shape()).fidelity.largest_gap < 1e-6
    assert asked == ["off", "on"]


def test_remeshing_gives_parts_that_cover_the_body() -> None:
    body = u_shape()
    parts = run_coacd(body, replace(settings_for(body, 10), preprocess_mode="on", preprocess_resolution=20))
    found = fidelity(body, parts)
    assert found.largest_gap < 0.001
    assert found.largest_bulge < 0.006


def test_a_crash_of_coacd_is_an_error_that_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def abort(*_: object, **__: object) -> subprocess.CompletedProcess[bytes]:
        return real_run([sys.executable, "-c", "import os; os.abort()"], capture_output=True)

    real_run = subprocess.run
    monkeypatch.setattr("graspmatch.simulate.decompose.subprocess.run", abort)
    with pytest.raises(GraspmatchError, match="folder 'convex'"):
        convex_parts(u_shape())


def test_a_mesh_that_is_no_solid_is_refused() -> None:
    with pytest.raises(GraspmatchError, match="no faces"):
        convex_parts(TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=int)))
    with pytest.raises(GraspmatchError, match="no face with an area"):
        convex_parts(TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, 2]])))


def test_a_folder_without_usable_parts_is_refused(tmp_path: Path) -> None:
    whole = box(0.05, 0.06, 0.07)
    with pytest.raises(GraspmatchError, match="is no folder"):
        convex_parts(whole, folder=tmp_path / "none")
    (tmp_path / "convex").mkdir()
    with pytest.raises(GraspmatchError, match="holds no STL"):
        convex_parts(whole, folder=tmp_path / "convex")
    (tmp_path / "convex" / "00.stl").write_bytes(b"solid nonsense")
    with pytest.raises(GraspmatchError, match=r"00\.stl"):
        convex_parts(whole, folder=tmp_path / "convex")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export(tmp_path / "convex" / "00.stl")
    with pytest.raises(GraspmatchError, match=r"00\.stl .* no volume"):
        convex_parts(whole, folder=tmp_path / "convex")


def test_ready_parts_of_real_objects_are_read(shared_data: Path) -> None:
    from graspmatch.scene.read import read_mesh

    folder = shared_data / "objects" / "contactdb" / "cup"
    convex = convex_parts(read_mesh(folder / "mesh.stl"), folder=folder / "convex")
    assert len(convex.parts) == len(list((folder / "convex").glob("*.stl")))
    assert_convex(convex)
    assert not is_inside(convex, *np.mean([part.vertices.mean(axis=0) for part in convex.parts], axis=0))
