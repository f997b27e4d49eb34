"""The CPU engine: projection, depth sort, tile lists and pixel loops as cached SIMD kernels (Numba).

The kernels live in ``_project``, ``_tiles`` and ``_blend``; this file allocates, runs them on threads, and
gives them to autograd. Nothing is shared between calls, so any number of forward passes may wait for their
backward.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hingesplat.camera import Camera
from hingesplat.errors import HingesplatError
from hingesplat.render._blend import blend, unblend
from hingesplat.render._project import SUM_FEATURES, View, project, unproject
from hingesplat.render._tiles import REC_EXTENT_X, REC_FEATURES, TILE, fill_lists, sort_and_offset
from hingesplat.render.torch_backend import (
    NEAR,
    TRANSMITTANCE_MIN,
    record_screen_gradient,
    tangent_limits,
)
from hingesplat.simd import LANES, Build, parallel

CHANNEL_SIZES = (0, 1, 4, 8, 16)
"""Numbers of channels that kernels are compiled for; others are padded up, more take several passes."""

GAUSSIANS_PER_THREAD = 1024
"""With fewer, another thread costs more than it brings."""

_BUILD = Build(Path(__file__).parent.glob("*.py"))


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    channels: Tensor,
    camera: Camera,
    background: Tensor,
    early_stop: bool,
    screen_gradient: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See ``hingesplat.render.rasterize``: rgb (3, H, W), depth (H, W), alpha (H, W), channels (C, H, W).

    Raises:
        HingesplatError: a tensor is not float32 on the CPU.
    """
    inputs = [means, quats, scales, opacities, colors, channels]
    if any(t.device.type != "cpu" or t.dtype != torch.float32 for t in inputs):
        raise HingesplatError("backend numba: needs float32 CPU tensors; convert them or use another backend")
    n = len(means)
    if n < LANES:  # the kernels work on whole vectors; an opacity of 0 is never seen
        inputs = [torch.cat([t, t.new_zeros((LANES - n, *t.shape[1:]))]) for t in inputs]
    *geometry, colors, channels = inputs
    shift = torch.zeros((len(colors), 2), requires_grad=screen_gradient is not None)

    most = CHANNEL_SIZES[-1]
    rgb, first, depth, alpha = _Draw.apply(*geometry, colors, channels[:, :most], shift, camera, background, early_stop)
    pieces = [first]
    nothing = background.new_zeros(3)
    for start in range(most, channels.shape[1], most + 3):  # the place of the colours takes three channels
        chunk = channels[:, start : start + most + 3]
        count = chunk.shape[1]
        chunk = torch.nn.functional.pad(chunk, (0, max(0, 3 - count)))
        head, tail, _, _ = _Draw.apply(*geometry, chunk[:, :3], chunk[:, 3:], shift, camera, nothing, early_stop)
        pieces.append(torch.cat([head, tail])[:count])
    if screen_gradient is not None and rgb.requires_grad:
        seen, radius = rgb.grad_fn.seen, rgb.grad_fn.radius
        # ``shift`` moves the projected means of all passes, so its gradient is theirs.
        shift.register_hook(lambda g: record_screen_gradient(screen_gradient, seen, g[seen], radius))
    return rgb, depth, alpha, pieces[0] if len(pieces) == 1 else torch.cat(pieces)


@dataclass
class _State:
    """What the backward pass needs of a forward pass besides its tensors; names as in the kernels."""

    build: Build
    camera: Camera
    view: np.ndarray
    record: np.ndarray
    record_stride: int
    offsets: np.ndarray
    items: np.ndarray
    slots: np.ndarray
    shapes: np.ndarray
    starts: np.ndarray
    stops: np.ndarray
    tiles: np.ndarray
    image: np.ndarray
    floor: np.float32
    threads: int


def _view(camera: Camera) -> np.ndarray:
    view = np.empty(View.SIZE, np.float32)
    T = camera.T_camera_world
    view[View.R : View.R + 9] = T[:3, :3].ravel()
    view[View.T : View.T + 3] = T[:3, 3]
    view[View.FX : View.NEAR] = camera.fx, camera.fy, camera.cx, camera.cy
    view[View.NEAR] = NEAR
    view[View.X_MIN : View.WIDTH] = tangent_limits(camera)
    view[View.WIDTH : View.SIZE] = camera.width, camera.height
    return view


