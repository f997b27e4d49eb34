"""Truncated signed distance grids: fused from depth (Curless and Levoy 1996), and cut by one another.

Distances are to the tangent planes of the depth maps. A view carves: what lies before its surface is empty.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np
import torch

from hingesplat.camera import Camera
from hingesplat.threads import parallel

WALL, DEEP = np.float32(2.0), np.float32(0.001)
"""How much lying just behind the part's own surface says for being inside, and lying farther behind, beside the 1 of a
view that sees through. It takes several good views to hollow a wall, and few to see into what lies behind it."""
TWO_SIDED = 0.01
"""Places where a wall was seen from both sides, of those of the surface, from which on they tell how thick it is."""


@dataclass(frozen=True)
class DepthView:
    """What one view says of one part."""

    camera: Camera
    """In the frame of the part."""
    depth: np.ndarray
    """(height, width) float32 z-depth of the first surface; inf: the ray meets nothing; nan: not known."""
    own: np.ndarray
    """(height, width) bool: that surface belongs to the part."""
    rgb: np.ndarray
    """(height, width, 3) float32 in [0, 1]."""
    planes: np.ndarray
    """(height, width, 5) float32, what ``tangent_planes`` gives."""


@dataclass(frozen=True)
class DistanceGrid:
    """Signed distances on a box of voxels, in the frame of a part."""

    lower: np.ndarray
    """(3,) centre of voxel (0, 0, 0)."""
    voxel: float
    """Edge of a voxel, scene units."""
    truncation: float
    """Scene units."""
    distance: np.ndarray
    """(x, y, z) float32 in [-1, 1], units of the truncation, positive outside."""
    weight: np.ndarray
    """(x, y, z) float32; 0 where no view saw free space or a surface."""

    @property
    def T_part_voxel(self) -> np.ndarray:
        """(4, 4): from indices to the part's frame."""
        T = np.diag([self.voxel, self.voxel, self.voxel, 1.0])
        T[:3, 3] = self.lower
        return T


def fuse_depth(
    views: Sequence[DepthView],
    lower: np.ndarray,
    shape: tuple[int, int, int],
    voxel: float,
    truncation: float,
) -> DistanceGrid:
    """Fuse depth maps into a grid of signed distances, -1 where no view saw anything; fields as in ``DistanceGrid``."""
    total, weight, free, behind = (np.zeros(shape, np.float32) for _ in range(4))
    grid = DistanceGrid(lower, voxel, truncation, total, weight)
    for view in views:
        T = view.camera.T_camera_world[:3] @ grid.T_part_voxel
        parallel(
            _integrate, torch.get_num_threads(), total, weight, free, behind,
            (view.camera.K @ T).astype(np.float32), T.astype(np.float32),
            np.float32(truncation), view.depth, view.own, view.planes,
        )  # fmt: skip
    free = np.maximum(free - behind, 0)
    weight += free
    distance = np.where(weight > 0, (total + free) / np.maximum(weight, 1e-6), -1).astype(np.float32)
    return replace(grid, distance=distance)


def distance_to(grid: DistanceGrid, other: DistanceGrid, T_grid_other: Sequence[np.ndarray]) -> np.ndarray:
    """The signed distance from each voxel of ``grid`` to the surface of ``other``, the least over its poses.

    Args:
        T_grid_other: (4, 4) each.

    Returns:
        Of the grid's shape, scene units, no more than the truncation of ``other`` either way; inf outside its box.
    """
    nearest = np.full(grid.distance.shape, np.inf, np.float32)
    for T in T_grid_other:
        T_voxel = np.linalg.inv(T @ other.T_part_voxel) @ grid.T_part_voxel
        parallel(_lower, torch.get_num_threads(), nearest, other.distance, T_voxel[:3])
    return nearest * np.float32(other.truncation)


def wall_thickness(grid: DistanceGrid, most: float) -> np.ndarray:
    """(n,) how thick walls up to ``most`` are, scene units, at each place where both of their sides were seen.

    Along every line of the grid: from where seen space turns solid to where it is empty again, times the cosine between
    the line and the wall's normal. Lines that meet a side at less than 45° do not count.
    """
    return np.array(_walls(grid.distance, grid.weight, most / grid.voxel), float) * grid.voxel


