"""The box of a drawer: what its cabinet hides goes on as it was last seen.

Photographs show a drawer as far as it was ever pulled out. What lies behind is a guess, and a short drawer with an open
end is the worse one: its walls go on up to a back just before that of the cabinet.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import Delaunay, KDTree

from hingesplat.drawer import FEWEST, largest, narrowest, outline_of
from hingesplat.screw import axes_across, slide_of
from hingesplat.tsdf import DistanceGrid, usual_thickness

SEEN = 0.1
"""Share of what its walls enclose that must have been seen, for it to be hollow."""
FULL = 0.6
"""Share of it that is solid in a block, a panel, or a drawer's front: these end where they end."""
INNER = 0.8
"""Share of an outline's width and height that its walls leave."""
OFTEN = 0.25
"""Share of the slices that show most of its cells in which a cell of it must have been seen."""
WHOLE = 0.9
"""Share of its walls that a slice must show to be the last that counts, of those that the best slice shows."""
SPAN, RISE = 0.6, 0.3
"""Shares of an outline's width and height that a back spans; what spans less is in the drawer, or a strip of floor."""
FRAME = 2
"""Times the points of other slices around its opening that a slice with the frame of a drawer has."""
MARGIN = 3
"""Empty cells around a cross-section."""


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
    reach, gap = walls
    axis = slide_of(T_base_part)
    if axis is None:
        return part
    ways, front = np.array([T[:3, 3] for T in T_base_part]), largest(surface, 2 * reach)
    for inwards in (axis, -axis):
        across = axes_across(inwards)
        if len(front) < FEWEST or narrowest(front @ across.T) < reach:
            continue
        covered = outline_of(front @ across.T)  # A drawer's box is behind its front.
        box = surface[covered.find_simplex(surface @ across.T) >= 0]
        section = _section(part, box, inwards, covered, reach) if len(box) else None
        if section is None:
            continue
        closed = base - float((ways @ inwards).max()) * inwards
        deep = closed[closed @ inwards > section.start + gap]
        deep = deep[_inner(section.outline, deep @ across.T)]
        if len(deep) < FEWEST:
            continue
        stop = float(np.median(deep @ inwards))
        end = stop - gap - _ajar(section, closed, inwards, stop, covered)
        inside = box[(box @ inwards > section.start) & _inner(section.outline, box @ across.T)]
        for back in np.arange(end, section.start, -reach):  # Its own back, if that was seen.
            face = inside[np.abs(inside @ inwards - back) < reach / 2]
            if len(face) >= FEWEST and _spans(face @ across.T, section.outline.points):
                end = float(np.median(face @ inwards)) + section.wall
                break
        if end > section.start + 2 * reach:
            part = _extruded(part, section, inwards, end, covered)
    return part


def _widest(flat: np.ndarray) -> float:
    """Extent of points (n, 2) along the axis along which it is the larger."""
    return float(np.ptp(flat, axis=0).max())


def _spans(flat: np.ndarray, outline: np.ndarray) -> bool:
    """Whether points (n, 2) are as large as a back within an outline (m, 2)."""
    return _widest(flat) > SPAN * _widest(outline) and narrowest(flat) > RISE * narrowest(outline)


def _inner(outline: Delaunay, flat: np.ndarray) -> np.ndarray:
    """(n,) bool: points (n, 2) that lie well inside an outline: walls and rails do not."""
    middle = (outline.points.min(0) + outline.points.max(0)) / 2
    return outline.find_simplex(middle + (flat - middle) / INNER) >= 0


@dataclass(frozen=True)
class _Section:
    """What a drawer looks like across its way, and how deep it was seen whole."""

    front: float
    """Where its front ends, along the way inwards."""
    wall: float
    """How thick its walls are, scene units."""
    start: float
    """Where its walls were last whole."""
    outline: Delaunay
    """Of its walls, (points, 2) across the way."""
    lower: np.ndarray
    """(2,) centre of the first cell."""
    cell: float
    profile: np.ndarray
    """(cells, cells) distance to its walls, as in ``DistanceGrid``."""

    def at(self, flat: np.ndarray) -> np.ndarray:
        """(n,) the distance at points (n, 2) across the way."""
        return ndimage.map_coordinates(self.profile, ((flat - self.lower) / self.cell).T, order=1, cval=1.0)


