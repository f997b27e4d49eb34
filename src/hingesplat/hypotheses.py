"""Motions that may be those of the parts: from every patch of seeds the likeliest, improved on what they concern."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.spatial import KDTree

from hingesplat import square
from hingesplat.chains import misfit
from hingesplat.labelling import WORTH, seed_costs, seed_gains
from hingesplat.mechanism import oddity
from hingesplat.register import register
from hingesplat.screw import axes_across, matrix_to_screw
from hingesplat.se3 import apart, moved
from hingesplat.search import BASE, OLD, Motion, ScoreVolume, inverted, scan, score_volume, there_and_back
from hingesplat.stereo import Cloud
from hingesplat.surface import Pair, Surface, components
from hingesplat.visibility import Sight

FLAT = 0.2
"""Thickness of a plate, beside its sides."""
LINK = 0.035
"""Extents between neighbours of one piece of seeds."""
PATCH = 60
"""Seeds of a large piece for each patch that may be a part of its own."""
MOSTLY = 0.8
"""Share of a piece's seeds from which a plate of it is as good as the piece."""
TRIED_PLANES = 64
"""Seeds whose tangent planes are tried for the next plate."""
LEVEL, FACING = 0.01, np.cos(np.radians(25))
"""Extents off a plane, and cosine between normals, of what lies in it."""
HANGING = 0.02
"""Mean error of the best joint on the base, as a fraction of the extent, from which a part may hang on another."""
LEADING = 0.75
"""Score from which the best hypothesis of a patch climbs in any case."""
START_APART, APART = 0.03, 0.02
"""Extents between where two hypotheses take seeds, in the mean, for both to climb, and for both to be candidates."""
MET, SAME_COLOUR, PARALLEL = 0.025, 0.3, 0.8
"""Extents, RGB difference and cosine between normals within which a seed has come to lie on a surface."""
CLIMB = ((0.06, (0.03, 0.015)), (0.03, (0.015, 0.007)), (0.015, (0.007, 0.0035)))
"""Extents within which seeds are heard beside those that meet, and steps, one round after the other."""
SETTLED, CLEARLY = (0.015, 0.007), 0.01
"""Steps of a motion that has been registered, and by how much each must better a point's cost in the mean."""
GAINED = 0.3
"""By how much a motion must explain a seed better than ``WORTH`` for it to be one that it moves."""
NEARLY_SQUARE, SQUARED_REACH, HARDLY_MINDS = 15, 0.03, 0.02
"""Degrees from what a face looks at within which a slide is tried along it, extents by which it may go farther then,
and what it may cost a point more, in the mean."""
IMPOSSIBLE = 3.0
"""Oddity from which a motion is none."""
GO_ON = 0.5
"""Share of those that climb, the most promising, that go on after each round."""
STEPS, ANYWHERE = 6, 6
"""Steps of one size at most, and trials in each that change all numbers at once."""
WIDE = np.array([2.0, 2.0, 1.0, 1.0, 2.0])
"""Steps of an axis across itself, of its place, and of the motion along it, beside each other."""


@dataclass(frozen=True)
class HypothesesConfig:
    """Looking for motions."""

    seeds_per_search: int = 128
    """Seeds moved in one search."""
    agreeing_cost: float = 0.45
    """A seed agrees with a motion that costs it less than this."""
    explained_cost: float = 0.8
    """A seed that a motion explains worse than this counts as unexplained."""
    starts: int = 60
    """Hypotheses that climb, beside the best of every group of seeds."""
    leaders: int = 3
    """Of every group of seeds, hypotheses that climb in any case."""
    climbing_points: int = 100
    """Of each state, by which a hypothesis climbs."""
    min_concerned: int = 10
    """Of each state; a hypothesis that concerns fewer seeds stays where it is."""
    candidates: int = 80
    """Hypotheses among which the parts' motions are chosen."""
    min_points: int = 25
    """A motion is refined on no fewer points."""


