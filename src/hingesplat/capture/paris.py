"""The layout of PARIS: ``STATE/camera_{train,test}.json`` beside ``STATE/{train,test}/0000.png``."""

from pathlib import Path

import numpy as np

from hingesplat.camera import Camera
from hingesplat.capture.frames import (
    FLIP_YZ,
    Frame,
    StateFrames,
    natural_key,
    require,
    rigid,
    state_folders,
)
from hingesplat.capture.images import image_size
from hingesplat.errors import HingesplatError
from hingesplat.files import read_json

LOOKED_FOR = "STATE/camera_train.json (PARIS)"


def recognises(root: Path) -> bool:
    """Whether a state folder holds ``camera_train.json``."""
    return any((folder / "camera_train.json").is_file() for folder in state_folders(root))


def read(root: Path) -> list[StateFrames]:
    """Train and test views of every state; ``val`` is not used."""
    states = []
    for folder in state_folders(root):
        test = _split(folder, "test", root) if (folder / "camera_test.json").is_file() else []
        states.append(StateFrames(folder.name, folder, _split(folder, "train", root), test))
    return states


def _split(folder: Path, split: str, root: Path) -> list[Frame]:
    path = folder / f"camera_{split}.json"
    data = read_json(path)
    try:
        K = np.asarray(require(data, "K", str(path)), dtype=np.float64)
    except (TypeError, ValueError) as e:
        raise HingesplatError(f"{path}: K is not a 3×3 matrix of numbers") from e
    if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise HingesplatError(f"{path}: K is not a 3×3 camera matrix")
    frames = []
    for key in sorted((k for k in data if k != "K"), key=natural_key):
        where = f"{path}: frame {key}"
        image = folder / split / f"{key}.png"
        c2w_opengl = rigid(data[key], where)
        width, height = image_size(image, where)
        camera = Camera(c2w_opengl @ FLIP_YZ, K[0, 0], K[1, 1], K[0, 2], K[1, 2], width, height)
        frames.append(Frame(camera, image, image.relative_to(root).as_posix()))
    return frames
