"""What the photographs of one state say about a point: empty here, on the surface here, or hidden.

A point that is drawn in front of what a photograph shows, or beside the object's mask, cannot be there. This is the
judge of every motion hypothesis: the other state's pictures, never point matches.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numba import njit
from scipy.ndimage import maximum_filter, minimum_filter

from hingesplat.camera import Camera
from hingesplat.capture import View
from hingesplat.capture.images import downsampled
from hingesplat.gaussians import Gaussians
from hingesplat.render import render
from hingesplat.simd import KERNEL
from hingesplat.stereo import DepthMap, seen_through, witnesses
from hingesplat.threads import parallel

FREE, SURFACE, HIDDEN, COLOUR = range(4)
"""Columns of ``ask``'s answer."""
COLOURED = 4
"""And of the views whose colours count."""
BEHIND = np.float32(0.2)
"""Cosine between a side and the way to a camera from which, below 0, the camera is behind it."""
BLOCK = 512
"""Points that are asked about at once."""


@dataclass(frozen=True)
class Sight:
    """Low-resolution depth, colour and mask of one state from each of its cameras."""

    P: np.ndarray
    """(v, 3, 4) float32 world to pixel projection; the third row gives depth."""
    depth: np.ndarray
    """(v, h, w) float32 rendered depth, scene units; 0 off the object."""
    rgb: np.ndarray
    """(v, h, w, 3) float32 photograph over white."""
    tolerance: float
    """Half-width of the band around the surface, scene units."""

    @cached_property
    def centres(self) -> np.ndarray:
        """(v, 3) float32 where the cameras are."""
        P = self.P.astype(np.float64)
        return -np.linalg.solve(P[:, :, :3], P[:, :, 3:])[..., 0].astype(np.float32)

    @cached_property
    def reach(self) -> np.ndarray:
        """(v, h, w, 2) float32 least and greatest known depth of the pixel and its eight neighbours.

        Both are infinite where all nine lie off the object, so that any point there is in front; both are 0 where
        nothing is known.
        """
        near = minimum_filter(np.where(self.depth > 0, self.depth, np.inf), (1, 3, 3))
        far = maximum_filter(np.maximum(self.depth, 0), (1, 3, 3))
        off = np.asarray(minimum_filter(self.depth == 0, (1, 3, 3)), bool)
        return np.stack([np.where((far > 0) | off, near, 0), np.where(off, np.inf, far)], -1).astype(np.float32)

    @cached_property
    def pixels(self) -> np.ndarray:
        """(v, h, w, 4) float32: colour and depth side by side."""
        return np.concatenate([self.rgb, self.depth[..., None]], -1)


@torch.no_grad()
def look(
    gaussians: Gaussians, views: Sequence[View], size: int, tolerance: float, maps: Sequence[DepthMap] = ()
) -> Sight:
    """The state's depth at most ``size`` pixels wide from each photograph's camera.

    It is rendered, but for pixels whose depth ``maps`` (one a photograph, or none) know; and nothing is said of
    pixels where the maps see through what is rendered: fits put lids on hollows. The mask comes from the photograph,
    so that a floater makes no surface where the photograph shows background.
    """
    factor = max(max(max(v.camera.width, v.camera.height) for v in views) / size, 1.0)
    photographs = [downsampled(v, round(max(v.camera.width, v.camera.height) / factor)) for v in views]
    shape = len(views), max(v.camera.height for v in photographs), max(v.camera.width for v in photographs)
    depth, rgb = np.zeros(shape, np.float32), np.ones((*shape, 3), np.float32)
    half = 127 if factor == 1 else 128  # 128 may be a mean of half, rounded; such pixels would make all things larger.
    for i, view in enumerate(photographs):
        r, rgba = render(gaussians, view.camera), torch.from_numpy(view.rgba).float() / 255
        mask = torch.from_numpy(view.rgba[..., 3] > half)
        drawn = torch.where(mask & (r.alpha > 0.3), r.depth / r.alpha.clamp_min(1e-3), torch.where(mask, -1.0, 0.0))
        known = _corrected(drawn.numpy(), view.camera, maps[i], maps, 2 * tolerance) if maps else drawn.numpy()
        rows, columns = slice(view.camera.height), slice(view.camera.width)
        depth[i, rows, columns] = known
        rgb[i, rows, columns] = rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
    P = np.stack([v.camera.K @ v.camera.T_camera_world[:3] for v in photographs])
    return Sight(P.astype(np.float32), depth, rgb, tolerance)


