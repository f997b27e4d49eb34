"""Pictures for people: ``summary.png`` (photographs, renders, parts), ``motion.gif`` (the joints moving)."""

import colorsys
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from hingesplat.camera import Camera
from hingesplat.capture.types import View
from hingesplat.files import whole_file
from hingesplat.gaussians import SH_C0, Gaussians, posed
from hingesplat.render import render
from hingesplat.twin import Joint, Twin

_BASE = (0.78, 0.78, 0.80)
_GAP = 12  # pixels between pictures
_INK = (60, 60, 66)


def part_colour(part_id: int) -> tuple[float, float, float]:
    """Rgb in [0, 1]: grey for the base, then hues a golden angle apart, so that any number stays distinct."""
    if part_id == 0:
        return _BASE
    hue = (0.02 + (part_id - 1) * 0.381966) % 1.0
    return colorsys.hsv_to_rgb(hue, 0.85, 0.95)


def in_part_colours(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians in the colours of their parts; a little of their own brightness shows the shape."""
    ids, which = gaussians.part.unique(return_inverse=True)
    colours = torch.tensor([part_colour(int(i)) for i in ids]).to(gaussians.means).reshape(-1, 3)[which]
    own = (0.5 + SH_C0 * gaussians.sh[:, 0]).clamp(0, 1).mean(1, keepdim=True)
    return replace(gaussians, sh=((colours * (0.55 + 0.45 * own) - 0.5) / SH_C0)[:, None])


def write_summary(
    path: Path,
    gaussians: Gaussians,
    states: Sequence[tuple[View, Mapping[int, np.ndarray]]],
    *,
    size: int = 400,
) -> None:
    """A grid PNG: a row a state; photograph, render and parts in colour, all from the photograph's camera.

    Args:
        path: the PNG, written whole or not at all.
        gaussians: in state 0, with part ids.
        states: for each state a photograph and its part poses ``{part id: T_state_part0}``, as
            ``Twin.at_state`` gives them.
        size: longest side of each picture, pixels.
    """
    rows = []
    for view, poses in states:
        camera = fitted(view.camera, size)
        scene = posed(gaussians.detached(), poses)
        rows.append([photograph(view, camera), picture(scene, camera), picture(in_part_colours(scene), camera)])
    with whole_file(path) as tmp:
        _grid(rows, ("photograph", "twin", "parts")).save(tmp, "PNG")


def write_motion_gif(
    path: Path,
    gaussians: Gaussians,
    twin: Twin,
    camera: Camera,
    *,
    frames: int = 48,
    size: int = 360,
    max_bytes: int = 3_000_000,
) -> None:
    """A looping GIF: the joints, one after another, through their whole range and back, on white.

    Args:
        path: the GIF, written whole or not at all.
        gaussians: in state 0, with part ids.
        twin: whose joints move; without any the GIF is a still.
        camera: the viewpoint, world frame.
        frames: of the loop; 20 a second.
        size: longest side, pixels.
        max_bytes: the pictures shrink until the file is at most this long.
    """
    camera = fitted(camera, size)
    scene = gaussians.detached()
    moving = [j for j in twin.joints if j.type != "fixed"]
    times = np.arange(frames if moving else 1) / frames
    pictures = [picture(posed(scene, twin.transforms(sweep_values(moving, t))), camera) for t in times]
    data = encode_gif(pictures)
    while len(data) > max_bytes and min(pictures[0].size) > 32:
        smaller = tuple(int(0.85 * s) for s in pictures[0].size)
        pictures = [p.resize((smaller[0], smaller[1]), Image.Resampling.LANCZOS) for p in pictures]
        data = encode_gif(pictures)
    with whole_file(path) as tmp:
        tmp.write_bytes(data)


def sweep_values(joints: Sequence[Joint], time: float) -> dict[int, float]:
    """Joint values by child at a time in [0, 1): each has its turn, half of it shared with the next one's."""
    turn = 2 / (len(joints) + 1)
    return {j.child: _sweep(j, (time - i * turn / 2) / turn) for i, j in enumerate(joints)}


def _sweep(joint: Joint, phase: float) -> float:
    """From rest (state 0) to both limits and back while the phase goes from 0 to 1, easing at the ends."""
    low, high = joint.limits
    rest = min(max(0.0, low), high)
    stops = [rest]
    for stop in [*sorted((low, high), key=lambda v: -abs(v - rest)), rest]:
        if abs(stop - stops[-1]) > 1e-9:
            stops.append(stop)
    if len(stops) == 1 or not 0 < phase < 1:
        return rest
    lengths = np.abs(np.diff(stops))
    ends = np.concatenate([[0], np.cumsum(lengths) / lengths.sum()])
    leg = min(int(np.searchsorted(ends, phase, "right")) - 1, len(lengths) - 1)
    share = (phase - ends[leg]) / (ends[leg + 1] - ends[leg])
    ease = (1 - math.cos(math.pi * share)) / 2
    return float(stops[leg] + ease * (stops[leg + 1] - stops[leg]))


def fitted(camera: Camera, size: int) -> Camera:
    """The same view, its longest side ``size`` pixels."""
    shrink = size / max(camera.width, camera.height)
    return camera.scaled(max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink)))


