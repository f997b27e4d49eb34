"""Projection of 3D Gaussians to the image and back: SIMD kernels, LANES Gaussians at a time.

All arrays are flat. ``view`` holds what ``View`` names; a *record* is what the pixel loops need to know of
one projected Gaussian: the fields named in ``_tiles``, then its colours, its channels, its depth, and zeros.
Blocks overlap at the end instead of being cut short, so at least LANES Gaussians are needed.
"""

import math
from enum import IntEnum

import numpy as np
from numba import njit

from hingesplat.render._tiles import (
    REC_A,
    REC_B,
    REC_C,
    REC_DEPTH,
    REC_EXTENT_X,
    REC_EXTENT_Y,
    REC_FEATURES,
    REC_LOG_OPACITY,
    REC_X,
    REC_Y,
    count_segments,
)
from hingesplat.render.torch_backend import ALPHA_MIN, BLUR
from hingesplat.simd import (
    INLINE,
    INNER,
    KERNEL,
    LANES,
    sload,
    sstore,
    vand,
    vceil,
    vexponent,
    vfloor,
    vfma,
    vgather,
    vgt,
    vload,
    vmantissa,
    vmax,
    vmin,
    vscatter,
    vselect,
    vsplat,
    vsqrt,
    vstore,
)


class View(IntEnum):
    """Offsets in the float32 array that describes a camera."""

    R = 0  # world to camera, row by row
    T = 9
    FX, FY, CX, CY = 12, 13, 14, 15
    NEAR = 16
    X_MIN, X_MAX, Y_MIN, Y_MAX = 17, 18, 19, 20  # clamp of x/z and y/z for the Jacobian
    WIDTH, HEIGHT = 21, 22
    SIZE = 23


# Fields of the sums that the backward pass over the pixels leaves: v = d loss / d log(alpha), summed over
# pixels as v, v·dx, v·dx², v·dy, v·dx·dy, v·dy²; then d loss / d feature.
SUM_1, SUM_X, SUM_XX, SUM_Y, SUM_XY, SUM_YY, SUM_FEATURES = 0, 1, 2, 3, 4, 5, 6

_R, _T, _FX, _FY, _CX, _CY = int(View.R), int(View.T), int(View.FX), int(View.FY), int(View.CX), int(View.CY)
_NEAR, _WIDTH, _HEIGHT = int(View.NEAR), int(View.WIDTH), int(View.HEIGHT)
_X_MIN, _X_MAX, _Y_MIN, _Y_MAX = int(View.X_MIN), int(View.X_MAX), int(View.Y_MIN), int(View.Y_MAX)

_0, _1, _2, _HALF = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
_BLUR, _ALPHA_MIN = np.float32(BLUR), np.float32(ALPHA_MIN)
_LOG2_E, _LN_2 = np.float32(math.log2(math.e)), np.float32(math.log(2))
_LOG2_ALPHA_MIN = np.float32(math.log2(ALPHA_MIN))
_TINY = np.float32(1e-6)  # keeps logarithms and divisions finite where the result is not used
_DET_MIN = np.float32(1e-12)
_SAMPLE = 64  # depths that tell where to cut

# log2(1 + m) ≈ m·(P0 + P1·m + …) on [0, 1), minimax fit, error below 2e-7.
_P0, _P1, _P2, _P3, _P4, _P5, _P6 = (
    np.float32(p)
    for p in (
        1.4426907807067442,
        -0.7210954782223373,
        0.47722417313055904,
        -0.3378349451317032,
        0.2136625904983307,
        -0.09487798136284191,
        0.020233915361827077,
    )
)


@njit(**INLINE)
def _log2(x):
    m = vmantissa(x) - _1
    p = vfma(vfma(vfma(vfma(vfma(vfma(m, _P6, _P5), m, _P4), m, _P3), m, _P2), m, _P1), m, _P0)
    return vfma(m, p, vexponent(x))


