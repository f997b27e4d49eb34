"""Drawers: what one state alone shows of them is theirs, and what their cabinet hides goes on as it was last seen.

Photographs show a drawer as far as it was ever pulled out. What lies behind is a guess, and a short drawer with an open
end is the worse one: its walls go on up to a back just before that of the cabinet.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, Delaunay, KDTree

from hingesplat.labelling import hidden
from hingesplat.screw import axes_across
from hingesplat.se3 import moved
from hingesplat.surface import Labels, Surface, components
from hingesplat.tsdf import DistanceGrid

SEEN = 0.5
"""Share of a cross-section that must have been seen, of what its outline holds."""
FULL = 0.6
"""Share of it that is solid in a block, a panel, or a drawer whose back was seen: these end where they end."""
INNER = 0.8
"""Share of an outline's width and height that its walls leave."""
SPAN = 0.5
"""Share of an outline's width that a back spans; what spans less is something in the drawer."""
STRAY = 0.02
"""Share of a surface that may lie deeper than its last cross-section."""
NARROW = 0.08
"""Extents of the object that a drawer is wide and high at least, for its contents to be told from its walls."""
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
        axis = _slide([T])
        if axis is None:
            continue
        mine = np.concatenate([moved(surfaces[0].points[owned[0] == k], T), surfaces[1].points[owned[1] == k]])
        for inwards in (axis, -axis):
            across, depth = axes_across(inwards), mine @ inwards
            near, far = np.quantile(depth, [STRAY, 1 - STRAY]) if len(mine) else (0, 0)
            box = _largest(mine[depth > (near + far) / 2], 0.03 * extent) @ across.T
            if len(box) < FEWEST or _narrowest(box) < NARROW * extent:
                continue
            outline = _outline(box)
            for s, T_s in ((0, T), (1, np.linalg.inv(T))):
                at_end = surfaces[s].points if s == 1 else moved(surfaces[s].points, T)
                inner = np.flatnonzero((owned[s] == 0) & (at_end @ inwards > near + (far - near) / 4))
                inner = inner[outline.find_simplex(at_end[inner] @ across.T) >= 0]
                some, other = surfaces[s].rows(inner), surfaces[1 - s].sight
                labels[s][inner[hidden(some, other) & hidden(some, other, T_s)]] = k
    return labels


def drawn_out(
    part: DistanceGrid,
    surface: np.ndarray,
    base: np.ndarray,
    T_base_part: Sequence[np.ndarray],
    walls: tuple[float, float],
) -> DistanceGrid:
    """The same part with what its base hides; the part as it was unless it slides, is hollow and its hollow open there.

    Args:
        part: its distances, with what was never seen filled in.
        surface: (n, 3) points that were seen of it.
        base: (m, 3) points that were seen of what it slides in.
        T_base_part: (4, 4) places on its way.
        walls: how thick the part's and the base's walls count where nobody saw them, scene units.
    """
    own, wall = walls
    axis = _slide(T_base_part)
    if axis is None:
        return part
    ways, front = np.array([T[:3, 3] for T in T_base_part]), _largest(surface, 2 * own)
    for inwards in (axis, -axis):
        across = axes_across(inwards)
        if len(front) < FEWEST or _narrowest(front @ across.T) < own:
            continue
        covered = _outline(front @ across.T)  # A drawer's box is behind its front.
        box = surface[covered.find_simplex(surface @ across.T) >= 0]
        found = _section(part, box, inwards, own)
        if found is None:
            continue
        start, outline = found
        farthest = float((ways @ inwards).max())
        behind = base[base @ inwards > start + farthest + wall]
        behind = behind[_inner(outline, behind @ across.T)] @ inwards
        if len(behind) < FEWEST:
            continue
        end = float(np.median(behind)) - farthest - wall
        inside = box[(box @ inwards > start) & _inner(outline, box @ across.T)]
        if len(inside) >= FEWEST:
            back = float(np.median(inside @ inwards))
            face = inside[np.abs(inside @ inwards - back) < own] @ across.T
            if np.ptp(face, axis=0).max() > SPAN * np.ptp(outline.points, axis=0).max():
                end = min(end, back + own)
        if end > start + 2 * own:
            part = _extruded(part, box, inwards, (start, end), covered, own)
    return part


def _slide(T_base_part: Sequence[np.ndarray]) -> np.ndarray | None:
    """(3,) the direction of a part that only slides, given places (4, 4) on its way."""
    turns, ways = np.array([T[:3, :3] for T in T_base_part]), np.array([T[:3, 3] for T in T_base_part])
    length = np.linalg.norm(ways, axis=-1)
    if not length.any() or np.abs(turns - np.eye(3)).max() > 1e-6:
        return None
    return ways[length.argmax()] / length.max()


def _largest(points: np.ndarray, radius: float) -> np.ndarray:
    """Those of points (n, 3) that hang together most."""
    piece = components(points, radius)
    return points[piece == np.bincount(piece, minlength=1).argmax()]


