"""The paper's own terms of the joint optimisation (sections 4 and 5): repel points, L_art and the physics losses."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from hingesplat.gaussians import Gaussians
from hingesplat.losses.articulation import articulation_loss
from hingesplat.losses.contact import contact_loss
from hingesplat.losses.part import soft_motion
from hingesplat.losses.repel import repel_force, sample_repel_points
from hingesplat.losses.vector_field import vector_loss
from hingesplat.losses.velocity import fit_parts, velocity_loss
from hingesplat.matching import nearest, one_to_one
from hingesplat.optim import GaussianAdam


@dataclass(frozen=True)
class RepelConfig:
    """Repel points on the base (section 4, eq. 14). Lengths are fractions of the object's extent."""

    points: int = 0
    """N_R; 0 leaves them out (paper: 2000; table 5)."""
    threshold: float = 0.03
    """Base closer than this to a movable part may get points."""
    noise: float = 0.0
    """σ_r of the points' places (table 11)."""
    refresh: float = 0.0
    """Fraction of the run after which points are drawn anew; 0 keeps the first (paper; its dynamic variant: 0.2, which
    is 5 000 steps of 25 000; table 12)."""
    since: float = 0.0
    """Fraction of the run after which points are drawn: from a random start, parts have to form first."""
    strength: float = 5e-4
    """k_r."""
    exponent: float = 3.0
    """p of the falloff (table 14)."""
    epsilon: float = 1e-5
    """Least distance in the denominator."""
    tau_max: float = 1e-3
    """Longest push; the paper gives none."""
    nearest: int = 32
    """Points that push a Gaussian, the nearest ones; 0 takes all as printed, at some 25 times the cost."""


@dataclass(frozen=True)
class PhysicsConfig:
    """L_art and L_phys (section 5). Weights are λ; 0 leaves a term out. All are in units of the extent."""

    art: float = 0.0
    """λ_art of L_art, alignment with the other state's own Gaussians (paper: 1.0)."""
    rotation: float = 0.1
    """λ_rot in L_art; the paper gives none."""
    contact: float = 0.0
    """λ_phys of L_contact (paper: 0.5; table 9)."""
    velocity: float = 0.0
    """λ_phys of L_velocity (paper: 0.5; table 9)."""
    velocity_form: Literal["twist", "displacement"] = "twist"
    """displacement is the loss as printed, which punishes every rotation; twist allows every rigid motion."""
    vector: float = 0.0
    """λ_phys of L_vector (paper: 0.5; table 9)."""
    vector_reduction: Literal["mean", "sum"] = "mean"
    """sum is as printed: the weight then grows with the number of Gaussians."""
    targets: Literal["nearest", "matched"] = "nearest"
    """μ¹ in L_art and L_vector. nearest: the state's Gaussian closest to the moved one. matched: one to one, found
    once on the Gaussians where they stand (paper)."""
    reach: float = 0.02
    """nearest: one farther away is no target."""
    every: int = 200
    """nearest: steps after which they are found anew."""
    matched: int = 2000
    """matched: Gaussians of each side that are paired (Hungarian, cubic in this number)."""

    @property
    def aims(self) -> bool:
        """Whether a term needs targets."""
        return bool(self.art or self.vector)


def draw_repel_points(g: Gaussians, config: RepelConfig, generator: torch.Generator) -> Tensor | None:
    """Points (n, 3) of the base that movable Gaussians are pushed off; None where there are none."""
    base = g.part == 0
    if config.points == 0 or base.all():
        return None
    return sample_repel_points(
        g.means[base],
        g.means[~base],
        N_R=config.points,
        threshold=config.threshold,
        sigma_r=config.noise,
        generator=generator,
    )


class Repulsion:
    """Repel points over a run, and the push they give."""

    def __init__(self, config: RepelConfig, extent: float, generator: torch.Generator) -> None:
        self.config, self.extent, self.generator = config, extent, generator
        self.points: Tensor | None = None
        self.drawn = -1

    def update(self, g: Gaussians, step: int, steps: int) -> None:
        """Draw points if it is time to."""
        c = self.config
        if c.points == 0 or step < c.since * steps:
            return
        if self.drawn < 0 or (c.refresh and step - self.drawn >= c.refresh * steps):
            self.points, self.drawn = draw_repel_points(g, c, self.generator), step

    def pushed(self, means: Tensor, movable: Tensor) -> Tensor:
        """Centres (n, 3), each pushed as far as it is movable (n,), in [0, 1]."""
        if self.points is None:
            return means
        c, unit = self.config, self.extent
        force = repel_force(
            means / unit, self.points / unit, c.strength, c.epsilon, c.tau_max, c.exponent, c.nearest or None
        )
        return means + unit * force * movable[:, None]