@njit(**INLINE)
def _rotation(w, x, y, z):
    """Unit quaternion to the nine entries of its matrix, row by row."""
    return (
        _1 - _2 * (y * y + z * z),
        _2 * (x * y - w * z),
        _2 * (x * z + w * y),
        _2 * (x * y + w * z),
        _1 - _2 * (x * x + z * z),
        _2 * (y * z - w * x),
        _2 * (x * z - w * y),
        _2 * (y * z + w * x),
        _1 - _2 * (x * x + y * y),
    )


@njit(**INLINE)
def _in_camera(i, means, view):
    """Camera-frame centres."""
    x, y, z = vgather(means, 3 * i, 3), vgather(means, 3 * i + 1, 3), vgather(means, 3 * i + 2, 3)
    return (
        vfma(x, view[_R], vfma(y, view[_R + 1], vfma(z, view[_R + 2], view[_T]))),
        vfma(x, view[_R + 3], vfma(y, view[_R + 4], vfma(z, view[_R + 5], view[_T + 1]))),
        vfma(x, view[_R + 6], vfma(y, view[_R + 7], vfma(z, view[_R + 8], view[_T + 2]))),
    )


@njit(**INLINE)
def _shape(i, quats, scales):
    """Unit quaternion, 1 / its former length, rotation matrix, standard deviations."""
    w, x, y, z = (
        vgather(quats, 4 * i, 4),
        vgather(quats, 4 * i + 1, 4),
        vgather(quats, 4 * i + 2, 4),
        vgather(quats, 4 * i + 3, 4),
    )
    shrink = _1 / vsqrt(vfma(w, w, vfma(x, x, vfma(y, y, z * z))))
    q = (w * shrink, x * shrink, y * shrink, z * shrink)
    s = (vgather(scales, 3 * i, 3), vgather(scales, 3 * i + 1, 3), vgather(scales, 3 * i + 2, 3))
    return q, shrink, _rotation(*q), s


@njit(**INLINE)
def _jacobian(u, v, view):
    """Rows of J·R times z / f, with u = x/z and v = y/z clamped: (h00, h01, h02, h10, h11, h12)."""
    u = vmin(vmax(u, view[_X_MIN]), view[_X_MAX])
    v = vmin(vmax(v, view[_Y_MIN]), view[_Y_MAX])
    return (
        view[_R] - u * view[_R + 6],
        view[_R + 1] - u * view[_R + 7],
        view[_R + 2] - u * view[_R + 8],
        view[_R + 3] - v * view[_R + 6],
        view[_R + 4] - v * view[_R + 7],
        view[_R + 5] - v * view[_R + 8],
    )


@njit(**INLINE)
def _half_covariance(G, R, s):
    """B = G R diag(s), 2×3, so that the covariance is B Bᵀ + blur; G is J times the camera's rotation."""
    g00, g01, g02, g10, g11, g12 = G
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = R
    s0, s1, s2 = s
    return (
        (g00 * r00 + g01 * r10 + g02 * r20) * s0,
        (g00 * r01 + g01 * r11 + g02 * r21) * s1,
        (g00 * r02 + g01 * r12 + g02 * r22) * s2,
        (g10 * r00 + g11 * r10 + g12 * r20) * s0,
        (g10 * r01 + g11 * r11 + g12 * r21) * s1,
        (g10 * r02 + g11 * r12 + g12 * r22) * s2,
    )


@njit(**INLINE)
def _covariance(B):
    """Entries 00, 01, 11 of B Bᵀ + blur, and its determinant.

    The determinant sums squared minors (Cauchy-Binet); c00·c11 - c01² would cancel to noise for thin
    Gaussians.
    """
    b00, b01, b02, b10, b11, b12 = B
    t00 = b00 * b00 + b01 * b01 + b02 * b02
    t11 = b10 * b10 + b11 * b11 + b12 * b12
    m01, m02, m12 = b00 * b11 - b01 * b10, b00 * b12 - b02 * b10, b01 * b12 - b02 * b11
    det = m01 * m01 + m02 * m02 + m12 * m12 + _BLUR * (t00 + t11 + _BLUR)
    return t00 + _BLUR, b00 * b10 + b01 * b11 + b02 * b12, t11 + _BLUR, det


