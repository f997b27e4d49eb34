"""Which Gaussians move, with which rigid motion, and how many parts that makes. No number of parts is needed.

Seeds are surface points that the other state's cameras would see floating in free space: they must have moved. Every
motion of one degree of freedom is tried on them (``search``). Surface points of both states vote for a motion, each
with its neighbours and with the place where it would go (``labelling``); those motions are kept that explain most at
the least description length, look-alikes told apart by their texture (``texture``). Gaussians take the label of the
nearest point.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from functools import wraps
from itertools import chain, combinations
from typing import TypeVar

import numpy as np
from scipy.spatial import KDTree

from hingesplat.borders import bordered
from hingesplat.capture import View
from hingesplat.drawer import behind_fronts, insides
from hingesplat.exchange import changed_places
from hingesplat.gaussians import Gaussians
from hingesplat.hypotheses import (
    Evidence,
    HypothesesConfig,
    both_ways,
    candidates,
    costs_anywhere,
    oddities,
    propose_hanging,
    refit,
)
from hingesplat.labelling import Choices, Labelling, seed_costs, whereabouts_under
from hingesplat.patches import Photograph
from hingesplat.pieces import (
    follow_fronts,
    give_way,
    lying_on,
    passed_on,
    reattach_fragments,
    riding,
    seen_to_move,
    split_pieces,
)
from hingesplat.se3 import apart
from hingesplat.search import BASE, Motion, carrier_of, inverted, novelty
from hingesplat.square import nearest
from hingesplat.stereo import DepthMap
from hingesplat.surface import Labels, Pair, Surface, bounds, surface_of, thin
from hingesplat.texture import (
    ENOUGH,
    GOES_ALONG,
    LEAST,
    TextureConfig,
    against,
    compared,
    fitted,
    likeness,
    photographs_of,
    told_apart,
    unless_still,
    vouched_for,
)
from hingesplat.training import evenly
from hingesplat.visibility import FREE, HIDDEN, ask

Index = TypeVar("Index")
Said = TypeVar("Said")

ALIKE = 0.06
"""Extents between the places to which two motions take points, in the mean, for them to be nearly the same."""
HEARD = (0.1, 0.3, 0.3)
"""Share of a price that a motion must explain besides those chosen, each time before it is fitted anew."""
FIRSTHAND = 0.5
"""Part of its price that a motion must explain at first hand: right ones had 1.1 and more, the frame round one drawer
that became the frame round another 0.2."""
DISCOUNT = 2.5
"""Part of a price, for all of the patches asked, that texture pays: 16 and 25 % of those of drawers went along, 9 and
10 % of those of handles that were alike."""
RIVALS = 6
"""Motions that are heard beside the best, in place of each of them, and of each two."""
HEARINGS = 2
"""Times at most that rivals are heard, the second time those of what texture left."""
STAYS = 0.8
"""Share of its price for which a motion stays that was chosen among all: what is worth just that would come and go."""
SQUARE, SQUARE_SLIDE = 3, 0.7
"""Degrees from what a face looks at within which a slide is square, and part of a price that it costs: two numbers
less say where it leads."""
WORSE = 0.04
"""By how much photographs may like a motion less, in the mean over its points, once texture has corrected it: right
corrections cost 0.03 at most, those of a door by what it had taken along of a wire rack 0.05 to 0.33."""
MEETING, HANGING_MEETS = 0.7, 0.8
"""Share of a part's points that must meet its points of the other state, in one of the states: right ones had 0.76 and
more, wrong ones 0.68 and less. Of one that hangs on another there is little else to go by: there it was 0.90 and more,
and 0.75 and less."""
PASSED_ON, RIDING = 0.5, 0.6
"""Share of a part's points that lie on one part in state 0 and on another in state 1, or on the same in both, from
which it is none."""


@dataclass(frozen=True)
class SegmentConfig:
    """Finding the parts and their first motions."""

    views: int = 60
    """Photographs of each state that judge the hypotheses, at most."""
    sight_size: int = 200
    """Longest side in pixels of the depth pictures that judge the hypotheses."""
    tolerance: float = 0.012
    """Half-width of a surface, as a fraction of the object's extent."""
    spacing: float = 0.015
    """Distance of the surface points that are labelled, as a fraction of the object's extent."""
    cells: int = 48
    """Voxels along the object's longest side in the search."""
    max_seeds: int = 1200
    """Seeds of each state that judge the hypotheses."""
    part_cost: float = 50.0
    """Description length of one more part, in points (a point stands for 0.03² of the extent's square)."""
    hanging_cost: float = 22.0
    """The same where something is left that no joint on the base explains: parts that hang on others are small."""
    min_part_seeds: int = 25
    """Surface points of a part that each state must show, where they are not 0.3 % of it; another piece with the same
    motion is a part if it shows five times as many."""
    min_left_over: int = 100
    """Seeds that no part known explains from which a further state is searched for more parts."""
    hypotheses: HypothesesConfig = field(default_factory=HypothesesConfig)
    rounds: int = 3
    """Rounds of relabelling and refining the motions."""
    texture: TextureConfig = field(default_factory=TextureConfig)


