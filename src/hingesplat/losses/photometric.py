"""The photometric loss of 3D Gaussian Splatting (Kerbl et al. 2023, eq. 7) and the measures of image quality.

SSIM after Wang et al. 2004: an 11×11 Gaussian window with σ = 1.5, zero padding, data range 1, per channel.
On the CPU a fused kernel computes loss and gradient at once, many times faster than convolutions in torch.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numba import njit
from scipy.ndimage import correlate1d
from torch import Tensor

from hingesplat.simd import (
    INLINE,
    INNER,
    KERNEL,
    LANES,
    Build,
    sload,
    sstore,
    vfma,
    vgt,
    viota,
    vload,
    vmax,
    vselect,
    vsplat,
    vstore,
    vsum,
)
from hingesplat.threads import parallel

WINDOW_SIGMA = 1.5
RADIUS = 5
"""Half width of the window: 11 pixels in all."""
C1, C2 = 0.01**2, 0.03**2
"""The constants that stabilise SSIM, for a data range of 1."""
COVERED = 0.5
"""Alpha from which a pixel has a depth."""
NEAR = 0.02
"""Share of a known depth within which the drawn one must be to be drawn to it."""

_WINDOW = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / WINDOW_SIGMA) ** 2)
_WINDOW /= _WINDOW.sum()


@dataclass(frozen=True)
class Target:
    """A photograph to be matched, with what the loss needs of it more than once."""

    image: Tensor
    """(C, height, width), values in 0 … 1."""
    mean: Tensor
    """(C, height, width) local mean."""
    variance: Tensor
    """(C, height, width) local variance."""
    depth: Tensor | None = None
    """(height, width) where the surface is known to be; 0 where it is not."""

    @property
    def nbytes(self) -> int:
        depth = 0 if self.depth is None else self.depth.nbytes
        return self.image.nbytes + self.mean.nbytes + self.variance.nbytes + depth

    @staticmethod
    def of(image: Tensor, depth: Tensor | None = None) -> "Target":
        """Blur ``image`` (C, height, width) once for all."""
        image = image.detach().contiguous()
        if _fusible(image):
            threads, (mean, variance) = torch.get_num_threads(), (torch.empty_like(image) for _ in range(2))
            flat = (t.numpy().reshape(-1) for t in (image, mean, variance))
            parallel(_mean_and_variance, threads, _BUILD, *flat, tuple(image.shape))
            return Target(image, mean, variance, depth)
        exact = image.double()
        mean = _blur_once(exact)
        variance = _blur_once(exact * exact) - mean * mean
        return Target(image, mean.to(image), variance.to(image), depth)


def photometric(image: Tensor, target: Target, ssim_weight: float = 0.2) -> Tensor:
    """(1 - w)·mean |image - target| + w·(1 - mean SSIM) of ``image`` (C, height, width); differentiable.

    Raises:
        ValueError: the shapes differ.
    """
    return picture_loss(image, target, ssim_weight)[0]


def picture_loss(
    image: Tensor,
    target: Target,
    ssim_weight: float = 0.2,
    depths: tuple[Tensor, Tensor] | None = None,
    variance_weight: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """``photometric`` + ``variance_weight`` · ``depth_variance``, and how good the picture is.

    Args:
        image: (C, height, width); its fourth channel is alpha where depths are given.
        depths: depth and squared depth (height, width) as blended, if their variance counts.

    Returns:
        The loss, and (C,) mean squared error of each channel, without gradients.

    Raises:
        ValueError: the shapes differ.
    """
    if image.shape != target.image.shape:
        raise ValueError(f"image: shape {tuple(image.shape)}, but its target has {tuple(target.image.shape)}")
    if _fusible(image):
        return _Fused.apply(image, target, ssim_weight, *(depths or (None, None)), variance_weight)
    difference = image - target.image
    loss = (1 - ssim_weight) * difference.abs().mean() + ssim_weight * (1 - ssim_map(image, target).mean())
    if depths is not None:
        loss = loss + variance_weight * depth_variance(image[3], *depths, target.depth)
    return loss, difference.detach().square().mean((1, 2))


def depth_variance(alpha: Tensor, depth: Tensor, squared_depth: Tensor, known: Tensor | None = None) -> Tensor:
    """Mean over covered pixels of the variance of depth along the ray, scene units squared; differentiable.

    It is the variance about the mean, or about the ``known`` depth where the mean is within NEAR of that: one that is
    farther off may be wrong. All (height, width), blended: ``alpha`` Σ w, ``depth`` Σ w·z, ``squared_depth`` Σ w·z².
    """
    covered = alpha > COVERED
    weight = torch.where(covered, alpha, 1)
    about = mean = depth / weight
    if known is not None:
        about = torch.where((known - mean).abs() < NEAR * known, known, mean)
    variance = (squared_depth / weight - 2 * about * mean + about.square()).clamp_min(0)
    return (variance * covered).mean()


def _fusible(image: Tensor) -> bool:
    """Whether the kernels below can take it."""
    return image.device.type == "cpu" and image.dtype == torch.float32 and image.numel() > 0


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Mean structural similarity of two images (C, height, width): 1 when they are equal."""
    return ssim_map(a, Target.of(b)).mean()


