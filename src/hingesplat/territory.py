"""Where a motion may have its part: one part is one piece.

What a door's motion takes out of sight costs less than what floats where it is, be it a rack that hangs far behind the
door. So the points that would rather follow a motion than stay are cut into connected pieces, its territories. A part
lies in one of them; every other that its motion takes costs as much as a part, or is left to others.
"""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from hingesplat.surface import Labels

REACH = 0.06
"""Extents between points of one state that hang together, at most."""
RATHER = 0.1
"""By how much a motion must cost a point less than to stay, for the point to lie in one of its territories."""
FOREIGN = -1
"""Number of a territory in which nothing says that the motion has been there."""
FEW = 5
"""Points that a motion may hold in a territory for nothing: to settle all labels anew for them takes twice as long."""
BARRED = 10.0
"""Cost of a label in a territory that is not its motion's."""


def links(trees: tuple[KDTree, KDTree], extent: float) -> np.ndarray:
    """(m, 2) rows, of both states' points one after the other, of those of a state that hang together."""
    first, second = (tree.query_pairs(REACH * extent, output_type="ndarray") for tree in trees)
    return np.concatenate([first, second + trees[0].n])


def territories(
    costs: Sequence[np.ndarray], partners: Sequence[np.ndarray], links: np.ndarray, may: float, least: float
) -> list[np.ndarray]:
    """(n_s, labels) int32 number of the territory of each label in which each point lies; 0: in none, or ``FOREIGN``.

    Points that a motion lays on each other hang together as well, and a few are no bridge. Where nothing meets, or
    hardly anything, is foreign, but for the best.

    Args:
        costs: (n_s, labels) of both states' points, the first label to stay.
        partners: (n_s, labels) the other state's point that a point meets under each label, or −1.
        links: as ``links`` gives them.
        may: cost below which a point may follow a motion.
        least: by how much, in sum, a motion must cost less than to stay those points of a territory that meet.
    """
    n, count = len(costs[0]), len(costs[0]) + len(costs[1])
    cost = np.concatenate(costs)
    partner = np.concatenate([np.where(partners[0] >= 0, partners[0] + n, -1), partners[1]])
    gain = cost[:, :1] - cost
    number = np.zeros(cost.shape, np.int32)
    for k in range(1, cost.shape[1]):
        follows = gain[:, k] > RATHER
        row, there = np.flatnonzero(follows), partner[follows, k]
        if len(row) == 0:
            continue
        met = (there >= 0) & (cost[there, k] < may)
        both = met & follows[there]
        edges = np.concatenate([links[follows[links].all(1)], np.stack([row[both], there[both]], 1)])
        edges = _without_bridges(edges, row)
        graph = coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
        piece = connected_components(graph, directed=False)[1]
        worth = np.bincount(piece[row[met]], gain[row[met], k], piece.max() + 1)
        own = worth > least
        own[worth.argmax()] = True
        number[row, k] = np.where(own, 1 + np.arange(len(own)), FOREIGN)[piece[row]]
    return np.split(number, [n])


def _without_bridges(edges: np.ndarray, row: np.ndarray) -> np.ndarray:
    """The edges (m, 2) without all but one of each of the rows that have less than half the usual number of them."""
    degree = np.bincount(edges.ravel(), minlength=row.max() + 1)
    dense = 2 * degree >= np.median(degree[row])
    ends = dense[edges]
    joins = edges[ends[:, 0] != ends[:, 1]]
    sparse = np.where(dense[joins[:, 0]], joins[:, 1], joins[:, 0])
    return np.concatenate([edges[ends.all(1)], joins[np.unique(sparse, return_index=True)[1]]])


def barred(costs: Sequence[np.ndarray], foreign: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The costs, (n_s, labels), with that of each label ``BARRED`` for a point where it is foreign, (n_s, labels)."""
    return [np.where(f, c + BARRED, c).astype(np.float32) for c, f in zip(costs, foreign, strict=True)]


def lead(costs: np.ndarray, label: int) -> np.ndarray:
    """(n,) by how much a label costs points less than the next best, costs being (n, labels)."""
    return np.delete(costs, label, axis=1).min(1) - costs[:, label]


def further(
    costs: Sequence[np.ndarray], number: Sequence[np.ndarray], labels: Labels, price: float
) -> tuple[int, list[np.ndarray]]:
    """Of the territories that labels hold beside their best: how many are worth a price, and which are not.

    A label gains in a territory what its points there would cost under the next best.

    Returns:
        That number, and (n_s, labels) bool: in a territory that is not worth its price.
    """
    worthy, away = 0, [np.zeros(n.shape, bool) for n in number]
    for k in range(1, costs[0].shape[1]):
        size = 1 + max(int(n[:, k].max(initial=0)) for n in number)
        gains, held = np.zeros(size), np.zeros(size, int)
        for cost, mine, label in zip(costs, number, labels, strict=True):
            own = np.flatnonzero((label == k) & (mine[:, k] > 0))
            gains += np.bincount(mine[own, k], np.maximum(lead(cost[own], k), 0), size)
            held += np.bincount(mine[own, k], minlength=size)
        # Of two motions that are the same neither gains anything: then it is the one that holds most.
        others = (held > FEW) & (np.arange(size) != (gains + 1e-6 * held).argmax())
        worthy += int((others & (gains >= price)).sum())
        left = others & (gains < price)
        for mine, out in zip(number, away, strict=True):
            out[:, k] = left[np.maximum(mine[:, k], 0)]
    return worthy, away


__all__ = ["barred", "further", "lead", "links", "territories"]
