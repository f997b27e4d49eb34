"""Part identity: which Gaussian belongs to which part, smooth over neighbours; the soft motion of eq. 13."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hingesplat.matching import nearest

TINY = 1e-12


def part_probabilities(
    psi: Float[Tensor, "n d"], weight: Float[Tensor, "K d"], bias: Float[Tensor, "K"]
) -> Float[Tensor, "n K"]:
    """F(G_i) = softmax(f(ψ_i)), f one linear layer shared by all Gaussians (sec. 4.2; eq. 13's p_{i,k})."""
    return torch.nn.functional.linear(psi, weight, bias).softmax(-1)


def nearest_neighbours(mu: Float[Tensor, "n 3"], k: int) -> Int[Tensor, "n k2"]:
    """Indices (n, min(k, n − 1)) of the nearest other centres. Changes slowly in training: cache it."""
    n = mu.shape[0]
    index = nearest(mu, mu, min(k, n - 1) + 1)[1]
    itself = index == torch.arange(n, device=mu.device)[:, None]
    itself[~itself.any(1), -1] = True  # Lost among duplicates of itself: drop the farthest instead.
    return index[~itself].reshape(n, -1)


def part_loss(F: Float[Tensor, "n K"], neighbours: Int[Tensor, "n k"]) -> Float[Tensor, ""]:
    """L_part = mean_i KL( F(G_i) ‖ mean of F over the k nearest neighbours of i ), in nats; ≥ 0.

    Zero exactly where every Gaussian agrees with its neighbourhood. Gradients reach both arguments of the
    divergence. Paper: sec. 4.2.
    """
    around = F[neighbours].mean(1)
    return (F * (F.clamp_min(TINY).log() - around.clamp_min(TINY).log())).sum(1).mean()


def moved_by_each_part(
    mu: Float[Tensor, "n 3"], R: Float[Tensor, "K 3 3"], t: Float[Tensor, "K 3"]
) -> Float[Tensor, "n K 3"]:
    """R_k μ_i + t_k: where every Gaussian would be if it belonged to each part in turn."""
    return torch.einsum("kab,nb->nka", R, mu) + t


def soft_motion(
    mu: Float[Tensor, "n 3"],
    p: Float[Tensor, "n K"],
    R: Float[Tensor, "K 3 3"],
    t: Float[Tensor, "K 3"],
    F_repel: Float[Tensor, "n 3"] | None = None,
) -> Float[Tensor, "n 3"]:
    """μ_i^(t) = Σ_k p_{i,k} (R_k^(t) μ_i⁰ + t_k^(t)) + F_repel,i (eq. 13).

    With one-hot ``p`` this is the hard assignment of inference.
    """
    moved = (p[..., None] * moved_by_each_part(mu, R, t)).sum(1)
    return moved if F_repel is None else moved + F_repel