def psnr(a: Tensor, b: Tensor, mask: Tensor | None = None) -> Tensor:
    """Peak signal-to-noise ratio in dB of images (C, height, width) with data range 1.

    ``mask`` (height, width), bool or weights, selects the pixels that count. Equal images give infinity.
    """
    error = (a - b) ** 2
    if mask is None:
        return -10 * torch.log10(error.mean())
    weight = mask.to(error)
    return -10 * torch.log10((error * weight).sum() / (weight.sum() * len(error)))


def _blur(image: Tensor) -> Tensor:
    """Window average of every channel. A full 2-D window: torch is many times slower with two 1-D ones."""
    window = torch.as_tensor(_WINDOW).to(image)
    kernel = (window[:, None] * window).expand(len(image), 1, -1, -1)
    return torch.nn.functional.conv2d(image[None], kernel, padding=RADIUS, groups=len(image))[0]


def _blur_once(image: Tensor) -> Tensor:
    """``_blur`` without gradients: on the CPU a window at a time, fifty times faster."""
    if image.device.type != "cpu":
        return _blur(image)
    rows = correlate1d(image.numpy(), _WINDOW, axis=1, mode="constant")
    return torch.from_numpy(correlate1d(rows, _WINDOW, axis=2, mode="constant"))


def ssim_map(x: Tensor, target: Target) -> Tensor:
    """Structural similarity at every pixel, (C, height, width), by convolutions in torch."""
    mean, square, product = _blur(torch.cat([x, x * x, x * target.image])).chunk(3)
    variance, covariance = square - mean * mean, product - mean * target.mean
    above = (2 * mean * target.mean + C1) * (2 * covariance + C2)
    below = (mean * mean + target.mean**2 + C1) * (variance + target.variance + C2)
    return above / below


# ---- the fused kernel ------------------------------------------------------------------------------------
#
# With μ, e, f the window averages of x, x², x·y, SSIM is a function of (μ, e - μ², f - μ·μ_y) at every
# pixel. Rows stream through three steps: average along the row; average down the columns and differentiate
# SSIM; average these derivatives likewise (the window is its own transpose) and add up the gradient. Every
# step lags the one before by five rows.

_BUILD = Build([Path(__file__)])
_W0, _W1, _W2, _W3, _W4, _W5 = (np.float32(w) for w in _WINDOW[RADIUS:])
_C1, _C2 = np.float32(C1), np.float32(C2)
_0, _1, _2, _COVERED, _NEAR = (np.float32(x) for x in (0, 1, 2, COVERED, NEAR))
_MARGIN = 16  # zero columns beside a padded row
_STEP = 16  # rows that go through each step at a time
_LAG = 2 * RADIUS


@njit(**INLINE)
def _load(array, p, count, scratch):
    """array[p : p + count], zeros up to a whole vector."""
    if count >= LANES:
        return vload(array, p)
    vstore(scratch, 0, vsplat(_0))
    for k in range(count):
        sstore(scratch, k, sload(array, p + k))
    return vload(scratch, 0)


