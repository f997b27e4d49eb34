"""The visual hull: what is left of space once every mask has cut away what it does not show.

Laurentini, "The visual hull concept for silhouette-based image understanding" (PAMI 1994), on voxels, coarse
to fine, with signed distances to the masks in place of rasterised voxels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image
from scipy.ndimage import distance_transform_edt

from hingesplat.camera import Camera
from hingesplat.capture.types import View
from hingesplat.errors import HingesplatError

TOLERANCE = 0.05
"""Share of the views that may disagree: a few bad masks must not carve the object away."""


@dataclass(frozen=True)
class Silhouette:
    """A mask at low resolution with the camera that follows it."""

    camera: Camera
    distance: np.ndarray
    """(h, w) float32: pixels from each pixel centre to the mask's edge, negative inside."""

    def margins(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 3) to pixels outside the mask (n,), NaN out of frame, and pixels per unit there (n,)."""
        T = self.camera.T_camera_world.astype(np.float32)
        p = points @ T[:3, :3].T + T[:3, 3]
        z = p[:, 2]
        scale = np.float32(max(self.camera.fx, self.camera.fy)) / np.maximum(z, 1e-6)
        u = np.float32(self.camera.fx) * p[:, 0] / np.maximum(z, 1e-6) + np.float32(self.camera.cx)
        v = np.float32(self.camera.fy) * p[:, 1] / np.maximum(z, 1e-6) + np.float32(self.camera.cy)
        h, w = self.distance.shape
        seen = (z > 1e-6) & (u >= 0) & (u < w) & (v >= 0) & (v < h)
        margin = np.full(len(points), np.nan, np.float32)
        margin[seen] = self.distance[v[seen].astype(np.intp), u[seen].astype(np.intp)]
        return margin, scale


def silhouettes(views: Sequence[View], size: int = 256) -> list[Silhouette]:
    """Signed distances of the masks (alpha ≥ 128) at no more than ``size`` pixels a side.

    Views with an empty mask are left out: they would carve everything. A low-resolution pixel belongs to the
    mask if any of its pixels does, so thin things stay.
    """
    found = []
    for view in views:
        mask = view.rgba[..., 3] >= 128
        if not mask.any():
            continue
        camera = view.camera
        step = size / max(camera.width, camera.height)
        if step < 1:
            w, h = max(1, round(camera.width * step)), max(1, round(camera.height * step))
            shrunk = Image.fromarray(mask.astype(np.float32)).resize((w, h), Image.Resampling.BOX)
            mask, camera = np.asarray(shrunk) > 0, camera.scaled(w, h)
        # A frame that the mask fills has no outside; the distance is then "far inside".
        within = np.full(mask.shape, float(size)) if mask.all() else np.asarray(distance_transform_edt(mask))
        signed = np.where(mask, 0.5 - within, np.asarray(distance_transform_edt(~mask)) - 0.5)
        found.append(Silhouette(camera, signed.astype(np.float32)))
    return found


def visual_hull(views: Sequence[View], resolution: int = 128) -> tuple[np.ndarray, float]:
    """Centres (m, 3) float32 of the occupied voxels, world frame, and the voxel's side.

    ``resolution`` voxels span the hull's longest side. A voxel stays if at least half of the views see it in
    their frame and no more than TOLERANCE of them see it outside their mask; views in which it falls outside
    the frame do not carve. Raises HingesplatError when nothing is left.
    """
    points, voxel = carve(silhouettes(views), resolution)
    if len(points) == 0:
        raise HingesplatError(
            f"{views[0].name if views else 'capture'}: the masks share no common visual hull; "
            "the poses or the masks of this state are wrong"
        )
    return points, voxel


def carve(views: Sequence[Silhouette], resolution: int) -> tuple[np.ndarray, float]:
    """As ``visual_hull``; (0, 3) points and voxel 0 when nothing is left."""
    nothing = np.zeros((0, 3), np.float32), 0.0
    if not views:
        return nothing
    centre, half = search_cube(views)
    if half <= 0:
        return nothing
    coarse = 32
    voxel = 2 * half / coarse
    points, _ = _keep(views, _grid(centre, np.full(3, coarse), voxel), voxel, final=False)
    if len(points) == 0:
        return nothing

    low, high = points.min(0) - voxel / 2, points.max(0) + voxel / 2
    levels = max(0, round(np.log2(resolution / coarse)))
    voxel = float((high - low).max()) / resolution * 2**levels
    counts = np.maximum(1, np.ceil((high - low) / voxel - 1e-4).astype(int))
    points, sure = _keep(views, _grid((low + high) / 2, counts, voxel), voxel, final=levels == 0)
    for level in range(levels):
        voxel /= 2
        inner = _children(points[sure], voxel)
        edge, edge_sure = _keep(views, _children(points[~sure], voxel), voxel, final=level == levels - 1)
        points = np.concatenate([inner, edge])
        sure = np.concatenate([np.ones(len(inner), bool), edge_sure])
    return points, voxel


def inside(views: Sequence[Silhouette], points: np.ndarray, voxel: float) -> np.ndarray:
    """Which of the points (n, 3) lie in the hull, (n,) bool; the masks are dilated by half a voxel."""
    outside, seen, _ = _votes(views, points, voxel / 2)
    return _survives(outside, seen, len(views))


def search_cube(views: Sequence[Silhouette]) -> tuple[np.ndarray, float]:
    """Centre (3,) and half side of a cube about the object, half side 0 if the cameras face away from it.

    The centre is the point nearest to the rays through the masks' centroids (L1, so that a few bad ones do
    not pull it away); the side comes from the masks' reach about its projection.
    """
    origins = np.stack([v.camera.centre for v in views])
    directions = np.stack([_centroid_ray(v) for v in views])
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    weights = np.ones(len(views))
    centre = origins.mean(0)
    for _ in range(8):
        A = (weights[:, None, None] * across).sum(0)
        b = (weights[:, None, None] * across @ origins[:, :, None]).sum(0)[:, 0]
        centre = np.linalg.lstsq(A, b, rcond=1e-9)[0]
        miss = np.linalg.norm((across @ (centre - origins)[:, :, None])[:, :, 0], axis=1)
        weights = 1 / np.maximum(miss, 1e-3 * max(float(miss.max()), 1e-12))
    reaches = []
    for view in views:
        uv, z = view.camera.project(centre[None])
        if z[0] > 0:
            rows, columns = np.nonzero(view.distance <= 0)
            pixels = np.hypot(columns + 0.5 - uv[0, 0], rows + 0.5 - uv[0, 1]).max()
            reaches.append(pixels / min(view.camera.fx, view.camera.fy) * z[0])
    if len(reaches) < len(views) / 2:
        return centre, 0.0
    # Perspective shows what lies beyond the centre smaller than it is.
    return centre, 1.3 * float(np.quantile(reaches, 0.9))


def _centroid_ray(view: Silhouette) -> np.ndarray:
    """Unit direction (3,), world frame, through the mask's centroid."""
    rows, columns = np.nonzero(view.distance <= 0)
    x = (columns.mean() + 0.5 - view.camera.cx) / view.camera.fx
    y = (rows.mean() + 0.5 - view.camera.cy) / view.camera.fy
    d = view.camera.T_world_camera[:3, :3] @ np.array([x, y, 1.0])
    return d / np.linalg.norm(d)


