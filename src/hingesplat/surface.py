"""What one state shows of itself: points on its visible surface, and what its photographs say of any other point."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from hingesplat.capture import View
from hingesplat.gaussians import SH_C0, Gaussians
from hingesplat.register import normals_of
from hingesplat.stereo import Cloud, DepthMap, cubes, fused, seen_through
from hingesplat.visibility import FREE, HIDDEN, SURFACE, Sight, ask, look, sides

Pair = tuple[np.ndarray, np.ndarray]
"""Rows of the surface points of the two states, or a mask (n,) of each."""
Labels = tuple[np.ndarray, np.ndarray]
"""Part id of every surface point of the two states."""


@dataclass(frozen=True)
class Surface:
    """Points on the visible surface of one state, and the photographs that see it."""

    points: np.ndarray
    """(n, 3)"""
    colours: np.ndarray
    """(n, 3)"""
    normals: np.ndarray
    """(n, 3) unit, either side."""
    free_at_home: np.ndarray
    """(n,) ``free_share`` of the points in their own photographs: fits and stereo stick out a little."""
    sight: Sight
    facing: np.ndarray | None = None
    """(n, 3) the ``sides`` from which they are seen; None: nobody knows."""

    def rows(self, index: np.ndarray) -> "Surface":
        """The subset ``index``, seen by the same cameras."""
        free, facing = self.free_at_home[index], None if self.facing is None else self.facing[index]
        return Surface(self.points[index], self.colours[index], self.normals[index], free, self.sight, facing)

    def blurred(self, k: int = 8) -> np.ndarray:
        """(n, 3) mean colour of each point and its neighbours: what a coarse voxel would show."""
        index = np.asarray(KDTree(self.points).query(self.points, min(k, len(self.points)))[1])
        return self.colours[index.reshape(len(self.points), -1)].mean(1)

    @property
    def cloud(self) -> Cloud:
        return Cloud(self.points, self.normals, self.colours)


def free_share(answer: np.ndarray) -> np.ndarray:
    """(…,) share of the views that see each point in free space, from what ``ask`` answers, (…, 4)."""
    return answer[..., FREE] / np.maximum(answer[..., : HIDDEN + 1].sum(-1), 1)


def bounds(surfaces: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner (3,) of all points, a few stragglers aside, with a margin."""
    points = np.concatenate(surfaces)
    low, high = np.quantile(points, 0.002, axis=0), np.quantile(points, 0.998, axis=0)
    margin = 0.03 * (high - low).max()
    return low - margin, high + margin


def thin(points: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    """Indices of one random point in each occupied cube of the given size, so that area counts, not texture."""
    order = rng.permutation(len(points))
    _, first = np.unique(cubes(points[order], size), return_index=True)
    return order[rng.permutation(first)]


def surface_of(
    gaussians: Gaussians, views: Sequence[View], maps: Sequence[DepthMap], size: int, spacing: float, tolerance: float
) -> Surface:
    """The visible surface: what depth maps know, and where they know nothing, the Gaussians.

    Args:
        gaussians: fitted to the state.
        views, maps: its photographs, and their depth where it is known.
        size: longest side in pixels of the pictures that judge.
        spacing: of the points, scene units.
        tolerance: half-width of a surface, scene units.
    """
    sight = look(gaussians, views, size, tolerance, maps)
    cloud = fused(maps, spacing)
    points, colours = gaussians.means.numpy().astype(np.float64), (gaussians.sh[:, 0] * SH_C0 + 0.5).numpy()
    alone = (gaussians.opacities.numpy() > 0.2) & (seen_through(points, maps, 2 * tolerance) < 2)
    if len(cloud):
        alone &= KDTree(cloud.points).query(points)[0] > 2 * spacing
    cloud = cloud.joined(Cloud(points[alone], normals_of(gaussians)[alone], colours[alone]))
    answer = ask(cloud.points, cloud.colours, sight)
    facing = sides(cloud.points, cloud.normals, sight)
    surface = Surface(cloud.points, cloud.colours, cloud.normals, free_share(answer), sight, facing)
    views_of_it = answer[:, : HIDDEN + 1].sum(1)
    return surface.rows(np.flatnonzero((answer[:, SURFACE] >= 2) & (answer[:, FREE] <= 0.15 * views_of_it)))


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
