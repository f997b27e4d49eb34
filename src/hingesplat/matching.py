"""Which point of one set belongs to which of another: the nearest ones, and matches one to one."""

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from torch import Tensor

ROWS = 4096
"""Points whose distances to all others are held at once, off the CPU."""


@torch.no_grad()
def nearest(points: Tensor, among: Tensor, k: int = 1) -> tuple[Tensor, Tensor]:
    """Distances (n, k) and rows (n, k) of the ``k`` points of ``among`` (m, 3) nearest to each of ``points`` (n, 3).

    The nearest first, k ≤ m; without gradients. A k-d tree on the CPU; elsewhere all distances, so that nothing
    leaves the device.
    """
    if points.device.type != "cpu":
        exact = "donot_use_mm_for_euclid_dist"
        found = [torch.cdist(some, among, compute_mode=exact).topk(k, largest=False) for some in points.split(ROWS)]
        return torch.cat([f.values for f in found]), torch.cat([f.indices for f in found])
    found = KDTree(among.detach().numpy()).query(points.detach().numpy(), k)
    distance, index = (torch.from_numpy(np.asarray(x)).reshape(len(points), k) for x in found)
    return distance.to(points), index


def one_to_one(
    points: np.ndarray, other: np.ndarray, limit: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (m,) of ``points`` (n, 3) and of ``other`` (k, 3) that the cheapest assignment pairs (Hungarian).

    Drawn from at most ``limit`` of each: the assignment is cubic in that number.
    """
    rows = rng.permutation(len(points))[:limit]
    columns = rng.permutation(len(other))[:limit]
    i, j = linear_sum_assignment(cdist(points[rows], other[columns]))
    return rows[i], columns[j]
