"""Files that are mistyped, cut, disguised or made to do harm: each is one line that names the file, and quickly."""

from __future__ import annotations

import io
import json
import os
import time
import zipfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from graspmatch.errors import GraspmatchError
from graspmatch.formats.registry import read_grasps, write_grasps, writer_of
from graspmatch.gripper.load import load_gripper
from graspmatch.types import GraspSet, Gripper
from test_graspnet import grasps_of

SUFFIXES = (".npz", ".yaml", ".moveit.yaml", ".npy", ".json", ".h5")


@pytest.fixture(scope="module")
def franka() -> Gripper:
    return load_gripper("franka_hand")


@pytest.fixture(scope="module")
def good(franka: Gripper, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Three grasps in every format."""
    folder = tmp_path_factory.mktemp("good")
    for suffix in SUFFIXES:
        write_grasps(grasps_of(franka, 3), folder / f"grasps{suffix}", franka)
    return {suffix: (folder / f"grasps{suffix}").read_bytes() for suffix in SUFFIXES}


def refused(path: Path, gripper: Gripper, said: str = "") -> str:
    """The error: one line of bearable length, with the file's name and what is expected to be said, within seconds."""
    begin = time.perf_counter()
    with pytest.raises(GraspmatchError, match=said or None) as caught:
        read_grasps(path, gripper)
    message = str(caught.value)
    assert path.name in message
    assert "\n" not in message
    assert len(message) < 600
    assert time.perf_counter() - begin < 5
    return message


def outcome(path: Path, gripper: Gripper) -> tuple[GraspSet | None, str]:
    """The grasps of a file, or the error."""
    try:
        return read_grasps(path, gripper), ""
    except GraspmatchError as error:
        return None, str(error)


ISAAC = "format: isaac_grasp\nformat_version: 1.0\ngrasps: "
NINES = "9" * 5000


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\n", r"line 2 has an alias, \*a"),
        ("a: &a {x: 1}\nb: &b {<<: [*a, *a]}\n", "alias"),
        ("[" * 3_000_000, "nested more than 24 levels"),
        ("{a: " * 3_000_000, "nested more than 24 levels"),
        ("? " * 100_000, "nested"),
        (ISAAC + "!!python/object/apply:os.getcwd []", "could not determine a constructor"),
        (ISAAC + "!include /etc/passwd", "could not determine a constructor"),
        (ISAAC + "2001-99-99", "month must be in"),
        (ISAAC + f"{{a: {{position: [{NINES}, 0, 0], orientation: {{w: 1, xyz: [0, 0, 0]}}}}}}", ""),
        (ISAAC + "{a: {position: [[0], 0, 0], orientation: {w: 1, xyz: [0, 0, 0]}}}", "grasp 'a' is malformed"),
        (ISAAC + "{a: {position: [0, 0, 0], orientation: [1, 0, 0, 0]}}", "grasp 'a' is malformed"),
        (ISAAC + "{a: {position: [0, 0, 0], orientation: {w: 0.7, xyz: [0, 0, 0]}}}", "length 0.7, not 1"),
        (ISAAC + "{a: {position: [0, 0, 0], orientation: {w: .nan, xyz: [0, 0, 0]}}}", "length nan"),
        (ISAAC + "{a: null}", "grasp 'a' is malformed"),
        (ISAAC + "{}\n---\n" + ISAAC + "{}", "neither 'format: isaac_grasp' nor"),
        (ISAAC + "{}\ngraspmatch: {joint_names: 3}", "block 'graspmatch' is malformed"),
        (ISAAC + "{}\ngraspmatch: null", "block 'graspmatch' is malformed"),
        (
            ISAAC + "{a: {position: [0, 0, 0], orientation: {w: 1, xyz: [0, 0, 0]}, cspace_position: {k: 1}}}\n"
            "graspmatch: {joint_names: [j], preshape_names: [p]}",
            "'k' is none of its joint_names",
        ),
        ("\x00\x01", "not YAML"),
        ("{}", "holds no grasps"),
        ("- {grasp_pose: {pose: {}}}", "message 0 is malformed"),
        (
            "- {grasp_pose: {pose: {position: {x: 0, y: 0, z: 0}, orientation: {x: 0, y: 0, z: 0, w: 0}}}}",
            "length 0, not",
        ),
        ("- {grasp_pose: {pose: {position: {x: .inf, y: 0, z: 0}, orientation: {x: 0, y: 0, z: 0, w: 1}}}}", "finite"),
    ],
)
def test_hostile_yaml_is_one_line(franka, tmp_path, text, said):
    (tmp_path / "bad.yaml").write_text(text)
    refused(tmp_path / "bad.yaml", franka, said)


