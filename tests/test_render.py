"""The rasteriser: torch is proved by finite differences, and the other backends by torch."""

import math
import threading

import numpy as np
import pytest
import torch

from hingesplat.camera import Camera
from hingesplat.errors import HingesplatError
from hingesplat.gaussians import Gaussians
from hingesplat.render import gsplat_backend, rasterize, render, sh_to_rgb
from hingesplat.simd import LANES
from standin import definition_as_gsplat

BACKGROUND = torch.tensor([0.2, 0.5, 0.9])
NAMES = ("means", "quats", "scales", "opacities", "colors", "channels")


def camera(width=45, height=33, focal=50.0):
    """At (0, -3, 0.4), looking along +y, slightly turned."""
    a = 0.1
    z = np.array([math.sin(a), math.cos(a), -0.1])
    z /= np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = -3 * z
    return Camera(pose, focal, focal * 1.1, width / 2 + 1.3, height / 2 - 0.7, width, height)


def scene(n, channels=0, seed=0, size=0.08, dtype=torch.float32):
    """n Gaussians of about ``size`` in a unit ball: means, quats, scales, opacities, colours, channels."""
    g = torch.Generator().manual_seed(seed)
    tensors = (
        0.5 * torch.randn((n, 3), generator=g),
        torch.randn((n, 4), generator=g),
        size * torch.exp(0.5 * torch.randn((n, 3), generator=g)),
        0.05 + 0.9 * torch.rand(n, generator=g),
        torch.rand((n, 3), generator=g),
        torch.randn((n, channels), generator=g),
    )
    return [t.to(dtype) for t in tensors]


def draw(tensors, view, **options):
    *geometry, channels = tensors
    return rasterize(*geometry, view, channels=channels, background=BACKGROUND, **options)


def stacked(r):
    return torch.cat([r.rgb, r.channels, r.depth[None], r.alpha[None]])


def image_and_gradients(tensors, view, backend, dtype, **options):
    leaves = [t.to(dtype).clone().requires_grad_() for t in tensors]
    image = stacked(draw(leaves, view, backend=backend, **options))
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    image.backward(weights.to(image))
    return image.detach(), [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves]


def assert_agree(tensors, view, image_tolerance=1e-5, gradient_tolerance=2e-5, **options):
    image, gradients = image_and_gradients(tensors, view, "numba", torch.float32, **options)
    truth, exact = image_and_gradients(tensors, view, "torch", torch.float64, **options)
    assert (image - truth).abs().max() <= image_tolerance
    for name, a, b in zip(NAMES, gradients, exact, strict=True):
        assert a.isfinite().all(), name
        assert (a - b).norm() <= gradient_tolerance * b.norm() + 1e-6, name


# ---- the definition --------------------------------------------------------------------------------------


def test_torch_passes_gradcheck():
    # Four large Gaussians on 6×5 pixels: no alpha near a threshold, so the function is smooth.
    tensors = scene(4, channels=2, size=1.0, dtype=torch.float64)
    tensors[0] *= 0.3
    tensors[3] = torch.tensor([0.3, 0.5, 0.6, 0.8], dtype=torch.float64)
    leaves = [t.requires_grad_() for t in tensors]
    view = camera(6, 5, focal=8.0)
    torch.autograd.gradcheck(lambda *t: stacked(draw(t, view, backend="torch")), leaves)


def test_one_gaussian_has_the_colour_depth_and_width_it_should():
    view = Camera(np.eye(4), 100.0, 100.0, 20.5, 20.5, 41, 41)
    sigma, z, o = 0.1, 2.0, 0.5
    one = [[[0, 0, z]], [[2.0, 0, 0, 0]], [[sigma] * 3], [o], [[1, 0.5, 0]], [[3.0]]]
    tensors = [torch.tensor(t, dtype=torch.float64) for t in one]
    r = draw(tensors, view)
    assert r.alpha[20, 20] == pytest.approx(o)
    assert r.depth[20, 20] == pytest.approx(o * z)
    assert r.channels[0, 20, 20] == pytest.approx(o * 3)
    torch.testing.assert_close(r.rgb[:, 20, 20], o * tensors[4][0] + (1 - o) * BACKGROUND.double())
    variance = (100 * sigma / z) ** 2 + 0.3
    assert r.alpha[20, 26] == pytest.approx(o * math.exp(-(6**2) / (2 * variance)))
    assert r.alpha[0, 0] == 0


