"""Which Gaussians move, with which rigid motion, and how many parts that makes. No number of parts is needed.

Seeds are surface points that the other state's cameras would see floating in free space: they must have moved. Every
motion of one degree of freedom is tried on them (``search``). Surface points of both states vote for a motion, each
with its neighbours and with the place where it would go (``labelling``); those motions are kept that explain most at
the least description length, look-alikes told apart by their texture (``texture``). Gaussians take the label of the
nearest point.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from hingesplat.capture import View
from hingesplat.drawer import insides
from hingesplat.gaussians import Gaussians
from hingesplat.hypotheses import (
    Evidence,
    HypothesesConfig,
    consensus,
    distinct,
    polished,
    propose,
    propose_hanging,
    refit,
)
from hingesplat.labelling import Choices, Labelling, seed_costs
from hingesplat.pieces import follow_fronts, give_way, reattach_fragments, seen_to_move, split_pieces
from hingesplat.se3 import moved
from hingesplat.search import BASE, Motion, ScoreVolume, carrier_of, inverted, novelty, scan, score_volume
from hingesplat.stereo import DepthMap
from hingesplat.surface import Pair, Surface, bounds, surface_of, thin
from hingesplat.texture import (
    TextureConfig,
    against,
    compared,
    fitted,
    photographs_of,
    told_apart,
    vouched_for,
)
from hingesplat.training import evenly
from hingesplat.visibility import FREE, HIDDEN, ask

ALONE = 0.5
"""Share of a hanging part's points that nothing else may explain nearly as well; else they are those of a door whose
motion is a little off."""
ALIKE = 0.06
"""Extents between the places to which two motions take points, in the mean, for them to be nearly the same."""


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
    """Voxels along the object's longest side in the coarse search."""
    max_seeds: int = 1200
    """Seeds of each state that judge the hypotheses."""
    explained_cost: float = 0.8
    """A seed that a motion explains worse than this counts as unexplained."""
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
    extent = float((high - low).max())
    sights = [surface.sight for surface in surfaces]
    seeds, answers = must_have_moved(surfaces, extent, rng)
    # Where both states show a surface, nothing that moved has come to lie.
    fresh = [s.rows(np.flatnonzero(novelty(a) > 0.5)) for s, a in zip(surfaces, answers, strict=True)]

    def volumes(cells: int) -> tuple[ScoreVolume, ScoreVolume]:
        first, last = (
            score_volume(surfaces[s].points, surfaces[s].colours, sights[s], sights[1 - s], low, high, cells)
            for s in (0, 1)
        )
        return first, last

    coarse, fine = volumes(config.cells), volumes(2 * config.cells)
    return Evidence(surfaces, (fresh[0], fresh[1]), coarse, fine, extent, config.hypotheses, rng), seeds


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
    rng = np.random.default_rng(seed)
    low, high, surfaces = survey(gaussians, views, maps, config)
    evidence, seeds = gather(surfaces, low, high, config, rng)
    extent = evidence.extent
    pool = propose(evidence, seeds)
    n_seeds = sum(len(i) for i in seeds)
    if not pool:
        empty = (np.zeros(len(gaussians[0]), int), np.zeros(len(gaussians[1]), int))
        return Segmentation(empty, (), 0.0, n_seeds)

    judging = [index[: config.max_seeds] for index in seeds]
    judges = [s.rows(index) for s, index in zip(surfaces, judging, strict=True)]

    def costs_of(candidates: Sequence[Motion]) -> np.ndarray:
        """(seeds, candidates) what the other state's cameras say of every seed under every candidate."""
        forward, backward = [m.T for m in candidates], [inverted(m).T for m in candidates]
        return np.concatenate(
            [
                seed_costs(judges[0], surfaces[1].sight, forward, extent),
                seed_costs(judges[1], surfaces[0].sight, backward, extent),
            ]
        )

    costs = costs_of(pool)
    pool += consensus(evidence, judging, pool, costs)
    costs = np.concatenate([costs, costs_of(pool[costs.shape[1] :])], 1)
    sample = np.concatenate([j.points[:100] for j in judges])
    chosen = [pool[k] for k in distinct(pool, costs, sample, 0.012 * extent, config.hypotheses.candidates)]

    rows = [thin(surface.points, 2 * config.spacing * extent, rng) for surface in surfaces]
    problem = Labelling.of((surfaces[0].rows(rows[0]), surfaces[1].rows(rows[1])), extent)

    def settled(candidates: list[Motion], prices: list[float]) -> list[Motion]:
        """Those of the candidates that there are, refined on what they own."""
        owners: list[Pair] = []
        for _ in range(config.rounds):
            shared = one_for_two(evidence, candidates, owners)
            candidates, prices = candidates + list(shared.values()), prices + [prices[k] for k, _ in shared]
            choices = Choices(problem, [m.T for m in candidates])
            kept = sorted(choices.best(np.array(prices), parts))
            owned = choices.labels(kept)
            owners = [(rows[0][owned[0] == i + 1], rows[1][owned[1] == i + 1]) for i in range(len(kept))]
            candidates = [refit(evidence, candidates[k], own) for k, own in zip(kept, owners, strict=True)]
            prices = [prices[k] for k in kept]
        return candidates

    prices = [config.part_cost] * len(chosen)
    if config.texture.patches:
        photographs = [photographs_of(g, v, config.texture) for g, v in zip(gaussians, views, strict=True)]

        def texture(k: int | None, mine: Pair) -> list[tuple[np.ndarray, float]]:
            T_1_0 = BASE if k is None else ways[k]
            return compared(problem.surfaces, photographs, T_1_0, mine, extent, config.texture, seed)

        def likeness(k: int | None, mine: Pair) -> np.ndarray:
            return np.concatenate([found for found, _ in texture(k, mine)])

        def nearly(j: int, k: int, mine: Pair) -> bool:
            return alike(problem.surfaces[0].points[mine[0]], ways[j], ways[k], extent)

        ways = [m.T for m in chosen]
        choices = Choices(problem, ways)
        told = told_apart(choices, lambda *asked: against(texture(*asked)), config.part_cost, parts)
        told = vouched_for(choices, told, nearly, likeness, config.part_cost, parts)
        chosen, prices = [chosen[k] for k in told], list(told.values())
    chosen = settled(chosen, prices)
    # What no joint on the base explains may hang on another part.
    left = np.flatnonzero(costs_of(chosen).min(1) >= config.explained_cost) if chosen else np.zeros(0, int)
    stray = [judging[0][left[left < len(judging[0])]], judging[1][left[left >= len(judging[0])] - len(judging[0])]]
    hanging = propose_hanging(evidence, stray, chosen, lambda motions: costs_of(motions)[left])
    if hanging:
        more = settled([*chosen, *hanging], [config.hanging_cost] * (len(chosen) + len(hanging)))
        alone = problem.alone([motion.T for motion in more])
        more = [m for m, share in zip(more, alone, strict=True) if carrier_of(m, more) is None or share > ALONE]
        if any(carrier_of(motion, more) is not None for motion in more):
            chosen = more
    if config.texture.patches and not any(carrier_of(m, chosen) is not None for m in chosen):
        here, label = problem.surfaces[0], problem.labels([m.T for m in chosen])[0]
        mine = [rng.permutation(np.flatnonzero(label == k + 1)) for k in range(len(chosen))]
        chosen = [
            fitted(m, here.rows(own[: config.texture.corrected]), photographs, extent)
            for m, own in zip(chosen, mine, strict=True)
        ]
    problem = Labelling.of(surfaces, extent)
    owned = problem.labels([m.T for m in chosen])
    pieces = split_pieces(chosen, owned, surfaces, extent, config.min_part_seeds)
    if parts is None or len(pieces[0]) <= parts:
        chosen, owned = pieces
    transforms = [m.T for m in chosen]
    owned = give_way(transforms, reattach_fragments(transforms, owned, surfaces, extent), surfaces, extent)
    owned = insides(transforms, follow_fronts(transforms, owned, surfaces, extent), surfaces, extent)
    chosen, owned = seen_to_move(chosen, owned, surfaces, config.min_part_seeds)
    costs = costs_of(chosen) if chosen else np.ones((1, 1))
    unexplained = float((costs.min(1) >= config.explained_cost).mean())
    labels = tuple(spread_labels(gaussians[s].means.numpy(), surfaces[s], owned[s]) for s in (0, 1))
    return Segmentation((labels[0], labels[1]), tuple(chosen), unexplained, n_seeds)


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
    apart = np.linalg.norm(moved(points, first) - moved(points, second), axis=1)
    return len(points) > 0 and float(apart.mean()) < ALIKE * extent


