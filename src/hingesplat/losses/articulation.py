"""L_art: the moved Gaussians meet their targets, and the rotations meet theirs."""

import torch
from jaxtyping import Float
from torch import Tensor


def rotation_angle(R: Float[Tensor, "*K 3 3"], R_hat: Float[Tensor, "*K 3 3"]) -> Float[Tensor, "*K"]:
    """Angle (radians, 0 to π) of R⁻¹R̂. Its gradient is exact in between and zero, not NaN, at 0 and π."""
    M = R.transpose(-1, -2) @ R_hat
    twice_sine = torch.stack(
        [M[..., 2, 1] - M[..., 1, 2], M[..., 0, 2] - M[..., 2, 0], M[..., 1, 0] - M[..., 0, 1]], -1
    )
    cosine = (M.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return torch.atan2(torch.linalg.vector_norm(twice_sine, dim=-1) / 2, cosine)


def articulation_loss(
    moved: Float[Tensor, "n 3"],
    target: Float[Tensor, "n 3"],
    R: Float[Tensor, "K 3 3"],
    R_hat: Float[Tensor, "K 3 3"],
    lambda_rot: float = 0.1,
) -> Float[Tensor, ""]:
    """L_art = mean_i ‖μ_i^(1) − target_i‖² + λ_rot · mean_k angle(R_k, R̂_k); square units and radians.

    ``moved`` are the Gaussians of state 0 carried to state 1 (``part.soft_motion``), ``target`` their matches
    there, ``R_hat`` the rotations estimated from those matches (``velocity.fit_parts``). The paper gives no
    λ_rot. Means instead of sums, so that the weight holds for any number of Gaussians and parts.
    """
    return (moved - target).square().sum(-1).mean() + lambda_rot * rotation_angle(R, R_hat).mean()