def usual_thickness(grid: DistanceGrid, points: int, reach: float) -> float:
    """How thick walls of a part are where both sides were seen, scene units: the median, at most ``reach``.

    Just that where such places are rare beside the ``points`` of its surface.
    """
    known = wall_thickness(grid, 2 * reach)
    return min(float(np.median(known)), reach) if len(known) > TWO_SIDED * points else reach


def tangent_planes(camera: Camera, depth: np.ndarray, jump: float) -> np.ndarray:
    """The plane at each pixel of a depth map: (height, width, 5) float32, normal, offset, weight.

    ``n·x + offset`` is the signed distance of the camera-frame point x, positive towards the camera; the
    weight is the cosine of incidence, and 0 where neighbours are missing or the surface turns edge-on.
    On a plane, inverse depth is affine in the pixel: least squares over a window of 5 × 5 pixels, of which those
    farther off than ``jump`` (scene units) lie on another surface.
    """
    planes = np.zeros((camera.height, camera.width, 5), np.float32)
    _fit_planes(depth, camera.fx, camera.fy, camera.cx, camera.cy, jump, planes)
    return planes


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fit_planes(depth, fx, fy, cx, cy, jump, planes):  # pragma: no cover
    """Fill ``planes`` as ``tangent_planes`` says; a x + b y + c is the inverse depth at (x, y, 1)."""
    height, width = depth.shape
    for v in range(2, height - 2):
        for u in range(2, width - 2):
            z0 = depth[v, u]
            if not np.isfinite(z0):
                continue
            n = sx = sy = sxx = sxy = syy = sq = sxq = syq = 0.0
            for j in range(-2, 3):
                for i in range(-2, 3):
                    z = depth[v + j, u + i]
                    if abs(z - z0) < jump:
                        q = 1 / z - 1 / z0
                        n += 1
                        sx, sy, sxx, sxy, syy = sx + i, sy + j, sxx + i * i, sxy + i * j, syy + j * j
                        sq, sxq, syq = sq + q, sxq + i * q, syq + j * q
            # The normal equations, centred.
            xx, xy, yy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
            xq, yq = sxq - sx * sq / n, syq - sy * sq / n
            determinant = xx * yy - xy * xy
            if n < 8 or determinant < 1:
                continue
            du, dv = (yy * xq - xy * yq) / determinant, (xx * yq - xy * xq) / determinant
            here = 1 / z0 + (sq - du * sx - dv * sy) / n
            x, y = (u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy
            a, b = du * fx, dv * fy
            c = here - a * x - b * y
            length = np.sqrt(a * a + b * b + c * c)
            cosine = here / (length * np.sqrt(x * x + y * y + 1))
            if here > 0 and cosine > 0.15:
                planes[v, u, 0], planes[v, u, 1], planes[v, u, 2] = -a / length, -b / length, -c / length
                planes[v, u, 3], planes[v, u, 4] = 1 / length, cosine


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _integrate(total, weight, free, behind, P, T, truncation, depth, own, planes, thread, threads):  # pragma: no cover
    """Add one view to the grid, in place. ``P`` (3, 4) takes voxels to pixels, ``T`` (3, 4) to the camera's frame."""
    height, width = depth.shape
    nx, ny, nz = total.shape
    for i in range(thread, nx, threads):
        for j in range(ny):
            a0 = P[0, 0] * i + P[0, 1] * j + P[0, 3]
            b0 = P[1, 0] * i + P[1, 1] * j + P[1, 3]
            z0 = P[2, 0] * i + P[2, 1] * j + P[2, 3]
            for k in range(nz):
                z = z0 + P[2, 2] * k
                if z <= 1e-6:
                    continue
                inverse = 1 / z
                a, b = (a0 + P[0, 2] * k) * inverse, (b0 + P[1, 2] * k) * inverse
                if a < 0 or b < 0 or a >= width or b >= height:
                    continue
                u, v = int(a), int(b)
                d = depth[v, u]
                if np.isnan(d):
                    continue
                if z < d - 4 * truncation or (not own[v, u] and z < d - truncation):
                    free[i, j, k] += 1
                elif own[v, u] and planes[v, u, 4] > 0:
                    x = T[0, 0] * i + T[0, 1] * j + T[0, 2] * k + T[0, 3]
                    y = T[1, 0] * i + T[1, 1] * j + T[1, 2] * k + T[1, 3]
                    s = planes[v, u, 0] * x + planes[v, u, 1] * y + planes[v, u, 2] * z + planes[v, u, 3]
                    s /= truncation
                    if s < -1:
                        behind[i, j, k] += WALL * max((3 + s) / 2, 0) + DEEP
                    elif s > 1:
                        free[i, j, k] += 1
                    else:  # Votes fade at both ends alike, so that noise does not shift the surface.
                        w = planes[v, u, 4] * min(2 - 2 * abs(s), 1.0)
                        total[i, j, k] += w * s
                        weight[i, j, k] += w


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lower(nearest, distance, T, thread, threads):  # pragma: no cover
    """Lower ``nearest`` in place to the interpolated distances of another grid, whose indices ``T`` (3, 4) leads to."""
    nx, ny, nz = nearest.shape
    mx, my, mz = distance.shape
    for i in range(thread, nx, threads):
        for j in range(ny):
            x0 = T[0, 0] * i + T[0, 1] * j + T[0, 3]
            y0 = T[1, 0] * i + T[1, 1] * j + T[1, 3]
            z0 = T[2, 0] * i + T[2, 1] * j + T[2, 3]
            # The stretch of this column that lies in the other grid.
            low, high = 0.0, float(nz - 1)
            for start, slope, size in ((x0, T[0, 2], mx), (y0, T[1, 2], my), (z0, T[2, 2], mz)):
                if abs(slope) < 1e-9:
                    if start < 0 or start >= size - 1:
                        high = -1.0
                else:
                    a, b = -start / slope, (size - 1.001 - start) / slope
                    low, high = max(low, min(a, b)), min(high, max(a, b))
            for k in range(int(np.ceil(low)), int(np.floor(high)) + 1):
                x, y, z = x0 + T[0, 2] * k, y0 + T[1, 2] * k, z0 + T[2, 2] * k
                a, b, c = int(x), int(y), int(z)
                if x < 0 or y < 0 or z < 0 or a >= mx - 1 or b >= my - 1 or c >= mz - 1:
                    continue
                u, v, w = x - a, y - b, z - c
                d = 0.0
                for p in range(2):
                    for q in range(2):
                        s = (u if p else 1 - u) * (v if q else 1 - v)
                        d += s * ((1 - w) * distance[a + p, b + q, c] + w * distance[a + p, b + q, c + 1])
                nearest[i, j, k] = min(nearest[i, j, k], d)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _walls(distance, weight, most):  # pragma: no cover
    """What ``wall_thickness`` gives, in voxels."""
    found = [np.float64(0) for _ in range(0)]
    shape = distance.shape
    for axis in range(3):
        x, y, z = np.int64(axis == 0), np.int64(axis == 1), np.int64(axis == 2)
        for i in range(shape[0] - x):
            for j in range(shape[1] - y):
                for k in range(shape[2] - z):
                    if weight[i, j, k] == 0 or weight[i + x, j + y, k + z] == 0:
                        continue
                    before, first = distance[i, j, k], distance[i + x, j + y, k + z]
                    if before < 0 or first >= 0:
                        continue
                    room = (x * (shape[0] - i) + y * (shape[1] - j) + z * (shape[2] - k)) - 1
                    n = 2
                    while n <= room and n < most + 2 and distance[i + n * x, j + n * y, k + n * z] < 0:
                        n += 1
                    if n > room:
                        continue
                    a, b, c = i + n * x, j + n * y, k + n * z
                    last, after = distance[a - x, b - y, c - z], distance[a, b, c]
                    if after < 0 or weight[a, b, c] == 0 or weight[a - x, b - y, c - z] == 0:
                        continue
                    cosine = min(
                        _steepness(distance, i + x, j + y, k + z, axis), _steepness(distance, a - x, b - y, c - z, axis)
                    )
                    thickness = (n - 1 + last / (last - after) - before / (before - first)) * cosine
                    if cosine > 0.7 and thickness <= most:
                        found.append(thickness)
    return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _steepness(distance, i, j, k, axis):  # pragma: no cover
    """How much of the gradient at a voxel lies along an axis, 0 to 1."""
    nx, ny, nz = distance.shape
    x = distance[min(i + 1, nx - 1), j, k] - distance[max(i - 1, 0), j, k]
    y = distance[i, min(j + 1, ny - 1), k] - distance[i, max(j - 1, 0), k]
    z = distance[i, j, min(k + 1, nz - 1)] - distance[i, j, max(k - 1, 0)]
    along = x if axis == 0 else y if axis == 1 else z
    return abs(along) / max(np.sqrt(x * x + y * y + z * z), 1e-6)
