"""Which Gaussians move, with which rigid motion, and how many parts that makes. No number of parts is needed.

Seeds are surface points that the other state's cameras would see floating in free space: they must have moved. Every
motion of one degree of freedom is tried on them (``search``), the fewest motions that explain most seeds are kept
(description length), and all Gaussians of both states then vote for a label, each with its neighbours and with the
place where its label says it went.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.sparse import coo_matrix, csr_matrix, identity
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from hingesplat.capture import View
from hingesplat.gaussians import Gaussians
from hingesplat.register import register
from hingesplat.screw import matrix_to_screw
from hingesplat.search import Motion, ScoreVolume, novelty, scan, score_volume
from hingesplat.stereo import Cloud, DepthMap
from hingesplat.surface import Surface, bounds, free_share, surface_of, thin
from hingesplat.visibility import COLOUR, FREE, HIDDEN, SURFACE, Sight, ask

Labels = tuple[np.ndarray, np.ndarray]
"""Part id of every surface point of the two states."""

LARGE_PIECE = 0.2
"""A piece this large beside the largest of its part is a part of its own, not a fragment."""

PATCH = 60
"""Seeds of a large piece for each patch that may be a part of its own."""

PROMISING = 0.6
"""A hypothesis is worth as much as it explains its seeds better than this."""

ARRIVED = 4
"""Views that must see a surface where a motion takes a point, for the point to have been seen there."""

UNEXPLAINED = 0.35
"""What a point costs at most when motions are chosen: a little more than one that a motion hides."""

HIDDEN_SEED_COST = 0.4
"""Cost of a seed that a motion takes out of everybody's sight."""


@dataclass(frozen=True)
class SegmentConfig:
    """Finding the parts and their first motions."""

    sight_size: int = 200
    """Longest side in pixels of the depth pictures that judge the hypotheses."""
    tolerance: float = 0.012
    """Half-width of a surface, as a fraction of the object's extent."""
    spacing: float = 0.015
    """Distance of the surface points that are labelled, as a fraction of the object's extent."""
    cells: int = 48
    """Voxels along the object's longest side in the coarse search."""
    seeds_per_search: int = 128
    """Seeds moved in one search."""
    max_seeds: int = 1200
    """Seeds of each state that judge the hypotheses."""
    explained_cost: float = 0.8
    """A seed that a motion explains worse than this counts as unexplained."""
    consensus_cost: float = 0.45
    """A seed agrees with a motion that costs it less than this."""
    consensus_motions: int = 50
    """Hypotheses that are refined on all seeds that agree with them."""
    part_cost: float = 36.0
    """Description length of one more part, in points (a point stands for 0.03² of the extent's square)."""
    min_part_seeds: int = 25
    """A part must own at least this many seeds."""
    candidates: int = 80
    """Hypotheses among which the parts' motions are chosen."""
    rounds: int = 3
    """Rounds of relabelling and refining the motions."""


@dataclass(frozen=True)
class Segmentation:
    """Parts found: part k + 1 moves by ``motions[k]`` from state 0 to the other state."""

    labels: tuple[np.ndarray, np.ndarray]
    """Part id of every Gaussian of the two states."""
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
    first, second = (
        surface_of(g, v, m, config.sight_size, spacing, tolerance)
        for g, v, m in zip(gaussians, views, maps, strict=True)
    )
    return low, high, (first, second)


def floating(answer: np.ndarray) -> np.ndarray:
    """(n,) bool: points that enough of the other state's cameras see in free space."""
    return (answer[:, FREE] >= 3) & (answer[:, FREE] > 0.15 * answer[:, : HIDDEN + 1].sum(1))


def components(points: np.ndarray, radius: float, *, bridges: bool = True) -> np.ndarray:
    """(n,) label of the connected piece each point belongs to, neighbours being closer than ``radius``.

    Without ``bridges``, points with less than half the usual number of neighbours connect nothing: each only joins
    the nearest that has more.
    """
    if len(points) == 0:
        return np.zeros(0, int)
    tree = KDTree(points)
    pairs = tree.query_pairs(radius, output_type="ndarray")
    if not bridges:
        degree = np.bincount(pairs.ravel(), minlength=len(points))
        dense = 2 * degree >= np.median(degree)
        distance, nearest = map(np.asarray, KDTree(points[dense]).query(points[~dense]))
        joins = np.column_stack([np.flatnonzero(~dense), np.flatnonzero(dense)[nearest]])
        pairs = np.concatenate([pairs[dense[pairs].all(1)], joins[distance < radius]])
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    return connected_components(graph, directed=False)[1]


