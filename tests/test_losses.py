"""Laws of the paper's losses: gradients in float64, zero at the truth and above it elsewhere, invariances."""

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError
from torch import Tensor
from torch.autograd import gradcheck
from torch.nn.functional import one_hot

from hingesplat import se3
from hingesplat.losses.articulation import articulation_loss, rotation_angle
from hingesplat.losses.contact import contact_loss
from hingesplat.losses.part import nearest_neighbours, part_loss, part_probabilities, soft_motion
from hingesplat.losses.repel import repel_force, sample_repel_points
from hingesplat.losses.vector_field import vector_loss
from hingesplat.losses.velocity import velocity_loss

N, K = 12, 3


@pytest.fixture
def g() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def randn(g: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=g, dtype=torch.float64)


def leaf(x: Tensor) -> Tensor:
    return x.clone().requires_grad_()


def rotations(g: torch.Generator, k: int = K) -> Tensor:
    return se3.rotvec_to_matrix(randn(g, k, 3))


def soft(g: torch.Generator) -> Tensor:
    return randn(g, N, K).softmax(-1)


def hard() -> Tensor:
    return one_hot(torch.arange(N) % K, K).double()


def rigid(g: torch.Generator) -> Tensor:
    return se3.from_Rt(rotations(g, 1)[0], randn(g, 3))


# Part identity and soft motion.


def test_part_probabilities_are_probabilities_with_gradients(g: torch.Generator) -> None:
    psi, weight, bias = leaf(randn(g, N, 4)), leaf(randn(g, K, 4)), leaf(randn(g, K))
    torch.testing.assert_close(part_probabilities(psi, weight, bias).sum(1), torch.ones(N, dtype=torch.float64))
    assert gradcheck(part_probabilities, (psi, weight, bias))


def test_nearest_neighbours_leave_out_oneself_even_among_duplicates(g: torch.Generator) -> None:
    mu = randn(g, N, 3)
    mu[3:7] = mu[3]
    index = nearest_neighbours(mu, 4)
    assert index.shape == (N, 4)
    assert not (index == torch.arange(N)[:, None]).any()
    brute = torch.cdist(mu, mu).fill_diagonal_(torch.inf).topk(4, largest=False).values
    torch.testing.assert_close((mu[:, None] - mu[index]).norm(dim=-1).sort(1).values, brute)
    assert nearest_neighbours(mu[:3], 8).shape == (3, 2)


def test_part_loss_is_zero_for_agreement_and_positive_else(g: torch.Generator) -> None:
    index = nearest_neighbours(randn(g, N, 3), 4)
    assert part_loss(soft(g)[:1].expand(N, K), index).item() == pytest.approx(0, abs=1e-12)
    assert part_loss(soft(g), index) > 1e-3
    certain = one_hot(torch.zeros(N, dtype=torch.int64), K).double()
    assert part_loss(certain, index) == 0
    certain[0] = certain[0].roll(1)  # One Gaussian against its whole neighbourhood: large, but finite.
    assert 1 < part_loss(certain, index) < 100
    assert gradcheck(lambda x: part_loss(x.softmax(-1), index), (leaf(randn(g, N, K)),))


def test_soft_motion_of_certain_gaussians_is_the_motion_of_their_part(g: torch.Generator) -> None:
    mu, R, t, repel = randn(g, N, 3), rotations(g), randn(g, K, 3), randn(g, N, 3)
    k = torch.arange(N) % K
    expected = (R[k] @ mu[..., None])[..., 0] + t[k]
    torch.testing.assert_close(soft_motion(mu, hard(), R, t), expected)
    torch.testing.assert_close(soft_motion(mu, hard(), R, t, repel), expected + repel)


def test_soft_motion_moves_with_the_frame(g: torch.Generator) -> None:
    mu, p, T, A = randn(g, N, 3), soft(g), se3.from_Rt(rotations(g), randn(g, K, 3)), rigid(g)
    moved = se3.apply(A, soft_motion(mu, p, T[:, :3, :3], T[:, :3, 3]))
    T2 = A @ T @ se3.inverse(A)
    torch.testing.assert_close(soft_motion(se3.apply(A, mu), p, T2[:, :3, :3], T2[:, :3, 3]), moved)