def _narrowest(flat: np.ndarray) -> float:
    """Extent of points (n, 2) along their shorter principal axis."""
    return float(np.ptp(np.linalg.svd(flat - flat.mean(0), full_matrices=False)[2] @ flat.T, axis=1).min())


def _outline(flat: np.ndarray) -> Delaunay:
    """The convex hull of points (n, 2), which tells what lies in it."""
    return Delaunay(flat[ConvexHull(flat).vertices])


def _inner(outline: Delaunay, flat: np.ndarray) -> np.ndarray:
    """(n,) bool: points (n, 2) that lie well inside an outline: walls and rails do not."""
    middle = (outline.points.min(0) + outline.points.max(0)) / 2
    return outline.find_simplex(middle + (flat - middle) / INNER) >= 0


def _places(grid: DistanceGrid) -> np.ndarray:
    """(voxels, 3) centres, in the order of a raveled grid."""
    return grid.lower + grid.voxel * np.indices(grid.distance.shape).reshape(3, -1).T


def _section(
    part: DistanceGrid, surface: np.ndarray, inwards: np.ndarray, wall: float
) -> tuple[float, Delaunay] | None:
    """Where, along ``inwards``, the last cross-section lies that was well seen, and its outline; None if it is full.

    A slice is as thick as a ``wall``, for one voxel alone has gaps, and what is narrower than three is no section.
    """
    places, across = _places(part), axes_across(inwards)
    depth, depth_of_surface = places @ inwards, surface @ inwards
    seen, solid = (part.weight > 0).ravel(), (part.distance < 0).ravel()
    deepest, first = np.quantile(depth_of_surface, [1 - STRAY, 0])
    for at in np.arange(deepest, first, -part.voxel):
        edge = surface[np.abs(depth_of_surface - at) < wall / 2] @ across.T
        if len(edge) < FEWEST or _narrowest(edge) < 3 * wall:
            continue
        outline = _outline(edge)
        rows = np.flatnonzero(np.abs(depth - at) < part.voxel / 2)
        rows = rows[outline.find_simplex(places[rows] @ across.T) >= 0]
        if len(rows) and seen[rows].mean() > SEEN:
            return None if solid[rows].mean() > FULL else (float(at), outline)
    return None


def _extruded(
    part: DistanceGrid,
    surface: np.ndarray,
    inwards: np.ndarray,
    span: tuple[float, float],
    covered: Delaunay,
    wall: float,
) -> DistanceGrid:
    """Unseen voxels of a span along ``inwards`` as they are at its start, and a back before its end.

    All that behind the front, whose outline across is ``covered``. A little before the start is mended likewise.
    """
    (start, end), across = span, axes_across(inwards)
    # Not what only closes pockets.
    places, known = _places(part), part.distance.copy()
    close = np.flatnonzero((np.abs(places @ inwards - start) < wall + part.voxel) & (part.weight == 0).ravel())
    far = np.isinf(KDTree(surface).query(places[close], distance_upper_bound=wall)[0])
    known.ravel()[close[far]] = 1
    grid = _longer(part, (end - start + 3 * part.voxel) * inwards)
    places = _places(grid)
    rows = np.flatnonzero((places @ inwards > start - wall) & (grid.weight.ravel() == 0))
    rows = rows[covered.find_simplex(places[rows] @ across.T) >= 0]
    places, along = places[rows], places[rows] @ inwards
    profile = np.ones(len(rows))
    for before in np.arange(0, wall, part.voxel):  # One section alone has gaps.
        at_start = (places - (along - start + before)[:, None] * inwards - part.lower) / part.voxel
        walls = ndimage.map_coordinates(known, at_start.T, order=1, cval=1.0)
        if (walls < 0).mean() > FULL:
            break  # The front.
        profile = np.minimum(profile, walls)
    flat = places @ across.T
    if (profile < 0).sum() < FEWEST or _narrowest(flat[profile < 0]) < part.voxel:
        return part
    outline = _outline(flat[profile < 0])
    profile[_inner(outline, flat)] = 1  # What lies in a drawer does not go on.
    back = np.abs(along - (end - wall / 2)) - wall / 2
    back = np.where(outline.find_simplex(flat) >= 0, back / part.truncation, 1)
    distance = grid.distance.ravel().copy()
    guess = np.minimum(profile, np.where(along < start, distance[rows], back))
    distance[rows] = np.clip(np.where(along < end, guess, (along - end) / part.truncation), -1, 1)
    return replace(grid, distance=distance.reshape(grid.distance.shape))


def _longer(grid: DistanceGrid, far: np.ndarray) -> DistanceGrid:
    """The same grid in a box that holds it shifted by ``far`` (3,), too; what is new was not seen and is empty."""
    more = np.ceil(np.abs(far) / grid.voxel).astype(int)
    pad = [(n, 0) if shift < 0 else (0, n) for n, shift in zip(more, far, strict=True)]
    return replace(
        grid,
        lower=grid.lower - grid.voxel * np.array([before for before, _ in pad]),
        distance=np.pad(grid.distance, pad, constant_values=1),
        weight=np.pad(grid.weight, pad),
    )