@njit(**INLINE)
def _store(array, p, count, value, scratch):
    """array[p : p + count] = the first ``count`` lanes."""
    if count >= LANES:
        vstore(array, p, value)
    else:
        vstore(scratch, 0, value)
        for k in range(count):
            sstore(array, p + k, sload(scratch, k))


@njit(**INLINE)
def _average(array, p, stride):
    """Window average of the vectors at p - 5·stride … p + 5·stride."""
    far = (vload(array, p - 5 * stride) + vload(array, p + 5 * stride)) * _W5
    far = vfma(vload(array, p - 4 * stride) + vload(array, p + 4 * stride), _W4, far)
    far = vfma(vload(array, p - 3 * stride) + vload(array, p + 3 * stride), _W3, far)
    far = vfma(vload(array, p - 2 * stride) + vload(array, p + 2 * stride), _W2, far)
    far = vfma(vload(array, p - stride) + vload(array, p + stride), _W1, far)
    return vfma(vload(array, p), _W0, far)


@njit(**INLINE)
def _average_rows(rows, padded, planes, plane, q, width):
    """Average the three padded rows along themselves, into row q of the three planes."""
    for k in range(3):
        for c in range(0, width, LANES):
            vstore(planes, k * plane + q + c, _average(rows, k * padded + _MARGIN + c, 1))


@njit(**INNER)
def _average_source(x, y, p, width, rows, padded, planes, plane, q, scratch):
    for c in range(0, width, LANES):
        a, b = _load(x, p + c, width - c, scratch), _load(y, p + c, width - c, scratch)
        vstore(rows, _MARGIN + c, a)
        vstore(rows, padded + _MARGIN + c, a * a)
        vstore(rows, 2 * padded + _MARGIN + c, a * b)
    _average_rows(rows, padded, planes, plane, q, width)


@njit(**KERNEL)
def _mean_and_variance(build, image, mean, variance, size, t, threads):
    """Of the window about every pixel; bands as in ``_loss_and_gradient``."""
    channels, height, width = size
    pitch = (width + LANES - 1) // LANES * LANES
    padded, plane = pitch + 2 * _MARGIN, (_STEP + _LAG) * pitch
    scratch, rows, averages = (
        np.empty(LANES, np.float32),
        np.zeros(3 * padded, np.float32),
        np.zeros(3 * plane, np.float32),
    )
    for job in range(t, channels * threads, threads):
        channel, band = job // threads, job % threads
        first, last = band * height // threads, (band + 1) * height // threads
        for start in range(first - RADIUS, last + RADIUS, _STEP):
            for i in range(_STEP):
                r, q = start + i, (_LAG + i) * pitch
                if 0 <= r < height:
                    p = (channel * height + r) * width
                    _average_source(image, image, p, width, rows, padded, averages, plane, q, scratch)
                else:
                    for k in range(3):
                        for c in range(0, pitch, LANES):
                            vstore(averages, k * plane + q + c, vsplat(_0))
            for i in range(_STEP):
                r, q = start - RADIUS + i, (RADIUS + i) * pitch
                if first <= r < last:
                    for c in range(0, width, LANES):
                        p, m = (channel * height + r) * width + c, _average(averages, q + c, pitch)
                        _store(mean, p, width - c, m, scratch)
                        _store(variance, p, width - c, _average(averages, plane + q + c, pitch) - m * m, scratch)
            _keep_last(averages, plane, pitch)


@njit(**INNER)
def _differentiate(averages, plane, q, pitch, mean, variance, p, width, rows, padded, planes, q_out, scratch):
    """d SSIM / d (μ, e, f) of one row, averaged along it; returns the row's sum of SSIM."""
    total, lane = vsplat(_0), viota()
    for c in range(0, width, LANES):
        mx = _average(averages, q + c, pitch)
        vx = _average(averages, plane + q + c, pitch) - mx * mx
        my, vy = _load(mean, p + c, width - c, scratch), _load(variance, p + c, width - c, scratch)
        cov = _average(averages, 2 * plane + q + c, pitch) - mx * my
        a, b = vfma(_2 * mx, my, _C1), vfma(cov, _2, _C2)
        g, h = vfma(mx, mx, vfma(my, my, _C1)), vx + vy + _C2
        inverse = _1 / (g * h)
        value = a * b * inverse
        d_f, d_e = _2 * a * inverse, _0 - value * (g * inverse)
        d_mu = _2 * (my * (b * inverse) - mx * value * (h * inverse)) - _2 * mx * d_e - my * d_f
        inside = vgt(np.float32(width - c), lane)
        total = total + vselect(inside, value, _0)
        vstore(rows, _MARGIN + c, vselect(inside, d_mu, _0))
        vstore(rows, padded + _MARGIN + c, vselect(inside, d_e, _0))
        vstore(rows, 2 * padded + _MARGIN + c, vselect(inside, d_f, _0))
    _average_rows(rows, padded, planes, plane, q_out, width)
    return vsum(total)