def test_gradients_of_soft_motion(g: torch.Generator) -> None:
    inputs = (randn(g, N, 3), soft(g), rotations(g), randn(g, K, 3), randn(g, N, 3))
    assert gradcheck(soft_motion, tuple(map(leaf, inputs)))


def test_shapes_in_annotations_are_checked_here(g: torch.Generator) -> None:
    """If this fails, the type checks of the whole suite are off: see addopts in pyproject.toml."""
    with pytest.raises(TypeCheckError):
        part_loss(soft(g), nearest_neighbours(randn(g, N + 1, 3), 4))


# L_art.


def test_rotation_angle_is_the_angle_and_never_nan() -> None:
    axis = torch.nn.functional.normalize(torch.tensor([1.0, -2, 0.5], dtype=torch.float64), dim=0)
    for angle in (0.0, 1e-7, 1e-3, 1.0, 3.0, np.pi):
        v = leaf(axis * angle)
        found = rotation_angle(torch.eye(3, dtype=torch.float64)[None], se3.rotvec_to_matrix(v)[None])
        assert found.item() == pytest.approx(angle, abs=1e-9)
        found.sum().backward()
        assert v.grad is not None
        assert v.grad.isfinite().all()
        if 1e-7 < angle < 3.1:
            torch.testing.assert_close(v.grad, axis, atol=1e-6, rtol=0)


def test_articulation_loss(g: torch.Generator) -> None:
    mu, R = randn(g, N, 3), rotations(g)
    assert articulation_loss(mu, mu, R, R).item() == pytest.approx(0, abs=1e-7)
    assert articulation_loss(mu + 0.1, mu, R, R).item() == pytest.approx(0.03, abs=1e-6)
    turned = se3.rotvec_to_matrix(torch.tensor([0, 0.2, 0], dtype=torch.float64))
    assert articulation_loss(mu, mu, R, R @ turned, lambda_rot=2.0).item() == pytest.approx(0.4)
    A = rigid(g)
    other, R_hat = randn(g, N, 3), rotations(g)
    torch.testing.assert_close(
        articulation_loss(se3.apply(A, mu), se3.apply(A, other), A[:3, :3] @ R, A[:3, :3] @ R_hat),
        articulation_loss(mu, other, R, R_hat),
    )
    assert gradcheck(articulation_loss, (leaf(mu), leaf(other), leaf(R), leaf(R_hat)))


# Physics: contact, velocity, vector field.


def sphere(g: torch.Generator, n: int, radius: float = 1.0) -> Tensor:
    return radius * torch.nn.functional.normalize(randn(g, n, 3), dim=-1)


def test_contact_loss_is_zero_outside_the_base_and_near_one_inside(g: torch.Generator) -> None:
    base = sphere(g, 4000)
    assert contact_loss(sphere(g, 50, 1.5), base) == 0
    inside = contact_loss(sphere(g, 50, 0.8), base)
    assert 0.8 < inside <= 1
    assert contact_loss(base[:0], base) == 0
    A = rigid(g)
    part = sphere(g, 50, 0.8)
    torch.testing.assert_close(contact_loss(se3.apply(A, part), se3.apply(A, base)), contact_loss(part, base))


def test_contact_loss_weighs_members_and_descent_leaves_the_base(g: torch.Generator) -> None:
    base = sphere(g, 500)
    part = torch.cat([sphere(g, 5, 0.7), sphere(g, 5, 1.5)])
    weights = torch.cat([torch.zeros(5), torch.ones(5)]).double()
    assert contact_loss(part, base, weights) == 0
    assert contact_loss(part, base, 1 - weights) > 0.3
    tilted = leaf(part[:5])
    before = contact_loss(tilted, base)
    before.backward()
    assert tilted.grad is not None
    assert contact_loss(tilted.detach() - 1e-3 * tilted.grad, base) < before
    assert gradcheck(contact_loss, (leaf(part), leaf(base[:50]), leaf(weights + 0.1)))


def moved_parts(g: torch.Generator, mu: Tensor, slide_only: bool = False) -> tuple[Tensor, Tensor, Tensor]:
    R = torch.eye(3, dtype=torch.float64).expand(K, 3, 3) if slide_only else rotations(g)
    t = randn(g, K, 3)
    return soft_motion(mu, hard(), R, t), R, t


