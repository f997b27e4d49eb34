"""Texture goes where the motion takes it, and that of a look-alike is another, on a card drawn by rays."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from card import CARD, HALF, photographs, place
from hingesplat.patches import Photograph
from hingesplat.se3 import moved
from hingesplat.search import Motion
from hingesplat.segment import SegmentConfig, _Case
from hingesplat.surface import Surface
from hingesplat.texture import TextureConfig, carried, fitted, photographs_of, unless_still
from hingesplat.visibility import Sight
from scenes import ANGLE, AXIS, FORWARD, PIVOT, SLIDE, scene

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


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_motion_is_corrected_by_the_texture_it_carries(kind: str) -> None:
    """Axis and turn are half a degree off, the line and a slide by 0.004 and 0.006 of the extent."""
    exact = place(kind)(STILL)[1]
    value = ANGLE if kind == "revolute" else SLIDE
    right = Motion(kind, AXIS if kind == "revolute" else FORWARD, PIVOT, value, 1.0)
    np.testing.assert_allclose(right.T, exact, atol=1e-12)
    tilted = right.axis + 0.009 * np.array([1.0, 0, 0])
    aside = PIVOT + 0.004 * np.array([1.0, 0, 0])
    off = replace(right, axis=tilted / np.linalg.norm(tilted), pivot=aside, value=value + 0.006)
    surface = Surface(POINTS, 0 * POINTS, EITHER_SIDE, 0 * POINTS[:, 0], cast(Sight, None))
    found = fitted(off, surface, photographs(kind, part=0), 1.0)

    def error(motion: Motion) -> float:
        return float(np.abs(moved(POINTS, motion.T) - moved(POINTS, exact)).max())

    assert error(off) > 4e-3 and error(found) < 4e-4
    assert np.linalg.norm(found.axis) == pytest.approx(1) and found.kind == kind
    # Where texture does not go along even then, nothing is corrected.
    other = photographs(kind, part=0, phases=(0, 1))
    assert fitted(off, surface, other, 1.0) is off
    assert fitted(off, surface.rows(np.zeros(0, int)), other, 1.0) is off
    assert fitted(off, surface, ([], other[1]), 1.0) is off


def shown(pictures: list[Photograph]) -> Sight:
    """What these photographs show, without a colour."""
    P = np.stack([p.camera.K @ p.camera.T_camera_world[:3] for p in pictures]).astype(np.float32)
    depth = np.stack([p.depth for p in pictures]).astype(np.float32)
    return Sight(P, depth, np.zeros((*depth.shape, 3), np.float32), 0.012)


def corrected(off: Motion, shows: int) -> Motion:
    """The motion of a card, corrected where only this state labels it as the part's."""
    exact, pictures = place("prismatic")(STILL)[1], photographs("prismatic", part=0)
    first, second = (
        Surface(points, 0 * points, EITHER_SIDE, 0 * points[:, 0], shown(there))
        for points, there in zip((POINTS, moved(POINTS, exact)), pictures, strict=True)
    )
    labels = [np.full(len(POINTS), int(s == shows)) for s in (0, 1)]
    case = SimpleNamespace(
        problem=SimpleNamespace(surfaces=(first, second), labels=lambda _: labels),
        evidence=SimpleNamespace(rng=np.random.default_rng(0), extent=1.0),
        config=SegmentConfig(),
    )
    return _Case.corrected(cast(_Case, case), [off], pictures)[0]


@pytest.mark.parametrize("shows", [0, 1])
def test_the_texture_that_one_state_shows_of_a_part_corrects_its_motion(shows: int) -> None:
    """In the other nothing is labelled as the part's."""
    exact = place("prismatic")(STILL)[1]
    found = corrected(Motion("prismatic", FORWARD, PIVOT, SLIDE + 0.006, 1.0), shows)
    assert found.by_texture and abs(found.value - SLIDE) < 4e-4
    assert np.abs(moved(POINTS, found.T) - moved(POINTS, exact)).max() < 4e-4


@pytest.mark.parametrize("shows", [0, 1])
def test_a_correction_that_photographs_dislike_is_none(shows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a dishwasher's door had taken along of a rack turned it 2 degrees too far."""
    right = Motion("prismatic", FORWARD, PIVOT, SLIDE, 1.0)

    def too_far(motion: Motion, surface: Surface, *_: object) -> Motion:
        return replace(motion, value=motion.value * 1.5, by_texture=True) if len(surface.points) else motion

    monkeypatch.setattr("hingesplat.segment.fitted", too_far)
    found = corrected(right, shows)
    assert not found.by_texture and found.value == pytest.approx(SLIDE)


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
    assert len(likeness((first, []))) == len(likeness(([], second))) == 0
    away = carried(POINTS, EITHER_SIDE, np.eye(4), (first, second), 1.0)
    assert len(away) == 0  # There the other state shows nothing.


def test_what_one_state_shows_differently_from_place_to_place_is_gloss() -> None:
    """Each photograph of the other state shows another pattern, as a mirror does."""
    first, second = photographs("revolute", part=0)
    others = [photographs("revolute", part=0, phases=(0, 0.7 * i + 0.5))[1][i] for i in range(len(second))]
    assert len(likeness((first, others))) < 0.2 * len(likeness((first, second)))


@pytest.mark.parametrize(
    ("here", "there", "goes_back"),
    [
        ([0.95] * 8, [0.3] * 8, True),
        ([0.95] * 8 + [0.5] * 9, [0.3] * 8, False),  # Most of its texture is not where it was.
        ([0.95] * 8, [0.95] * 9, False),  # More of it has gone along.
        ([0.95] * 4, [], False),  # Too little texture to tell.
    ],
)
def test_what_a_part_gained_stays_if_its_texture_is_where_it_was(
    here: list[float], there: list[float], goes_back: bool
) -> None:
    T, owned, more = place("prismatic")(STILL)[1], np.array([0, 0, 0, 1, 2]), np.array([0, 1, 1, 1, 2])

    def likeness_of(way: np.ndarray, mine: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        gained = np.any(mine)
        assert not gained or [m.tolist() for m in mine] == [[False, True, True, False, False]] * 2
        return np.array(here if (way == np.eye(4)).all() else there) if gained else np.zeros(0)

    for labels in unless_still([T, T], (owned, owned), (more, more), likeness_of):
        np.testing.assert_array_equal(labels, owned if goes_back else more)


def test_photographs_are_few_and_small_enough() -> None:
    made = scene("revolute", 96)
    config = TextureConfig(views=5, size=48)
    found = photographs_of(made.gaussians, made.views[0], config)
    assert len(found) == 5
    assert all(max(p.depth.shape) <= 48 and p.spline.shape == p.depth.shape for p in found)
    assert all(set(np.unique(p.part)) == {-1, 0} for p in found)