def test_a_joint_of_its_own_in_every_grasp_makes_no_endless_table(franka, tmp_path):
    pose = "position: [0, 0, 0], orientation: {w: 1, xyz: [0, 0, 0]}"
    entries = "".join(f"  g{i}: {{{pose}, cspace_position: {{j{i}: 0}}}}\n" for i in range(2000))
    (tmp_path / "bad.yaml").write_text(ISAAC + "\n" + entries)
    refused(tmp_path / "bad.yaml", franka, "names 2000 joints")


def moveit(**changes: Any) -> str:
    """A message with other values."""
    pose = {"position": {"x": 0, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    message = {"grasp_pose": {"header": {"frame_id": "world"}, "pose": pose}, "grasp_quality": 1.0}
    return json.dumps(message | changes)  # JSON is YAML


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (moveit(grasp_quality=float("nan")).replace("NaN", ".nan"), "'grasp_quality' is not finite"),
        (moveit(grasp_posture={"joint_names": ["a", "b"], "points": [{"positions": [1]}]}), "1 positions, expected 2"),
        (moveit(grasp_posture={"joint_names": ["a"], "points": [{}]}), "KeyError: 'positions'"),
        (moveit(pre_grasp_approach={"desired_distance": 0.1}), "KeyError: 'direction'"),
        (moveit(pre_grasp_approach=7), "message 0 is malformed"),
        (f"[{moveit()}, {moveit().replace('world', 'camera')}]", "several frames, 'camera' and 'world'"),
        (f"[{moveit()}, 7]", "holds no grasps"),
    ],
)
def test_mistyped_messages_are_one_line(franka, tmp_path, text, said):
    (tmp_path / "bad.yaml").write_text(text)
    refused(tmp_path / "bad.yaml", franka, said)


EYE = np.eye(4).tolist()
MIRROR = np.diag([1, 1, -1, 1]).tolist()


@pytest.mark.parametrize(
    ("document", "said"),
    [
        ([], "TypeError"),
        ({}, "KeyError: 'grasps'"),
        ({"grasps": {"transforms": [EYE]}}, "KeyError: 'object_in_gripper'"),
        ({"grasps": {"transforms": [EYE], "object_in_gripper": [True, True]}}, "0 or 1 for each of 1 grasps"),
        ({"grasps": {"transforms": [EYE], "object_in_gripper": [2]}}, "other than 0 and 1"),
        ({"grasps": {"transforms": EYE, "object_in_gripper": [1] * 4}}, r"expected numbers of \(n, 4, 4\)"),
        ({"grasps": {"transforms": [EYE, [1]], "object_in_gripper": [1, 1]}}, "inhomogeneous"),
        ({"grasps": {"transforms": [[["1"] * 4] * 4], "object_in_gripper": [1]}}, "expected numbers"),
        ({"grasps": {"transforms": [[[10**400] * 4] * 4], "object_in_gripper": [1]}}, "holds object"),
        ({"grasps": {"transforms": [MIRROR], "object_in_gripper": [1]}}, "grasp 0 is no pose"),
        (
            {"grasps": {"transforms": [EYE, np.full((4, 4), np.nan).tolist()], "object_in_gripper": [1, 1]}},
            "grasp 1 is",
        ),
        ({"grasps": {"transforms": [np.full((4, 4), 1e200).tolist()], "object_in_gripper": [1]}}, "no pose"),
        ({"grasps": {"transforms": [EYE], "object_in_gripper": [1]}, "graspmatch": {}}, "KeyError"),
    ],
)
def test_mistyped_json_is_one_line(franka, tmp_path, document, said):
    (tmp_path / "bad.json").write_text(json.dumps(document))
    refused(tmp_path / "bad.json", franka, said)


