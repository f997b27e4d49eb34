"""Surface points by plane-sweep stereo: where the fit starts, hollows included.

A visual hull has a lid on every hollow. Gaussians that start on the lid are painted with what lies behind it and
never get there; photographs compared with their neighbours know the depth of most of it beforehand.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numba import njit
from scipy.spatial import KDTree

from hingesplat.camera import Camera
from hingesplat.capture import View, visual_hull
from hingesplat.capture.images import downsampled
from hingesplat.threads import parallel


@dataclass(frozen=True)
class StereoConfig:
    """Depth from neighbouring photographs."""

    image_size: int = 200
    """Longest side in pixels of the photographs that are compared."""
    planes: int = 64
    """Depths tried at each pixel, evenly spaced in inverse depth."""
    neighbours: int = 6
    """Photographs that each one is compared with, those that look the most alike way."""
    best: int = 2
    """How many of them must show the same: the others may be hidden from."""
    window: int = 5
    """Side in pixels of the patches compared."""
    bend: float = 0.002
    """Price of a step to the next plane between neighbouring pixels, as a difference of colour."""
    jump: float = 0.02
    """Price of a farther step, where the photograph shows no edge."""
    agree: int = 2
    """Depth maps that must confirm a point, besides its own."""
    tolerance: float = 0.01
    """Difference that confirms, as a fraction of the object's extent (longest side of its hull)."""


@dataclass(frozen=True)
class Picture:
    """A photograph of moderate size."""

    camera: Camera
    rgba: np.ndarray
    """(h, w, 4) float32, colour over white."""


@dataclass(frozen=True)
class DepthMap:
    """What stereo knows of one photograph."""

    camera: Camera
    depth: np.ndarray
    """(h, w) float32 along the optical axis, scene units; 0 where unknown or off the object."""
    rgb: np.ndarray
    """(h, w, 3) float32, over white."""

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """World points (n, 3) of the known pixels and their colours (n, 3)."""
        y, x = np.nonzero(self.depth > 0)
        return self.camera.lifted(x, y, self.depth[y, x]), self.rgb[y, x]


TRUNCATE = 0.2
"""Colour difference (mean of three channels) beyond which more is no worse."""


WITNESSES = 64
"""Depth maps that a point is held against where every map's points are."""
POINTS_PER_THREAD = 16_384
"""With fewer, another thread costs more than it brings."""


@dataclass(frozen=True)
class Cloud:
    """Points on a surface, evenly spread."""

    points: np.ndarray
    """(n, 3) world frame."""
    normals: np.ndarray
    """(n, 3) unit, towards the cameras where it is known which see the point."""
    colours: np.ndarray
    """(n, 3)"""

    def __len__(self) -> int:
        return len(self.points)

    @staticmethod
    def of(points: np.ndarray) -> "Cloud":
        """Grey points (n, 3), their normals guessed from their neighbours."""
        return Cloud(points, normals_by_neighbours(points), np.full(points.shape, 0.5))

    def joined(self, other: "Cloud") -> "Cloud":
        pairs = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(Cloud))
        return Cloud(*map(np.concatenate, pairs))

    def rows(self, index: np.ndarray) -> "Cloud":
        return Cloud(self.points[index], self.normals[index], self.colours[index])


def stereo(views: Sequence[View], config: StereoConfig) -> list[DepthMap]:
    """Depth of each photograph of one state, where its neighbours tell it and others confirm it."""
    hull, voxel = visual_hull(views, 64)
    low, high = hull.min(0) - voxel, hull.max(0) + voxel
    pictures = [_picture(v, config.image_size) for v in views]
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    looking = np.array([p.camera.T_world_camera[:3, 2] for p in pictures])
    alike = looking @ looking.T
    np.fill_diagonal(alike, -np.inf)
    maps = []
    for i, picture in enumerate(pictures):
        z = picture.camera.project(corners)[1]
        far = float(z.max())
        inverse = np.linspace(1 / max(float(z.min()), 0.02 * far), 1 / far, config.planes)
        others = [pictures[j] for j in np.argsort(-alike[i], kind="stable")[: min(config.neighbours, len(views) - 1)]]
        maps.append(DepthMap(picture.camera, sweep(picture, others, 1 / inverse, config), picture.rgba[..., :3]))
    tolerance = config.tolerance * float((high - low).max())
    return [replace(m, depth=confirmed(i, maps, tolerance, config.agree)) for i, m in enumerate(maps)]


