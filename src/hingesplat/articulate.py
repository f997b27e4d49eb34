"""Joint optimisation of Gaussians, part identities and part motions on the photographs of all states (sections 3–5)."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from hingesplat.capture import View
from hingesplat.gaussians import Gaussians, posed
from hingesplat.identity import Free, Identity, IdentityConfig, identity_of, parts_of_shifts
from hingesplat.losses.part import soft_motion
from hingesplat.optim import Adam, GaussianAdam, LearningRates
from hingesplat.physics import PhysicsConfig, RepelConfig, Repulsion, Targets, one_hot, physics_loss
from hingesplat.poses import (
    PoseDelta,
    StateLossConfig,
    part_centres,
    pose_step,
    state_loss,
)
from hingesplat.slots import SlotsConfig, living_slots
from hingesplat.stereo import DepthMap
from hingesplat.training import Report, averaged, grow, shuffled, training_views


@dataclass(frozen=True)
class ArticulateConfig:
    """Joint optimisation."""

    steps: int = 1000
    """Optimiser steps, each on one photograph of one state."""
    max_gaussians: int = 16_000
    """Cap on the number of canonical Gaussians."""
    pose_rate: float = 2e-4
    """Adam step of the part poses (radians, extents) at the start; decays to 2 %. Small where alignment came before:
    what one state alone shows of a part holds it, and what is painted follows."""
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
    pose_adam = Adam(poses.parameters)
    rate = config.rates.means * extent
    identity = identity_of(canonical, parts, fitted, config.identity, extent, rate, generator)
    targets = Targets(canonical, fitted, config.physics, extent, seed)
    repulsion = Repulsion(config.repel, extent, generator)
    extra = {"state_sh": (canonical.means.new_zeros((len(canonical), len(views) - 1, 3)), config.rates.sh)}
    optimiser = GaussianAdam(canonical, config.rates, extent, extra | identity.extra | targets.extra)
    training = training_views(views, maps, device)
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


def _result(
    optimiser: GaussianAdam,
    poses: PoseDelta,
    identity: Identity,
    extent: float,
    config: ArticulateConfig,
    seed: int,
) -> Articulation:
    g = optimiser.gaussians.detached().to("cpu")
    T = poses.T_state_0()
    if isinstance(identity, Free):
        part, T = parts_of_shifts(g.means, optimiser.values["shift"].detach().cpu(), T.shape[1], seed)
        g = g.with_part(part)
    # What the search has told apart stays apart, but of what was none hardly anything is left.
    slots = config.slots if config.identity.kind != "hard" else replace(config.slots, same_motion=0.0)
    label, living = living_slots(g.means.numpy(), g.part.numpy(), T, extent, slots)
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
