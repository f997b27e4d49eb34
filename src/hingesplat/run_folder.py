"""A run's folder: whose it is, what it may take over from others, and what is read from it."""

import json
import logging
import platform
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from hashlib import blake2b
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from safetensors.torch import save_file
from torch import Tensor

from hingesplat.camera import common_up
from hingesplat.capture import Capture, load_cameras
from hingesplat.errors import HingesplatError
from hingesplat.files import read_json, whole_file, write_json
from hingesplat.gaussians import Gaussians
from hingesplat.logs import heard_by
from hingesplat.physics import RepelConfig, draw_repel_points
from hingesplat.twin import Twin

ARTEFACTS = (
    *("config.json", "stages.json", "log.txt", "depth_state*.safetensors", "fit_state*.safetensors", "segmentation.*"),
    *("alignment.safetensors", "canonical.safetensors", "articulation.safetensors", "gaussians*.safetensors"),
    *("twin.json", "parts", "export", "curves.json", "views", "motion.gif", "summary.*", "metrics.json", "report.html"),
    "*.tmp",
)
"""Everything that a run folder holds; ``overwrite`` deletes these and nothing else."""
Inherited = Mapping[str, tuple[Sequence[str], str]]


# What others read from it.


def load_result(folder: Path) -> tuple[Gaussians, Twin]:
    """The Gaussians, frame of state 0, and the twin of a run.

    Raises:
        HingesplatError: no such run, one that has not come this far, or something broken.
    """
    if not folder.is_dir():
        raise HingesplatError(f"{folder}: no such run folder")
    if (folder / "stages.json").is_file() and not (folder / "twin.json").is_file():
        raise HingesplatError(f"{folder}: its run is not finished; give the same `hingesplat reconstruct` again")
    twin = Twin.load(folder / "twin.json")
    return Gaussians.load(folder / "gaussians.safetensors"), twin


def capture_of(folder: Path) -> Path | None:
    """The capture that a run was made from; None where it is gone."""
    known = read_record(folder / "config.json").get("capture")
    return Path(known) if isinstance(known, str) and Path(known).is_dir() else None


def up_of(folder: Path) -> np.ndarray | None:
    """Up (3,) as the photographs of a run have it; None where these are gone."""
    capture = capture_of(folder)
    with suppress(HingesplatError):
        return None if capture is None else common_up(load_cameras(capture))


def repel_points_of(folder: Path) -> np.ndarray:
    """Repel points (n, 3) as ``articulate`` draws them, where a run used them; else none."""
    told = read_record(folder / "config.json").get("articulate", {}).get("repel")
    path = folder / "canonical.safetensors"
    drawn = None
    if isinstance(told, dict) and path.is_file():
        drawn = draw_repel_points(Gaussians.load(path), RepelConfig(**told), torch.Generator().manual_seed(0))
    return np.zeros((0, 3), np.float32) if drawn is None else drawn.numpy()


def load_meshes(folder: Path, twin: Twin) -> dict[int, trimesh.Trimesh]:
    """The part meshes of a run, by part id, frame of state 0.

    Raises:
        HingesplatError: a mesh file is missing or broken.
    """
    meshes = {}
    for part in twin.parts:
        if part.mesh is not None:
            path = folder / part.mesh
            try:
                mesh = trimesh.load(path, force="mesh", process=False)
            except Exception as e:  # Readers of many formats raise errors of many kinds.
                raise HingesplatError(f"{path}: missing or no readable mesh; reconstruct again") from e
            assert isinstance(mesh, trimesh.Trimesh)
            meshes[part.id] = mesh
    return meshes


def read_record(path: Path) -> dict[str, Any]:
    """A JSON file of a run; empty where there is none."""
    return read_json(path, "give another folder", absent={})


# Whose it is.


def open_folder(folder: Path, capture: Capture, config: Any, overwrite: bool) -> None:
    """Make the folder ready: new, or that of the same run, or cleared of another."""
    path = folder / "config.json"
    identity = {
        **json.loads(json.dumps(asdict(config))),
        "capture": str(capture.path.resolve()),
        "photographs": fingerprint(capture),
    }
    if path.is_file():
        known = read_record(path)
        if "photographs" not in known:
            raise HingesplatError(f"{folder}: its config.json is not that of a run; give another folder")
        if not overwrite:
            _check_same_run(folder, known, identity)
            return
        for pattern in ARTEFACTS:
            for old in folder.glob(pattern):
                shutil.rmtree(old) if old.is_dir() else old.unlink()
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise HingesplatError(f"{folder}: is in use and holds no run; give another folder")
    folder.mkdir(parents=True, exist_ok=True)
    write_json(path, identity | {"versions": versions()})


