"""The photometric loss and the image measures."""

import math

import pytest
import torch

from hingesplat.losses.photometric import Target, photometric, picture_loss, psnr, ssim, ssim_map


def pair(channels=3, height=40, width=30, seed=0, dtype=torch.float32):
    g = torch.Generator().manual_seed(seed)
    x = torch.rand((channels, height, width), generator=g)
    y = (x + 0.2 * torch.randn(x.shape, generator=g)).clamp(0, 1)
    return x.to(dtype), y.to(dtype)


def value_and_gradient(x, y, weight):
    x = x.clone().requires_grad_()
    loss = photometric(x, Target.of(y), weight)
    loss.backward()
    return loss.item(), x.grad


SIZES = [(3, 61, 45), (1, 1, 1), (3, 5, 3), (2, 40, 17), (3, 7, 100), (3, 16, 16), (4, 90, 33), (1, 100, 2)]


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("size", SIZES)
def test_the_fused_kernel_agrees_with_torch_in_float64(size, weight):
    x, y = pair(*size)
    value, gradient = value_and_gradient(x, y, weight)
    exact, truth = value_and_gradient(x.double(), y.double(), weight)
    assert value == pytest.approx(exact, abs=2e-6)
    assert (gradient - truth).norm() <= 1e-5 * truth.norm() + 1e-9


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("size", [(61, 45), (1, 1), (7, 100)])
def test_the_fused_depth_variance_agrees_with_torch_in_float64(size, known):
    x, y = pair(4, *size)
    g = torch.Generator().manual_seed(3)
    z = 1 + torch.rand(size, generator=g)
    depths = (x[3] * z, x[3] * (z * z + 0.1 * torch.randn(size, generator=g)))

    # Half of the known depths are near what is drawn, the others too far off to count, or not known.
    where = torch.rand(size, generator=g)
    depth = torch.where(where < 0.5, z * (1 + 0.03 * (where - 0.25)), torch.where(where < 0.8, 2 * z, 0))

    def all_of(dtype):
        inputs = [t.to(dtype).requires_grad_() for t in (x.clone(), *depths)]
        target = Target.of(y.to(dtype), depth.to(dtype) if known else None)
        loss, error = picture_loss(inputs[0], target, 0.2, (inputs[1], inputs[2]), 3.0)
        gradients = torch.autograd.grad(2 * loss, inputs)
        return [loss.detach(), error, *gradients]

    for found, exact in zip(all_of(torch.float32), all_of(torch.float64), strict=True):
        torch.testing.assert_close(found, exact.float(), rtol=1e-4, atol=2e-6)


def test_the_error_gives_the_psnr():
    x, y = pair()
    error = picture_loss(x, Target.of(y))[1]
    assert -10 * math.log10(error.mean()) == pytest.approx(float(psnr(x, y)), rel=1e-5)


def test_the_number_of_threads_does_not_matter():
    x, y = pair(3, 50, 70)
    before = torch.get_num_threads()
    results = []
    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        results.append(value_and_gradient(x, y, 0.2))
    torch.set_num_threads(before)
    for value, gradient in results[1:]:
        assert value == pytest.approx(results[0][0], rel=1e-6)
        torch.testing.assert_close(gradient, results[0][1])


def test_torch_passes_gradcheck():
    x, y = pair(2, 9, 7, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda image: photometric(image, Target.of(y)), x.requires_grad_())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equal_images_cost_nothing_and_are_a_minimum(dtype):
    _, y = pair(dtype=dtype)
    value, gradient = value_and_gradient(y, y, 0.2)
    assert abs(value) < 1e-6
    assert gradient.abs().max() < 1e-6
    assert value_and_gradient(y + 0.01, y, 0.2)[0] > 0.008
    assert psnr(y, y) == math.inf
    assert ssim(y, y).item() == pytest.approx(1)


def test_the_window_is_the_published_one():
    # On constant images SSIM has a closed form wherever the window lies inside.
    a, b = 0.3, 0.6
    size = (1, 40, 40)
    x, y = torch.full(size, a, dtype=torch.float64), torch.full(size, b, dtype=torch.float64)
    expected = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    inner = ssim_map(x, Target.of(y))[0, 5:-5, 5:-5]
    torch.testing.assert_close(inner, torch.full_like(inner, expected))
    # A single bright pixel shows the window itself: 11 wide, standard deviation 1.5.
    dot = torch.zeros(size, dtype=torch.float64)
    dot[0, 20, 20] = 1
    row = Target.of(dot).mean[0, 20]
    assert (row > 0).sum() == 11
    assert (row[21] / row[20]).item() == pytest.approx(math.exp(-0.5 / 1.5**2))


@pytest.mark.parametrize("size", [(3, 40, 37), (1, 5, 3), (4, 70, 130)])
def test_the_statistics_of_a_photograph_are_those_of_the_definition(size):
    y = torch.rand(size, generator=torch.Generator().manual_seed(2))
    exact, before = Target.of(y.double()), torch.get_num_threads()
    for threads in (1, 3):
        torch.set_num_threads(threads)
        found = Target.of(y)
        torch.set_num_threads(before)
        torch.testing.assert_close(found.mean.double(), exact.mean, atol=1e-6, rtol=0)
        torch.testing.assert_close(found.variance.double(), exact.variance, atol=1e-6, rtol=0)


def test_upstream_gradient_scales_and_non_contiguous_images_work():
    x, y = pair()
    _, expected = value_and_gradient(x, y, 0.2)
    z = x.permute(1, 2, 0).contiguous().permute(2, 0, 1).requires_grad_()
    (3 * photometric(z, Target.of(y.permute(1, 2, 0).contiguous().permute(2, 0, 1)))).backward()
    torch.testing.assert_close(z.grad, 3 * expected)


def test_psnr_counts_the_masked_pixels_only():
    x, y = torch.zeros(3, 4, 4), torch.zeros(3, 4, 4)
    y[:, 0] = 0.1
    mask = torch.zeros(4, 4, dtype=torch.bool)
    mask[0] = True
    assert psnr(x, y, mask).item() == pytest.approx(20, abs=1e-4)
    assert psnr(x, y).item() == pytest.approx(20 + 10 * math.log10(4), abs=1e-4)
    assert psnr(x, y, ~mask) == math.inf


def test_sizes_that_differ_are_refused():
    x, y = pair()
    with pytest.raises(ValueError, match="target has"):
        photometric(x[:, 1:], Target.of(y))