@njit(**INNER)
def _finish(derivatives, plane, q, pitch, x, y, p, width, gradient, l1_scale, ssim_scale, scratch):
    """The gradient of one row; returns the row's sums of |x - y| and (x - y)²."""
    total, squares = vsplat(_0), vsplat(_0)
    for c in range(0, width, LANES):
        a, b = _load(x, p + c, width - c, scratch), _load(y, p + c, width - c, scratch)
        d = a - b
        total, squares = total + vmax(d, _0 - d), vfma(d, d, squares)
        sign = vselect(vgt(d, _0), l1_scale, vselect(vgt(_0, d), -l1_scale, _0))
        d_mu, d_e = _average(derivatives, q + c, pitch), _average(derivatives, plane + q + c, pitch)
        d_f = _average(derivatives, 2 * plane + q + c, pitch)
        g = vfma(_2 * a, d_e, vfma(b, d_f, d_mu))
        _store(gradient, p + c, width - c, vfma(g, ssim_scale, sign), scratch)
    return vsum(total), vsum(squares)


@njit(**INNER)
def _keep_last(planes, plane, pitch):
    """Move the last rows of the three planes to their top."""
    for k in range(3):
        for q in range(k * plane, k * plane + _LAG * pitch, LANES):
            vstore(planes, q, vload(planes, q + _STEP * pitch))


@njit(**INNER)
def _stream(
    x,
    y,
    mean,
    variance,
    base,
    first,
    last,
    height,
    width,
    gradient,
    l1_scale,
    ssim_scale,
    pitch,
    work,
    scratch,
):
    """Rows first … last - 1 of the image plane at ``base``; returns the sums of SSIM, |x - y| and (x - y)²."""
    rows, averages, derivatives = work
    padded, plane = pitch + 2 * _MARGIN, (_STEP + _LAG) * pitch
    zero = vsplat(_0)
    similarity, difference, squares = 0.0, 0.0, 0.0
    for start in range(first - _LAG, last + _LAG, _STEP):
        for i in range(_STEP):
            r, q = start + i, (_LAG + i) * pitch
            if 0 <= r < height:
                p = base + r * width
                _average_source(x, y, p, width, rows, padded, averages, plane, q, scratch)
            else:
                for k in range(3):
                    for c in range(0, pitch, LANES):
                        vstore(averages, k * plane + q + c, zero)
        for i in range(_STEP):
            r, q = start - RADIUS + i, (RADIUS + i) * pitch
            if 0 <= r < height:
                p, q_out = base + r * width, (_LAG + i) * pitch
                value = _differentiate(
                    averages,
                    plane,
                    q,
                    pitch,
                    mean,
                    variance,
                    p,
                    width,
                    rows,
                    padded,
                    derivatives,
                    q_out,
                    scratch,
                )
                if first <= r < last:
                    similarity += value
            else:
                for k in range(3):
                    for c in range(0, pitch, LANES):
                        vstore(derivatives, k * plane + (_LAG + i) * pitch + c, zero)
        for i in range(_STEP):
            r, q = start - _LAG + i, (RADIUS + i) * pitch
            if first <= r < last:
                p = base + r * width
                row_difference, row_squares = _finish(
                    derivatives, plane, q, pitch, x, y, p, width, gradient, l1_scale, ssim_scale, scratch
                )
                difference += row_difference
                squares += row_squares
        _keep_last(averages, plane, pitch)
        _keep_last(derivatives, plane, pitch)
    return similarity, difference, squares


