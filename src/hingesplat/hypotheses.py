"""Motions that may be those of the parts: from every patch of seeds the likeliest, refined on all that agree."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.cluster.vq import kmeans2

from hingesplat.chains import misfit
from hingesplat.labelling import seed_costs
from hingesplat.register import register
from hingesplat.screw import axes_across, matrix_to_screw
from hingesplat.se3 import moved
from hingesplat.search import BASE, Motion, ScoreVolume, inverted, scan
from hingesplat.stereo import Cloud
from hingesplat.surface import Surface, components

FLAT = 0.2
"""Thickness of a plate, beside its sides."""
PATCH = 60
"""Seeds of a large piece for each patch that may be a part of its own."""
HANGING = 0.02
"""Mean error of the best joint on the base, as a fraction of the extent, from which a part may hang on another."""
WORTH = 0.6
"""A hypothesis is worth as much as it explains its seeds better than this."""


@dataclass(frozen=True)
class HypothesesConfig:
    """Looking for motions."""

    seeds_per_search: int = 128
    """Seeds moved in one search."""
    consensus_cost: float = 0.45
    """A seed agrees with a motion that costs it less than this."""
    consensus_motions: int = 50
    """Hypotheses that are refined on all seeds that agree with them."""
    candidates: int = 80
    """Hypotheses among which the parts' motions are chosen."""
    min_points: int = 25
    """A motion is refined on no fewer points."""


@dataclass(frozen=True)
class Evidence:
    """What every search for motions between two states goes by; pairs are (state 0, the other)."""

    surfaces: tuple[Surface, Surface]
    fresh: tuple[Surface, Surface]
    """The points of each state that the other does not show in the same place: there something may have come to lie."""
    coarse: tuple[ScoreVolume, ScoreVolume]
    fine: tuple[ScoreVolume, ScoreVolume]
    extent: float
    config: HypothesesConfig
    rng: np.random.Generator

    @cached_property
    def blurred(self) -> tuple[np.ndarray, np.ndarray]:
        """Colours (n, 3) of the surfaces as coarse as the volumes."""
        return self.surfaces[0].blurred(), self.surfaces[1].blurred()


def groups_to_try(points: np.ndarray, extent: float, seed: int) -> list[tuple[np.ndarray, bool]]:
    """Connected pieces of the seeds, and patches of the pieces that are large enough to be several parts at once.

    Each with whether it is a whole piece.
    """
    label = components(points, 0.035 * extent)
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
    return groups


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


def propose(evidence: Evidence, seeds: Sequence[np.ndarray], after: np.ndarray = BASE) -> list[Motion]:
    """Hypotheses, as motions from state 0 to 1, from every group of seeds (rows of both states' surfaces).

    ``after`` (4, 4) is the motion of another part, on which these seeds hang.
    """
    e, surfaces = evidence, evidence.surfaces
    groups = []
    for s in (0, 1):
        p = surfaces[s].points[seeds[s]]
        tried = groups_to_try(p, e.extent, seed=int(e.rng.integers(2**31)))
        groups += [(s, seeds[s][index], whole) for index, whole in tried]
    if not groups:
        return []
    directions = axis_directions([surfaces[s].points[g] for s, g, _ in groups])
    pool = []
    for s, group, whole in groups:
        chosen = e.rng.choice(group, min(e.config.seeds_per_search, len(group)), replace=False)
        p, c = surfaces[s].points[chosen], surfaces[s].colours[chosen]
        blurred, then = e.blurred[s][chosen], after if s == 0 else np.linalg.inv(after)

        def add(motion: Motion, s: int = s, chosen: np.ndarray = chosen) -> None:
            motion = polished([motion], surfaces[s].rows(chosen), e.fresh[1 - s], e.extent)
            pool.append(motion if s == 0 else inverted(motion))

        # Of a door that shows its inside in one state and its outside in the other little meets: an edge is its hinge.
        for edge in edges(surfaces[s].points[group]) if whole and len(group) >= PATCH else []:
            for motion in scan("revolute", p, blurred, edge.axis[None], e.coarse[1 - s], near=edge, after=then, keep=1):
                add(motion)
        # Slides get a hearing of their own: with three numbers fewer they are seldom the luckiest fit.
        for kind in ("revolute", "prismatic"):
            found = scan(kind, p, blurred, directions, e.coarse[1 - s], after=then, keep=4)
            for motion in found:
                if motion.score > max(0.1, 0.7 * found[0].score):
                    # Compare hypotheses at their best: on the grid a true one may be 3° off and lose to a lucky one.
                    for spread in (4.0, 1.5):
                        motion = refine_motion(motion, p, c, e.fine[1 - s], spread)
                    add(motion)
    return pool


def propose_hanging(
    evidence: Evidence,
    seeds: Sequence[np.ndarray],
    carriers: Sequence[Motion],
    costs_of: Callable[[Sequence[Motion]], np.ndarray],
) -> list[Motion]:
    """Hypotheses for seeds that no joint on the base explains: joints on the parts that the carriers move.

    Only motions that no joint on the base comes near; ``costs_of`` gives the (seeds, motions) costs of these seeds.
    """
    config, least = evidence.config, HANGING * evidence.extent
    if sum(map(len, seeds)) < config.min_points:
        return []
    pool = [motion for carrier in carriers for motion in propose(evidence, seeds, carrier.T)]
    if not pool:
        return []
    points = np.concatenate([evidence.surfaces[s].points[seeds[s]] for s in (0, 1)])
    agreeing = [points[agree] for agree in (costs_of(pool) < config.consensus_cost).T]
    return [
        motion
        for motion, own in zip(pool, agreeing, strict=True)
        if len(own) >= config.min_points and misfit(motion.T[None], own) > least
    ]


