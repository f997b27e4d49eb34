"""The pixel loops: blending of the tiles' work lists, forward and backward.

A thread holds one tile at a time in a small buffer of planes. A plane has LANES spare columns and one spare
row, so that a segment may start at any column and rows go two at a time; spare pixels have transmittance 0.
"""

import math

import numpy as np
from numba import njit

from hingesplat.render._tiles import REC_A, REC_B, REC_C, REC_FEATURES, REC_LOG_OPACITY, REC_X, REC_Y, TILE
from hingesplat.render.torch_backend import ALPHA_MAX, ALPHA_MIN
from hingesplat.simd import (
    INNER,
    KERNEL,
    LANES,
    paccumulate,
    pblend,
    pconcat,
    pdot,
    planes_of,
    psplat,
    pstore_sums,
    pzeros,
    sload,
    sstore,
    take_ticket,
    vand,
    vany,
    vexp2,
    vfma,
    vgt,
    viota,
    vload,
    vmax,
    vmin,
    vselect,
    vsplat,
    vstore,
)

PITCH = TILE + LANES
PLANE = (TILE + 1) * PITCH

_CHECK_EVERY = 32  # segments between looks whether a whole tile is opaque
_0, _1, _2, _HALF = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
_ALPHA_MAX, _LOG2_ALPHA_MIN = np.float32(ALPHA_MAX), np.float32(math.log2(ALPHA_MIN))


@njit(**INNER)
def _blend_tile(build, x0, y0, x1, y1, record, stride, items, shapes, start, stop, floor, buffer):
    """Blend the list entries start … stop - 1 into the buffer; returns the entry before which all was opaque.

    Planes: transmittance, then the features. Pixels outside x0 … x1, y0 … y1 do not exist.
    """
    zero = vsplat(_0)
    for q in range(0, (planes_of(build) + 1) * PLANE, LANES):
        vstore(buffer, q, zero)
    for r in range(y1 - y0 + 1):
        for c in range(x1 - x0 + 1):
            sstore(buffer, r * PITCH + c, _1)
    for entry in range(start, stop):
        if (entry - start) % _CHECK_EVERY == _CHECK_EVERY - 1:
            clearest = zero
            for q in range(0, TILE * PITCH, LANES):
                clearest = vmax(clearest, vload(buffer, q))
            if not vany(vgt(clearest, floor)):
                return entry
        o, shape = np.int64(sload(items, entry)) * stride, np.int64(sload(shapes, entry))
        a, b, c = sload(record, o + REC_A), sload(record, o + REC_B), sload(record, o + REC_C)
        features = psplat(build, record, o + REC_FEATURES)
        column, row, rows = shape & 255, (shape >> 8) & 255, shape >> 16
        dx = viota() + (np.float32(x0 + column) + _HALF - sload(record, o + REC_X))
        constant, linear = vfma(dx * a, dx, sload(record, o + REC_LOG_OPACITY)), dx * b
        dy = np.float32(y0 + row) + _HALF - sload(record, o + REC_Y)
        p = row * PITCH + column
        end = p + rows * PITCH
        while p < end:
            t0, t1 = vload(buffer, p), vload(buffer, p + PITCH)
            if vany(vgt(vmax(t0, t1), floor)):
                dy1 = dy + _1
                e0 = vfma(vfma(dy, c, linear), dy, constant)
                e1 = vfma(vfma(dy1, c, linear), dy1, constant)
                alpha0 = vselect(vand(vgt(e0, _LOG2_ALPHA_MIN), vgt(t0, floor)), vmin(vexp2(e0), _ALPHA_MAX), _0)
                alpha1 = vselect(vand(vgt(e1, _LOG2_ALPHA_MIN), vgt(t1, floor)), vmin(vexp2(e1), _ALPHA_MAX), _0)
                w0, w1 = alpha0 * t0, alpha1 * t1
                vstore(buffer, p, t0 - w0)
                vstore(buffer, p + PITCH, t1 - w1)
                pblend(features, w0, buffer, p + PLANE, PLANE)
                pblend(features, w1, buffer, p + PITCH + PLANE, PLANE)
            p += 2 * PITCH
            dy += _2
    return stop