def test_nearer_gaussians_hide_farther_ones_whatever_their_order():
    view = Camera(np.eye(4), 100.0, 100.0, 20.5, 20.5, 41, 41)
    means = torch.tensor([[0, 0, 3.0], [0, 0, 2.0]])
    shape = (torch.tensor([[1.0, 0, 0, 0]] * 2), torch.full((2, 3), 0.5), torch.full((2,), 0.9))
    colors = torch.eye(3)[:2]
    for order in ([0, 1], [1, 0]):
        r = rasterize(means[order], *shape, colors[order], view)
        torch.testing.assert_close(r.rgb[:, 20, 20], torch.tensor([0.09, 0.9, 0]), atol=1e-4, rtol=0)


def test_a_rigid_motion_of_everything_changes_nothing():
    tensors, view = scene(50, dtype=torch.float64), camera()
    angle = torch.tensor(0.7, dtype=torch.float64)
    c, s = angle.cos(), angle.sin()
    R = torch.stack([c, -s, 0 * c, s, c, 0 * c, 0 * c, 0 * c, 0 * c + 1]).reshape(3, 3)
    t = torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64)
    w, x, y, z = tensors[1].unbind(1)
    k, h = (angle / 2).cos(), (angle / 2).sin()
    turned = torch.stack([k * w - h * z, k * x - h * y, k * y + h * x, k * z + h * w], dim=1)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.numpy(), t.numpy()
    moved = Camera(T @ view.T_world_camera, view.fx, view.fy, view.cx, view.cy, view.width, view.height)
    a = stacked(draw(tensors, view))
    b = stacked(draw([tensors[0] @ R.T + t, turned, *tensors[2:]], moved))
    torch.testing.assert_close(a, b)


# ---- numba against torch ---------------------------------------------------------------------------------


@pytest.mark.parametrize("early_stop", [False, True])
@pytest.mark.parametrize(("size", "tolerance"), [(0.03, 2e-5), (0.1, 2e-5), (0.2, 2e-5), (0.4, 5e-5)])
def test_numba_agrees_with_torch(size, tolerance, early_stop):
    # The largest size puts a hundred layers over every pixel; what lies behind them is total minus prefix,
    # in float32.
    tensors = scene(500, size=size)
    assert_agree(tensors, camera(61, 45), gradient_tolerance=tolerance, early_stop=early_stop)


@pytest.mark.parametrize("channels", [1, 3, 8, 13, 16, 17, 40])
def test_numba_agrees_for_any_number_of_channels(channels):
    assert_agree(scene(60, channels=channels), camera(), early_stop=False)


@pytest.mark.parametrize("shape", [(1, 1), (1, 70), (130, 3), (32, 32), (33, 31), (64, 16), (300, 2)])
def test_numba_agrees_for_any_image_size(shape):
    assert_agree(scene(80, size=0.3), camera(*shape))


@pytest.mark.parametrize("n", [0, 1, 2, LANES - 1, LANES, LANES + 1, 3 * LANES + 5])
def test_numba_agrees_for_any_number_of_gaussians(n):
    assert_agree(scene(n, channels=2, size=0.3), camera())


def test_numba_leaves_out_what_cannot_be_seen():
    tensors, view = scene(40), camera()
    forward = torch.as_tensor(view.T_world_camera[:3, 2]).float()
    tensors[0][:10] -= 6 * forward  # behind the camera
    tensors[0][10:20, 0] += 50  # beside the image
    tensors[3][20:30] = 1 / 300  # too faint
    tensors[0][30:35] = torch.as_tensor(view.centre).float() + 0.005 * forward  # too near
    assert_agree(tensors, view)
    hidden = [t[:35] for t in tensors]
    image, gradients = image_and_gradients(hidden, view, "numba", torch.float32)
    assert_agree(hidden, view)
    assert image[-1].abs().max() == 0
    torch.testing.assert_close(image[:3], BACKGROUND[:, None, None].expand(3, view.height, view.width))
    assert all((g == 0).all() for g in gradients)


def test_numba_agrees_on_huge_and_on_needle_shaped_gaussians():
    tensors = scene(60, size=0.05)
    tensors[2][:5] = 4.0
    tensors[2][5:15] *= torch.tensor([40.0, 0.01, 0.01])
    tensors[3] *= 0.5
    assert_agree(tensors, camera(70, 50), image_tolerance=1e-3, gradient_tolerance=2e-3)


def test_numba_drops_what_is_not_finite():
    tensors, view = scene(40), camera()
    clean = stacked(draw([t[3:] for t in tensors], view))
    tensors[0][0], tensors[2][1], tensors[1][2] = torch.nan, torch.nan, 0
    image, gradients = image_and_gradients(tensors, view, "numba", torch.float32)
    torch.testing.assert_close(image, clean)
    assert all(g.isfinite().all() for g in gradients)


