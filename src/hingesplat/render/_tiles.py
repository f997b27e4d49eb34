"""Which Gaussian touches which part of the image: depth order and the work lists of the tiles.

The image is cut into tiles. Within a tile the columns that a Gaussian covers are cut into *segments* of at
most LANES columns, starting at the Gaussian's left edge; a segment with its rows is one unit of work for the
pixel loops. Each segment owns a slot for its gradient sums; the slots of one Gaussian lie side by side, so
no atomics are needed.
"""

import math

import numpy as np
from numba import njit

from hingesplat.render.torch_backend import ALPHA_MIN
from hingesplat.simd import INLINE, INNER, KERNEL, LANES, float_bits, sload, sstore

# Fields of a record. log2(alpha) = LOG_OPACITY + A·dx² + B·dx·dy + C·dy², with d = pixel centre - (X, Y);
# EXTENT are the half sides of the box outside which alpha is below its threshold.
REC_X, REC_Y, REC_A, REC_B, REC_C, REC_LOG_OPACITY = 0, 1, 2, 3, 4, 5
REC_EXTENT_X, REC_EXTENT_Y, REC_DEPTH, REC_FEATURES = 6, 7, 8, 9

TILE = 32
"""Side of a tile, pixels; with four planes a tile's buffers fit the first-level cache."""

_HALF, _0, _1 = np.float32(0.5), np.float32(0), np.float32(1)
_LOG2_ALPHA_MIN = np.float32(math.log2(ALPHA_MIN))
_TINY = np.float32(1e-6)

_TILE_BITS = TILE.bit_length() - 1
_DIGIT = 11  # bits that one pass of the radix sort looks at


@njit(**INLINE)
def tile_of(x):
    """Row or column of tiles that pixel x ≥ 0 lies in; // would provide for negative numbers."""
    return np.int64(x) >> _TILE_BITS


@njit(**INLINE)
def _segments_in_column(x0, x1, column):
    """Number of segments of the columns x0 … x1 within a column of tiles."""
    return (min(x1, column * TILE + TILE - 1) - max(x0, column * TILE)) // LANES + 1


@njit(**INNER)
def slice_of(depth, pivots):
    """Which slice of depths this one lies in: each begins at a pivot."""
    k = 0
    while k < pivots.shape[0] and sload(pivots, k) <= depth:
        k += 1
    return k


@njit(**INNER)
def count_segments(first, last, boxes, record, stride, pivots, segments, histogram, width):
    """segments[i] for first ≤ i < last; adds them to the histogram (slices of depth, tiles)."""
    columns = (width + TILE - 1) // TILE
    for i in range(first, last):
        x0, x1 = sload(boxes, 4 * i), sload(boxes, 4 * i + 1)
        total = 0
        if x1 >= x0:
            base = slice_of(sload(record, i * stride + REC_DEPTH), pivots) * histogram.shape[1]
            row0, row1 = tile_of(sload(boxes, 4 * i + 2)), tile_of(sload(boxes, 4 * i + 3))
            for column in range(tile_of(x0), tile_of(x1) + 1):
                count = _segments_in_column(x0, x1, column)
                total += count
                for row in range(row0, row1 + 1):  # a range in steps would divide
                    tile = base + row * columns + column
                    sstore(histogram, tile, sload(histogram, tile) + count)
            total *= row1 - row0 + 1
        sstore(segments, i, total)


@njit(**KERNEL)
def sort_and_offset(build, segments, record, stride, histogram, order, offsets, starts):
    """Sort the visible Gaussians by depth (stable, exact) into ``order``; lay out slots and tile lists.

    ``offsets`` (n + 1,) are the first slots of the Gaussians, ``starts`` (tiles + 1,) the first list entries
    of the tiles, and ``histogram[0]`` becomes those of their slices. Returns the numbers of visible Gaussians and of
    segments.
    """
    n, visible, total = segments.shape[0], 0, 0
    low, high = np.int64(2**31), np.int64(0)
    source, target = np.empty(n, np.int64), np.empty(n, np.int64)  # depth and index in one: one memory access a pass
    for i in range(n):
        offsets[i] = total
        if segments[i] > 0:
            total += segments[i]
            key = np.int64(float_bits(sload(record, i * stride + REC_DEPTH)))
            low, high = min(low, key), max(high, key)
            source[visible] = (key << 32) | i
            visible += 1
    offsets[n] = total

    counts = np.empty(1 << _DIGIT, np.int64)
    shift = 0
    while visible > 0 and (high - low) >> shift > 0:
        counts[:] = 0
        for j in range(visible):
            counts[(((source[j] >> 32) - low) >> shift) & ((1 << _DIGIT) - 1)] += 1
        position = 0
        for digit in range(1 << _DIGIT):
            position, counts[digit] = position + counts[digit], position
        for j in range(visible):
            digit = (((source[j] >> 32) - low) >> shift) & ((1 << _DIGIT) - 1)
            target[counts[digit]] = source[j]
            counts[digit] += 1
        source, target = target, source
        shift += _DIGIT
    for j in range(visible):
        order[j] = source[j] & 0x7FFFFFFF

    position = 0
    for tile in range(starts.shape[0] - 1):
        starts[tile] = position
        for k in range(histogram.shape[1]):
            count = 0
            for t in range(histogram.shape[0]):
                count += histogram[t, k, tile]
            histogram[0, k, tile] = position
            position += count
    starts[starts.shape[0] - 1] = position
    return visible, total


