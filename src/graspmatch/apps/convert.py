"""`graspmatch convert`: the grasps of a file in another format, and what became of what that one cannot say."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from graspmatch.apps.grasp_file import named_hand
from graspmatch.apps.options import Convert
from graspmatch.apps.speech import Speech
from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import check_place
from graspmatch.formats.registry import read_grasps, suffix_of, write_grasps, writer_of
from graspmatch.gripper.load import load_gripper
from graspmatch.types import GraspSet, Gripper


def convert(command: Convert, say: Speech) -> int:
    """Read, write, say what was done; the result is the exit status."""
    writer_of(command.output)
    check_place(command.output)
    gripper = None if command.gripper is None else _load(command.gripper, command.description, say)
    with say.progress(f"Reading {command.input.name}"):
        grasps = read_grasps(command.input, gripper, frame=command.frame)
    notes = []
    if gripper is not None:
        grasps, notes = _for_hand(grasps, gripper, command.input)
    elif suffix_of(command.output) != ".npz":
        gripper = _load(named_hand(grasps, command.input), command.description, say)
    notes += _losses(grasps, command.output)
    with say.progress(f"Writing {command.output.name}"):
        write_grasps(grasps, command.output, gripper)
    for note in notes:
        say.show(f"Note: {note}")
    say.show(f"Wrote {len(grasps)} grasp{'s' * (len(grasps) != 1)} to {command.output}")
    if say.as_json:
        record = {
            "input": str(command.input),
            "output": str(command.output),
            "gripper": grasps.provenance.gripper,
            "grasps": len(grasps),
            "notes": notes,
        }
        print(json.dumps(record))
    return 0


def _load(name: str, description: Path | None, say: Speech) -> Gripper:
    with say.progress(f"Loading {name} (the first time, its preshapes are computed)"):
        return load_gripper(name, description=description)


def _for_hand(grasps: GraspSet, gripper: Gripper, path: Path) -> tuple[GraspSet, list[str]]:
    """The grasps as those of the given hand, and a note where the file has another name for it."""
    named = grasps.provenance.gripper
    if named == gripper.name:
        return grasps, []
    if grasps.provenance.version:  # our own files name hands as cards do
        raise GraspmatchError(f"{path} is for {named}, not for {gripper.name}.")
    note = (
        f"the poses in {path.name} are of '{named}'; they are taken as those of "
        f"'{gripper.base_link}' of {gripper.name}."
    )
    return replace(grasps, provenance=replace(grasps.provenance, gripper=gripper.name)), [note]


def _losses(grasps: GraspSet, path: Path) -> list[str]:
    """What the format cannot say, or the file does not know."""
    if suffix_of(path) == ".npy":
        return ["GraspNet's rows hold poses, scores and widths; joint values and everything else stay behind."]
    if len(grasps) and np.isnan(grasps.grasp_joints).any():
        return ["joint values at the grasp are not known to the file, and are missing in what was written."]
    return []
