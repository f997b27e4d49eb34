"""COLMAP sparse models, binary or text, both states registered in one model.

Format: https://colmap.github.io/format.html. Version 4 adds ``rigs`` and ``frames``, but still writes every
image's pose to ``images``, so those two are not needed; neither are the points.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hingesplat.camera import Camera
from hingesplat.capture.frames import Frame, StateFrames, is_state_name, natural_key, reject_distortion, rigid
from hingesplat.capture.images import image_size
from hingesplat.errors import HingesplatError

LOOKED_FOR = "cameras.bin/.txt and images.bin/.txt in sparse/0, sparse or the root (COLMAP)"

MODELS: dict[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
}
"""Model id to name and number of parameters, of those we can read; the others are fisheyes and the like."""


@dataclass(frozen=True)
class _Lens:
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class _Image:
    name: str
    camera_id: int
    quat: tuple[float, ...]
    """World to camera, wxyz."""
    t: tuple[float, ...]


def recognises(root: Path) -> bool:
    """Whether a sparse model lies in one of the usual places."""
    return _model(root) is not None


def read(root: Path) -> list[StateFrames]:
    """One state for each image folder; a ``test`` folder inside it holds its test views."""
    model = _model(root)
    assert model is not None
    folder, suffix = model
    lenses = _read(folder / f"cameras{suffix}", _cameras_bin if suffix == ".bin" else _cameras_txt)
    images = _read(folder / f"images{suffix}", _images_bin if suffix == ".bin" else _images_txt)
    states: dict[str, StateFrames] = {}
    for image in sorted(images, key=lambda i: natural_key(i.name)):
        where = f"{folder / f'images{suffix}'}: image {image.name}"
        state, inside = _state_of(image.name, where)
        frame = _frame(image, dict(lenses), root, where)
        # As many parents up as there are folders below the state's.
        entry = states.setdefault(state, StateFrames(state, frame.image.parents[len(inside)], [], []))
        (entry.test if "test" in inside else entry.train).append(frame)
    return sorted(states.values(), key=lambda s: natural_key(s.name))


def _model(root: Path) -> tuple[Path, str] | None:
    """Folder and suffix of the first sparse model found."""
    for folder in (root / "sparse" / "0", root / "sparse", root):
        for suffix in (".bin", ".txt"):
            if (folder / f"cameras{suffix}").is_file() and (folder / f"images{suffix}").is_file():
                return folder, suffix
    return None


def _state_of(name: str, where: str) -> tuple[str, tuple[str, ...]]:
    """State and the folders below it; the folder named like a state, or else the first, tells the state."""
    folders = Path(name).parts[:-1]
    if not folders:
        raise HingesplatError(f"{where}: has no folder that tells its state; name images STATE/IMAGE")
    i = next((i for i, f in enumerate(folders) if is_state_name(f)), 0)
    return folders[i], folders[i + 1 :]


def _frame(image: _Image, lenses: dict[int, _Lens], root: Path, where: str) -> Frame:
    lens = lenses.get(image.camera_id)
    if lens is None:
        raise HingesplatError(f"{where}: its camera {image.camera_id} is not in the cameras file")
    quat = np.array(image.quat)
    T_camera_world = np.eye(4)
    if np.isfinite(quat).all() and np.linalg.norm(quat) > 0:
        T_camera_world[:3, :3] = Rotation.from_quat(np.roll(quat, -1)).as_matrix()
    else:
        T_camera_world[:3, :3] = np.nan
    T_camera_world[:3, 3] = image.t
    path = root / image.name
    if not path.is_file():
        path = root / "images" / image.name
    size = image_size(path, where)
    if size != (lens.width, lens.height):
        raise HingesplatError(
            f"{where}: {path} is {size[0]}×{size[1]} pixels, but its camera says {lens.width}×{lens.height}"
        )
    T_world_camera = np.linalg.inv(rigid(T_camera_world, where))
    camera = Camera(T_world_camera, lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height)
    return Frame(camera, path, (path.relative_to(root) if path.is_relative_to(root) else path).as_posix())


def _lens(model: str, width: int, height: int, params: tuple[float, ...], where: str) -> _Lens:
    """Pinhole intrinsics; raises HingesplatError for other models and for a distortion that matters."""
    if model not in {name for name, _ in MODELS.values()}:
        raise HingesplatError(f"{where}: camera model {model} is not a pinhole; run COLMAP's image_undistorter first")
    two_focals = model in ("PINHOLE", "OPENCV")
    fx, fy, cx, cy = params[:4] if two_focals else (params[0], params[0], params[1], params[2])
    rest = params[4:] if two_focals else params[3:]
    if not np.isfinite(params).all() or min(fx, fy) <= 0:
        raise HingesplatError(f"{where}: its parameters {params} are no lens")
    reject_distortion(min(fx, fy), width, height, rest[:2], rest[2:], where)
    return _Lens(width, height, fx, fy, cx, cy)


def _read(path: Path, parse) -> list:
    """Everything a parser yields; a file that ends early or holds no numbers is a HingesplatError."""
    try:
        return list(parse(path))
    except (struct.error, IndexError, ValueError) as e:
        raise HingesplatError(f"{path}: is truncated or not a COLMAP file ({e})") from e
    except OSError as e:
        raise HingesplatError(f"{path}: cannot be read ({e.strerror or e})") from e


def _cameras_bin(path: Path) -> Iterator[tuple[int, _Lens]]:
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        camera_id, model_id, width, height = struct.unpack_from("<iiQQ", data, at)
        model, size = MODELS.get(model_id, (f"number {model_id}", 0))
        params = struct.unpack_from(f"<{size}d", data, at + 24)
        at += 24 + 8 * size
        yield camera_id, _lens(model, width, height, params, f"{path}: camera {camera_id}")


def _images_bin(path: Path) -> Iterator[_Image]:
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        _, *pose, camera_id = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode()
        (observations,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * observations
        yield _Image(name, camera_id, tuple(pose[:4]), tuple(pose[4:]))


def _lines(path: Path) -> list[str]:
    """Lines but for comments; empty ones stay, since an image without points has an empty second line."""
    return [s for s in path.read_text(encoding="utf-8").splitlines() if not s.startswith("#")]


def _cameras_txt(path: Path) -> Iterator[tuple[int, _Lens]]:
    for line in filter(str.strip, _lines(path)):
        camera_id, model, width, height, *params = line.split()
        where = f"{path}: camera {camera_id}"
        yield int(camera_id), _lens(model, int(width), int(height), tuple(map(float, params)), where)


def _images_txt(path: Path) -> Iterator[_Image]:
    for line in _lines(path)[::2]:
        if not line.strip():
            continue
        _, *pose, camera_id, name = line.split(maxsplit=9)
        numbers = tuple(map(float, pose))
        yield _Image(name.strip(), int(camera_id), numbers[:4], numbers[4:])
