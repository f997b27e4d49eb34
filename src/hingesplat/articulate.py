"""Joint optimisation of Gaussians, part identities and part motions on the photographs of all states (sections 3–5)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from hingesplat.capture import View
from hingesplat.gaussians import Gaussians
from hingesplat.losses.articulation import articulation_loss
from hingesplat.losses.contact import contact_loss
from hingesplat.losses.part import nearest_neighbours, part_loss, part_probabilities, soft_motion
from hingesplat.losses.repel import repel_force, sample_repel_points
from hingesplat.losses.vector_field import vector_loss
from hingesplat.losses.velocity import fit_parts, velocity_loss
from hingesplat.optim import GaussianAdam, LearningRates
from hingesplat.poses import PoseDelta, StateLossConfig, part_centres, state_loss
from hingesplat.render import move
from hingesplat.training import Report, averaged, grow, shuffled, training_view


@dataclass(frozen=True)
class ArticulateConfig:
    """Joint optimisation. Weights of the paper's terms are its λ; 0 leaves a term out."""

    steps: int = 1000
    """Optimiser steps, each on one photograph of one state."""
    max_gaussians: int = 16_000
    """Cap on the number of canonical Gaussians."""
    pose_rate: float = 2e-3
    """Adam step of the part poses (radians, extents) at the start; decays to 2 %."""
    render: StateLossConfig = field(default_factory=StateLossConfig)
    densify_every: int = 150
    """Steps between densifications."""
    min_opacity: float = 0.02
    """Gaussians fainter than this are pruned: a wrong label fades, its neighbours fill in."""
    identity: Literal["hard", "embedding"] = "hard"
    """hard: the labels found by segmentation. embedding: a learnable identity, soft until ``hard_from`` (eq. 13)."""
    embedding_size: int = 8
    """Length of ψ."""
    hard_from: float = 0.7
    """Fraction of the run after which a soft identity is frozen to its argmax."""
    part_weight: float = 0.1
    """λ_part of the KL neighbourhood term (embedding only)."""
    neighbours: int = 8
    """Neighbours in the KL term."""
    art_weight: float = 0.0
    """λ_art: alignment with the other state's own Gaussians (paper: 1.0)."""
    contact_weight: float = 0.0
    """λ_phys of L_contact (paper: 0.5)."""
    velocity_weight: float = 0.0
    """λ_phys of L_velocity (paper: 0.5)."""
    velocity_form: Literal["twist", "displacement"] = "twist"
    """displacement is the loss as printed, which punishes every rotation."""
    vector_weight: float = 0.0
    """λ_phys of L_vector (paper: 0.5)."""
    repel: bool = False
    """Push movable Gaussians off repel points on the base (eq. 14)."""
    repel_points: int = 2000
    """N_R."""
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


@dataclass(frozen=True)
class _Targets:
    """Where each canonical Gaussian's nearest relative of its own state fit lies: μ¹ of the paper's losses."""

    rows: Tensor
    points: Tensor


