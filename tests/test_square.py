"""Directions of an object's large faces."""

import numpy as np
import pytest

from hingesplat.screw import joint_motion
from hingesplat.se3 import moved
from hingesplat.square import directions_of, nearest

AXIS = np.array([2.0, -1, 2]) / 3
TURN = joint_motion("revolute", AXIS, np.zeros(3), 0.8)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def faces(sizes: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Normals along x, y, z of faces of so many points, either side, off by a degree or two, turned together."""
    normals = np.repeat(np.eye(3)[: len(sizes)], sizes, 0) * rng.choice([-1, 1], (sum(sizes), 1))
    normals = normals + rng.normal(scale=0.02, size=normals.shape)
    return moved(normals / np.linalg.norm(normals, axis=1, keepdims=True), TURN)


@pytest.mark.parametrize("sizes", [(300, 200, 100), (300, 200)])
def test_directions_are_those_of_large_faces(sizes: tuple[int, ...], rng: np.random.Generator) -> None:
    """The largest first; of a box without lids the third is across."""
    found = directions_of(faces(sizes, rng), rng)
    cosines = np.abs(found @ moved(np.eye(3), TURN).T)
    np.testing.assert_allclose(cosines, np.eye(3), atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)


def test_a_plate_has_one_direction_and_a_ball_none(rng: np.random.Generator) -> None:
    assert len(directions_of(faces((300,), rng), rng)) == 1
    ball = rng.normal(size=(2000, 3))
    assert directions_of(ball / np.linalg.norm(ball, axis=1, keepdims=True), rng).shape == (0, 3)
    assert directions_of(np.zeros((0, 3)), rng).shape == (0, 3)


def test_the_nearest_looks_the_same_way() -> None:
    axis = np.array([-np.cos(0.1), np.sin(0.1), 0])
    found = nearest(np.eye(3), axis, 15)
    assert found is not None
    np.testing.assert_allclose(found, [-1, 0, 0])
    assert nearest(np.eye(3), axis, 3) is None and nearest(np.zeros((0, 3)), axis, 90) is None