def test_velocity_as_printed_punishes_rotation_and_the_twist_form_does_not(g: torch.Generator) -> None:
    mu0 = randn(g, N, 3)
    turned, _, _ = moved_parts(g, mu0)
    slid, _, _ = moved_parts(g, mu0, slide_only=True)
    assert velocity_loss(mu0, slid, hard(), "displacement").item() == pytest.approx(0, abs=1e-20)
    assert velocity_loss(mu0, turned, hard(), "displacement") > 0.1
    assert velocity_loss(mu0, slid, hard(), "twist").item() == pytest.approx(0, abs=1e-20)
    assert velocity_loss(mu0, turned, hard(), "twist").item() == pytest.approx(0, abs=1e-20)


@pytest.mark.parametrize("form", ["twist", "displacement"])
def test_velocity_loss(g: torch.Generator, form: str) -> None:
    mu0, mu1, p = randn(g, N, 3), randn(g, N, 3), soft(g)
    loss = velocity_loss(mu0, mu1, p, form)
    assert loss > 0.1
    A = rigid(g)
    torch.testing.assert_close(
        velocity_loss(se3.apply(A, mu0), se3.apply(A, mu1), p, form),
        loss,
    )
    empty = torch.cat([p, torch.zeros(N, 1, dtype=p.dtype)], 1)
    torch.testing.assert_close(velocity_loss(mu0, mu1, empty, form), loss)
    assert gradcheck(lambda *x: velocity_loss(*x, form), (leaf(mu0), leaf(mu1), leaf(p)))


def test_velocity_loss_falls_when_labels_are_mended(g: torch.Generator) -> None:
    mu0 = randn(g, N, 3)
    mu1, _, _ = moved_parts(g, mu0)
    wrong = hard()
    wrong[0] = wrong[0].roll(1)
    assert velocity_loss(mu0, mu1, wrong) > 1e-3


def test_vector_loss(g: torch.Generator) -> None:
    mu0 = randn(g, N, 3)
    mu1, R, t = moved_parts(g, mu0)
    assert vector_loss(mu0, mu1, hard(), R, t).item() == pytest.approx(0, abs=1e-20)
    off = vector_loss(mu0, mu1 + 0.1, hard(), R, t)
    assert off.item() == pytest.approx(0.03)
    assert vector_loss(mu0, mu1 + 0.1, hard(), R, t, "sum").item() == pytest.approx(0.03 * N)
    A = rigid(g)
    T2 = A @ se3.from_Rt(R, t) @ se3.inverse(A)
    torch.testing.assert_close(
        vector_loss(se3.apply(A, mu0), se3.apply(A, mu1 + 0.1), hard(), T2[:, :3, :3], T2[:, :3, 3]), off
    )
    assert gradcheck(vector_loss, tuple(map(leaf, (mu0, mu1, soft(g), R, t))))


# Repel points.


def test_a_gaussian_is_pushed_away_from_a_repel_point(g: torch.Generator) -> None:
    """The sign: equation 14 as printed fails this."""
    r = randn(g, 1, 3)
    mu = r + 0.05 * sphere(g, 20)
    force = repel_force(mu, r)
    assert ((mu - r) * force).sum(1).min() > 0
    assert ((mu + force - r).norm(dim=1) > (mu - r).norm(dim=1)).all()


def test_repulsion_lowers_penetration(g: torch.Generator) -> None:
    """Two solid balls overlap by a third of a diameter; the mean force, as eq. 13 adds it, parts them."""
    base, part = (sphere(g, 600) * torch.rand(600, 1, generator=g, dtype=torch.float64) ** (1 / 3) for _ in "ab")
    part = part + torch.tensor([1.4, 0, 0], dtype=torch.float64)

    def penetration(mu: Tensor) -> float:
        return (mu.norm(dim=1) < 1).double().mean().item()

    r = sample_repel_points(base, part, N_R=300, generator=g)
    after = part
    for _ in range(100):
        after = after + repel_force(after, r, tau_max=0.05).mean(0)
    assert penetration(part) > 0.08
    assert penetration(after) < 0.02


