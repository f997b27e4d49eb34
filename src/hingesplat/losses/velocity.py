"""L_velocity: the Gaussians of a part move as one."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hingesplat.losses.part import moved_by_each_part

TINY = 1e-12


def velocity_loss(
    mu0: Float[Tensor, "n 3"],
    mu1: Float[Tensor, "n 3"],
    p: Float[Tensor, "n K"],
    form: Literal["twist", "displacement"] = "twist",
) -> Float[Tensor, ""]:
    """L_velocity = Σ_k Var{ v_i : i ∈ part k } with the trace of the covariance for Var; square units.

    ``displacement``, as printed: v_i = Δμ_i = μ_i¹ − μ_i⁰. It is zero only for parts that slide, and so it
    punishes every rotation. ``twist``: v_i is what is left of Δμ_i after the part's own rigid motion (the
    best fitting one), so it is zero for every rigid motion and only there. ``p`` one-hot or soft weighs the
    members; a part without members adds nothing.

    The fit is held constant in the backward pass, which leaves the gradient exact: at the least squares
    optimum it has none (envelope theorem).
    """
    if form == "displacement":
        v = (mu1 - mu0)[:, None].expand(-1, p.shape[1], -1)
    else:
        with torch.no_grad():
            R, t = fit_parts(mu0, mu1, p)
        v = mu1[:, None] - moved_by_each_part(mu0, R, t)
    share = p / p.sum(0).clamp_min(TINY)
    mean = (share[..., None] * v).sum(0)
    return (share * (v - mean).square().sum(-1)).sum()


def fit_parts(
    mu0: Float[Tensor, "n 3"], mu1: Float[Tensor, "n 3"], p: Float[Tensor, "n K"]
) -> tuple[Float[Tensor, "K 3 3"], Float[Tensor, "K 3"]]:
    """The rigid motion of each part that best takes its members from μ⁰ to μ¹; identity where it has none."""
    w = p + TINY
    w = w / w.sum(0)
    centre0, centre1 = w.T @ mu0, w.T @ mu1
    covariance = torch.einsum("nk,nka,nkb->kab", w, mu1[:, None] - centre1, mu0[:, None] - centre0)
    U, _, Vh = torch.linalg.svd(covariance)
    handed = torch.linalg.det(U @ Vh)[:, None, None]  # −1 would make R a reflection.
    R = torch.cat([U[..., :2], U[..., 2:] * handed], -1) @ Vh
    return R, centre1 - (R @ centre0[..., None])[..., 0]
