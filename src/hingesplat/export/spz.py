"""Gaussians as SPZ, the compact splat format that browsers read (github.com/nianticlabs/spz, version 3)."""

import gzip
import struct

import numpy as np
import torch

from hingesplat.gaussians import Gaussians

MAGIC, VERSION = 0x5053474E, 3
COLOUR_SCALE = 0.15
MAX_DEGREE = 3


def spz_bytes(gaussians: Gaussians, *, max_degree: int = MAX_DEGREE) -> bytes:
    """One gzipped SPZ file; axes as they are, part ids left out.

    Centres get as many binary places as their 24 bits leave room for, so small and large objects keep their
    detail: about one part in eight million of the largest coordinate.

    Args:
        gaussians: n of them; none is allowed.
        max_degree: spherical harmonics above this degree (and above 3) are left out.
    """
    g = gaussians.detached()
    n, degree = len(g), min(g.sh_degree, max_degree, MAX_DEGREE)
    means = g.means.cpu().double().numpy()
    reach = max(float(np.abs(means).max(initial=0.0)), 1e-6)
    places = int(np.clip(np.floor(22 - np.log2(reach)), 0, 30))
    fixed = np.rint(means * 2.0**places).astype("<i4").reshape(-1, 1).view(np.uint8)[:, :3]
    colours = g.sh[:, 0].cpu().double().numpy() * COLOUR_SCALE * 255 + 0.5 * 255
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, n, degree, places, 0, 0)
    body = (
        fixed,
        _bytes(g.opacities.cpu().numpy() * 255),
        _bytes(colours),
        _bytes((g.log_scales.cpu().numpy() + 10) * 16),
        _smallest_three(g.quats.cpu()),
        _bytes(g.sh[:, 1 : (degree + 1) ** 2].cpu().numpy() * 128 + 128),
    )
    return gzip.compress(header + b"".join(part.tobytes() for part in body), 9, mtime=0)


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.rint(values).clip(0, 255).astype(np.uint8)


def _smallest_three(quats_wxyz: torch.Tensor) -> np.ndarray:
    """(n,) little-endian words: two bits name the largest of x y z w, then 9 bits and a sign for each other one."""
    q = torch.nn.functional.normalize(quats_wxyz.double(), dim=1).numpy()[:, [1, 2, 3, 0]]
    largest = np.abs(q).argmax(1)
    rows = np.arange(len(q))
    q = q * np.where(q[rows, largest] < 0, -1.0, 1.0)[:, None]
    words = largest.astype(np.uint32)
    for i in range(4):
        sign = (q[:, i] < 0).astype(np.uint32)
        size = np.rint(511 * np.sqrt(2) * np.abs(q[:, i])).clip(0, 511).astype(np.uint32)
        words = np.where(largest == i, words, (words << 10) | (sign << 9) | size)
    return words.astype("<u4")
