"""Repel points: a soft wall on the static base that movable Gaussians are pushed off (eq. 14)."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from hingesplat.matching import nearest

ROWS = 1024
"""Gaussians handled at once in the full sum: 1024 × 2000 points × 3 floats are 25 MB."""


def sample_repel_points(
    mu_static: Float[Tensor, "s 3"],
    mu_movable: Float[Tensor, "m 3"],
    N_R: int = 2000,
    threshold: float = 0.03,
    sigma_r: float = 0.0,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "r 3"]:
    """N_R points (N_R, 3) drawn uniformly from the static Gaussians within a threshold of a movable one.

    ``threshold`` and ``sigma_r`` (noise, table 11) are fractions of the object's extent, the diagonal of its
    bounding box: the paper's "1.5 unit length" has no stated unit. Drawn without repeats while the region
    has enough Gaussians, else with. Where nothing is near, the result is (0, 3) and its force zero. The
    points are detached and stay as they are; to refresh them every so often (table 12) call again.
    """
    static, movable = mu_static.detach(), mu_movable.detach()
    if len(static) == 0 or len(movable) == 0:
        return static.new_zeros(0, 3)
    everything = torch.cat([static, movable])
    extent = float(torch.linalg.vector_norm(everything.amax(0) - everything.amin(0)))
    region = static[nearest(static, movable)[0][:, 0] <= threshold * extent]
    if len(region) == 0:
        return region
    if len(region) >= N_R:
        index = torch.randperm(len(region), generator=generator)[:N_R]
    else:
        index = torch.randint(len(region), (N_R,), generator=generator)
    noise = torch.randn((N_R, 3), generator=generator, dtype=static.dtype).to(static.device)
    return region[index.to(static.device)] + sigma_r * extent * noise


def repel_force(
    mu: Float[Tensor, "n 3"],
    r: Float[Tensor, "m 3"],
    k_r: float = 5e-4,
    epsilon: float = 1e-5,
    tau_max: float = 1e-3,
    exponent: float = 3.0,
    neighbours: int | None = 32,
) -> Float[Tensor, "n 3"]:
    """F_repel,i = clip( Σ_j k_r (μ_i − r_j) / max(‖r_j − μ_i‖, ε)^p, τ_max ), a displacement in scene units.

    Equation 14 with its sign turned: as printed, (r_j − μ_i) pulls Gaussians *onto* the repel points, and the
    text wants them kept off. clip(v, τ) = v · min(1, τ/‖v‖). ``exponent`` is the p of table 14. The paper
    gives no τ_max; the sum is so steep that τ_max is in effect the length of the push, so choose it small
    beside the object (the default suits a unit-sized one).

    The push is away from points, not out of a solid: a Gaussian that is already through a one-sided sheet of
    repel points is pushed on. ``contact.contact_loss`` is the term that knows inside from outside.

    Cost: ``neighbours`` keeps only that many repel points a Gaussian (found with a k-d tree): n · neighbours terms,
    without the far remainder of the sum. None takes all m points in chunks of rows that are recomputed in the
    backward pass, so memory stays flat. Differentiable in ``mu``, and in ``r``.
    """
    if len(r) == 0 or len(mu) == 0:
        return torch.zeros_like(mu)
    if neighbours is not None and neighbours < len(r):
        force = _push(mu, r[nearest(mu, r, neighbours)[1]], k_r, epsilon, exponent)
    else:
        force = torch.cat([_push_all(rows, r, k_r, epsilon, exponent) for rows in mu.split(ROWS)])
    return _clip(force, tau_max)


def _push_all(mu: Tensor, r: Tensor, k_r: float, epsilon: float, exponent: float) -> Tensor:
    pushed = checkpoint(_push, mu, r[None], k_r, epsilon, exponent, use_reentrant=False)
    assert isinstance(pushed, Tensor)
    return pushed


def _push(mu: Tensor, r: Tensor, k_r: float, epsilon: float, exponent: float) -> Tensor:
    away = mu[:, None] - r
    distance = torch.linalg.vector_norm(away, dim=-1, keepdim=True).clamp_min(epsilon)
    return (k_r * away / distance**exponent).sum(1)


def _clip(v: Tensor, tau: float) -> Tensor:
    length = torch.linalg.vector_norm(v, dim=-1, keepdim=True)
    return v * (tau / length.clamp_min(1e-12)).clamp_max(1.0)
