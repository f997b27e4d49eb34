"""Round things turn into themselves about their own axis, and nothing else does."""

import numpy as np
import pytest
import trimesh

from hingesplat.se3 import moved
from hingesplat.symmetry import round_about

UP = np.eye(3)[2]
SHAPES = {
    "knob": (trimesh.creation.cylinder(radius=0.1, height=0.06, sections=64), True),
    "ball": (trimesh.creation.icosphere(4, radius=0.2), True),
    "ring": (trimesh.creation.annulus(r_min=0.3, r_max=0.4, height=0.02, sections=64), True),
    "drawer": (trimesh.creation.box((0.4, 0.3, 0.1)), False),
    "square lid": (trimesh.creation.box((0.3, 0.3, 0.02)), False),
    "lever": (trimesh.creation.capsule(height=0.5, radius=0.03).apply_transform(
        trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])), False),
}  # fmt: skip


def seen(mesh: trimesh.Trimesh, noise: float = 0.0) -> np.ndarray:
    points, _ = trimesh.sample.sample_surface(mesh, 2000, seed=0)
    return np.asarray(points) + noise * np.random.default_rng(0).standard_normal((2000, 3))


@pytest.mark.parametrize("name", SHAPES)
def test_round_things_are_round(name: str) -> None:
    mesh, is_round = SHAPES[name]
    assert round_about(seen(mesh, 0.002), UP, np.zeros(3)) is is_round


@pytest.mark.parametrize(("turn", "size"), [(-2.0, 0.2), (0.4, 1.0), (2.5, 5.0)])
def test_it_does_not_depend_on_place_or_size(turn: float, size: float) -> None:
    T = trimesh.transformations.rotation_matrix(turn, [1, 0.3, -0.2]) @ np.diag([size, size, size, 1])
    T[:3, 3] = turn, -1, size
    axis = T[:3, 2] / size
    for name in ("knob", "square lid"):
        mesh, is_round = SHAPES[name]
        assert round_about(moved(seen(mesh), T), axis, T[:3, 3]) is is_round


def test_a_knob_is_not_round_about_another_line() -> None:
    points = seen(SHAPES["knob"][0])
    assert not round_about(points, np.eye(3)[0], np.zeros(3))
    assert not round_about(points, UP, np.array([0.1, 0, 0]))


def test_too_few_points_tell_nothing() -> None:
    assert not round_about(seen(SHAPES["ball"][0])[:20], UP, np.zeros(3))