@pytest.mark.parametrize("text", ["[" * 3_000_000, '{"a":' * 1_000_000, "", "nul", NINES, '{"grasps": ' + NINES + "}"])
def test_hostile_json_is_one_line(franka, tmp_path, text):
    (tmp_path / "bad.json").write_text(text)
    refused(tmp_path / "bad.json", franka)


def acronym(path: Path) -> Any:
    """An open file with one good grasp."""
    file: Any = h5py.File(path, "w")
    file["grasps/transforms"] = np.eye(4)[None]
    file["grasps/qualities/flex/object_in_gripper"] = np.array([1])
    return file


def huge(file: Any) -> None:
    file.create_dataset("grasps/transforms", shape=(10**11, 4, 4), dtype="f8", chunks=(1024, 4, 4), compression="gzip")


def elsewhere(file: Any) -> None:
    file["grasps/transforms"] = h5py.ExternalLink("/etc/other.h5", "/data")


def around(file: Any) -> None:
    file["grasps/transforms"] = h5py.SoftLink("/grasps/transforms")


def raw_bytes_of_another_file(file: Any) -> None:
    file.create_dataset("grasps/transforms", shape=(1, 4, 4), dtype="f8", external=[("/etc/passwd", 0, 128)])


def put_together(file: Any) -> None:
    layout = h5py.VirtualLayout(shape=(1, 4, 4), dtype="f8")
    layout[:] = h5py.VirtualSource("/etc/other.h5", "data", shape=(1, 4, 4))
    file.create_virtual_dataset("grasps/transforms", layout)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda file: None, "there is no 'grasps/transforms'"),
        (huge, "larger than 256 MiB"),
        (elsewhere, "a link to another place"),
        (around, "a link to another place"),
        (raw_bytes_of_another_file, "no data of its own"),
        (put_together, "no data of its own"),
        (lambda file: file.create_group("grasps/transforms"), "no data of its own"),
        (lambda file: file.create_dataset("grasps/transforms", data=h5py.Empty("f8")), "is empty"),
        (lambda file: file.create_dataset("grasps/transforms", data="words"), "expected numbers"),
        (lambda file: file.create_dataset("grasps/transforms", data=np.eye(4)), r"expected numbers of \(n, 4, 4\)"),
        (lambda file: file.create_dataset("grasps/transforms", data=np.full((1, 4, 4), np.nan)), "no pose"),
        (lambda file: file.create_dataset("grasps/transforms", data=np.stack([np.eye(4)] * 2)), "for each of 2 grasps"),
        (
            lambda file: (file.__setitem__("grasps/transforms", np.eye(4)[None]), file.create_group("gripper/type")),
            "no data of its own",
        ),
    ],
)
def test_mistyped_and_hostile_hdf5_is_one_line(franka, tmp_path, make, said):
    with acronym(tmp_path / "bad.h5") as file:
        del file["grasps/transforms"]
        make(file)
    refused(tmp_path / "bad.h5", franka, said)


def npz_with(good: dict[str, bytes], path: Path, **changes: Any) -> None:
    """A good file with other arrays."""
    with np.load(io.BytesIO(good[".npz"])) as file:
        contents: dict[str, Any] = dict(file) | changes
    np.savez(path, **contents)


def test_mistyped_npz_is_one_line(good, franka, tmp_path):
    bad = tmp_path / "bad.npz"
    npz_with(good, bad, T_world_gripper=np.full((3, 4, 4), np.nan))
    refused(bad, franka, "'T_world_gripper' of grasp 0 is no pose")
    npz_with(good, bad, score=np.array([{}, {}, {}]))
    refused(bad, franka, "Object arrays cannot be loaded")
    npz_with(good, bad, grasp_joints=np.full((3, 1), np.inf))
    refused(bad, franka, "infinite")
    npz_with(good, bad, preshape=np.array([0, 1, 99]))
    refused(bad, franka, "a preshape has no name")
    npz_with(good, bad, header=np.array("[" * 100_000))
    refused(bad, franka, "RecursionError")
    for change in ({"joint_names": "ab"}, {"provenance": {}}, {"tally": 3}):
        with np.load(io.BytesIO(good[".npz"])) as file:
            header = json.loads(str(file["header"])) | change
        npz_with(good, bad, header=np.array(json.dumps(header)))
        refused(bad, franka)