@pytest.mark.parametrize("exponent", [2.0, 3.0, 4.0])
def test_falloff_floor_and_ceiling_of_the_force(exponent: float) -> None:
    r = torch.zeros(1, 3, dtype=torch.float64)

    def size(d: float, tau_max: float = 1e12) -> float:
        mu = torch.tensor([[d, 0, 0]], dtype=torch.float64)
        return repel_force(mu, r, tau_max=tau_max, exponent=exponent).norm().item()

    assert size(0.1) == pytest.approx(5e-4 * 0.1 ** (1 - exponent))
    assert size(1e-6) == pytest.approx(5e-4 * 1e-6 / 1e-5**exponent)
    assert size(1e-6, tau_max=0.02) == pytest.approx(0.02)
    assert size(0.0) == 0


def test_the_force_is_the_printed_sum_turned_round(g: torch.Generator) -> None:
    mu, r = randn(g, N, 3), randn(g, 30, 3)
    offset = r[None] - mu[:, None]
    printed = (5e-4 * offset / offset.norm(dim=-1, keepdim=True) ** 3).sum(1)
    torch.testing.assert_close(repel_force(mu, r, tau_max=1e9, neighbours=None), -printed)
    torch.testing.assert_close(repel_force(mu, r, tau_max=1e9, neighbours=30), -printed)


def test_the_force_turns_with_the_frame_and_the_nearest_points_carry_it(g: torch.Generator) -> None:
    r = sample_repel_points(sphere(g, 800), sphere(g, 800), N_R=500, generator=g)
    mu = sphere(g, 40, 1.01)
    A = rigid(g)
    near, whole = repel_force(mu, r, tau_max=1e9), repel_force(mu, r, tau_max=1e9, neighbours=None)
    torch.testing.assert_close(repel_force(se3.apply(A, mu), se3.apply(A, r), tau_max=1e9), near @ A[:3, :3].T)
    assert torch.cosine_similarity(near, whole).median() > 0.7


@pytest.mark.parametrize("neighbours", [None, 4])
@pytest.mark.parametrize("tau_max", [1e9, 1e-3])
def test_gradients_of_the_force(g: torch.Generator, neighbours: int | None, tau_max: float) -> None:
    mu, r = leaf(randn(g, N, 3)), leaf(randn(g, 9, 3))
    assert gradcheck(lambda a, b: repel_force(a, b, tau_max=tau_max, neighbours=neighbours), (mu, r))


def test_the_force_has_finite_gradients_on_top_of_a_repel_point() -> None:
    mu = torch.zeros(2, 3, requires_grad=True)
    repel_force(mu, torch.zeros(3, 3)).sum().backward()
    assert mu.grad is not None
    assert mu.grad.isfinite().all()


def test_repel_points_lie_on_the_static_side_of_the_seam(g: torch.Generator) -> None:
    static = torch.rand(3000, 3, generator=g, dtype=torch.float64)
    movable = static + torch.tensor([1.0, 0, 0], dtype=torch.float64)
    r = sample_repel_points(static, movable, N_R=2000, threshold=0.05, generator=g)
    assert r.shape == (2000, 3)
    assert torch.cdist(r, static).amin(1).max() < 1e-6
    extent = torch.cat([static, movable]).aminmax(dim=0)
    assert torch.cdist(r, movable).amin(1).max() <= 0.05 * (extent.max - extent.min).norm()
    few = sample_repel_points(static, movable, N_R=10, threshold=0.05, generator=g)
    assert few.unique(dim=0).shape == (10, 3)


def test_repel_points_scale_with_the_object_and_repeat_with_the_seed(g: torch.Generator) -> None:
    static, movable = sphere(g, 300), sphere(g, 300) + 1

    def sample(scale: float, sigma_r: float = 0.01) -> Tensor:
        seed = torch.Generator().manual_seed(7)
        return sample_repel_points(static * scale, movable * scale, sigma_r=sigma_r, generator=seed)

    torch.testing.assert_close(sample(1000.0), 1000 * sample(1.0))
    noise = sample(1.0, 0.01) - sample(1.0, 0.0)
    extent = torch.cat([static, movable]).aminmax(dim=0)
    assert noise.std().item() == pytest.approx(0.01 * (extent.max - extent.min).norm().item(), rel=0.1)


def test_without_a_seam_there_are_no_points_and_no_force(g: torch.Generator) -> None:
    static = sphere(g, 50)
    for movable in (static + 100, static[:0]):
        r = sample_repel_points(static, movable)
        assert r.shape == (0, 3)
        assert (repel_force(static, r) == 0).all()
