"""Ranking by confidence, and keeping the results apart."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from graspmatch.config import RankingConfig
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.tally import Tally


def rank(
    candidates: Candidates, worth: Float[np.ndarray, "n"], config: RankingConfig, tally: Tally, reason: str
) -> Int[np.ndarray, "k"]:
    """Indices of the best distinct candidates, the worthiest first; the others but for doubles are dropped for a
    reason."""
    kept: list[int] = []
    alike, double = np.zeros((2, len(candidates)), dtype=bool)
    for index in np.argsort(-worth, kind="stable"):
        if len(kept) == config.count:
            break
        if alike[index]:
            double[index] = True
        else:
            kept.append(int(index))
            alike |= doubles(candidates, int(index), config)
    tally.keep(~double, "much like a better one", of=candidates)
    tally.keep(np.isin(np.arange(len(candidates)), kept), reason, among=~double, of=candidates)
    return np.array(kept, dtype=int)


def doubles(candidates: Candidates, index: int, config: RankingConfig) -> Bool[np.ndarray, "n"]:
    """Which candidates have the preshape of one of them and are near to it in position and rotation."""
    T = candidates.T_world_gripper
    apart = np.sum((T[:, :3, 3] - T[index, :3, 3]) ** 2, axis=-1)
    cosine = (T[:, :3, :3].reshape(-1, 9) @ T[index, :3, :3].ravel() - 1) / 2
    is_near = (apart < config.distinct_distance**2) & (cosine > np.cos(min(config.distinct_angle, np.pi)))
    return is_near & (candidates.preshape == candidates.preshape[index])
