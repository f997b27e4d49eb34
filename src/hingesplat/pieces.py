"""One part is one piece: connected pieces of labelled surface points, and what becomes of those apart."""

from collections.abc import Sequence
from itertools import permutations

import numpy as np
from scipy.spatial import KDTree

from hingesplat.labelling import HIDDEN_COST, Whereabouts, gone, label_costs
from hingesplat.screw import distances_to_line, matrix_to_screw
from hingesplat.se3 import apart, moved
from hingesplat.search import Motion
from hingesplat.surface import Labels, Surface, components

LARGE_PIECE = 0.2
"""A piece this large beside the largest of its part is a part of its own, not a fragment."""
LEAST_SHARE = 0.003
"""Of each state's surface: a part that shows less of itself in one of them has no way from there to here, unless it
shows as many points as a part must."""
TOUCH = 0.05
"""Extents between points of two parts that touch."""
HINGE = 0.02
"""Extents from its hinge line within which nothing tells whether a part is one."""
LINKED = 0.25
"""Links across a hinge line that make one part of what lies on both sides, for every point that it is long."""
THIN = 0.25
"""Share of how far both of two pieces reach from their pivot that they share along it: less makes them one lever."""
GONE = 0.3
"""Share of a part's points that one of the states at least must show to have gone, or four times the fewest of a part:
a long panel slides over itself."""
LEFT, EMPTY = 0.03, 0.5
"""Extents from all of a part in the other state, from which it has left a point's place; and share of such places that
one of the states must show empty: right parts had 0.84 and more, the bulge of a white wall 0.48."""
PLATE = 0.06
"""Extents between the two sides of a plate at most."""
UNDER = 0.1
"""Extents between the inside of a door and the rest of it at most."""
UPON = 0.01
"""Extents between points that lie in the same place."""
SURE = 0.4
"""A fragment that costs so much more with what it touches, on average, stays what it is."""


def spacing(points: np.ndarray) -> float:
    """Median distance of points (n, 3) to their nearest neighbour; 0 for fewer than two."""
    if len(points) < 2:
        return 0.0
    return float(np.median(KDTree(points).query(points, 2)[0][:, 1]))


