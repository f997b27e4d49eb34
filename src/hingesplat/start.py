"""Starts without a search, as the literature has them: clusters of what moved, or nothing but random numbers.

They need the number of parts. What they give has the shape of what ``segment`` finds: a part for every Gaussian of
both states, and a motion for every part.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from hingesplat.gaussians import Gaussians
from hingesplat.matching import one_to_one


@dataclass(frozen=True)
class StartConfig:
    """Where the joint optimisation starts from."""

    labels: Literal["search", "clusters", "random"] = "search"
    """search: parts found by ``segment``. clusters: those of ArtGS, moved Gaussians clustered. random: as in the paper,
    all Gaussians begin alike. The last two need ``parts``."""
    motions: Literal["search", "random"] = "search"
    """search: the motions that explain the seeds best. random: T_k drawn around the identity, as in the paper."""
    spread: float = 0.05
    """random: standard deviation of T_k, radians and extents; 0 starts at the identity."""
    static: float = 0.02
    """clusters: a Gaussian is static if its squared distance to the other state is below this share of the largest."""
    matched: int = 2000
    """clusters: Gaussians of each state that are matched one to one."""


def random_motions(parts: int, points: np.ndarray, spread: float, seed: int) -> np.ndarray:
    """T_1_0 (parts, 4, 4): small random turns about the middle of ``points`` (n, 3) and slides; the base stays."""
    rng = np.random.default_rng(seed)
    low, high = np.quantile(points, [0.002, 0.998], axis=0)
    centre = (low + high) / 2
    T = np.tile(np.eye(4), (parts, 1, 1))
    R = Rotation.from_rotvec(spread * rng.normal(size=(parts - 1, 3))).as_matrix()
    T[1:, :3, :3] = R
    T[1:, :3, 3] = centre - R @ centre + spread * (high - low).max() * rng.normal(size=(parts - 1, 3))
    return T


def clusters(
    gaussians: tuple[Gaussians, Gaussians], parts: int, config: StartConfig, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Labels (n,) of both states' Gaussians: what moved, in ``parts`` − 1 spectral clusters of matched pairs' middles.

    After ArtGS: Gaussians far from any of the other state have moved; pairs of a one-to-one match stand between the
    states, and each moved Gaussian takes the cluster of the nearest pair's end in its own state.
    """
    from sklearn.cluster import SpectralClustering  # Takes most of a second, and few ask for it.

    points = [g.means.numpy() for g in gaussians]
    squared = [KDTree(points[1 - s]).query(points[s])[0] ** 2 for s in (0, 1)]
    moving = [d > config.static * max(d.max() for d in squared) for d in squared]
    i, j = one_to_one(points[0], points[1], config.matched, np.random.default_rng(seed))
    far = moving[0][i] | moving[1][j]
    ends = points[0][i[far]], points[1][j[far]]
    labels = [np.zeros(len(p), int) for p in points]
    if far.sum() < 2 * parts:
        return labels[0], labels[1]
    of_pair = np.ones(len(ends[0]), int)
    if parts > 2:
        # In units of the pairs' spread, so that the kernel's width suits every object.
        middles = (ends[0] + ends[1]) / 2
        found = SpectralClustering(parts - 1, assign_labels="discretize", random_state=seed, gamma=10.0)
        of_pair += found.fit_predict((middles - middles.mean(0)) / middles.std())
    for s in (0, 1):
        labels[s][moving[s]] = of_pair[KDTree(ends[s]).query(points[s][moving[s]])[1]]
    return labels[0], labels[1]