def spacing(points: np.ndarray) -> float:
    """Median distance of points (n, 3) to their nearest neighbour; 0 for fewer than two."""
    if len(points) < 2:
        return 0.0
    return float(np.median(KDTree(points).query(points, 2)[0][:, 1]))


def groups_to_try(points: np.ndarray, extent: float, seed: int) -> list[np.ndarray]:
    """Connected pieces of the seeds, and patches of the pieces that are large enough to be several parts at once."""
    label = components(points, 0.035 * extent)
    groups = []
    for piece in range(label.max(initial=-1) + 1):
        index = np.flatnonzero(label == piece)
        if len(index) < 12:
            continue
        groups.append(index)
        patches = min(len(index) // PATCH, 10)
        if patches >= 2:
            which = kmeans2(points[index], patches, rng=np.random.default_rng(seed), minit="++")[1]
            groups += [index[which == p] for p in range(patches) if (which == p).sum() >= 12]
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


def inverted(motion: Motion) -> Motion:
    return replace(motion, value=-motion.value)


def moved(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Points (n, 3) under a 4×4 transform."""
    return points @ T[:3, :3].T + T[:3, 3]


def distinct(motions: Sequence[Motion], costs: np.ndarray, points: np.ndarray, apart: float, limit: int) -> list[int]:
    """The most promising hypotheses for all of the seeds, small parts' too, no two of them the same.

    ``costs`` (seeds, motions). A seed counts less with every hypothesis that explains it. Two hypotheses are one if
    they take ``points`` (n, 3) to places that lie within ``apart`` on average.
    """
    gain = np.maximum(PROMISING - costs, 0)
    ends = np.stack([moved(points, m.T) for m in motions])
    left = np.ones(len(motions), bool)
    weight = np.ones(len(costs))
    kept: list[int] = []
    while left.any() and len(kept) < limit:
        best = int(np.where(left, weight @ gain, -1).argmax())
        kept.append(best)
        weight *= np.where(gain[:, best] > 0.3 * PROMISING, 0.7, 1.0)
        left &= np.linalg.norm(ends - ends[best], axis=2).mean(1) > apart
    return kept


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


def refine_motion(
    motion: Motion, points: np.ndarray, colours: np.ndarray, volume: ScoreVolume, spread_deg: float
) -> Motion:
    """A finer search around one hypothesis: its axis tilted by up to ``spread_deg``, angles and slides to match."""
    tilt = np.tan(np.radians(spread_deg))
    helper = np.eye(3)[np.abs(motion.axis).argmin()]
    u = np.cross(motion.axis, helper)
    u /= np.linalg.norm(u)
    w = np.cross(motion.axis, u)
    tilted = np.array([motion.axis + tilt * (a * u + b * w) for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b])
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    values = motion.value + np.linspace(-1, 1, 9) * (
        np.radians(spread_deg) if motion.kind == "revolute" else 2 * volume.voxel
    )
    kinds = (motion.kind,)
    (straight,) = scan(points, colours, motion.axis[None], volume, kinds=kinds, values=values, near=motion, keep=1)
    (best,) = scan(points, colours, tilted, volume, kinds=kinds, values=values, near=motion, keep=1)
    # The volume is coarse: an axis is tilted only for a clear gain, and the photographs settle the rest later.
    return best if best.score > straight.score + 0.02 else straight


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


def softmax(x: np.ndarray) -> np.ndarray:
    e = np.exp(x - x.max(1, keepdims=True))
    return e / e.sum(1, keepdims=True)


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
        parts: number of movable parts, or None to find it.
    """
    rng = np.random.default_rng(seed)
    low, high, surfaces = survey(gaussians, views, maps, config)
    extent = float((high - low).max())
    sights = [surface.sight for surface in surfaces]
    answers = [ask(surfaces[s].points, surfaces[s].colours, sights[1 - s]) for s in (0, 1)]
    seeds = []
    for surface, answer in zip(surfaces, answers, strict=True):
        index = np.flatnonzero(floating(answer))
        seeds.append(index[thin(surface.points[index], 0.012 * extent, rng)])
    # Where both states show a surface, nothing that moved has come to lie.
    fresh = [s.rows(np.flatnonzero(novelty(a) > 0.5)) for s, a in zip(surfaces, answers, strict=True)]

    def volume(s: int, cells: int) -> ScoreVolume:
        return score_volume(surfaces[s].points, surfaces[s].colours, sights[s], sights[1 - s], low, high, cells)

    coarse, fine = [volume(s, config.cells) for s in (0, 1)], [volume(s, 2 * config.cells) for s in (0, 1)]
    pool = propose(surfaces, fresh, seeds, coarse, fine, extent, config, rng)
    n_seeds = sum(len(i) for i in seeds)
    if not pool:
        empty = (np.zeros(len(gaussians[0]), int), np.zeros(len(gaussians[1]), int))
        return Segmentation(empty, (), 0.0, n_seeds)

    judges = [s.rows(i[: config.max_seeds]) for s, i in zip(surfaces, seeds, strict=True)]

    def costs_of(candidates: Sequence[Motion]) -> np.ndarray:
        """(seeds, candidates) what the other state's cameras say of every seed under every candidate."""
        forward, backward = [m.T for m in candidates], [inverted(m).T for m in candidates]
        return np.concatenate(
            [seed_costs(judges[0], sights[1], forward, extent), seed_costs(judges[1], sights[0], backward, extent)]
        )

    costs = costs_of(pool)
    pool += consensus(pool, costs, surfaces, fresh, [i[: config.max_seeds] for i in seeds], fine, extent, config, rng)
    costs = np.concatenate([costs, costs_of(pool[costs.shape[1] :])], 1)
    sample = np.concatenate([j.points[:100] for j in judges])
    chosen = [pool[k] for k in distinct(pool, costs, sample, 0.012 * extent, config.candidates)]

    rows = [thin(surface.points, 2 * config.spacing * extent, rng) for surface in surfaces]
    problem = Labelling.of((surfaces[0].rows(rows[0]), surfaces[1].rows(rows[1])), extent)
    kept = eliminate(problem.smoothed([m.T for m in chosen]), config.part_cost / 6, parts)
    chosen = [chosen[k - 1] for k in kept]
    for _ in range(config.rounds):
        kept, owned = problem.solve([m.T for m in chosen], config.part_cost, parts)
        chosen = [
            _refit(
                chosen[k],
                (rows[0][owned[0] == i + 1], rows[1][owned[1] == i + 1]),
                surfaces,
                fresh,
                fine,
                extent,
                config,
                rng,
            )
            for i, k in enumerate(kept)
        ]
    problem = Labelling.of(surfaces, extent)
    owned = problem.labels([m.T for m in chosen])
    if parts is None:
        chosen, owned = split_pieces(chosen, owned, surfaces, extent, config)
    owned = reattach_fragments([m.T for m in chosen], owned, surfaces, extent)
    costs = costs_of(chosen) if chosen else np.ones((1, 1))
    unexplained = float((costs.min(1) >= config.explained_cost).mean())
    labels = tuple(spread_labels(gaussians[s].means.numpy(), surfaces[s], owned[s]) for s in (0, 1))
    return Segmentation((labels[0], labels[1]), tuple(chosen), unexplained, n_seeds)


def split_pieces(
    motions: Sequence[Motion],
    owned: Labels,
    surfaces: tuple[Surface, Surface],
    extent: float,
    config: SegmentConfig,
) -> tuple[list[Motion], Labels]:
    """One part is one piece: two large pieces far apart that share a motion become two parts with that motion.

    Two doors one above the other, turned by the same angle about the same line, are such a pair.
    """
    owned = _rejoined(motions, owned, surfaces, extent)
    result: list[Motion] = []
    labels = (np.zeros_like(owned[0]), np.zeros_like(owned[1]))
    for k, motion in enumerate(motions):
        # Two doors edge to edge are linked by a few points at most.
        rows, piece = _pieces(k + 1, motion.T, owned, surfaces, extent, bridges=False)
        each = [np.bincount(p, minlength=max(int(q.max(initial=0)) for q in piece) + 1) for p in piece]
        size = each[0] + each[1]
        # A part is seen in both states; what is seen in one only is the inside of something.
        large = size >= max(LARGE_PIECE * size.max(), 5 * config.min_part_seeds)
        both = np.minimum(*each) >= config.min_part_seeds
        large &= both
        large[np.where(both, size, 0).argmax() if both.any() else size.argmax()] = size.max() > 0
        for p in np.flatnonzero(large):
            result.append(motion)
            for s in (0, 1):
                labels[s][rows[s][piece[s] == p]] = len(result)
        for s in (0, 1):
            # Small pieces stay with their motion for now; ``reattach_fragments`` judges them.
            lost = rows[s][labels[s][rows[s]] == 0]
            found = rows[s][labels[s][rows[s]] > 0]
            if len(lost) and len(found):
                points = surfaces[s].points
                labels[s][lost] = labels[s][found][KDTree(points[found]).query(points[lost])[1]]
    return result, labels


def _rejoined(motions: Sequence[Motion], owned: Labels, surfaces: tuple[Surface, Surface], extent: float) -> Labels:
    """Stray pieces go to a part that they touch and that would take them to the same place."""
    labels = (owned[0].copy(), owned[1].copy())
    for k, motion in enumerate(motions):
        rows, piece = _pieces(k + 1, motion.T, owned, surfaces, extent)
        size = np.bincount(np.concatenate(piece), minlength=1)
        for p in np.flatnonzero((size > 0) & (np.arange(len(size)) != size.argmax())):
            mine = [rows[s][piece[s] == p] for s in (0, 1)]
            s = int(len(mine[1]) > len(mine[0]))
            points = surfaces[s].points[mine[s]]
            for j, other in enumerate(motions):
                theirs = surfaces[s].points[owned[s] == j + 1]
                ends = [moved(points, T if s == 0 else np.linalg.inv(T)) for T in (motion.T, other.T)]
                alike = np.linalg.norm(ends[0] - ends[1], axis=1).mean() < 0.03 * extent
                if j != k and alike and len(theirs) and KDTree(theirs).query(points)[0].min() < 0.03 * extent:
                    for state in (0, 1):
                        labels[state][mine[state]] = j + 1
                    break
    return labels


def reattach_fragments(
    T_1_0: Sequence[np.ndarray], owned: Labels, surfaces: tuple[Surface, Surface], extent: float
) -> Labels:
    """Small pieces apart from their part's main one go to whatever they touch: nothing floats in the air."""
    stray = (np.zeros(len(owned[0]), bool), np.zeros(len(owned[1]), bool))
    for k, T in enumerate([np.eye(4), *T_1_0]):
        rows, piece = _pieces(k, T, owned, surfaces, extent)
        size = np.bincount(np.concatenate(piece), minlength=1)
        small = size < (size.max() if k else 0.02 * size.max())
        for s in (0, 1):
            stray[s][rows[s][small[piece[s]]]] = True
    labels = (owned[0].copy(), owned[1].copy())
    for s in (0, 1):
        if stray[s].any() and not stray[s].all():
            points = surfaces[s].points
            nearest = KDTree(points[~stray[s]]).query(points[stray[s]])[1]
            labels[s][stray[s]] = owned[s][~stray[s]][nearest]
    return labels


def _pieces(
    label: int,
    T_1_0: np.ndarray,
    owned: Labels,
    surfaces: tuple[Surface, Surface],
    extent: float,
    *,
    bridges: bool = True,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Rows of one part's points in each state, and the connected piece of each, both states laid over each other."""
    rows = [np.flatnonzero(o == label) for o in owned]
    both = np.concatenate([moved(surfaces[0].points[rows[0]], T_1_0), surfaces[1].points[rows[1]]])
    piece = components(both, max(0.025 * extent, 2.5 * spacing(both)), bridges=bridges)
    return rows, np.split(piece, [len(rows[0])])


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
    found = []
    for k, motion in enumerate(motions):
        own = np.flatnonzero(own_label == k + 1)
        if len(own) < config.min_part_seeds:
            found.append(np.eye(4))
            continue
        mine = here.rows(rng.choice(own, min(2 * config.seeds_per_search, len(own)), replace=False))
        reach = np.radians(150) if motion.kind == "revolute" else extent / 2
        values = np.linspace(-reach, reach, 201)
        trials = scan(
            mine.points,
            mine.colours,
            motion.axis[None],
            volume,
            kinds=(motion.kind,),
            values=values,
            near=motion,
            keep=6,
        )
        best = polished([replace(motion, value=0.0), *trials], mine, there, extent)
        found.append(best.T)
    return found


def propose(
    surfaces: tuple[Surface, Surface],
    fresh: Sequence[Surface],
    seeds: Sequence[np.ndarray],
    coarse: Sequence[ScoreVolume],
    fine: Sequence[ScoreVolume],
    extent: float,
    config: SegmentConfig,
    rng: np.random.Generator,
) -> list[Motion]:
    """Hypotheses, as motions from state 0 to 1, from every group of seeds of both states.

    ``fresh`` are the points of each state that the other does not show in the same place.
    """
    groups = []
    for s in (0, 1):
        p = surfaces[s].points[seeds[s]]
        groups += [(s, seeds[s][g]) for g in groups_to_try(p, extent, seed=int(rng.integers(2**31)))]
    if not groups:
        return []
    directions = axis_directions([surfaces[s].points[g] for s, g in groups])
    pool = []
    blurred = [surface.blurred() for surface in surfaces]
    for s, group in groups:
        chosen = rng.choice(group, min(config.seeds_per_search, len(group)), replace=False)
        p, c = surfaces[s].points[chosen], surfaces[s].colours[chosen]
        # Slides get a hearing of their own: with three numbers fewer they are seldom the luckiest fit.
        for kind in ("revolute", "prismatic"):
            found = scan(p, blurred[s][chosen], directions, coarse[1 - s], kinds=(kind,), keep=4)
            for motion in found:
                if motion.score > max(0.1, 0.7 * found[0].score):
                    # Compare hypotheses at their best: on the grid a true one may be 3° off and lose to a lucky one.
                    for spread in (4.0, 1.5):
                        motion = refine_motion(motion, p, c, fine[1 - s], spread)
                    motion = polished([motion], surfaces[s].rows(chosen), fresh[1 - s], extent)
                    pool.append(motion if s == 0 else inverted(motion))
    return pool


def consensus(
    pool: Sequence[Motion],
    costs: np.ndarray,
    surfaces: tuple[Surface, Surface],
    fresh: Sequence[Surface],
    seeds: Sequence[np.ndarray],
    fine: Sequence[ScoreVolume],
    extent: float,
    config: SegmentConfig,
    rng: np.random.Generator,
) -> list[Motion]:
    """The most promising hypotheses, each refined on all seeds that agree with it wherever they are.

    A hypothesis comes from one patch; the right one fits the whole part, and grows better with it.
    """
    sample = np.concatenate([surfaces[s].points[seeds[s][:100]] for s in (0, 1)])
    refined = []
    for k in distinct(pool, costs, sample, 0.02 * extent, config.consensus_motions):
        agree = costs[:, k] < config.consensus_cost
        own = (seeds[0][agree[: len(seeds[0])]], seeds[1][agree[len(seeds[0]) :]])
        refined.append(_refit(pool[k], own, surfaces, fresh, fine, extent, config, rng))
    return refined


def _refit(
    motion: Motion,
    own: tuple[np.ndarray, np.ndarray],
    surfaces: tuple[Surface, Surface],
    fresh: Sequence[Surface],
    fine: Sequence[ScoreVolume],
    extent: float,
    config: SegmentConfig,
    rng: np.random.Generator,
) -> Motion:
    """Refine on the points that the motion owns, from the state that has more of them to those of the other."""
    s = int(len(own[1]) > len(own[0]))
    if len(own[s]) < config.min_part_seeds:
        return motion
    limit = 4 * config.seeds_per_search
    mine, theirs = (surfaces[t].rows(rng.choice(own[t], min(limit, len(own[t])), replace=False)) for t in (s, 1 - s))
    start = motion if s == 0 else inverted(motion)
    if len(theirs.points) < config.min_part_seeds:
        few = mine.rows(np.arange(min(2 * config.seeds_per_search, len(mine.points))))
        near = refine_motion(start, few.points, few.colours, fine[1 - s], 3.0)
        fit = polished([start, near], mine, fresh[1 - s], extent)
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


def spread_labels(points: np.ndarray, surface: Surface, labels: np.ndarray) -> np.ndarray:
    """(n,) labels for all Gaussians at points (n, 3): each takes its nearest surface point's."""
    return labels[KDTree(surface.points).query(points)[1]]


__all__ = ["SegmentConfig", "Segmentation", "segment", "track"]
