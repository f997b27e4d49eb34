"""The optimiser's rows: kept, doubled and split without losing what Adam knew of them."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from hingesplat.gaussians import Gaussians
from hingesplat.optim import Adam, GaussianAdam, LearningRates, Moments, densify, morton_order
from hingesplat.se3 import matrix_to_wxyz, rotvec_to_matrix
from scenes import box

EXTENT = 2.0


@pytest.fixture
def g() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def some(g: torch.Generator, n: int = 6) -> Gaussians:
    return Gaussians(
        means=torch.randn((n, 3), generator=g),
        quats=torch.randn((n, 4), generator=g),
        log_scales=torch.randn((n, 3), generator=g) - 3,
        logit_opacities=torch.randn(n, generator=g),
        sh=torch.randn((n, 4, 3), generator=g),
        part=torch.arange(n),
    )


def optimiser_of(gaussians: Gaussians) -> GaussianAdam:
    extra = {"psi": (torch.arange(len(gaussians)).float()[:, None].repeat(1, 2), 0.1)}
    return GaussianAdam(gaussians, LearningRates(), EXTENT, extra)


def step(optimiser: GaussianAdam, gradients: dict[str, Tensor], progress: float = 0.3) -> None:
    for name, value in optimiser.values.items():
        value.grad = gradients[name].clone()
    optimiser.step(progress)


def gradients_for(optimiser: GaussianAdam, g: torch.Generator) -> dict[str, Tensor]:
    return {name: torch.randn(v.shape, generator=g) for name, v in optimiser.values.items()}


def test_the_order_of_a_tensor_in_memory_does_not_matter(g: torch.Generator) -> None:
    start, offsets = some(g), torch.randn((2, 6, 3), generator=g).permute(1, 0, 2)
    as_it_is, in_order = (
        GaussianAdam(start, LearningRates(), EXTENT, {"state_sh": (v, 0.1)}) for v in (offsets, offsets.contiguous())
    )
    for _ in range(3):
        gradients = gradients_for(in_order, g)
        step(as_it_is, gradients)
        step(in_order, gradients)
    torch.testing.assert_close(as_it_is.values["state_sh"], in_order.values["state_sh"], rtol=0, atol=0)
    assert not torch.equal(as_it_is.values["state_sh"], offsets)


def test_selecting_rows_and_stepping_commute(g: torch.Generator) -> None:
    start, index = some(g), torch.tensor([4, 0, 5])
    whole, few = optimiser_of(start), optimiser_of(start)
    for k in range(4):
        gradients = gradients_for(whole, g)
        step(whole, gradients)
        if k == 2:
            few.select(index)
        step(few, {n: v[index] for n, v in gradients.items()} if k >= 2 else gradients)
    for name, value in whole.values.items():
        torch.testing.assert_close(few.values[name], value[index], rtol=1e-6, atol=0)
    assert few.part.tolist() == [4, 0, 5]


def test_a_mask_selects_as_indices_do(g: torch.Generator) -> None:
    a, b = optimiser_of(some(g)), optimiser_of(some(torch.Generator().manual_seed(0)))
    a.select(torch.tensor([True, False, True, False, False, True]))
    b.select(torch.tensor([0, 2, 5]))
    assert len(a) == 3
    assert torch.equal(a.gaussians.means, b.gaussians.means)


def test_doubling_leaves_the_originals_course_unchanged_and_starts_copies_afresh(g: torch.Generator) -> None:
    start, rows = some(g), torch.tensor([1, 3])
    alone, doubled = optimiser_of(start), optimiser_of(start)
    first = gradients_for(alone, g)
    step(alone, first)
    step(doubled, first)
    doubled.duplicate(rows)
    assert len(doubled) == 8
    assert doubled.part.tolist() == [0, 1, 2, 3, 4, 5, 1, 3]
    for name, value in doubled.values.items():
        torch.testing.assert_close(value[6:], alone.values[name][rows], rtol=0, atol=0)
        moments = doubled.moments[name]
        assert moments.first[6:].abs().max() == 0 and moments.second[6:].abs().max() == 0
        assert moments.first[:6].abs().min() > 0
    second = gradients_for(alone, g)
    step(alone, second)
    step(doubled, {n: torch.cat([v, v[rows]]) for n, v in second.items()})
    for name, value in alone.values.items():
        torch.testing.assert_close(doubled.values[name][:6], value, rtol=1e-6, atol=0)


def test_first_step_is_the_learning_rate_and_decays_over_the_run(g: torch.Generator) -> None:
    start, rates = some(g), LearningRates()
    base = {"means": rates.means * EXTENT, "quats": rates.quats, "log_scales": rates.log_scales, "psi": 0.1}
    for progress in (0.0, 0.5, 1.0):
        optimiser = optimiser_of(start)
        before = {n: v.detach().clone() for n, v in optimiser.values.items()}
        step(optimiser, {n: torch.full_like(v, 7.0) for n, v in optimiser.values.items()}, progress)
        for name, rate in base.items():
            moved = before[name] - optimiser.values[name].detach()
            expected = rate * (0.01 if name == "means" else 0.1) ** progress
            torch.testing.assert_close(moved, torch.full_like(moved, expected), rtol=2e-2, atol=2e-7)
        assert all(v.grad is None for v in optimiser.values.values())


def test_a_few_tensors_step_at_rates_of_their_own() -> None:
    values = [torch.zeros(3).requires_grad_(), torch.zeros((2, 2)).requires_grad_()]
    adam = Adam(values)
    for v in values:
        v.grad = torch.full_like(v, 7.0)
    adam.step(0.1, 0.2)
    for v, rate in zip(values, (0.1, 0.2), strict=True):
        # Adam's first step is the rate.
        torch.testing.assert_close(v.detach(), torch.full_like(v, -rate), rtol=1e-5, atol=0)
        assert v.grad is None
    adam.step(0.1, 0.2)  # Without gradients nothing happens.
    assert values[0].detach().tolist() == pytest.approx([-0.1] * 3, rel=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("threads", [1, 3])
def test_a_step_is_torchs_own(g: torch.Generator, dtype: torch.dtype, threads: int, monkeypatch) -> None:
    monkeypatch.setattr("hingesplat.optim.NUMBERS_PER_THREAD", 100)
    ours = torch.randn((301, 3), generator=g, dtype=dtype).requires_grad_()
    theirs = ours.detach().clone().requires_grad_()
    adam = torch.optim.Adam([theirs], lr=0.03, eps=1e-15)
    moments = Moments.of(ours.detach())
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        for k in range(6):
            gradient = torch.randn(ours.shape, generator=g, dtype=dtype) * (k != 3)
            ours.grad, theirs.grad = gradient.clone(), gradient.clone()
            moments.step(ours, 0.03)
            adam.step()
            moments.step(ours, 0.03)  # Without a gradient nothing happens.
    finally:
        torch.set_num_threads(before)
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


def test_lobes_go_a_tenth_as_fast_as_the_constant_colour(g: torch.Generator) -> None:
    optimiser = optimiser_of(some(g))
    before = optimiser.values["sh"].detach().clone()
    step(optimiser, {n: torch.ones_like(v) for n, v in optimiser.values.items()})
    moved = (before - optimiser.values["sh"].detach()).mean((0, 2))
    torch.testing.assert_close(moved[1:] / moved[0], torch.full((3,), 0.1), rtol=1e-3, atol=0)


def needle(length: float) -> Gaussians:
    """One thin Gaussian, long in its own x, which a quarter turn about z lays along the world's y."""
    turn = rotvec_to_matrix(torch.tensor([[0.0, 0.0, math.pi / 2]]))
    return Gaussians(
        means=torch.tensor([[1.0, 2.0, 3.0]]),
        quats=matrix_to_wxyz(turn),
        log_scales=torch.tensor([[length, 1e-7, 1e-7]]).log(),
        logit_opacities=torch.zeros(1),
        sh=torch.zeros((1, 1, 3)),
        part=torch.tensor([2]),
    )


