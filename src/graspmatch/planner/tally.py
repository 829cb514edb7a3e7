"""Counting candidates: how many each stage began with, and how many it dropped for which reason."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from graspmatch.planner.candidates import Candidates
from graspmatch.planner.recording import Recording


class Tally:
    """Reasons and counts, in the order in which they came up."""

    def __init__(self, candidates: int, recording: Recording | None = None) -> None:
        self.counts: dict[str, int] = {"candidates": candidates}
        self.recording = recording

    def keep(
        self,
        mask: Bool[np.ndarray, "n"],
        reason: str,
        among: Bool[np.ndarray, "n"] | None = None,
        *,
        of: Candidates | None = None,
    ) -> Bool[np.ndarray, "n"]:
        """The mask itself; those outside it (of those `among`) are counted under `reason`, and recorded if they are
        candidates of a plan that is."""
        dropped = ~mask if among is None else ~mask & among
        self.add(reason, int(np.sum(dropped)))
        if self.recording is not None and of is not None:
            self.recording.drop(reason, of.select(dropped))
        return mask

    def add(self, reason: str, count: int) -> None:
        """So many more are dropped for a reason."""
        self.counts[reason] = self.counts.get(reason, 0) + count
