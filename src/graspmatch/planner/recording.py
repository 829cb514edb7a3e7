"""What a plan went through, for those who want to look: every particle at every iteration, and who was dropped why."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from graspmatch.planner.candidates import Candidates

Array = np.ndarray


class Recording:
    """Filled by `plan(..., recording=...)`; the grasps are the same with and without."""

    def __init__(self) -> None:
        self.dropped: dict[str, list[Candidates]] = {}
        """By reason, as in the tally."""
        self._moments: list[list[Candidates]] = []
        self._moment = 0

    def start(self) -> None:
        """The next are the particles of another batch."""
        self._moment = 0

    def watch(self, particles: Candidates) -> None:
        """The particles of this batch as they are now."""
        if self._moment == len(self._moments):
            self._moments.append([])
        self._moments[self._moment].append(Candidates(particles.preshape, particles.T_world_gripper))
        self._moment += 1

    def drop(self, reason: str, candidates: Candidates) -> None:
        """These are out."""
        self.dropped.setdefault(reason, []).append(Candidates(candidates.preshape, candidates.T_world_gripper))

    def particles(self) -> tuple[Int[Array, "n"], Float[Array, "k n 4 4"]]:
        """Preshapes and `T_world_gripper` of all batches: as they start, after each iteration, and their answers."""
        if not self._moments:
            return np.zeros(0, dtype=int), np.zeros((0, 0, 4, 4))
        preshape = np.concatenate([batch.preshape for batch in self._moments[0]])
        return preshape, np.stack([np.concatenate([b.T_world_gripper for b in moment]) for moment in self._moments])

    def dropped_poses(self, reason: str) -> tuple[Int[Array, "n"], Float[Array, "n 4 4"]]:
        """Preshapes and `T_world_gripper` of those that were dropped for a reason, where they were then."""
        parts = self.dropped.get(reason, [])
        if not parts:
            return np.zeros(0, dtype=int), np.zeros((0, 4, 4))
        return np.concatenate([p.preshape for p in parts]), np.concatenate([p.T_world_gripper for p in parts])
