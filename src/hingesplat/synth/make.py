"""Writes a made object as a capture, with its truth beside it."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from hingesplat.camera import Camera, look_at
from hingesplat.capture import View, write_state
from hingesplat.errors import HingesplatError
from hingesplat.synth.objects import MAKERS, Model
from hingesplat.synth.shapes import solid_mesh
from hingesplat.synth.trace import LitScene, Surface

NAMES = tuple(MAKERS)
FIELD_OF_VIEW = np.radians(45)


def make(
    name: str,
    out: Path,
    *,
    seed: int = 0,
    size: int = 400,
    train_views: int = 60,
    test_views: int = 10,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Photograph the object ``name`` in two states and write a capture with ``truth/`` to the folder ``out``.

    The object lies centred in a unit box (over both states), z up, units of the box. The seed draws the
    shape, the textures, the joint values and the cameras. ``progress`` is told (pictures done, in all).

    Returns:
        ``out``.

    Raises:
        HingesplatError: no such object, a size or a number of views that makes no sense, or ``out`` in use.
    """
    if name not in MAKERS:
        raise HingesplatError(f"{name}: no such object; there are {', '.join(NAMES)}")
    if size < 16 or train_views < 1 or test_views < 0:
        raise HingesplatError(f"size {size}, views {train_views} + {test_views}: need ≥ 16 pixels and ≥ 1 view")
    out = Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise HingesplatError(f"{out}: is already there; name another folder, or delete it first")
    model = MAKERS[name](seed)
    centre, scale, radius = _unit_box(model)
    distance = 1.02 * radius / np.sin(FIELD_OF_VIEW / 2)  # The object fills the picture.
    out.parent.mkdir(parents=True, exist_ok=True)
    tmp = out.with_name(out.name + ".tmp")
    shutil.rmtree(tmp, ignore_errors=True)
    try:
        surface = Surface(model, 0.6 / size / scale)
        rng = np.random.default_rng((3, seed))
        total, done = 2 * (train_views + test_views), 0
        for state in (0, 1):
            scene = LitScene(surface, model.state(state))
            ids = tmp / "truth" / f"partid_state{state}"
            ids.mkdir(parents=True)
            for split, count in (("train", train_views), ("test", test_views)):
                views = []
                for i, camera in enumerate(cameras_around(rng, count, size, distance)):
                    # The scene stays in metres; the camera goes to it.
                    T = camera.T_world_camera.copy()
                    T[:3, 3] = T[:3, 3] / scale + centre
                    rgba, depth, parts = scene.photograph(replace(camera, T_world_camera=T))
                    views.append(View(camera, rgba, f"state_{state}/{split}/{i:03d}.png", depth * scale))
                    Image.fromarray(parts).save(ids / f"{split}_{i:03d}.png")
                    done += 1
                    if progress:
                        progress(done, total)
                write_state(tmp / f"state_{state}", views, split)
        _write_truth(tmp / "truth", model, centre, scale, seed)
        if out.exists():
            out.rmdir()
        tmp.replace(out)
    except OSError as e:
        raise HingesplatError(f"{out}: cannot be written ({e.strerror or e})") from e
    finally:
        shutil.rmtree(tmp, ignore_errors=True)
    return out


def cameras_around(rng: np.random.Generator, count: int, size: int, distance: float) -> list[Camera]:
    """Cameras that look at the origin: mostly the upper hemisphere, one in eight slightly from below.

    Spread evenly (a golden spiral with jitter, in random order), so that few views already see all sides.
    """
    i = (np.arange(count) + rng.uniform(0.2, 0.8, count)) / max(count, 1)
    turn = 2 * np.pi * (rng.random() + np.arange(count) * (5**0.5 - 1) / 2)
    height = np.where(i < 0.125, -0.25 + 2 * i, (i - 0.125) / 0.875 * 0.9)
    focal = size / 2 / np.tan(FIELD_OF_VIEW / 2)
    cameras = []
    for z, a in zip(height, turn, strict=True):
        r = np.sqrt(1 - z**2)
        eye = distance * rng.uniform(0.97, 1.1) * np.array([r * np.cos(a), r * np.sin(a), z])
        T = look_at(eye, rng.uniform(-0.03, 0.03, 3), np.array([0, 0, 1]))
        cameras.append(Camera(T, focal, focal, size / 2, size / 2, size, size))
    return [cameras[k] for k in rng.permutation(count)]


def _unit_box(model: Model) -> tuple[np.ndarray, float, float]:
    """Centre of the object's box over both states, factor that makes it a unit box, radius after that."""
    points = []
    for state in (0, 1):
        for body, T in zip(model.bodies, model.state(state).values(), strict=True):
            v = np.concatenate([p.mesh()[0] for solid in body.solids for p in solid])
            points.append(v @ T[:3, :3].T + T[:3, 3])
    x = np.concatenate(points)
    low, high = x.min(0), x.max(0)
    centre, scale = (low + high) / 2, float(1 / (high - low).max())
    return centre, scale, float(np.linalg.norm(x - centre, axis=1).max() * scale)


def _write_truth(folder: Path, model: Model, centre: np.ndarray, scale: float, seed: int) -> None:
    """Joints, part meshes (solids united, so that no face lies inside) and where they came from."""
    parts = folder / "parts"
    parts.mkdir()
    joints = []
    for body in model.bodies:
        mesh = trimesh.boolean.union([solid_mesh(s) for s in body.solids], engine="manifold")
        mesh.vertices = (mesh.vertices - centre) * scale
        (parts / f"{body.name}.obj").write_text(_obj(mesh.vertices, mesh.faces))
        if body.hinge:
            h, unit = body.hinge, scale if body.hinge.type == "prismatic" else 1.0
            joints.append(
                {
                    "name": f"{body.name}_joint",
                    "parent": h.parent,
                    "child": body.name,
                    "type": h.type,
                    "axis": [float(a) for a in h.axis],
                    "origin": [float(o) for o in (np.asarray(h.origin) - centre) * scale],
                    "limits": [limit * unit for limit in h.limits],
                    "state0": h.states[0] * unit,
                    "state1": h.states[1] * unit,
                }
            )
    names = [b.name for b in model.bodies]
    _write_json(
        folder / "joints.json",
        {
            "frame": "world frame of the images, z up; parts/*.obj are at all joint values 0",
            "units": "revolute: rad; prismatic: scene units (multiply by metres_per_unit for metres)",
            "metres_per_unit": 1 / scale,
            "root": names[0],
            "parts": names,
            "part_ids": {name: i + 1 for i, name in enumerate(names)},
            "joints": joints,
        },
    )
    _write_json(folder / "meta.json", {"name": model.name, "seed": seed, "source": "hingesplat synth"})


def _obj(vertices: np.ndarray, faces: np.ndarray) -> str:
    """A Wavefront OBJ file."""
    lines = ["v {:.9g} {:.9g} {:.9g}".format(*v) for v in vertices]
    return "\n".join(lines + ["f {} {} {}".format(*f) for f in faces + 1]) + "\n"


def _write_json(path: Path, data: dict) -> None:
    path.write_text(json.dumps(data, indent=1))
