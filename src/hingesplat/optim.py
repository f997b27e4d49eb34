"""Adam over a changing set of Gaussians: densify, split, prune."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numba import njit
from torch import Tensor

from hingesplat.gaussians import Gaussians
from hingesplat.se3 import wxyz_to_matrix
from hingesplat.threads import parallel

PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "sh")


@dataclass(frozen=True)
class LearningRates:
    """Adam step sizes at the start; means are in units of the object's extent."""

    means: float = 4e-3
    """Centres, times the extent; decays to 1 % over the run."""
    quats: float = 1e-2
    """Orientations; this and the rest decay to 10 %."""
    log_scales: float = 2e-2
    """Log standard deviations."""
    logit_opacities: float = 5e-2
    """Opacity logits."""
    sh: float = 2e-2
    """Spherical-harmonic coefficients (constant term; the others get a tenth)."""


BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15
NUMBERS_PER_THREAD = 2**18
"""With fewer, another thread costs more than it brings."""


@dataclass
class Moments:
    """What Adam (Kingma and Ba 2015) knows of one tensor."""

    first: Tensor
    second: Tensor
    steps: int = 0

    @staticmethod
    def of(value: Tensor) -> "Moments":
        """Of a tensor that has made no step."""
        return Moments(torch.zeros_like(value), torch.zeros_like(value))

    def step(self, value: Tensor, rate: float) -> None:
        """Move ``value`` against its gradient, and clear that; without a gradient nothing happens."""
        gradient = value.grad
        if gradient is None:
            return
        self.steps += 1
        rate = rate / (1 - BETA1**self.steps)
        shrink = 1 / math.sqrt(1 - BETA2**self.steps)
        tensors = (value.detach(), gradient.contiguous(), self.first, self.second)
        if value.device.type != "cpu" or any(t.dtype != torch.float32 for t in tensors):
            self.first.lerp_(gradient, 1 - BETA1)
            self.second.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
            value.detach().addcdiv_(self.first, (self.second.sqrt() * shrink).add_(EPSILON), value=-rate)
        else:
            threads = min(torch.get_num_threads(), 1 + value.numel() // NUMBERS_PER_THREAD)
            parallel(_adam, threads, *(t.view(-1).numpy() for t in tensors), np.float32(rate), np.float32(shrink))
        value.grad = None


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _adam(value, gradient, first, second, rate, shrink, t, threads):
    """See ``Moments.step``; flat arrays."""
    mine = slice(t * len(value) // threads, (t + 1) * len(value) // threads)
    value, gradient, first, second = value[mine], gradient[mine], first[mine], second[mine]
    beta1, beta2, epsilon, one = np.float32(BETA1), np.float32(BETA2), np.float32(EPSILON), np.float32(1)
    for i in range(len(value)):
        g = gradient[i]
        m = beta1 * first[i] + (one - beta1) * g
        v = beta2 * second[i] + (one - beta2) * g * g
        first[i], second[i] = m, v
        value[i] -= rate * m / (np.sqrt(v) * shrink + epsilon)


class Adam:
    """Adam over a few tensors. Torch's own imports its compiler first, for over a second."""

    def __init__(self, values: Sequence[Tensor]) -> None:
        self.values = values
        self.moments = [Moments.of(v) for v in values]

    def step(self, *rates: float) -> None:
        """One update, with a step size each. Gradients are cleared."""
        for value, moments, rate in zip(self.values, self.moments, rates, strict=True):
            moments.step(value, rate)


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

    def _set(self, values: Mapping[str, Tensor], moments: Mapping[str, Moments]) -> None:
        self.values = {name: v.contiguous().requires_grad_() for name, v in values.items()}
        fresh = {name: Moments.of(v) for name, v in self.values.items()}
        self.moments = fresh | dict(moments)

    def __len__(self) -> int:
        return self.values["means"].shape[0]

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians as they stand; tensors are the optimised leaves themselves."""
        return Gaussians(**{name: self.values[name] for name in PARAMETERS}, part=self.part)

    def fresh_statistics(self) -> Tensor:
        """(n, 3) zeros for ``rasterize`` to take its ``screen_gradient`` down in."""
        return torch.zeros_like(self.values["means"], requires_grad=False)

    def step(self, progress: float) -> None:
        """One update; ``progress`` in [0, 1] sets the decay. Gradients are cleared."""
        lobes = self.values["sh"].detach()[:, 1:]
        before = lobes.clone()
        for name, value in self.values.items():
            base = self.extra_rates[name] if name in self.extra_rates else getattr(self.rates, name)
            floor = 0.01 if name == "means" else 0.1
            rate = base * (self.extent if name == "means" else 1.0) * floor**progress
            self.moments[name].step(value, rate)
        if lobes.shape[1]:  # Adam is blind to gradient scale: the lobes' slower pace is a fraction of its step.
            lobes.lerp_(before, 0.9)

    def select(self, index: Tensor) -> None:
        """Keep only the rows of ``index`` (mask or indices), in that order."""
        moments = {n: Moments(m.first[index], m.second[index], m.steps) for n, m in self.moments.items()}
        self.part = self.part[index]
        self._set({n: v.detach()[index] for n, v in self.values.items()}, moments)

    def duplicate(self, rows: Tensor) -> None:
        """Append copies of ``rows`` (indices) with fresh moments."""
        moments = {}
        for name, m in self.moments.items():
            zeros = torch.zeros_like(m.first[rows])
            moments[name] = Moments(torch.cat([m.first, zeros]), torch.cat([m.second, zeros]), m.steps)
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
    noise = torch.randn((int(large.sum()), 3), generator=generator).to(g.means) * g.scales[hot[large]]
    offset = (wxyz_to_matrix(g.quats[hot[large]]) @ noise[..., None])[..., 0]
    optimiser.duplicate(hot)
    new = first_new + torch.arange(len(hot), device=hot.device)
    for rows, sign in ((hot[large], -1.0), (new[large], 1.0)):
        optimiser.values["log_scales"][rows] -= math.log(1.6)
        optimiser.values["means"][rows] += sign * offset


def morton_order(points: Tensor) -> Tensor:
    """Indices (n,) that sort points (n, 3) along a Z-order curve, so that neighbours share cache lines."""
    low, high = points.amin(0), points.amax(0)
    q = ((points - low) / (high - low + 1e-9) * 1023).long()
    code = torch.zeros_like(q[:, 0])
    for bit in range(10):
        for axis in range(3):
            code |= ((q[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code.argsort()
