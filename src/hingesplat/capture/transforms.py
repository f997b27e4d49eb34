"""transforms.json folders (nerfstudio, Blender): one folder a state."""

import math
from pathlib import Path
from typing import Any

from hingesplat.camera import Camera
from hingesplat.capture.frames import (
    FLIP_YZ,
    Frame,
    StateFrames,
    number,
    reject_distortion,
    require,
    rigid,
    state_folders,
)
from hingesplat.capture.images import image_size
from hingesplat.errors import HingesplatError
from hingesplat.files import read_json

LOOKED_FOR = "STATE/transforms.json or STATE/transforms_train.json (STATE: start, end, state0, state_0, …)"
PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
"""Models whose distortion, if any, is in k1…k4, p1, p2; the others are refused."""


def recognises(root: Path) -> bool:
    """Whether a state folder holds a transforms file."""
    return any(_train_json(folder) for folder in state_folders(root))


def read(root: Path) -> list[StateFrames]:
    """The frames of every state folder; ``transforms_test.json`` gives the test views, if there."""
    states = []
    for folder in state_folders(root):
        train = _train_json(folder)
        if train is None:
            raise HingesplatError(f"{folder}: has no transforms.json or transforms_train.json")
        test = folder / "transforms_test.json"
        test_frames = read_frames(test, root) if test.is_file() else []
        states.append(StateFrames(folder.name, folder, read_frames(train, root), test_frames))
    return states


def _train_json(folder: Path) -> Path | None:
    names = ("transforms_train.json", "transforms.json")
    return next((folder / name for name in names if (folder / name).is_file()), None)


def frame_dicts(data: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    """The ``frames`` list of a transforms file, checked to be a list of objects."""
    frames = require(data, "frames", str(path))
    if not isinstance(frames, list) or not all(isinstance(f, dict) for f in frames):
        raise HingesplatError(f'{path}: "frames" must be a list of objects')
    return frames


def read_frames(path: Path, root: Path) -> list[Frame]:
    """The frames of one transforms file, in file order; names are relative to ``root``."""
    data = read_json(path)
    return [read_frame(f, i, data, path, root) for i, f in enumerate(frame_dicts(data, path))]


def read_frame(frame: dict[str, Any], index: int, data: dict[str, Any], path: Path, root: Path) -> Frame:
    """One entry of ``frames``; its own intrinsics win over the file's.

    Raises HingesplatError naming file, frame and key.
    """
    where = f"{path}: frame {index}"
    file_path = require(frame, "file_path", where)
    image = _image_path(path.parent, file_path, where)
    where = f"{where} ({file_path})"
    c2w_opengl = rigid(require(frame, "transform_matrix", where), f"{where}: transform_matrix")
    width, height = image_size(image, where)
    return Frame(
        camera=_lens(frame, data, width, height, c2w_opengl @ FLIP_YZ, where),
        image=image,
        name=image.relative_to(root).as_posix() if image.is_relative_to(root) else str(image),
        mask=_companion(frame, "mask_path", path.parent, where),
        depth=_companion(frame, "depth_file_path", path.parent, where),
        depth_unit=number(frame.get("depth_unit", data.get("depth_unit", 0.001)), f"{where}: depth_unit"),
    )


def _image_path(folder: Path, file_path: Any, where: str) -> Path:
    """The image of a frame; Blender's file paths lack the suffix."""
    if not isinstance(file_path, str):
        raise HingesplatError(f'{where}: "file_path" must be text')
    exact = folder / file_path
    tries = [exact] + [exact.with_name(exact.name + s) for s in (".png", ".jpg", ".jpeg")]
    found = next((p for p in tries if p.is_file()), None)
    if found is None:
        raise HingesplatError(f"{where}: image {exact} does not exist")
    return found


def _companion(frame: dict[str, Any], key: str, folder: Path, where: str) -> Path | None:
    """The file that an optional key names."""
    if not frame.get(key):
        return None
    path = folder / str(frame[key])
    if not path.is_file():
        raise HingesplatError(f"{where}: {key} {path} does not exist")
    return path


def _lens(
    frame: dict[str, Any], data: dict[str, Any], width: int, height: int, T_world_camera: Any, where: str
) -> Camera:
    """Intrinsics from ``fl_x … h`` or ``camera_angle_x``, of the frame if it has them, else of the file."""

    def get(key: str, default: float) -> float:
        return number(frame.get(key, data.get(key, default)), f"{where}: {key}")

    w, h = get("w", width), get("h", height)
    if (w, h) != (width, height):
        raise HingesplatError(f"{where}: the image is {width}×{height} pixels, but w, h say {w:g}×{h:g}")
    fx = fy = 0.0
    for source in (frame, data):
        if "fl_x" in source:
            fx = number(source["fl_x"], f"{where}: fl_x")
            fy = number(source.get("fl_y", fx), f"{where}: fl_y")
        elif "camera_angle_x" in source:
            angle = number(source["camera_angle_x"], f"{where}: camera_angle_x")
            if not 0 < angle < math.pi:
                raise HingesplatError(f"{where}: camera_angle_x must lie between 0 and π, not {angle:g}")
            fx = fy = 0.5 * width / math.tan(angle / 2)
        else:
            continue
        break
    else:
        raise HingesplatError(f'{where}: lacks the key "fl_x" (or "camera_angle_x")')
    if fx <= 0 or fy <= 0:
        raise HingesplatError(f"{where}: the focal length must be positive, not {fx:g}, {fy:g}")
    model = frame.get("camera_model", data.get("camera_model", "PINHOLE"))
    if model not in PINHOLE_MODELS:
        raise HingesplatError(f"{where}: camera_model {model} is not a pinhole; undistort the images first")
    radial = [get(k, 0.0) for k in ("k1", "k2", "k3", "k4")]
    reject_distortion(min(fx, fy), width, height, radial, (get("p1", 0.0), get("p2", 0.0)), where)
    return Camera(T_world_camera, fx, fy, get("cx", width / 2), get("cy", height / 2), width, height)
