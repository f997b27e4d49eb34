"""What the loops share: cropped photographs, depth variance, who is seen, growing."""

import numpy as np
import pytest
import torch

from hingesplat import training
from hingesplat.camera import Camera
from hingesplat.capture import View
from hingesplat.gaussians import Gaussians, concatenate
from hingesplat.losses.photometric import depth_variance
from hingesplat.optim import GaussianAdam, LearningRates
from hingesplat.render import place, rasterize, render
from hingesplat.training import (
    grow,
    mean_psnr,
    seen_weight,
    training_view,
)
from scenes import cameras_around, look_at, scene, sheet

FRONT = look_at(np.array([0.0, -2.0, 0.0]), 48)
"""Looks along +y."""


def disc(y: float, opacity: float, size: float = 0.1, x: float = 0.0) -> Gaussians:
    """One flat Gaussian that faces the camera."""
    facing = np.array([[0.0, -1.0, 0.0]])
    return sheet(np.array([[x, y, 0.0]]), facing, np.array([[0.8, 0.2, 0.4]]), size, opacity)


def noise_view(mask: np.ndarray) -> View:
    """A photograph of noise, with its mask."""
    rgba = np.random.default_rng(0).integers(0, 256, (*mask.shape, 4), dtype=np.uint8)
    rgba[..., 3] = np.where(mask, np.maximum(rgba[..., 3], 1), 0)
    height, width = mask.shape
    return View(Camera(np.eye(4), 70.0, 80.0, width / 2, height / 2, width, height), rgba, "noise")


def test_a_point_falls_on_the_same_pixel_content_in_the_crop() -> None:
    mask = np.zeros((60, 80), bool)
    mask[20:33, 41:66] = True
    view = noise_view(mask)
    cropped = training_view(view, margin=4)
    points = np.random.default_rng(1).uniform([0.0, -0.2, 1], [0.3, 0.03, 1], (50, 3))
    uv, _ = view.camera.project(points)
    x, y = np.floor(uv).astype(int).T
    inside = mask[y, x]
    assert inside.sum() > 20
    x_crop, y_crop = np.floor(cropped.camera.project(points)[0]).astype(int).T
    alpha = view.rgba[y, x, 3:] / 255
    over_white = view.rgba[y, x, :3] / 255 * alpha + 1 - alpha
    found = cropped.image[:, y_crop[inside], x_crop[inside]].T.numpy()
    np.testing.assert_allclose(found, np.concatenate([over_white, alpha], 1)[inside], atol=1e-6)


def test_the_crop_is_the_mask_and_a_margin_within_the_picture() -> None:
    mask = np.zeros((60, 80), bool)
    mask[2:30, 40:50] = True
    view = training_view(noise_view(mask), margin=8)
    assert view.image.shape == (4, 38, 26) and view.target.image.shape == (4, 38, 26)
    assert (view.camera.height, view.camera.width) == (38, 26)
    assert int((view.image[3] > 0).sum()) == mask.sum()


def test_an_empty_mask_keeps_the_whole_white_picture() -> None:
    view = training_view(noise_view(np.zeros((30, 40), bool)))
    assert view.image.shape == (4, 30, 40)
    assert torch.equal(view.image[:3], torch.ones((3, 30, 40)))


def test_photographs_stay_bytes_where_floats_would_take_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    mask = np.ones((30, 40), bool)
    first, second = training_view(noise_view(mask)), training_view(noise_view(mask))
    monkeypatch.setattr(training, "_kept_bytes", 0)
    monkeypatch.setattr(training, "KEPT_BYTES", 30 * 40 * 48 + 1)
    assert first.target is first.target
    assert second.target is not second.target
    assert torch.equal(second.target.mean, first.target.mean)
    del first  # Its room is free again.
    assert second.target is second.target


def drawn_variance(gaussians: Gaussians) -> torch.Tensor:
    placed = place(gaussians, FRONT)
    r = rasterize(*placed.drawn, FRONT, channels=placed.squared_depth)
    return depth_variance(r.alpha, r.depth, r.channels[0])


