"""Drawers: what one state alone shows of them is theirs, and what is behind a front goes with it."""

from collections.abc import Sequence
from itertools import permutations

import numpy as np
from scipy.spatial import ConvexHull, Delaunay

from hingesplat.labelling import Whereabouts, hidden
from hingesplat.screw import axes_across, slide_of
from hingesplat.se3 import moved
from hingesplat.surface import Labels, Surface, components

STRAY = 0.02
"""Share of a surface that may lie deeper than its last cross-section."""
NARROW = 0.08
"""Extents of the object that a drawer is wide and high at least, for its contents to be told from its walls."""
WITHIN = 0.03
"""Extents of the object between points of one piece, and that a front is wide and high at least."""
FEWEST = 24
"""Points of a surface that make an outline, or a back."""


def insides(T_1_0: Sequence[np.ndarray], owned: Labels, surfaces: tuple[Surface, Surface], extent: float) -> Labels:
    """Labels of both states' surface points, in which what lies in a drawer is the drawer's.

    The bottom of an open drawer is hidden in the other state, whether it stays or moves with the drawer, and to stay is
    the cheaper claim. But what fills the cross-section of a slide's inner half would be in its way if it stayed.

    Args:
        T_1_0: (4, 4) motion of each part from state 0 to state 1.
        owned: label of each point, 0 for the base.
    """
    labels = (owned[0].copy(), owned[1].copy())
    for k, T in enumerate(T_1_0, 1):
        axis = slide_of([T])
        if axis is None:
            continue
        mine = np.concatenate([moved(surfaces[0].points[owned[0] == k], T), surfaces[1].points[owned[1] == k]])
        for inwards in (axis, -axis):
            across, depth = axes_across(inwards), mine @ inwards
            near, far = np.quantile(depth, [STRAY, 1 - STRAY]) if len(mine) else (0, 0)
            box = largest(mine[depth > (near + far) / 2], WITHIN * extent) @ across.T
            if len(box) < FEWEST or narrowest(box) < NARROW * extent:
                continue
            outline = outline_of(box)
            for s, T_s in ((0, T), (1, np.linalg.inv(T))):
                at_end = surfaces[s].points if s == 1 else moved(surfaces[s].points, T)
                inner = np.flatnonzero((owned[s] == 0) & (at_end @ inwards > near + (far - near) / 4))
                inner = inner[outline.find_simplex(at_end[inner] @ across.T) >= 0]
                some, other = surfaces[s].rows(inner), surfaces[1 - s].sight
                labels[s][inner[hidden(some, other) & hidden(some, other, T_s)]] = k
    return labels


def behind_fronts(
    T_1_0: Sequence[np.ndarray], owned: Labels, surfaces: tuple[Surface, Surface], extent: float, told: Whereabouts
) -> Labels:
    """Labels in which what two motions take out of sight, one of them a slide, goes with the front that it is behind.

    Of two drawers one above the other, each motion hides the walls of the other, too. But a drawer's box is behind its
    front, and where that is those points say that no other motion explains.

    Args:
        T_1_0: (4, 4) motion of each part from state 0 to state 1.
        owned: label of each point, 0 for the base.
    """
    labels = (owned[0].copy(), owned[1].copy())
    for j, k in permutations(range(len(T_1_0)), 2):
        axis = slide_of([T_1_0[k]])
        if axis is None:
            continue
        fronts = []
        for own, other in ((k, j), (j, k)):
            firm = [(owned[s] == own + 1) & told[s][own][0] & ~told[s][other][0] for s in (0, 1)]
            points = np.concatenate([surfaces[s].points[firm[s]] for s in (0, 1)])
            fronts.append(largest(points, WITHIN * extent) @ axes_across(axis).T)
        if any(len(front) < FEWEST or narrowest(front) < WITHIN * extent for front in fronts):
            continue
        mine, others = map(outline_of, fronts)
        for s in (0, 1):
            loose = np.flatnonzero((owned[s] == j + 1) & told[s][k][0] & told[s][j][1])
            flat = surfaces[s].points[loose] @ axes_across(axis).T
            labels[s][loose[(mine.find_simplex(flat) >= 0) & (others.find_simplex(flat) < 0)]] = k + 1
    return labels


def largest(points: np.ndarray, radius: float) -> np.ndarray:
    """Those of points (n, 3) that hang together most."""
    piece = components(points, radius)
    return points[piece == np.bincount(piece, minlength=1).argmax()]


def narrowest(flat: np.ndarray) -> float:
    """Extent of points (n, 2) along their shorter principal axis."""
    return float(np.ptp(np.linalg.svd(flat - flat.mean(0), full_matrices=False)[2] @ flat.T, axis=1).min())


def outline_of(flat: np.ndarray) -> Delaunay:
    """The convex hull of points (n, 2), which tells what lies in it."""
    return Delaunay(flat[ConvexHull(flat).vertices])