@pytest.mark.parametrize("odd", ["no number", "behind the camera", "all one depth", "too near"])
def test_slices_of_depth_are_right_whatever_the_depths(odd):
    """Threads fill the lists of the tiles slice by slice; what tells where to cut may be nonsense."""
    tensors, view = scene(4096), camera(100, 80)
    centre = torch.from_numpy(view.centre).float()
    forward = torch.from_numpy(view.T_world_camera[:3, 2]).float()
    depth = (tensors[0] - centre) @ forward
    if odd == "no number":
        tensors[0][::64] = torch.nan  # Just those that are looked at.
    elif odd == "behind the camera":
        tensors[0][: 4000 // 2] -= 10 * depth[: 4000 // 2, None] * forward
    else:
        tensors[0] += ((1 if odd == "all one depth" else -1) - depth)[:, None] * forward
    before, images = torch.get_num_threads(), []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        images.append(image_and_gradients(tensors, view, "numba", torch.float32))
    torch.set_num_threads(before)
    for image, gradients in images[1:]:
        torch.testing.assert_close(image, images[0][0], atol=1e-6, rtol=0)
        for a, b in zip(gradients, images[0][1], strict=True):
            torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)


def test_depth_order_is_exact_over_a_large_range_of_depths():
    tensors = scene(200, size=0.2)
    tensors[0][0] *= 1e5  # must not coarsen the order of the others
    assert_agree(tensors, camera())


def test_several_forwards_may_wait_for_their_backwards():
    first, second, view = scene(100, seed=1), scene(300, seed=2), camera()
    _, expected = image_and_gradients(first, view, "numba", torch.float32)
    leaves = [t.clone().requires_grad_() for t in first]
    image = stacked(draw(leaves, view))
    image_and_gradients(second, view, "numba", torch.float32)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    image.backward(weights, retain_graph=True)
    image.backward(weights)
    for leaf, gradient in zip(leaves[:5], expected, strict=False):
        torch.testing.assert_close(leaf.grad, 2 * gradient)


def test_threads_in_and_outside_do_not_change_the_result():
    tensors, view = scene(5000), camera(100, 80)
    expected, gradients = image_and_gradients(tensors, view, "numba", torch.float32)
    results = []

    def work():
        torch.set_num_threads(3)
        results.append(image_and_gradients(tensors, view, "numba", torch.float32))

    before = torch.get_num_threads()
    callers = [threading.Thread(target=work) for _ in range(3)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    torch.set_num_threads(before)
    assert len(results) == 3
    for image, others in results:
        torch.testing.assert_close(image, expected, atol=1e-6, rtol=0)
        for a, b in zip(others, gradients, strict=True):
            torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)


def test_changing_the_picture_in_place_before_backward_is_noticed():
    leaves = [t.requires_grad_() for t in scene(30)]
    r = draw(leaves, camera())
    loss = r.rgb.sum()
    with torch.no_grad():
        r.rgb.zero_()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


