"""Numbers in the text of an option."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from graspmatch.scene.camera_file import pose_of_numbers, read_pose


def numbers_of(text: str) -> Float[np.ndarray, "n"] | None:
    """The numbers of a text such as 1,2.5,3; None if it is something else."""
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        return None
    return np.array(values) if len(values) > 1 else None


def read_pose_text(text: str) -> Float[np.ndarray, "4 4"]:
    """A pose as x,y,z,qw,qx,qy,qz, or that of a file."""
    numbers = numbers_of(text)
    return read_pose(text) if numbers is None else pose_of_numbers(numbers)