def split_pieces(
    motions: Sequence[Motion],
    owned: Labels,
    surfaces: tuple[Surface, Surface],
    extent: float,
    min_points: int,
) -> tuple[list[Motion], Labels]:
    """One part is one piece: two large pieces far apart that share a motion become two parts with that motion.

    Two doors one above the other, turned by the same angle about the same line, are such a pair. A motion no piece of
    which is seen in both states is none, and its points are base.
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
        large = size >= max(LARGE_PIECE * size.max(), 5 * min_points)
        both = np.minimum(*each) >= min_points
        large &= both
        if both.any():
            large[np.where(both, size, 0).argmax()] = True
        else:
            main = int(size.argmax())
            large[main] = all(e[main] > LEAST_SHARE * len(o) for e, o in zip(each, owned, strict=True))
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
                first, second = (T if s == 0 else np.linalg.inv(T) for T in (motion.T, other.T))
                alike = apart(points, first, second) < 0.03 * extent
                if j != k and alike and len(theirs) and KDTree(theirs).query(points)[0].min() < 0.03 * extent:
                    for state in (0, 1):
                        labels[state][mine[state]] = j + 1
                    break
    return labels


def reattach_fragments(
    T_1_0: Sequence[np.ndarray], owned: Labels, surfaces: tuple[Surface, Surface], extent: float
) -> Labels:
    """Small pieces apart from their part's main one go to what they touch, or to the nearest: nothing floats.

    Of the parts that a piece touches, photographs choose: the inside of a drawer touches the cabinet and the drawer.
    They may also be sure that it is neither: a knife's blade touches only the handle that it slides in. Not so the
    handle of a door whose motion is still off, if the motion of another merely takes it out of sight.
    """
    fragments: list[tuple[int, list[np.ndarray]]] = []
    for k, T in enumerate([np.eye(4), *T_1_0]):
        rows, piece = _pieces(k, T, owned, surfaces, extent)
        size = np.bincount(np.concatenate(piece), minlength=1)
        small = (size > 0) & (size < (size.max() if k else 0.02 * size.max()))
        fragments += [(k, [rows[s][piece[s] == p] for s in (0, 1)]) for p in np.flatnonzero(small)]
    labels = (owned[0].copy(), owned[1].copy())
    if not fragments:
        return labels
    costs, gaps = [], []
    for s in (0, 1):
        stray = np.zeros(len(owned[s]), bool)
        stray[np.concatenate([rows[s] for _, rows in fragments])] = True
        some, points = np.flatnonzero(stray), surfaces[s].points
        transforms = T_1_0 if s == 0 else [np.linalg.inv(T) for T in T_1_0]
        cost, gap = (np.full((len(stray), 1 + len(T_1_0)), np.inf) for _ in range(2))
        cost[some] = label_costs(surfaces[s].rows(some), surfaces[1 - s].sight, transforms, extent=extent)
        for k in np.unique(owned[s][~stray]):
            gap[some, k] = KDTree(points[~stray & (owned[s] == k)]).query(points[some])[0]
        costs.append(cost)
        gaps.append(gap)
    for k, rows in fragments:
        cost = np.concatenate([costs[s][rows[s]] for s in (0, 1)]).mean(0)
        gap = np.concatenate([gaps[s][rows[s]] for s in (0, 1)]).min(0)
        best = int(np.where(gap <= max(TOUCH * extent, gap.min()), cost, np.inf).argmin())
        if cost[best] - cost[k] < SURE or (min(best, k) > 0 and cost[k] > HIDDEN_COST):
            for s in (0, 1):
                labels[s][rows[s]] = best
    return labels


def give_way(
    T_1_0: Sequence[np.ndarray],
    owned: Labels,
    surfaces: tuple[Surface, Surface],
    extent: float,
    told: Whereabouts,
) -> Labels:
    """Labels in which points that land where another part does go along with it, if they may and that part must.

    Of two drawers side by side, each motion hides the other's bottom, too. What took the shorter way into the cabinet
    lies there in what took the longer, whose front photographs would see if it had taken the shorter.
    """
    ways = [list(T_1_0), [np.linalg.inv(T) for T in T_1_0]]
    labels = (owned[0].copy(), owned[1].copy())
    may = [[m for m, _ in told[s]] for s in (0, 1)]
    for s in (0, 1):
        here, there = surfaces[s].points, surfaces[1 - s].points
        for j, k in permutations(range(len(T_1_0)), 2):
            loose = np.flatnonzero((owned[s] == j + 1) & may[s][k])
            firm = moved(here[(owned[s] == k + 1) & ~may[s][j]], ways[s][k])
            firm = np.concatenate([firm, there[(owned[1 - s] == k + 1) & ~may[1 - s][j]]])
            if len(loose) == 0 or len(firm) == 0:
                continue
            landed, own = moved(here[loose], ways[s][j]), there[owned[1 - s] == j + 1]
            gap = KDTree(firm).query(landed)[0]
            met = KDTree(own).query(landed)[0] if len(own) else np.inf
            labels[s][loose[(gap < UPON * extent) & (gap < met)]] = k + 1
    return labels


def follow_fronts(owned: Labels, surfaces: tuple[Surface, Surface], extent: float, told: Whereabouts) -> Labels:
    """Labels in which the back of a plate is the part's whose front is right before it.

    What two motions take out of sight may follow either: of two doors one above the other that open by nearly the same,
    the inside of one was the other's. A piece of such points goes along with those that both states show of a part, if
    they are no farther than a plate is thick and twice as close as those of its own.
    """
    labels = (owned[0].copy(), owned[1].copy())
    for s in (0, 1):
        points = surfaces[s].points
        lost = [away for _, away in told[s]]
        firm = [KDTree(points[(owned[s] == k + 1) & may & ~away]) for k, (may, away) in enumerate(told[s])]
        nearest = np.full(len(points), PLATE * extent)
        for j, k in permutations(range(len(lost)), 2):
            loose = np.flatnonzero((owned[s] == j + 1) & lost[j] & lost[k])
            if not (firm[j].n and firm[k].n and len(loose)):
                continue
            own, front = (np.asarray(firm[i].query(points[loose])[0]) for i in (j, k))
            piece = components(points[loose], 0.025 * extent)
            for p in np.unique(piece):
                mine, gap = loose[piece == p], front[piece == p].mean()
                closer = mine[gap < nearest[mine]]
                if gap < own[piece == p].mean() / 2:
                    labels[s][closer], nearest[closer] = k + 1, gap
    return labels


def lying_on(owned: Labels, parts: int, surfaces: tuple[Surface, Surface], extent: float) -> np.ndarray:
    """(2, parts, parts) share of each part's points in each state that lie on another part.

    A point lies on what is nearest of what is not its own part's, and no farther than ``UNDER``.
    """
    share = np.zeros((2, parts, 1 + parts))
    for s in (0, 1):
        points = surfaces[s].points
        for k in range(parts):
            mine = owned[s] == k + 1
            if mine.any() and not mine.all():
                gap, nearest = map(np.asarray, KDTree(points[~mine]).query(points[mine]))
                on = owned[s][~mine][nearest[gap < UNDER * extent]]
                share[s, k] = np.bincount(on, minlength=1 + parts) / mine.sum()
    return share[..., 1:]


def passed_on(share: np.ndarray) -> np.ndarray:
    """(parts,) share of each part's points that lie on one other part in state 0, and on another in state 1; the less.

    Nobody hands a part over. Of two doors that look alike inside, one open in each state, the inside of one is taken
    for that of the other.

    Args:
        share: as ``lying_on`` gives it.
    """
    less = np.minimum(share[0][:, :, None], share[1][:, None, :])
    return np.where(np.eye(share.shape[1], dtype=bool), 0, less).max((1, 2), initial=0)


def riding(share: np.ndarray) -> np.ndarray:
    """(parts,) share of each part's points that lie on the same other part in both states.

    What rides on a part and has a joint on the base is that part: the dark window of an oven's door turned about
    another line than the door.

    Args:
        share: as ``lying_on`` gives it.
    """
    return np.minimum(share[0], share[1]).max(1, initial=0)


def seen_to_move(
    motions: Sequence[Motion], owned: Labels, surfaces: tuple[Surface, Surface], extent: float, min_points: int
) -> tuple[list[Motion], Labels]:
    """The parts that both states show, and one at least where they have gone; labels that count these.

    The points of the others are base: walls without texture, of which two states' depth differs, that a slight turn
    or a short slide would explain. A part is gone from all places but those where it has come to lie.
    """
    counts = [np.bincount(label, minlength=1 + len(motions))[1:] for label in owned]
    shown = [c > min(LEAST_SHARE * len(label), min_points - 1) for c, label in zip(counts, owned, strict=True)]
    went = [gone(surfaces[s], surfaces[1 - s].sight) for s in (0, 1)]
    many = [np.bincount(o, g, 1 + len(motions))[1:] for o, g in zip(owned, went, strict=True)]
    moved_on = [(m > GONE * c) | (m > 4 * min_points) for m, c in zip(many, counts, strict=True)]
    left = [_left_behind(k, m.T, owned, surfaces, extent) for k, m in enumerate(motions, 1)]
    empty = np.ones(len(motions), bool)
    for k, places in enumerate(left):
        asked = [w[at] for w, at in zip(went, places, strict=True) if len(at) >= min_points]
        empty[k] = not asked or max(w.mean() for w in asked) > EMPTY
    kept = np.flatnonzero(shown[0] & shown[1] & (moved_on[0] | moved_on[1]) & empty)
    rank = np.zeros(1 + len(motions), int)
    rank[1 + kept] = np.arange(1, 1 + len(kept))
    return [motions[int(k)] for k in kept], (rank[owned[0]], rank[owned[1]])


def _left_behind(
    label: int, T_1_0: np.ndarray, owned: Labels, surfaces: tuple[Surface, Surface], extent: float
) -> list[np.ndarray]:
    """Rows of a part's points in each state where the other state has nothing of it."""
    rows = [np.flatnonzero(o == label) for o in owned]
    first, second = (s.points[r] for s, r in zip(surfaces, rows, strict=True))
    there = np.concatenate([moved(first, T_1_0), second]), np.concatenate([first, moved(second, np.linalg.inv(T_1_0))])
    if len(there[0]) == 0:
        return rows
    ways = zip(rows, (first, second), there, strict=True)
    return [row[np.asarray(KDTree(other).query(here)[0]) > LEFT * extent] for row, here, other in ways]


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
    radius = max(0.025 * extent, 2.5 * spacing(both))
    piece = components(both, radius, bridges=bridges)
    if not bridges:
        gap = max(map(spacing, np.split(both, [len(rows[0])])))
        piece = _cut_at_hinge(both, piece, T_1_0, radius, gap, extent)
        piece = _joined_across_pivot(both, piece, T_1_0)
    return rows, np.split(piece, [len(rows[0])])


