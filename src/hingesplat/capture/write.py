"""Writes a state in the layout that ``transforms.py`` reads."""

import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from hingesplat.camera import Camera
from hingesplat.capture.frames import FLIP_YZ
from hingesplat.capture.types import View
from hingesplat.files import whole_file


def write_state(folder: Path, views: Sequence[View], split: str) -> Path:
    """Write one split (``train`` or ``test``) of one state; returns the path of its JSON.

    ``folder`` (``CAPTURE/state0``) gets ``{split}/000.png`` (RGBA), ``depth/{split}_000.png`` (uint16 ×
    ``depth_unit``, 0 = unknown) for views with depth, and ``transforms_{split}.json`` last, so that a folder
    with a JSON is complete. Poses are written camera-to-world with OpenGL axes.
    """
    (folder / split).mkdir(parents=True, exist_ok=True)
    unit = _depth_unit(views)
    shared = _intrinsics(views[0].camera) if views else {}
    same_lens = all(_intrinsics(v.camera) == shared for v in views)
    frames = []
    for i, view in enumerate(views):
        frame: dict = {"file_path": f"{split}/{i:03d}.png"}
        _write_png(folder / frame["file_path"], view.rgba)
        if view.depth is not None:
            frame["depth_file_path"] = f"depth/{split}_{i:03d}.png"
            stored = np.clip(np.round(np.nan_to_num(view.depth) / unit), 0, 65535).astype(np.uint16)
            _write_png(folder / frame["depth_file_path"], stored)
        if not same_lens:
            frame |= _intrinsics(view.camera)
        frame["transform_matrix"] = (view.camera.T_world_camera @ FLIP_YZ).tolist()
        frames.append(frame)
    header = {"camera_model": "PINHOLE"} | (shared if same_lens else {}) | {"depth_unit": unit}
    path = folder / f"transforms_{split}.json"
    _write_whole(path, json.dumps(header | {"frames": frames}, indent=1).encode())
    return path


def _intrinsics(camera: Camera) -> dict[str, float]:
    """The JSON keys of a camera's lens, pixels."""
    return {
        "fl_x": float(camera.fx),
        "fl_y": float(camera.fy),
        "cx": float(camera.cx),
        "cy": float(camera.cy),
        "w": int(camera.width),
        "h": int(camera.height),
    }


def _depth_unit(views: Sequence[View]) -> float:
    """Millimetres, or the coarser power of ten that lets the farthest depth fit 16 bits."""
    far = max((float(np.nanmax(v.depth)) for v in views if v.depth is not None), default=0.0)
    unit = 0.001
    while far > 65535 * unit:
        unit *= 10
    return unit


def _write_png(path: Path, pixels: np.ndarray) -> None:
    """uint8 (h, w, 4) or uint16 (h, w) to a PNG, whole or not at all."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, format="PNG", compress_level=4)
    _write_whole(path, buffer.getvalue())


def _write_whole(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as tmp:
        tmp.write_bytes(data)
