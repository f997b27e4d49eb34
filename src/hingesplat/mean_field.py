"""Labels of points of two states that listen to their neighbours and to each other: mean field, compiled.

The labels of a point lie beside each other in a vector, so that hearing a neighbour is one multiplication.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numba import njit
from scipy.sparse import csr_matrix

from hingesplat.simd import (
    INLINE,
    INNER,
    KERNEL,
    LANES,
    Build,
    sload,
    sstore,
    vexp2,
    vfma,
    vload,
    vmax,
    vsplat,
    vstore,
    vsum,
)

WARM, COLD = 0.15, 0.05
"""Temperature at first, and towards which it falls."""
NEVER = 1e3
"""Cost of the labels that fill a vector."""
_BUILD = Build([Path(__file__)])
_0, _QUARTER, _LOWEST = np.float32(0), np.float32(0.25), np.float32(-8)


def mean_field(
    costs: Sequence[np.ndarray],
    partners: Sequence[np.ndarray],
    weights: Sequence[csr_matrix],
    smoothness: float,
    consistency: float,
    nobody: float,
    iterations: int,
) -> tuple[tuple[np.ndarray, np.ndarray], float]:
    """The labels (n_s,) of both states' points, and the energy they cost.

    Args:
        costs: (n_s, labels) of each state's points.
        partners: (n_s, labels) int32: the other state's point that a point hears under each label, or −1.
        weights: (n_s, n_s) float32 of neighbours.
        nobody: what a point without a partner hears, between one that disagrees (0) and one that agrees (1).
    """
    labels = costs[0].shape[1]
    width = -(-labels // LANES) * LANES
    problems = []
    for c, p, w in zip(costs, partners, weights, strict=True):
        padded = np.full((len(c), width), NEVER, np.float32)
        padded[:, :labels] = c
        problems.append((padded.ravel(), p, w.indptr, w.indices, w.data))
    said = np.float32(smoothness), np.float32(consistency), np.float32(nobody)
    first, second, energy = _settle(_BUILD, width, problems[0], problems[1], said, iterations)
    return (first, second), float(energy)


@njit(**INLINE)
def _exp(x):
    """e^x for x ≤ 0, and e^-22 at least."""
    y = vexp2(vmax(x * np.float32(_QUARTER / np.log(2)), vsplat(_LOWEST)))
    y = y * y
    return y * y


@njit(**INNER)
def _update(build, width, q, other, costs, partners, start, end, weight, said, temperature, updated, half):
    """``updated`` from both states' present ``q`` and ``other``, all (n · width,); the energy of this state."""
    smoothness, consistency, nobody = said
    labels, energy = partners.shape[1], 0.0
    for i in range(len(partners)):
        o = i * width
        least = np.float32(np.inf)
        for b in range(0, width, LANES):
            total = vsplat(_0)
            for e in range(start[i], start[i + 1]):
                total = vfma(vsplat(sload(weight, e)), vload(q, end[e] * width + b), total)
            vstore(half, b, total * smoothness)
        for k in range(labels):
            partner = partners[i, k]
            agrees = sload(other, partner * width + k) if partner >= 0 else nobody
            heard = sload(half, k) + consistency * agrees
            cost = sload(costs, o + k)
            sstore(updated, o + k, cost - heard)
            # Each edge is heard from both its ends, so pairs count half.
            sstore(half, k, cost - np.float32(0.5) * heard)
            least = min(least, cost - heard)
        for k in range(labels, width):
            sstore(updated, o + k, np.float32(NEVER))
            sstore(half, k, _0)
        share, cost = _0, _0
        for b in range(0, width, LANES):
            q_b = _exp((vsplat(least) - vload(updated, o + b)) / temperature)
            vstore(updated, o + b, q_b)
            share += vsum(q_b)
            cost += vsum(q_b * vload(half, b))
        for b in range(0, width, LANES):
            vstore(updated, o + b, vload(updated, o + b) / share)
        energy += cost / share
    return energy


@njit(**KERNEL)
def _settle(build, width, problem0, problem1, said, iterations):
    """Labels of each state's points and the energy; a problem: costs, partners, and the graph of neighbours (CSR)."""
    costs0, partners0, start0, end0, weight0 = problem0
    costs1, partners1, start1, end1, weight1 = problem1
    q0, q1, u0, u1 = np.empty_like(costs0), np.empty_like(costs1), np.empty_like(costs0), np.empty_like(costs1)
    half = np.empty(width, np.float32)
    for costs, q in ((costs0, q0), (costs1, q1)):
        for o in range(0, len(costs), width):
            q[o : o + width] = np.exp((costs[o : o + width].min() - costs[o : o + width]) / np.float32(0.1))
            q[o : o + width] /= q[o : o + width].sum()
    energy = 0.0
    for iteration in range(iterations):
        temperature = np.float32(WARM + (COLD - WARM) * iteration / iterations)
        energy = _update(build, width, q0, q1, costs0, partners0, start0, end0, weight0, said, temperature, u0, half)
        energy += _update(build, width, q1, q0, costs1, partners1, start1, end1, weight1, said, temperature, u1, half)
        q0, u0, q1, u1 = u0, q0, u1, q1
    first, second = np.empty(len(partners0), np.int64), np.empty(len(partners1), np.int64)
    for q, label in ((q0, first), (q1, second)):
        for i in range(len(label)):
            label[i] = q[i * width : (i + 1) * width].argmax()
    return first, second, energy