@dataclass(frozen=True)
class Evidence:
    """What every search for motions between two states goes by; pairs are (state 0, the other)."""

    surfaces: tuple[Surface, Surface]
    novel: tuple[np.ndarray, np.ndarray]
    """(n,) ``novelty`` of each of their points."""
    low: np.ndarray
    high: np.ndarray
    """(3,) corners of both states together."""
    cells: int
    """Voxels along the longest side, in the search."""
    config: HypothesesConfig
    rng: np.random.Generator

    @cached_property
    def extent(self) -> float:
        """The longest side."""
        return float((self.high - self.low).max())

    @cached_property
    def fresh(self) -> tuple[Surface, Surface]:
        """The points of each state that the other does not show in the same place: something may have come to lie."""
        first, second = (s.rows(np.flatnonzero(n > 0.5)) for s, n in zip(self.surfaces, self.novel, strict=True))
        return first, second

    @cached_property
    def volumes(self) -> tuple[ScoreVolume, ScoreVolume]:
        """Of each state, where what comes from the other would be welcome."""
        box = self.low, self.high, self.cells
        each = zip(self.surfaces, self.novel, strict=True)
        first, second = (score_volume(s.points, s.colours, n, s.sight, *box) for s, n in each)
        return first, second

    def left_by(self, motions: Sequence[Motion]) -> "Evidence":
        """The same where nothing is new that one of the motions explains: two parts are never in one place."""
        costs = both_ways(seed_costs, self.surfaces, motions, self.extent).min(1)
        explained = np.split(costs < self.config.explained_cost, [len(self.novel[0])])
        first, second = (np.where(e, np.minimum(n, OLD), n) for e, n in zip(explained, self.novel, strict=True))
        return replace(self, novel=(first, second))

    @cached_property
    def square(self) -> np.ndarray:
        """(d, 3) ``square.directions_of`` both surfaces."""
        return square.directions_of(np.concatenate([s.normals for s in self.surfaces]), np.random.default_rng(0))

    def seen(self, seeds: Sequence[np.ndarray]) -> tuple[Surface, Surface]:
        """Of each state, the points in these rows."""
        return self.surfaces[0].rows(seeds[0]), self.surfaces[1].rows(seeds[1])

    @cached_property
    def trees(self) -> tuple[KDTree, KDTree]:
        """Of the fresh points."""
        return KDTree(self.fresh[0].points), KDTree(self.fresh[1].points)

    @cached_property
    def blurred(self) -> tuple[np.ndarray, np.ndarray]:
        """Colours (n, 3) of the surfaces as coarse as the volumes."""
        return self.surfaces[0].blurred(), self.surfaces[1].blurred()