def measured(views: Sequence[View], size: int) -> list[DepthMap]:
    """The depth pictures of a capture, at most ``size`` pixels long; empty for photographs without one."""
    maps = []
    for view in views:
        small = downsampled(view, size)
        seen = small.rgba[..., 3] >= 128
        depth = np.zeros(seen.shape) if small.depth is None else np.where(seen & (small.depth > 0), small.depth, 0)
        maps.append(depth_map(view, depth.astype(np.float32)))
    return maps


def depth_map(view: View, depth: np.ndarray) -> DepthMap:
    """A photograph at the size of its depth (h, w), 0 where unknown."""
    picture = _picture(view, max(depth.shape))
    return DepthMap(picture.camera, depth, picture.rgba[..., :3])


def fused(maps: Sequence[DepthMap], size: float) -> Cloud:
    """One point for each cube of edge ``size`` that at least two pixels lie in: their mean.

    Normals are the direction in which a point's twelve neighbours spread least, towards the cameras that see it.
    """
    if not maps:
        return Cloud(*(np.zeros((0, 3)) for _ in range(3)))
    seen = [m.points() for m in maps]
    points, colours = (np.concatenate(p) for p in zip(*seen, strict=True))
    towards = np.concatenate([m.camera.centre - p for m, (p, _) in zip(maps, seen, strict=True)])
    _, cell, count = np.unique(cubes(points, size), return_inverse=True, return_counts=True)
    columns = [np.bincount(cell, a) for a in (*points.T, *colours.T, *towards.T)]
    mean = (np.stack(columns, 1) / count[:, None])[count >= 2]
    normals = normals_by_neighbours(mean[:, :3])
    normals *= np.where((normals * mean[:, 6:]).sum(1, keepdims=True) < 0, -1, 1)
    return Cloud(mean[:, :3], normals, mean[:, 3:6])


def cubes(points: np.ndarray, size: float) -> np.ndarray:
    """(n,) int64: a number for the cube of edge ``size`` that each point (n, 3) lies in, the same for no two cubes."""
    cell = np.floor(points / size).astype(np.int64)
    cell -= cell.min(0, initial=0)
    return np.asarray(np.ravel_multi_index(tuple(cell.T), tuple(cell.max(0, initial=0) + 1)))


def normals_by_neighbours(points: np.ndarray, k: int = 12) -> np.ndarray:
    """(n, 3) unit normals of points (n, 3), either side."""
    if len(points) < 4:
        return np.tile([0.0, 0.0, 1.0], (len(points), 1))
    around = points[KDTree(points).query(points, min(k, len(points)))[1]]
    around = around - around.mean(1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]


def seen_through(points: np.ndarray, maps: Sequence[DepthMap], tolerance: float) -> np.ndarray:
    """(n,) number of depth maps that put their surface more than ``tolerance`` behind points (n, 3)."""
    return _votes(points, maps, tolerance / 2)[1]


def contradicted(points: np.ndarray, maps: Sequence[DepthMap], tolerance: float) -> np.ndarray:
    """(n,) bool: at least two maps see through points (n, 3), and more than put their surface there."""
    same, through = _votes(points, maps, tolerance / 2)
    return (through >= 2) & (through > same)


