"""Every 1-DoF motion on a grid, tried: where could these seeds have gone in the other state?

A joint is a line and a number. For each axis direction and angle (or slide) the kernel moves the seeds and adds up a
score volume of the other state (high on surfaces that were not there before, negative in free space), over all axis
positions that cross the object. Nothing is matched by appearance alone, so repeating texture cannot mislead it far.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numba import njit
from scipy.ndimage import distance_transform_edt

from hingesplat.screw import joint_motion, screws_to_matrices
from hingesplat.se3 import moved
from hingesplat.threads import parallel
from hingesplat.visibility import FREE, SURFACE, Sight, ask

COLOUR_SCALE = 0.2
"""RGB difference at which a surface of another colour counts half."""

CLOSER_LOOK = 0.6
"""A coarse score that is this fraction of the best is worth a finer look."""

BASE = np.eye(4)
"""Where the base takes what hangs on it."""

OLD = 0.15
"""Score of a surface that was there before, or came from somewhere else."""

HIDDEN_SCORE = 0.3
"""Score of unseen space, between a surface that fits (1) and free space (−1)."""


@dataclass(frozen=True)
class ScoreVolume:
    """A voxel grid over the object: how welcome a moved point is, and in which colour."""

    origin: np.ndarray
    """(3,) world position of the centre of voxel (0, 0, 0)."""
    voxel: float
    score: np.ndarray
    """(x, y, z) float32 in [-1, 1]."""
    colour: np.ndarray
    """(x, y, z, 3) float32."""

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres (3,) of the first and the last voxel."""
        return self.origin, self.origin + (np.array(self.score.shape) - 1) * self.voxel

    @property
    def reach(self) -> float:
        """Half of its diagonal."""
        return float(np.linalg.norm(self.box[1] - self.box[0])) / 2

    @property
    def grid(self) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
        """As the kernels take it."""
        return self.origin.astype(np.float32), self.voxel, self.score, self.colour


def score_volume(
    points: np.ndarray,
    colours: np.ndarray,
    novel: np.ndarray,
    here: Sight,
    low: np.ndarray,
    high: np.ndarray,
    cells: int,
) -> ScoreVolume:
    """Score volume of the state seen by ``here``, whose surface is sampled by points (n, 3) with colours (n, 3).

    A surface voxel is worth as much as it is ``novel`` (n,). Space that nobody sees is worth a little, since parts do
    go there (the sides of a drawer); free space costs −1.
    """
    voxel = float((high - low).max()) / cells
    shape = np.ceil((high - low) / voxel).astype(int) + 1
    centres = np.stack(np.meshgrid(*[np.arange(s) for s in shape], indexing="ij"), -1).reshape(-1, 3)
    centres = centres * voxel + low
    views_free = ask(centres, np.zeros_like(centres), here)[:, FREE].reshape(shape)
    index = np.clip(np.round((points - low) / voxel).astype(int), 0, shape - 1)
    occupied = np.zeros(shape, np.float32)
    np.maximum.at(occupied, tuple(index.T), novel)
    colour = np.zeros((*shape, 3), np.float32)
    count = np.zeros(shape, np.float32)
    np.add.at(colour, tuple(index.T), colours)
    np.add.at(count, tuple(index.T), 1)
    colour /= np.maximum(count, 1)[..., None]
    nearest = distance_transform_edt(count == 0, return_distances=False, return_indices=True)
    near = tuple(np.asarray(nearest))
    distance = np.linalg.norm(np.asarray(near) - np.indices(count.shape), axis=0)
    score = occupied[near] * np.exp(-0.5 * np.maximum(distance - 0.5, 0) ** 2)
    score = np.where(distance > 1.5, np.where(views_free >= 3, -1.0, HIDDEN_SCORE), score)
    return ScoreVolume(low, voxel, score.astype(np.float32), np.ascontiguousarray(colour[near]))


def novelty(answer: np.ndarray) -> np.ndarray:
    """(n,) how new a surface point is, from what the other state's cameras say of it.

    It is 1 where the other state saw free space, 0.6 where it could not see, and ``OLD`` where it saw a surface, too.
    """
    new = answer[:, FREE] >= 3
    seen = answer[:, SURFACE] >= 2
    return np.where(new, 1.0, np.where(seen, OLD, 0.6)).astype(np.float32)


