"""Texture goes where the motion takes it, and that of a look-alike is another, on a card drawn by rays."""

from dataclasses import replace

import numpy as np
import pytest

from card import CARD, HALF, photographs, place
from hingesplat.patches import Photograph
from hingesplat.texture import TextureConfig, carried, photographs_of
from scenes import FORWARD, scene

Pair = tuple[list[Photograph], list[Photograph]]
GRID = np.linspace(-0.7 * HALF, 0.7 * HALF, 7)
POINTS = CARD + np.array([[x, 0, z] for x in GRID for z in GRID])
EITHER_SIDE = FORWARD * np.where(np.arange(len(POINTS)) % 2, 1, -1)[:, None]
STILL = np.zeros(3)


def likeness(pair: Pair, theta: np.ndarray = STILL, kind: str = "revolute") -> np.ndarray:
    return carried(POINTS, EITHER_SIDE, place(kind)(theta)[1], pair, 1.0)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_texture_goes_along_though_the_motion_is_a_little_off(kind: str) -> None:
    off = np.array([0.01, 0.004, 0.006])
    for theta in (STILL, off):
        found = likeness(photographs(kind, part=0), theta, kind)
        assert len(found) > 20 and np.median(found) > 0.97


def test_a_look_alike_has_a_texture_of_its_own() -> None:
    found = likeness(photographs("revolute", part=0, phases=(0, 1)))
    assert len(found) > 20 and np.median(found) < 0.4


def test_light_is_no_texture() -> None:
    first, second = photographs("revolute", part=0)
    darker = [replace(p, spline=0.4 * p.spline + 0.1, slope=0.4 * p.slope) for p in second]
    np.testing.assert_allclose(likeness((first, darker)), likeness((first, second)), atol=2e-3)


def test_nothing_is_said_without_texture_or_photographs_or_of_what_is_not_there() -> None:
    assert len(likeness(photographs("revolute", part=0, contrast=0.001))) == 0
    first, second = photographs("revolute", part=0)
    assert len(likeness((first, []))) == 0
    away = carried(POINTS, EITHER_SIDE, np.eye(4), (first, second), 1.0)
    assert len(away) == 0  # There the other state shows nothing.


def test_what_one_state_shows_differently_from_place_to_place_is_gloss() -> None:
    """Each photograph of the other state shows another pattern, as a mirror does."""
    first, second = photographs("revolute", part=0)
    others = [photographs("revolute", part=0, phases=(0, 0.7 * i + 0.5))[1][i] for i in range(len(second))]
    assert len(likeness((first, others))) < 0.2 * len(likeness((first, second)))


def test_photographs_are_few_and_small_enough() -> None:
    made = scene("revolute", 96)
    config = TextureConfig(views=5, size=48)
    found = photographs_of(made.gaussians, made.views[0], config)
    assert len(found) == 5
    assert all(max(p.depth.shape) <= 48 and p.spline.shape == p.depth.shape for p in found)
    assert all(set(np.unique(p.part)) == {-1, 0} for p in found)