@njit(**INNER)
def _write_tile(x0, y0, x1, y1, width, height, buffer, background, image):
    """Features over the background, and alpha, to the image planes (colours, alpha, other features)."""
    area, features = width * height, background.shape[0]
    for r in range(y1 - y0 + 1):
        b, p, c = r * PITCH, (y0 + r) * width + x0, 0
        while c + LANES <= x1 - x0 + 1:
            t = vload(buffer, b + c)
            for k in range(features):
                value = vfma(t, sload(background, k), vload(buffer, (k + 1) * PLANE + b + c))
                vstore(image, (k + (k >= 3)) * area + p + c, value)
            vstore(image, 3 * area + p + c, _1 - t)
            c += LANES
        while c < x1 - x0 + 1:
            t1 = sload(buffer, b + c)
            for k in range(features):
                sstore(
                    image,
                    (k + (k >= 3)) * area + p + c,
                    t1 * sload(background, k) + sload(buffer, (k + 1) * PLANE + b + c),
                )
            sstore(image, 3 * area + p + c, _1 - t1)
            c += 1


@njit(**KERNEL)
def blend(
    build,
    tickets,
    tiles,
    width,
    height,
    record,
    stride,
    items,
    shapes,
    starts,
    stops,
    floor,
    background,
    image,
    t,
    threads,
):
    """Draw all tiles, thread by thread as they come; stops[tile] is where the tile was found opaque."""
    buffer = np.empty((planes_of(build) + 1) * PLANE + LANES, np.float32)
    columns = (width + TILE - 1) // TILE
    while True:
        j = take_ticket(tickets)
        if j >= tiles.shape[0]:
            break
        tile = tiles[j]
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        x1, y1 = min(x0 + TILE, width) - 1, min(y0 + TILE, height) - 1
        stops[tile] = _blend_tile(
            build,
            x0,
            y0,
            x1,
            y1,
            record,
            stride,
            items,
            shapes,
            starts[tile],
            starts[tile + 1],
            floor,
            buffer,
        )
        _write_tile(x0, y0, x1, y1, width, height, buffer, background, image)


@njit(**INNER)
def _load_plane(plane, x0, y0, x1, y1, width, image, i, gradient, j, buffer):
    """The gradient of a plane (at gradient[j]) to the buffer; times the plane (at image[i]) to the rest."""
    for r in range(y1 - y0 + 1):
        p, b, c = (y0 + r) * width + x0, r * PITCH, 0
        while c + LANES <= x1 - x0 + 1:
            g, q = vload(gradient, j + p + c), PLANE + b + c
            vstore(buffer, q, vfma(g, vload(image, i + p + c), vload(buffer, q)))
            vstore(buffer, plane * PLANE + b + c, g)
            c += LANES
        while c < x1 - x0 + 1:
            g1, q = sload(gradient, j + p + c), PLANE + b + c
            sstore(buffer, q, sload(buffer, q) + g1 * sload(image, i + p + c))
            sstore(buffer, plane * PLANE + b + c, g1)
            c += 1


@njit(**INNER)
def _load_tile(build, x0, y0, x1, y1, width, height, image, g_image, buffer):
    """Planes: transmittance, rest, gradients of alpha and of the features.

    The *rest* is Σ gradient·image over all planes: what the Gaussians not yet passed, and the background,
    still add to the linearised loss.
    """
    g_rgba, g_channels, g_depth = g_image
    area, zero = width * height, vsplat(_0)
    count = g_channels.shape[0] // area
    for q in range(0, (planes_of(build) + 3) * PLANE, LANES):
        vstore(buffer, q, zero)
    for r in range(y1 - y0 + 1):
        for c in range(x1 - x0 + 1):
            sstore(buffer, r * PITCH + c, _1)
    for k in range(3):
        _load_plane(3 + k, x0, y0, x1, y1, width, image, k * area, g_rgba, k * area, buffer)
    for k in range(count):
        _load_plane(6 + k, x0, y0, x1, y1, width, image, (4 + k) * area, g_channels, k * area, buffer)
    _load_plane(6 + count, x0, y0, x1, y1, width, image, (4 + count) * area, g_depth, 0, buffer)
    _load_plane(2, x0, y0, x1, y1, width, image, 3 * area, g_rgba, 3 * area, buffer)