@dataclass(frozen=True)
class Segmentation:
    """Parts found: part k + 1 moves by ``motions[k]`` from state 0 to the other state, or to one where it does move."""

    labels: tuple[np.ndarray, np.ndarray]
    """Part id of every Gaussian of state 0 and of the other state."""
    motions: tuple[Motion, ...]
    unexplained: float
    """Fraction of the seeds that no motion explains."""
    seeds: int
    """Number of (thinned) seeds of both states."""


def survey(
    gaussians: Sequence[Gaussians],
    views: Sequence[Sequence[View]],
    maps: Sequence[Sequence[DepthMap]],
    config: SegmentConfig,
) -> tuple[np.ndarray, np.ndarray, tuple[Surface, Surface]]:
    """Corners (3,) of two states together, and each state's visible surface."""
    low, high = bounds([g.means.numpy() for g in gaussians])
    extent = float((high - low).max())
    spacing, tolerance = config.spacing * extent, config.tolerance * extent
    surfaces = []
    for g, v, m in zip(gaussians, views, maps, strict=True):
        judges = evenly(len(v), config.views)
        v, m = [v[i] for i in judges], [m[i] for i in judges] if m else []
        surfaces.append(surface_of(g, v, m, config.sight_size, spacing, tolerance))
    return low, high, (surfaces[0], surfaces[1])


def floating(answer: np.ndarray) -> np.ndarray:
    """(n,) bool: points that enough of the other state's cameras see in free space."""
    return (answer[:, FREE] >= 3) & (answer[:, FREE] > 0.15 * answer[:, : HIDDEN + 1].sum(1))


