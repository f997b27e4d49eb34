"""Joints by the texture of patches, on a card whose joint is known exactly."""

from dataclasses import replace

import numpy as np
import pytest

from card import CARD, photographs, place
from hingesplat.patches import PatchConfig, Patches, _agreed, adjust, looks, patches_of, shown
from scenes import FORWARD

CONFIG = PatchConfig(per_part=60)
KNOWN = np.diag([1 / 0.03, 1 / 0.03, 1 / 0.03]) ** 2
"""How well the three numbers of a joint are known that ``place`` has: hardly."""
OFF = {"revolute": np.array([0.006, 0.004, 0.008]), "prismatic": np.array([0.008, 0.0, 0.004])}


def patches(kind: str) -> Patches:
    found = patches_of(1, photographs(kind)[0], CONFIG, np.random.default_rng(0))
    assert found is not None
    return found


def test_patches_lie_on_the_part_and_face_outwards() -> None:
    found = patches("revolute")
    assert len(found.points) > 20
    np.testing.assert_allclose(found.points[:, 1], CARD[1], atol=1e-5)
    np.testing.assert_allclose(found.normals @ FORWARD, 1, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1)
    np.testing.assert_allclose(np.einsum("nck,nk->nc", found.grid, found.normals), 0, atol=1e-12)
    np.testing.assert_allclose(found.grid.mean(1), 0, atol=1e-12)
    assert patches_of(2, photographs("revolute")[0], CONFIG, np.random.default_rng(0)) is None


def test_a_patch_shows_where_it_faces_the_camera_and_the_model_draws_it() -> None:
    found, T = patches("revolute"), place("revolute")(np.zeros(3))
    before, after = (
        np.mean([shown(found, t, p, 0.02) for p in s], 0) for t, s in zip(T, photographs("revolute"), strict=True)
    )
    assert np.median(before) > 0.3 and np.median(after) > 0.2
    away = replace(found, normals=-found.normals)
    assert not any(shown(away, T[0], p, 0.02).any() for p in photographs("revolute")[0])
    lifted = replace(found, points=found.points + np.array([0, -0.1, 0]))
    assert np.mean([shown(lifted, T[0], p, 0.02) for p in photographs("revolute")[0]]) < 0.05


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_patches_find_the_joint_again(kind: str) -> None:
    start = OFF[kind]
    theta, covariance = adjust(patches(kind), photographs(kind), place(kind), start, KNOWN, 1.0, CONFIG.rounds)
    felt = start != 0
    np.testing.assert_allclose(theta[felt], 0, atol=2e-4)
    assert (np.sqrt(np.diag(covariance))[felt] < 1e-3).all()
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-5)
    again = adjust(patches(kind), photographs(kind), place(kind), start, KNOWN, 1.0, CONFIG.rounds)
    np.testing.assert_array_equal(theta, again[0])


def test_light_does_not_matter() -> None:
    """A door that turns away from the lamp is darker; each photograph has its own exposure, and a lamp beside it."""
    first, second = photographs("revolute")
    right = np.linspace(0, 1, first[0].spline.shape[1])
    darker = [
        replace(
            p,
            spline=((0.4 + 0.01 * i) * p.spline + right + 0.1).astype(np.float32),
            slope=((0.4 + 0.01 * i) * p.slope + np.array([right[1], 0])[:, None, None]).astype(np.float32),
        )
        for i, p in enumerate(second)
    ]
    start, found = OFF["revolute"], patches("revolute")
    theta, _ = adjust(found, [first, darker], place("revolute"), start, KNOWN, 1.0, CONFIG.rounds)
    same, _ = adjust(found, [first, second], place("revolute"), start, KNOWN, 1.0, CONFIG.rounds)
    np.testing.assert_allclose(theta, same, atol=2e-4)


def test_without_texture_or_photographs_what_was_known_remains() -> None:
    first, second = photographs("revolute")
    start, found = OFF["revolute"], patches("revolute")
    grey = [[replace(p, spline=0 * p.spline + 0.5, slope=0 * p.slope) for p in s] for s in (first, second)]
    for states in (grey, [[], []], [first, []]):
        theta, covariance = adjust(found, states, place("revolute"), start, KNOWN, 1.0, CONFIG.rounds)
        np.testing.assert_allclose(theta, start, atol=1e-12)
        np.testing.assert_allclose(covariance, np.linalg.inv(KNOWN))


def test_derivatives_of_grey_values() -> None:
    found, photo, T = patches("revolute"), photographs("revolute")[1][3], place("revolute")
    rows = np.flatnonzero(shown(found, T(np.zeros(3))[1], photo, 0.02))[:10]
    found = replace(found, **{k: getattr(found, k)[rows] for k in ("points", "normals", "grid")})
    still, eps = np.zeros((len(rows), 3)), 1e-4
    slopes = np.stack([(T(d)[1] - T(-d)[1]) / (2 * eps) for d in eps * np.eye(3)])

    def seen(local: np.ndarray, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        patch, _, texture, jacobian = looks(found, local, [[photo]], T(theta)[1:], slopes[None], 0.03)
        np.testing.assert_array_equal(patch, np.arange(len(rows)))
        return texture, jacobian

    def grey(local: np.ndarray, theta: np.ndarray) -> np.ndarray:
        return seen(local, theta)[0]

    jacobian = seen(still, np.zeros(3))[1]
    for k, d in enumerate(eps * np.eye(3)):
        by_local = (grey(still + d, np.zeros(3)) - grey(still - d, np.zeros(3))) / (2 * eps)
        by_joint = (grey(still, d) - grey(still, -d)) / (2 * eps)
        for ours, expected in ((jacobian[..., k], by_local), (jacobian[..., 3 + k], by_joint)):
            # Slopes are of the picture between pixels, grey values of the spline through them.
            assert np.corrcoef(ours.ravel(), expected.ravel())[0, 1] > 0.97
            assert np.linalg.norm(ours) == pytest.approx(np.linalg.norm(expected), rel=0.15)


def test_a_patch_that_pulls_elsewhere_hardly_counts() -> None:
    rng = np.random.default_rng(0)
    stiff = np.stack([np.diag(rng.uniform(0.5, 2, 2)) for _ in range(40)])
    target = np.array([0.3, -0.2]) + 0.02 * rng.normal(size=(40, 2))
    off, weak = np.zeros(2), 1e-9 * np.eye(2)
    honest, sure = _agreed(-np.einsum("nkl,nl->nk", stiff, target), stiff, off, weak, 1)
    np.testing.assert_allclose(honest, [0.3, -0.2], atol=0.02)
    target[:3] += 5
    robust, less = _agreed(-np.einsum("nkl,nl->nk", stiff, target), stiff, off, weak, 1)
    np.testing.assert_allclose(robust, [0.3, -0.2], atol=0.05)
    assert np.trace(less) > np.trace(sure)
    assert np.linalg.norm(_agreed(-stiff @ [0.3, -0.2], stiff, off, 1e9 * np.eye(2), 1)[0]) < 1e-3


def test_a_patch_whose_curvature_rounds_below_zero_does_no_harm() -> None:
    """A fridge's door ended in a square root of less than nothing."""
    stiff = np.array([np.diag([1.0, 1.0])] * 4 + [np.diag([1.0, -1e-6])])
    pull = np.array([[0.1, 0.1], [-0.1, 0.1], [0.1, -0.1], [-0.1, -0.1], [0.0, 1.0]])
    step, covariance = _agreed(pull, stiff, np.zeros(2), np.eye(2), 1)
    assert np.isfinite(step).all() and (np.linalg.eigvalsh(covariance) > 0).all()
