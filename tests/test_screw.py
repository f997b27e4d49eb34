"""Laws of screws: round trips at every angle, line distances."""

import numpy as np
import pytest

from hingesplat.screw import (
    Screw,
    line_distance,
    matrix_to_screw,
    prismatic,
    revolute,
    screw_to_matrix,
    slide_of,
)

ANGLES = [1e-12, 1e-8, 1e-6, 1e-3, 0.1, 1.0, 2.5, np.pi - 1e-3, np.pi - 1e-8, np.pi]


def random_unit(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


@pytest.mark.parametrize("angle", ANGLES)
def test_matrix_screw_matrix_is_the_identity(angle: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        T = screw_to_matrix(Screw(random_unit(rng), rng.normal(size=3), angle, rng.normal()))
        T[:3, 3] += rng.normal(size=3)  # Far pivots at small angles: the hard case.
        again = screw_to_matrix(matrix_to_screw(T))
        np.testing.assert_allclose(again, T, atol=5e-9)


@pytest.mark.parametrize("angle", [1e-4, 1e-2, 1.0, 3.0])
def test_screw_matrix_screw_is_the_identity(angle: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        axis, pivot, slide = random_unit(rng), rng.normal(size=3), rng.normal()
        found = matrix_to_screw(screw_to_matrix(Screw(axis, pivot, angle, slide)), near=pivot)
        np.testing.assert_allclose(found.axis, axis, atol=1e-9)
        np.testing.assert_allclose(found.pivot, pivot, atol=1e-9 / angle)
        np.testing.assert_allclose([found.angle, found.slide], [angle, slide], atol=1e-9)


def test_a_slide_is_a_slide_and_the_identity_is_nothing() -> None:
    s = matrix_to_screw(prismatic((0, 0, 2), -0.3), near=(1, 2, 3))
    assert (s.angle, s.slide) == (0, 0.3)
    np.testing.assert_allclose(s.axis, (0, 0, -1))
    np.testing.assert_allclose(s.pivot, (1, 2, 3))
    nothing = matrix_to_screw(np.eye(4))
    assert (nothing.angle, nothing.slide) == (0, 0)
    assert np.linalg.norm(nothing.axis) == 1


def test_the_pivot_is_the_axis_point_nearest_to_near() -> None:
    T, near = revolute((1, 2, -1), (0.3, 0.1, 2), 0.7), np.array([5.0, -4, 1])
    s = matrix_to_screw(T, near)
    assert line_distance(s.pivot, s.axis, (0.3, 0.1, 2), (1, 2, -1)) < 1e-12
    assert abs(s.axis @ (near - s.pivot)) < 1e-12


def test_revolute_is_right_handed_and_keeps_its_pivot() -> None:
    T = revolute((0, 0, 5), (1, 0, 0), np.pi / 2)
    np.testing.assert_allclose(T @ [2, 0, 0, 1], [1, 1, 0, 1], atol=1e-12)
    np.testing.assert_allclose(T @ [1, 0, 7, 1], [1, 0, 7, 1], atol=1e-12)


def test_angles_about_one_axis_add_up() -> None:
    def turn(angle: float) -> np.ndarray:
        return revolute((1, 1, 0), (0, 2, 1), angle)

    np.testing.assert_allclose(turn(0.4) @ turn(1.1), turn(1.5), atol=1e-12)
    np.testing.assert_allclose(turn(-0.4), np.linalg.inv(turn(0.4)), atol=1e-12)


def test_an_axis_without_length_is_refused() -> None:
    with pytest.raises(ValueError, match="no direction"):
        revolute((0, 0, 0), (0, 0, 0), 1.0)
    with pytest.raises(ValueError, match="no direction"):
        line_distance((0, 0, 0), (1, 0, 0), (0, 0, 0), (0, 0, 0))


def test_line_distance() -> None:
    assert line_distance((0, 0, 0), (1, 0, 0), (5, 5, 2), (0, 3, 0)) == pytest.approx(2)
    assert line_distance((0, 0, 0), (1, 0, 0), (9, 3, 4), (-2, 0, 0)) == pytest.approx(5)
    assert line_distance((0, 0, 0), (1, 0, 0), (9, 3, 4), (-1, 1e-9, 0)) == pytest.approx(5)
    assert line_distance((0, 0, 0), (1, 1, 0), (2, 2, 0), (1, -1, 0)) == pytest.approx(0, abs=1e-12)


def test_what_only_slides_has_a_direction() -> None:
    way = np.array([0.6, 0, -0.8])
    np.testing.assert_allclose(slide_of([np.eye(4), prismatic(way, 0.1), prismatic(way, 0.3)]), way, atol=1e-12)
    np.testing.assert_allclose(slide_of([prismatic(way, -0.2)]), -way, atol=1e-12)
    assert slide_of([np.eye(4)]) is None
    assert slide_of([prismatic(way, 0.1), revolute(way, np.zeros(3), 0.01)]) is None
