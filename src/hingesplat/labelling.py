"""Which motion each surface point of two states follows, and which motions are worth having.

A point's cost under a motion is what the other state's photographs say of the place where the motion takes it.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree

from hingesplat.mean_field import mean_field
from hingesplat.se3 import moved
from hingesplat.surface import Labels, Surface, free_share
from hingesplat.territory import FOREIGN, barred, further, lead, links, territories
from hingesplat.visibility import COLOUR, SURFACE, Sight, ask

ARRIVED = 4
"""Views that must see a surface where a motion takes a point, for the point to have been seen there."""
HIDDEN_COST = 0.25
"""Cost of a point that a motion takes out of everybody's sight."""
HIDDEN_SEED_COST = 0.4
"""Cost of a seed that a motion takes out of everybody's sight."""
WORTH = 0.6
"""A motion is worth as much as it explains its seeds better than this."""
SLACK, CLEAR = 0.02, 0.2
"""Share of the views that may see a point in free space for nothing, and by how much more it is a contradiction."""
SAME, OTHER = 0.05, 0.5
"""RGB differences below which colours agree, and by how much more they are wholly different."""
HARDLY = 0.06
"""What one state shows of a part, beside what the other does, from which it says something of how much of it meets."""
NOBODY = 0.3
"""What a point without a partner in the other state hears from it, between a partner that disagrees (0) and one that
agrees (1)."""
UNMET = 0.5
"""What a point counts that a promising motion takes where the other state shows none."""
MAY, KNOWN_AGAIN = 0.45, 0.3
"""Costs below which a point may follow a motion, be it out of sight, and below which it is recognised there."""
TERRITORY, FURTHER = 20, 50
"""Points that a motion must gain in a territory of its own, and in every one beside the best, the price of a part."""
SMOOTHNESS = 0.25
"""What a neighbour of the same label is worth to a point. Where points are four times as dense it is half of that: a
wire rack between the walls behind it would be of their opinion."""
SAID = 0.2
"""What it is worth to a point to agree with what the thinned points said of its place: few points of a rack that a
slit shows were outvoted by what is round them, once there were more of all."""
AT_ONCE = 400_000
"""Places that photographs are asked about in one go."""
ADDED, EXCHANGED, PAIRED, SECOND = 10, 6, 8, 2
"""Motions that each round of a choice tries to add, to exchange for one that is there, and first and second of two."""


def label_costs(
    surface: Surface,
    other: Sight,
    transforms: Sequence[np.ndarray],
    *,
    extent: float,
    hidden_cost: float = HIDDEN_COST,
    covered_cost: float = 0.15,
    far_cost: float = 0.3,
) -> np.ndarray:
    """(n, 1 + transforms) cost of each label for each surface point, from the other state's photographs alone.

    Label 0 is to stay; label k + 1 is to move by ``transforms[k]``, 4×4 from the surface's state to the other. Who
    moves out of everybody's sight costs ``hidden_cost``; who stays and is covered by something that moves, less.
    """
    priced = _priced(surface, other, [None, *transforms], extent, hidden_cost, covered_cost, far_cost)
    return np.stack([cost for cost, _ in priced], 1)


