"""Gaussians before a camera: the compiled kernels against the definition in torch."""

from dataclasses import fields

import numpy as np
import pytest
import torch
from torch import Tensor

from hingesplat.gaussians import Gaussians
from hingesplat.render.place import GAUSSIANS_PER_THREAD, Placed, place, place_by_torch
from hingesplat.se3 import rotvec_to_matrix
from scenes import look_at

CAMERA = look_at(np.array([0.4, -2.0, 0.3]), 48)
NAMES = [f.name for f in fields(Placed)]


def some(n: int, degree: int, dtype: torch.dtype) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(n + degree)
    shapes = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "logit_opacities": (n,)}
    shapes |= {"sh": (n, (degree + 1) ** 2, 3), "offset": (n, 3), "turn": (3, 3), "shift": (3, 3)}
    return {k: torch.randn(s, generator=g).to(dtype).requires_grad_() for k, s in shapes.items()}


def placed_and_gradients(placing, inputs: dict[str, Tensor], *, posed: bool, lit: bool, moved: bool) -> list[Tensor]:
    names = ("means", "quats", "log_scales", "logit_opacities", "sh")
    n = len(inputs["means"])
    g = Gaussians(**{k: inputs[k] for k in names}, part=torch.arange(n) % 3)
    pose = (rotvec_to_matrix(inputs["turn"]), inputs["shift"]) if posed else None
    means = inputs["means"] * 1.5 if moved else None
    placed = placing(g, CAMERA, pose=pose, means=means, sh_offset=inputs["offset"] if lit else None)
    out = [getattr(placed, name) for name in NAMES]
    weights = torch.Generator().manual_seed(1)
    loss = sum((o * torch.randn(o.shape, generator=weights).to(o)).sum() for o in out)
    used = [inputs[k] for k in names] + ([inputs["offset"]] if lit else []) + ([inputs["turn"]] if posed else [])
    used += [inputs["shift"]] if posed and not moved else []
    return [*out, *torch.autograd.grad(loss, used)]


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize(
    ("posed", "lit", "moved"), [(False, False, False), (True, True, False), (True, False, True), (False, True, False)]
)
def test_kernels_agree_with_torch_in_float64(degree: int, posed: bool, lit: bool, moved: bool) -> None:
    options = {"posed": posed, "lit": lit, "moved": moved}
    found = placed_and_gradients(place, some(50, degree, torch.float32), **options)
    exact = placed_and_gradients(place_by_torch, some(50, degree, torch.float64), **options)
    for a, b in zip(found, exact, strict=True):
        torch.testing.assert_close(a, b.float(), rtol=1e-4, atol=1e-4)


def test_threads_do_not_change_the_result() -> None:
    n = 2 * GAUSSIANS_PER_THREAD + 5
    before, results = torch.get_num_threads(), []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        results.append(placed_and_gradients(place, some(n, 0, torch.float32), posed=True, lit=True, moved=False))
    torch.set_num_threads(before)
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-3)


def test_other_types_go_by_the_definition() -> None:
    assert place(Gaussians(**{k: v for k, v in some(5, 0, torch.float64).items() if k in Gaussians.__annotations__},
                           part=torch.zeros(5, dtype=torch.int64)), CAMERA).means.dtype == torch.float64  # fmt: skip


def test_squared_depth_is_the_cameras_depth_squared() -> None:
    inputs = some(9, 0, torch.float32)
    g = Gaussians(**{k: inputs[k] for k in ("means", "quats", "log_scales", "logit_opacities", "sh")},
                  part=torch.zeros(9, dtype=torch.int64))  # fmt: skip
    expected = CAMERA.project(g.means.detach().double().numpy())[1] ** 2
    np.testing.assert_allclose(place(g, CAMERA).squared_depth[:, 0].detach().numpy(), expected, rtol=1e-5)