def segment_states(
    gaussians: Sequence[Gaussians],
    views: Sequence[Sequence[View]],
    config: SegmentConfig,
    *,
    maps: Sequence[Sequence[DepthMap]] = (),
    parts: int | None = None,
    seed: int = 0,
) -> tuple[Segmentation, int, np.ndarray]:
    """Parts of an object in two or more states, wherever they move.

    The state in which most has moved since state 0 comes first. Then each of the others is searched, if more moves in
    it than the parts known so far explain: a part may rest in all states but one.

    Args:
        gaussians: fitted to every state.
        views: the training photographs of every state.
        maps: the depth of these photographs where it is known.
        parts: number of movable parts at most, or None to find it.

    Returns:
        The parts, with labels of state 0 and of that other state; the number of that state; and where each part is in
        every state, T_state_0 (states, 1 + parts, 4, 4), the base first.
    """
    maps = maps or [()] * len(views)

    def beside(t: int) -> tuple[tuple[Gaussians, Gaussians], tuple[Sequence[View], Sequence[View]]]:
        return (gaussians[0], gaussians[t]), (views[0], views[t])

    def more(t: int) -> dict[str, Any]:
        return {"maps": (maps[0], maps[t]), "seed": seed}

    others, moving = list(range(1, len(gaussians))), {}
    if len(others) > 1:
        moving = {t: _moving(*beside(t), config, **more(t)) for t in others}
        others.sort(key=lambda t: -sum(map(len, moving[t][1])))
    most = others[0]
    found = segment(*beside(most), config, parts=parts, **more(most))
    place = {(most, k): motion.T for k, motion in enumerate(found.motions)}
    for t in others[1:]:
        known = track(*beside(t), found.labels[0], found.motions, config, **more(t))
        place |= {(t, k): T for k, T in enumerate(known)}
        room = None if parts is None else parts - len(found.motions)
        if room == 0 or _left_over(gaussians[0], found.labels[0], known, moving[t]) < config.min_left_over:
            continue
        here = segment(*beside(t), config, **more(t))
        for k, motion in enumerate(here.motions[:room]):
            mine = here.labels[0] == k + 1
            new = mine & (found.labels[0] == 0)
            if 2 * new.sum() > mine.sum():
                place[t, len(found.motions)] = motion.T
                found = _with_part(found, motion, new, (gaussians[0], gaussians[most]))
    T_state_0 = np.tile(np.eye(4), (len(gaussians), 1 + len(found.motions), 1, 1))
    for t in others:
        if any((t, k) not in place for k in range(len(found.motions))):
            late = track(*beside(t), found.labels[0], found.motions, config, **more(t))
            place = {(t, k): T for k, T in enumerate(late)} | place
        for k in range(len(found.motions)):
            T_state_0[t, 1 + k] = place[t, k]
    return found, most, T_state_0


