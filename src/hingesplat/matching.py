"""Which point of one state is which of the other: one-to-one matches of two point sets."""

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist


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
