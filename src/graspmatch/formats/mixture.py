"""A mixture of Gaussians over poses of the hand, as TOML: where hands start, if that is known.

[[gaussian]]
position = [0.4, 0.0, 0.3]     # m, gripper frame in the world
wxyz = [0.0, 1.0, 0.0, 0.0]
sigma_position = 0.02          # m; this and what follows may be left out
sigma_angle = 0.2              # rad
weight = 1.0
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from graspmatch.config import PoseGaussian
from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import one_line, read_text
from graspmatch.formats.native import quaternion_rotation
from graspmatch.geometry import se3

LENGTHS = {"position": 3, "wxyz": 4}
"""Keys with several numbers, which every Gaussian has."""


def read_mixture(path: Path) -> tuple[PoseGaussian, ...]:
    """The Gaussians of a file."""
    try:
        content = tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise GraspmatchError(f"{path} is not TOML: {one_line(error)}.") from error
    entries = content.get("gaussian")
    if not isinstance(entries, list) or not entries or set(content) != {"gaussian"}:
        raise GraspmatchError(f"{path} is no mixture of Gaussians: it must have tables [[gaussian]] and nothing else.")
    return tuple(_gaussian(entry, f"{path}: gaussian {i}") for i, entry in enumerate(entries))


def moved(
    gaussians: tuple[PoseGaussian, ...],
    T_world_file: Float[np.ndarray, "4 4"],
    T_file_gripper: Float[np.ndarray, "4 4"],
) -> tuple[PoseGaussian, ...]:
    """The same about poses T_world_file @ pose @ T_file_gripper."""
    result = []
    for gaussian in gaussians:
        T = se3.from_parts(se3.matrix_from_quaternion(np.array(gaussian.wxyz)), np.array(gaussian.position))
        T = T_world_file @ T @ T_file_gripper
        position, wxyz = T[:3, 3].tolist(), se3.quaternion_from_matrix(T[:3, :3]).tolist()
        result.append(replace(gaussian, position=tuple(position), wxyz=tuple(wxyz)))
    return tuple(result)


def _gaussian(entry: Any, place: str) -> PoseGaussian:
    known = {field.name for field in fields(PoseGaussian)}
    unknown = sorted(set(entry) - known) if isinstance(entry, dict) else [repr(entry)]
    missing = [key for key in LENGTHS if key not in entry] if not unknown else []
    if unknown or missing:
        wrong = f"has no '{missing[0]}'" if missing else f"has '{unknown[0]}'"
        raise GraspmatchError(f"{place} {wrong}. Known: {', '.join(sorted(known))}.")
    values: dict[str, Any] = {key: _numbers(entry[key], LENGTHS.get(key), f"{place}: '{key}'") for key in entry}
    try:
        quaternion_rotation(np.array(values["wxyz"]))
    except ValueError as error:
        raise GraspmatchError(f"{place}: {error}.") from error
    for key in ("sigma_position", "sigma_angle", "weight"):
        if values.get(key, 0.0) < 0:
            raise GraspmatchError(f"{place}: '{key}' is {values[key]:g}; it must not be negative.")
    length = math.hypot(*values["wxyz"])
    values["wxyz"] = tuple(value / length for value in values["wxyz"])
    return PoseGaussian(**values)


def _numbers(value: Any, length: int | None, place: str) -> float | tuple[float, ...]:
    """One finite number, or so many."""
    several = value if isinstance(value, list) else [value]
    is_number = [isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in several]
    if not all(is_number) or isinstance(value, list) != (length is not None) or len(several) != (length or 1):
        raise GraspmatchError(
            f"{place} is {value!r}; {length or 'one'} finite number{'s' * (length is not None)} expected."
        )
    numbers = tuple(float(v) for v in several)
    return numbers if length else numbers[0]
