"""First motions made right: photographs of each state are drawn with its own base and the parts as another saw them.

With Gaussians of both states in one model, the inside of a flap that only one state shows would hold the flap wherever
it was first put; and behind a surface Gaussians are fuzz that nobody sees before it turns, so those hardly seen are
left out. What the shape of a part leaves open (a round bar turned about itself) its texture tells, as long as Gaussians
have not taken on the colours of a wrong pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hingesplat.capture import View
from hingesplat.gaussians import Gaussians, concatenate
from hingesplat.optim import Adam
from hingesplat.poses import PoseDelta, errors_by_part, part_centres, pose_loss, pose_step
from hingesplat.se3 import apart
from hingesplat.training import evenly, shown, shuffled, thinned, training_views

JUDGES = 25
"""Photographs of a state that say what is seen, and whether an alignment has made things better."""
SLIT, JUMP = 0.1, 0.015
"""Share of a part that one state shows beside the other, below which it is put right by no more than these extents, in
the mean over its Gaussians: wire racks behind a door had gone on by a bar or two, or aslant, 0.02 to 0.12."""


@dataclass(frozen=True)
class AlignConfig:
    """Moving the parts, and changing nothing else, from a start that was searched for."""

    steps: int = 360
    """Optimiser steps, each on one photograph of one state; 0 leaves the parts where they are."""
    rate: float = 5e-3
    """Adam step of the poses (radians, extents); decays to 10 %."""
    ssim_weight: float = 0.2
    """Weight of 1 − SSIM; the rest is L1."""
    shown: float = 0.2
    """Share of its ellipse that a photograph of its own state must show of a mover's Gaussian; others go."""


def shown_movers(gaussians: Gaussians, labels: np.ndarray, views: Sequence[View], share: float) -> np.ndarray:
    """(n,) bool: the Gaussians of a state but for those of movers that its photographs show less than this share of."""
    cameras = [views[i].camera for i in evenly(len(views), JUDGES)]
    return (labels == 0) | (shown(gaussians, cameras) > share).cpu().numpy()


def align(
    gaussians: tuple[Gaussians, Gaussians],
    labels: tuple[np.ndarray, np.ndarray],
    other: int,
    T_state_0: np.ndarray,
    views: Sequence[Sequence[View]],
    config: AlignConfig,
    *,
    known: np.ndarray | None = None,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> np.ndarray:
    """The motions (states, parts, 4, 4), those of parts put right that photographs then like better.

    Args:
        gaussians: fitted to state 0 and to the state ``other``.
        labels: part id of every Gaussian of each.
        T_state_0: (states, parts, 4, 4) first motions.
        views: training photographs of every state.
        known: (movers,) bool, which motions are right as they are; none if it is left out.
        device: where to optimise.
    """
    parts = T_state_0.shape[1]
    free = np.ones(parts - 1, bool) if known is None else ~known
    if not free.any() or config.steps == 0:
        return T_state_0
    first, second = (
        replace(g.with_part(torch.from_numpy(np.asarray(label, np.int64))), sh=g.sh[:, :1]).to(device)
        for g, label in zip(gaussians, labels, strict=True)
    )
    in_others = concatenate([second[second.part == 0], first[first.part > 0]])
    in_first = concatenate([first[first.part == 0], second[second.part > 0]])
    low, high = np.quantile(gaussians[0].means.numpy(), [0.002, 0.998], axis=0)
    start = torch.from_numpy(T_state_0).to(first.means)
    extent = float((high - low).max())
    poses = PoseDelta(start, part_centres(first, parts), extent)
    training = training_views(views, (), device)
    adam = Adam(poses.parameters)
    photographs = shuffled(training, np.random.default_rng(seed))
    for step in range(config.steps):
        state, view = next(photographs)
        R, t = poses.Rt()
        here = (in_others, R[state], t[state]) if state else (in_first, *_inverse(R[other], t[other]))
        pose_loss(*here, view, config.ssim_weight).backward()
        pose_step(adam, config.rate, step / config.steps, end=0.1)
    R, t = (x.detach() for x in poses.Rt())
    trials, judges = [(start[..., :3, :3], start[..., :3, 3]), (R, t)], thinned(training, JUDGES)
    back = [_inverse(torch.stack([R[other]] * 2), torch.stack([t[other]] * 2)) for R, t in trials]
    there, here = errors_by_part(in_others, trials, judges), errors_by_part(in_first, back, [(), judges[0]])
    was, now = _mean(np.concatenate([there, here], 1))
    found = poses.T_state_0()
    far = _strayed((first, second), found[other], T_state_0[other], extent)
    better = np.concatenate([[False], free & (now < was) & ~far])
    return np.where(better[:, None, None], found, T_state_0)


def _strayed(states: tuple[Gaussians, Gaussians], found: np.ndarray, start: np.ndarray, extent: float) -> np.ndarray:
    """(movers,) bool: those that one state hardly shows, and whose pose (parts, 4, 4) is far from where it started."""
    shares = [torch.bincount(g.part, minlength=len(found))[1:].cpu().numpy() for g in states]
    slit = np.minimum(*shares) < SLIT * np.maximum(*shares)
    far = np.zeros(len(slit), bool)
    for k in np.flatnonzero(slit) + 1:
        s = int(shares[0][k - 1] <= shares[1][k - 1])
        ways = (T[k] if s == 0 else np.linalg.inv(T[k]) for T in (found, start))
        far[k - 1] = apart(states[s].means[states[s].part == k].cpu().numpy(), *ways) > JUMP * extent
    return far


def _inverse(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Poses (…, 3, 3) and (…, 3) the other way."""
    back = R.transpose(-1, -2)
    return back, -(back @ t[..., None])[..., 0]


def _mean(errors: np.ndarray) -> np.ndarray:
    """(trials, movers) mean over the photographs (trials, photographs, movers) that show each; infinite if none do."""
    seen = np.isfinite(errors)
    return np.where(seen.any(1), np.where(seen, errors, 0).sum(1) / np.maximum(seen.sum(1), 1), np.inf)