@njit(**INNER)
def _project_block(i, means, quats, scales, opacities, view, record, stride, boxes):
    """Gaussians i … i + LANES - 1 to the geometric fields of their records and to pixel boxes (x0, x1, y0,
    y1)."""
    x, y, z = _in_camera(i, means, view)
    o = vload(opacities, i)
    visible = vand(vgt(z, view[_NEAR]), vgt(o, _ALPHA_MIN))
    inverse_z = _1 / vmax(z, _TINY)
    u, v = x * inverse_z, y * inverse_z
    mx, my = vfma(u, view[_FX], view[_CX]), vfma(v, view[_FY], view[_CY])
    _, _, R, s = _shape(i, quats, scales)
    h00, h01, h02, h10, h11, h12 = _jacobian(u, v, view)
    jx, jy = inverse_z * view[_FX], inverse_z * view[_FY]
    c00, c01, c11, det = _covariance(
        _half_covariance((jx * h00, jx * h01, jx * h02, jy * h10, jy * h11, jy * h12), R, s)
    )
    visible = vand(visible, vgt(det, _DET_MIN))
    inverse_det = _1 / det

    log_o = _log2(vmax(o, _TINY))
    spread = vmax(log_o - _LOG2_ALPHA_MIN, _0) * (_2 * _LN_2)
    ex, ey = vsqrt(spread * c00), vsqrt(spread * c11)
    x0, x1 = vmax(vceil(mx - ex - _HALF), _0), vmin(vfloor(mx + ex - _HALF), view[_WIDTH] - _1)
    y0, y1 = vmax(vceil(my - ey - _HALF), _0), vmin(vfloor(my + ey - _HALF), view[_HEIGHT] - _1)
    visible = vand(visible, vand(vgt(x1 + _HALF, x0), vgt(y1 + _HALF, y0)))
    vscatter(boxes, 4 * i, 4, vselect(visible, x0, _0))
    vscatter(boxes, 4 * i + 1, 4, vselect(visible, x1, -_1))
    vscatter(boxes, 4 * i + 2, 4, vselect(visible, y0, _0))
    vscatter(boxes, 4 * i + 3, 4, vselect(visible, y1, -_1))

    p = i * stride
    vscatter(record, p + REC_X, stride, mx)
    vscatter(record, p + REC_Y, stride, my)
    vscatter(record, p + REC_A, stride, c11 * inverse_det * (-_HALF * _LOG2_E))
    vscatter(record, p + REC_B, stride, c01 * inverse_det * _LOG2_E)
    vscatter(record, p + REC_C, stride, c00 * inverse_det * (-_HALF * _LOG2_E))
    vscatter(record, p + REC_LOG_OPACITY, stride, log_o)
    vscatter(record, p + REC_EXTENT_X, stride, ex)
    vscatter(record, p + REC_EXTENT_Y, stride, ey)
    vscatter(record, p + REC_DEPTH, stride, z)


@njit(**INNER)
def _copy_features(i, colors, channels, count, record, stride):
    """Colours, channels, depth and zeros into the record of Gaussian i."""
    p = i * stride + REC_FEATURES
    for c in range(3):
        sstore(record, p + c, sload(colors, 3 * i + c))
    for c in range(count):
        sstore(record, p + 3 + c, sload(channels, i * count + c))
    sstore(record, p + 3 + count, sload(record, i * stride + REC_DEPTH))
    for q in range(p + 4 + count, (i + 1) * stride):
        sstore(record, q, _0)