def _votes(points: np.ndarray, maps: Sequence[DepthMap], tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """How many maps put their surface within ``tolerance`` of each point (n, 3), and how many twice as far behind."""
    same, through = np.zeros(len(points), int), np.zeros(len(points), int)
    threads = min(torch.get_num_threads(), 1 + len(points) // POINTS_PER_THREAD)
    for m in maps:
        P = m.camera.K @ m.camera.T_camera_world[:3]
        parallel(_vote, threads, points, P, m.depth, tolerance, same, through)
    return same, through


@njit(cache=True, nogil=True, error_model="numpy")
def _vote(points, P, depth, tolerance, same, through, thread, threads):  # pragma: no cover - compiled
    """One map's votes added to ``same`` and ``through``; P (3, 4) takes points to pixels times depth, and depth."""
    height, width = depth.shape
    for i in range(thread * len(points) // threads, (thread + 1) * len(points) // threads):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        d = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
        if d <= 0:
            continue
        u = math.floor((P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / d)
        v = math.floor((P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / d)
        if 0 <= u < width and 0 <= v < height and depth[v, u] > 0:
            behind = depth[v, u] - d
            same[i] += abs(behind) < tolerance
            through[i] += behind > 2 * tolerance


def _picture(view: View, size: int) -> Picture:
    small = downsampled(view, size)
    rgba = small.rgba.astype(np.float32) / 255
    rgba[..., :3] = rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
    return Picture(small.camera, np.ascontiguousarray(rgba))


def sweep(picture: Picture, others: Sequence[Picture], planes: np.ndarray, config: StereoConfig) -> np.ndarray:
    """Depth (h, w) float32 of a picture by comparison with others; 0 off the object.

    ``planes`` are the depths tried, scene units, in the order of their inverses.
    """
    alpha = picture.rgba[..., 3]
    depth = np.zeros(alpha.shape, np.float32)
    rows, columns = np.flatnonzero(alpha.max(1) > 0.5), np.flatnonzero(alpha.max(0) > 0.5)
    if len(rows) == 0:
        return depth
    window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    reference = np.ascontiguousarray(picture.rgba[window])
    camera = picture.camera.cropped(int(columns[0]), int(rows[0]), reference.shape[1], reference.shape[0])
    cost = np.empty((len(others), len(planes), *reference.shape[:2]), np.float32)
    threads = torch.get_num_threads()
    for k, other in enumerate(others):
        A, b = _pixel_to_pixel(camera, other.camera)
        parallel(_match, threads, reference, other.rgba, A, b, planes, config.window // 2, cost[k])
    curve = np.empty((*reference.shape[:2], len(planes)), np.float32)
    parallel(_least, threads, cost, min(config.best, len(others)), curve)
    smooth = np.zeros_like(curve)
    for image, c, total in (
        (reference, curve, smooth),
        (reference.swapaxes(0, 1), curve.swapaxes(0, 1), smooth.swapaxes(0, 1)),
    ):
        parallel(_along_rows, threads, image, c, np.float32(config.bend), np.float32(config.jump), total)
    found = np.zeros(reference.shape[:2], np.float32)
    parallel(_winner, threads, smooth, (1 / planes).astype(np.float32), found)
    depth[window] = np.where(reference[..., 3] > 0.5, found, 0)
    return depth


def _pixel_to_pixel(source: Camera, target: Camera) -> tuple[np.ndarray, np.ndarray]:
    """A (3, 3) and b (3,): the source pixel (u, v) at depth z is at ``z A (u, v, 1) + b`` in target's image, times
    its depth there."""
    T = target.T_camera_world @ source.T_world_camera
    A, b = target.K @ T[:3, :3] @ np.linalg.inv(source.K), target.K @ T[:3, 3]
    return A.astype(np.float32), b.astype(np.float32)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _match(reference, other, A, b, planes, radius, cost, thread, threads):  # pragma: no cover - compiled
    """Mean truncated colour difference of the patches around each pixel, for each depth: (planes, h, w)."""
    h, w = cost.shape[1:]
    height, width = other.shape[:2]
    one, half, slack = np.float32(1), np.float32(0.5), np.float32(1e-3)
    raw = np.empty((h, w), np.float32)
    summed = np.empty((h + 1, w + 1), np.float32)
    for p in range(thread, len(planes), threads):
        z = np.float32(planes[p])
        for y in range(h):
            for x in range(w):
                raw[y, x] = TRUNCATE
                if reference[y, x, 3] <= 0.1:
                    continue
                u, v = np.float32(x + 0.5), np.float32(y + 0.5)
                d = z * (A[2, 0] * u + A[2, 1] * v + A[2, 2]) + b[2]
                if d < 1e-6:
                    continue
                s = (z * (A[0, 0] * u + A[0, 1] * v + A[0, 2]) + b[0]) / d - half
                t = (z * (A[1, 0] * u + A[1, 1] * v + A[1, 2]) + b[1]) / d - half
                if s < -slack or t < -slack or s >= width - 1 or t >= height - 1:
                    continue
                i, j = int(s), int(t)
                f, g = s - np.float32(i), t - np.float32(j)
                w00, w01, w10, w11 = (one - f) * (one - g), f * (one - g), (one - f) * g, f * g
                difference = np.float32(0)
                for c in range(3):
                    e = (
                        w00 * other[j, i, c]
                        + w01 * other[j, i + 1, c]
                        + w10 * other[j + 1, i, c]
                        + w11 * other[j + 1, i + 1, c]
                    )
                    difference += abs(e - reference[y, x, c])
                solid = max(other[j, i, 3], other[j, i + 1, 3], other[j + 1, i, 3], other[j + 1, i + 1, 3])
                if solid > 0.1:
                    raw[y, x] = min(difference / np.float32(3), np.float32(TRUNCATE))
        summed[0, :] = 0
        for y in range(h):
            row = np.float32(0)
            summed[y + 1, 0] = 0
            for x in range(w):
                row += raw[y, x]
                summed[y + 1, x + 1] = summed[y, x + 1] + row
        for y in range(h):
            y0, y1 = max(y - radius, 0), min(y + radius + 1, h)
            for x in range(w):
                x0, x1 = max(x - radius, 0), min(x + radius + 1, w)
                total = summed[y1, x1] - summed[y0, x1] - summed[y1, x0] + summed[y0, x0]
                cost[p, y, x] = total / ((y1 - y0) * (x1 - x0))


@njit(cache=True, nogil=True, error_model="numpy")
def _least(cost, best, curve, thread, threads):  # pragma: no cover - compiled
    """Mean cost (h, w, planes) of the ``best`` most alike pictures."""
    n, planes, h, w = cost.shape
    least, carried = np.empty((best, w), np.float32), np.empty(w, np.float32)
    for y in range(thread, h, threads):
        for p in range(planes):
            least[:] = np.inf
            for k in range(n):
                carried[:] = cost[k, p, y]
                for m in range(best):  # Insertion, for a whole row of pixels at a time.
                    for x in range(w):
                        low, high = min(carried[x], least[m, x]), max(carried[x], least[m, x])
                        least[m, x], carried[x] = low, high
            for x in range(w):
                curve[y, x, p] = least[:, x].sum() / best


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _along_rows(rgba, curve, bend, jump, total, thread, threads):  # pragma: no cover - compiled
    """Add to ``total`` the costs gathered along each row from either side (semi-global matching, Hirschmuller 2008)."""
    h, w, planes = curve.shape
    path, last = np.empty(planes + 2, np.float32), np.empty(planes + 2, np.float32)
    far = np.float32(1e9)
    for y in range(thread, h, threads):
        for side in range(2):
            path[:], last[:] = far, far
            lowest = np.float32(0)
            for i in range(w):
                x = i if side == 0 else w - 1 - i
                if rgba[y, x, 3] <= 0.5:
                    last[1 : planes + 1] = 0
                    lowest = np.float32(0)
                    continue
                before = x - 1 if side == 0 else x + 1
                edge = np.float32(0)
                if i > 0:
                    for c in range(3):
                        edge += abs(rgba[y, x, c] - rgba[y, before, c])
                farther = lowest + max(jump / (1 + 10 * edge), bend)
                least = far
                for p in range(planes):
                    near = min(last[p], last[p + 2]) + bend
                    value = curve[y, x, p] + min(min(last[p + 1], near), farther) - lowest
                    path[p + 1] = value
                    total[y, x, p] += value
                    least = min(least, value)
                lowest = least
                path, last = last, path


@njit(cache=True, nogil=True, error_model="numpy")
def _winner(curve, inverse_planes, depth, thread, threads):  # pragma: no cover - compiled
    """The depth (h, w) of the least cost, between the planes by a parabola."""
    h, w, planes = curve.shape
    for y in range(thread, h, threads):
        for x in range(w):
            p = curve[y, x].argmin()
            offset = np.float32(0)
            if 0 < p < planes - 1:
                bend = curve[y, x, p - 1] - 2 * curve[y, x, p] + curve[y, x, p + 1]
                if bend > 1e-9:
                    offset = 0.5 * (curve[y, x, p - 1] - curve[y, x, p + 1]) / bend
            depth[y, x] = 1 / (inverse_planes[p] + offset * (inverse_planes[1] - inverse_planes[0]))


def witnesses(count: int) -> range:
    """At most WITNESSES of so many maps, evenly picked: each against all would take the square of their number."""
    return range(0, count, max(-(-count // WITNESSES), 1))


def confirmed(index: int, maps: Sequence[DepthMap], tolerance: float, agree: int) -> np.ndarray:
    """One map's depth (h, w), 0 where fewer than ``agree`` others confirm it or twice as many see through."""
    m = maps[index]
    y, x = np.nonzero(m.depth > 0)
    points = m.camera.lifted(x, y, m.depth[y, x])
    others = [maps[k] for k in witnesses(len(maps)) if k != index]
    same, through = _votes(points, others, tolerance)
    keep = (same >= agree) & (same >= 0.5 * through)
    depth = np.zeros_like(m.depth)
    depth[y[keep], x[keep]] = m.depth[y[keep], x[keep]]
    return depth