def _cut_at_hinge(
    points: np.ndarray, piece: np.ndarray, T: np.ndarray, radius: float, gap: float, extent: float
) -> np.ndarray:
    """Pieces (n,) of points (n, 3) ``gap`` apart, in two where hardly more than their hinge line joins them.

    Two doors back to back that open by the same angle share their motion, and a slit between them that is narrower than
    the points are apart. A plate that turns about its middle is linked all along that line.
    """
    screw = matrix_to_screw(T)
    far = distances_to_line(points, screw.pivot, screw.axis) > HINGE * extent
    if screw.angle == 0 or not far.any():
        return piece
    cut = components(points[far], radius, bridges=False)[KDTree(points[far]).query(points)[1]]
    size = np.bincount(cut)
    if len(size) < 2:
        return piece
    first, second = (points[cut == p] for p in np.argsort(-size, kind="stable")[:2])
    shared = _shared_length(first, second, screw.axis)
    links = KDTree(first).count_neighbors(KDTree(second), 1.1 * gap)
    return cut if links * gap < LINKED * shared else piece


def _joined_across_pivot(points: np.ndarray, piece: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Pieces (n,) of points (n, 3), the two largest made one if a pivot between them joins them.

    Where a blade of scissors crosses the other, that one hides it. Doors back to back are longer along their hinge line
    than far apart, and not thin beside what they reach from it.
    """
    screw, size = matrix_to_screw(T), np.bincount(piece)
    if screw.angle == 0 or len(size) < 2:
        return piece
    larger, smaller = np.argsort(-size, kind="stable")[:2]
    first, second = points[piece == larger], points[piece == smaller]
    gap, shared = KDTree(first).query(second)[0].min(), _shared_length(first, second, screw.axis)
    a, b = (np.cross(p - screw.pivot, screw.axis) for p in (first, second))
    reach = min(np.linalg.norm(off, axis=1).max() for off in (a, b))
    joined = a.mean(0) @ b.mean(0) < 0 < shared < max(gap, THIN * reach)
    return np.where(piece == smaller, larger, piece) if joined else piece


def _shared_length(first: np.ndarray, second: np.ndarray, axis: np.ndarray) -> float:
    """How far two sets of points (n, 3), (m, 3) go beside each other along an axis; negative where they do not."""
    along = [side @ axis for side in (first, second)]
    return float(min(a.max() for a in along) - max(a.min() for a in along))
