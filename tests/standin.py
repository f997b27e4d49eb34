"""A device that stands in for a GPU: it computes on the CPU, but does not mix with CPU tensors, and counts who waits.

Its tensors wrap CPU tensors. An operation that is given some of both kinds fails as it would on CUDA, ``numpy()``
fails, and whatever brings a number or an unknown size to the host is counted. gsplat's place is taken by the torch
definition.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten, tree_map_only
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from hingesplat.camera import Camera
from hingesplat.render import rasterize
from hingesplat.render.torch_backend import BLUR, NEAR

WAITING = ("aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::_unique2", "aten::equal")
"""Operations whose result the host needs before it can go on."""
_waits: list[str] = []
_library = torch.library.Library("_", "IMPL", "PrivateUse1")


class OnDevice(Tensor):
    """A tensor of the device; ``held`` are its numbers."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> "OnDevice":
        made = Tensor._make_wrapper_subclass(  # pyright: ignore[reportAttributeAccessIssue]
            cls,
            held.shape,
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device="standin:0",
        )
        made.held = held
        return made

    def __init__(self, held: Tensor) -> None:
        pass

    def __repr__(self, **_: Any) -> str:
        return f"OnDevice({self.held!r})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        return _run(func, args, kwargs or {})


def _run(func: Any, args: tuple, kwargs: dict) -> Any:
    name = func.name().split(".")[0]
    tensors = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, Tensor)]
    here = [t for t in tensors if isinstance(t, OnDevice)]
    args, kwargs = tree_map_only(OnDevice, lambda t: t.held, (args, kwargs))
    device = torch.device(kwargs["device"] if kwargs.get("device") is not None else "standin" if here else "cpu")
    if "device" in kwargs:
        kwargs = kwargs | {"device": torch.device("cpu")}
    elsewhere = [t for t in tensors if not isinstance(t, OnDevice) and t.dim()]
    # CUDA takes indices and copies from either side.
    if here and elsewhere and not name.startswith(("aten::index", "aten::_to_copy", "aten::copy_")):
        raise RuntimeError(f"{name}: tensors on two devices")
    to_host = name == "aten::_to_copy" and here and device.type == "cpu"
    by_mask = name.startswith("aten::index") and any(t.dtype == torch.bool for t in here)
    if name in WAITING or to_host or by_mask:
        _waits.append(name)
    out = func(*args, **kwargs)
    if device.type == "cpu":
        return out.clone() if any(out is t.held for t in here) else out
    known = {id(t.held): t for t in here}  # What an operation in place gives back is what it was given.
    return tree_map_only(Tensor, lambda t: known.get(id(t)) if id(t) in known else OnDevice(t), out)


@contextmanager
def unheeded() -> Iterator[None]:
    """Nobody counts who waits meanwhile."""
    before = len(_waits)
    yield
    del _waits[before:]


def waits() -> int:
    """How often the host has waited for the device so far."""
    return len(_waits)


@cache
def standin() -> str:
    """Its name, for ``.to()``; the first call makes it known to torch."""
    _setup_privateuseone_for_python_backend("standin")
    _library.fallback(lambda func, *args, **kwargs: _run(func, args, kwargs))
    return "standin"


class Drawn(torch.autograd.Function):
    """The torch definition on the CPU, whatever its tensors are on, and nobody counts that."""

    @staticmethod
    def forward(ctx: Any, view: Camera, *tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        with unheeded(), torch.enable_grad():
            ctx.leaves = [t.detach().cpu().clone().requires_grad_() for t in tensors]
            *geometry, colors = ctx.leaves
            r = rasterize(*geometry, colors[:, :3], view, channels=colors[:, 3:], backend="torch")
            ctx.drawn = torch.cat([r.rgb, r.channels, r.depth[None]]).permute(1, 2, 0), r.alpha
            statistics = torch.zeros_like(geometry[0], requires_grad=False)
            alone = [a.detach().requires_grad_() for a in (*geometry, colors[:, :3])]
            rasterize(*alone, view, backend="torch", screen_gradient=statistics).rgb.sum().backward()
            image, alpha, radii = (x.detach().to(tensors[0].device) for x in (*ctx.drawn, statistics[:, 2]))
        ctx.mark_non_differentiable(radii)
        return image, alpha, radii

    @staticmethod
    def backward(ctx: Any, image: Tensor, alpha: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        with unheeded():
            gradients = torch.autograd.grad(ctx.drawn, ctx.leaves, (image.cpu(), alpha.cpu()), materialize_grads=True)
            return None, *(g.to(image.device) for g in gradients)


def definition_as_gsplat(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options):
    """What stands in for gsplat's call where there is no GPU: its arguments and returns, drawn by the definition."""
    assert options == {"near_plane": NEAR, "eps2d": BLUR, "packed": False, "render_mode": "RGB+D"}
    with unheeded():
        T, K = viewmats[0].double().cpu(), Ks[0].cpu().tolist()
    view = Camera(torch.linalg.inv(T).numpy(), K[0][0], K[1][1], K[0][2], K[1][2], width, height)
    # By way of the projected means, so that these get a gradient.
    R, t = T[:3, :3].to(means), T[:3, 3].to(means)
    x, y, z = (means @ R.T + t).unbind(1)
    means2d = torch.stack([view.fx * x / z + view.cx, view.fy * y / z + view.cy], 1)[None]
    u, v = means2d[0].unbind(1)
    centres = torch.stack([(u - view.cx) / view.fx * z, (v - view.cy) / view.fy * z, z], 1)
    image, alpha, radii = Drawn.apply(view, (centres - t) @ R, quats, scales, opacities, colors)
    return image[None], alpha[None, :, :, None], {"means2d": means2d, "radii": radii[None, :, None].expand(-1, -1, 2)}