def _grid(centre: np.ndarray, counts: np.ndarray, voxel: float) -> np.ndarray:
    """Centres (n, 3) float32 of a box of voxels."""
    axes = [c + (np.arange(n) - (n - 1) / 2) * voxel for c, n in zip(centre, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)


def _children(points: np.ndarray, voxel: float) -> np.ndarray:
    """The eight voxels of side ``voxel`` in each voxel twice that size."""
    corners = (_grid(np.zeros(3), np.full(3, 2), voxel)).astype(np.float32)
    return (points[:, None] + corners).reshape(-1, 3)


def _keep(views: Sequence[Silhouette], points: np.ndarray, voxel: float, final: bool) -> tuple[np.ndarray, np.ndarray]:
    """The voxels that survive, and which of them need no further test since every part of them would.

    Before the final level a voxel stays if any part of it may: the masks are dilated by its half diagonal.
    """
    half_diagonal = voxel * 0.75**0.5
    outside, seen, deepest = _votes(views, points, voxel / 2 if final else half_diagonal)
    alive = _survives(outside, seen, len(views))
    return points[alive], deepest[alive] < -half_diagonal


def _survives(outside: np.ndarray, seen: np.ndarray, views: int) -> np.ndarray:
    return (seen >= views / 2) & (outside <= TOLERANCE * seen)


def _votes(views: Sequence[Silhouette], points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n,) views that see each ball (point, radius) outside their mask, views that see it, worst margin.

    The margin is in world units, negative inside, infinite where not every view sees the point.
    """
    outside = np.zeros(len(points), np.int32)
    seen = np.zeros(len(points), np.int32)
    worst = np.full(len(points), -np.inf, np.float32)
    alive = np.arange(len(points))
    for i, view in enumerate(views):
        margin, scale = view.margins(points[alive])
        visible = ~np.isnan(margin)
        # A pixel's distance is that of its centre; half its diagonal keeps the test conservative.
        outside[alive] += visible & (margin > radius * scale + 0.71)
        seen[alive] += visible
        worst[alive] = np.maximum(worst[alive], np.where(visible, (margin + 0.71) / scale, np.inf))
        if i % 4 == 3:
            hopeless = outside[alive] > TOLERANCE * len(views)
            alive = alive[~hopeless]
    return outside, seen, worst
