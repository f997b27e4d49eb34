"""Drawers: what one state alone shows of them is theirs, and what their cabinet hides goes on as it was last seen.

Photographs show a drawer as far as it was ever pulled out. What lies behind is a guess, and a short drawer with an open
end is the worse one: its walls go on up to a back just before that of the cabinet.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage
from scipy.spatial import Delaunay, QhullError

from hingesplat.labelling import hidden
from hingesplat.se3 import moved
from hingesplat.surface import Labels, Surface, components
from hingesplat.tsdf import DistanceGrid

SEEN = 0.5
"""Share of a cross-section that must have been seen, of what its outline holds."""
FULL = 0.6
"""Share of it that is solid in a block, a panel, or a drawer whose back was seen: these end where they end."""
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
            across, depth = _across(inwards), mine @ inwards
            near, far = np.quantile(depth, [STRAY, 1 - STRAY]) if len(mine) else (0, 0)
            box = _largest(mine[depth > (near + far) / 2], 0.03 * extent) @ across.T
            if len(box) < FEWEST or _narrowest(box) < NARROW * extent:
                continue
            outline = Delaunay(box)
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
    ways, front = np.array([T[:3, 3] for T in T_base_part]), _largest(surface, 4 * part.voxel)
    for inwards in (axis, -axis):
        across = _across(inwards)
        covered = Delaunay(front @ across.T)  # A drawer's box is behind its front.
        box = surface[covered.find_simplex(surface @ across.T) >= 0]
        found = _section(part, box, inwards, 3 * own)
        if found is None:
            continue
        start, outline = found
        farthest = float((ways @ inwards).max())
        behind = base[base @ inwards > start + farthest + wall]
        # The inner nine tenths: frames and rails beside the way are not its end.
        middle = outline.points.mean(0)
        back = behind[outline.find_simplex(middle + (behind @ across.T - middle) / 0.9) >= 0] @ inwards
        if len(back) >= FEWEST:
            end = float(np.median(back)) - farthest - wall
            if end > start + 2 * own:
                part = _extruded(part, inwards, (start, end), (covered, outline), own)
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


def _across(axis: np.ndarray) -> np.ndarray:
    """(2, 3) unit vectors across an axis."""
    u = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(axis, u)])


def _places(grid: DistanceGrid) -> np.ndarray:
    """(voxels, 3) centres, in the order of a raveled grid."""
    return grid.lower + grid.voxel * np.indices(grid.distance.shape).reshape(3, -1).T


def _section(
    part: DistanceGrid, surface: np.ndarray, inwards: np.ndarray, narrowest: float
) -> tuple[float, Delaunay] | None:
    """Where, along ``inwards``, the last cross-section lies that was well seen, and its outline.

    None if it is full, or narrower than ``narrowest``.
    """
    places, across = _places(part), _across(inwards)
    slab, slab_of_surface = (np.floor((p @ inwards) / part.voxel).astype(int) for p in (places, surface))
    seen, solid = (part.weight > 0).ravel(), (part.distance < 0).ravel()
    for k in range(int(np.quantile(slab_of_surface, 1 - STRAY)), int(slab_of_surface.min()), -1):
        edge = surface[np.abs(slab_of_surface - k) <= 1] @ across.T  # One voxel alone has gaps.
        try:
            outline = Delaunay(edge)
        except (QhullError, ValueError):  # Too few points, or all on a line.
            continue
        rows = np.flatnonzero(slab == k)
        rows = rows[outline.find_simplex(places[rows] @ across.T) >= 0]
        if min(len(edge), len(rows)) < FEWEST or seen[rows].mean() < SEEN:
            continue
        hollow = solid[rows].mean() < FULL and _narrowest(edge) > narrowest
        return ((k + 0.5) * part.voxel, outline) if hollow else None
    return None


def _extruded(
    part: DistanceGrid,
    inwards: np.ndarray,
    span: tuple[float, float],
    outlines: tuple[Delaunay, Delaunay],
    wall: float,
) -> DistanceGrid:
    """Unseen voxels of a span along ``inwards`` as they are at its start, and a back before its end.

    ``outlines``, across, are those of all that goes on and of the back. A little before the start is mended likewise.
    """
    (start, end), across = span, _across(inwards)
    grid = _longer(part, (end - start + 3 * part.voxel) * inwards)
    places = _places(grid)
    rows = np.flatnonzero((places @ inwards > start - 2 * wall) & (grid.weight.ravel() == 0))
    covered, inside = (outline.find_simplex(places[rows] @ across.T) >= 0 for outline in outlines)
    places, along = places[rows], places[rows] @ inwards
    distance = grid.distance.ravel().copy()
    guess = np.where(along < start, distance[rows], 1)
    for before in np.arange(0, 2 * wall, part.voxel):  # One section alone has gaps.
        at_start = (places - (along - start + before)[:, None] * inwards - part.lower) / part.voxel
        guess = np.minimum(guess, ndimage.map_coordinates(part.distance, at_start.T, order=1, cval=1.0))
    back = np.where(inside, np.abs(along - (end - wall / 2)) - wall / 2, np.inf) / part.truncation
    guess = np.where(covered, np.minimum(guess, back), 1)
    guess = np.where(along < end, guess, np.maximum(guess, (along - end) / part.truncation))
    distance[rows] = np.clip(guess, -1, 1)
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
