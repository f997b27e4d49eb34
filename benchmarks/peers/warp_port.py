"""The standard tile-based algorithm in NVIDIA Warp, on its CPU device: a kernel a step, one thread a pixel.

Keys of (tile, depth), a radix sort, ranges, a loop front to back; then back to front with atomic sums. The projection's
backward pass is Warp's own differentiation.
"""

from typing import Any

import numpy as np

from hingesplat.camera import Camera
from hingesplat.render.torch_backend import ALPHA_MAX, ALPHA_MIN, BLUR, NEAR, TRANSMITTANCE_MIN, tangent_limits

try:
    import warp as wp

    wp.config.quiet = True
    wp.init()
except ImportError:
    wp: Any = None


def why_not() -> str | None:
    """Why it cannot run here; None where it can."""
    return "warp-lang is not installed" if wp is None else None


SIDE = 16
"""Of a tile, pixels."""

if wp is not None:
    A_MAX, A_MIN = wp.constant(ALPHA_MAX), wp.constant(ALPHA_MIN)
    T_MIN, EPS, Z_MIN = wp.constant(TRANSMITTANCE_MIN), wp.constant(BLUR), wp.constant(NEAR)
    S = wp.constant(SIDE)

    @wp.struct
    class View:
        R: wp.mat33
        t: wp.vec3
        focal: wp.vec2
        centre: wp.vec2
        limits: wp.vec4
        width: int
        height: int
        columns: int

    @wp.kernel
    def project(
        means: wp.array(dtype=wp.vec3),
        quats: wp.array(dtype=wp.vec4),
        scales: wp.array(dtype=wp.vec3),
        view: View,
        mean2: wp.array(dtype=wp.vec2),
        conic: wp.array(dtype=wp.vec3),
        depth: wp.array(dtype=float),
        spread: wp.array(dtype=wp.vec2),
    ):
        i = wp.tid()
        p = view.R * means[i] + view.t
        z = wp.max(p[2], 1.0e-6)
        q = wp.normalize(quats[i])
        Q = wp.quat_to_matrix(wp.quaternion(q[1], q[2], q[3], q[0]))
        half = view.R * Q * wp.diag(scales[i])
        u = wp.clamp(p[0] / z, view.limits[0], view.limits[1])
        v = wp.clamp(p[1] / z, view.limits[2], view.limits[3])
        a = (
            view.focal[0]
            / z
            * (wp.vec3(half[0, 0], half[0, 1], half[0, 2]) - u * wp.vec3(half[2, 0], half[2, 1], half[2, 2]))
        )
        b = (
            view.focal[1]
            / z
            * (wp.vec3(half[1, 0], half[1, 1], half[1, 2]) - v * wp.vec3(half[2, 0], half[2, 1], half[2, 2]))
        )
        c00 = wp.dot(a, a) + EPS
        c01 = wp.dot(a, b)
        c11 = wp.dot(b, b) + EPS
        det = c00 * c11 - c01 * c01
        mean2[i] = wp.vec2(view.focal[0] * p[0] / z + view.centre[0], view.focal[1] * p[1] / z + view.centre[1])
        conic[i] = wp.vec3(c11 / det, -c01 / det, c00 / det)
        depth[i] = p[2]
        spread[i] = wp.vec2(c00, c11)

    @wp.kernel
    def boxes_of(
        mean2: wp.array(dtype=wp.vec2),
        spread: wp.array(dtype=wp.vec2),
        depth: wp.array(dtype=float),
        opacities: wp.array(dtype=float),
        view: View,
        boxes: wp.array(dtype=wp.vec4i),
        counts: wp.array(dtype=int),
    ):
        i = wp.tid()
        counts[i] = 0
        if depth[i] <= Z_MIN or opacities[i] <= A_MIN:
            return
        reach = 2.0 * wp.log(opacities[i] / A_MIN)
        ex = wp.sqrt(reach * spread[i][0])
        ey = wp.sqrt(reach * spread[i][1])
        x0 = wp.max(int(wp.ceil(mean2[i][0] - ex - 0.5)), 0)
        x1 = wp.min(int(wp.floor(mean2[i][0] + ex - 0.5)), view.width - 1)
        y0 = wp.max(int(wp.ceil(mean2[i][1] - ey - 0.5)), 0)
        y1 = wp.min(int(wp.floor(mean2[i][1] + ey - 0.5)), view.height - 1)
        if x1 < x0 or y1 < y0:
            return
        boxes[i] = wp.vec4i(x0 / S, x1 / S, y0 / S, y1 / S)
        counts[i] = (x1 / S - x0 / S + 1) * (y1 / S - y0 / S + 1)

    @wp.kernel
    def make_keys(
        boxes: wp.array(dtype=wp.vec4i),
        counts: wp.array(dtype=int),
        ends: wp.array(dtype=int),
        depth: wp.array(dtype=float),
        view: View,
        keys: wp.array(dtype=wp.int64),
        items: wp.array(dtype=int),
    ):
        i = wp.tid()
        p = ends[i] - counts[i]
        if counts[i] > 0:
            bits = wp.int64(wp.cast(depth[i], wp.int32))
            for row in range(boxes[i][2], boxes[i][3] + 1):
                for column in range(boxes[i][0], boxes[i][1] + 1):
                    keys[p] = (wp.int64(row * view.columns + column) << wp.int64(32)) | bits
                    items[p] = i
                    p += 1

    @wp.kernel
    def ranges_of(keys: wp.array(dtype=wp.int64), total: int, starts: wp.array(dtype=int), stops: wp.array(dtype=int)):
        p = wp.tid()
        tile = int(keys[p] >> wp.int64(32))
        if p == 0 or int(keys[p - 1] >> wp.int64(32)) != tile:
            starts[tile] = p
        if p == total - 1 or int(keys[p + 1] >> wp.int64(32)) != tile:
            stops[tile] = p + 1

    @wp.kernel(enable_backward=False)
    def blend(
        mean2: wp.array(dtype=wp.vec2),
        conic: wp.array(dtype=wp.vec3),
        opacities: wp.array(dtype=float),
        colors: wp.array(dtype=wp.vec3),
        depth: wp.array(dtype=float),
        items: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        stops: wp.array(dtype=int),
        view: View,
        image: wp.array3d(dtype=float),
        last: wp.array2d(dtype=int),
    ):
        y, x = wp.tid()
        tile = y / S * view.columns + x / S
        centre = wp.vec2(float(x) + 0.5, float(y) + 0.5)
        t = float(1.0)  # noqa: UP018 (Warp's way to say that it varies)
        rgb = wp.vec3(0.0, 0.0, 0.0)
        z = float(0.0)  # noqa: UP018
        end = int(starts[tile])
        for p in range(starts[tile], stops[tile]):
            g = items[p]
            d = centre - mean2[g]
            k = conic[g]
            alpha = wp.min(
                A_MAX, opacities[g] * wp.exp(-0.5 * (k[0] * d[0] * d[0] + k[2] * d[1] * d[1]) - k[1] * d[0] * d[1])
            )
            if alpha >= A_MIN:
                w = alpha * t
                rgb += w * colors[g]
                z += w * depth[g]
                t -= w
                end = p + 1
                if t <= T_MIN:
                    break
        for c in range(3):
            image[c, y, x] = rgb[c]
        image[3, y, x] = z
        image[4, y, x] = 1.0 - t
        last[y, x] = end

    @wp.kernel(enable_backward=False)
    def unblend(
        mean2: wp.array(dtype=wp.vec2),
        conic: wp.array(dtype=wp.vec3),
        opacities: wp.array(dtype=float),
        colors: wp.array(dtype=wp.vec3),
        depth: wp.array(dtype=float),
        items: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        view: View,
        image: wp.array3d(dtype=float),
        last: wp.array2d(dtype=int),
        g_image: wp.array3d(dtype=float),
        g_mean2: wp.array(dtype=wp.vec2),
        g_conic: wp.array(dtype=wp.vec3),
        g_opacities: wp.array(dtype=float),
        g_colors: wp.array(dtype=wp.vec3),
        g_depth: wp.array(dtype=float),
    ):
        y, x = wp.tid()
        tile = y / S * view.columns + x / S
        centre = wp.vec2(float(x) + 0.5, float(y) + 0.5)
        g_rgb = wp.vec3(g_image[0, y, x], g_image[1, y, x], g_image[2, y, x])
        g_z = g_image[3, y, x]
        t = 1.0 - image[4, y, x]
        behind = float(-g_image[4, y, x])  # what a unit of light that passes brings: alpha less, and what lies behind
        p = last[y, x] - 1
        while p >= starts[tile]:
            g = items[p]
            d = centre - mean2[g]
            k = conic[g]
            raw = opacities[g] * wp.exp(-0.5 * (k[0] * d[0] * d[0] + k[2] * d[1] * d[1]) - k[1] * d[0] * d[1])
            alpha = wp.min(A_MAX, raw)
            if alpha >= A_MIN:
                t = t / (1.0 - alpha)
                w = alpha * t
                wp.atomic_add(g_colors, g, w * g_rgb)
                wp.atomic_add(g_depth, g, w * g_z)
                dot = wp.dot(colors[g], g_rgb) + depth[g] * g_z
                if raw < A_MAX:
                    v = w * (dot - behind)
                    wp.atomic_add(g_opacities, g, v / opacities[g])
                    wp.atomic_add(g_mean2, g, v * wp.vec2(k[0] * d[0] + k[1] * d[1], k[1] * d[0] + k[2] * d[1]))
                    wp.atomic_add(g_conic, g, -v * wp.vec3(0.5 * d[0] * d[0], d[0] * d[1], 0.5 * d[1] * d[1]))
                behind = alpha * dot + (1.0 - alpha) * behind
            p -= 1


