"""Films of a twin: around it, its joints through their range, or one after the other; from the splats."""

import logging
import math
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from PIL import Image

from hingesplat.camera import Camera, look_at
from hingesplat.errors import HingesplatError
from hingesplat.files import whole_file
from hingesplat.gaussians import Gaussians, posed
from hingesplat.pictures import encode_gif, movable_share, sweep_values
from hingesplat.render import render
from hingesplat.training import Report
from hingesplat.twin import Joint, Twin

log = logging.getLogger(__name__)

What = Literal["orbit", "sweep", "both"]
Shot = tuple[float, dict[int, float]]
"""How far the camera has gone around the object, radians, and the joint values by child."""

FIELD_OF_VIEW = math.radians(30)
ELEVATION = math.radians(24)
"""Of the camera above the object's middle."""
FILLED = 0.92
"""Share of the picture's side that the object takes where it is largest."""
BOTTOM = 0.9
"""Grey to which the white background fades downwards."""


def write_video(
    path: Path,
    gaussians: Gaussians,
    twin: Twin,
    *,
    what: What = "both",
    up: np.ndarray | None = None,
    size: int = 720,
    fps: float = 30,
    seconds: float = 8,
    report: Report = lambda **_: None,
) -> None:
    """A looping film; the camera starts where movable parts show best.

    Args:
        path: the file, ``.mp4`` (H.264) or ``.gif``, written whole or not at all.
        gaussians: in state 0, with part ids.
        twin: whose joints move.
        what: ``orbit`` goes once around the resting object, ``sweep`` takes the joints one after another through
            their range and back, ``both`` does the one in the first half and the other in the second.
        up: unit vector (3,), world frame; z if None.
        size: side of the square pictures, pixels.
        fps: pictures a second.
        seconds: of the whole film.
        report: called with ``stage, step, steps`` after each picture.

    Raises:
        HingesplatError: another suffix, numbers that make no sense, no joint to sweep, or no encoder.
    """
    frames = _check(path, size, fps, seconds)
    joints = [j for j in twin.joints if j.type != "fixed"]
    if not joints and what != "orbit":
        if what == "sweep":
            raise HingesplatError("sweep: the twin has no joint that moves; use orbit")
        log.warning("the twin has no joint that moves: the film only goes around it")
        what = "orbit"
    shots = [_shot(what, i / frames, joints) for i in range(frames)]
    cameras = _cameras(gaussians, twin, shots, np.array([0.0, 0.0, 1.0]) if up is None else up, size)
    # A GIF's 256 colours would turn the fading into bands.
    backdrop = np.linspace(1, 1 if path.suffix == ".gif" else BOTTOM, size)[:, None, None]

    def draw() -> Iterator[np.ndarray]:
        for i, ((_, values), camera) in enumerate(zip(shots, cameras, strict=True)):
            yield _frame(posed(gaussians, twin.transforms(values)), camera, backdrop)
            report(stage="render", step=i + 1, steps=frames)

    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as tmp:
        if path.suffix == ".gif":
            tmp.write_bytes(encode_gif([Image.fromarray(frame) for frame in draw()], fps))
        else:
            _write_mp4(tmp, draw(), size, fps)


def _check(path: Path, size: int, fps: float, seconds: float) -> int:
    """The number of frames; raises HingesplatError for what cannot be filmed, before anything is drawn."""
    if path.suffix not in (".mp4", ".gif"):
        raise HingesplatError(f"{path}: films end in .mp4 or .gif")
    if path.is_dir():
        raise HingesplatError(f"{path}: is a folder; name a file")
    if size < 16 or size % 2:
        raise HingesplatError(f"size: must be an even number of pixels, at least 16, not {size}")
    fastest = 50 if path.suffix == ".gif" else 120
    if not 1 <= fps <= fastest:
        raise HingesplatError(f"fps: must be 1 to {fastest} for {path.suffix}, not {fps:g}")
    if not 1 / fps <= seconds <= 600:
        raise HingesplatError(f"seconds: must be at least one frame and at most 600, not {seconds:g}")
    if path.suffix == ".mp4":
        _ffmpeg()
    return round(fps * seconds)


def _ffmpeg() -> str:
    """The encoder's program, which imageio-ffmpeg brings along."""
    try:
        import imageio_ffmpeg
    except ModuleNotFoundError as e:
        raise HingesplatError("mp4 needs imageio-ffmpeg: pip install 'hingesplat[video]', or name a .gif") from e
    try:
        return imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as e:
        raise HingesplatError("mp4: no ffmpeg for this machine; name a .gif") from e


