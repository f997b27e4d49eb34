"""One pass over the Gaussians before a picture is drawn, and one after: kernels of ``place``.

A rigid part's pose is (3, 3) ``R``, its quaternion and (3,) ``t``; no parts at all means that nothing moves.
``view`` holds the camera's third row (4,): what it makes a point's depth of.
"""

from typing import Any

import numpy as np
from numba import njit

from hingesplat.gaussians import SH_C0

_0, _1, _2, _HALF, _C0 = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5), np.float32(SH_C0)
_OPTIONS: dict[str, Any] = dict(cache=True, nogil=True, error_model="numpy", fastmath=True)


@njit(inline="always")
def _product(a0, a1, a2, a3, b0, b1, b2, b3):
    """Hamilton product of quaternions wxyz."""
    return (
        a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3,
        a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2,
        a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1,
        a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0,
    )


@njit(**_OPTIONS)
def place_forward(
    means, quats, part, R, turns, t, moved, constant, offset, lobes, view, placed, turned, colors, squares, th, threads
):  # fmt: skip
    """Fill ``placed``, ``turned``, ``colors`` and ``squares`` for every so many-th block of Gaussians."""
    n = len(means)
    for i in range(th * n // threads, (th + 1) * n // threads):
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        q0, q1, q2, q3 = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
        if len(R):
            k = part[i]
            if not moved:
                x, y, z = (
                    R[k, 0, 0] * x + R[k, 0, 1] * y + R[k, 0, 2] * z + t[k, 0],
                    R[k, 1, 0] * x + R[k, 1, 1] * y + R[k, 1, 2] * z + t[k, 1],
                    R[k, 2, 0] * x + R[k, 2, 1] * y + R[k, 2, 2] * z + t[k, 2],
                )
            q0, q1, q2, q3 = _product(turns[k, 0], turns[k, 1], turns[k, 2], turns[k, 3], q0, q1, q2, q3)
        placed[i, 0], placed[i, 1], placed[i, 2] = x, y, z
        turned[i, 0], turned[i, 1], turned[i, 2], turned[i, 3] = q0, q1, q2, q3
        depth = view[0] * x + view[1] * y + view[2] * z + view[3]
        squares[i, 0] = depth * depth
        for c in range(3):
            colour = constant[i, c]
            if len(offset):
                colour += offset[i, c]
            colour = _HALF + _C0 * colour
            if len(lobes):
                colour += lobes[i, c]
            colors[i, c] = max(colour, _0)


@njit(**_OPTIONS)
def place_backward(
    g_placed, g_turned, g_colors, g_squares,
    means, part, R, turns, moved, view, placed, turned, colors,
    g_means, g_quats, g_constant, g_lobes, sums, th, threads,
):  # fmt: skip
    """The chain rule back through ``place_forward``; gradients that are not there have no rows.

    ``sums`` (threads, parts, 15) gets d loss / d R as if R were free (9), d loss / d t (3), and the torque on
    the orientations: d loss / d (a small turn of them about the world's axes) (3).
    """
    n = len(means)
    for i in range(th * n // threads, (th + 1) * n // threads):
        gx, gy, gz = _0, _0, _0
        if len(g_placed):
            gx, gy, gz = g_placed[i, 0], g_placed[i, 1], g_placed[i, 2]
        if len(g_squares):
            x, y, z = placed[i, 0], placed[i, 1], placed[i, 2]
            g = _2 * g_squares[i, 0] * (view[0] * x + view[1] * y + view[2] * z + view[3])
            gx, gy, gz = gx + g * view[0], gy + g * view[1], gz + g * view[2]
        h0, h1, h2, h3 = _0, _0, _0, _0
        if len(g_turned):
            h0, h1, h2, h3 = g_turned[i, 0], g_turned[i, 1], g_turned[i, 2], g_turned[i, 3]
        if len(R):
            k = part[i]
            _, tx, ty, tz = _product(h0, h1, h2, h3, turned[i, 0], -turned[i, 1], -turned[i, 2], -turned[i, 3])
            sums[th, k, 12] += _HALF * tx
            sums[th, k, 13] += _HALF * ty
            sums[th, k, 14] += _HALF * tz
            h0, h1, h2, h3 = _product(turns[k, 0], -turns[k, 1], -turns[k, 2], -turns[k, 3], h0, h1, h2, h3)
            if not moved:
                for a in range(3):
                    m = means[i, a]
                    sums[th, k, a] += gx * m
                    sums[th, k, 3 + a] += gy * m
                    sums[th, k, 6 + a] += gz * m
                sums[th, k, 9] += gx
                sums[th, k, 10] += gy
                sums[th, k, 11] += gz
                gx, gy, gz = (
                    R[k, 0, 0] * gx + R[k, 1, 0] * gy + R[k, 2, 0] * gz,
                    R[k, 0, 1] * gx + R[k, 1, 1] * gy + R[k, 2, 1] * gz,
                    R[k, 0, 2] * gx + R[k, 1, 2] * gy + R[k, 2, 2] * gz,
                )
        g_means[i, 0], g_means[i, 1], g_means[i, 2] = gx, gy, gz
        g_quats[i, 0], g_quats[i, 1], g_quats[i, 2], g_quats[i, 3] = h0, h1, h2, h3
        for c in range(3):
            g = _0
            if len(g_colors) and colors[i, c] > _0:
                g = g_colors[i, c]
            g_constant[i, c] = _C0 * g
            if len(g_lobes):
                g_lobes[i, c] = g