@njit(**INNER)
def _slice_depths(means, view, sample, pivots):
    """Depths that cut the Gaussians into slices of about as many each. Every thread finds the same."""
    n, seen = means.shape[0] // 3, 0
    for k in range(_SAMPLE):
        i = 3 * (k * n // _SAMPLE)
        depth = view[_T + 2]
        for axis in range(3):
            depth += view[_R + 6 + axis] * means[i + axis]
        if depth > view[_NEAR]:  # What is no number is not.
            j = seen
            while j > 0 and sample[j - 1] > depth:
                sample[j] = sample[j - 1]
                j -= 1
            sample[j] = depth
            seen += 1
    for k in range(pivots.shape[0]):
        pivots[k] = sample[(k + 1) * seen // (pivots.shape[0] + 1)] if seen > 0 else view[_NEAR]


@njit(**KERNEL)
def project(
    build,
    means,
    quats,
    scales,
    opacities,
    colors,
    channels,
    view,
    record,
    boxes,
    segments,
    pivots,
    histogram,
    t,
    threads,
):
    """Fill the records and boxes; count the segments of each Gaussian and, in histogram[t], of each tile.

    These are counted in slices of depth, for ``fill_lists``; ``pivots`` (threads - 1,) become their bounds.
    """
    n = opacities.shape[0]
    if threads > 1:
        _slice_depths(means, view, np.empty(_SAMPLE, np.float32), pivots)
    count, stride = channels.shape[0] // n, record.shape[0] // n
    blocks = (n + LANES - 1) // LANES
    first, last = t * blocks // threads * LANES, min((t + 1) * blocks // threads * LANES, n)
    for i in range(first, last, LANES):
        _project_block(min(i, n - LANES), means, quats, scales, opacities, view, record, stride, boxes)
    for i in range(first, last):
        _copy_features(i, colors, channels, count, record, stride)
    count_segments(first, last, boxes, record, stride, pivots, segments, histogram[t], int(view[_WIDTH]))


@njit(**INNER)
def _unproject_block(i, sums, stride, means, quats, scales, opacities, view, count, grads):
    """The chain rule from the sums over pixels (LANES records of ``stride``) to the inputs."""
    g_means, g_quats, g_scales, g_opacities, g_colors, g_channels, g_screen = grads
    x, y, z = _in_camera(i, means, view)
    inverse_z = _1 / vmax(z, _TINY)
    u, v = x * inverse_z, y * inverse_z
    (qw, qx, qy, qz), shrink, R, s = _shape(i, quats, scales)
    H = _jacobian(u, v, view)
    h00, h01, h02, h10, h11, h12 = H
    jx, jy = inverse_z * view[_FX], inverse_z * view[_FY]
    g00, g01, g02, g10, g11, g12 = jx * h00, jx * h01, jx * h02, jy * h10, jy * h11, jy * h12
    B = _half_covariance((g00, g01, g02, g10, g11, g12), R, s)
    b00, b01, b02, b10, b11, b12 = B
    c00, c01, c11, det = _covariance(B)
    inverse_det = _1 / det
    pa, pb, pc = c11 * inverse_det, _0 - c01 * inverse_det, c00 * inverse_det  # precision: pa, pb; pb, pc

    vstore(g_opacities, i, vgather(sums, SUM_1, stride) / vload(opacities, i))
    for lane in range(LANES):
        for c in range(3):
            sstore(g_colors, 3 * (i + lane) + c, sload(sums, lane * stride + SUM_FEATURES + c))
        for c in range(count):
            sstore(g_channels, (i + lane) * count + c, sload(sums, lane * stride + SUM_FEATURES + 3 + c))
    d_z = vgather(sums, SUM_FEATURES + 3 + count, stride)

    # log(alpha) = log(o) - ½ dᵀ P d with d = pixel - mean, so d/d mean = P d and d/d P = -½ d dᵀ.
    sx, sy = vgather(sums, SUM_X, stride), vgather(sums, SUM_Y, stride)
    d_mx, d_my = pa * sx + pb * sy, pb * sx + pc * sy
    vscatter(g_screen, 2 * i, 2, d_mx)
    vscatter(g_screen, 2 * i + 1, 2, d_my)
    sxx, sxy, syy = (
        vgather(sums, SUM_XX, stride),
        vgather(sums, SUM_XY, stride),
        vgather(sums, SUM_YY, stride),
    )
    # d/d covariance = ½ P (Σ v d dᵀ) P; then d/d B = 2 (d/d covariance) B = P S P B.
    t00, t01, t10, t11 = pa * sxx + pb * sxy, pa * sxy + pb * syy, pb * sxx + pc * sxy, pb * sxy + pc * syy
    e00, e01, e11 = t00 * pa + t01 * pb, t00 * pb + t01 * pc, t10 * pb + t11 * pc
    d_b00, d_b01, d_b02 = e00 * b00 + e01 * b10, e00 * b01 + e01 * b11, e00 * b02 + e01 * b12
    d_b10, d_b11, d_b12 = e01 * b00 + e11 * b10, e01 * b01 + e11 * b11, e01 * b02 + e11 * b12

    # B = G (R diag(s)): first to R diag(s) …
    s0, s1, s2 = s
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = R
    m00, m01, m02 = g00 * d_b00 + g10 * d_b10, g00 * d_b01 + g10 * d_b11, g00 * d_b02 + g10 * d_b12
    m10, m11, m12 = g01 * d_b00 + g11 * d_b10, g01 * d_b01 + g11 * d_b11, g01 * d_b02 + g11 * d_b12
    m20, m21, m22 = g02 * d_b00 + g12 * d_b10, g02 * d_b01 + g12 * d_b11, g02 * d_b02 + g12 * d_b12
    vscatter(g_scales, 3 * i, 3, m00 * r00 + m10 * r10 + m20 * r20)
    vscatter(g_scales, 3 * i + 1, 3, m01 * r01 + m11 * r11 + m21 * r21)
    vscatter(g_scales, 3 * i + 2, 3, m02 * r02 + m12 * r12 + m22 * r22)
    m00, m10, m20 = m00 * s0, m10 * s0, m20 * s0
    m01, m11, m21 = m01 * s1, m11 * s1, m21 * s1
    m02, m12, m22 = m02 * s2, m12 * s2, m22 * s2
    dw = _2 * (qx * (m21 - m12) + qy * (m02 - m20) + qz * (m10 - m01))
    dx = _2 * (qy * (m10 + m01) - _2 * qx * (m11 + m22) + qz * (m20 + m02) + qw * (m21 - m12))
    dy = _2 * (qx * (m10 + m01) - _2 * qy * (m00 + m22) + qz * (m21 + m12) + qw * (m02 - m20))
    dz = _2 * (qx * (m20 + m02) + qy * (m21 + m12) - _2 * qz * (m00 + m11) + qw * (m10 - m01))
    along = dw * qw + dx * qx + dy * qy + dz * qz  # the length of a quaternion does not matter
    vscatter(g_quats, 4 * i, 4, (dw - along * qw) * shrink)
    vscatter(g_quats, 4 * i + 1, 4, (dx - along * qx) * shrink)
    vscatter(g_quats, 4 * i + 2, 4, (dy - along * qy) * shrink)
    vscatter(g_quats, 4 * i + 3, 4, (dz - along * qz) * shrink)

    # … then to G = diag(jx, jy) H, and from there and the mean to the centre.
    k00, k01, k02 = (
        d_b00 * r00 * s0 + d_b01 * r01 * s1 + d_b02 * r02 * s2,
        d_b00 * r10 * s0 + d_b01 * r11 * s1 + d_b02 * r12 * s2,
        d_b00 * r20 * s0 + d_b01 * r21 * s1 + d_b02 * r22 * s2,
    )
    k10, k11, k12 = (
        d_b10 * r00 * s0 + d_b11 * r01 * s1 + d_b12 * r02 * s2,
        d_b10 * r10 * s0 + d_b11 * r11 * s1 + d_b12 * r12 * s2,
        d_b10 * r20 * s0 + d_b11 * r21 * s1 + d_b12 * r22 * s2,
    )
    d_jx, d_jy = k00 * h00 + k01 * h01 + k02 * h02, k10 * h10 + k11 * h11 + k12 * h12
    d_u = _0 - jx * (k00 * view[_R + 6] + k01 * view[_R + 7] + k02 * view[_R + 8])
    d_v = _0 - jy * (k10 * view[_R + 6] + k11 * view[_R + 7] + k12 * view[_R + 8])
    d_u = vselect(vand(vgt(u, view[_X_MIN]), vgt(view[_X_MAX], u)), d_u, _0) + d_mx * view[_FX]
    d_v = vselect(vand(vgt(v, view[_Y_MIN]), vgt(view[_Y_MAX], v)), d_v, _0) + d_my * view[_FY]
    d_x, d_y = d_u * inverse_z, d_v * inverse_z
    d_z = d_z - (d_u * u + d_v * v + d_jx * jx + d_jy * jy) * inverse_z
    for axis in range(3):
        d = view[_R + axis] * d_x + view[_R + 3 + axis] * d_y + view[_R + 6 + axis] * d_z
        vscatter(g_means, 3 * i + axis, 3, d)


@njit(**INNER)
def _clear(i, count, grads):
    """Zero gradients for Gaussian i."""
    g_means, g_quats, g_scales, g_opacities, g_colors, g_channels, g_screen = grads
    for c in range(3):
        sstore(g_means, 3 * i + c, _0)
        sstore(g_scales, 3 * i + c, _0)
        sstore(g_colors, 3 * i + c, _0)
    for c in range(4):
        sstore(g_quats, 4 * i + c, _0)
    for c in range(count):
        sstore(g_channels, count * i + c, _0)
    sstore(g_opacities, i, _0)
    sstore(g_screen, 2 * i, _0)
    sstore(g_screen, 2 * i + 1, _0)


@njit(**KERNEL)
def unproject(build, means, quats, scales, opacities, view, partial, stride, offsets, grads, t, threads):
    """Sum the partial sums of the segments of each Gaussian and carry them to the gradients of the inputs."""
    n = opacities.shape[0]
    count = grads[5].shape[0] // n
    sums = np.zeros(stride * LANES, np.float32)
    blocks = (n + LANES - 1) // LANES
    for start in range(t * blocks // threads * LANES, min((t + 1) * blocks // threads * LANES, n), LANES):
        i = min(start, n - LANES)
        if sload(offsets, i) < sload(offsets, i + LANES):
            for lane in range(LANES):
                for q in range(0, stride, LANES):
                    total = vsplat(_0)
                    for p in range(sload(offsets, i + lane), sload(offsets, i + lane + 1)):
                        total = total + vload(partial, p * stride + q)
                    vstore(sums, lane * stride + q, total)
            _unproject_block(i, sums, stride, means, quats, scales, opacities, view, count, grads)
        for g in range(i, i + LANES):
            if sload(offsets, g) == sload(offsets, g + 1):
                _clear(g, count, grads)


@njit(**KERNEL)
def record_screen_gradient(build, gradient, segments, record, stride, statistics):
    """``torch_backend.record_screen_gradient`` with the pixel-space ``gradient`` (n, 2) of everyone seen."""
    for i in range(len(gradient)):
        if segments[i] > 0:
            dx, dy = gradient[i, 0], gradient[i, 1]
            statistics[i, 0] += math.sqrt(dx * dx + dy * dy)
            statistics[i, 1] += _1
            radius = max(record[i * stride + REC_EXTENT_X], record[i * stride + REC_EXTENT_Y])
            statistics[i, 2] = max(statistics[i, 2], radius)
