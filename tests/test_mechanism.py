"""How odd a joint is: hinges away from what they turn, slides slantwise to a plate."""

from dataclasses import replace

import numpy as np
import pytest

from hingesplat.hypotheses import IMPOSSIBLE
from hingesplat.mechanism import AROUND, AWAY, SLANTED, oddity
from hingesplat.search import Motion

DOOR = np.stack(np.meshgrid(np.linspace(0, 0.4, 21), [0.0], np.linspace(0, 0.6, 31)), -1).reshape(-1, 3)
"""A plate that looks along y, 0.4 wide from x = 0, of an object of extent 1."""


def hinge(at: float, by: float = 0.5) -> Motion:
    return Motion("revolute", np.array([0.0, 0.0, 1.0]), np.array([at, 0.0, 0.0]), by, 1.0)


def slide(direction: list[float], by: float = 0.3) -> Motion:
    return Motion("prismatic", np.array(direction) / np.linalg.norm(direction), np.zeros(3), by, 1.0)


@pytest.mark.parametrize(("at", "least", "most"), [(0, 0, 0.01), (0.2, 0, 0.01), (-0.1, 0, 0.5), (-0.5, 50, 1000)])
def test_a_hinge_is_at_what_it_turns(at: float, least: float, most: float) -> None:
    """At its edge, in its middle, a little beside it; and one about which a door would come to be where another is."""
    assert least <= oddity(hinge(at), DOOR, DOOR, 1.0) <= most


def test_a_hinge_turns_by_no_more_than_it_has_to() -> None:
    """A round lever that was a third of a turn about itself farther would look the same."""
    small, large, most = (oddity(hinge(0, by), DOOR, DOOR, 1.0) for by in (1.2, 2.2, np.pi))
    assert small < 0.1 < 0.4 < large < 1 < most < IMPOSSIBLE


def test_a_slide_goes_along_or_across_a_plate() -> None:
    """A sliding door, a drawer's front; and neither, but the less so the less it goes."""
    assert oddity(slide([1, 0, 0]), DOOR, DOOR, 1.0) < 1e-9
    assert oddity(slide([0, -1, 0]), DOOR, DOOR, 1.0) < 1e-9
    assert oddity(slide([1, 1, 0]), DOOR, DOOR, 1.0) == pytest.approx((0.3 * np.sqrt(0.5) / SLANTED) ** 4)
    assert oddity(slide([1, 1, 0], 0.05), DOOR, DOOR, 1.0) < 0.1


def test_nothing_is_odd_about_what_nobody_saw() -> None:
    """Without points, and without a plate, nothing speaks against a joint."""
    assert oddity(hinge(9, 0), DOOR[:0], DOOR[:0], 1.0) == oddity(slide([1, 1, 0]), DOOR, DOOR[:0], 1.0) == 0
    assert oddity(hinge(9), DOOR[:0], DOOR[:0], 1.0) == pytest.approx((0.5 / AROUND) ** 4)


def test_oddity_knows_no_units_and_no_direction() -> None:
    """An object ten times as large, and a joint the other way round, are as odd."""
    for motion in (hinge(-AWAY), slide([1, 0.4, 0])):
        once = oddity(motion, DOOR, DOOR, 1.0)
        size = 1 if motion.kind == "revolute" else 10
        larger = replace(motion, pivot=10 * motion.pivot, value=size * motion.value)
        back = replace(motion, axis=-motion.axis, value=-motion.value)
        assert oddity(larger, 10 * DOOR, 10 * DOOR, 10.0) == pytest.approx(once)
        assert oddity(back, DOOR, DOOR, 1.0) == pytest.approx(once)