def articulate(
    canonical: Gaussians,
    T_state_0: np.ndarray,
    views: Sequence[Sequence[View]],
    config: ArticulateConfig,
    *,
    fitted: Sequence[Gaussians] = (),
    seed: int = 0,
    report: Report = lambda **_: None,
) -> Articulation:
    """Optimise everything together, starting from the parts and motions that segmentation found.

    Args:
        canonical: frame of state 0, with part ids.
        T_state_0: (states, parts, 4, 4) first motions.
        views: training photographs of every state.
        fitted: each state's own Gaussians; L_art and L_vector need them, nothing else does.
    """
    rng = np.random.default_rng(seed)
    generator = torch.Generator().manual_seed(seed)
    low, high = np.quantile(canonical.means.numpy(), [0.002, 0.998], axis=0)
    extent = float((high - low).max())
    parts = T_state_0.shape[1]
    centres = part_centres(canonical, parts)
    poses = PoseDelta(torch.from_numpy(T_state_0).float(), centres, extent)
    pose_adam = torch.optim.Adam(poses.parameters, lr=config.pose_rate)
    identity = _Identity(canonical, parts, config, generator)
    extra = {"state_sh": (torch.zeros((len(canonical), len(views) - 1, 3)), config.rates.sh)}
    optimiser = GaussianAdam(canonical, config.rates, extent, extra | identity.extra)
    training = [[training_view(v) for v in state] for state in views]
    repel_points = draw_repel_points(canonical, config, generator)
    photographs = shuffled(training, rng)
    statistics = torch.zeros((len(optimiser), 3))
    targets: list[_Targets] = []
    tell = averaged(report, config.steps)
    for step in range(config.steps):
        progress = step / config.steps
        state, view = next(photographs)
        R, t = poses.Rt()
        p = identity.probabilities(optimiser, progress)
        if fitted and (not targets or step % 200 == 0) and (config.art_weight or config.vector_weight):
            targets = _match(optimiser.gaussians, poses, fitted, extent)
        means = _moved(optimiser.gaussians, R[state], t[state], p, repel_points, config)
        loss, error = state_loss(
            optimiser, R[state], t[state], view, state, config.render, extent, means=means, statistics=statistics
        )
        loss = loss + identity.loss(optimiser, p, step)
        loss = loss + _physics(optimiser.gaussians, R, t, p, targets, config, extent, state, generator)
        loss.backward()
        optimiser.step(progress)
        for group in pose_adam.param_groups:
            group["lr"] = config.pose_rate * 0.02**progress
        pose_adam.step()
        pose_adam.zero_grad(set_to_none=True)
        if identity.settle(optimiser, progress):
            statistics = torch.zeros((len(optimiser), 3))
        if step % config.densify_every == config.densify_every - 1 and progress < 0.7:
            grow(optimiser, statistics, config.max_gaussians, config.min_opacity, extent, generator)
            statistics = torch.zeros((len(optimiser), 3))
            identity.stale()
            targets = []  # Rows have changed places.
        tell(loss, error, len(optimiser))
    return _result(optimiser, poses)


def _result(optimiser: GaussianAdam, poses: PoseDelta) -> Articulation:
    with torch.no_grad():
        R, t = poses.Rt()
    T = np.tile(np.eye(4), (*R.shape[:2], 1, 1))
    u, _, vt = np.linalg.svd(R.double().numpy())
    T[..., :3, :3], T[..., :3, 3] = u @ vt, t.double().numpy()
    offsets = optimiser.values["state_sh"].detach().permute(1, 0, 2)
    state_sh = torch.cat([torch.zeros_like(offsets[:1]), offsets])
    return Articulation(optimiser.gaussians.detached(), T, state_sh.clone())


def _moved(
    g: Gaussians, R: Tensor, t: Tensor, p: Tensor | None, repel_points: Tensor | None, config: ArticulateConfig
) -> Tensor | None:
    """Centres by eq. 13 and 14, or None where the hard motion without repulsion will do."""
    if p is None and repel_points is None:
        return None
    if p is None:
        p = torch.nn.functional.one_hot(g.part, len(R)).to(g.means.dtype)
    means = soft_motion(g.means, p, R, t)
    if repel_points is None:
        return means
    force = repel_force(means, repel_points)
    return means + force * (1 - p[:, :1])