def _moving(
    gaussians: tuple[Gaussians, Gaussians],
    views: tuple[Sequence[View], Sequence[View]],
    config: SegmentConfig,
    *,
    maps: tuple[Sequence[DepthMap], Sequence[DepthMap]],
    seed: int,
) -> tuple[float, list[np.ndarray]]:
    """The extent of two states, and each state's points (n, 3), thinned, that must have moved."""
    rng = np.random.default_rng(seed)
    low, high, surfaces = survey(gaussians, views, maps, config)
    extent = float((high - low).max())
    rows = must_have_moved(surfaces, extent, rng)[0]
    return extent, [surface.points[index] for surface, index in zip(surfaces, rows, strict=True)]


def _left_over(
    gaussians: Gaussians, labels: np.ndarray, T_t_0: Sequence[np.ndarray], moving: tuple[float, list[np.ndarray]]
) -> int:
    """How many of the points that must have moved belong to none of the parts known, in either state."""
    extent, (here, there) = moving
    means = gaussians.means.numpy()
    at_end = np.concatenate([means[:0], *(moved(means[labels == k], T) for k, T in enumerate(T_t_0, 1))])
    count = int((labels[KDTree(means).query(here)[1]] == 0).sum()) if len(here) else 0
    if len(at_end) == 0 or len(there) == 0:
        return count + len(there)
    return count + int((KDTree(at_end).query(there)[0] > 0.03 * extent).sum())


