"""Which motion each surface point of two states follows, and which motions are worth having.

A point's cost under a motion is what the other state's photographs say of the place where the motion takes it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, identity
from scipy.spatial import KDTree

from hingesplat.se3 import moved
from hingesplat.surface import Labels, Surface, free_share
from hingesplat.visibility import COLOUR, SURFACE, Sight, ask

ARRIVED = 4
"""Views that must see a surface where a motion takes a point, for the point to have been seen there."""
UNEXPLAINED = 0.35
"""What a point costs at most when motions are chosen: a little more than one that a motion hides."""
HIDDEN_SEED_COST = 0.4
"""Cost of a seed that a motion takes out of everybody's sight."""


def label_costs(
    surface: Surface,
    other: Sight,
    transforms: Sequence[np.ndarray],
    *,
    extent: float,
    hidden_cost: float = 0.25,
    far_cost: float = 0.3,
) -> np.ndarray:
    """(n, 1 + transforms) cost of each label for each surface point, from the other state's photographs alone.

    Label 0 is to stay; label k + 1 is to move by ``transforms[k]``, 4×4 from the surface's state to the other.
    """
    columns = []
    for T in [None, *transforms]:
        points = surface.points if T is None else moved(surface.points, T)
        answer = ask(points, surface.colours, other)
        # A point a little in front of its surface floats in some photographs of its own state, too.
        contradiction = np.clip((free_share(answer) - surface.free_at_home - 0.02) / 0.2, 0, 1)
        # Every surface is hidden from most sides: a few views that see it there are enough.
        arrived = np.clip(answer[:, SURFACE] / ARRIVED, 0, 1)
        colour = np.clip((answer[:, COLOUR] - 0.05) / 0.5, 0, 1)
        # To move is a claim: it costs a little, and to be recognised far away costs more.
        way = np.linalg.norm(points - surface.points, axis=1) / extent
        claim = 0.0 if T is None else 0.05 + far_cost * way * arrived
        columns.append(contradiction + arrived * 0.5 * colour + (1 - arrived) * hidden_cost + claim)
    return np.stack(columns, 1)


def seed_costs(
    seeds: Surface, other: Sight, transforms: Sequence[np.ndarray], extent: float, far_cost: float = 0.3
) -> np.ndarray:
    """(n, transforms) cost of each motion for each seed. Here hidden is worse than seen: a seed must go somewhere."""
    return label_costs(seeds, other, transforms, extent=extent, hidden_cost=HIDDEN_SEED_COST, far_cost=far_cost)[:, 1:]


def neighbour_weights(points: np.ndarray, colours: np.ndarray, radius: float, k: int = 12) -> csr_matrix:
    """(n, n) sparse weights of the k nearest points, less for distance and for another colour."""
    n = len(points)
    k = min(k, n - 1)
    distance, index = map(np.asarray, KDTree(points).query(points, k + 1))
    row = np.repeat(np.arange(n), k)
    column = index[:, 1:].ravel()
    difference = np.linalg.norm(colours[row] - colours[column], axis=1)
    weight = np.exp(-((distance[:, 1:].ravel() / radius) ** 2)) * np.exp(-((difference / 0.3) ** 2))
    return csr_matrix((weight, (row, column)), shape=(n, n))


