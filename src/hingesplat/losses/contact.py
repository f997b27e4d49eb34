"""L_contact: no movable Gaussian lies behind the surface of the static base."""

import torch
from jaxtyping import Float
from torch import Tensor

from hingesplat.matching import nearest


def contact_loss(
    mu: Float[Tensor, "m 3"],
    mu_static: Float[Tensor, "s 3"],
    weights: Float[Tensor, "m"] | None = None,
) -> Float[Tensor, ""]:
    """L_contact = mean_i max(0, −cos θ_i) over the Gaussians ``mu`` of a movable part; in [0, 1].

    θ_i lies between the vectors from Gaussian i to its nearest static Gaussian and to the centroid of the
    static base. Outside, the near surface lies on the way to the centroid and θ is acute; inside it lies the
    other way. ``weights`` (m,), for example part probabilities, make it a weighted mean. Zero for an empty
    part or base. The choice of the nearest is not differentiated; the vectors to it are.

    A part that belongs inside the base (a drawer) is punished too; the paper has no remedy, so give this
    loss a small weight there.
    """
    if len(mu) == 0 or len(mu_static) == 0:
        return mu.sum() * 0
    to_surface = mu_static[nearest(mu, mu_static)[1][:, 0]] - mu
    to_centre = mu_static.mean(0) - mu
    cosine = torch.nn.functional.cosine_similarity(to_surface, to_centre, dim=-1, eps=1e-12)
    inside = cosine.neg().clamp_min(0)
    if weights is None:
        return inside.mean()
    return (weights * inside).sum() / weights.sum().clamp_min(1e-12)