def _with_part(
    found: Segmentation, motion: Motion, rows: np.ndarray, gaussians: tuple[Gaussians, Gaussians]
) -> Segmentation:
    """One part more, that of ``rows`` (n,) bool of state 0's Gaussians; in the other state of ``found`` it rests."""
    here, there = (g.means.numpy() for g in gaussians)
    part, labels = len(found.motions) + 1, (found.labels[0].copy(), found.labels[1].copy())
    labels[0][rows] = part
    labels[1][(labels[1] == 0) & rows[KDTree(here).query(there)[1]]] = part
    return replace(found, labels=labels, motions=(*found.motions, motion))


def track(
    gaussians: tuple[Gaussians, Gaussians],
    views: tuple[Sequence[View], Sequence[View]],
    labels: np.ndarray,
    motions: Sequence[Motion],
    config: SegmentConfig,
    *,
    maps: tuple[Sequence[DepthMap], Sequence[DepthMap]] = ((), ()),
    seed: int = 0,
) -> list[np.ndarray]:
    """T_t_0 (4×4) of every part in a further state, its joint known from another pair of states.

    Args:
        gaussians: fitted to state 0 and to the further state t.
        views: the training photographs of the same two states.
        labels: part id of every Gaussian of state 0.
        motions: each part's joint, as ``segment`` found it.
    """
    rng = np.random.default_rng(seed)
    low, high, (here, there) = survey(gaussians, views, maps, config)
    extent = float((high - low).max())
    volume = score_volume(there.points, there.colours, there.sight, here.sight, low, high, 2 * config.cells)
    own_label = labels[KDTree(gaussians[0].means.numpy()).query(here.points)[1]]
    carriers = [carrier_of(motion, motions) for motion in motions]
    found: dict[int, np.ndarray] = {}
    for k in sorted(range(len(motions)), key=lambda k: carriers[k] is not None):
        motion, carrier = motions[k], carriers[k]
        after = BASE if carrier is None else found[carrier]
        own = np.flatnonzero(own_label == k + 1)
        if len(own) < config.min_part_seeds:
            found[k] = after
            continue
        motion = replace(motion, value=0.0, after=after)
        mine = here.rows(rng.choice(own, min(2 * config.hypotheses.seeds_per_search, len(own)), replace=False))
        reach = np.radians(150) if motion.kind == "revolute" else extent / 2
        trials = scan(
            motion.kind,
            mine.points,
            mine.colours,
            motion.axis[None],
            volume,
            values=np.linspace(-reach, reach, 201),
            near=motion,
            after=after,
            keep=6,
        )
        found[k] = polished([motion, *trials], mine, there, extent).T
    return [found[k] for k in range(len(motions))]


def spread_labels(points: np.ndarray, surface: Surface, labels: np.ndarray) -> np.ndarray:
    """(n,) labels for all Gaussians at points (n, 3): each takes its nearest surface point's."""
    return labels[KDTree(surface.points).query(points)[1]]


__all__ = ["SegmentConfig", "Segmentation", "segment", "segment_states", "track"]
