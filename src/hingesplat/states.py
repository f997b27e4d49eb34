"""Parts of an object in more than two states, wherever they move."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from hingesplat.capture import View
from hingesplat.gaussians import Gaussians
from hingesplat.hypotheses import polished
from hingesplat.se3 import moved
from hingesplat.search import BASE, Motion, carrier_of, novelty, scan, score_volume
from hingesplat.segment import Segmentation, SegmentConfig, must_have_moved, segment, survey
from hingesplat.stereo import DepthMap
from hingesplat.visibility import ask


def segment_states(
    gaussians: Sequence[Gaussians],
    views: Sequence[Sequence[View]],
    config: SegmentConfig,
    *,
    maps: Sequence[Sequence[DepthMap]] = (),
    parts: int | None = None,
    seed: int = 0,
) -> tuple[Segmentation, int, np.ndarray]:
    """Parts of an object in two or more states, wherever they move.

    The state in which most has moved since state 0 comes first. Then each of the others is searched, if more moves in
    it than the parts known so far explain: a part may rest in all states but one.

    Args:
        gaussians: fitted to every state.
        views: the training photographs of every state.
        maps: the depth of these photographs where it is known.
        parts: number of movable parts at most, or None to find it.

    Returns:
        The parts, with labels of state 0 and of that other state; the number of that state; and where each part is in
        every state, T_state_0 (states, 1 + parts, 4, 4), the base first.
    """
    maps = maps or [()] * len(views)

    def beside(t: int) -> tuple[tuple[Gaussians, Gaussians], tuple[Sequence[View], Sequence[View]]]:
        return (gaussians[0], gaussians[t]), (views[0], views[t])

    def more(t: int) -> dict[str, Any]:
        return {"maps": (maps[0], maps[t]), "seed": seed}

    others, moving = list(range(1, len(gaussians))), {}
    if len(others) > 1:
        moving = {t: _moving(*beside(t), config, **more(t)) for t in others}
        others.sort(key=lambda t: -sum(map(len, moving[t][1])))
    most = others[0]
    found = segment(*beside(most), config, parts=parts, **more(most))
    place = {(most, k): motion.T for k, motion in enumerate(found.motions)}
    for t in others[1:]:
        known = track(*beside(t), found.labels[0], found.motions, config, **more(t))
        place |= {(t, k): T for k, T in enumerate(known)}
        room = None if parts is None else parts - len(found.motions)
        if room == 0 or _left_over(gaussians[0], found.labels[0], known, moving[t]) < config.min_left_over:
            continue
        here = segment(*beside(t), config, **more(t))
        for k, motion in enumerate(here.motions[:room]):
            mine = here.labels[0] == k + 1
            new = mine & (found.labels[0] == 0)
            if 2 * new.sum() > mine.sum():
                place[t, len(found.motions)] = motion.T
                found = _with_part(found, motion, new, (gaussians[0], gaussians[most]))
    T_state_0 = np.tile(np.eye(4), (len(gaussians), 1 + len(found.motions), 1, 1))
    for t in others:
        if any((t, k) not in place for k in range(len(found.motions))):
            late = track(*beside(t), found.labels[0], found.motions, config, **more(t))
            place = {(t, k): T for k, T in enumerate(late)} | place
        for k in range(len(found.motions)):
            T_state_0[t, 1 + k] = place[t, k]
    return found, most, T_state_0


def _moving(
    gaussians: tuple[Gaussians, Gaussians],
    views: tuple[Sequence[View], Sequence[View]],
    config: SegmentConfig,
    *,
    maps: tuple[Sequence[DepthMap], Sequence[DepthMap]],
    seed: int,
) -> tuple[float, list[np.ndarray]]:
    """The extent of two states, and each state's points (n, 3), thinned, that must have moved."""
    rng = np.random.default_rng(seed)
    low, high, surfaces = survey(gaussians, views, maps, config)
    extent = float((high - low).max())
    rows = must_have_moved(surfaces, extent, rng)[0]
    return extent, [surface.points[index] for surface, index in zip(surfaces, rows, strict=True)]


def _left_over(
    gaussians: Gaussians, labels: np.ndarray, T_t_0: Sequence[np.ndarray], moving: tuple[float, list[np.ndarray]]
) -> int:
    """How many of the points that must have moved belong to none of the parts known, in either state."""
    extent, (here, there) = moving
    means = gaussians.means.numpy()
    at_end = np.concatenate([means[:0], *(moved(means[labels == k], T) for k, T in enumerate(T_t_0, 1))])
    count = int((labels[KDTree(means).query(here)[1]] == 0).sum()) if len(here) else 0
    if len(at_end) == 0 or len(there) == 0:
        return count + len(there)
    return count + int((KDTree(at_end).query(there)[0] > 0.03 * extent).sum())


def _with_part(
    found: Segmentation, motion: Motion, rows: np.ndarray, gaussians: tuple[Gaussians, Gaussians]
) -> Segmentation:
    """One part more, that of ``rows`` (n,) bool of state 0's Gaussians; in the other state of ``found`` it rests."""
    here, there = (g.means.numpy() for g in gaussians)
    part, labels = len(found.motions) + 1, (found.labels[0].copy(), found.labels[1].copy())
    labels[0][rows] = part
    labels[1][(labels[1] == 0) & rows[KDTree(here).query(there)[1]]] = part
    return replace(found, labels=labels, motions=(*found.motions, motion))


def track(
    gaussians: tuple[Gaussians, Gaussians],
    views: tuple[Sequence[View], Sequence[View]],
    labels: np.ndarray,
    motions: Sequence[Motion],
    config: SegmentConfig,
    *,
    maps: tuple[Sequence[DepthMap], Sequence[DepthMap]] = ((), ()),
    seed: int = 0,
) -> list[np.ndarray]:
    """T_t_0 (4×4) of every part in a further state, its joint known from another pair of states.

    Args:
        gaussians: fitted to state 0 and to the further state t.
        views: the training photographs of the same two states.
        labels: part id of every Gaussian of state 0.
        motions: each part's joint, as ``segment`` found it.
    """
    rng = np.random.default_rng(seed)
    low, high, (here, there) = survey(gaussians, views, maps, config)
    extent = float((high - low).max())
    novel = novelty(ask(there.points, there.colours, here.sight))
    volume = score_volume(there.points, there.colours, novel, there.sight, low, high, 2 * config.cells)
    own_label = labels[KDTree(gaussians[0].means.numpy()).query(here.points)[1]]
    carriers = [carrier_of(motion, motions) for motion in motions]
    found: dict[int, np.ndarray] = {}
    for k in sorted(range(len(motions)), key=lambda k: carriers[k] is not None):
        motion, carrier = motions[k], carriers[k]
        after = BASE if carrier is None else found[carrier]
        own = np.flatnonzero(own_label == k + 1)
        if len(own) < config.min_part_seeds:
            found[k] = after
            continue
        motion = replace(motion, value=0.0, after=after)
        mine = here.rows(rng.choice(own, min(2 * config.hypotheses.seeds_per_search, len(own)), replace=False))
        reach = np.radians(150) if motion.kind == "revolute" else extent / 2
        trials = scan(
            motion.kind,
            mine.points,
            mine.colours,
            motion.axis[None],
            volume,
            values=np.linspace(-reach, reach, 201),
            near=motion,
            after=after,
            keep=6,
        )
        found[k] = polished([motion, *trials], mine, there, extent).T
    return [found[k] for k in range(len(motions))]


__all__ = ["segment_states", "track"]
