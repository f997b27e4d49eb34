"""The standard tile-based algorithm in Taichi on the CPU: a kernel a step, the outermost loop over pixels.

Keys of (tile, depth), sorted by NumPy; a loop front to back, then back to front with atomic sums. The projection's
backward pass is Taichi's own differentiation.
"""

import os
from typing import Any

import numpy as np

from hingesplat.camera import Camera
from hingesplat.render.torch_backend import ALPHA_MAX, ALPHA_MIN, BLUR, NEAR, TRANSMITTANCE_MIN, tangent_limits

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_LOG_LEVEL", "error")
try:
    import taichi as ti
    import taichi.math as tm
except ImportError:
    ti: Any = None


def why_not() -> str | None:
    """Why it cannot run here; None where it can."""
    return "taichi is not installed" if ti is None else None


SIDE = 16
"""Of a tile, pixels."""

if ti is not None:
    ti.init(arch=ti.cpu, cpu_max_num_threads=1, offline_cache=True)
    Floats, Ints = ti.types.ndarray(dtype=ti.f32), ti.types.ndarray(dtype=ti.i32)

    @ti.func
    def rotation(q):
        w, x, y, z = q[0], q[1], q[2], q[3]
        return ti.Matrix(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

    @ti.kernel
    def project(
        means: Floats,
        quats: Floats,
        scales: Floats,
        R: ti.types.matrix(3, 3, ti.f32),
        t: ti.types.vector(3, ti.f32),
        focal: ti.types.vector(2, ti.f32),
        centre: ti.types.vector(2, ti.f32),
        limits: ti.types.vector(4, ti.f32),
        flat: Floats,
    ):
        """flat[i]: mean x, y; conic a, b, c; depth; variances x, y."""
        for i in range(means.shape[0]):
            p = R @ ti.Vector([means[i, 0], means[i, 1], means[i, 2]]) + t
            z = ti.max(p[2], 1e-6)
            q = ti.Vector([quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]])
            half = R @ rotation(q / ti.sqrt(q.dot(q)))
            u = ti.min(ti.max(p[0] / z, limits[0]), limits[1])
            v = ti.min(ti.max(p[1] / z, limits[2]), limits[3])
            c00, c01, c11 = BLUR, 0.0, BLUR
            for k in ti.static(range(3)):
                a = focal[0] / z * (half[0, k] - u * half[2, k]) * scales[i, k]
                b = focal[1] / z * (half[1, k] - v * half[2, k]) * scales[i, k]
                c00 += a * a
                c01 += a * b
                c11 += b * b
            det = c00 * c11 - c01 * c01
            flat[i, 0], flat[i, 1] = focal[0] * p[0] / z + centre[0], focal[1] * p[1] / z + centre[1]
            flat[i, 2], flat[i, 3], flat[i, 4] = c11 / det, -c01 / det, c00 / det
            flat[i, 5], flat[i, 6], flat[i, 7] = p[2], c00, c11

    @ti.kernel
    def boxes_of(flat: Floats, opacities: Floats, width: int, height: int, boxes: Ints, counts: Ints):
        for i in range(opacities.shape[0]):
            counts[i] = 0
            if flat[i, 5] > NEAR and opacities[i] > ALPHA_MIN:
                reach = 2 * ti.log(opacities[i] / ALPHA_MIN)
                ex, ey = ti.sqrt(reach * flat[i, 6]), ti.sqrt(reach * flat[i, 7])
                x0 = ti.max(ti.ceil(flat[i, 0] - ex - 0.5, int), 0)
                x1 = ti.min(ti.floor(flat[i, 0] + ex - 0.5, int), width - 1)
                y0 = ti.max(ti.ceil(flat[i, 1] - ey - 0.5, int), 0)
                y1 = ti.min(ti.floor(flat[i, 1] + ey - 0.5, int), height - 1)
                if x1 >= x0 and y1 >= y0:
                    boxes[i, 0], boxes[i, 1] = x0 // SIDE, x1 // SIDE
                    boxes[i, 2], boxes[i, 3] = y0 // SIDE, y1 // SIDE
                    counts[i] = (x1 // SIDE - x0 // SIDE + 1) * (y1 // SIDE - y0 // SIDE + 1)

    @ti.kernel
    def make_keys(
        flat: Floats,
        boxes: Ints,
        counts: Ints,
        ends: Ints,
        columns: int,
        keys: ti.types.ndarray(dtype=ti.i64),
        items: Ints,
        tiles: Ints,
    ):
        for i in range(counts.shape[0]):
            if counts[i] > 0:
                p = ends[i] - counts[i]
                bits = ti.cast(ti.bit_cast(flat[i, 5], ti.i32), ti.i64)
                for row in range(boxes[i, 2], boxes[i, 3] + 1):
                    for column in range(boxes[i, 0], boxes[i, 1] + 1):
                        tile = row * columns + column
                        keys[p] = (ti.cast(tile, ti.i64) << 32) | bits
                        items[p] = i
                        p += 1
                        ti.atomic_add(tiles[tile + 1], 1)

    @ti.kernel
    def blend(
        flat: Floats,
        opacities: Floats,
        colors: Floats,
        items: Ints,
        starts: Ints,
        columns: int,
        image: Floats,
        last: Ints,
    ):
        for y, x in ti.ndrange(image.shape[1], image.shape[2]):
            tile = y // SIDE * columns + x // SIDE
            t, z = 1.0, 0.0
            rgb = tm.vec3(0.0)
            end = starts[tile]
            for p in range(starts[tile], starts[tile + 1]):
                g = items[p]
                dx, dy = x + 0.5 - flat[g, 0], y + 0.5 - flat[g, 1]
                e = 0.5 * (flat[g, 2] * dx * dx + flat[g, 4] * dy * dy) + flat[g, 3] * dx * dy
                alpha = ti.min(ALPHA_MAX, opacities[g] * ti.exp(-e))
                if alpha >= ALPHA_MIN:
                    w = alpha * t
                    rgb += w * tm.vec3(colors[g, 0], colors[g, 1], colors[g, 2])
                    z += w * flat[g, 5]
                    t -= w
                    end = p + 1
                    if t <= TRANSMITTANCE_MIN:
                        break
            for c in ti.static(range(3)):
                image[c, y, x] = rgb[c]
            image[3, y, x] = z
            image[4, y, x] = 1 - t
            last[y, x] = end

    @ti.kernel
    def unblend(
        flat: Floats,
        opacities: Floats,
        colors: Floats,
        items: Ints,
        starts: Ints,
        columns: int,
        image: Floats,
        last: Ints,
        g_image: Floats,
        g_flat: Floats,
        g_opacities: Floats,
        g_colors: Floats,
    ):
        for y, x in ti.ndrange(image.shape[1], image.shape[2]):
            tile = y // SIDE * columns + x // SIDE
            g_rgb = tm.vec3(g_image[0, y, x], g_image[1, y, x], g_image[2, y, x])
            g_z, g_alpha = g_image[3, y, x], g_image[4, y, x]
            t, behind = 1 - image[4, y, x], 0.0
            for back in range(last[y, x] - starts[tile]):
                g = items[last[y, x] - 1 - back]
                dx, dy = x + 0.5 - flat[g, 0], y + 0.5 - flat[g, 1]
                e = 0.5 * (flat[g, 2] * dx * dx + flat[g, 4] * dy * dy) + flat[g, 3] * dx * dy
                raw = opacities[g] * ti.exp(-e)
                alpha = ti.min(ALPHA_MAX, raw)
                if alpha >= ALPHA_MIN:
                    t /= 1 - alpha
                    w = alpha * t
                    dot = g_alpha + flat[g, 5] * g_z
                    for c in ti.static(range(3)):
                        g_colors[g, c] += w * g_rgb[c]
                        dot += colors[g, c] * g_rgb[c]
                    g_flat[g, 5] += w * g_z
                    if raw < ALPHA_MAX:
                        v = w * (dot - behind)
                        g_opacities[g] += v / opacities[g]
                        g_flat[g, 0] += v * (flat[g, 2] * dx + flat[g, 3] * dy)
                        g_flat[g, 1] += v * (flat[g, 3] * dx + flat[g, 4] * dy)
                        g_flat[g, 2] -= 0.5 * v * dx * dx
                        g_flat[g, 3] -= v * dx * dy
                        g_flat[g, 4] -= 0.5 * v * dy * dy
                    behind = alpha * dot + (1 - alpha) * behind


class Rasteriser:
    """See the package."""

    def __init__(self, n: int, camera: Camera) -> None:
        T = camera.T_camera_world
        self.size, self.n = (camera.height, camera.width), n
        self.columns, rows = -(-camera.width // SIDE), -(-camera.height // SIDE)
        self.tiles = self.columns * rows
        focal, centre, limits = (camera.fx, camera.fy), (camera.cx, camera.cy), tangent_limits(camera)
        self.view = [ti.Matrix(T[:3, :3].tolist()), *(ti.Vector(list(v)) for v in (T[:3, 3], focal, centre, limits))]
        shapes = ((n, 3), (n, 4), (n, 3), (n, 8))
        self.geometry = [ti.ndarray(ti.f32, shape, needs_grad=True) for shape in shapes]

    def forward(self, *inputs: np.ndarray) -> np.ndarray:
        *geometry, self.opacities, self.colors = inputs
        for target, source in zip(self.geometry, geometry, strict=False):
            target.from_numpy(source)
        project(*self.geometry[:3], *self.view, self.geometry[3])
        self.flat = self.geometry[3].to_numpy()
        boxes, counts = np.empty((self.n, 4), np.int32), np.empty(self.n, np.int32)
        boxes_of(self.flat, self.opacities, self.size[1], self.size[0], boxes, counts)
        ends = np.cumsum(counts, dtype=np.int32)
        keys, items = np.empty(ends[-1], np.int64), np.empty(ends[-1], np.int32)
        tiles = np.zeros(self.tiles + 1, np.int32)
        make_keys(self.flat, boxes, counts, ends, self.columns, keys, items, tiles)
        self.items, self.starts = items[np.argsort(keys)], np.cumsum(tiles, dtype=np.int32)
        self.image, self.last = np.empty((5, *self.size), np.float32), np.empty(self.size, np.int32)
        lists = (self.items, self.starts, self.columns, self.image, self.last)
        blend(self.flat, self.opacities, self.colors, *lists)
        return self.image.copy()

    def backward(self, g_image: np.ndarray) -> list[np.ndarray]:
        g_flat, g_opacities = np.zeros_like(self.flat), np.zeros_like(self.opacities)
        g_colors = np.zeros_like(self.colors)
        lists = (self.items, self.starts, self.columns, self.image, self.last)
        unblend(self.flat, self.opacities, self.colors, *lists, g_image, g_flat, g_opacities, g_colors)
        for array in self.geometry[:3]:
            array.grad.fill(0)
        self.geometry[3].grad.from_numpy(g_flat)
        project.grad(*self.geometry[:3], *self.view, self.geometry[3])
        return [*(array.grad.to_numpy() for array in self.geometry[:3]), g_opacities, g_colors]