@njit(**INNER)
def _unblend_tile(build, x0, y0, record, stride, items, slots, shapes, start, stop, floor, buffer, partial, width):
    """Front to back once more: the gradient sums of every segment into its slot of ``partial``."""
    zero = vsplat(_0)
    for entry in range(start, stop):
        o, shape = np.int64(sload(items, entry)) * stride, np.int64(sload(shapes, entry))
        a, b, c = sload(record, o + REC_A), sload(record, o + REC_B), sload(record, o + REC_C)
        features, g_features = psplat(build, record, o + REC_FEATURES), pzeros(build)
        column, row, rows = shape & 255, (shape >> 8) & 255, shape >> 16
        dx = viota() + (np.float32(x0 + column) + _HALF - sload(record, o + REC_X))
        constant, linear = vfma(dx * a, dx, sload(record, o + REC_LOG_OPACITY)), dx * b
        dy = np.float32(y0 + row) + _HALF - sload(record, o + REC_Y)
        p = row * PITCH + column
        end = p + rows * PITCH
        # dx is the same down a lane, so sums over v, v·dy, v·dy² suffice until the end.
        s0, s1, s2 = zero, zero, zero
        while p < end:
            if vany(vgt(vmax(vload(buffer, p), vload(buffer, p + PITCH)), floor)):
                for _ in range(2):
                    t = vload(buffer, p)
                    e = vfma(vfma(dy, c, linear), dy, constant)
                    raw = vexp2(e)
                    live = vand(vgt(e, _LOG2_ALPHA_MIN), vgt(t, floor))
                    alpha = vselect(live, vmin(raw, _ALPHA_MAX), _0)
                    weight = alpha * t
                    own = weight * pdot(vload(buffer, p + 2 * PLANE), features, buffer, p + 3 * PLANE, PLANE)
                    rest = vload(buffer, p + PLANE) - own
                    vstore(buffer, p, t - weight)
                    vstore(buffer, p + PLANE, rest)
                    # d loss / d log(alpha); what lies behind is scaled by 1 - alpha.
                    v = vselect(vgt(_ALPHA_MAX, raw), own - alpha * rest / (_1 - alpha), _0)
                    g_features = paccumulate(g_features, weight, buffer, p + 3 * PLANE, PLANE)
                    s0, s1, s2 = s0 + v, s1 + v * dy, s2 + v * dy * dy
                    p += PITCH
                    dy += _1
            else:
                p += 2 * PITCH
                dy += _2
        s0x = s0 * dx
        sums = pconcat((s0, s0x, s0x * dx, s1, s1 * dx, s2), g_features)
        pstore_sums(sums, partial, np.int64(sload(slots, entry)) * width)


@njit(**KERNEL)
def unblend(
    build,
    tickets,
    tiles,
    width,
    height,
    record,
    stride,
    items,
    slots,
    shapes,
    starts,
    stops,
    floor,
    image,
    g_image,
    partial,
    partial_stride,
    t,
    threads,
):
    """The backward pass over the pixels: fills every slot of ``partial``."""
    buffer = np.empty((planes_of(build) + 3) * PLANE + LANES, np.float32)
    columns = (width + TILE - 1) // TILE
    zero = vsplat(_0)
    while True:
        j = take_ticket(tickets)
        if j >= tiles.shape[0]:
            break
        tile = tiles[j]
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        x1, y1 = min(x0 + TILE, width) - 1, min(y0 + TILE, height) - 1
        _load_tile(build, x0, y0, x1, y1, width, height, image, g_image, buffer)
        _unblend_tile(
            build,
            x0,
            y0,
            record,
            stride,
            items,
            slots,
            shapes,
            starts[tile],
            stops[tile],
            floor,
            buffer,
            partial,
            partial_stride,
        )
        for entry in range(stops[tile], starts[tile + 1]):
            p = np.int64(sload(slots, entry)) * partial_stride
            for q in range(p, p + partial_stride, LANES):
                vstore(partial, q, zero)