HIDDEN32 = np.float32(HIDDEN_SCORE)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _sum(q, colours, shift, origin, inverse_voxel, score, volume_colour, give_up):  # pragma: no cover - compiled
    """Mean score of points q + shift; surfaces count by how constant the colour difference is: light shifts it."""
    nx, ny, nz = score.shape
    m = q.shape[0]
    zero = np.float32(0)
    penalty, welcome, square, unseen = zero, zero, zero, zero
    mean0, mean1, mean2 = zero, zero, zero
    for i in range(m):
        x = int((q[i, 0] + shift[0] - origin[0]) * inverse_voxel + np.float32(0.5))
        y = int((q[i, 1] + shift[1] - origin[1]) * inverse_voxel + np.float32(0.5))
        z = int((q[i, 2] + shift[2] - origin[2]) * inverse_voxel + np.float32(0.5))
        if x < 0 or y < 0 or z < 0 or x >= nx or y >= ny or z >= nz:
            penalty -= 1
        else:
            s = score[x, y, z]
            if s == HIDDEN32:
                unseen += s
            elif s > 0:
                e0 = volume_colour[x, y, z, 0] - colours[i, 0]
                e1 = volume_colour[x, y, z, 1] - colours[i, 1]
                e2 = volume_colour[x, y, z, 2] - colours[i, 2]
                welcome += s
                mean0 += s * e0
                mean1 += s * e1
                mean2 += s * e2
                square += s * (e0 * e0 + e1 * e1 + e2 * e2)
            else:
                penalty += s
        # Most places are hopeless: a few points say so, for a worse sum than a fair one of theirs would be.
        if (i == m // 16 or i == m // 4) and welcome + unseen + penalty < give_up * i - (2 if i < m // 4 else 0):
            return np.float32(-1)
    if welcome > 0:
        offset = (mean0 * mean0 + mean1 * mean1 + mean2 * mean2) / welcome
        variance = (square - np.float32(0.8) * offset) / welcome
        welcome /= np.float32(1) + variance * np.float32(1 / COLOUR_SCALE**2)
    # What is hidden counts as far as something is seen: else every part would vanish inside another.
    return (welcome + min(unseen, welcome) + penalty) / m


@njit(cache=True, nogil=True, error_model="numpy")
def _crosses_box(px, py, pz, d, low, high):  # pragma: no cover - compiled
    near, far = -1e9, 1e9
    p = (px, py, pz)
    for a in range(3):
        if abs(d[a]) < 1e-6:
            if p[a] < low[a] or p[a] > high[a]:
                return False
        else:
            t0, t1 = (low[a] - p[a]) / d[a], (high[a] - p[a]) / d[a]
            near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
    return near <= far


@njit(cache=True, nogil=True, error_model="numpy")
def _scan_revolute(
    seeds,
    colours,
    directions,
    angles,
    origin,
    voxel,
    score,
    volume_colour,
    low,
    high,
    reach,
    stride,
    wanted,
    best,
    pivots,
    thread,
    threads,
):  # pragma: no cover - compiled
    n_d, n_a, m = directions.shape[0], angles.shape[0], seeds.shape[0]
    c = np.zeros(3)
    for i in range(m):
        for a in range(3):
            c[a] += seeds[i, a] / m
    for job in range(thread, n_d * n_a, threads):
        if not wanted[job // n_a, job % n_a]:
            continue
        d, theta = directions[job // n_a], angles[job % n_a]
        helper = np.zeros(3)
        helper[np.argmin(np.abs(d))] = 1
        u = np.cross(d, helper)
        u /= np.sqrt((u * u).sum())
        w = np.cross(d, u)
        cs, sn = np.cos(theta), np.sin(theta)
        q = np.empty((m, 3), np.float32)
        for i in range(m):
            r = seeds[i] - c
            along = (r * d).sum()
            cross = np.cross(d, r)
            for a in range(3):
                q[i, a] = c[a] + r[a] * cs + cross[a] * sn + d[a] * along * (1 - cs)
        half = 0.5 / np.tan(theta / 2)
        n = int(min(reach, 2 * reach * abs(np.sin(theta / 2))) / voxel) // stride
        shift = np.empty(3, np.float32)
        top = np.float32(-1)
        for ia in range(-n, n + 1):
            for ib in range(-n, n + 1):
                ta, tb = ia * stride * voxel, ib * stride * voxel
                # The fixed point of rotating by theta about c and then shifting by (ta, tb).
                pa, pb = 0.5 * ta - half * tb, 0.5 * tb + half * ta
                px, py, pz = (
                    c[0] + pa * u[0] + pb * w[0],
                    c[1] + pa * u[1] + pb * w[1],
                    c[2] + pa * u[2] + pb * w[2],
                )
                if not _crosses_box(px, py, pz, d, low, high):
                    continue
                for a in range(3):
                    shift[a] = ta * u[a] + tb * w[a]
                s = _sum(
                    q,
                    colours,
                    shift,
                    origin,
                    np.float32(1 / voxel),
                    score,
                    volume_colour,
                    max(top, np.float32(0)) * 0.4,
                )
                if s > top:
                    top = s
                    pivots[job // n_a, job % n_a, 0] = px
                    pivots[job // n_a, job % n_a, 1] = py
                    pivots[job // n_a, job % n_a, 2] = pz
        best[job // n_a, job % n_a] = top


@njit(cache=True, nogil=True, error_model="numpy")
def _scan_prismatic(
    seeds, colours, directions, slides, origin, voxel, score, volume_colour, best, thread, threads
):  # pragma: no cover - compiled
    n_d, n_s = directions.shape[0], slides.shape[0]
    for job in range(thread, n_d * n_s, threads):
        shift = (directions[job // n_s] * slides[job % n_s]).astype(np.float32)
        best[job // n_s, job % n_s] = _sum(
            seeds, colours, shift, origin, np.float32(1 / voxel), score, volume_colour, np.float32(-9)
        )


@dataclass(frozen=True)
class Motion:
    """A hypothesis: one degree of freedom from this state to the other, world frame."""

    kind: str
    """``revolute`` or ``prismatic``."""
    axis: np.ndarray
    """(3,) unit."""
    pivot: np.ndarray
    """(3,) a point on the axis; the seeds' centroid for a slide."""
    value: float
    """Radians or scene units."""
    score: float
    """Mean score of the seeds, at most 1."""
    after: np.ndarray = field(default_factory=lambda: BASE)
    """(4, 4) where the motion of another part, on which this one hangs, takes it then."""
    by_texture: bool = False
    """Whether texture has corrected it: it is right to a fraction of a pixel."""

    @staticmethod
    def of(known: Mapping[str, Any]) -> "Motion":
        """From a JSON object of its fields."""
        axis, pivot, after = (np.asarray(known[name], np.float64) for name in ("axis", "pivot", "after"))
        return Motion(known["kind"], axis, pivot, known["value"], known["score"], after, known.get("by_texture", False))

    @property
    def T(self) -> np.ndarray:
        """4×4 from this state's configuration to the other's."""
        return self.after @ joint_motion(self.kind, self.axis, self.pivot, self.value)


def there_and_back(motions: Sequence[Motion]) -> tuple[np.ndarray, np.ndarray]:
    """(n, 4, 4) where every motion takes things from this state to the other, and from there back."""
    turns = np.array([m.kind == "revolute" for m in motions], bool)
    values = np.array([m.value for m in motions])
    axes, pivots = (np.reshape([getattr(m, name) for m in motions], (-1, 3)) for name in ("axis", "pivot"))
    joint = screws_to_matrices(axes, pivots, np.where(turns, values, 0), np.where(turns, 0, values))
    there = np.reshape([m.after for m in motions], (-1, 4, 4)) @ joint
    return there, np.linalg.inv(there)


def inverted(motion: Motion) -> Motion:
    """The way back: the joint where the other part's motion has taken it, then that motion undone."""
    axis, pivot = motion.after[:3, :3] @ motion.axis, moved(motion.pivot[None], motion.after)[0]
    return replace(motion, axis=axis, pivot=pivot, value=-motion.value, after=np.linalg.inv(motion.after))


def carrier_of(motion: Motion, motions: Sequence[Motion]) -> int | None:
    """Index of the motion on the base that carries this one on; None for one that hangs on the base, or on no other."""
    if np.array_equal(motion.after, BASE):
        return None
    on_base = [k for k, m in enumerate(motions) if np.array_equal(m.after, BASE)]
    return min(on_base, key=lambda k: float(np.abs(motions[k].T - motion.after).max()), default=None)


def scan(
    kind: str,
    seeds: np.ndarray,
    colours: np.ndarray,
    directions: np.ndarray,
    volume: ScoreVolume,
    *,
    values: np.ndarray | None = None,
    near: Motion | None = None,
    after: np.ndarray = BASE,
    keep: int = 12,
) -> list[Motion]:
    """The best distinct motions of one kind for seeds (m, 3) with colours (m, 3), about or along ``directions`` (d, 3).

    Args:
        values: angles (radians) or slides (scene units) to try; None tries ±5° to ±150° and every slide that stays
            within the object.
        near: keep a revolute axis within four voxels of this motion's pivot.
        after: (4, 4) what moves the seeds on, once their joint has moved them.

    Distinct: their mean displacement of the seeds differs by more than three voxels.
    """
    R, back = after[:3, :3], np.linalg.inv(after)
    seeds, directions = moved(seeds, after), directions @ R.T  # There the same joint stands elsewhere.
    directions = np.ascontiguousarray(directions, dtype=np.float64)
    found = (
        _turns(seeds, colours, directions, volume, values, None if near is None else moved(near.pivot[None], after)[0])
        if kind == "revolute"
        else _slides(seeds, colours, directions, volume, values)
    )
    found.sort(key=lambda m: -m.score)
    kept: list[Motion] = []
    ends: list[np.ndarray] = []
    for motion in found:
        end = moved(seeds, motion.T)
        if all(np.linalg.norm(end - e, axis=1).mean() > 3 * volume.voxel for e in ends):
            kept.append(motion)
            ends.append(end)
            if len(kept) == keep:
                break
    return [replace(m, axis=m.axis @ R, pivot=moved(m.pivot[None], back)[0], after=after) for m in kept]


def _turns(
    seeds: np.ndarray,
    colours: np.ndarray,
    directions: np.ndarray,
    volume: ScoreVolume,
    angles: np.ndarray | None,
    pivot: np.ndarray | None,
) -> list[Motion]:
    """For each direction and angle the place of the axis that scores best."""
    angles = both_signs(np.radians(np.arange(5, 151, 5))) if angles is None else angles
    angles = angles[np.abs(angles) > 1e-3]
    box = volume.box if pivot is None else (pivot - 4 * volume.voxel, pivot + 4 * volume.voxel)
    score = np.full((len(directions), len(angles)), -1, np.float32)
    pivots = np.zeros((*score.shape, 3))
    wanted = np.ones(score.shape, bool)
    # Every second place first, since surfaces are three voxels thick; every place where that is promising.
    for stride in (2, 1):
        parallel(
            _scan_revolute, torch.get_num_threads(), seeds.astype(np.float32), colours.astype(np.float32), directions,
            angles, *volume.grid, *box, volume.reach, stride, wanted, score, pivots,
        )  # fmt: skip
        wanted = score > CLOSER_LOOK * score.max(initial=0)
    return [
        Motion("revolute", directions[i], pivots[i, j], float(angles[j]), float(score[i, j]))
        for i, j in np.ndindex(score.shape)
    ]


def _slides(
    seeds: np.ndarray, colours: np.ndarray, directions: np.ndarray, volume: ScoreVolume, slides: np.ndarray | None
) -> list[Motion]:
    if slides is None:
        slides = both_signs(np.arange(1, 1.2 * volume.reach / volume.voxel, 0.5) * volume.voxel)
    score = np.full((len(directions), len(slides)), -1, np.float32)
    given = (seeds.astype(np.float32), colours.astype(np.float32), directions, slides, *volume.grid)
    parallel(_scan_prismatic, torch.get_num_threads(), *given, score)
    centroid = seeds.mean(0)
    return [
        Motion("prismatic", directions[i], centroid, float(slides[j]), float(score[i, j]))
        for i, j in np.ndindex(score.shape)
    ]


def both_signs(values: np.ndarray) -> np.ndarray:
    return np.concatenate([-values[::-1], values])