def consensus(
    evidence: Evidence, seeds: Sequence[np.ndarray], pool: Sequence[Motion], costs: np.ndarray
) -> list[Motion]:
    """The most promising hypotheses, each refined on all seeds that agree with it wherever they are.

    A hypothesis comes from one patch; the right one fits the whole part, and grows better with it.
    """
    config = evidence.config
    sample = np.concatenate([evidence.surfaces[s].points[seeds[s][:100]] for s in (0, 1)])
    refined = []
    for k in distinct(pool, costs, sample, 0.02 * evidence.extent, config.consensus_motions):
        agree = costs[:, k] < config.consensus_cost
        own = (seeds[0][agree[: len(seeds[0])]], seeds[1][agree[len(seeds[0]) :]])
        refined.append(refit(evidence, pool[k], own))
    return refined


def distinct(motions: Sequence[Motion], costs: np.ndarray, points: np.ndarray, apart: float, limit: int) -> list[int]:
    """The most promising hypotheses for all of the seeds, small parts' too, no two of them the same.

    ``costs`` (seeds, motions). A seed counts less with every hypothesis that explains it. Two hypotheses are one if
    they take ``points`` (n, 3) to places that lie within ``apart`` on average.
    """
    gain = np.maximum(WORTH - costs, 0)
    ends = np.stack([moved(points, m.T) for m in motions])
    left = np.ones(len(motions), bool)
    weight = np.ones(len(costs))
    kept: list[int] = []
    while left.any() and len(kept) < limit:
        best = int(np.where(left, weight @ gain, -1).argmax())
        kept.append(best)
        weight *= np.where(gain[:, best] > 0.3 * WORTH, 0.7, 1.0)
        left &= np.linalg.norm(ends - ends[best], axis=2).mean(1) > apart
    return kept


def refine_motion(
    motion: Motion, points: np.ndarray, colours: np.ndarray, volume: ScoreVolume, spread_deg: float
) -> Motion:
    """A finer search around one hypothesis: its axis tilted by up to ``spread_deg``, angles and slides to match."""
    tilt = np.tan(np.radians(spread_deg))
    u, w = axes_across(motion.axis)
    tilted = np.array([motion.axis + tilt * (a * u + b * w) for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b])
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    values = motion.value + np.linspace(-1, 1, 9) * (
        np.radians(spread_deg) if motion.kind == "revolute" else 2 * volume.voxel
    )
    straight, best = (
        scan(motion.kind, points, colours, axes, volume, values=values, near=motion, after=motion.after, keep=1)[0]
        for axes in (motion.axis[None], tilted)
    )
    # The volume is coarse: an axis is tilted only for a clear gain, and the photographs settle the rest later.
    return best if best.score > straight.score + 0.02 else straight


def refit(evidence: Evidence, motion: Motion, own: tuple[np.ndarray, np.ndarray]) -> Motion:
    """Refine on the points that the motion owns (rows), from the state that has more of them to those of the other."""
    surfaces, extent, config, rng = evidence.surfaces, evidence.extent, evidence.config, evidence.rng
    s = int(len(own[1]) > len(own[0]))
    if len(own[s]) < config.min_points:
        return motion
    limit = 4 * config.seeds_per_search
    mine, theirs = (surfaces[t].rows(rng.choice(own[t], min(limit, len(own[t])), replace=False)) for t in (s, 1 - s))
    start = motion if s == 0 else inverted(motion)
    if len(theirs.points) < config.min_points:
        few = mine.rows(np.arange(min(2 * config.seeds_per_search, len(mine.points))))
        near = refine_motion(start, few.points, few.colours, evidence.fine[1 - s], 3.0)
        fit = polished([start, near], mine, evidence.fresh[1 - s], extent)
        return fit if s == 0 else inverted(fit)
    # Against the whole of the other state a drawer would cling to the frame that it slides along.
    target = surfaces[1 - s].rows(own[1 - s]).cloud
    once = registered(start, mine.cloud, target, extent)
    trials = [start, once, registered(once, mine.cloud, target, extent)]

    def best(motions: Sequence[Motion]) -> Motion:
        there = seed_costs(mine, surfaces[1 - s].sight, [m.T for m in motions], extent, 0.0).sum(0)
        back = seed_costs(theirs, surfaces[s].sight, [inverted(m).T for m in motions], extent, 0.0).sum(0)
        return motions[int((there + back).argmin())]

    fit = best(values_around(best(trials), extent))
    return fit if s == 0 else inverted(fit)


def values_around(motion: Motion, extent: float) -> list[Motion]:
    """The motion, and a little more or less of it: along a slide only few faces hold a registration."""
    reach = np.radians(3) if motion.kind == "revolute" else 0.02 * extent
    return [replace(motion, value=motion.value + d * reach) for d in (0, -1, -0.5, -0.25, -0.1, 0.1, 0.25, 0.5, 1)]


def polished(trials: Sequence[Motion], mine: Surface, other: Surface, extent: float) -> Motion:
    """The best of some motions, their registrations and a little more or less of these, as the cameras judge them."""

    def best(motions: Sequence[Motion]) -> Motion:
        costs = seed_costs(mine, other.sight, [m.T for m in motions], extent, 0.0)
        return motions[int(costs.mean(0).argmin())]

    motion = best([*trials, *(registered(m, mine.cloud, other.cloud, extent) for m in trials)])
    return best(values_around(motion, extent))


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
