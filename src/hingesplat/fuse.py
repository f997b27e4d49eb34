"""Motion-aware canonical Gaussians: the two states' Gaussians become one set (method, section 2).

Deviation: the paper averages centres of the two states where they stand, so a moving part's canonical shape lies
between its poses. We know a first motion of every part by now, so both states are first brought to state 0, and what
is fused is one surface seen twice.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from scipy.spatial import KDTree

from hingesplat.gaussians import Gaussians, concatenate, posed
from hingesplat.matching import one_to_one


@dataclass(frozen=True)
class FuseConfig:
    """Making one canonical set of two."""

    strategy: Literal["union", "none", "uniform", "per_part", "global"] = "union"
    """union: state 0, and what only state 1 shows. The others are the paper's table 6: state 0 alone, or matched
    pairs averaged with β = 1/2, a β a part, or one motion-aware β."""
    new_surface: float = 0.012
    """union: a Gaussian of state 1 is new if none of its part lies closer than this fraction of the extent."""
    matched: int = 2000
    """Gaussians of each state that are matched one to one (Hungarian, cubic in this number)."""


def motion_richness(points: np.ndarray, other: np.ndarray) -> float:
    """D_{t→1−t}: mean distance of points (n, 3) to their nearest of the other state (m, 3)."""
    return float(KDTree(other).query(points)[0].mean())


def fusion_weight(points0: np.ndarray, points1: np.ndarray) -> float:
    """β = D_{0→1} / (D_{0→1} + D_{1→0}), the weight of state 0; ½ where nothing moved."""
    d01, d10 = motion_richness(points0, points1), motion_richness(points1, points0)
    return d01 / (d01 + d10) if d01 + d10 > 0 else 0.5


def fuse(
    gaussians: tuple[Gaussians, Gaussians],
    labels: tuple[np.ndarray, np.ndarray],
    T_1_0: np.ndarray,
    config: FuseConfig,
    *,
    seed: int = 0,
) -> Gaussians:
    """Canonical Gaussians in the frame of state 0, each with its part.

    Args:
        labels: part id of every Gaussian of each state.
        T_1_0: (parts, 4, 4) motion of each part from state 0 to state 1; identity for the base.
    """
    first = gaussians[0].with_part(torch.from_numpy(labels[0]).long())
    second = gaussians[1].with_part(torch.from_numpy(labels[1]).long())
    degree = max(first.sh.shape[1], second.sh.shape[1])
    first, second = _padded(first, degree), _padded(second, degree)
    if config.strategy == "none":
        return first
    back = posed(second, {k: np.linalg.inv(T) for k, T in enumerate(T_1_0)})
    if config.strategy == "union":
        low, high = np.quantile(first.means.numpy(), [0.002, 0.998], axis=0)
        return concatenate([first, back[_new_surface(first, back, config.new_surface * float((high - low).max()))]])
    return _matched_average(first, second, back, config, seed)


def _padded(gaussians: Gaussians, coefficients: int) -> Gaussians:
    missing = coefficients - gaussians.sh.shape[1]
    zeros = gaussians.sh.new_zeros((len(gaussians), missing, 3))
    return replace(gaussians, sh=torch.cat([gaussians.sh, zeros], 1))


def _new_surface(first: Gaussians, back: Gaussians, radius: float) -> torch.Tensor:
    new = torch.ones(len(back), dtype=torch.bool)
    for part in back.part.unique():
        mine, known = back.part == part, first.means[first.part == part]
        if len(known):
            distance = KDTree(known.numpy()).query(back.means[mine].numpy())[0]
            new[mine] = torch.from_numpy(distance > radius)
    return new


def _matched_average(first: Gaussians, second: Gaussians, back: Gaussians, config: FuseConfig, seed: int) -> Gaussians:
    i, j = one_to_one(first.means.numpy(), back.means.numpy(), config.matched, np.random.default_rng(seed))
    same = (first.part[i] == back.part[j]).numpy()
    i, j = torch.from_numpy(i[same]), torch.from_numpy(j[same])
    beta = torch.full((int(first.part.max()) + 1,), 0.5)
    if config.strategy == "global":
        beta[:] = fusion_weight(first.means.numpy(), second.means.numpy())
    elif config.strategy == "per_part":
        for part in first.part.unique().tolist():
            a, b = first.means[first.part == part], second.means[second.part == part]
            if len(a) and len(b):
                beta[part] = fusion_weight(a.numpy(), b.numpy())
    canonical = first.detached()
    weight = beta[first.part[i]][:, None]
    canonical.means[i] = weight * first.means[i] + (1 - weight) * back.means[j]
    return canonical
