"""Which part a Gaussian belongs to while everything is optimised: as found before, embedded, by centres, or none.

A soft identity is frozen to its argmax in the end.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from scipy.cluster.vq import kmeans2
from torch import Tensor

from hingesplat.gaussians import Gaussians
from hingesplat.losses.part import nearest_neighbours, part_loss, part_probabilities
from hingesplat.losses.velocity import fit_parts
from hingesplat.matching import nearest, one_to_one
from hingesplat.optim import Adam, GaussianAdam
from hingesplat.se3 import wxyz_to_matrix

Extra = dict[str, tuple[Tensor, float]]
"""Values with one row a Gaussian that are optimised with it, and their Adam steps."""


@dataclass(frozen=True)
class IdentityConfig:
    """Part identities (section 3)."""

    kind: Literal["hard", "embedding", "centres", "none"] = "hard"
    """hard: the labels of the start. embedding: a learnable ψ, soft until ``hard_from`` (eq. 13; paper). centres: the
    Mahalanobis distance to a centre a part, as in ArtGS. none: no part parameters; every Gaussian moves by itself, and
    parts are read off the displacements at the end."""
    size: int = 8
    """Length of ψ."""
    hard_from: float = 0.7
    """Fraction of the run after which a soft identity is frozen to its argmax."""
    weight: float = 0.1
    """embedding: λ_part of the KL neighbourhood term (paper: 0.1)."""
    neighbours: int = 8
    """embedding: neighbours in the KL term."""
    rate: float = 2e-2
    """Adam step of ψ and of the centres' residuals."""


class Identity:
    """The labels found before the optimisation."""

    def __init__(self) -> None:
        self.extra: Extra = {}

    def probabilities(self, optimiser: GaussianAdam, progress: float) -> Tensor | None:
        """(n, K), or None for the hard labels of the Gaussians."""
        return None

    def loss(self, optimiser: GaussianAdam, p: Tensor | None, step: int) -> Tensor:
        return torch.zeros(())

    def stale(self) -> None:
        """Rows have changed places."""


class Embedding(Identity):
    """F(G_i) = softmax(f(ψ_i)), with the KL term to the neighbourhood."""

    def __init__(self, g: Gaussians, parts: int, config: IdentityConfig, generator: torch.Generator) -> None:
        self.config = config
        self.neighbours: Tensor | None = None
        size = max(config.size, parts)
        # Orthogonal codes scaled so that a label that is known starts with a probability of about 0.97.
        self.weight = torch.eye(parts, size, device=g.means.device) * (np.log(32.0 * parts) ** 0.5)
        psi = 0.01 * torch.randn((len(g), size), generator=generator).to(g.means)
        if (g.part > 0).any():
            psi = psi + self.weight[g.part]
        self.extra = {"psi": (psi, config.rate)}

    def probabilities(self, optimiser: GaussianAdam, progress: float) -> Tensor | None:
        if progress >= self.config.hard_from:
            return None
        p = part_probabilities(optimiser.values["psi"], self.weight, torch.zeros_like(self.weight[:, 0]))
        optimiser.part = p.detach().argmax(1)
        return p

    def loss(self, optimiser: GaussianAdam, p: Tensor | None, step: int) -> Tensor:
        if p is None:
            return torch.zeros(())
        if self.neighbours is None or step % 100 == 0:
            self.neighbours = nearest_neighbours(optimiser.gaussians.means, self.config.neighbours)
        return self.config.weight * part_loss(p, self.neighbours)

    def stale(self) -> None:
        self.neighbours = None


