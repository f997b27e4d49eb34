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
from hingesplat.render._project import SUM_FEATURES, View, project, record_screen_gradient, unproject
from hingesplat.render._tiles import REC_FEATURES, TILE, fill_lists, sort_and_offset
from hingesplat.render.torch_backend import NEAR, TRANSMITTANCE_MIN, tangent_limits
from hingesplat.simd import LANES, Build
from hingesplat.threads import parallel

CHANNEL_SIZES = (0, 1, 4, 8, 16)
"""Numbers of channels that kernels are compiled for; others are padded up, more take several passes."""

GAUSSIANS_PER_THREAD = 1024
"""With fewer, another thread costs more than it brings."""
MOST_THREADS = 16
"""For what counts the tiles' work grows with their square."""

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
) -> tuple[Tensor, Tensor, Tensor]:
    """See ``hingesplat.render.rasterize``: rgba (4, H, W), depth (H, W), channels (C, H, W).

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
    rgba, first, depth = _Draw.apply(*geometry, colors, channels[:, :most], shift, camera, background, early_stop)
    pieces = [first]
    nothing = background.new_zeros(3)
    for start in range(most, channels.shape[1], most + 3):  # the place of the colours takes three channels
        chunk = channels[:, start : start + most + 3]
        count = chunk.shape[1]
        chunk = torch.nn.functional.pad(chunk, (0, max(0, 3 - count)))
        head, tail, _ = _Draw.apply(*geometry, chunk[:, :3], chunk[:, 3:], shift, camera, nothing, early_stop)
        pieces.append(torch.cat([head[:3], tail])[:count])
    if screen_gradient is not None and rgba.requires_grad:
        state = rgba.grad_fn.state
        # ``shift`` moves the projected means of all passes, so its gradient is theirs.
        shift.register_hook(lambda g: _record(state, g, screen_gradient))
    return rgba, depth, pieces[0] if len(pieces) == 1 else torch.cat(pieces)


def _record(state: "_State", gradient: Tensor, statistics: Tensor) -> None:
    """What ``record_screen_gradient`` does, for those of the state that are seen."""
    n = min(len(statistics), len(gradient))
    record_screen_gradient(
        _BUILD, gradient[:n].contiguous().numpy(), state.segments, state.record, state.record_stride, statistics.numpy()
    )


@dataclass
class _State:
    """What the backward pass needs of a forward pass besides its tensors; names as in the kernels."""

    build: Build
    camera: Camera
    view: np.ndarray
    record: np.ndarray
    record_stride: int
    segments: np.ndarray
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
) -> _State:
    """Draw colours, alpha, channels and depth to ``state.image`` (4 + C + 1, H, W)."""
    n, count = channels.shape
    planes = next(size for size in CHANNEL_SIZES if size >= count) + 4  # colours and depth
    build, view = _BUILD.with_planes(planes), _view(camera)
    threads = min(torch.get_num_threads(), 1 + n // GAUSSIANS_PER_THREAD, MOST_THREADS)
    width, height = camera.width, camera.height
    columns, rows = -(-width // TILE), -(-height // TILE)
    stride = -(-(REC_FEATURES + planes) // 4) * 4

    record, boxes = np.empty(n * stride, np.float32), np.empty(4 * n, np.int32)
    segments, pivots = np.empty(n, np.int32), np.empty(threads - 1, np.float32)
    histogram = np.zeros((threads, threads, columns * rows), np.int64)
    flat = [a.reshape(-1) for a in (*geometry, colors, channels)]
    parallel(project, threads, _BUILD, *flat, view, record, boxes, segments, pivots, histogram)

    order, offsets = np.empty(n, np.int32), np.empty(n + 1, np.int64)
    starts = np.empty(columns * rows + 1, np.int64)
    visible, total = sort_and_offset(_BUILD, segments, record, stride, histogram, order, offsets, starts)
    items, slots, shapes = (np.empty(total, np.int32) for _ in range(3))
    lists = (record, stride, offsets, pivots, histogram[0], columns, items, slots, shapes)
    parallel(fill_lists, threads, _BUILD, visible, order, boxes, *lists)
    tiles = np.argsort(starts[:-1] - starts[1:], kind="stable")  # the longest lists first, for balance

    backdrop = np.zeros(3 + count + 1, np.float32)
    backdrop[:3] = background
    image = np.empty((4 + count + 1, height, width), np.float32)
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
        segments,
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
    )


def _undraw(state: _State, geometry: list[np.ndarray], g_image: list[np.ndarray]) -> list[np.ndarray]:
    """Gradients of means, quats, scales, opacities, colours, channels and projected means.

    ``g_image`` are the gradients of the colours with alpha, of the channels and of the depth of the image.
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
        state = _draw(arrays, _numpy(colors), _numpy(channels), camera, _numpy(background), early_stop)
        image = state.image
        outputs = [torch.from_numpy(p) for p in (image[:4], image[4:-1], image[-1])]
        ctx.state, ctx.shapes = state, [tuple(p.shape) for p in outputs]
        ctx.save_for_backward(*geometry, *outputs)  # outputs too: autograd then notices changes in place
        ctx.set_materialize_grads(False)
        return tuple(outputs)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g_rgba, g_channels, g_depth):
        state, geometry = ctx.state, [_numpy(t) for t in ctx.saved_tensors[:4]]
        outputs = zip((g_rgba, g_channels, g_depth), ctx.shapes, strict=True)
        g_image = [np.zeros(shape, np.float32) if g is None else _numpy(g) for g, shape in outputs]
        grads = _undraw(state, geometry, g_image)
        return *(torch.from_numpy(g) for g in grads), None, None, None