def photograph(view: View, camera: Camera) -> Image.Image:
    """A photograph on white, at the camera's size."""
    photo = Image.fromarray(view.rgba, "RGBA")
    white = Image.new("RGBA", photo.size, "white")
    photo = Image.alpha_composite(white, photo).convert("RGB")
    return photo.resize((camera.width, camera.height), Image.Resampling.LANCZOS)


def picture(gaussians: Gaussians, camera: Camera) -> Image.Image:
    """What the camera sees, on white."""
    with torch.no_grad():
        rgb: Tensor = render(gaussians, camera, background=torch.ones(3)).rgb
    return Image.fromarray((rgb.clamp(0, 1).permute(1, 2, 0).cpu().numpy() * 255).round().astype(np.uint8))


@torch.no_grad()
def movable_share(gaussians: Gaussians, camera: Camera, size: int = 64) -> float:
    """How much of the camera's picture movable parts cover, 0 to 1, judged at ``size`` pixels."""
    movable = (gaussians.part > 0).to(gaussians.means)[:, None]
    return float(render(gaussians, fitted(camera, size), channels=movable).channels.mean())


def _grid(rows: list[list[Image.Image]], titles: Sequence[str]) -> Image.Image:
    font = ImageFont.load_default(18)
    head = 30
    width = max(p.width for row in rows for p in row)
    heights = [max(p.height for p in row) for row in rows]
    sheet = Image.new("RGB", (len(titles) * (width + _GAP) + _GAP, head + sum(heights) + _GAP * len(rows)), "white")
    draw = ImageDraw.Draw(sheet)
    for column, title in enumerate(titles):
        draw.text((_GAP + column * (width + _GAP) + width / 2, head / 2), title, _INK, font, anchor="mm")
    top = head
    for number, (row, height) in enumerate(zip(rows, heights, strict=True)):
        for column, picture in enumerate(row):
            sheet.paste(picture, (_GAP + column * (width + _GAP), top))
        draw.text((_GAP + 6, top + 4), f"state {number}", _INK, font)
        top += height + _GAP
    return sheet


def encode_gif(pictures: Sequence[Image.Image], fps: float = 20) -> bytes:
    """A looping GIF of at most 50 frames a second; one palette for all of them, so that nothing flickers."""
    step = max(1, len(pictures) // 6)
    samples = pictures[::step]
    strip = Image.new("RGB", (sum(p.width for p in samples), samples[0].height))
    for i, picture in enumerate(samples):
        strip.paste(picture, (i * picture.width, 0))
    palette = strip.quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    colours = np.array(palette.getpalette(), np.uint8).reshape(-1, 3)
    colours[(colours > 247).all(1)] = 255  # white stays white
    palette.putpalette(colours.ravel().tolist())
    indexed = [p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]
    # A frame lasts whole hundredths of a second: some longer, some shorter, so that the whole keeps time.
    lengths = np.diff(np.round(np.arange(len(indexed) + 1) * 100 / fps)).astype(int) * 10
    file = io.BytesIO()
    indexed[0].save(
        file, "GIF", save_all=True, append_images=indexed[1:], duration=lengths.tolist(), loop=0, disposal=1
    )
    return file.getvalue()