def _section(
    part: DistanceGrid, surface: np.ndarray, inwards: np.ndarray, covered: Delaunay, reach: float
) -> _Section | None:
    """The median of all slices behind the front; None if it is narrow or full, or too little was seen of its hollow.

    Args:
        surface: (n, 3) points that were seen of it, behind and in its front, whose outline across is ``covered``.
        reach: how thick its walls count where that was not seen; what is narrower than three walls is no section.
    """
    across, lower = axes_across(inwards), covered.points.min(0) - MARGIN * part.voxel
    shape = np.ceil(np.ptp(covered.points, axis=0) / part.voxel).astype(int) + 1 + 2 * MARGIN
    cells = lower + part.voxel * np.indices(shape).reshape(2, -1).T
    behind_front = covered.find_simplex(cells) >= 0
    depths = np.arange((surface @ inwards).min(), (surface @ inwards).max() + part.voxel, part.voxel)
    places = depths[:, None, None] * inwards + cells @ across
    index = ((places - part.lower) / part.voxel).reshape(-1, 3).T
    distance = ndimage.map_coordinates(part.distance, index, order=1, cval=1.0).reshape(len(depths), -1)
    known = ndimage.map_coordinates((part.weight > 0).astype(np.uint8), index, order=0).reshape(len(depths), -1) > 0
    # Of what nobody saw, walls are known well enough; what only closes pockets is not.
    guess = np.nonzero(~known & (distance < 0))
    away = np.full(distance.shape, np.inf)
    away[guess] = KDTree(surface).query(places[guess], distance_upper_bound=reach)[0]
    full = ((known | np.isfinite(away)) & (distance < 0))[:, behind_front].mean(1) > FULL
    behind = slice(int(np.flatnonzero(full).max(initial=-1)) + 1, None)
    if not len(depths[behind]):
        return None
    front = float(depths[behind][0])
    wall = usual_thickness(_behind(part, inwards, front), len(surface), reach)
    known |= away < wall
    solid = known & (distance < 0)
    seen = known[behind].sum(0)
    often = seen > OFTEN * max(int(seen.max(initial=0)), 1)
    profile = np.ones(len(cells))
    profile[often] = np.nanmedian(np.where(known, distance, np.nan)[behind][:, often], axis=0)
    profile[~behind_front] = 1
    profile = ndimage.grey_opening(profile.reshape(shape), 5).ravel()  # Narrow gaps are none.
    walls = profile < 0
    if walls.sum() < FEWEST or narrowest(cells[walls]) < 3 * wall:
        return None
    outline = outline_of(cells[walls])
    within = outline.find_simplex(cells) >= 0
    if walls[within].mean() > FULL or often[within & ~walls].mean() < SEEN:
        return None
    shown = solid[behind][:, walls].mean(1)
    start = depths[behind][np.flatnonzero(shown > WHOLE * shown.max()).max()]
    stands = (walls & ~_inner(outline, cells)).reshape(shape)
    rim = _rim(stands, often.reshape(shape), within.reshape(shape), round(wall / part.voxel))
    profile = np.minimum(profile.reshape(shape), np.clip(rim * (part.voxel / part.truncation), -1, 1))
    return _Section(front, wall, float(start), outline, lower, part.voxel, profile)


def _rim(walls: np.ndarray, seen: np.ndarray, within: np.ndarray, thick: int) -> np.ndarray:
    """Distance in cells to a wall along the outline where none was seen farther in: a bottom that was always hidden.

    Args:
        walls: (cells, cells) bool: those that were seen and go on.
        seen: (cells, cells) bool: what is known of them.
        within: (cells, cells) bool: the outline.
        thick: of the wall, cells.
    """
    rim = within & ~np.asarray(ndimage.binary_erosion(within, iterations=max(thick, 2)), bool) & ~seen
    cells, middle = np.argwhere(rim), np.argwhere(within).mean(0)
    ways = np.linspace(cells, np.broadcast_to(middle, cells.shape), max(seen.shape), axis=1).round().astype(int)
    first = ways[np.arange(len(cells)), seen[tuple(ways.T)].argmax(0)]  # That was seen on the way to the middle.
    rim[rim] = np.logical_not(walls[tuple(first.T)])
    if not rim.any():
        return np.full(rim.shape, np.inf)
    outside, inside = map(np.asarray, (ndimage.distance_transform_edt(~rim), ndimage.distance_transform_edt(rim)))
    return np.where(rim, 0.5 - inside, outside - 0.5)


def _ajar(section: _Section, base: np.ndarray, inwards: np.ndarray, stop: float, covered: Delaunay) -> float:
    """How far a drawer that is as deep in its cabinet as it ever was is from being shut; 0 if nothing tells.

    A drawer may have been open in every state. Its front would meet a frame around the opening, and of what that front
    covers and its box does not, most is there.

    Args:
        base: (n, 3) points of the cabinet.
        stop: where its back is, along the way inwards.
    """
    flat, depth = base @ axes_across(inwards).T, base @ inwards - section.front
    met = depth[(covered.find_simplex(flat) >= 0) & (section.outline.find_simplex(flat) < 0)]
    slice_, most = section.wall, (stop - section.front) / 2
    count, edges = np.histogram(met, np.arange(-2 * slice_, max(most, slice_), slice_))
    if count.max() < max(FEWEST, FRAME * np.median(count)):
        return 0.0
    return max(float(edges[count.argmax()] + slice_ / 2), 0.0)


def _extruded(
    part: DistanceGrid, section: _Section, inwards: np.ndarray, end: float, covered: Delaunay
) -> DistanceGrid:
    """The part with its walls as they are in its section from where they were last whole to a back before ``end``."""
    across = axes_across(inwards)
    grid = _longer(part, (end - section.start + 3 * part.voxel) * inwards)
    places = grid.lower + grid.voxel * np.indices(grid.distance.shape).reshape(3, -1).T
    rows = np.flatnonzero(places @ inwards > section.front)
    rows = rows[covered.find_simplex(places[rows] @ across.T) >= 0]
    along, flat = places[rows] @ inwards, places[rows] @ across.T
    walls = section.at(flat)
    walls[_inner(section.outline, flat) & (walls < 0)] = 1  # What lies in a drawer does not go on.
    back = (np.abs(along - (end - section.wall / 2)) - section.wall / 2) / part.truncation
    back[section.outline.find_simplex(flat) < 0] = 1
    guess = np.where(along < end, np.minimum(walls, back), (along - end) / part.truncation)
    distance, unseen = grid.distance.ravel().copy(), grid.weight.ravel()[rows] == 0
    # Beside the ragged end of a wall, what was behind it was seen for it.
    new = unseen | ((along > section.start) & (guess < 0))
    distance[rows[new]] = np.clip(guess[new], -1, 1)
    return replace(grid, distance=distance.reshape(grid.distance.shape))


def _behind(grid: DistanceGrid, inwards: np.ndarray, depth: float) -> DistanceGrid:
    """The same grid as if only what lies deeper had been seen."""
    places = grid.lower[:, None, None, None] + grid.voxel * np.indices(grid.distance.shape)
    return replace(grid, weight=np.where(np.tensordot(inwards, places, 1) > depth, grid.weight, 0))


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