class _Identity:
    """Part identity of each Gaussian: its hard label, or softmax(f(ψ)) until it settles."""

    def __init__(self, g: Gaussians, parts: int, config: ArticulateConfig, generator: torch.Generator) -> None:
        self.config, self.settled = config, config.identity == "hard"
        self.extra: dict[str, tuple[Tensor, float]] = {}
        self.neighbours: Tensor | None = None
        if not self.settled:
            # Orthogonal codes scaled so that the found label starts with a probability of about 0.97.
            size = max(config.embedding_size, parts)
            self.weight = torch.eye(parts, size) * (np.log(32.0 * parts) ** 0.5)
            noise = 0.01 * torch.randn((len(g), size), generator=generator)
            self.extra = {"psi": (self.weight[g.part] + noise, 2e-2)}

    def probabilities(self, optimiser: GaussianAdam, progress: float) -> Tensor | None:
        if self.settled:
            return None
        return part_probabilities(optimiser.values["psi"], self.weight, torch.zeros(len(self.weight)))

    def loss(self, optimiser: GaussianAdam, p: Tensor | None, step: int) -> Tensor:
        if p is None:
            return torch.zeros(())
        if self.neighbours is None or step % 100 == 0:
            self.neighbours = nearest_neighbours(optimiser.gaussians.means, self.config.neighbours)
        return self.config.part_weight * part_loss(p, self.neighbours)

    def stale(self) -> None:
        self.neighbours = None

    def settle(self, optimiser: GaussianAdam, progress: float) -> bool:
        """Freeze to the argmax once ``hard_from`` is passed."""
        if self.settled or progress < self.config.hard_from:
            return False
        p = self.probabilities(optimiser, progress)
        assert p is not None
        optimiser.part = p.detach().argmax(1)
        self.settled = True
        return True


def draw_repel_points(g: Gaussians, config: ArticulateConfig, generator: torch.Generator) -> Tensor | None:
    """Points (n, 3) of the base that movable Gaussians are pushed off; None where the config wants none."""
    if not config.repel or not (g.part > 0).any():
        return None
    base = g.part == 0
    return sample_repel_points(g.means[base], g.means[~base], N_R=config.repel_points, generator=generator)


@torch.no_grad()
def _match(g: Gaussians, poses: PoseDelta, fitted: Sequence[Gaussians], extent: float) -> list[_Targets]:
    """For every state, the canonical Gaussians that land near one of the state's own, and where."""
    R, t = poses.Rt()
    matches = []
    for state, own in enumerate(fitted):
        moved = move(g.means, g.part, R[state], t[state])
        distance, index = map(np.asarray, KDTree(own.means.numpy()).query(moved.numpy()))
        rows = np.flatnonzero(distance < 0.02 * extent)
        matches.append(_Targets(torch.from_numpy(rows), own.means[torch.from_numpy(index[rows])]))
    return matches


def _physics(
    g: Gaussians,
    R: Tensor,
    t: Tensor,
    p: Tensor | None,
    targets: list[_Targets],
    config: ArticulateConfig,
    extent: float,
    state: int,
    generator: torch.Generator,
) -> Tensor:
    """L_art and the three physics losses for one moved state, in units of the extent."""
    total = torch.zeros(())
    if state == 0 or not (config.art_weight or config.contact_weight or config.velocity_weight or config.vector_weight):
        return total
    if p is None:
        p = torch.nn.functional.one_hot(g.part, R.shape[1]).to(g.means.dtype)
    moved = soft_motion(g.means, p, R[state], t[state])
    if targets:
        rows, points = targets[state].rows, targets[state].points
        near = rows < len(g)
        rows, points = rows[near], points[near]
        if config.vector_weight:
            total = (
                total
                + config.vector_weight * vector_loss(g.means[rows], points, p[rows], R[state], t[state]) / extent**2
            )
        if config.art_weight:
            with torch.no_grad():
                R_hat, _ = fit_parts(g.means[rows], points, p[rows])
            total = total + config.art_weight * articulation_loss(moved[rows], points, R[state], R_hat) / extent
    if config.velocity_weight:
        loss = velocity_loss(g.means, moved, p, form=config.velocity_form)
        total = total + config.velocity_weight * loss / extent**2
    if config.contact_weight:
        base = moved[g.part == 0].detach()
        pick = torch.randint(len(base), (2000,), generator=generator)
        for k in range(1, R.shape[1]):
            mine = moved[g.part == k]
            if len(mine):
                few = mine[torch.randint(len(mine), (256,), generator=generator)]
                total = total + config.contact_weight * contact_loss(few, base[pick])
    return total