@njit(**KERNEL)
def _loss_and_gradient(build, x, y, mean, variance, size, weight, sums, gradient, t, threads):
    """Every channel is cut into as many bands as there are threads; thread t does every so many-th of them.

    ``sums`` (channels · threads, 3) gets what ``_stream`` returns for each band.
    """
    channels, height, width = size
    n = channels * height * width
    l1_scale, ssim_scale = np.float32((1 - weight) / n), np.float32(-weight / n)
    pitch = (width + LANES - 1) // LANES * LANES
    scratch, rows = np.empty(LANES, np.float32), np.zeros(3 * (pitch + 2 * _MARGIN), np.float32)
    plane = (_STEP + _LAG) * pitch
    work = (rows, np.zeros(3 * plane, np.float32), np.zeros(3 * plane, np.float32))
    for job in range(t, channels * threads, threads):
        channel, band = job // threads, job % threads
        first, last = band * height // threads, (band + 1) * height // threads
        base = channel * height * width
        sums[job] = _stream(
            x,
            y,
            mean,
            variance,
            base,
            first,
            last,
            height,
            width,
            gradient,
            l1_scale,
            ssim_scale,
            pitch,
            work,
            scratch,
        )


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _variance_and_gradient(alpha, depth, squared_depth, known, weight, g_alpha, g_depth, g_squared, sums, t, threads):
    """``depth_variance`` times weight: its gradients, added to ``g_alpha``, and sums[t] for a thread's share."""
    n, total = len(alpha), 0.0
    mine = slice(t * n // threads, (t + 1) * n // threads)
    alpha, depth, squared_depth, known = alpha[mine], depth[mine], squared_depth[mine], known[mine]
    g_alpha, g_depth, g_squared = g_alpha[mine], g_depth[mine], g_squared[mine]
    for i in range(len(alpha)):
        inverse = _1 / alpha[i] if alpha[i] > _COVERED else _0
        mean, square = depth[i] * inverse, squared_depth[i] * inverse
        about = known[i] if abs(known[i] - mean) < _NEAR * known[i] else mean
        variance = square - _2 * about * mean + about * about
        scale = weight / np.float32(n) * inverse if variance > _0 else _0
        total += max(variance, _0)
        g_alpha[i] += scale * (_2 * about * mean - square)
        g_depth[i] = _0 - scale * _2 * about
        g_squared[i] = scale
    sums[t] = weight * total / n


class _Fused(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, target, weight, depth, squared_depth, variance_weight):
        size, threads = tuple(image.shape), torch.get_num_threads()
        gradient, sums = np.empty(size, np.float32), np.zeros((size[0] * threads, 3))
        flat = [_flat(t) for t in (image, target.image, target.mean, target.variance)]
        parallel(_loss_and_gradient, threads, _BUILD, *flat, size, float(weight), sums, gradient.reshape(-1))
        channels = sums.reshape(size[0], threads, 3).sum(axis=1) / (size[1] * size[2])
        similarity, difference, _ = channels.mean(axis=0)
        loss = (1 - weight) * difference + weight * (1 - similarity)
        gradients = [gradient]
        if depth is not None:
            g_depth, g_squared, more = np.empty(size[1:], np.float32), np.empty(size[1:], np.float32), np.zeros(threads)
            alpha, g_alpha = (a.reshape(size[0], -1)[3] for a in (flat[0], gradient))
            known = np.zeros_like(alpha) if target.depth is None else _flat(target.depth)
            given = (alpha, _flat(depth), _flat(squared_depth), known, np.float32(variance_weight))
            parallel(_variance_and_gradient, threads, *given, g_alpha, g_depth.reshape(-1), g_squared.reshape(-1), more)
            loss += more.sum()
            gradients += [g_depth, g_squared]
        ctx.save_for_backward(*map(torch.from_numpy, gradients))
        error = image.new_tensor(channels[:, 2])
        ctx.mark_non_differentiable(error)
        return image.new_tensor(loss), error

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g, _):
        # Mostly the whole loss is differentiated, by 1: that needs no pass over the pictures.
        image, *depths = ctx.saved_tensors if float(g) == 1 else (saved * g for saved in ctx.saved_tensors)
        return image, None, None, *(depths or (None, None)), None


def _flat(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy().reshape(-1)