def _check_same_run(folder: Path, known: dict[str, Any], wanted: dict[str, Any]) -> None:
    remedy = "give another folder, or --overwrite to start afresh"
    if known["capture"] != wanted["capture"]:
        raise HingesplatError(f"{folder}: belongs to another capture ({known['capture']}); {remedy}")
    old, new = flat(known), flat(wanted)
    changed = [k for k in new if k != "photographs" and old.get(k) != new[k]]
    if changed:
        k = changed[0]
        more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
        raise HingesplatError(
            f"{folder}: was made with another config ({k} was {old.get(k)}, is {new[k]}{more}); {remedy}"
        )
    if known["photographs"] != wanted["photographs"]:
        raise HingesplatError(
            f"{folder}: belongs to another capture (the photographs in {known['capture']} have changed); {remedy}"
        )


def take_over(folder: Path, parents: Sequence[Path], inherited: Inherited) -> None:
    """Copy the first stages' results from the run that agrees with this one the longest.

    ``inherited`` names the stages that may be taken over, in order, each with the options that decide its results
    beside those of the stages before, and its files.
    """
    wanted = flat(read_record(folder / "config.json"))
    shared = {parent: _stages_shared(parent, wanted, inherited) for parent in parents}
    best = max(shared, key=lambda parent: len(shared[parent]), default=None)
    if best is None or not shared[best] or (folder / "stages.json").is_file():
        return
    for name in shared[best]:
        for path in best.glob(inherited[name][1]):
            shutil.copy2(path, folder / path.name)
    if (best / "curves.json").is_file():
        shutil.copy2(best / "curves.json", folder / "curves.json")
    finished = read_record(best / "stages.json")
    write_json(folder / "stages.json", {name: finished[name] for name in shared[best]})


def _stages_shared(parent: Path, wanted: dict[str, Any], inherited: Inherited) -> list[str]:
    """The first stages of a run that the same photographs and options would make again."""
    known = flat(read_record(parent / "config.json"))
    finished = read_record(parent / "stages.json")
    shared = []
    for name, (options, _) in inherited.items():
        keys = [k for k in wanted if any(k == o or k.startswith(f"{o}.") for o in options)]
        if name not in finished or any(k not in known or known[k] != wanted[k] for k in keys):
            break
        shared.append(name)
    return shared


def flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested keys joined by dots."""
    leaves = {}
    for key, value in tree.items():
        leaves |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return leaves


def fingerprint(capture: Capture) -> str:
    """A digest of every training pixel, mask and camera: what the twin is made from."""
    digest = blake2b(digest_size=12)
    for state in capture.states:
        for view in state.train:
            c = view.camera
            digest.update(np.array([*c.T_world_camera.ravel(), c.fx, c.fy, c.cx, c.cy]).tobytes())
            digest.update(np.ascontiguousarray(view.rgba).data)
            digest.update(b"" if view.depth is None else np.ascontiguousarray(view.depth).data)
        digest.update(b"/")
    return digest.hexdigest()


# What is written into it.


def versions() -> dict[str, str]:
    """Of the program and of what its numbers depend on."""
    found = {"python": platform.python_version()}
    for name in ("hingesplat", "torch", "numba", "numpy", "scipy", "gsplat"):
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def write_tensors(path: Path, tensors: dict[str, Tensor]) -> None:
    """Write a safetensors file, whole or not at all."""
    with whole_file(path) as tmp:
        save_file({name: t.detach().cpu().contiguous() for name, t in tensors.items()}, str(tmp))


class _LogFile(logging.FileHandler):
    """Silent where it cannot write: a full disk is reported by the stage that meets it."""

    def handleError(self, record: logging.LogRecord) -> None:
        pass


@contextmanager
def log_file(path: Path) -> Iterator[None]:
    """What the package logs goes to this file, too."""
    handler = _LogFile(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s", "%Y-%m-%d %H:%M:%S"))
    try:
        with heard_by(handler):
            yield
    finally:
        with suppress(OSError):
            handler.close()
