"""Ranking by confidence, and keeping the results apart."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from graspmatch.config import RankingConfig
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.tally import Tally


def rank(
    candidates: Candidates, worth: Float[np.ndarray, "n"], config: RankingConfig, tally: Tally, reason: str
) -> Int[np.ndarray, "k"]:
    """Indices of the best distinct candidates, the worthiest first; the others but for doubles are dropped for a
    reason."""
    order = np.lexsort((np.arange(len(candidates)), -worth))
    kept: list[int] = []
    double = np.zeros(len(candidates), dtype=bool)
    for index in order:
        if len(kept) == config.count:
            break
        if is_double(candidates, int(index), kept, config):
            double[index] = True
        else:
            kept.append(int(index))
    tally.keep(~double, "much like a better one", of=candidates)
    tally.keep(np.isin(np.arange(len(candidates)), kept), reason, among=~double, of=candidates)
    return np.array(kept, dtype=int)


def is_double(candidates: Candidates, index: int, kept: list[int], config: RankingConfig) -> bool:
    """Whether a candidate of the same preshape is near in position and rotation to one already kept."""
    T = candidates.T_world_gripper
    apart = np.linalg.norm(T[kept, :3, 3] - T[index, :3, 3], axis=-1)
    cosine = (np.einsum("kij,ij->k", T[kept, :3, :3], T[index, :3, :3]) - 1) / 2
    angle = np.arccos(np.clip(cosine, -1, 1))
    same = candidates.preshape[kept] == candidates.preshape[index]
    return bool(np.any(same & (apart < config.distinct_distance) & (angle < config.distinct_angle)))
