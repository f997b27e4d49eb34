"""Pictures of the twin beside the test photographs: PSNR, SSIM, and which part is seen where."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from hingesplat.capture import State, View, load_capture
from hingesplat.errors import HingesplatError
from hingesplat.gaussians import Gaussians, posed
from hingesplat.losses.photometric import psnr, ssim
from hingesplat.metrics.truth import Truth
from hingesplat.render import render
from hingesplat.twin import Twin

BEST_PSNR = 100.0
"""Equal pictures have no finite PSNR; JSON has no infinity."""


@dataclass(frozen=True)
class ViewScores:
    """Means over the test views of both states."""

    psnr: float
    """dB, white background."""
    ssim: float
    psnr_by_state: tuple[float, ...]
    part_iou: float | None
    """Mean over the base and the true movers; None where the truth has no part-id pictures."""
    part_iou_each: dict[str, float]
    count: int
    """Views compared."""


def state_gaussians(run: Path, twin: Twin, state: int) -> Gaussians:
    """The Gaussians of a run as they stand in an input state.

    ``gaussians_state{t}.safetensors``, with colours of its own for the state, wins over the canonical file,
    which the twin's joints move there.

    Raises:
        HingesplatError: neither file is there, or one is broken.
    """
    own = run / f"gaussians_state{state}.safetensors"
    if own.is_file():
        return Gaussians.load(own)
    return posed(Gaussians.load(run / "gaussians.safetensors"), twin.at_state(state))


def score_views(
    run: Path,
    twin: Twin,
    truth: Truth,
    true_of_found: dict[int, int],
    capture: Path,
    max_size: int | None = None,
    masks: Path | None = None,
) -> ViewScores:
    """Render the run at every test view of its capture and compare.

    Args:
        true_of_found: part id of the twin → index of the true part; ids not in it match nothing.
        max_size, masks: as in ``load_capture``.

    Raises:
        HingesplatError: Gaussians or photographs missing, no test view, or a part-id picture of another size.
    """
    states = load_capture(capture, max_size=max_size, masks=masks).states[:2]
    if not all(state.test for state in states):
        raise HingesplatError(f"{capture}: a state has no test views to compare with")
    dbs: list[list[float]] = [[], []]
    similarity: list[float] = []
    overlap, union = np.zeros(len(truth.parts)), np.zeros(len(truth.parts))
    for t, state in enumerate(states):
        gaussians = state_gaussians(run, twin, t)
        belongs = _part_channels(gaussians, true_of_found, len(truth.parts))
        for view, stem in _with_stems(state):
            with torch.no_grad():
                drawn = render(gaussians, view.camera, background=torch.ones(3), channels=belongs)
                image, photo = drawn.rgb.clamp(0, 1), _on_white(view)
                dbs[t].append(min(float(psnr(image, photo)), BEST_PSNR))
                similarity.append(float(ssim(image, photo)))
            picture = truth.part_picture(t, stem)
            if picture.is_file():
                true = _true_parts(picture, truth, view)
                seen = _seen_parts(drawn.channels.numpy(), drawn.alpha.numpy())
                for k in range(len(truth.parts)):
                    overlap[k] += ((seen == k) & (true == k)).sum()
                    union[k] += ((seen == k) | (true == k)).sum()
    each = {p.name: float(o / u) for p, o, u in zip(truth.parts, overlap, union, strict=True) if u}
    return ViewScores(
        psnr=float(np.mean(dbs[0] + dbs[1])),
        ssim=float(np.mean(similarity)),
        psnr_by_state=tuple(float(np.mean(d)) for d in dbs),
        part_iou=float(np.mean(list(each.values()))) if union.any() else None,
        part_iou_each=each if union.any() else {},
        count=len(similarity),
    )


def _with_stems(state: State) -> list[tuple[View, str]]:
    return [(view, Path(view.name).stem) for view in state.test]


def _on_white(view: View) -> torch.Tensor:
    """(3, height, width) in 0 … 1."""
    rgba = torch.from_numpy(view.rgba.astype(np.float32) / 255)
    rgb, alpha = rgba[..., :3], rgba[..., 3:]
    return (rgb * alpha + 1 - alpha).permute(2, 0, 1).contiguous()


def _part_channels(gaussians: Gaussians, true_of_found: dict[int, int], true_parts: int) -> torch.Tensor:
    """One-hot true part of each Gaussian (n, true parts + 1); last column: parts that match nothing."""
    column = torch.full_like(gaussians.part, true_parts)
    for found, true in true_of_found.items():
        column[gaussians.part == found] = true
    return torch.nn.functional.one_hot(column, true_parts + 1).to(gaussians.means)


def _seen_parts(channels: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Index of the true part each pixel shows, −1 for the background and for parts that match nothing."""
    seen = channels.argmax(0)
    return np.where((alpha > 0.5) & (seen < len(channels) - 1), seen, -1)


def _true_parts(picture: Path, truth: Truth, view: View) -> np.ndarray:
    """The same from a part-id picture, at the size of the view."""
    with Image.open(picture) as image:
        if image.size[0] * view.camera.height != image.size[1] * view.camera.width:
            raise HingesplatError(f"{picture}: {image.size}, but the test view {view.name} has another shape")
        size = (view.camera.width, view.camera.height)
        grey = np.asarray(image.convert("L").resize(size, Image.Resampling.NEAREST))
    index = np.full(256, -1)
    for value, part in truth.picture_ids.items():
        index[value] = part
    return index[grey]
