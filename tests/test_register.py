"""Trimmed point-to-plane registration."""

import numpy as np
import pytest
import torch

from hingesplat.register import features, normals_of, register
from hingesplat.screw import revolute
from hingesplat.stereo import Cloud
from scenes import angle_between, sheet, texture


def corner(n: int, rng: np.random.Generator) -> Cloud:
    """Three faces of a unit cube that meet in the origin, textured."""
    points, normals = [], []
    for axis in range(3):
        p = rng.uniform(0, 1, (n, 3))
        p[:, axis] = 0
        points.append(p)
        normals.append(np.broadcast_to(np.eye(3)[axis], p.shape))
    everything = np.concatenate(points)
    return Cloud(everything, np.concatenate(normals), texture(everything, 3))


def plane(n: int, rng: np.random.Generator) -> Cloud:
    """One grey face, z = 0."""
    points = np.column_stack([rng.uniform(0, 1, (n, 2)), np.zeros(n)])
    return Cloud(points, np.tile([0.0, 0, 1], (n, 1)), np.full((n, 3), 0.5))


def off(degrees: float, shift: list[float]) -> np.ndarray:
    T = revolute([1.0, -0.5, 0.7], [0.4, 0.4, 0.4], np.radians(degrees))
    T[:3, 3] += shift
    return T


@pytest.mark.parametrize("same_points", [True, False])
def test_a_small_error_is_undone(same_points: bool) -> None:
    rng = np.random.default_rng(0)
    target = corner(1500, rng)
    rows = rng.choice(len(target.points), 400, replace=False)
    fresh = corner(150, rng)
    taken = Cloud(target.points[rows], target.normals[rows], target.colours[rows]) if same_points else fresh
    T_true = revolute([0, 0, 1], [0, 0, 0], 0.5)
    moved = target.points @ T_true[:3, :3].T
    there = Cloud(moved, target.normals @ T_true[:3, :3].T, target.colours)
    start = off(3.0, [0.012, -0.012, 0.01]) @ T_true
    T = register(taken, there, start, 1.0)
    assert angle_between(start, T_true) > 2.9
    assert angle_between(T, T_true) < (0.02 if same_points else 0.2)
    assert np.linalg.norm((T - T_true)[:3, 3]) < (2e-4 if same_points else 3e-3)


def test_the_result_is_rigid() -> None:
    rng = np.random.default_rng(1)
    sheet_ = corner(500, rng)
    T = register(sheet_, sheet_, off(2.0, [0.01, 0, 0]), 1.0)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert T[3].tolist() == [0, 0, 0, 1]


def test_the_truth_stays() -> None:
    sheet_ = corner(500, np.random.default_rng(2))
    np.testing.assert_allclose(register(sheet_, sheet_, np.eye(4), 1.0), np.eye(4), atol=1e-9)


def test_directions_that_nothing_constrains_stay() -> None:
    """A plane slides and turns on itself; only its height and tilt can be told."""
    rng = np.random.default_rng(3)
    target, source = plane(4000, rng), plane(400, rng)
    start = revolute([1.0, 0.4, 0], [0.5, 0.5, 0], np.radians(1.5)) @ revolute([0, 0, 1.0], [0.5, 0.5, 0], 0.1)
    start[2, 3] += 0.01
    T = register(source, target, start, 1.0)
    height = source.points @ T[2, :3] + T[2, 3]
    assert np.abs(height).max() < 1e-3
    moved = (source.points @ (T - start)[:3, :3].T + (T - start)[:3, 3])[:, :2]
    assert np.abs(moved).max() < 0.012  # Less than the points' spacing.


def test_texture_holds_a_plane_that_could_slide() -> None:
    rng = np.random.default_rng(4)
    grey = plane(4000, rng)
    painted = Cloud(grey.points, grey.normals, texture(grey.points, 5))
    start = np.eye(4)
    start[:2, 3] = 0.015, -0.01
    T = register(painted, painted, start, 1.0)
    assert np.linalg.norm(T[:2, 3]) < 0.002


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_panel_comes_to_lie_on_the_side_it_shows(side: float) -> None:
    """Grey, and it starts on the wrong side: only normals tell the two sheets of a thin panel apart."""
    rng = np.random.default_rng(8)
    thickness = 0.02
    front, back = plane(4000, rng), plane(4000, rng)
    target = Cloud(
        np.concatenate([front.points, back.points - [0, 0, thickness]]),
        np.concatenate([front.normals, -back.normals]),
        np.concatenate([front.colours, back.colours]),
    )
    seen = plane(400, rng)
    source = Cloud(seen.points, side * seen.normals, seen.colours)
    right, wrong = (0.0, -thickness) if side > 0 else (-thickness, 0.0)
    start = np.eye(4)
    start[2, 3] = wrong
    T = register(source, target, start, 1.0)
    assert np.abs(source.points @ T[2, :3] + T[2, 3] - right).max() < 1e-3


def test_features_turn_with_the_sheet() -> None:
    sheet_ = corner(50, np.random.default_rng(9))
    T = revolute([1.0, 2.0, 0.5], [0.3, 0, 0], 0.8)
    moved = Cloud(sheet_.points @ T[:3, :3].T + T[:3, 3], sheet_.normals @ T[:3, :3].T, sheet_.colours)
    np.testing.assert_allclose(features(sheet_, T, 2.0), features(moved, np.eye(4), 2.0), atol=1e-12)


def test_too_few_pairs_leave_the_motion_alone() -> None:
    rng = np.random.default_rng(5)
    target = corner(300, rng)
    few = Cloud(target.points[:11], target.normals[:11], target.colours[:11])
    start = off(2.0, [0.01, 0, 0])
    assert np.array_equal(register(few, target, start, 1.0), start)
    far = np.eye(4)
    far[:3, 3] = 5
    assert np.array_equal(register(target, target, far, 1.0), far)


def test_outliers_are_trimmed() -> None:
    rng = np.random.default_rng(6)
    target = corner(1000, rng)
    junk = rng.uniform(0.1, 0.9, (600, 3))
    source = Cloud(
        np.concatenate([target.points[::2], junk]),
        np.concatenate([target.normals[::2], np.tile([0.0, 0, 1], (600, 1))]),
        np.concatenate([target.colours[::2], rng.uniform(0, 1, (600, 3))]),
    )
    T = register(source, target, off(2.0, [0.01, 0, 0]), 1.0)
    assert angle_between(T, np.eye(4)) < 0.1


def test_normals_are_the_thin_axes() -> None:
    rng = np.random.default_rng(7)
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    g = sheet(rng.normal(size=(50, 3)), normals, np.full((50, 3), 0.5), 0.1)
    g.quats = g.quats * torch.linspace(0.5, 2, 50)[:, None]  # Quaternions of any length.
    assert np.abs((normals_of(g) * normals).sum(1)).min() == pytest.approx(1, abs=1e-5)