@dataclass(frozen=True)
class Aim:
    """Rows of the canonical Gaussians and where they belong in one state: μ¹ of the paper's losses."""

    rows: Tensor
    points: Tensor


class Targets:
    """Where canonical Gaussians belong in every state, judged by the states' own Gaussians."""

    def __init__(self, g: Gaussians, fitted: Sequence[Gaussians], config: PhysicsConfig, extent: float, seed: int):
        self.config, self.extent = config, extent
        self.fitted = fitted if config.aims else ()
        self.aims: list[Aim] = []
        self.extra: dict[str, tuple[Tensor, float]] = {}
        if self.fitted and config.targets == "matched":
            places = g.means.new_full((len(g), len(fitted), 3), torch.nan)
            for state, own in enumerate(fitted):
                rng = np.random.default_rng(seed)
                i, j = one_to_one(g.means.cpu().numpy(), own.means.cpu().numpy(), config.matched, rng)
                places[i, state] = own.means[j].to(places)
            # A value that is never stepped: its rows follow the Gaussians when they are split and sorted.
            self.extra = {"target": (places, 0.0)}

    def stale(self) -> None:
        """Rows have changed places."""
        self.aims = []

    @torch.no_grad()
    def at(self, optimiser: GaussianAdam, p: Tensor | None, R: Tensor, t: Tensor, state: int, step: int) -> Aim | None:
        """The targets of one state; R (states, K, 3, 3) and t (states, K, 3)."""
        if not self.fitted:
            return None
        if self.extra:
            places = optimiser.values["target"].detach()[:, state]
            rows = torch.nonzero(~places[:, 0].isnan())[:, 0]
            return Aim(rows, places[rows])
        if not self.aims or step % self.config.every == 0:
            g = optimiser.gaussians
            p = one_hot(g, R.shape[1]) if p is None else p
            self.aims = [self._nearest(g, p, R[s], t[s], own) for s, own in enumerate(self.fitted)]
        return self.aims[state]

    def _nearest(self, g: Gaussians, p: Tensor, R: Tensor, t: Tensor, own: Gaussians) -> Aim:
        moved = soft_motion(g.means, p, R, t)
        points = own.means.to(moved)
        distance, index = nearest(moved, points)
        rows = torch.nonzero(distance[:, 0] < self.config.reach * self.extent)[:, 0]
        return Aim(rows, points[index[rows, 0]])


def one_hot(g: Gaussians, parts: int) -> Tensor:
    """(n, parts) membership of hard labels."""
    return torch.nn.functional.one_hot(g.part, parts).to(g.means.dtype)


def physics_loss(
    g: Gaussians,
    p: Tensor | None,
    R: Tensor,
    t: Tensor,
    aim: Aim | None,
    config: PhysicsConfig,
    extent: float,
    generator: torch.Generator,
) -> Tensor:
    """λ_art L_art + λ_phys (L_contact + L_velocity + L_vector) of one moved state, R (K, 3, 3) and t (K, 3).

    ``p`` (n, K) is None for the hard labels of ``g``.
    """
    total = g.means.new_zeros(())
    if not (config.aims or config.contact or config.velocity):
        return total
    if p is None:
        p = one_hot(g, len(R))
    moved = soft_motion(g.means, p, R, t)
    if aim is not None and len(aim.rows):
        mu0, mu1, share = g.means[aim.rows], aim.points, p[aim.rows]
        if config.vector:
            total = total + config.vector * vector_loss(mu0, mu1, share, R, t, config.vector_reduction) / extent**2
        if config.art:
            with torch.no_grad():
                R_hat, _ = fit_parts(mu0, mu1, share)
            loss = articulation_loss(moved[aim.rows] / extent, mu1 / extent, R, R_hat, config.rotation)
            total = total + config.art * loss
    if config.velocity:
        total = total + config.velocity * velocity_loss(g.means, moved, p, form=config.velocity_form) / extent**2
    base = moved[g.part == 0].detach()
    if config.contact and len(base):
        pick = torch.randint(len(base), (2000,), generator=generator)
        for k in range(1, len(R)):
            mine = moved[g.part == k]
            if len(mine):
                few = mine[torch.randint(len(mine), (256,), generator=generator)]
                total = total + config.contact * contact_loss(few, base[pick])
    return total
