"""Counting candidates: how many each stage began with, and how many it dropped for which reason."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool


class Tally:
    """Reasons and counts, in the order in which they came up."""

    def __init__(self, candidates: int) -> None:
        self.counts: dict[str, int] = {"candidates": candidates}

    def keep(
        self, mask: Bool[np.ndarray, "n"], reason: str, among: Bool[np.ndarray, "n"] | None = None
    ) -> Bool[np.ndarray, "n"]:
        """The mask itself; those outside it (of those `among`) are counted under `reason`."""
        dropped = ~mask if among is None else ~mask & among
        self.add(reason, int(np.sum(dropped)))
        return mask

    def add(self, reason: str, count: int) -> None:
        """So many more are dropped for a reason."""
        self.counts[reason] = self.counts.get(reason, 0) + count