def _draw(
    geometry: list[np.ndarray],
    colors: np.ndarray,
    channels: np.ndarray,
    camera: Camera,
    background: np.ndarray,
    early_stop: bool,
) -> tuple[_State, np.ndarray]:
    """Draw colours, channels, depth and alpha to ``state.image`` (3 + C + 2, H, W); and tell who is seen."""
    n, count = channels.shape
    planes = next(size for size in CHANNEL_SIZES if size >= count) + 4  # colours and depth
    build, view = _BUILD.with_planes(planes), _view(camera)
    threads = min(torch.get_num_threads(), 1 + n // GAUSSIANS_PER_THREAD)
    width, height = camera.width, camera.height
    columns, rows = -(-width // TILE), -(-height // TILE)
    stride = -(-(REC_FEATURES + planes) // 4) * 4

    record, boxes = np.empty(n * stride, np.float32), np.empty(4 * n, np.int32)
    segments, histogram = np.empty(n, np.int32), np.zeros((threads, columns * rows), np.int64)
    flat = [a.reshape(-1) for a in (*geometry, colors, channels)]
    parallel(project, threads, _BUILD, *flat, view, record, boxes, segments, histogram)

    order, scratch, offsets = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n + 1, np.int64)
    starts = np.empty(columns * rows + 1, np.int64)
    visible, total = sort_and_offset(_BUILD, segments, record, stride, histogram, order, scratch, offsets, starts)
    items, slots, shapes = (np.empty(total, np.int32) for _ in range(3))
    lists = (record, stride, offsets, starts, columns, items, slots, shapes)
    parallel(fill_lists, threads, _BUILD, visible, order, boxes, *lists)
    tiles = np.argsort(starts[:-1] - starts[1:], kind="stable")  # the longest lists first, for balance

    backdrop = np.zeros(3 + count + 1, np.float32)
    backdrop[:3] = background
    image = np.empty((3 + count + 2, height, width), np.float32)
    floor = np.float32(TRANSMITTANCE_MIN if early_stop else 0)
    stops, tickets = np.empty(columns * rows, np.int64), np.zeros(1, np.int64)
    work = (tiles, width, height, record, stride, items, shapes, starts, stops, floor)
    parallel(blend, threads, build, tickets, *work, backdrop, image.reshape(-1))
    return _State(
        build,
        camera,
        view,
        record,
        stride,
        offsets,
        items,
        slots,
        shapes,
        starts,
        stops,
        tiles,
        image,
        floor,
        threads,
    ), segments > 0


def _undraw(state: _State, geometry: list[np.ndarray], g_image: list[np.ndarray]) -> list[np.ndarray]:
    """Gradients of means, quats, scales, opacities, colours, channels and projected means.

    ``g_image`` are the gradients of the colours, channels, depth and alpha of the image.
    """
    s, camera = state, state.camera
    n, count = len(geometry[0]), len(g_image[1])
    stride = -(-(SUM_FEATURES + s.build.type.planes) // LANES) * LANES
    partial = np.empty(len(s.items) * stride, np.float32)
    tickets = np.zeros(1, np.int64)
    work = (s.tiles, camera.width, camera.height, s.record, s.record_stride, s.items, s.slots, s.shapes)
    images = (s.image.reshape(-1), tuple(g.reshape(-1) for g in g_image))
    parallel(unblend, s.threads, s.build, tickets, *work, s.starts, s.stops, s.floor, *images, partial, stride)
    shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, 3), (n, count), (n, 2)]
    grads = [np.empty(shape, np.float32) for shape in shapes]
    flat = [a.reshape(-1) for a in geometry]
    targets = tuple(g.reshape(-1) for g in grads)
    parallel(unproject, s.threads, _BUILD, *flat, s.view, partial, stride, s.offsets, targets)
    return grads


def _numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, scales, opacities, colors, channels, shift, camera, background, early_stop):
        geometry = (means, quats, scales, opacities)
        arrays = [_numpy(t) for t in geometry]
        state, seen = _draw(arrays, _numpy(colors), _numpy(channels), camera, _numpy(background), early_stop)
        image = state.image
        outputs = [torch.from_numpy(p) for p in (image[:3], image[3:-2], image[-2], image[-1])]
        ctx.state, ctx.shapes = state, [tuple(p.shape) for p in outputs]
        ctx.save_for_backward(*geometry, *outputs)  # outputs too: autograd then notices changes in place
        ctx.set_materialize_grads(False)
        if shift.requires_grad:
            extents = state.record.reshape(len(seen), -1)[seen, REC_EXTENT_X : REC_EXTENT_X + 2]
            ctx.seen = torch.from_numpy(np.flatnonzero(seen))
            ctx.radius = torch.from_numpy(extents.max(axis=1))
        return tuple(outputs)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g_rgb, g_channels, g_depth, g_alpha):
        state, geometry = ctx.state, [_numpy(t) for t in ctx.saved_tensors[:4]]
        outputs = zip((g_rgb, g_channels, g_depth, g_alpha), ctx.shapes, strict=True)
        g_image = [np.zeros(shape, np.float32) if g is None else _numpy(g) for g, shape in outputs]
        grads = _undraw(state, geometry, g_image)
        return *(torch.from_numpy(g) for g in grads), None, None, None