class Centres(Identity):
    """Softmax of −d², the Mahalanobis distance to each part's centre, cooled from 1 to 0.1.

    ArtGS adds what a hash grid and a small network say about each place; here that is a free residual a Gaussian.
    """

    def __init__(self, g: Gaussians, parts: int, config: IdentityConfig, extent: float) -> None:
        self.config = config
        self.alive = torch.bincount(g.part, minlength=parts) > 0
        centres, radii = g.means.new_zeros((parts, 3)), g.means.new_ones(parts)
        for k in g.part.unique().cpu().tolist():
            mine = g.means[g.part == k]
            centres[k] = mine.mean(0)
            radii[k] = (mine - centres[k]).norm(dim=1).max().clamp_min(0.01 * extent) / 2
        self.centres = centres.requires_grad_()
        self.log_scales = radii.log()[:, None].repeat(1, 3).requires_grad_()
        self.quats = torch.tensor([1.0, 0, 0, 0]).to(g.means).repeat(parts, 1).requires_grad_()
        self.adam = Adam((self.centres, self.log_scales, self.quats))
        self.rates = 1e-3 * extent, 1e-2, 1e-3
        self.extra = {"residual": (g.means.new_zeros((len(g), parts)), config.rate)}

    def probabilities(self, optimiser: GaussianAdam, progress: float) -> Tensor | None:
        # The gradients of the step before: this is called once a step.
        self.adam.step(*self.rates)
        if progress >= self.config.hard_from:
            return None
        away = optimiser.values["means"].detach()[:, None] - self.centres
        local = torch.einsum("nka,kab->nkb", away, wxyz_to_matrix(self.quats)) / self.log_scales.exp()
        logits = (0.5 * optimiser.values["residual"] - local.square().sum(2)).masked_fill(~self.alive, -torch.inf)
        temperature = 0.55 + 0.45 * np.cos(np.pi * progress / self.config.hard_from)
        p = (logits / temperature).softmax(1)
        optimiser.part = p.detach().argmax(1)
        return p


class Free(Identity):
    """No parts: each Gaussian has a displacement of its own in every moved state, at first that of its match."""

    def __init__(self, shift: Tensor, rate: float) -> None:
        """``shift`` (n, states − 1, 3)."""
        self.extra = {"shift": (shift, rate)}

    def moved(self, optimiser: GaussianAdam, state: int) -> Tensor:
        """Centres (n, 3) in a state."""
        means = optimiser.values["means"]
        return means + optimiser.values["shift"][:, state - 1] if state else means


def identity_of(
    g: Gaussians,
    parts: int,
    fitted: Sequence[Gaussians],
    config: IdentityConfig,
    extent: float,
    rate: float,
    generator: torch.Generator,
) -> Identity:
    """The kind that the config names; ``rate`` is the Adam step of a displacement, scene units."""
    match config.kind:
        case "embedding":
            return Embedding(g, parts, config, generator)
        case "centres":
            return Centres(g, parts, config, extent)
        case "none":
            rng = np.random.default_rng(generator.initial_seed())
            return Free(torch.stack([_matched_shift(g, own, rng) for own in fitted[1:]], 1), rate)
    return Identity()


def _matched_shift(g: Gaussians, own: Gaussians, rng: np.random.Generator, limit: int = 2000) -> Tensor:
    """(n, 3) from each Gaussian to its match in a state's own; what has none takes its nearest neighbour's way."""
    i, j = one_to_one(g.means.cpu().numpy(), own.means.cpu().numpy(), limit, rng)
    way = own.means[j].to(g.means) - g.means[i]
    return way[nearest(g.means, g.means[i])[1][:, 0]]


def parts_of_shifts(means: Tensor, shift: Tensor, parts: int, seed: int) -> tuple[Tensor, np.ndarray]:
    """Labels (n,) and T_state_0 (states, parts, 4, 4) read off displacements (n, states − 1, 3).

    What moved less than a seventh of the farthest is base; the rest is clustered by place and displacement.
    """
    length = shift.square().sum((1, 2))
    moving = length > 0.02 * length.quantile(0.99)
    part = torch.zeros(len(means), dtype=torch.int64)
    features = torch.cat([means, shift.flatten(1)], 1)[moving]
    if len(features) >= parts:
        unit = (features - features.mean(0)) / features[:, :3].std()
        label = kmeans2(unit.double().numpy(), parts - 1, rng=np.random.default_rng(seed), minit="++")[1]
        part[moving] = torch.from_numpy(np.asarray(label, np.int64)) + 1
    p = torch.nn.functional.one_hot(part, parts).double()
    T = np.tile(np.eye(4), (1 + shift.shape[1], parts, 1, 1))
    for state in range(shift.shape[1]):
        R, t = fit_parts(means.double(), (means + shift[:, state]).double(), p)
        T[state + 1, 1:, :3, :3], T[state + 1, 1:, :3, 3] = R[1:].numpy(), t[1:].numpy()
    return part, T
