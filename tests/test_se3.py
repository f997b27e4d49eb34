"""Axioms of transforms: groups, round trips between forms, the wxyz order, gradients."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.autograd import gradcheck

from hingesplat import se3


@pytest.fixture
def g() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def randn(g: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=g, dtype=torch.float64)


def transforms(g: torch.Generator, n: int) -> Tensor:
    return se3.from_Rt(se3.rotvec_to_matrix(randn(g, n, 3)), randn(g, n, 3))


def test_transforms_are_a_group(g: torch.Generator) -> None:
    A, B, C = transforms(g, 3)
    I = torch.eye(4, dtype=torch.float64)
    torch.testing.assert_close((A @ B) @ C, A @ (B @ C))
    torch.testing.assert_close(A @ se3.inverse(A), I)
    torch.testing.assert_close(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A))


def test_apply_composes_keeps_distances_and_takes_one_transform_a_point(g: torch.Generator) -> None:
    A, B = transforms(g, 2)
    x = randn(g, 7, 3)
    torch.testing.assert_close(se3.apply(A, se3.apply(B, x)), se3.apply(A @ B, x))
    torch.testing.assert_close(torch.cdist(se3.apply(A, x), se3.apply(A, x)), torch.cdist(x, x))
    many = transforms(g, 7)
    torch.testing.assert_close(se3.apply(many, x)[4], se3.apply(many[4], x[4:5])[0])


def test_the_real_part_comes_first() -> None:
    half = math.sqrt(0.5)
    quarter_turn_about_z = torch.tensor([half, 0, 0, half])
    R = se3.wxyz_to_matrix(quarter_turn_about_z)
    torch.testing.assert_close(R @ torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]))
    torch.testing.assert_close(se3.matrix_to_wxyz(torch.eye(3)).abs(), torch.tensor([1.0, 0, 0, 0]))


def test_quaternions_and_matrices_round_trip_and_multiply_alike(g: torch.Generator) -> None:
    a, b = randn(g, 20, 4), randn(g, 20, 4)
    R = se3.wxyz_to_matrix(a)
    torch.testing.assert_close(se3.wxyz_to_matrix(5 * a), R)
    torch.testing.assert_close(se3.wxyz_to_matrix(-a), R)
    torch.testing.assert_close(se3.wxyz_to_matrix(se3.matrix_to_wxyz(R)), R)
    torch.testing.assert_close(R @ se3.wxyz_to_matrix(b), se3.wxyz_to_matrix(se3.quat_multiply(a, b)))
    eye = torch.eye(3, dtype=R.dtype).expand_as(R)
    torch.testing.assert_close(R @ R.transpose(-1, -2), eye)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, 3.1])
def test_rotation_vectors_round_trip(g: torch.Generator, angle: float) -> None:
    v = angle * torch.nn.functional.normalize(randn(g, 9, 3), dim=-1)
    back = Rotation.from_matrix(se3.rotvec_to_matrix(v).numpy()).as_rotvec()
    np.testing.assert_allclose(back, v.numpy(), atol=1e-9, rtol=1e-9)


def test_gradients_also_at_no_rotation(g: torch.Generator) -> None:
    def leaf(x: Tensor) -> Tensor:
        return x.clone().requires_grad_()

    assert gradcheck(se3.rotvec_to_matrix, (leaf(randn(g, 3, 3)),))
    assert gradcheck(se3.rotvec_to_matrix, (leaf(torch.zeros(2, 3, dtype=torch.float64)),))
    assert gradcheck(se3.wxyz_to_matrix, (leaf(randn(g, 3, 4)),))
    assert gradcheck(se3.apply, (leaf(transforms(g, 1)[0]), leaf(randn(g, 4, 3))))