def groups_to_try(points: np.ndarray, normals: np.ndarray, extent: float, seed: int) -> list[tuple[np.ndarray, bool]]:
    """Connected pieces of the seeds, and patches and plates of the pieces that are large enough to be several parts.

    Each with whether it may be a whole part: a piece or a plate. Two doors side by side are one piece.
    """
    rng = np.random.default_rng(seed)
    label = components(points, LINK * extent)
    groups = []
    for piece in range(label.max(initial=-1) + 1):
        index = np.flatnonzero(label == piece)
        if len(index) < 12:
            continue
        groups.append((index, True))
        patches = min(len(index) // PATCH, 10)
        if patches >= 2:
            which = kmeans2(points[index], patches, rng=np.random.default_rng(seed), minit="++")[1]
            groups += [(index[which == p], False) for p in range(patches) if (which == p).sum() >= 12]
            flat = [index[rows] for rows in plates(points[index], normals[index], extent, rng)]
            groups += [(rows, True) for rows in flat if len(rows) < MOSTLY * len(index)]
    return groups


def plates(points: np.ndarray, normals: np.ndarray, extent: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Rows of points (n, 3) that lie connected in a plane, the planes that hold most of them first (RANSAC).

    Args:
        normals: (n, 3) unit, either side.
    """
    left, found = np.arange(len(points)), []
    while len(left) >= PATCH:
        p, n = points[left], normals[left]
        tried = rng.choice(len(left), min(TRIED_PLANES, len(left)), replace=False)
        level = np.abs((p @ n[tried].T) - (p[tried] * n[tried]).sum(1)) < LEVEL * extent
        within = level & (np.abs(n @ n[tried].T) > FACING)
        plane = within[:, within.sum(0).argmax()]
        if plane.sum() < PATCH:
            break
        piece = components(p[plane], LINK * extent)
        found += [left[plane][piece == k] for k in np.flatnonzero(np.bincount(piece) >= PATCH)]
        left = left[~plane]
    return found


def axis_directions(groups: Sequence[np.ndarray]) -> np.ndarray:
    """(d, 3) unit directions to try: the world's, and each group's principal ones; none twice (within 8°)."""
    candidates = list(np.eye(3))
    for points in groups:
        candidates += list(np.linalg.svd(points - points.mean(0), full_matrices=False)[2])
    kept: list[np.ndarray] = []
    for d in candidates:
        if all(abs(d @ k) < np.cos(np.radians(8)) for k in kept):
            kept.append(d)
    return np.array(kept[:12])


def edges(points: np.ndarray) -> list[Motion]:
    """Joints of no turn yet about the four edges of a plate, (n, 3) points of it; none of what is no plate.

    The edges are those of the smallest rectangle that holds all but a few of the points.
    """
    middle = points.mean(0)
    principal = np.linalg.svd(points - middle, full_matrices=False)[2]
    flat, across = (points - middle) @ principal[:2].T, (points - middle) @ principal[2]

    def rectangle(angle: float) -> tuple[np.ndarray, np.ndarray]:
        """Directions (2, 2) of its sides, and its lower and upper corner (2, 2) along these."""
        sides = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        return sides, np.quantile(flat @ sides.T, [0.01, 0.99], axis=0)

    sides, corners = min(map(rectangle, np.radians(np.arange(0, 90, 2))), key=lambda r: float(np.ptp(r[1], 0).prod()))
    if np.ptp(np.quantile(across, [0.1, 0.9])) > FLAT * np.sqrt(np.ptp(corners, 0).prod()):
        return []
    along, centre = sides @ principal[:2], corners.mean(0)
    found = []
    for a in (0, 1):
        for end in corners[:, a]:
            place = middle + end * along[a] + centre[1 - a] * along[1 - a]
            found.append(Motion("revolute", along[1 - a], place, 0.0, 0.0))
    return found


def propose(evidence: Evidence, seeds: Sequence[np.ndarray], after: np.ndarray = BASE) -> list[list[Motion]]:
    """Hypotheses, as motions from state 0 to 1, for every group of seeds (rows of both states' surfaces), best first.

    ``after`` (4, 4) is the motion of another part, on which these seeds hang.
    """
    e, surfaces = evidence, evidence.surfaces
    groups = []
    for s in (0, 1):
        there = surfaces[s].rows(seeds[s])
        tried = groups_to_try(there.points, there.normals, e.extent, seed=int(e.rng.integers(2**31)))
        groups += [(s, seeds[s][index], whole) for index, whole in tried]
    if not groups:
        return []
    directions = axis_directions([surfaces[s].points[g] for s, g, _ in groups])
    pools = []
    for s, group, whole in groups:
        chosen = e.rng.choice(group, min(e.config.seeds_per_search, len(group)), replace=False)
        mine, blurred = surfaces[s].rows(chosen), e.blurred[s][chosen]
        then = after if s == 0 else np.linalg.inv(after)
        search = partial(scan, seeds=mine.points, colours=blurred, volume=e.volumes[1 - s], after=then)
        found: list[Motion] = []
        # Of a door that shows its inside in one state and its outside in the other little meets: an edge is its hinge.
        for edge in edges(surfaces[s].points[group]) if whole and len(group) >= PATCH else []:
            found += search("revolute", directions=edge.axis[None], near=edge, keep=2)
        # Slides get a hearing of their own: with three numbers fewer they are seldom the luckiest fit.
        for kind in ("revolute", "prismatic"):
            best = search(kind, directions=directions, keep=4)
            found += [motion for motion in best if motion.score > max(0.1, 0.7 * best[0].score)]
        judged = [liked(values_around(motion, e.extent), mine, surfaces[1 - s].sight, e.extent) for motion in found]
        pool = [motion if s == 0 else inverted(motion) for motion in judged]
        pools.append(sorted(pool, key=lambda m: -m.score))
    return pools


def candidates(evidence: Evidence, seeds: Sequence[np.ndarray], judges: Pair) -> list[Motion]:
    """Motions that may be those of the parts, no two of them alike; none where nothing moved.

    ``seeds`` and ``judges``, some of them, are rows of each state's points. A hypothesis comes from one patch, and is
    off by several per cent of the extent: the most promising of all, and the best of every patch, climb.
    """
    e, surfaces = evidence, evidence.surfaces
    pools = propose(e, seeds)
    pool = list(chain(*pools))
    if not pool:
        return []
    sample = np.concatenate([surfaces[s].points[judges[s][:100]] for s in (0, 1)])

    def promising(motions: Sequence[Motion], least: float, limit: int) -> list[Motion]:
        gain = both_ways(seed_gains, e.seen(judges), motions, e.extent)
        return [motions[k] for k in distinct(motions, gain, sample, least * e.extent, limit)]

    best = [m for motions in pools for m in motions[: e.config.leaders] if m.score > LEADING]
    climbing = promising(pool, START_APART, e.config.starts)
    for motion in best:
        if all(apart(sample, motion.T, other.T) >= START_APART * e.extent for other in climbing):
            climbing.append(motion)
    higher: list[Motion] = []
    for near, steps in CLIMB:
        higher = [_one_round(e, motion, judges, near, steps) for motion in climbing]
        climbing = promising(higher, APART, round(GO_ON * len(higher)))
    slides = [m for m in higher if m.kind == "prismatic"]
    higher += [squared(e, m, _both_concerned(e, m, judges, CLIMB[-1][0])) for m in slides]
    found = promising([*higher, *pool], APART, 2 * e.config.candidates)
    possible = [m for m, odd in zip(found, oddities(e, found, judges), strict=True) if odd < IMPOSSIBLE]
    return possible[: e.config.candidates]


def oddities(evidence: Evidence, motions: Sequence[Motion], seeds: Sequence[np.ndarray]) -> np.ndarray:
    """(motions,) ``oddity`` of each, by those of the seeds (rows of each state's points) that it explains."""
    first, second = evidence.seen(seeds)
    result = np.zeros(len(motions))
    if not motions:
        return result
    gains = both_ways(seed_gains, (first, second), motions, evidence.extent)
    for k, motion in enumerate(motions):
        there, back = np.split(gains[:, k] > GAINED, [len(first.points)])
        T_0_1 = np.linalg.inv(motion.T)
        points = np.concatenate([first.points[there], moved(second.points[back], T_0_1)])
        normals = np.concatenate([first.normals[there], second.normals[back] @ T_0_1[:3, :3].T])
        flat = plates(points, normals, evidence.extent, np.random.default_rng(0)) if motion.kind == "prismatic" else []
        result[k] = oddity(motion, points, points[flat[0]] if flat else points[:0], evidence.extent)
    return result


def both_ways(
    asked: Callable[[Surface, Sight, Sequence[np.ndarray], float], np.ndarray],
    some: tuple[Surface, Surface],
    motions: Sequence[Motion],
    extent: float,
) -> np.ndarray:
    """(points, motions) what each state's photographs say of the other state's points, ``asked`` of both in turn."""
    there, back = map(list, there_and_back(motions))
    first, second = some
    return np.concatenate([asked(first, second.sight, there, extent), asked(second, first.sight, back, extent)])


costs_anywhere = partial(seed_costs, far_cost=0.0)
"""How far a motion takes a seed says nothing of which of its neighbours is right."""


def propose_hanging(evidence: Evidence, seeds: Sequence[np.ndarray], carriers: Sequence[Motion]) -> list[Motion]:
    """Hypotheses for seeds that no joint on the base explains: joints on the parts that the carriers move.

    Only motions that no joint on the base comes near. A latch fits anywhere on the door that carries it, so what the
    carriers explain is not new.
    """
    config, least = evidence.config, HANGING * evidence.extent
    if sum(map(len, seeds)) < config.min_points:
        return []
    evidence = evidence.left_by(carriers)
    pools = [motions[: config.leaders] for carrier in carriers for motions in propose(evidence, seeds, carrier.T)]
    pool = [climbed(evidence, motion, seeds) for motion in chain(*pools)]
    if not pool:
        return []
    points = np.concatenate([evidence.surfaces[s].points[seeds[s]] for s in (0, 1)])
    costs = both_ways(seed_costs, evidence.seen(seeds), pool, evidence.extent)
    agreeing = [points[agree] for agree in (costs < config.agreeing_cost).T]
    return [
        motion
        for motion, own in zip(pool, agreeing, strict=True)
        if len(own) >= config.min_points and misfit(motion.T[None], own) > least
    ]


def climbed(evidence: Evidence, motion: Motion, seeds: Sequence[np.ndarray]) -> Motion:
    """The motion, changed little by little until it explains best those seeds that it seems to concern.

    These are seeds, rows of each state's points, that come to lie on what is new in the other state, and those near
    them: what is off at the edge of a part has to be heard, or nothing would hold a plate in its own plane. A right
    motion that is 8 % of the extent off comes near, as fewer are left out and steps get smaller; a wrong one gets no
    better.
    """
    for near, steps in CLIMB:
        motion = _one_round(evidence, motion, seeds, near, steps)
    return motion


def _one_round(
    evidence: Evidence, motion: Motion, seeds: Sequence[np.ndarray], near: float, steps: Sequence[float]
) -> Motion:
    own = _both_concerned(evidence, motion, seeds, near)
    if min(map(len, own)) < evidence.config.min_concerned:
        return motion
    return _climb(evidence, motion, own, steps, 1e-4)


def _climb(evidence: Evidence, motion: Motion, own: Pair, steps: Sequence[float], least: float) -> Motion:
    """The motion, changed by ``steps`` as long as it costs some of the points it owns (rows) less, by ``least``."""
    e = evidence
    most = e.config.climbing_points
    some = e.seen((e.rng.permutation(own[0])[:most], e.rng.permutation(own[1])[:most]))

    def cost(motions: Sequence[Motion]) -> np.ndarray:
        return both_ways(costs_anywhere, some, motions, e.extent).mean(0)

    best = float(cost([motion])[0])
    for step in steps:
        for _ in range(STEPS):
            trials = around(motion, step, e.extent, e.rng)
            costs = cost(trials)
            if costs.min() > best - least:
                break
            motion, best = trials[int(costs.argmin())], float(costs.min())
    return replace(motion, score=1 - best)


def _both_concerned(evidence: Evidence, motion: Motion, seeds: Sequence[np.ndarray], near: float) -> Pair:
    first, second = motion, inverted(motion)
    return _concerned(evidence, 0, first, seeds[0], near), _concerned(evidence, 1, second, seeds[1], near)


def _concerned(evidence: Evidence, state: int, motion: Motion, seeds: np.ndarray, near: float) -> np.ndarray:
    """Those of the seeds (rows) of a state that a motion from there lays on what is new, and those near them."""
    mine, (fresh, tree) = evidence.surfaces[state].rows(seeds), (evidence.fresh[1 - state], evidence.trees[1 - state])
    gap, index = map(np.asarray, tree.query(moved(mine.points, motion.T), distance_upper_bound=MET * evidence.extent))
    met = np.flatnonzero(np.isfinite(gap))
    there = index[met]
    alike = np.linalg.norm(fresh.colours[there] - mine.colours[met], axis=1) < SAME_COLOUR
    parallel = np.abs((fresh.normals[there] * (mine.normals[met] @ motion.T[:3, :3].T)).sum(1)) > PARALLEL
    met = met[alike & parallel]
    if len(met) == 0:
        return seeds[:0]
    return seeds[KDTree(mine.points[met]).query(mine.points)[0] <= near * evidence.extent]


def around(motion: Motion, step: float, extent: float, rng: np.random.Generator) -> list[Motion]:
    """Motions a step, radians or extents, away from one: along each of its numbers, and some along all."""
    turns = motion.kind == "revolute"
    ways = np.concatenate([np.diag(WIDE), -np.diag(WIDE), rng.normal(size=(ANYWHERE, len(WIDE)))])
    if not turns:  # A slide is nowhere.
        ways = ways[ways[:, [0, 1, 4]].any(1)]
    across = axes_across(motion.axis)
    axes = motion.axis + step * ways[:, :2] @ across
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    pivots = motion.pivot + step * extent * turns * ways[:, 2:4] @ across
    values = motion.value + step * ways[:, 4] * (1 if turns else extent)
    return [
        replace(motion, axis=axis, pivot=pivot, value=float(value))
        for axis, pivot, value in zip(axes, pivots, values, strict=True)
    ]


def distinct(motions: Sequence[Motion], gain: np.ndarray, points: np.ndarray, apart: float, limit: int) -> list[int]:
    """The most promising hypotheses for all of the seeds, small parts' too, no two of them the same.

    ``gain`` (seeds, motions), at most ``WORTH``. A seed counts less with every hypothesis that explains it. Two
    hypotheses are one if they take ``points`` (n, 3) to places that lie within ``apart`` on average.
    """
    ends = moved(points, there_and_back(motions)[0])
    left = np.ones(len(motions), bool)
    weight = np.ones(len(gain))
    kept: list[int] = []
    while left.any() and len(kept) < limit:
        best = int(np.where(left, weight @ gain, -1).argmax())
        kept.append(best)
        weight *= np.where(gain[:, best] > 0.3 * WORTH, 0.7, 1.0)
        left &= np.linalg.norm(ends - ends[best], axis=2).mean(1) > apart
    return kept


def refit(evidence: Evidence, motion: Motion, own: Pair) -> Motion:
    """Refine on the points that the motion owns (rows), from the state that has more of them to those of the other."""
    surfaces, extent, config, rng = evidence.surfaces, evidence.extent, evidence.config, evidence.rng
    s = int(len(own[1]) > len(own[0]))
    if len(own[s]) < config.min_points:
        return motion
    limit = 4 * config.seeds_per_search
    mine, theirs = (surfaces[t].rows(rng.choice(own[t], min(limit, len(own[t])), replace=False)) for t in (s, 1 - s))
    start = motion if s == 0 else inverted(motion)

    def best(motions: Sequence[Motion]) -> Motion:
        return motions[int(both_ways(costs_anywhere, (mine, theirs), motions, extent).sum(0).argmin())]

    if len(theirs.points) < config.min_points:
        fit = polished([start], mine, evidence.fresh[1 - s], extent)
    else:
        # Against the whole of the other state a drawer would cling to the frame that it slides along.
        target = surfaces[1 - s].rows(own[1 - s]).cloud
        once = registered(start, mine.cloud, target, extent)
        trials = [start, once, registered(once, mine.cloud, target, extent)]
        fit = best(values_around(best(trials), extent))
    return squared(evidence, _climb(evidence, fit if s == 0 else inverted(fit), own, SETTLED, CLEARLY), own)


def squared(evidence: Evidence, motion: Motion, own: Pair) -> Motion:
    """A slide on the base laid along what faces look at, if photographs of what it owns (rows) hardly mind."""
    axis = square.nearest(evidence.square, motion.axis, NEARLY_SQUARE) if motion.kind == "prismatic" else None
    if axis is None or not np.array_equal(motion.after, BASE) or sum(map(len, own)) < 2 * evidence.config.min_concerned:
        return motion
    rng, most = np.random.default_rng(0), 2 * evidence.config.climbing_points
    some = evidence.seen((rng.permutation(own[0])[:most], rng.permutation(own[1])[:most]))
    values = motion.value + np.linspace(-SQUARED_REACH, SQUARED_REACH, 25) * evidence.extent
    trials = [replace(motion, axis=axis, value=float(value)) for value in values]
    before, *after = both_ways(costs_anywhere, some, [motion, *trials], evidence.extent).mean(0)
    best = int(np.argmin(after))
    return trials[best] if after[best] < before + HARDLY_MINDS else motion


def values_around(motion: Motion, extent: float) -> list[Motion]:
    """The motion, and a little more or less of it: along a slide only few faces hold a registration."""
    reach = np.radians(3) if motion.kind == "revolute" else 0.02 * extent
    return [replace(motion, value=motion.value + d * reach) for d in (0, -1, -0.5, -0.25, -0.1, 0.1, 0.25, 0.5, 1)]


def polished(trials: Sequence[Motion], mine: Surface, other: Surface, extent: float) -> Motion:
    """The best of some motions, their registrations and a little more or less of these, as the cameras judge them."""
    fits = [registered(m, mine.cloud, other.cloud, extent) for m in trials]
    motion = liked([*trials, *fits], mine, other.sight, extent)
    return liked(values_around(motion, extent), mine, other.sight, extent)


def liked(motions: Sequence[Motion], mine: Surface, other: Sight, extent: float) -> Motion:
    """The best of some motions of a surface, as the other state's cameras judge them; its score says how good."""
    costs = costs_anywhere(mine, other, [m.T for m in motions], extent).mean(0)
    return replace(motions[int(costs.argmin())], score=1 - float(costs.min()))


def registered(motion: Motion, source: Cloud, target: Cloud, extent: float) -> Motion:
    """The motion after registration, of the same kind again: what another degree of freedom took up is dropped."""
    T = register(source, target, motion.T, extent, turn=motion.kind == "revolute")
    T = np.linalg.inv(motion.after) @ T
    centroid = source.points.mean(0)
    if motion.kind == "prismatic":
        shift = T[:3, :3] @ centroid + T[:3, 3] - centroid
        value = float(np.linalg.norm(shift))
        if value < 1e-9:  # Nowhere has no direction.
            return motion
        axis = shift / value
        sign = 1.0 if axis @ motion.axis * motion.value >= 0 else -1.0
        return replace(motion, axis=axis * sign, pivot=centroid, value=value * sign)
    screw = matrix_to_screw(T, centroid)
    if screw.angle < 1e-3:  # A slide has no hinge line.
        return motion
    sign = 1.0 if screw.axis @ motion.axis >= 0 else -1.0
    return replace(motion, axis=screw.axis * sign, pivot=screw.pivot, value=screw.angle * sign)