@njit(**INNER)
def _slab(a, b, c, spread, reach_x, reach_y, xa, xb):
    """Lowest and highest dy at which the ellipse a·dx² + b·dx·dy + c·dy² = -spread meets xa ≤ dx ≤ xb.

    ``reach`` are the half sides of its box. The bounds are those of the ellipse's extreme points where these
    lie in the interval, else of the nearer end of the interval.
    """
    a, b, c = -a, -_HALF * b, -c
    topmost = -b * reach_y / a  # dx of the topmost point
    s = min(max(topmost, xa), xb)
    top = (-b * s + math.sqrt(max(c * spread * (_1 - (s / reach_x) ** 2), _0))) / c
    s = min(max(-topmost, xa), xb)
    bottom = (-b * s - math.sqrt(max(c * spread * (_1 - (s / reach_x) ** 2), _0))) / c
    return bottom, top


@njit(**INLINE)
def pack(x, y, rows):
    """First column, first row and number of rows of a segment within its tile."""
    return x | (y << 8) | (rows << 16)


@njit(**INNER)
def _list_segments(g, box, columns, record, stride, slot0, cursor, items, slots, shapes):
    """Append the segments of Gaussian g to the lists of their tiles."""
    x0, x1, y0, y1 = box
    o = g * stride
    mx, my = sload(record, o + REC_X), sload(record, o + REC_Y)
    a, b, c = sload(record, o + REC_A), sload(record, o + REC_B), sload(record, o + REC_C)
    spread = sload(record, o + REC_LOG_OPACITY) - _LOG2_ALPHA_MIN
    reach_x, reach_y = max(sload(record, o + REC_EXTENT_X), _TINY), sload(record, o + REC_EXTENT_Y)
    first_row, last_row = tile_of(y0), tile_of(y1)
    per_row = 0
    for column in range(tile_of(x0), tile_of(x1) + 1):
        per_row += _segments_in_column(x0, x1, column)
    done = 0  # segments of a tile row to the left of this one
    for column in range(tile_of(x0), tile_of(x1) + 1):
        end = min(x1, column * TILE + TILE - 1)
        for x in range(max(x0, column * TILE), end + 1, LANES):
            left, right = np.float32(x) + _HALF - mx, np.float32(min(x + LANES - 1, end)) + _HALF - mx
            bottom, top = _slab(a, b, c, spread, reach_x, reach_y, left, right)
            low = max(y0, math.ceil(my + bottom - _HALF))
            high = min(y1, math.floor(my + top - _HALF))
            for row in range(first_row, last_row + 1):
                start = max(low, row * TILE)
                rows = max(min(high, row * TILE + TILE - 1) - start + 1, 0)
                if rows == 0:
                    start = row * TILE
                tile = row * columns + column
                p = cursor[tile]
                cursor[tile] = p + 1
                sstore(items, p, g)
                sstore(slots, p, slot0 + (row - first_row) * per_row + done)
                sstore(shapes, p, pack(x - column * TILE, start - row * TILE, rows))
            done += 1


@njit(**INNER)
def _before(depth, order, visible, record, stride):
    """How many of the sorted Gaussians lie before this depth."""
    low, high = 0, visible
    while low < high:
        middle = (low + high) >> 1
        if sload(record, np.int64(sload(order, middle)) * stride + REC_DEPTH) < depth:
            low = middle + 1
        else:
            high = middle
    return low


@njit(**KERNEL)
def fill_lists(
    build, visible, order, boxes, record, stride, offsets, pivots, cursors, columns, items, slots, shapes, t, threads,
):  # fmt: skip
    """Write the lists of the tiles, front to back; thread t takes a slice of depths, from ``cursors[t]`` (tiles,)."""
    cursor = cursors[t]
    first = _before(pivots[t - 1], order, visible, record, stride) if t > 0 else 0
    last = _before(pivots[t], order, visible, record, stride) if t < threads - 1 else visible
    for j in range(first, last):
        g = np.int64(sload(order, j))
        x0, x1 = np.int64(sload(boxes, 4 * g)), np.int64(sload(boxes, 4 * g + 1))
        y0, y1 = np.int64(sload(boxes, 4 * g + 2)), np.int64(sload(boxes, 4 * g + 3))
        slot0 = np.int64(sload(offsets, g))
        if tile_of(x0) == tile_of(x1) and tile_of(y0) == tile_of(y1) and x1 - x0 < LANES:  # the common case
            tile = tile_of(y0) * columns + tile_of(x0)
            p = cursor[tile]
            cursor[tile] = p + 1
            sstore(items, p, g)
            sstore(slots, p, slot0)
            sstore(shapes, p, pack(x0 % TILE, y0 % TILE, y1 - y0 + 1))
        else:
            _list_segments(g, (x0, x1, y0, y1), columns, record, stride, slot0, cursor, items, slots, shapes)
