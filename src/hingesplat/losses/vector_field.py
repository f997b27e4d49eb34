"""L_vector: the motion field of a part is the one its rigid transform predicts."""

from typing import Literal

from jaxtyping import Float
from torch import Tensor

from hingesplat.losses.part import moved_by_each_part


def vector_loss(
    mu0: Float[Tensor, "n 3"],
    mu1: Float[Tensor, "n 3"],
    p: Float[Tensor, "n K"],
    R: Float[Tensor, "K 3 3"],
    t: Float[Tensor, "K 3"],
    reduction: Literal["mean", "sum"] = "mean",
) -> Float[Tensor, ""]:
    """L_vector = Σ_k Σ_i p_{i,k} ‖R_k μ_i⁰ + t_k − μ_i¹‖², square units.

    ``p`` one-hot gives the printed sum over i ∈ k; soft ``p`` its expectation. ``sum`` is as printed;
    ``mean`` divides by n, so that "equal weights" with the other physics losses holds for any n.
    """
    total = (p * (moved_by_each_part(mu0, R, t) - mu1[:, None]).square().sum(-1)).sum()
    return total if reduction == "sum" else total / max(len(mu0), 1)
