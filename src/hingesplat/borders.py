"""Where a part ends: what looks the same whether it moves or stays goes with what it hangs together with.

A lever's hub is round about its axis, a door turns little at its hinge, and a drawer's side slides along itself. To
stay is the cheaper claim there, so parts ended too early. Between what must stay and what must move the border runs
where the least of a surface is cut, and rather between two colours than within one: a minimum cut.
"""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import block_array, coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from hingesplat.labelling import Labelling, Whereabouts, of_one_mind
from hingesplat.screw import slide_of
from hingesplat.surface import Labels

STAYS = {"revolute": 0.4, "prismatic": 0.3}
"""A point that costs so much more moved than where it is must stay."""
PLACE = 0.02
"""Extents between points of two states that stand in the same place."""
FINE = 1000
"""Weights are whole numbers of this fraction."""


def bordered(T_1_0: Sequence[np.ndarray], owned: Labels, problem: Labelling, told: Whereabouts) -> Labels:
    """Labels in which every part has of the base what hangs together with it more than with what must stay.

    Args:
        T_1_0: (4, 4) motion of each part from state 0 to state 1.
        owned: label of each point, 0 for the base.
        told: ``whereabouts_under`` these motions: what nobody would see arrive is not asked about.
    """
    links, owner = _links(problem), np.concatenate(owned)
    costs = np.concatenate(problem.costs(T_1_0, far_cost=0.0))
    labels = owner.copy()
    for k, T in enumerate(T_1_0, 1):
        lost = np.concatenate([told[s][k - 1][1] for s in (0, 1)])
        worse = costs[:, k] - costs[:, 0]
        kind = "revolute" if slide_of([T]) is None else "prismatic"
        # Of a bar that slides along itself few points, its ends, know; of a hub none, but noise.
        if kind == "revolute":
            worse = of_one_mind(worse[:, None], links)[:, 0]
        stays = (owner == 0) & (worse >= STAYS[kind])
        loose = np.flatnonzero((owner == 0) & ~lost & ~stays)
        labels[loose[_cut(links, loose, stays, owner == k)]] = k
    first, second = np.split(labels, [len(owned[0])])
    return first, second


def _links(problem: Labelling) -> csr_matrix:
    """(n, n) symmetric weights between neighbours of both states' points, and between those in the same place."""
    first, second = problem.surfaces
    near = np.asarray(problem.trees[1].query(first.points, distance_upper_bound=PLACE * problem.extent)[1])
    met = np.flatnonzero(near < len(second.points))
    apart = np.linalg.norm(first.colours[met] - second.colours[near[met]], axis=1)
    shape = len(first.points), len(second.points)
    across = coo_matrix((np.exp(-((apart / 0.3) ** 2)), (met, near[met])), shape=shape)
    w0, w1 = problem.weights
    return csr_matrix(block_array([[w0 + w0.T, across], [across.T, w1 + w1.T]]))


def _cut(links: csr_matrix, loose: np.ndarray, base: np.ndarray, part: np.ndarray) -> np.ndarray:
    """(m,) bool: those of the loose rows on the part's side of the least cut between a part and a base, (n,) bool.

    Of several that are the least, the one that leaves most to the base.
    """
    count, mine = len(loose), links[loose]
    inner = mine[:, loose].tocoo()
    source, sink, each = count, count + 1, np.arange(count)
    row = np.concatenate([inner.row, np.full(count, source), each])
    column = np.concatenate([inner.col, each, np.full(count, sink)])
    weight = np.concatenate([inner.data, mine @ base.astype(float), mine @ part.astype(float)])
    capacity = csr_matrix((np.round(FINE * weight).astype(np.int32), (row, column)), shape=(count + 2,) * 2)
    left = capacity - maximum_flow(capacity, source, sink).flow
    left.eliminate_zeros()
    # Who can still be drained into the part is the part's.
    side = np.zeros(count + 2, bool)
    side[breadth_first_order(left.T.tocsr(), sink, return_predecessors=False)] = True
    return side[:count]
