"""``views/``: some photographs of a run and the twin from their cameras, kept for the page."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from hingesplat.camera import Camera
from hingesplat.capture.types import View
from hingesplat.files import write_json
from hingesplat.gaussians import Gaussians
from hingesplat.pictures import fitted
from hingesplat.render import render


def spread_views(views: Sequence[View], first: View, count: int) -> list[View]:
    """At most ``count`` of the views: ``first``, then each time the one that looks from farthest aside."""
    directions = np.stack([view.camera.T_world_camera[:3, 2] for view in views])
    nearest = directions @ first.camera.T_world_camera[:3, 2]
    chosen = [first]
    while len(chosen) < min(count, len(views)):
        i = int(nearest.argmin())
        chosen.append(views[i])
        nearest = np.maximum(nearest, directions @ directions[i])
    return chosen


def write_views(
    folder: Path,
    states: Sequence[tuple[Sequence[View], Gaussians]],
    up: np.ndarray,
    *,
    held_out: bool,
    size: int = 480,
) -> None:
    """Write the pictures, cut out of their background, and ``views.json`` that tells of them.

    Args:
        folder: where they go; it exists.
        states: for each state some photographs and the Gaussians as they stand in it; the first photograph of the
            last state is where the page's viewer stands at first.
        up: (3,) away from the ground, world frame.
        held_out: whether the twin was made without these photographs.
        size: longest side of a picture at most, pixels.
    """
    entries = []
    for state, (views, gaussians) in enumerate(states):
        for number, view in enumerate(views):
            camera = fitted(view.camera, min(size, max(view.camera.width, view.camera.height)))
            photo = Image.fromarray(view.rgba, "RGBA").resize((camera.width, camera.height), Image.Resampling.LANCZOS)
            twin = _cut_out(gaussians, camera)
            error = float(np.square(_on_white(photo) - _on_white(twin)).mean())
            names = {what: f"state{state}_{number}_{what}.webp" for what in ("photo", "twin")}
            photo.save(folder / names["photo"], quality=85)
            twin.save(folder / names["twin"], quality=85)
            entries.append(
                {
                    "state": state,
                    "name": view.name,
                    **names,
                    "size": [camera.width, camera.height],
                    "psnr": -10 * math.log10(max(error, 1e-10)),
                    "camera": {"position": view.camera.centre.tolist(), "focal_pixels": view.camera.fy},
                }
            )
    index = {"up": np.asarray(up).tolist(), "held_out": held_out, "views": entries}
    write_json(folder / "views.json", index)


@torch.no_grad()
def _cut_out(gaussians: Gaussians, camera: Camera) -> Image.Image:
    """The render, RGBA with straight alpha."""
    image = render(gaussians, camera)
    alpha = image.alpha[None]
    rgba = torch.cat([image.rgb / alpha.clamp(min=1e-4), alpha]).clamp(0, 1).permute(1, 2, 0)
    return Image.fromarray((rgba.cpu().numpy() * 255).round().astype(np.uint8), "RGBA")


def _on_white(picture: Image.Image) -> np.ndarray:
    """(height, width, 3) in [0, 1]."""
    rgba = np.asarray(picture, np.float64) / 255
    return rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