class Rasteriser:
    """See the package."""

    def __init__(self, n: int, camera: Camera) -> None:
        T, view = camera.T_camera_world, View()
        view.R, view.t = wp.mat33(*T[:3, :3].ravel().tolist()), wp.vec3(*T[:3, 3].tolist())
        view.focal, view.centre = wp.vec2(camera.fx, camera.fy), wp.vec2(camera.cx, camera.cy)
        view.limits = wp.vec4(*tangent_limits(camera))
        view.width, view.height, view.columns = camera.width, camera.height, -(-camera.width // SIDE)
        self.view, self.n, self.size = view, n, (camera.height, camera.width)
        self.tiles = view.columns * -(-camera.height // SIDE)
        kinds = {"mean2": wp.vec2, "conic": wp.vec3, "depth": float, "spread": wp.vec2}
        with wp.ScopedDevice("cpu"):
            self.flat = {name: wp.zeros(n, dtype=kind, requires_grad=True) for name, kind in kinds.items()}
            self.boxes, self.counts, self.ends = (
                wp.zeros(n, dtype=wp.vec4i),
                wp.zeros(n, dtype=int),
                wp.zeros(n, dtype=int),
            )

    def forward(self, *inputs: np.ndarray) -> np.ndarray:
        kinds = (wp.vec3, wp.vec4, wp.vec3, float, wp.vec3)
        with wp.ScopedDevice("cpu"):
            self.inputs = [wp.from_numpy(a, dtype=k, requires_grad=True) for a, k in zip(inputs, kinds, strict=True)]
            *geometry, opacities, colors = self.inputs
            flat = self.flat
            with wp.Tape() as self.tape:
                wp.launch(project, self.n, [*geometry, self.view], [*flat.values()])
            box_inputs = [flat["mean2"], flat["spread"], flat["depth"], opacities, self.view]
            wp.launch(boxes_of, self.n, box_inputs, [self.boxes, self.counts])
            wp.utils.array_scan(self.counts, self.ends, True)
            total = int(self.ends.numpy()[-1])
            keys, self.items = wp.zeros(2 * total, dtype=wp.int64), wp.zeros(2 * total, dtype=int)
            key_inputs = [self.boxes, self.counts, self.ends, flat["depth"], self.view]
            wp.launch(make_keys, self.n, key_inputs, [keys, self.items])
            wp.utils.radix_sort_pairs(keys, self.items, total)
            self.starts, stops = wp.zeros(self.tiles, dtype=int), wp.zeros(self.tiles, dtype=int)
            wp.launch(ranges_of, total, [keys, total], [self.starts, stops])
            self.image, self.last = wp.zeros((5, *self.size), dtype=float), wp.zeros(self.size, dtype=int)
            picture = [flat["mean2"], flat["conic"], opacities, colors, flat["depth"], self.items, self.starts]
            wp.launch(blend, self.size, [*picture, stops, self.view], [self.image, self.last])
        return self.image.numpy().copy()

    def backward(self, g_image: np.ndarray) -> list[np.ndarray]:
        opacities, colors = self.inputs[3:]
        flat = self.flat
        with wp.ScopedDevice("cpu"):
            self.tape.zero()
            picture = [flat["mean2"], flat["conic"], opacities, colors, flat["depth"], self.items, self.starts]
            given = [self.view, self.image, self.last, wp.from_numpy(g_image, dtype=float)]
            targets = [flat["mean2"], flat["conic"], opacities, colors, flat["depth"]]
            wp.launch(unblend, self.size, [*picture, *given], [a.grad for a in targets])
            self.tape.backward()
        return [a.grad.numpy().copy() for a in self.inputs]
