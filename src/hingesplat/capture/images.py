"""Pixels: decoding, masks, depth and area downsampling."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import sparse

from hingesplat.capture.frames import Frame
from hingesplat.capture.types import View
from hingesplat.errors import HingesplatError

IMAGE_FOLDERS = frozenset({"image", "images", "rgb", "rgba"})
"""Folder names that a mask's path may lack."""


def image_size(path: Path, where: str) -> tuple[int, int]:
    """(width, height) from the header; raises HingesplatError when missing or no image."""
    try:
        with Image.open(path) as im:
            return im.size
    except FileNotFoundError as e:
        raise HingesplatError(f"{where}: image {path} does not exist") from e
    except (OSError, ValueError, Image.DecompressionBombError) as e:
        raise HingesplatError(f"{where}: {path} is not a readable image ({e})") from e


def find_mask(frame: Frame, root: Path, state: str, folder: Path, masks: Path | None) -> Path | None:
    """The mask of a frame in the given mask folder, or else in ``CAPTURE/masks`` or ``STATE/masks``.

    A mask lies at its image's path relative to the state (below ``masks/STATE`` or ``STATE/masks``), with or
    without an ``images``/``rgb`` component, named ``stem.png`` or ``name.png`` (COLMAP) or as the image.
    """
    image = frame.image
    inside = image.relative_to(folder) if image.is_relative_to(folder) else Path(image.name)
    bare = Path(*(p for p in inside.parts[:-1] if p.lower() not in IMAGE_FOLDERS), inside.name)
    bases = [masks / state] if masks else [root / "masks" / state, folder / "masks"]
    for base in bases:
        for relative in dict.fromkeys((inside, bare)):
            names = (f"{image.stem}.png", f"{image.name}.png", image.name)
            for name in names:
                candidate = base / relative.parent / name
                if candidate.is_file() and candidate != image:
                    return candidate
    return None


def load_view(frame: Frame, mask: Path | None, forced: bool, max_size: int | None, with_depth: bool) -> View:
    """Decode one frame.

    ``mask`` is used when ``forced`` or when the image has no transparency of its own. Raises HingesplatError
    for broken files, wrong sizes and missing masks.
    """
    size = (frame.camera.width, frame.camera.height)
    rgba = _rgba(frame)
    if mask is not None and (forced or rgba[..., 3].min() == 255):
        rgba[..., 3] = _mask(mask, size, frame.name)
    elif rgba[..., 3].min() == 255:
        raise HingesplatError(
            f"{frame.name}: has no mask (it is opaque everywhere); save it as RGBA with the object's mask as "
            "alpha, put masks in a masks/ folder beside the images, or pass --masks DIR (DIR/STATE/IMAGE.png)"
        )
    depth = _depth(frame) if with_depth and frame.depth is not None else None
    view = View(frame.camera, rgba, frame.name, depth)
    return view if max_size is None else downsampled(view, max_size)


def downsampled(view: View, max_size: int) -> View:
    """The view with its longer side ``max_size`` pixels at most, intrinsics following.

    Exact area filter; colours are weighted by alpha, so the background's colour does not bleed in. Depth is
    sampled, not averaged, since a mean across an edge lies on neither surface.
    """
    height, width = view.rgba.shape[:2]
    if max(width, height) <= max_size:
        return view
    scale = max_size / max(width, height)
    w, h = max(1, round(width * scale)), max(1, round(height * scale))
    depth = view.depth
    if depth is not None:
        rows = ((np.arange(h) + 0.5) * height / h).astype(int)
        columns = ((np.arange(w) + 0.5) * width / w).astype(int)
        depth = depth[rows[:, None], columns[None, :]]
    return replace(view, camera=view.camera.scaled(w, h), rgba=_area_resize(view.rgba, w, h), depth=depth)


def _area_resize(rgba: np.ndarray, width: int, height: int) -> np.ndarray:
    """Alpha-weighted mean of each target pixel's footprint; (H, W, 4) uint8 to (height, width, 4) uint8."""
    H, W = rgba.shape[:2]
    premultiplied = rgba.astype(np.float32)
    premultiplied[..., :3] *= premultiplied[..., 3:] / 255
    rows = _area_weights(H, height) @ premultiplied.reshape(H, W * 4)
    columns = rows.reshape(height, W, 4).transpose(1, 0, 2).reshape(W, height * 4)
    mean = (_area_weights(W, width) @ columns).reshape(width, height, 4).transpose(1, 0, 2)
    colour = mean[..., :3] * 255 / np.maximum(mean[..., 3:], 1e-6)
    out = np.concatenate([colour, mean[..., 3:]], axis=-1)
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)


@lru_cache(maxsize=32)
def _area_weights(n: int, m: int) -> sparse.csr_array:
    """(m, n) weights: the share of source pixel j in the footprint of target pixel i; rows sum to one."""
    edges = np.arange(m + 1) * (n / m)
    first = np.floor(edges[:-1]).astype(int)
    reach = np.arange(int(np.ceil(n / m)) + 1)
    source = first[:, None] + reach
    overlap = np.minimum(source + 1, edges[1:, None]) - np.maximum(source, edges[:-1, None])
    keep = (overlap > 1e-9) & (source < n)
    target = np.broadcast_to(np.arange(m)[:, None], source.shape)
    weights = (overlap[keep] * (m / n)).astype(np.float32)
    return sparse.csr_array((weights, (target[keep], source[keep])), shape=(m, n))


def _open(path: Path, size: tuple[int, int], where: str) -> Image.Image:
    """A decoded image of the given (width, height)."""
    try:
        with Image.open(path) as image:
            image.load()
    except FileNotFoundError as e:
        raise HingesplatError(f"{where}: {path} does not exist") from e
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as e:
        raise HingesplatError(f"{where}: {path} is truncated or no image ({e})") from e
    if image.size != size:
        has, wants = f"{image.size[0]}×{image.size[1]}", f"{size[0]}×{size[1]}"
        raise HingesplatError(f"{where}: {path} is {has} pixels, but its camera says {wants}")
    return image


def _rgba(frame: Frame) -> np.ndarray:
    """(h, w, 4) uint8, writable; opaque where the file has no transparency."""
    image = _open(frame.image, (frame.camera.width, frame.camera.height), frame.name)
    if image.mode.startswith(("I", "F")):
        raise HingesplatError(f"{frame.name}: images must have 8 bits a channel, not PIL mode {image.mode}")
    return np.array(image.convert("RGBA"))


def _mask(path: Path, size: tuple[int, int], where: str) -> np.ndarray:
    """(h, w) uint8 mask: transparency if it varies, else grey; labels and 0/1 images count as non-zero."""
    image = _open(path, size, where)
    if "A" in image.getbands():
        alpha = np.array(image.getchannel("A"))
        if alpha.min() < 255:
            return alpha
    if image.mode in ("RGB", "RGBA", "LA", "CMYK", "YCbCr"):
        image = image.convert("RGB").convert("L")
    values = np.array(image)
    if image.mode == "L" and values.max() > 1:
        return values
    return np.where(values > 0, 255, 0).astype(np.uint8)


def _depth(frame: Frame) -> np.ndarray:
    """(h, w) float32 in scene units, 0 where unknown."""
    assert frame.depth is not None
    image = _open(frame.depth, (frame.camera.width, frame.camera.height), frame.name)
    if len(image.getbands()) != 1:
        raise HingesplatError(f"{frame.name}: depth {frame.depth} must have one channel, not {image.mode}")
    depth = np.array(image).astype(np.float32) * np.float32(frame.depth_unit)
    depth[~np.isfinite(depth) | (depth < frame.min_depth)] = 0
    return depth