def test_a_zip_bomb_is_not_unpacked(good, franka, tmp_path):
    archive = zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED)
    with archive, archive.open("score.npy", "w", force_zip64=True) as member:
        for _ in range(260):
            member.write(bytes(2**20))
    assert (tmp_path / "bomb.npz").stat().st_size < 2**20
    refused(tmp_path / "bomb.npz", franka, "would unpack to 260 MiB")


def test_rows_that_are_promised_but_not_there_take_no_memory(franka, tmp_path):
    with (tmp_path / "bad.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (10**13, 17)})
        file.write(bytes(1000))
    refused(tmp_path / "bad.npy", franka, r"no \.npy file of numbers")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_that_is_too_large_is_not_read(franka, tmp_path, suffix):
    with (tmp_path / f"large{suffix}").open("wb") as file:
        file.truncate(2**30)  # takes no room on the disk
    refused(tmp_path / f"large{suffix}", franka, "has 1024 MiB")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_no_file_is_refused(franka, tmp_path, suffix):
    refused(tmp_path / f"missing{suffix}", franka, "No such file")
    (tmp_path / f"folder{suffix}").mkdir()
    refused(tmp_path / f"folder{suffix}", franka, "not a file")
    os.mkfifo(tmp_path / f"pipe{suffix}")  # to read it would wait for ever
    refused(tmp_path / f"pipe{suffix}", franka, "not a file")
    (tmp_path / f"empty{suffix}").touch()
    refused(tmp_path / f"empty{suffix}", franka)


@pytest.mark.parametrize("content", [".npz", ".npy", ".h5"])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_wrong_suffix_is_told_by_the_content(good, franka, tmp_path, content, suffix):
    if content == suffix:
        return
    (tmp_path / f"grasps{suffix}").write_bytes(good[content])
    message = refused(tmp_path / f"grasps{suffix}", franka)
    assert message.endswith(f"its content is that of a {content} file.")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_text_under_the_name_of_another_format_is_refused(good, franka, tmp_path, suffix):
    for content in (".yaml", ".json"):
        if content != suffix and not (content == ".yaml" and suffix == ".moveit.yaml"):  # YAML says what it is
            (tmp_path / f"grasps{suffix}").write_bytes(good[content])
            refused(tmp_path / f"grasps{suffix}", franka)


def test_an_unknown_suffix_lists_all_that_are_known(franka, tmp_path):
    (tmp_path / "grasps.txt").touch()
    message = refused(tmp_path / "grasps.txt", franka)
    assert all(suffix in message for suffix in SUFFIXES)
    with pytest.raises(GraspmatchError, match=r"\.h5, \.json"):
        writer_of(Path("grasps.pkl"))


@pytest.mark.parametrize("suffix", SUFFIXES)
@given(data=st.data())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damage_anywhere_is_refused_or_harmless(good, franka, tmp_path, suffix, data):
    whole = bytearray(good[suffix])
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(whole) - 1))
        whole[at : at + data.draw(st.integers(0, 30))] = data.draw(st.binary(max_size=10))
    path = tmp_path / f"damaged{suffix}"
    path.write_bytes(whole)
    grasps, message = outcome(path, franka)
    assert grasps is not None or (path.name in message and "\n" not in message)
    assert grasps is None or np.isfinite(grasps.T_world_gripper).all()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_cut_is_refused_or_fewer_grasps(good, franka, tmp_path, suffix):
    whole = good[suffix]
    for length in np.linspace(0, len(whole) - 40, 25).astype(int):
        (tmp_path / f"cut{suffix}").write_bytes(whole[:length])
        if suffix.endswith(".yaml"):  # cut between two entries it is still YAML
            grasps, message = outcome(tmp_path / f"cut{suffix}", franka)
            assert f"cut{suffix}" in message or (grasps is not None and len(grasps) <= 3 * length / len(whole) + 1)
        else:
            refused(tmp_path / f"cut{suffix}", franka)