@pytest.mark.parametrize("channels", [0, 30])
def test_screen_gradient_statistics(channels):
    tensors, view = scene(300, channels=channels), camera()
    tensors[0][:20, 0] += 50
    start = torch.tensor([1.0, 2.0, 3.0]).repeat(300, 1)
    numba, exact = start.clone(), start.clone()
    image_and_gradients(tensors, view, "numba", torch.float32, screen_gradient=numba)
    image_and_gradients(tensors, view, "torch", torch.float64, screen_gradient=exact)
    torch.testing.assert_close(numba, exact, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(numba[:20], start[:20])
    assert (numba[20:, 1] == 3).float().mean() > 0.5
    assert numba[:, 2].max() > 3

    # The statistic is the gradient of the loss in the principal point: it shifts all projected means alike.
    one = [t[25:26].double() for t in tensors]
    statistics = torch.zeros(1, 3)
    leaves = [t.requires_grad_() for t in one]
    draw(leaves, view, screen_gradient=statistics).rgb.square().sum().backward()
    h = 1e-5

    def loss(dx, dy):
        shifted = Camera(view.T_world_camera, view.fx, view.fy, view.cx + dx, view.cy + dy, view.width, view.height)
        return draw(one, shifted).rgb.square().sum().item()

    slope = math.hypot(loss(h, 0) - loss(-h, 0), loss(0, h) - loss(0, -h)) / (2 * h)
    assert statistics[0, 0].item() == pytest.approx(slope, rel=1e-3)


@pytest.mark.parametrize("channels", [0, 5])
def test_what_surrounds_the_call_of_gsplat_agrees_with_torch(monkeypatch, channels):
    monkeypatch.setattr(gsplat_backend, "_gsplat", lambda means: definition_as_gsplat)
    tensors, view = scene(80, channels=channels, size=0.05, dtype=torch.float64), camera()
    tensors[0][:10, 0] += 50
    found, exact = torch.zeros((80, 3)), torch.zeros((80, 3))
    image, gradients = image_and_gradients(tensors, view, "gsplat", torch.float64, screen_gradient=found)
    truth, expected = image_and_gradients(tensors, view, "torch", torch.float64, screen_gradient=exact)
    torch.testing.assert_close(image, truth, atol=1e-6, rtol=0)
    for a, b in zip(gradients, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(found[:, 1:], exact[:, 1:])
    # The stand-in's projected means move the shapes a little, too.
    torch.testing.assert_close(found[:, 0], exact[:, 0], rtol=0.1, atol=0.02 * float(exact[:, 0].max()))
    nothing = [t[:0] for t in tensors]
    image, _ = image_and_gradients(nothing, view, "gsplat", torch.float64)
    torch.testing.assert_close(image, image_and_gradients(nothing, view, "torch", torch.float64)[0])


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("channels", [0, 5])
def test_gsplat_agrees_with_torch(channels):
    pytest.importorskip("gsplat")
    tensors, view = scene(300, channels=channels), camera(61, 45)
    tensors[3].clamp_(max=0.9)  # then its stricter early stop is below the tolerance
    truth, exact = image_and_gradients(tensors, view, "torch", torch.float64)
    on_device = [t.cuda() for t in tensors]
    image, gradients = image_and_gradients(on_device, view, None, torch.float32)
    assert (image.cpu() - truth).abs().max() <= 1e-3
    for name, a, b in zip(NAMES, gradients, exact, strict=True):
        assert (a.cpu() - b).norm() <= 1e-3 * b.norm() + 1e-6, name


# ---- colours, wrapper, errors ----------------------------------------------------------------------------


def test_spherical_harmonics_are_orthonormal_and_have_the_usual_signs():
    g = torch.Generator().manual_seed(0)
    d = torch.nn.functional.normalize(torch.randn((200_000, 3), generator=g, dtype=torch.float64), dim=1)
    eye = torch.eye(16, dtype=torch.float64)
    # Three basis functions at a time through the colour channels, shifted so that nothing is clamped.
    basis = []
    for k in range(0, 18, 3):
        sh = torch.zeros((16, 3), dtype=torch.float64)
        for c in range(3):
            if k + c < 16:
                sh[:, c] = 0.1 * eye[k + c]
        basis.append((sh_to_rgb(sh.expand(len(d), -1, -1), d) - 0.5) * 10)
    basis = torch.cat(basis, dim=1)[:, :16]
    gram = 4 * math.pi * basis.T @ basis / len(d)
    torch.testing.assert_close(gram, eye, atol=0.03, rtol=0)
    x, y, z = d[:, 0], d[:, 1], d[:, 2]
    for k, part in ((1, -y), (2, z), (3, -x), (4, x * y), (5, -y * z), (7, -x * z), (10, x * y * z)):
        assert (basis[:, k] * part).mean() > 0.99 * (basis[:, k].square().mean() * part.square().mean()).sqrt()


def test_colours_are_clamped_at_zero_and_other_sizes_refused():
    down = torch.tensor([[0.0, 0, 1]])
    assert (sh_to_rgb(torch.full((1, 1, 3), -5.0), down) == 0).all()
    with pytest.raises(ValueError, match="degree 0 to 3"):
        sh_to_rgb(torch.zeros((1, 5, 3)), down)


@pytest.mark.parametrize("degree", [0, 2])
def test_render_evaluates_the_harmonics_towards_the_gaussians(degree):
    means, quats, scales, opacities, _, _ = scene(50)
    sh = 0.3 * torch.randn((50, (degree + 1) ** 2, 3), generator=torch.Generator().manual_seed(3))
    gaussians = Gaussians(
        means.requires_grad_(), quats, scales.log(), opacities.logit(), sh, torch.zeros(50, dtype=torch.int64)
    )
    view = camera()
    away = torch.nn.functional.normalize(means - torch.as_tensor(view.centre).float(), dim=1)
    expected = rasterize(means, quats, scales, opacities, sh_to_rgb(sh, away), view)
    r = render(gaussians, view)
    torch.testing.assert_close(r.rgb, expected.rgb, atol=1e-4, rtol=0)
    assert r.channels.shape == (0, view.height, view.width)


def test_bad_input_is_refused():
    tensors, view = scene(5), camera()
    with pytest.raises(ValueError, match="quats"):
        draw([tensors[0], tensors[1][:, :3], *tensors[2:]], view)
    with pytest.raises(ValueError, match="opacities"):
        draw([*tensors[:3], tensors[3][:, None], *tensors[4:]], view)
    with pytest.raises(HingesplatError, match="float32"):
        draw([t.double() for t in tensors], view, backend="numba")
    with pytest.raises(HingesplatError, match="unknown"):
        draw(tensors, view, backend="taichi")
    if not torch.cuda.is_available():
        with pytest.raises(HingesplatError, match="no CUDA device"):
            draw(tensors, view, backend="gsplat")