def _write_mp4(path: Path, frames: Iterator[np.ndarray], size: int, fps: float) -> None:
    """H.264 that plays everywhere: 4:2:0, and tagged with the colours it has."""
    colours = "colorspace=bt709:color_primaries=bt709:color_trc=bt709"
    command = [
        *(_ffmpeg(), "-v", "error", "-y"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size}x{size}", "-r", f"{fps:g}", "-i", "-"),
        *("-vf", f"scale=out_color_matrix=bt709:out_range=tv,setparams={colours}"),
        *("-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p"),
        *("-movflags", "+faststart", "-f", "mp4", str(path)),
    ]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin is not None
        try:
            with suppress(BrokenPipeError):  # It says below why it stopped.
                for frame in frames:
                    ffmpeg.stdin.write(frame.tobytes())
            complaint = ffmpeg.communicate()[1].decode(errors="replace")
        except BaseException:
            ffmpeg.kill()
            raise
    if ffmpeg.returncode:
        raise HingesplatError(f"{path.with_suffix('')}: ffmpeg cannot write it ({complaint.strip()[-300:]})")


def _shot(what: What, time: float, joints: Sequence[Joint]) -> Shot:
    """At a time in [0, 1); the turn is slow where the joints are about to move, so that the film loops smoothly."""
    if what == "both":
        what, time = ("orbit", 2 * time) if time < 0.5 else ("sweep", 2 * time - 1)
    if what == "orbit":
        return 2 * math.pi * time - math.sin(2 * math.pi * time), {}
    return 0.0, sweep_values(joints, time)


def _cameras(gaussians: Gaussians, twin: Twin, shots: Sequence[Shot], up: np.ndarray, size: int) -> list[Camera]:
    """A camera a shot, all at one distance from the resting object's middle: as close as no shot is cut off."""
    rest, widest = (
        posed(gaussians, twin.transforms(values))
        for values in ({}, {j.child: max(j.limits, key=abs) for j in twin.joints})
    )
    low, high = np.quantile(rest.means.double().numpy(), [0.002, 0.998], axis=0)
    centre, extent = (low + high) / 2, float(np.linalg.norm(high - low))
    half = math.tan(FIELD_OF_VIEW / 2)

    def camera(azimuth: float, distance: float) -> Camera:
        T = look_at(centre + distance * _direction(azimuth, up), centre, up)
        return Camera(T, size / 2 / half, size / 2 / half, size / 2, size / 2, size, size)

    start = max(2 * math.pi * np.arange(24) / 24, key=lambda a: movable_share(widest, camera(a, 2.5 * extent)))
    rows = (gaussians.opacities >= min(0.3, float(gaussians.opacities.max()))).nonzero()[:, 0]
    solid = gaussians[rows[:: len(rows) // 4000 + 1]]
    reach = 2 * solid.scales.amax(1).double().numpy()
    distance = 0.0
    for turn, values in shots[:: len(shots) // 48 + 1]:
        points = posed(solid, twin.transforms(values)).means.double().numpy() - centre
        x, y, z = (points @ camera(start + turn, 1).T_world_camera[:3, :3]).T
        needed = (np.maximum(abs(x), abs(y)) + reach) / (FILLED * half) - z
        distance = max(distance, float(np.quantile(needed, 0.999)))
    return [camera(start + turn, distance) for turn, _ in shots]


def _direction(azimuth: float, up: np.ndarray) -> np.ndarray:
    """From the object to the camera."""
    side = np.eye(3)[np.abs(up).argmin()]
    side = side - (side @ up) * up
    side /= np.linalg.norm(side)
    level = math.cos(azimuth) * side + math.sin(azimuth) * np.cross(up, side)
    return math.cos(ELEVATION) * level + math.sin(ELEVATION) * up


@torch.no_grad()
def _frame(gaussians: Gaussians, camera: Camera, backdrop: np.ndarray) -> np.ndarray:
    """(size, size, 3) uint8."""
    seen = render(gaussians, camera)
    rgb = seen.rgb.permute(1, 2, 0).cpu().numpy() + (1 - seen.alpha[..., None].cpu().numpy()) * backdrop
    return np.round(255 * rgb.clip(0, 1)).astype(np.uint8)