def must_have_moved(
    surfaces: tuple[Surface, Surface], extent: float, rng: np.random.Generator
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Rows of each state's points, thinned, that must have moved; and what the other state's cameras say of all."""
    answers = [ask(here.points, here.colours, other.sight) for here, other in (surfaces, surfaces[::-1])]
    rows = []
    for surface, answer in zip(surfaces, answers, strict=True):
        index = np.flatnonzero(floating(answer))
        rows.append(index[thin(surface.points[index], 0.012 * extent, rng)])
    return rows, answers


def gather(
    surfaces: tuple[Surface, Surface],
    low: np.ndarray,
    high: np.ndarray,
    config: SegmentConfig,
    rng: np.random.Generator,
) -> tuple[Evidence, list[np.ndarray]]:
    """What the search for motions goes by, and its seeds: rows of each state's points that must have moved.

    ``low`` and ``high`` (3,) are the corners of both states together.
    """
    seeds, answers = must_have_moved(surfaces, float((high - low).max()), rng)
    first, second = map(novelty, answers)
    return Evidence(surfaces, (first, second), low, high, config.cells, config.hypotheses, rng), seeds


def segment(
    gaussians: tuple[Gaussians, Gaussians],
    views: tuple[Sequence[View], Sequence[View]],
    config: SegmentConfig,
    *,
    maps: tuple[Sequence[DepthMap], Sequence[DepthMap]] = ((), ()),
    parts: int | None = None,
    seed: int = 0,
) -> Segmentation:
    """Two states' Gaussians and photographs to parts and their first motions.

    Args:
        gaussians: fitted to state 0 and to the other state.
        views: the training photographs of the same two states.
        maps: the depth of these photographs where it is known.
        parts: number of movable parts at most, or None to find it.
    """
    low, high, surfaces = survey(gaussians, views, maps, config)
    evidence, seeds = gather(surfaces, low, high, config, np.random.default_rng(seed))
    judges = (seeds[0][: config.max_seeds], seeds[1][: config.max_seeds])
    n_seeds = sum(map(len, seeds))
    found = candidates(evidence, seeds, judges)
    if not found:
        empty = (np.zeros(len(gaussians[0]), int), np.zeros(len(gaussians[1]), int))
        return Segmentation(empty, (), 0.0, n_seeds)

    case = _Case.of(evidence, judges, config, parts)
    photographs = [photographs_of(g, v, config.texture) for g, v in zip(gaussians, views, strict=True)]
    chosen = case.settled(*case.told_by_texture(found, photographs, seed))
    chosen = case.with_hanging(chosen)
    chosen = case.without_still(chosen, photographs, seed)
    if not any(carrier_of(m, chosen) is not None for m in chosen):
        chosen = case.corrected(chosen, photographs)
        chosen = case.heard_again(chosen, found, photographs, seed)
    chosen, owned = _labelled(case, chosen, photographs, seed)
    costs = _seed_costs(evidence, judges, chosen) if chosen else np.ones((1, 1))
    unexplained = float((costs.min(1) >= config.hypotheses.explained_cost).mean())
    labels = tuple(spread_labels(gaussians[s].means.numpy(), surfaces[s], owned[s]) for s in (0, 1))
    return Segmentation((labels[0], labels[1]), tuple(chosen), unexplained, n_seeds)


def _seed_costs(evidence: Evidence, seeds: Pair, motions: Sequence[Motion]) -> np.ndarray:
    """(seeds, motions) what the other state's cameras say of seeds, rows of each state's points, under every motion."""
    return both_ways(seed_costs, evidence.seen(seeds), motions, evidence.extent)


def _said_once(say: Callable[[Index, Pair], Said]) -> Callable[[Index, Pair], Said]:
    """The same of a motion and what it owns: it is asked more than once, and takes a while to say."""
    said: dict[tuple[Index, bytes, bytes], Said] = {}

    @wraps(say)
    def once(k: Index, mine: Pair) -> Said:
        asked = k, mine[0].tobytes(), mine[1].tobytes()
        if asked not in said:
            said[asked] = say(k, mine)
        return said[asked]

    return once


@dataclass(frozen=True)
class _Case:
    """What decides which motions there are."""

    evidence: Evidence
    seeds: Pair
    """Rows of each state's points that must have moved."""
    rows: Pair
    """Rows of each state's points that are labelled."""
    problem: Labelling
    """Of these."""
    config: SegmentConfig
    parts: int | None
    """No more than this many motions."""

    @staticmethod
    def of(evidence: Evidence, seeds: Pair, config: SegmentConfig, parts: int | None) -> "_Case":
        first, second = evidence.surfaces
        rows = tuple(thin(s.points, 2 * config.spacing * evidence.extent, evidence.rng) for s in (first, second))
        problem = Labelling.of((first.rows(rows[0]), second.rows(rows[1])), evidence.extent)
        return _Case(evidence, seeds, (rows[0], rows[1]), problem, config, parts)

    def told_by_texture(
        self, motions: Sequence[Motion], photographs: Sequence[Sequence[Photograph]], seed: int
    ) -> tuple[list[Motion], list[float]]:
        """Those of the motions that there are, and what they cost: look-alikes told apart, and what is nearly alike."""
        surfaces, extent, price = self.problem.surfaces, self.evidence.extent, self.config.part_cost
        choices, usual = Choices(self.problem, [m.T for m in motions]), self._prices(motions)

        @_said_once
        def verdict(k: int, mine: Pair) -> float:
            """Of the motion that fits these points: one 2 % off would not go along with its own texture."""
            fit = refit(self.evidence, motions[k], (self.rows[0][mine[0]], self.rows[1][mine[1]]))
            return against(compared(surfaces, photographs, fit.T, mine, extent, self.config.texture, seed))

        # What texture speaks against, and leaves, may have rivals: a right drawer may be 2 % off, too.
        kept = choices.best(usual, self.parts)
        for _ in range(HEARINGS):
            rivals = self._rivals(choices, motions, kept)
            choices, motions = choices.with_more([m.T for m in rivals]), [*motions, *rivals]
            usual = np.concatenate([usual, self._prices(rivals)])
            told = told_apart(choices, verdict, usual, self.parts, self._plain_prices(motions))
            while exchanges := self._exchanges(choices, motions, told):
                usual[np.any(list(exchanges.values()), axis=0)] = np.inf
                told = told_apart(choices, verdict, usual, self.parts, self._plain_prices(motions))
            if all(p <= usual[k] for k, p in told.items()):
                break
            kept = frozenset(told)
        ways = [m.T for m in motions]
        texture = self._texture_under(ways, photographs, seed)

        def nearly_alike(k: int, _: float, others: Collection[int], mine: Pair) -> bool:
            """Two drawers pulled out by nearly the same are one to points and colours, or nearly so."""
            points = surfaces[0].points[mine[0]]
            return any(alike(points, ways[j], ways[k], extent) for j in others)

        prices = vouched_for(
            choices, told, nearly_alike, lambda *asked: likeness(texture(*asked)), LEAST * price, self.parts
        )
        return [motions[k] for k in prices], [STAYS * p for p in prices.values()]

    def _plain_prices(self, motions: Sequence[Motion]) -> np.ndarray:
        """(motions,) what each costs if nothing is odd about it, in points: square slides less."""
        square = [m.kind == "prismatic" and nearest(self.evidence.square, m.axis, SQUARE) is not None for m in motions]
        return self.config.part_cost * np.where(square, SQUARE_SLIDE, 1.0)

    def _prices(self, motions: Sequence[Motion]) -> np.ndarray:
        """(motions,) what each costs before texture is asked, in points: odd joints more."""
        return self._plain_prices(motions) + self.config.part_cost * oddities(self.evidence, motions, self.seeds)

    def _rivals(self, choices: Choices, motions: Sequence[Motion], kept: frozenset[int]) -> list[Motion]:
        """What might stand beside the motions kept, or in place of one or two, fitted to what would be its own then.

        Look-alikes that meet by chance meet at once; a right motion that is 2 % off explains less than they do.
        """
        found: dict[int, Motion] = {}
        for out in chain.from_iterable(combinations(sorted(kept), n) for n in range(3)):
            less = kept - set(out)
            for k in [k for k in choices.promising(less) if k not in kept][:RIVALS]:
                if k not in found:
                    found[k] = refit(self.evidence, motions[k], self._owned(choices, [*sorted(less), k])[-1])
        return list(found.values())

    def _texture_under(
        self, ways: Sequence[np.ndarray], photographs: Sequence[Sequence[Photograph]], seed: int
    ) -> Callable[[int | None, Pair], list[tuple[np.ndarray, float]]]:
        """``compared`` for the points of a motion, under any of the motions (4, 4), or None: to stay."""
        surfaces, extent = self.problem.surfaces, self.evidence.extent

        @_said_once
        def texture(k: int | None, mine: Pair) -> list[tuple[np.ndarray, float]]:
            T_1_0 = BASE if k is None else ways[k]
            return compared(surfaces, photographs, T_1_0, mine, extent, self.config.texture, seed)

        return texture

    def _exchanges(self, choices: Choices, motions: Sequence[Motion], told: Collection[int]) -> dict[int, np.ndarray]:
        """Those told that are rather two drawers, each with (motions,) which others are like it."""
        kept, extent = sorted(told), self.evidence.extent
        first, _ = choices.labels(kept)
        like = {}
        for i, k in enumerate(kept, 1):
            own, T = self.problem.surfaces[0].points[first == i], motions[k].T
            like[k] = np.array([m is motions[k] or alike(own, m.T, T, extent) for m in motions])
        known = np.any(list(like.values()), axis=0)
        return {k: like[k] for k in kept if changed_places(choices, motions, kept, k, known, extent)}

    def settled(self, candidates: list[Motion], prices: list[float]) -> list[Motion]:
        """Those of the candidates that there are, refined on what they own."""
        owners: list[Pair] = []
        for _ in range(self.config.rounds):
            shared = one_for_two(self.evidence, candidates, owners)
            candidates, prices = (
                candidates + list(shared.values()),
                prices + [max(prices[j], prices[k]) for j, k in shared],
            )
            choices = Choices(self.problem, [m.T for m in candidates])
            kept = sorted(_seen_to_explain(choices, choices.best(np.array(prices), self.parts), prices))
            owners = self._owned(choices, kept)
            candidates = [refit(self.evidence, candidates[k], own) for k, own in zip(kept, owners, strict=True)]
            prices = [prices[k] for k in kept]
        return candidates

    def heard_again(
        self,
        chosen: list[Motion],
        candidates: Sequence[Motion],
        photographs: Sequence[Sequence[Photograph]],
        seed: int,
    ) -> list[Motion]:
        """The motions, with those candidates that explain half a price once they fit what would be theirs.

        What is off by 2 % of the extent explains a fifth of what it would if it were right. Texture has to go along.
        """
        if self.parts is not None and len(chosen) >= self.parts:
            return chosen
        price, kept, others = self.config.part_cost, frozenset(range(len(chosen))), list(candidates)
        for share in HEARD:
            motions = [*chosen, *others]
            choices = Choices(self.problem, [m.T for m in motions])
            found = [k for k, gain in choices.gains(kept).items() if gain > share * price]
            others = [refit(self.evidence, motions[k], self._owned(choices, [*sorted(kept), k])[-1]) for k in found]
            if not others:
                return chosen
        motions = [*chosen, *others]
        ways = [m.T for m in motions]
        usual = self._prices(motions)
        texture, among = self._texture_under(ways, photographs, seed), Choices(self.problem, ways)

        def worth(k: int, gain: float, _: Collection[int], mine: Pair) -> bool:
            asked = sum(min(int(m.sum()), self.config.texture.patches) for m in mine)
            along = int((likeness(texture(k, mine)) > GOES_ALONG).sum())
            if gain <= usual[k] * (1 - DISCOUNT * along / max(asked, 1)):
                return False
            return k not in self._exchanges(among, motions, [*kept, k])

        prices = vouched_for(
            among,
            dict.fromkeys(kept, price),
            worth,
            lambda *asked: likeness(texture(*asked)),
            LEAST * price,
            self.parts,
        )
        return self.corrected([motions[k] for k in prices], photographs) if len(prices) > len(chosen) else chosen

    def _owned(self, choices: Choices, kept: Sequence[int]) -> list[Pair]:
        """What each of these motions owns: rows of each state's points."""
        first, second = choices.labels(kept)
        return [(self.rows[0][first == i + 1], self.rows[1][second == i + 1]) for i in range(len(kept))]

    def with_hanging(self, chosen: list[Motion]) -> list[Motion]:
        """The motions, with those of parts that hang on theirs if what no joint on the base explains says so."""
        if not chosen:
            return chosen
        left = _seed_costs(self.evidence, self.seeds, chosen).min(1) >= self.config.hypotheses.explained_cost
        first, second = np.split(left, [len(self.seeds[0])])
        stray = (self.seeds[0][first], self.seeds[1][second])
        hanging = propose_hanging(self.evidence, stray, chosen)
        if not hanging:
            return chosen
        more = self.settled([*chosen, *hanging], [self.config.hanging_cost] * (len(chosen) + len(hanging)))
        share = self.problem.labels_and_meeting([m.T for m in more])[1]
        kept = [m for m, s in zip(more, share, strict=True) if s > HANGING_MEETS or carrier_of(m, more) is None]
        return kept if any(carrier_of(m, kept) is not None for m in kept) else chosen

    def without_still(
        self, chosen: list[Motion], photographs: Sequence[Sequence[Photograph]], seed: int
    ) -> list[Motion]:
        """The motions but for those of points whose texture has stayed where it is, rather than gone along."""
        ways = [m.T for m in chosen]
        texture = self._texture_under(ways, photographs, seed)
        owned = self.problem.labels(ways)

        def along(k: int | None, mine: Pair) -> int:
            return int((likeness(texture(k, mine)) > GOES_ALONG).sum())

        def still(k: int) -> bool:
            mine = owned[0] == k + 1, owned[1] == k + 1
            return (stayed := along(None, mine)) >= ENOUGH and stayed > along(k, mine)

        return [motion for k, motion in enumerate(chosen) if not still(k)]

    def corrected(self, chosen: Sequence[Motion], photographs: Sequence[Sequence[Photograph]]) -> list[Motion]:
        """The motions, each corrected by the texture of what it owns in state 0, then of what it owns in state 1.

        A correction that takes these points where photographs clearly like them less is none.
        """
        labels = self.problem.labels([m.T for m in chosen])

        def by_texture_of(s: int, k: int, motion: Motion) -> Motion:
            own = self.evidence.rng.permutation(np.flatnonzero(labels[s] == k + 1))[: self.config.texture.corrected]
            some = self.problem.surfaces[s].rows(own)
            fit = fitted(motion, some, (photographs[s], photographs[1 - s]), self.evidence.extent)
            if fit is motion:
                return motion
            there = self.problem.surfaces[1 - s].sight
            before, after = costs_anywhere(some, there, [motion.T, fit.T], self.evidence.extent).mean(0)
            return motion if after - before > WORSE else fit

        first = [by_texture_of(0, k, m) for k, m in enumerate(chosen)]
        return [inverted(by_texture_of(1, k, inverted(m))) for k, m in enumerate(first)]


def _labelled(
    case: _Case, motions: list[Motion], photographs: Sequence[Sequence[Photograph]], seed: int
) -> tuple[list[Motion], Labels]:
    """The parts that these motions make, each one piece, and labels of all points of both states."""
    surfaces, extent, config, parts = case.evidence.surfaces, case.evidence.extent, case.config, case.parts
    count, few = (sum(len(s.points) for s in some) for some in (surfaces, case.problem.surfaces))
    problem = Labelling.of(surfaces, extent, count / few)
    while True:
        transforms = [m.T for m in motions]
        thinned, met = case.problem.labels_and_meeting(transforms)
        each = zip(surfaces, case.problem.surfaces, thinned, strict=True)
        first, second = (spread_labels(s.points, thin, label) for s, thin, label in each)
        owned = problem.labels(transforms, (first, second))
        share = lying_on(owned, len(motions), surfaces, extent)
        own_joint = np.array([not m.by_texture and carrier_of(m, motions) is None for m in motions], float)
        doubts = MEETING - met, passed_on(share) - PASSED_ON, own_joint * riding(share) - RIDING
        doubt = np.max(doubts, axis=0)
        if doubt.max(initial=0) <= 0:
            break
        worst = int(doubt.argmax())
        motions = motions[:worst] + motions[worst + 1 :]
    pieces = split_pieces(motions, owned, surfaces, extent, config.min_part_seeds)
    if parts is None or len(pieces[0]) <= parts:
        motions, owned = pieces
    transforms = [m.T for m in motions]
    owned = reattach_fragments(transforms, owned, surfaces, extent)
    told = whereabouts_under(transforms, surfaces)
    owned = give_way(transforms, owned, surfaces, extent, told)
    owned = follow_fronts(owned, surfaces, extent, told)
    owned = behind_fronts(transforms, owned, surfaces, extent, told)
    owned = insides(transforms, owned, surfaces, extent)

    def texture(T: np.ndarray, mine: Pair) -> np.ndarray:
        return likeness(compared(surfaces, photographs, T, mine, extent, config.texture, seed))

    owned = unless_still(transforms, owned, bordered(transforms, owned, problem, told), texture)
    return seen_to_move(motions, owned, surfaces, extent, config.min_part_seeds)


def _seen_to_explain(choices: Choices, kept: frozenset[int], prices: Sequence[float]) -> frozenset[int]:
    """The set without motions that explain too little at first hand, the emptiest of them first."""
    while kept:
        first = choices.firsthand(kept)
        least = min(kept, key=lambda k: first[k] / prices[k])
        if first[least] >= FIRSTHAND * prices[least]:
            break
        kept -= {least}
    return kept


def one_for_two(evidence: Evidence, motions: Sequence[Motion], owners: Sequence[Pair]) -> dict[tuple[int, int], Motion]:
    """For every two motions that nearly agree on what they own, rows of each state's points: one refined on both.

    A part whose true motion was not among those tried may be shared by one on either side of it. The first of the two
    is the one that owns more.
    """
    shared = {}
    for pair in combinations(range(len(owners)), 2):
        larger, smaller = sorted(pair, key=lambda k: -sum(map(len, owners[k])))
        both = tuple(np.concatenate([owners[k][s] for k in pair]) for s in (0, 1))
        points = evidence.surfaces[0].points[both[0]]
        if alike(points, motions[larger].T, motions[smaller].T, evidence.extent):
            shared[larger, smaller] = refit(evidence, motions[larger], (both[0], both[1]))
    return shared


def alike(points: np.ndarray, first: np.ndarray, second: np.ndarray, extent: float) -> bool:
    """Whether two motions (4, 4) take points (n, 3) to nearly the same places."""
    return len(points) > 0 and apart(points, first, second) < ALIKE * extent


def spread_labels(points: np.ndarray, surface: Surface, labels: np.ndarray) -> np.ndarray:
    """(n,) labels for all Gaussians at points (n, 3): each takes its nearest surface point's."""
    return labels[KDTree(surface.points).query(points)[1]]


__all__ = ["SegmentConfig", "Segmentation", "segment"]