def _priced(
    surface: Surface,
    other: Sight,
    labels: Sequence[np.ndarray | None],
    extent: float,
    hidden_cost: float,
    covered_cost: float,
    far_cost: float,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For each label, (4, 4) or None to stay, every point's cost (n,), and how surely it is seen to arrive, 0 … 1."""
    at_once = max(AT_ONCE // max(len(surface.points), 1), 1)
    for start in range(0, len(labels), at_once):
        some = labels[start : start + at_once]
        places, *told = _told(surface, other, some)
        for T, place, contradiction, arrived, colour in zip(some, places, *told, strict=True):
            # To move is a claim: it costs a little, and to be recognised far away costs more.
            claim = 0.0 if T is None else 0.05
            if T is not None and far_cost > 0:
                claim = claim + far_cost * arrived * np.linalg.norm(place - surface.points, axis=1) / extent
            unseen = covered_cost if T is None else hidden_cost
            yield contradiction + arrived * 0.5 * colour + (1 - arrived) * unseen + claim, arrived


def whereabouts(surface: Surface, other: Sight, T: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Points that may follow T (4, 4), since nobody in the other state sees through them there; those lost on the way.

    Returns:
        (n,) bool each. Who is lost may be there, but nobody sees it.
    """
    _, (contradiction,), (arrived,), _ = _told(surface, other, [T])
    may = contradiction < 0.1
    return may, may & (arrived < 0.3)


Whereabouts = tuple[list[np.ndarray], list[np.ndarray]]
"""For each state, of every motion: ``whereabouts`` of all its points, (2, n) bool."""


def whereabouts_under(T_1_0: Sequence[np.ndarray], surfaces: tuple[Surface, Surface]) -> Whereabouts:
    """Which points may follow each motion, and which of them are lost on the way."""
    first, second = surfaces
    return (
        [np.stack(whereabouts(first, second.sight, T)) for T in T_1_0],
        [np.stack(whereabouts(second, first.sight, np.linalg.inv(T))) for T in T_1_0],
    )


def hidden(surface: Surface, other: Sight, T: np.ndarray | None = None) -> np.ndarray:
    """(n,) bool: points that nobody sees in the other state, nor sees through, where T (4, 4) takes them."""
    return whereabouts(surface, other, T)[1]


def gone(surface: Surface, other: Sight) -> np.ndarray:
    """(n,) bool: points in whose place the other state's photographs show nothing, or another colour."""
    _, (contradiction,), (arrived,), (colour,) = _told(surface, other, [None])
    return ((contradiction >= 0.5) & (arrived < 0.3)) | (arrived * colour > 0.3)


def _told(
    surface: Surface, other: Sight, transforms: Sequence[np.ndarray | None]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What photographs say of points moved by each of the transforms (None: not at all).

    Returns:
        (transforms, n, 3) where they are then; (transforms, n) in 0 … 1 each: seen through, seen, of another colour.
    """
    T_other_here = np.stack([np.eye(4) if T is None else T for T in transforms])
    places, facing = moved(surface.points, T_other_here), surface.facing
    if facing is not None:
        facing = (facing @ T_other_here[:, :3, :3].transpose(0, 2, 1)).reshape(-1, 3)
    answer = ask(places.reshape(-1, 3), surface.colours, other, facing).reshape(*places.shape[:2], 4)
    # A point a little in front of its surface floats in some photographs of its own state, too.
    contradiction = np.clip((free_share(answer) - surface.free_at_home - SLACK) / CLEAR, 0, 1)
    # Every surface is hidden from most sides: a few views that see it there are enough.
    arrived = np.clip(answer[..., SURFACE] / ARRIVED, 0, 1)
    return places, contradiction, arrived, np.clip((answer[..., COLOUR] - SAME) / OTHER, 0, 1)


def seed_costs(
    seeds: Surface, other: Sight, transforms: Sequence[np.ndarray], extent: float, far_cost: float = 0.3
) -> np.ndarray:
    """(n, transforms) cost of each motion for each seed. Here hidden is worse than seen: a seed must go somewhere."""
    return label_costs(seeds, other, transforms, extent=extent, hidden_cost=HIDDEN_SEED_COST, far_cost=far_cost)[:, 1:]


def seed_gains(seeds: Surface, other: Sight, transforms: Sequence[np.ndarray], extent: float) -> np.ndarray:
    """(n, transforms) by how much each motion explains each seed better than ``WORTH``, as far as it is seen there.

    What hides can be had from many motions: it says nothing of which is right.
    """
    priced = _priced(seeds, other, transforms, extent, HIDDEN_SEED_COST, HIDDEN_SEED_COST, 0.3)
    return np.stack([np.maximum(WORTH - cost, 0) * arrived for cost, arrived in priced], 1)


def neighbour_weights(points: np.ndarray, colours: np.ndarray, radius: float, k: int = 12) -> csr_matrix:
    """(n, n) sparse float32 weights of the k nearest points, less for distance and for another colour."""
    n = len(points)
    k = min(k, n - 1)
    distance, index = map(np.asarray, KDTree(points).query(points, k + 1))
    row = np.repeat(np.arange(n), k)
    column = index[:, 1:].ravel()
    difference = np.linalg.norm(colours[row] - colours[column], axis=1)
    weight = np.exp(-((distance[:, 1:].ravel() / radius) ** 2)) * np.exp(-((difference / 0.3) ** 2))
    return csr_matrix((weight.astype(np.float32), (row, column)), shape=(n, n))


def of_one_mind(values: np.ndarray, weights: csr_matrix) -> np.ndarray:
    """(n, k) mean of each point's values (n, k) and its neighbours'."""
    return (weights @ values + values) / (1 + np.asarray(weights.sum(1)).reshape(-1, 1))


class Settled(NamedTuple):
    """Labels of both states' points, and what they go by."""

    labels: Labels
    energy: float
    costs: list[np.ndarray]
    """(n_s, labels) with those of labels that lead to the territories of others."""


@dataclass(frozen=True)
class Labelling:
    """The labelling problem of both states' surface points: mean field over labels, description length over motions."""

    surfaces: tuple[Surface, Surface]
    weights: tuple[csr_matrix, csr_matrix]
    trees: tuple[KDTree, KDTree]
    extent: float
    density: float = 1.0
    """Points where prices count one: as many more neighbours are heard, each of them less."""
    consistency: float = 0.6

    @staticmethod
    def of(surfaces: tuple[Surface, Surface], extent: float, density: float = 1.0) -> "Labelling":
        first, second = surfaces
        w0, w1 = (neighbour_weights(s.points, s.colours, 0.025 * extent) for s in surfaces)
        return Labelling(surfaces, (w0, w1), (KDTree(first.points), KDTree(second.points)), extent, density)

    @property
    def smoothness(self) -> float:
        return SMOOTHNESS / self.density**0.5

    @cached_property
    def links(self) -> np.ndarray:
        """``territory.links`` of both states' points."""
        return links(self.trees, self.extent)

    def costs(self, T_1_0: Sequence[np.ndarray], far_cost: float = 0.3) -> list[np.ndarray]:
        """``label_costs`` of both states' points."""
        a, b = self.surfaces
        inverse = [np.linalg.inv(T) for T in T_1_0]
        return [
            label_costs(a, b.sight, T_1_0, extent=self.extent, far_cost=far_cost),
            label_costs(b, a.sight, inverse, extent=self.extent, far_cost=far_cost),
        ]

    def partners(self, T_1_0: Sequence[np.ndarray]) -> list[np.ndarray]:
        """(n_s, 1 + motions) int32: the other state's point with which each point coincides under each label, or −1."""
        result = []
        for s in (0, 1):
            columns = []
            for T in [np.eye(4), *T_1_0]:
                carried = moved(self.surfaces[s].points, T if s == 0 else np.linalg.inv(T))
                distance, index = map(np.asarray, self.trees[1 - s].query(carried, workers=torch.get_num_threads()))
                columns.append(np.where(distance < 0.025 * self.extent, index, -1).astype(np.int32))
            result.append(np.stack(columns, 1))
        return result

    def mean_field(
        self, costs: Sequence[np.ndarray], partners: Sequence[np.ndarray], iterations: int = 20
    ) -> tuple[Labels, float]:
        """Labels of both states and the energy they cost.

        A point hears its own costs, its neighbours, and the point of the other state it would coincide with under
        each label: if k carries me there, the one who lives there should be k, too.
        """
        return mean_field(costs, partners, self.weights, self.smoothness, self.consistency, NOBODY, iterations)

    def territories(self, costs: Sequence[np.ndarray], partners: Sequence[np.ndarray]) -> list[np.ndarray]:
        """``territory.territories`` of every label for both states' points, (n_s, labels)."""
        return territories(costs, partners, self.links, MAY, TERRITORY * self.density)

    def settled(
        self, costs: Sequence[np.ndarray], partners: Sequence[np.ndarray], number: Sequence[np.ndarray]
    ) -> Settled:
        """Labels that keep to their territories, numbered (n_s, labels); the energy counts those beside the best."""
        costs = barred(costs, [n == FOREIGN for n in number])
        labels, energy = self.mean_field(costs, partners)
        price = FURTHER * self.density
        worthy, away = further(costs, number, labels, price)
        if any(a.any() for a in away):
            costs = barred(costs, away)
            labels, energy = self.mean_field(costs, partners)
        return Settled(labels, energy + worthy * price, costs)

    def labels(self, T_1_0: Sequence[np.ndarray], said: Labels | None = None) -> Labels:
        """Labels of both states' points under these motions, all of which stay.

        Args:
            said: labels that these points, thinned, had chosen: each point hears the nearest of them.
        """
        return self._labels(T_1_0, self.partners(T_1_0), said)

    def labels_and_meeting(self, T_1_0: Sequence[np.ndarray]) -> tuple[Labels, np.ndarray]:
        """The same, and ``meeting`` of each motion."""
        partners = self.partners(T_1_0)
        owned = self._labels(T_1_0, partners)
        return owned, meeting(partners, owned)

    def _labels(
        self, T_1_0: Sequence[np.ndarray], partners: Sequence[np.ndarray], said: Labels | None = None
    ) -> Labels:
        costs = self.costs(T_1_0)
        if said is not None:
            for cost, label in zip(costs, said, strict=True):
                cost[np.arange(len(label)), label] -= SAID
        return self.settled(costs, partners, self.territories(costs, partners)).labels


def meeting(partners: Sequence[np.ndarray], owned: Labels) -> np.ndarray:
    """(motions,) share of each motion's points that meet one of its own, in that state where more of them do.

    Of a part that one state shows nearly whole or hardly at all, that is nearly all of what the one or the other shows:
    in 120 parts 0.76 at least. What merely hides had 0.4 and less, a shelf that slid up a fridge's door 0.68. A state
    that shows a twentieth of what the other does says nothing: right parts had a tenth, a laptop's screen, put out of
    sight but for a few points, 0.055.

    Args:
        partners: as ``Labelling.partners`` gives them, of both states.
    """
    result = np.zeros(partners[0].shape[1] - 1)
    for k in range(len(result)):
        shown = [int((labels == k + 1).sum()) for labels in owned]
        for s in (0, 1):
            met = partners[s][owned[s] == k + 1, k + 1]
            if len(met) > HARDLY * shown[1 - s]:
                result[k] = max(result[k], ((met >= 0) & (owned[1 - s][met] == k + 1)).mean())
    return result


class Choices:
    """Motions to choose from; what a set of them explains is worked out once. Sets hold indices of motions.

    That two points meet counts, so a motion gains little that would explain a surface of one state by a surface of the
    other that has a better explanation.
    """

    def __init__(self, problem: Labelling, T_1_0: Sequence[np.ndarray]) -> None:
        self.problem, self.number = problem, len(T_1_0)
        self._costs = [costs.astype(np.float32) for costs in problem.costs(T_1_0)]
        self._partners = problem.partners(T_1_0)
        self._territories = problem.territories(self._costs, self._partners)
        met = [partners >= 0 for partners in self._partners]
        # What each label would cost a point if its partner and its neighbours agreed; who hides may be anywhere.
        self._agreed = [
            of_one_mind((costs - 0.5 * problem.consistency * np.where(m, 1, NOBODY)).astype(np.float32), weights)
            for costs, m, weights in zip(self._costs, met, problem.weights, strict=True)
        ]
        self._seen = [np.where(m, 1, UNMET).astype(np.float32) for m in met]
        self._solutions: dict[frozenset[int], tuple[Labels, float]] = {}
        self._promises: dict[frozenset[int], np.ndarray] = {}

    def with_more(self, T_1_0: Sequence[np.ndarray]) -> "Choices":
        """The same motions to choose from, and some more after them."""
        if len(T_1_0) == 0:
            return self
        both, more = copy(self), Choices(self.problem, T_1_0)
        both.number = self.number + more.number
        for name in ("_costs", "_partners", "_agreed", "_seen", "_territories"):
            columns = zip(getattr(self, name), getattr(more, name), strict=True)
            setattr(both, name, [np.concatenate([mine, theirs[:, 1:]], 1) for mine, theirs in columns])
        both._promises = {}
        return both

    def _settled(self, kept: frozenset[int]) -> Settled:
        """The set's, its labels and costs being those to stay and of the motions in order."""
        columns = [0, *(k + 1 for k in sorted(kept))]
        # Fewer iterations would leave energies off by as much as one look-alike differs from another.
        tables = self._costs, self._partners, self._territories
        return self.problem.settled(*([each[:, columns] for each in table] for table in tables))

    def _solved(self, kept: frozenset[int]) -> tuple[Labels, float]:
        """Labels that are columns of all costs, and their energy."""
        if kept not in self._solutions:
            (first, second), energy, _ = self._settled(kept)
            columns = np.array([0, *(k + 1 for k in sorted(kept))])
            self._solutions[kept] = (columns[first], columns[second]), energy
        return self._solutions[kept]

    def best(self, prices: np.ndarray, parts: int | None) -> frozenset[int]:
        """The set that explains both states at the least description length: energy and a price for each motion.

        Args:
            prices: (motions,) in points.
            parts: choose no more than this many.
        """
        points = sum(map(len, self._costs))

        def length(kept: frozenset[int]) -> float:
            too_many = 0 if parts is None else max(len(kept) - parts, 0)
            return self._solved(kept)[1] + float(prices[sorted(kept)].sum()) + points * too_many

        def lengths(sets: Sequence[frozenset[int]]) -> list[float]:
            with ThreadPoolExecutor(torch.get_num_threads()) as pool:
                return list(pool.map(length, sets))

        return shortest(lengths, lambda kept: self._promising(kept, prices))

    def gains(self, kept: frozenset[int]) -> dict[int, float]:
        """What each of the most promising others would explain besides these, in points; the best first."""
        others = self.promising(kept)[:ADDED]
        gain = {k: self._solved(kept)[1] - self._solved(kept | {k})[1] for k in others}
        return dict(sorted(gain.items(), key=lambda item: -item[1]))

    def promising(self, kept: frozenset[int]) -> list[int]:
        """All others, those first by which points would gain most besides these."""
        return [k for k in self._promising(kept, np.zeros(self.number)) if k not in kept]

    def firsthand(self, kept: frozenset[int]) -> dict[int, float]:
        """By how much each of these motions explains its points better than the next best, whatever they hear.

        A frame round a hole, and one round another hole in the other state, make a motion that only hearsay speaks for.
        """
        labels, _, costs = self._settled(kept)
        better = dict.fromkeys(kept, 0.0)
        for cost, label in zip(costs, labels, strict=True):
            for i, k in enumerate(sorted(kept), 1):
                better[k] += float(lead(cost[label == i], i).sum())
        return better

    def stand_ins(self, kept: Collection[int], k: int) -> tuple[np.ndarray, np.ndarray]:
        """How well every motion would do with what motion ``k`` of this set owns: on the way there, and on that back.

        Returns:
            (2, motions) share of those points of each state that may as well follow it, be it out of sight, and number
            of the other state's points, met by none of the set, on which it lays some of them.
        """
        labels, may, found = self._solved(frozenset(kept))[0], [], []
        for s, (mine, theirs) in enumerate((labels, labels[::-1])):
            own, partners = mine == k + 1, self._partners[1 - s]
            alone = (theirs != k + 1) & (partners[np.arange(len(theirs)), theirs] < 0)
            there = partners[alone, 1:]
            found.append(((there >= 0) & own[there] & (self._costs[1 - s][alone, 1:] < KNOWN_AGAIN)).sum(0))
            may.append((self._costs[s][own, 1:] < MAY).sum(0) / max(own.sum(), 1))
        return np.stack(may), np.stack(found)

    def labels(self, kept: Sequence[int]) -> Labels:
        """Labels of both states' points: 0 stays, i + 1 is to move by ``kept[i]``."""
        rank = np.zeros(1 + self.number, int)
        rank[[k + 1 for k in kept]] = np.arange(1, len(kept) + 1)
        first, second = self._solved(frozenset(kept))[0]
        return rank[first], rank[second]

    def _promising(self, kept: frozenset[int], prices: np.ndarray) -> list[int]:
        """All motions, those first that the points would gain most by if their partners agreed, less their prices."""
        if kept not in self._promises:
            labels, gain = self._solved(kept)[0], np.zeros(self.number)
            for s, weights in enumerate(self.problem.weights):
                row, label = np.arange(len(labels[s])), labels[s]
                partner = self._partners[s][row, label]
                heard = np.where(partner >= 0, labels[1 - s][partner] == label, NOBODY)
                now = self._costs[s][row, label] - 0.5 * self.problem.consistency * heard
                better = of_one_mind(now[:, None].astype(np.float32), weights) - self._agreed[s]
                gain += (np.maximum(better, 0) * self._seen[s]).sum(0)[1:]
            self._promises[kept] = gain
        return [int(k) for k in np.argsort(prices - self._promises[kept])]


def shortest(
    lengths: Callable[[Sequence[frozenset[int]]], Sequence[float]],
    promising: Callable[[frozenset[int]], Sequence[int]],
) -> frozenset[int]:
    """The set of the least length that adding, dropping and exchanging lead to, from the empty set.

    Two motions that are right together replace one that is nearly right for both, which comes first; and two replace
    two where look-alikes are taken for each other, so that either exchange alone is worse.

    Args:
        lengths: of sets, measured together.
        promising: names what may be added to a set, the best first.
    """

    def two_more(less: frozenset[int], kept: frozenset[int]) -> Iterator[frozenset[int]]:
        """The set with two more that were not in another, the second chosen once the first is there."""
        for first in [k for k in promising(less) if k not in kept][:PAIRED]:
            once = less | {first}
            yield from (once | {k} for k in [k for k in promising(once) if k not in kept | once][:SECOND])

    def trials(kept: frozenset[int]) -> Iterator[list[frozenset[int]]]:
        """Sets beside ``kept``, the few first: what is many has its turn when nothing else helps."""
        others = [k for k in promising(kept) if k not in kept]
        smaller = [kept - {k} for k in sorted(kept)]
        yield smaller + [kept | {k} for k in others[:ADDED]]
        yield [less | {k} for less in smaller for k in others[:EXCHANGED]]
        yield [more for less in smaller for more in two_more(less, kept)]
        yield [more for pair in combinations(sorted(kept), 2) for more in two_more(kept - set(pair), kept)]

    kept: frozenset[int] = frozenset()
    (least,) = lengths([kept])
    while True:
        for beside in trials(kept):
            length, best = min(
                zip(lengths(beside), beside, strict=True), key=lambda pair: pair[0], default=(least, kept)
            )
            if length < least - 1:
                kept, least = best, length
                break
        else:
            return kept
