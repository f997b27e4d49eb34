"""Procedural textures: smooth enough to photograph, and never the same twice on one object.

Every texture is a function of a point in the part's own frame (so that it moves with the part) and of the
number of the face, which shifts and tints it, so that no two faces look alike.
"""

import numpy as np
from numba import njit

from hingesplat.synth.shapes import Texture

Colour = tuple[float, float, float]


def _hash(i: np.ndarray, j: np.ndarray, k: np.ndarray, seed: int) -> np.ndarray:
    """Integers to pseudo-random float32 in [0, 1)."""
    with np.errstate(over="ignore"):
        h = i.astype(np.uint32) * np.uint32(0x8DA6B343)
        h ^= j.astype(np.uint32) * np.uint32(0xD8163841)
        h ^= k.astype(np.uint32) * np.uint32(0xCB1AB31F)
        h ^= np.uint32((seed * 0x9E3779B1) & 0xFFFFFFFF)
        h = (h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
        h = (h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39)
        h ^= h >> np.uint32(15)
    return (h >> np.uint32(8)).astype(np.float32) * np.float32(2**-24)


def noise(x: np.ndarray, seed: int) -> np.ndarray:
    """Value noise in [0, 1] with cells of size 1: trilinear between hashed lattice values, (n, 3) to (n,)."""
    out = np.empty(len(x), np.float32)
    _noise(np.ascontiguousarray(x, np.float64), np.uint32((seed * 0x9E3779B1) & 0xFFFFFFFF), out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _noise(x: np.ndarray, salt: np.uint32, out: np.ndarray) -> None:
    for n in range(len(x)):
        total = np.float32(0)
        c0, c1, c2 = np.floor(x[n, 0]), np.floor(x[n, 1]), np.floor(x[n, 2])
        f0, f1, f2 = _smooth(x[n, 0] - c0), _smooth(x[n, 1] - c1), _smooth(x[n, 2] - c2)
        for a in range(2):
            for b in range(2):
                for c in range(2):
                    h = np.uint32(np.uint32(np.int64(c0) + a) * np.uint32(0x8DA6B343))
                    h ^= np.uint32(np.uint32(np.int64(c1) + b) * np.uint32(0xD8163841))
                    h ^= np.uint32(np.uint32(np.int64(c2) + c) * np.uint32(0xCB1AB31F))
                    h = np.uint32(h ^ salt)
                    h = np.uint32(np.uint32(h ^ (h >> 15)) * np.uint32(0x2C1B3C6D))
                    h = np.uint32(np.uint32(h ^ (h >> 12)) * np.uint32(0x297A2D39))
                    h = np.uint32(h ^ (h >> 15))
                    w = (f0 if a else np.float32(1) - f0) * (f1 if b else np.float32(1) - f1)
                    w *= f2 if c else np.float32(1) - f2
                    total += w * (np.float32(h >> 8) * np.float32(2**-24))
        out[n] = total


@njit(cache=True, inline="always")
def _smooth(t: float) -> np.float32:
    f = np.float32(t)
    return f * f * (np.float32(3) - np.float32(2) * f)


def fractal(x: np.ndarray, seed: int, octaves: int = 3) -> np.ndarray:
    """Noise at sizes 1, ½, ¼, … with halving weight, in [0, 1]."""
    weights = 0.5 ** np.arange(octaves)
    return sum(w * noise(x * 2.0**o, seed + o) for o, w in enumerate(weights)) / weights.sum()


def _mix(a: Colour, b: Colour, w: np.ndarray) -> np.ndarray:
    return np.asarray(a) + (np.asarray(b) - np.asarray(a)) * np.clip(w, 0, 1)[:, None]


def _own(x: np.ndarray, face: int) -> np.ndarray:
    """Shifts a face's coordinates, so that opposite faces do not repeat each other."""
    return x + np.array([3.17, 5.71, 7.93]) * face


def wood(light: Colour, dark: Colour, grain: int, seed: int, scale: float = 0.05) -> Texture:
    """Bent growth rings and fibres along axis ``grain``; ``scale``: distance of rings, model units."""
    squeeze = np.full(3, 1.0)
    squeeze[grain] = 0.12

    def texture(x: np.ndarray, face: int) -> np.ndarray:
        p = _own(x, face) * squeeze / scale
        rings = p @ np.array([0.9, 1.1, 0.8]) + 2.5 * fractal(p * 0.45, seed)
        fibre = fractal(p * np.where(squeeze < 1, 0.6, 5.0), seed + 11, 2)
        blotch = noise(_own(x, face) / (4 * scale), seed + 23)
        w = 0.5 + 0.32 * np.sin(2 * np.pi * rings) + 0.9 * (fibre - 0.5)
        return _mix(dark, light, w) * (0.72 + 0.5 * blotch)[:, None]

    return texture


def checker(a: Colour, b: Colour, period: float, seed: int) -> Texture:
    """Fields of two colours, each field with a tint of its own and fine grain."""

    def texture(x: np.ndarray, face: int) -> np.ndarray:
        cell = np.floor((x + 0.013) / period).astype(np.int64)
        base = _mix(a, b, (cell.sum(1) % 2).astype(float))
        i, j, k = cell.T
        tint = np.stack([_hash(i, j, k, seed + 97 * face + c) for c in range(3)], 1)
        grain = fractal(_own(x, face) / (period * 0.2), seed + 5, 2)
        return np.clip(base * (0.75 + 0.4 * tint) + 0.25 * (grain[:, None] - 0.5), 0, 1)

    return texture


def speckle(base: Colour, spots: Colour, size: float, seed: int, cover: float = 0.3) -> Texture:
    """Paint with flecks of two sizes and slow changes of brightness."""

    def texture(x: np.ndarray, face: int) -> np.ndarray:
        p = _own(x, face) / size
        level = np.quantile(noise(np.random.default_rng(0).uniform(0, 99, (2000, 3)), seed), 1 - cover)
        flecks = np.maximum(noise(p, seed) - level, 0.8 * (noise(p * 2.3, seed + 3) - level)) / 0.16
        slow = fractal(p * 0.12, seed + 7, 2)
        hue = noise(p * 0.2, seed + 13)[:, None] * np.array([0.10, -0.03, -0.10])
        return np.clip(_mix(base, spots, flecks) * (0.7 + 0.6 * slow)[:, None] + hue - hue.mean(0), 0, 1)

    return texture


def plain(colour: Colour, seed: int, depth: float = 0.08, size: float = 0.1) -> Texture:
    """Paint that is nearly one colour: slow changes of brightness by ``depth``."""

    def texture(x: np.ndarray, face: int) -> np.ndarray:
        slow = fractal(_own(x, face) / size, seed, 2)
        return np.clip(np.asarray(colour) * (1 + depth * (2 * slow - 1))[:, None], 0, 1)

    return texture


def brushed(colour: Colour, axis: int, seed: int, depth: float = 0.12, size: float = 0.004) -> Texture:
    """Metal with fine scratches along ``axis``."""
    stretch = np.full(3, 1.0)
    stretch[axis] = 0.03

    def texture(x: np.ndarray, face: int) -> np.ndarray:
        p = _own(x, face)
        streaks = 0.7 * fractal(p * stretch / size, seed, 2) + 0.3 * noise(p / (20 * size), seed + 9)
        return np.clip(np.asarray(colour) * (1 + depth * (2 * streaks - 1))[:, None], 0, 1)

    return texture


def stripes(a: Texture, b: Texture, axis: int, period: float, share: float = 0.5, start: float = 0.0) -> Texture:
    """``b`` on ``share`` of every ``period`` along ``axis`` from ``start`` on, ``a`` on the rest."""

    def texture(x: np.ndarray, face: int) -> np.ndarray:
        second = ((x[:, axis] - start) / period) % 1 < share
        return np.where(second[:, None], b(x, face), a(x, face))

    return texture


def inlay(outer: Texture, inner: Texture, margin: float) -> Texture:
    """``inner`` on every face but for a frame of ``outer``, ``margin`` wide."""

    def texture(x: np.ndarray, face: int) -> np.ndarray:
        low, high = x.min(0), x.max(0)
        wide = high - low > 2 * margin
        within = ((x > low + margin) & (x < high - margin) | ~wide).all(1) & (wide.sum() > 1)
        return np.where(within[:, None], inner(x, face), outer(x, face))

    return texture


def by_face(default: Texture, **faces: Texture) -> Texture:
    """Other textures for some faces of a box, named ``f0`` … ``f5`` as ``box`` numbers them."""
    table = {int(name[1:]): texture for name, texture in faces.items()}

    def texture(x: np.ndarray, face: int) -> np.ndarray:
        return table.get(face, default)(x, face)

    return texture


def panes(lower: Colour, upper: Colour, axes: tuple[int, int], period: float, seed: int) -> Texture:
    """A screen: overlapping rectangles of many colours over a gradient, lines of text-like dashes in some."""
    rng = np.random.default_rng(seed)
    n = 26
    centres, halves = rng.uniform(-1, 1, (n, 2)), rng.uniform(0.08, 0.32, (n, 2))
    colours, dashed = rng.uniform(0.1, 0.95, (n, 3)), rng.random(n) < 0.5

    def texture(x: np.ndarray, face: int) -> np.ndarray:
        q = x[:, list(axes)]
        middle, half = (q.max(0) + q.min(0)) / 2, np.maximum((q.max(0) - q.min(0)) / 2, 1e-9)
        g = (q - middle) / half
        rgb = _mix(lower, upper, 0.5 + 0.5 * g[:, 1] + 0.3 * (fractal(x / (3 * period), seed, 2) - 0.5))
        for c, h, colour, lines in zip(centres, halves, colours, dashed, strict=True):
            inside = (np.abs(g - c) < h).all(1)
            rgb[inside] = colour
            if lines:
                cell = np.floor(q[inside] / (period * np.array([0.6, 0.45]))).astype(np.int64)
                ink = (_hash(cell[:, 0], cell[:, 1], 0 * cell[:, 0], seed) > 0.4) & (cell[:, 1] % 2 == 0)
                rgb[np.flatnonzero(inside)[ink]] = 1 - colour
        return rgb * (0.85 + 0.3 * noise(x / (0.5 * period), seed + 2))[:, None]

    return texture
