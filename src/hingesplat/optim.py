"""Adam over a changing set of Gaussians: densify, split, prune."""

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
    """Adam whose rows can be kept, dropped and added; moments follow their Gaussians."""

    def __init__(self, gaussians: Gaussians, rates: LearningRates, extent: float) -> None:
        self.rates, self.extent = rates, extent
        self.part = gaussians.part
        self._set({name: getattr(gaussians, name).detach().clone() for name in PARAMETERS}, {})

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
        return Gaussians(**self.values, part=self.part)

    def step(self, progress: float) -> None:
        """One update; ``progress`` in [0, 1] sets the decay. Gradients are cleared."""
        for group in self.adam.param_groups:
            base = getattr(self.rates, group["name"])
            floor = 0.01 if group["name"] == "means" else 0.1
            scale = self.extent if group["name"] == "means" else 1.0
            group["lr"] = base * scale * floor**progress
        if self.values["sh"].grad is not None and self.values["sh"].shape[1] > 1:
            # Adam is blind to gradient scale, so slow lobes by shrinking their step through the values.
            before = self.values["sh"].detach()[:, 1:].clone()
            self.adam.step()
            with torch.no_grad():
                self.values["sh"][:, 1:] = before + 0.1 * (self.values["sh"][:, 1:] - before)
        else:
            self.adam.step()
        self.adam.zero_grad(set_to_none=True)

    def _moments(self) -> dict[str, tuple[Tensor, Tensor, Tensor]]:
        states = {name: self.adam.state.get(v) for name, v in self.values.items()}
        return {n: (s["step"], s["exp_avg"], s["exp_avg_sq"]) for n, s in states.items() if s}

    def select(self, index: Tensor) -> None:
        """Keep only the rows of ``index`` (mask or indices), in that order."""
        moments = {n: (step, m[index], v[index]) for n, (step, m, v) in self._moments().items()}
        self.part = self.part[index]
        self._set({n: v.detach()[index] for n, v in self.values.items()}, moments)

    def append(self, new: Gaussians) -> None:
        """Add Gaussians with fresh moments."""
        moments = {}
        for name, (step, m, v) in self._moments().items():
            zeros = torch.zeros_like(getattr(new, name))
            moments[name] = (step, torch.cat([m, zeros]), torch.cat([v, zeros]))
        values = {n: torch.cat([v.detach(), getattr(new, n).detach()]) for n, v in self.values.items()}
        self.part = torch.cat([self.part, new.part])
        self._set(values, moments)


def densify(
    optimiser: GaussianAdam, hot: Tensor, split_above: float, generator: torch.Generator
) -> None:
    """Clone the small and split the large among the rows ``hot`` (indices).

    A large Gaussian (largest standard deviation above ``split_above``, scene units) becomes two of 1/1.6 its size,
    placed ± a draw from its own distribution; a small one is doubled in place.
    """
    g = optimiser.gaussians.detached()
    large = g.scales[hot].amax(1) > split_above
    clones, splits = g[hot[~large]], g[hot[large]]
    noise = torch.randn(splits.means.shape, generator=generator) * splits.scales
    offset = (wxyz_to_matrix(splits.quats) @ noise[..., None])[..., 0]
    shrink = torch.log(torch.tensor(1.6))
    with torch.no_grad():
        optimiser.values["log_scales"][hot[large]] -= shrink
        optimiser.values["means"][hot[large]] -= offset
    splits.means += offset
    splits.log_scales -= shrink
    optimiser.append(clones)
    optimiser.append(splits)


def morton_order(points: Tensor) -> Tensor:
    """Indices (n,) that sort points (n, 3) along a Z-order curve, so that neighbours share cache lines."""
    low, high = points.amin(0), points.amax(0)
    q = ((points - low) / (high - low + 1e-9) * 1023).long()
    code = torch.zeros(len(points), dtype=torch.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((q[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code.argsort()