def test_a_large_gaussian_splits_along_itself_about_its_centre(g: torch.Generator) -> None:
    optimiser = GaussianAdam(needle(0.5), LearningRates(), EXTENT)
    densify(optimiser, torch.tensor([0]), 0.1, g)
    made = optimiser.gaussians.detached()
    offset = made.means - torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(offset[0], -offset[1])
    assert offset[:, 1].abs().min() > 1e-3 and offset[:, [0, 2]].abs().max() < 1e-5
    torch.testing.assert_close(made.scales[:, 0], torch.full((2,), 0.5 / 1.6))
    assert made.part.tolist() == [2, 2]


def test_splits_scatter_as_their_own_distribution() -> None:
    draws = []
    for seed in range(200):
        optimiser = GaussianAdam(needle(0.5), LearningRates(), EXTENT)
        densify(optimiser, torch.tensor([0]), 0.1, torch.Generator().manual_seed(seed))
        draws.append(float(optimiser.gaussians.means[1, 1].detach()) - 2)
    assert np.std(draws) == pytest.approx(0.5, rel=0.2)


def test_a_small_gaussian_is_doubled_in_place(g: torch.Generator) -> None:
    optimiser = GaussianAdam(needle(0.05), LearningRates(), EXTENT)
    densify(optimiser, torch.tensor([0]), 0.1, g)
    made = optimiser.gaussians
    assert torch.equal(made.means[0], made.means[1]) and torch.equal(made.log_scales[0], made.log_scales[1])


def test_densify_adds_one_row_for_each_hot_one_and_spares_the_others(g: torch.Generator) -> None:
    start = some(g, 10)
    optimiser = optimiser_of(start)
    hot = torch.tensor([7, 2, 9])
    densify(optimiser, hot, float(start.scales.amax(1).median()), g)
    assert len(optimiser) == 13
    assert all(len(v) == 13 and v.requires_grad for v in optimiser.values.values())
    assert optimiser.part[10:].tolist() == [7, 2, 9]
    cold = [i for i in range(10) if i not in hot.tolist()]
    for name in ("means", "log_scales", "sh"):
        assert torch.equal(optimiser.values[name][cold], getattr(start, name)[cold])


def test_morton_order_is_a_permutation_that_keeps_neighbours_near() -> None:
    points = box((0, 0, 0), (1, 2, 1), 0.1, seed=0).means
    points = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(1))]
    order = morton_order(points)
    assert sorted(order.tolist()) == list(range(len(points)))

    def walk(p: Tensor) -> float:
        return float((p[1:] - p[:-1]).norm(dim=1).mean())

    assert walk(points[order]) < 0.3 * walk(points)


def test_morton_order_bears_points_that_coincide() -> None:
    assert sorted(morton_order(torch.zeros((5, 3))).tolist()) == [0, 1, 2, 3, 4]
