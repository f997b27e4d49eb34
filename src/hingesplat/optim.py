"""Adam over a changing set of Gaussians: densify, split, prune."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from hingesplat.gaussians import Gaussians
from hingesplat.se3 import wxyz_to_matrix

PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "sh")


@dataclass(frozen=True)
class LearningRates:
    """Adam step sizes at the start; means are in units of the object's extent."""

    means: float = 2e-3
    """Centres, times the extent; decays to 1 % over the run."""
    quats: float = 5e-3
    """Orientations; this and the rest decay to 10 %."""
    log_scales: float = 1e-2
    """Log standard deviations."""
    logit_opacities: float = 5e-2
    """Opacity logits."""
    sh: float = 1e-2
    """Spherical-harmonic coefficients (constant term; the others get a tenth)."""


class GaussianAdam:
    """Adam whose rows can be kept, dropped and added; moments follow their Gaussians.

    Args:
        extra: further values to optimise, one row a Gaussian, each with its step size.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        rates: LearningRates,
        extent: float,
        extra: Mapping[str, tuple[Tensor, float]] | None = None,
    ) -> None:
        self.rates, self.extent = rates, extent
        self.part = gaussians.part
        self.extra_rates = {name: rate for name, (_, rate) in (extra or {}).items()}
        values = {name: getattr(gaussians, name) for name in PARAMETERS}
        values |= {name: value for name, (value, _) in (extra or {}).items()}
        self._set({name: v.detach().clone() for name, v in values.items()}, {})

    def _set(self, values: Mapping[str, Tensor], moments: Mapping[str, tuple[Tensor, Tensor, Tensor]]) -> None:
        self.values = {name: v.contiguous().requires_grad_() for name, v in values.items()}
        groups = [{"params": [v], "name": name, "lr": 0.0} for name, v in self.values.items()]
        self.adam = torch.optim.Adam(groups, eps=1e-15, fused=True)
        for name, (step, first, second) in moments.items():
            self.adam.state[self.values[name]] = {"step": step, "exp_avg": first, "exp_avg_sq": second}

    def __len__(self) -> int:
        return self.values["means"].shape[0]

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians as they stand; tensors are the optimised leaves themselves."""
        return Gaussians(**{name: self.values[name] for name in PARAMETERS}, part=self.part)

    def step(self, progress: float) -> None:
        """One update; ``progress`` in [0, 1] sets the decay. Gradients are cleared."""
        for group in self.adam.param_groups:
            name = group["name"]
            base = self.extra_rates[name] if name in self.extra_rates else getattr(self.rates, name)
            floor = 0.01 if name == "means" else 0.1
            group["lr"] = base * (self.extent if name == "means" else 1.0) * floor**progress
        lobes = self.values["sh"].detach()[:, 1:]
        before = lobes.clone()
        self.adam.step()
        # Adam is blind to gradient scale: the lobes' slower pace is a fraction of its step.
        lobes.lerp_(before, 0.9)
        self.adam.zero_grad(set_to_none=True)

    def _moments(self) -> dict[str, tuple[Tensor, Tensor, Tensor]]:
        states = {name: self.adam.state.get(v) for name, v in self.values.items()}
        return {n: (s["step"], s["exp_avg"], s["exp_avg_sq"]) for n, s in states.items() if s}

    def select(self, index: Tensor) -> None:
        """Keep only the rows of ``index`` (mask or indices), in that order."""
        moments = {n: (step, m[index], v[index]) for n, (step, m, v) in self._moments().items()}
        self.part = self.part[index]
        self._set({n: v.detach()[index] for n, v in self.values.items()}, moments)

    def duplicate(self, rows: Tensor) -> None:
        """Append copies of ``rows`` (indices) with fresh moments."""
        moments = {}
        for name, (step, m, v) in self._moments().items():
            zeros = torch.zeros_like(m[rows])
            moments[name] = (step, torch.cat([m, zeros]), torch.cat([v, zeros]))
        self.part = torch.cat([self.part, self.part[rows]])
        self._set({n: torch.cat([v.detach(), v.detach()[rows]]) for n, v in self.values.items()}, moments)


@torch.no_grad()
def densify(optimiser: GaussianAdam, hot: Tensor, split_above: float, generator: torch.Generator) -> None:
    """Clone the small and split the large among the rows ``hot`` (indices).

    A large Gaussian (largest standard deviation above ``split_above``, scene units) becomes two of 1/1.6 its size,
    placed ± a draw from its own distribution; a small one is doubled in place.
    """
    g = optimiser.gaussians
    first_new = len(optimiser)
    large = g.scales[hot].amax(1) > split_above
    noise = torch.randn((int(large.sum()), 3), generator=generator) * g.scales[hot[large]]
    offset = (wxyz_to_matrix(g.quats[hot[large]]) @ noise[..., None])[..., 0]
    optimiser.duplicate(hot)
    new = first_new + torch.arange(len(hot))
    for rows, sign in ((hot[large], -1.0), (new[large], 1.0)):
        optimiser.values["log_scales"][rows] -= math.log(1.6)
        optimiser.values["means"][rows] += sign * offset


def morton_order(points: Tensor) -> Tensor:
    """Indices (n,) that sort points (n, 3) along a Z-order curve, so that neighbours share cache lines."""
    low, high = points.amin(0), points.amax(0)
    q = ((points - low) / (high - low + 1e-9) * 1023).long()
    code = torch.zeros(len(points), dtype=torch.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((q[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code.argsort()
