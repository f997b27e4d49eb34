"""Joint optimisation of Gaussians, part identities and part motions on the photographs of all states (sections 3–5)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from hingesplat.capture import View
from hingesplat.gaussians import Gaussians, posed
from hingesplat.identity import Free, Identity, IdentityConfig, identity_of, parts_of_shifts
from hingesplat.losses.part import soft_motion
from hingesplat.optim import GaussianAdam, LearningRates
from hingesplat.physics import PhysicsConfig, RepelConfig, Repulsion, Targets, one_hot, physics_loss
from hingesplat.poses import (
    PoseDelta,
    StateLossConfig,
    errors_by_part,
    move_parts_alone,
    part_centres,
    pose_step,
    state_loss,
)
from hingesplat.slots import SlotsConfig, living_slots
from hingesplat.stereo import DepthMap
from hingesplat.training import Report, TrainingView, averaged, grow, shuffled, thinned, training_views

JUDGES, BETTER = 25, 0.9
"""Photographs of a state that say whether an alignment has made things better, and the share of the error that may be
left if it plainly has: a round lever 13° off had 0.65."""
GENTLER = 4
"""Part of the rate at which all is tried once more if a part went back."""
ASTRAY, FAR = 5e-3, 0.03
"""Extents by which an alignment that is not plainly better may take a part off the other state's surface, in the mean:
a door brought from 11° off to 1° had 0.003, one that left its hinge 0.009. No point counts as farther off than FAR."""


@dataclass(frozen=True)
class ArticulateConfig:
    """Joint optimisation."""

    steps: int = 1000
    """Optimiser steps, each on one photograph of one state."""
    max_gaussians: int = 16_000
    """Cap on the number of canonical Gaussians."""
    align_steps: int = 240
    """Steps before these in which parts move and nothing else changes, from a start that was searched for."""
    align_rate: float = 1e-2
    """Adam step of their poses then (radians, extents); decays to 10 %."""
    pose_rate: float = 2e-3
    """Adam step of the part poses (radians, extents) at the start; decays to 2 %."""
    render: StateLossConfig = field(default_factory=StateLossConfig)
    densify_every: int = 150
    """Steps between densifications."""
    min_opacity: float = 0.02
    """Gaussians fainter than this are pruned: a wrong label fades, its neighbours fill in."""
    frame: Literal["first", "between"] = "first"
    """first: the canonical Gaussians are those of state 0. between: they stand anywhere between the states, and every
    part moves from there to each state (eq. 13; paper): averaged Gaussians of parts whose motion nobody knows yet."""
    identity: IdentityConfig = field(default_factory=IdentityConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    repel: RepelConfig = field(default_factory=RepelConfig)
    slots: SlotsConfig = field(default_factory=SlotsConfig)
    rates: LearningRates = field(default_factory=lambda: LearningRates(means=2e-3))


@dataclass(frozen=True)
class Articulation:
    """Canonical Gaussians and where their parts are in each state."""

    gaussians: Gaussians
    """In the frame of state 0, hard part ids."""
    T_state_0: np.ndarray
    """(states, parts, 4, 4) float64; identity in state 0 and for the base."""
    state_sh: Tensor
    """(states, n, 3) offset of the constant colour coefficient in each state; zero in state 0."""


def articulate(
    canonical: Gaussians,
    T_state_0: np.ndarray,
    views: Sequence[Sequence[View]],
    config: ArticulateConfig,
    *,
    fitted: Sequence[Gaussians] = (),
    maps: Sequence[Sequence[DepthMap]] = (),
    known: np.ndarray | None = None,
    seed: int = 0,
    device: torch.device | str = "cpu",
    report: Report = lambda **_: None,
) -> Articulation:
    """Optimise everything together, starting from the parts and motions given.

    The parts that come out may be fewer where ``config.identity`` is not hard: redundant slots die.

    Args:
        canonical: frame of state 0, with part ids.
        T_state_0: (states, parts, 4, 4) first motions.
        views: training photographs of every state.
        fitted: each state's own Gaussians; L_art, L_vector and displacements without parts need them.
        maps: the depth of every photograph where it is known.
        known: (movers,) bool, which first motions need no alignment; none if it is left out.
        device: where to optimise; what comes out is on the CPU.
    """
    rng = np.random.default_rng(seed)
    generator = torch.Generator().manual_seed(seed)
    low, high = np.quantile(canonical.means.numpy(), [0.002, 0.998], axis=0)
    extent = float((high - low).max())
    canonical, parts = canonical.to(device), T_state_0.shape[1]
    centres = part_centres(canonical, parts)
    first = config.frame == "first"
    poses = PoseDelta(torch.from_numpy(T_state_0).to(canonical.means), centres, extent, first_is_frame=first)
    pose_adam = torch.optim.Adam(poses.parameters, lr=config.pose_rate)
    rate = config.rates.means * extent
    identity = identity_of(canonical, parts, fitted, config.identity, extent, rate, generator)
    targets = Targets(canonical, fitted, config.physics, extent, seed)
    repulsion = Repulsion(config.repel, extent, generator)
    extra = {"state_sh": (canonical.means.new_zeros((len(canonical), len(views) - 1, 3)), config.rates.sh)}
    optimiser = GaussianAdam(canonical, config.rates, extent, extra | identity.extra | targets.extra)
    training = training_views(views, maps, device)
    if first and config.identity.kind == "hard" and config.align_steps:
        free = np.ones(parts - 1, bool) if known is None else ~known
        if free.any():
            _align(canonical, poses, free, training, fitted, extent, config, rng)
    photographs = shuffled(training, rng)
    statistics = optimiser.fresh_statistics()
    tell = averaged(report, config.steps)
    for step in range(config.steps):
        progress = step / config.steps
        state, view = next(photographs)
        R, t = poses.Rt()
        p = identity.probabilities(optimiser, progress)
        repulsion.update(optimiser.gaussians, step, config.steps)
        means = _moved(optimiser, R[state], t[state], state, p, identity, repulsion)
        loss, error = state_loss(
            optimiser, R[state], t[state], view, state, config.render, extent, means=means, statistics=statistics
        )
        loss = loss + identity.loss(optimiser, p, step)
        if state or not first:
            aim = targets.at(optimiser, p, R, t, state, step)
            g = optimiser.gaussians
            loss = loss + physics_loss(g, p, R[state], t[state], aim, config.physics, extent, generator)
        loss.backward()
        optimiser.step(progress)
        pose_step(pose_adam, config.pose_rate, progress)
        if step % config.densify_every == config.densify_every - 1 and progress < 0.7:
            grow(optimiser, statistics, config.max_gaussians, config.min_opacity, extent, generator)
            statistics = optimiser.fresh_statistics()
            identity.stale()
            targets.stale()
        tell(loss, error, len(optimiser))
    return _result(optimiser, poses, identity, extent, config, seed)


def _align(
    canonical: Gaussians,
    poses: PoseDelta,
    free: np.ndarray,
    training: Sequence[Sequence[TrainingView]],
    fitted: Sequence[Gaussians],
    extent: float,
    config: ArticulateConfig,
    rng: np.random.Generator,
) -> None:
    """Move the parts that are ``free`` (movers,) alone, before anything is painted anew.

    What the shape of a part leaves open (a round bar turned about itself) its texture tells, as long as Gaussians have
    not taken on the colours of a wrong pose. A part goes back to where it was if photographs do not like it better, or
    hardly so and its surface comes off that of the ``fitted`` Gaussians: the insides of a door, unseen so far, draw it.
    (A door that texture had put right, they drew off by 4°, and photographs liked that: its error fell to 0.65.) Then
    there is a second, gentler try.
    """
    for rate in (config.align_rate, config.align_rate / GENTLER):
        were = [correction.detach().clone() for correction in poses.parameters]
        (R, t), off = poses.Rt(), _misfits(canonical, poses, fitted, extent)
        move_parts_alone(canonical, poses, training, config.align_steps, rate, config.render.ssim_weight, rng, end=0.1)
        before, after = _mean_errors(canonical, [(R, t), poses.Rt()], thinned(training, JUDGES))
        still_on = _misfits(canonical, poses, fitted, extent) < off + ASTRAY
        good = free & ((after < BETTER * before) | ((after < before) & still_on))
        with torch.no_grad():
            for correction, was in zip(poses.parameters, were, strict=True):
                kept = torch.from_numpy(good).to(correction.device)[:, None]
                correction[:, 1:] = torch.where(kept, correction[:, 1:], was[:, 1:])
        if good[free].all():
            break


def _mean_errors(
    g: Gaussians, trials: Sequence[tuple[Tensor, Tensor]], training: Sequence[Sequence[TrainingView]]
) -> np.ndarray:
    """(trials, movers) mean of ``errors_by_part`` over the photographs that show each; infinite where none does."""
    errors = errors_by_part(g, trials, training)
    seen = np.isfinite(errors)
    return np.where(seen.any(1), np.where(seen, errors, 0).sum(1) / np.maximum(seen.sum(1), 1), np.inf)


@torch.no_grad()
def _misfits(g: Gaussians, poses: PoseDelta, fitted: Sequence[Gaussians], extent: float) -> np.ndarray:
    """(movers,) mean distance, in extents, of each part's Gaussians from the nearest of every moved state's own.

    Zero where a part has none. Infinite if no state has been fitted.
    """
    g, (R, t) = g.to("cpu"), (x.cpu() for x in poses.Rt())
    total = np.zeros(R.shape[1] - 1) if fitted else np.full(R.shape[1] - 1, np.inf)
    g = g[g.opacities > 0.5]
    for state, own in list(enumerate(fitted))[1:]:
        tree = KDTree(own.means[own.opacities > 0.5].numpy())
        for k in range(1, R.shape[1]):
            moved = g.means[g.part == k] @ R[state, k].T + t[state, k]
            if len(moved):
                distance = np.asarray(tree.query(moved.numpy(), workers=torch.get_num_threads())[0])
                total[k - 1] += np.minimum(distance / extent, FAR).mean() / (len(fitted) - 1)
    return total


def _result(
    optimiser: GaussianAdam,
    poses: PoseDelta,
    identity: Identity,
    extent: float,
    config: ArticulateConfig,
    seed: int,
) -> Articulation:
    g = optimiser.gaussians.detached().to("cpu")
    with torch.no_grad():
        R, t = (x.cpu() for x in poses.Rt())
    T = np.tile(np.eye(4), (*R.shape[:2], 1, 1))
    u, _, vt = np.linalg.svd(R.double().numpy())
    T[..., :3, :3], T[..., :3, 3] = u @ vt, t.double().numpy()
    if isinstance(identity, Free):
        part, T = parts_of_shifts(g.means, optimiser.values["shift"].detach().cpu(), T.shape[1], seed)
        g = g.with_part(part)
    if config.identity.kind != "hard":
        label, living = living_slots(g.means.numpy(), g.part.numpy(), T, extent, config.slots)
        g, T = g.with_part(torch.from_numpy(label)), T[:, living]
    g, T = (
        posed(g, dict(enumerate(T[0]))),
        T @ np.linalg.inv(T[:1]),
    )  # To state 0, where they are already if it is the frame.
    offsets = optimiser.values["state_sh"].detach().cpu().permute(1, 0, 2)
    state_sh = torch.cat([torch.zeros_like(offsets[:1]), offsets])
    return Articulation(g, T, state_sh.clone())


def _moved(
    optimiser: GaussianAdam,
    R: Tensor,
    t: Tensor,
    state: int,
    p: Tensor | None,
    identity: Identity,
    repulsion: Repulsion,
) -> Tensor | None:
    """Centres by eq. 13 and 14 in one state, or None where the hard motion without repulsion will do."""
    if isinstance(identity, Free):
        return identity.moved(optimiser, state)
    if p is None and repulsion.points is None:
        return None
    g = optimiser.gaussians
    p = one_hot(g, len(R)) if p is None else p
    return repulsion.pushed(soft_motion(g.means, p, R, t), 1 - p[:, 0])
