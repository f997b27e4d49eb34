"""Slots for parts that turn out to be none: K is an upper bound, and what is left over dies (tables 4 and 13)."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from hingesplat.se3 import apart


@dataclass(frozen=True)
class SlotsConfig:
    """When a slot for a part is redundant."""

    min_share: float = 0.005
    """A slot with a smaller share of the Gaussians dies; they go to their neighbours' parts."""
    same_motion: float = 0.01
    """Two slots are one if they touch and take their points to places closer than this fraction of the extent;
    a slot that moves its points less than that is the base."""


def living_slots(
    points: np.ndarray, part: np.ndarray, T_state_0: np.ndarray, extent: float, config: SlotsConfig
) -> tuple[np.ndarray, list[int]]:
    """Labels after redundant slots have died, and the slots that live.

    Args:
        points: (n, 3), state 0.
        part: (n,) slot of each point.
        T_state_0: (states, slots, 4, 4) motions; slot 0 is the base and always lives.

    Returns:
        (n,) labels that count the living slots from 0, and their old numbers in that order.
    """
    label = part.copy()
    size = np.bincount(label, minlength=T_state_0.shape[1])
    dead = size < max(config.min_share * len(points), 1)
    dead[0] = False
    lost = dead[label]
    if lost.any():
        label[lost] = part[~lost][KDTree(points[~lost]).query(points[lost])[1]] if not lost.all() else 0
    for k in range(T_state_0.shape[1] - 1, 0, -1):
        mine = points[label == k]
        for j in range(k if len(mine) else 0):
            theirs = points[label == j]
            off = max(apart(mine, *pair) for pair in zip(T_state_0[:, k], T_state_0[:, j], strict=True))
            alike = off < config.same_motion * extent
            if alike and (j == 0 or _touch(mine, theirs, extent)):
                label[label == k] = j
                break
    living = [0, *(k for k in range(1, T_state_0.shape[1]) if (label == k).any())]
    return np.searchsorted(living, label), living


def _touch(points: np.ndarray, other: np.ndarray, extent: float) -> bool:
    return len(other) > 0 and float(KDTree(other).query(points)[0].min()) < 0.03 * extent