@dataclass(frozen=True)
class Labelling:
    """The labelling problem of both states' surface points: mean field over labels, description length over motions."""

    surfaces: tuple[Surface, Surface]
    weights: tuple[csr_matrix, csr_matrix]
    trees: tuple[KDTree, KDTree]
    extent: float
    smoothness: float = 0.25
    consistency: float = 0.6

    @staticmethod
    def of(surfaces: tuple[Surface, Surface], extent: float) -> "Labelling":
        w0, w1 = (neighbour_weights(s.points, s.colours, 0.025 * extent) for s in surfaces)
        return Labelling(surfaces, (w0, w1), (KDTree(surfaces[0].points), KDTree(surfaces[1].points)), extent)

    def costs(self, T_1_0: Sequence[np.ndarray]) -> list[np.ndarray]:
        """``label_costs`` of both states' points."""
        a, b = self.surfaces
        inverse = [np.linalg.inv(T) for T in T_1_0]
        return [
            label_costs(a, b.sight, T_1_0, extent=self.extent),
            label_costs(b, a.sight, inverse, extent=self.extent),
        ]

    def partners(self, T_1_0: Sequence[np.ndarray]) -> list[np.ndarray]:
        """(n_s, 1 + motions): the other state's point with which each point coincides under each label, or −1."""
        result = []
        for s in (0, 1):
            columns = []
            for T in [np.eye(4), *T_1_0]:
                carried = moved(self.surfaces[s].points, T if s == 0 else np.linalg.inv(T))
                distance, index = map(np.asarray, self.trees[1 - s].query(carried))
                columns.append(np.where(distance < 0.025 * self.extent, index, -1))
            result.append(np.stack(columns, 1))
        return result

    def mean_field(
        self, costs: list[np.ndarray], partners: list[np.ndarray], iterations: int = 20
    ) -> tuple[Labels, float]:
        """Labels of both states and the energy they cost.

        A point hears its own costs, its neighbours, and the point of the other state it would coincide with under
        each label: if k carries me there, the one who lives there should be k, too.
        """
        q = [softmax(-c / 0.1) for c in costs]
        label = np.arange(costs[0].shape[1])
        energy = 0.0
        for iteration in range(iterations):
            temperature = 0.15 - 0.1 * iteration / iterations
            updated, energy = [], 0.0
            for s in (0, 1):
                support = self.smoothness * (self.weights[s] @ q[s])
                partner = q[1 - s][np.maximum(partners[s], 0), label]
                meeting = self.consistency * np.where(partners[s] >= 0, partner, 0.3)
                total = costs[s] - support - meeting
                updated.append(softmax(-total / temperature))
                # Each edge is heard from both its ends, so pairs count half.
                energy += float((updated[s] * (costs[s] - 0.5 * support - 0.5 * meeting)).sum())
            q = updated
        return (q[0].argmax(1), q[1].argmax(1)), energy

    def smoothed(self, T_1_0: Sequence[np.ndarray]) -> np.ndarray:
        """(points of both states, 1 + motions) costs, each the mean over a point and its neighbours.

        A point that a motion brings onto a surface asks that surface, too, how much it would rather be another's.
        None costs more than ``UNEXPLAINED``: else a motion would pay that only takes what nothing explains out of
        sight.
        """
        costs, partners = self.costs(T_1_0), self.partners(T_1_0)
        result = []
        for s in (0, 1):
            regret = costs[1 - s] - costs[1 - s].min(1, keepdims=True)
            there = np.take_along_axis(regret, np.maximum(partners[s], 0), 0)
            both = np.minimum(costs[s] + np.where(partners[s] >= 0, 0.5 * there, 0), UNEXPLAINED)
            average = self.weights[s] + identity(len(both))
            average = average.multiply(1 / average.sum(1)).tocsr()
            result.append(average @ (average @ both))
        return np.concatenate(result)

    def labels(self, T_1_0: Sequence[np.ndarray]) -> Labels:
        """Labels of both states' points under these motions, all of which stay."""
        return self.mean_field(self.costs(T_1_0), self.partners(T_1_0))[0]

    def solve(self, T_1_0: Sequence[np.ndarray], part_cost: float, parts: int | None) -> tuple[list[int], Labels]:
        """Drop motions one by one as long as doing without costs less than a part.

        Returns:
            The indices of the motions that stay, and labels that count them from 1.
        """
        costs, partners = self.costs(T_1_0), self.partners(T_1_0)
        columns = list(range(len(T_1_0) + 1))

        def run(keep: list[int], iterations: int) -> tuple[Labels, float]:
            return self.mean_field([c[:, keep] for c in costs], [p[:, keep] for p in partners], iterations)

        while len(columns) > 1 and (parts is None or len(columns) - 1 > parts):
            energy = run(columns, 8)[1]
            trials = {k: run([c for c in columns if c != k], 8)[1] for k in columns[1:]}
            worst = min(trials, key=lambda k: trials[k])
            if parts is None and trials[worst] - energy > part_cost:
                break
            columns.remove(worst)
        return [k - 1 for k in columns[1:]], run(columns, 20)[0]


def eliminate(costs: np.ndarray, price: float, parts: int | None) -> list[int]:
    """The fewest labels (columns) that explain the points (rows) at the least description length.

    All are there at first; the one that is missed least goes, until every one is worth its price or ``parts`` are
    left. Column 0, to stay, is free and stays. Two motions that are right together thus beat one that is nearly
    right for both, which a greedy choice would take first.
    """
    kept = list(range(costs.shape[1]))
    while len(kept) > 1 and (parts is None or len(kept) - 1 > parts):
        best = np.argpartition(costs[:, kept], 1, axis=1)
        first, second = (np.take_along_axis(costs[:, kept], best[:, [i]], 1)[:, 0] for i in (0, 1))
        missed = np.bincount(best[:, 0], second - first, minlength=len(kept))
        missed[0] = np.inf
        least = int(missed.argmin())
        if parts is None and missed[least] > price:
            break
        kept.pop(least)
    while True:  # Another one for one of these, as long as that explains more.
        trials = []
        for i in range(1, len(kept)):
            rest = costs[:, kept[:i] + kept[i + 1 :]].min(1)
            energy = np.minimum(costs, rest[:, None]).sum(0)
            trials.append((float(energy.min()), i, int(energy.argmin())))
        now = costs[:, kept].min(1).sum()
        if not trials or min(trials)[0] > now - 1:
            return kept[1:]
        _, i, better = min(trials)
        kept[i] = better


def softmax(x: np.ndarray) -> np.ndarray:
    e = np.exp(x - x.max(1, keepdims=True))
    return e / e.sum(1, keepdims=True)