def test_one_opaque_sheet_has_no_depth_variance_and_two_clear_ones_have_theirs() -> None:
    assert float(drawn_variance(disc(0.0, 0.95, size=3.0))) == pytest.approx(0, abs=1e-5)
    gap = 0.4
    # Half the light stops at the first sheet, and nearly all that is left at the second.
    first, second = 0.5, 0.5 * 0.98
    mean = second * gap / (first + second)
    expected = (first * mean**2 + second * (gap - mean) ** 2) / (first + second)
    both = concatenate([disc(0.0, 0.5, size=9.0), disc(gap, 0.98, size=9.0)])
    assert float(drawn_variance(both)) == pytest.approx(expected, rel=0.03)


def test_depth_variance_pulls_two_sheets_together() -> None:
    both = concatenate([disc(0.0, 0.5, size=3.0), disc(0.4, 0.98, size=3.0)])
    both.means.requires_grad_()
    drawn_variance(both).backward()
    assert both.means.grad is not None
    near, far = both.means.grad[:, 1].tolist()
    assert near < 0 < far


def test_seen_weight_of_a_lone_gaussian_is_what_it_covers() -> None:
    g = disc(0.0, 0.7)
    expected = float(render(g, FRONT).alpha.sum())
    assert expected > 5
    assert seen_weight(g, [FRONT]).tolist() == pytest.approx([expected], rel=1e-4)


def test_who_is_hidden_or_out_of_view_has_no_weight() -> None:
    wall = concatenate([disc(0.0, 0.999, size=0.5), disc(0.05, 0.999, size=0.5)])
    g = concatenate([wall, disc(0.3, 0.9, size=0.05), disc(0.0, 0.9, x=30.0), disc(-4.0, 0.9)])
    weight = seen_weight(g, [FRONT])
    assert weight[0] > 100
    assert weight[2:].max() < 0.5
    behind = look_at(np.array([0.0, 3.0, 0.0]), 48)
    assert seen_weight(g, [FRONT, behind])[2] > 1  # The best view counts.


def test_seen_weight_needs_no_gradients_and_leaves_none() -> None:
    g = disc(0.0, 0.9)
    g.means.requires_grad_()
    assert not seen_weight(g, [FRONT]).requires_grad
    assert g.means.grad is None


def test_grow_drops_the_faint_keeps_to_the_cap_and_follows_the_gradient() -> None:
    base = scene("static", 48).gaussians
    faint = base.logit_opacities.clone()
    faint[::4] = -9.0
    n = len(base)
    solid = n - len(range(0, n, 4))
    optimiser = GaussianAdam(
        Gaussians(base.means, base.quats, base.log_scales, faint, base.sh, torch.arange(n)), LearningRates(), 1.0
    )
    statistics = torch.ones((n, 3))
    statistics[:, 0] = torch.where(torch.arange(n) % 4 == 1, 5.0, 1.0)
    grow(optimiser, statistics, solid + 50, 0.02, 1.0, torch.Generator().manual_seed(0))
    assert len(optimiser) == solid + 50
    assert (optimiser.part % 4 != 0).all()  # ``part`` serves as a name tag here.
    tags, count = optimiser.part.unique(return_counts=True)
    assert int((count == 2).sum()) == 50
    assert (tags[count == 2] % 4 == 1).all()


def test_grow_does_nothing_where_nothing_pulls() -> None:
    base = scene("static", 48).gaussians
    optimiser = GaussianAdam(base, LearningRates(), 1.0)
    grow(optimiser, torch.zeros((len(base), 3)), 10**6, 0.02, 1.0, torch.Generator())
    assert len(optimiser) == len(base)


def test_the_truth_draws_its_own_photographs() -> None:
    made = scene("static", 48)
    views = [training_view(v) for v in made.views[0][:4]]
    assert mean_psnr(made.gaussians, views) > 45
    image = render(made.gaussians, views[0].camera, background=torch.ones(3)).rgba
    assert float((image - views[0].image).abs().max()) < 0.02
    assert mean_psnr(made.gaussians[torch.arange(0, len(made.gaussians), 2)], views) < 40


def test_cameras_of_the_made_scene_see_the_object_from_all_sides() -> None:
    made = scene("static", 48)
    weight = seen_weight(made.gaussians, cameras_around(12, 48))
    assert float((weight > 0.1).float().mean()) > 0.8
