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
from hingesplat.gaussians import Gaussians
from hingesplat.render import render
from hingesplat.stereo import DepthMap, seen_through, witnesses
from hingesplat.threads import parallel

FREE, SURFACE, HIDDEN, COLOUR = range(4)
"""Columns of ``ask``'s answer."""


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
    def reach(self) -> np.ndarray:
        """(v, h, w, 2) float32 least and greatest known depth of the pixel and its eight neighbours.

        Both are infinite where all nine lie off the object, so that any point there is in front; both are 0 where
        nothing is known.
        """
        near = minimum_filter(np.where(self.depth > 0, self.depth, np.inf), (1, 3, 3))
        far = maximum_filter(np.maximum(self.depth, 0), (1, 3, 3))
        off = np.asarray(minimum_filter(self.depth == 0, (1, 3, 3)), bool)
        return np.stack([np.where((far > 0) | off, near, 0), np.where(off, np.inf, far)], -1).astype(np.float32)


@torch.no_grad()
def look(
    gaussians: Gaussians, views: Sequence[View], size: int, tolerance: float, maps: Sequence[DepthMap] = ()
) -> Sight:
    """The state's depth at most ``size`` pixels wide from each photograph's camera.

    It is rendered, but for pixels whose depth ``maps`` (one a photograph, or none) know; and nothing is said of
    pixels where the maps see through what is rendered: fits put lids on hollows. The mask comes from the photograph,
    so that a floater makes no surface where the photograph shows background.
    """
    longest = max(max(v.camera.width, v.camera.height) for v in views)
    factor = max(longest / size, 1.0)
    width = max(round(v.camera.width / factor) for v in views)
    height = max(round(v.camera.height / factor) for v in views)
    P, depth, rgb = [], [], []
    for i, view in enumerate(views):
        camera = view.camera.scaled(round(view.camera.width / factor), round(view.camera.height / factor))
        r = render(gaussians, camera)
        rgba = torch.from_numpy(view.rgba).permute(2, 0, 1)[None].float() / 255
        small = torch.nn.functional.interpolate(rgba, (camera.height, camera.width), mode="area")[0]
        mask = small[3] > 0.5
        solid = r.alpha > 0.3
        d = torch.where(mask & solid, r.depth / r.alpha.clamp_min(1e-3), torch.where(mask, -1.0, 0.0))
        if maps:
            d = torch.from_numpy(_corrected(d.numpy(), camera, maps[i], maps, 2 * tolerance))
        picture = small[:3] * small[3:] + 1 - small[3:]
        pad = (0, width - camera.width, 0, height - camera.height)
        depth.append(torch.nn.functional.pad(d, pad).numpy())
        rgb.append(torch.nn.functional.pad(picture, pad, value=1.0).permute(1, 2, 0).numpy())
        P.append(camera.K @ camera.T_camera_world[:3])
    return Sight(
        np.stack(P).astype(np.float32),
        np.ascontiguousarray(np.stack(depth), dtype=np.float32),
        np.ascontiguousarray(np.stack(rgb), dtype=np.float32),
        tolerance,
    )


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


@njit(cache=True, nogil=True, error_model="numpy")
def _ask(points, colours, P, depth, reach, rgb, tolerance, answer, thread, threads):  # pragma: no cover - compiled
    views, height, width = depth.shape
    answer[thread::threads] = 0
    # One picture after the other, so that it stays in the cache.
    for v in range(views):
        p = P[v]
        for i in range(thread, points.shape[0], threads):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            d = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
            if d < 1e-3:
                continue
            u = int(np.floor((p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / d))
            w = int(np.floor((p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / d))
            if u < 1 or w < 1 or u >= width - 1 or w >= height - 1:
                continue
            # The best of nine pixels decides, so that an edge or a speckle one pixel off is no contradiction.
            near, far = reach[v, w, u, 0], reach[v, w, u, 1]
            if d <= near - tolerance:
                answer[i, FREE] += 1
                continue
            if d >= far + tolerance:
                answer[i, HIDDEN] += far > 0  # 0: nothing is known.
                continue
            least = np.float32(1e9)
            signed = np.float32(0)
            for b in range(-1, 2):
                for a in range(-1, 2):
                    s = depth[v, w + b, u + a]
                    if s > 0 and abs(d - s) < least:
                        least = abs(d - s)
                        signed = d - s
            if least < tolerance:
                answer[i, SURFACE] += 1
                closest, c = np.float32(3), i % colours.shape[0]
                for b in range(-1, 2):
                    for a in range(-1, 2):
                        e0 = rgb[v, w + b, u + a, 0] - colours[c, 0]
                        e1 = rgb[v, w + b, u + a, 1] - colours[c, 1]
                        e2 = rgb[v, w + b, u + a, 2] - colours[c, 2]
                        closest = min(closest, e0 * e0 + e1 * e1 + e2 * e2)
                answer[i, COLOUR] += np.sqrt(closest)
            elif signed < 0:
                answer[i, FREE] += 1
            else:
                answer[i, HIDDEN] += 1
    for i in range(thread, points.shape[0], threads):
        answer[i, COLOUR] /= max(answer[i, SURFACE], np.float32(1))


def ask(points: np.ndarray, colours: np.ndarray, sight: Sight) -> np.ndarray:
    """What a state's cameras say of points (n, 3) with colours (m, 3), which start again where there are fewer.

    Returns:
        (n, 4): the number of views in which the point is in free space, on the surface, hidden behind it; and the mean
        Euclidean RGB difference (best of nine pixels) over the views that see it on the surface.
    """
    answer = np.empty((len(points), 4), np.float32)
    parallel(
        _ask,
        torch.get_num_threads(),
        np.ascontiguousarray(points, dtype=np.float32),
        np.ascontiguousarray(colours, dtype=np.float32),
        sight.P,
        sight.depth,
        sight.reach,
        sight.rgb,
        np.float32(sight.tolerance),
        answer,
    )
    return answer
