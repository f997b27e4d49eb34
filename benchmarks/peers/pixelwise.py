"""What one writes first in Numba: a scalar loop over the pixels of each tile, and over the tile's list for each.

Projection, its backward pass and the conventions are ours, so that what differs is the pixel loops.
"""

import math

import numpy as np
from numba import njit

from hingesplat.camera import Camera
from hingesplat.render._project import SUM_FEATURES, project, unproject
from hingesplat.render._tiles import (
    REC_A,
    REC_B,
    REC_C,
    REC_DEPTH,
    REC_FEATURES,
    REC_LOG_OPACITY,
    REC_X,
    REC_Y,
    TILE,
)
from hingesplat.render.numba_backend import _BUILD, _view
from hingesplat.render.torch_backend import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from hingesplat.simd import LANES

SIDE = 16
"""Of a tile, pixels."""
FEATURES = 4
"""Rgb and depth."""
_LN_2, _LOG2_ALPHA_MIN = math.log(2), math.log2(ALPHA_MIN)


@njit(cache=True, error_model="numpy", fastmath=True)
def _lists(order, boxes, columns, rows):
    """Gaussians of each tile, front to back: starts (tiles + 1,) and items."""
    starts = np.zeros(columns * rows + 1, np.int64)
    for g in order:
        x0, x1, y0, y1 = boxes[g]
        for row in range(y0 // SIDE, y1 // SIDE + 1):
            for column in range(x0 // SIDE, x1 // SIDE + 1):
                starts[row * columns + column + 1] += 1
    starts[:] = np.cumsum(starts)
    items, cursor = np.empty(starts[-1], np.int32), starts.copy()
    for g in order:
        x0, x1, y0, y1 = boxes[g]
        for row in range(y0 // SIDE, y1 // SIDE + 1):
            for column in range(x0 // SIDE, x1 // SIDE + 1):
                tile = row * columns + column
                items[cursor[tile]] = g
                cursor[tile] += 1
    return starts, items


@njit(cache=True, error_model="numpy", fastmath=True)
def _blend(record, starts, items, image):
    height, width = image.shape[1:]
    columns = (width + SIDE - 1) // SIDE
    for y in range(height):
        for x in range(width):
            tile = y // SIDE * columns + x // SIDE
            t = np.float32(1)
            for entry in range(starts[tile], starts[tile + 1]):
                r = record[items[entry]]
                dx, dy = np.float32(x + 0.5) - r[REC_X], np.float32(y + 0.5) - r[REC_Y]
                e = r[REC_LOG_OPACITY] + r[REC_A] * dx * dx + r[REC_B] * dx * dy + r[REC_C] * dy * dy
                if e <= _LOG2_ALPHA_MIN:
                    continue
                alpha = min(np.float32(math.exp(np.float32(_LN_2) * e)), np.float32(ALPHA_MAX))
                weight = alpha * t
                for k in range(FEATURES):
                    image[k, y, x] += weight * r[REC_FEATURES + k]
                t -= weight
                if t <= TRANSMITTANCE_MIN:
                    break
            image[FEATURES, y, x] = 1 - t


@njit(cache=True, error_model="numpy", fastmath=True)
def _unblend(record, starts, items, image, g_image, sums):
    height, width = image.shape[1:]
    columns = (width + SIDE - 1) // SIDE
    for y in range(height):
        for x in range(width):
            tile = y // SIDE * columns + x // SIDE
            t, rest = np.float32(1), np.float32(0)
            for k in range(FEATURES + 1):
                rest += g_image[k, y, x] * image[k, y, x]
            for entry in range(starts[tile], starts[tile + 1]):
                g = items[entry]
                r, s = record[g], sums[g]
                dx, dy = np.float32(x + 0.5) - r[REC_X], np.float32(y + 0.5) - r[REC_Y]
                e = r[REC_LOG_OPACITY] + r[REC_A] * dx * dx + r[REC_B] * dx * dy + r[REC_C] * dy * dy
                if e <= _LOG2_ALPHA_MIN:
                    continue
                raw = np.float32(math.exp(np.float32(_LN_2) * e))
                alpha = min(raw, np.float32(ALPHA_MAX))
                weight, dot = alpha * t, g_image[FEATURES, y, x]
                for k in range(FEATURES):
                    dot += g_image[k, y, x] * r[REC_FEATURES + k]
                    s[SUM_FEATURES + k] += weight * g_image[k, y, x]
                rest -= weight * dot
                if raw < ALPHA_MAX:
                    v = weight * dot - alpha * rest / (1 - alpha)
                    s[0] += v
                    s[1] += v * dx
                    s[2] += v * dx * dx
                    s[3] += v * dy
                    s[4] += v * dx * dy
                    s[5] += v * dy * dy
                t -= weight
                if t <= TRANSMITTANCE_MIN:
                    break


class Rasteriser:
    """See the package."""

    def __init__(self, n: int, camera: Camera) -> None:
        self.camera, self.view = camera, _view(camera)
        self.inputs: tuple[np.ndarray, ...] = ()

    def forward(self, *inputs: np.ndarray) -> np.ndarray:
        self.inputs, n = inputs, len(inputs[0])
        width, height = self.camera.width, self.camera.height
        columns, rows = -(-width // SIDE), -(-height // SIDE)
        self.record, boxes = np.empty((n, 16), np.float32), np.empty((n, 4), np.int32)
        segments, pivots = np.empty(n, np.int32), np.empty(0, np.float32)
        histogram = np.zeros((1, 1, -(-width // TILE) * -(-height // TILE)), np.int64)
        flat = [a.reshape(-1) for a in inputs]
        nothing = np.zeros(0, np.float32)
        targets = (self.record.reshape(-1), boxes.reshape(-1), segments, pivots, histogram)
        project(_BUILD, *flat, nothing, self.view, *targets, 0, 1)
        self.seen = segments > 0
        visible = np.flatnonzero(self.seen)
        order = visible[np.argsort(self.record[visible, REC_DEPTH], kind="stable")]
        self.starts, self.items = _lists(order, boxes, columns, rows)
        self.image = np.zeros((FEATURES + 1, height, width), np.float32)
        _blend(self.record, self.starts, self.items, self.image)
        return self.image.copy()

    def backward(self, g_image: np.ndarray) -> list[np.ndarray]:
        n = len(self.seen)
        stride = -(-(SUM_FEATURES + FEATURES) // LANES) * LANES
        sums = np.zeros((n, stride), np.float32)
        _unblend(self.record, self.starts, self.items, self.image, g_image, sums)
        offsets = np.concatenate([[0], np.cumsum(self.seen)])
        shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, 3), (n, 0), (n, 2)]
        gradients = [np.empty(shape, np.float32) for shape in shapes]
        flat = [a.reshape(-1) for a in self.inputs[:4]]
        targets = tuple(g.reshape(-1) for g in gradients)
        unproject(_BUILD, *flat, self.view, sums[self.seen].reshape(-1), stride, offsets, targets, 0, 1)
        return gradients[:5]