def sides(points: np.ndarray, normals: np.ndarray, sight: Sight) -> np.ndarray:
    """(n, 3) the side from which a state's cameras see points (n, 3) of its surface, as long as it is sure, up to 1.

    A thin plate has points that both sides are seen at: their side is none.

    Args:
        normals: (n, 3) unit, either side.
    """
    towards, views = np.zeros(len(points)), np.zeros(len(points))
    for P, centre, depth in zip(sight.P, sight.centres, sight.depth, strict=True):
        at = points @ P[:, :3].T + P[:, 3]
        x, y = (np.floor(at[:, k] / np.maximum(at[:, 2], 1e-6)).astype(int) for k in (0, 1))
        within = (at[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < depth.shape[1]) & (y < depth.shape[0])
        there = np.flatnonzero(within)
        shown = depth[y[there], x[there]]
        there = there[(shown > 0) & (np.abs(shown - at[there, 2]) < sight.tolerance)]
        way = centre - points[there]
        towards[there] += (way * normals[there]).sum(1) / np.linalg.norm(way, axis=1)
        views[there] += 1
    return normals * np.clip(2 * towards / np.maximum(views, 1), -1, 1)[:, None]


def _corrected(
    rendered: np.ndarray, camera: Camera, own: DepthMap, maps: Sequence[DepthMap], tolerance: float
) -> np.ndarray:
    """Rendered depth (h, w) where maps know better: their depth, or -1 where they see through it."""
    h, w = rendered.shape
    rows = ((np.arange(h) + 0.5) * own.depth.shape[0] / h).astype(int)
    columns = ((np.arange(w) + 0.5) * own.depth.shape[1] / w).astype(int)
    known = own.depth[rows[:, None], columns]
    y, x = np.nonzero((rendered > 0) & (known == 0))
    others = [maps[k] for k in witnesses(len(maps))]
    lid = seen_through(camera.lifted(x, y, rendered[y, x]), others, tolerance) >= 2
    depth = np.where((rendered != 0) & (known > 0), known, rendered)
    depth[y[lid], x[lid]] = -1
    return depth


@njit(**KERNEL)
def _ask(
    points, colours, facing, P, centres, reach, pixels, tolerance, answer, thread, threads
):  # pragma: no cover - compiled
    views, height, width = reach.shape[:3]
    first, last = points.shape[1] * thread // threads, points.shape[1] * (thread + 1) // threads
    answer[:, first:last] = 0
    zero, one = np.float32(0), np.float32(1)
    depth, pixel, left = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    # One picture after the other, so that it stays in the cache; a few points at once, without a branch.
    for v in range(views):
        p, bounds, picture = P[v], reach[v].reshape(-1, 2), pixels[v].reshape(-1, 4)
        for start in range(first, last, BLOCK):
            n = min(BLOCK, last - start)
            x, y, z = points[0, start : start + n], points[1, start : start + n], points[2, start : start + n]
            free, surface, hidden = (
                answer[FREE, start : start + n],
                answer[SURFACE, start : start + n],
                answer[HIDDEN, start : start + n],
            )
            for i in range(n):
                depth[i] = p[2, 0] * x[i] + p[2, 1] * y[i] + p[2, 2] * z[i] + p[2, 3]
                u = (p[0, 0] * x[i] + p[0, 1] * y[i] + p[0, 2] * z[i] + p[0, 3]) / depth[i]
                w = (p[1, 0] * x[i] + p[1, 1] * y[i] + p[1, 2] * z[i] + p[1, 3]) / depth[i]
                within = (u >= 1) & (w >= 1) & (u < np.float32(width - 1)) & (w < np.float32(height - 1))
                within &= depth[i] >= np.float32(1e-3)
                pixel[i] = np.int32(w if within else zero) * np.int32(width) + np.int32(u if within else zero)
            count = 0
            for i in range(n):
                near, far, within = bounds[pixel[i], 0], bounds[pixel[i], 1], pixel[i] > 0
                before = within & (depth[i] <= near - tolerance)
                behind = within & (depth[i] >= far + tolerance) & (not before)
                free[i] += one if before else zero
                hidden[i] += one if behind & (far > 0) else zero  # 0: nothing is known.
                left[count] = i
                count += within & (not before) & (not behind)
            # The best of nine pixels decides, so that an edge or a speckle one pixel off is no contradiction.
            for i in left[:count]:
                least, signed = np.float32(1e9), zero
                for b in range(-1, 2):
                    for a in range(-1, 2):
                        shown = picture[pixel[i] + b * width + a, 3]
                        off = depth[i] - shown
                        nearer = (shown > 0) & (abs(off) < least)
                        least, signed = abs(off) if nearer else least, off if nearer else signed
                if least < tolerance:
                    surface[i] += 1
                    f = (start + i) % facing.shape[1]
                    dx, dy, dz = centres[v, 0] - x[i], centres[v, 1] - y[i], centres[v, 2] - z[i]
                    towards = facing[0, f] * dx + facing[1, f] * dy + facing[2, f] * dz
                    if towards < 0 and towards * towards > BEHIND * BEHIND * (dx * dx + dy * dy + dz * dz):
                        continue
                    closest, c = np.float32(3), (start + i) % colours.shape[0]
                    for b in range(-1, 2):
                        for a in range(-1, 2):
                            there = picture[pixel[i] + b * width + a]
                            e0, e1, e2 = there[0] - colours[c, 0], there[1] - colours[c, 1], there[2] - colours[c, 2]
                            closest = min(closest, e0 * e0 + e1 * e1 + e2 * e2)
                    answer[COLOUR, start + i] += np.sqrt(closest)
                    answer[COLOURED, start + i] += 1
                elif signed < 0:
                    free[i] += 1
                else:
                    hidden[i] += 1
    for i in range(first, last):
        answer[COLOUR, i] /= max(answer[COLOURED, i], one)


def ask(points: np.ndarray, colours: np.ndarray, sight: Sight, facing: np.ndarray | None = None) -> np.ndarray:
    """What a state's cameras say of points (n, 3) with colours (m, 3), which start again where there are fewer.

    Args:
        facing: (m, 3) the sides from which the points can be seen, as long as that is sure; None: from all around. Of
            the surface that a camera behind a point sees there the colour is another's.

    Returns:
        (n, 4): the number of views in which the point is in free space, on the surface, hidden behind it; and the mean
        Euclidean RGB difference (best of nine pixels) over the views that see it on the surface, and from its side.
    """
    facing = np.zeros((1, 3)) if facing is None else facing
    answer = np.empty((COLOURED + 1, len(points)), np.float32)
    parallel(
        _ask,
        torch.get_num_threads(),
        np.ascontiguousarray(points.T, dtype=np.float32),
        np.ascontiguousarray(colours, dtype=np.float32),
        np.ascontiguousarray(facing.T, dtype=np.float32),
        sight.P,
        sight.centres,
        sight.reach,
        sight.pixels,
        np.float32(sight.tolerance),
        answer,
    )
    return answer[:COLOURED].T
