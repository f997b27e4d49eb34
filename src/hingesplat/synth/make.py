"""Writes a made object as a capture, with its truth beside it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from hingesplat.camera import Camera, look_at
from hingesplat.capture import View, write_state
from hingesplat.errors import HingesplatError
from hingesplat.files import whole_folder, write_json
from hingesplat.synth.model import Model
from hingesplat.synth.objects import CAMERAS, NAMES, build
from hingesplat.synth.shapes import solid_mesh
from hingesplat.synth.trace import LitScene, Surface

FIELD_OF_VIEW = np.radians(45)
TEXELS = 16
"""At most so many a pixel of a picture, on all surfaces together."""


def make(
    name: str,
    out: Path,
    *,
    seed: int = 0,
    size: int = 400,
    train_views: int = 100,
    test_views: int = 20,
    states: int = 2,
    below: float = 0.0,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Photograph the object ``name`` in two or more states and write a capture with ``truth/`` to the folder ``out``.

    The object lies centred in a unit box (over all states), z up, units of the box. The seed draws the
    shape, the textures, the joint values and the cameras. Views are those of a state, on the upper hemisphere but
    for the share ``below``, which looks up from slightly below. States after the second have joint values between
    those of the first two. ``progress`` is told (pictures done, in all).

    Returns:
        ``out``.

    Raises:
        HingesplatError: no such object; a size, share or number of views or states that makes no sense; or ``out``
            in use.
    """
    if name not in NAMES:
        raise HingesplatError(f"{name}: no such object; there are {', '.join(NAMES)}")
    if size < 16 or train_views < 1 or test_views < 0:
        raise HingesplatError(f"size {size}, views {train_views} + {test_views}: need ≥ 16 pixels and ≥ 1 view")
    if seed < 0:
        raise HingesplatError(f"seed: must be at least 0, not {seed}")
    if states < 2 or not 0 <= below < 1:
        raise HingesplatError(f"{states} states, {below} of the views from below: need ≥ 2 states and 0 ≤ share < 1")
    out = Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise HingesplatError(f"{out}: is already there; name another folder, or delete it first")
    model = build(name, seed)
    centre, scale, radius = unit_box(model, states)
    distance = 1.02 * radius / np.sin(FIELD_OF_VIEW / 2)  # The object fills the picture.
    try:
        with whole_folder(out) as tmp:
            surface = Surface(model, fine_texel(model, size, scale))
            rng = np.random.default_rng((CAMERAS, seed))
            total, done = states * (train_views + test_views), 0
            for state in range(states):
                scene = LitScene(surface, model.state(state))
                ids = tmp / "truth" / f"partid_state{state}"
                ids.mkdir(parents=True)
                for split, count in (("train", train_views), ("test", test_views)):
                    views = []
                    for i, camera in enumerate(cameras_around(rng, count, size, distance, below)):
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
            _write_truth(tmp / "truth", model, centre, scale, seed, states)
    except OSError as e:
        raise HingesplatError(f"{out}: cannot be written ({e.strerror or e})") from e
    return out


def fine_texel(model: Model, size: int, scale: float) -> float:
    """Edge of a texel, model units: 0.6 units of the box / ``size``, more where that would need too many texels."""
    area = sum(p.size[0] * p.size[1] for body in model.bodies for solid in body.solids for p in solid)
    return max(0.6 / scale, float(np.sqrt(area / TEXELS))) / size


def cameras_around(
    rng: np.random.Generator, count: int, size: int, distance: float, below: float = 0.0
) -> list[Camera]:
    """Cameras that look at the origin from the upper hemisphere, a share ``below`` of them from slightly below.

    Spread evenly (a golden spiral with jitter, in random order), so that few views already see all sides.
    """
    i = (np.arange(count) + rng.uniform(0.2, 0.8, count)) / max(count, 1)
    turn = 2 * np.pi * (rng.random() + np.arange(count) * (5**0.5 - 1) / 2)
    height = np.where(i < below, 0.25 * (i / (below or 1) - 1), (i - below) / (1 - below) * 0.9)
    cameras = []
    for z, a in zip(height, turn, strict=True):
        r = np.sqrt(1 - z**2)
        eye = distance * rng.uniform(0.97, 1.1) * np.array([r * np.cos(a), r * np.sin(a), z])
        cameras.append(camera_at(eye, rng.uniform(-0.03, 0.03, 3), size))
    return [cameras[k] for k in rng.permutation(count)]


def camera_at(eye: np.ndarray, target: np.ndarray, size: int) -> Camera:
    """A camera at ``eye`` that looks at ``target``, z up, with square pictures of ``size`` pixels."""
    T = look_at(eye, target, np.array([0, 0, 1]))
    focal = size / 2 / np.tan(FIELD_OF_VIEW / 2)
    return Camera(T, focal, focal, size / 2, size / 2, size, size)


def unit_box(model: Model, states: int = 2) -> tuple[np.ndarray, float, float]:
    """Centre of the object's box over its states, factor that makes it a unit box, radius after that."""
    vertices = [np.concatenate([p.mesh()[0] for solid in body.solids for p in solid]) for body in model.bodies]
    points = []
    for state in range(states):
        for v, T in zip(vertices, model.state(state).values(), strict=True):
            points.append(v @ T[:3, :3].T + T[:3, 3])
    x = np.concatenate(points)
    low, high = x.min(0), x.max(0)
    centre, scale = (low + high) / 2, float(1 / (high - low).max())
    return centre, scale, float(np.linalg.norm(x - centre, axis=1).max() * scale)


def _write_truth(folder: Path, model: Model, centre: np.ndarray, scale: float, seed: int, states: int) -> None:
    """Joints, part meshes (solids united, so that no face lies inside) and where they came from."""
    parts = folder / "parts"
    parts.mkdir()
    joints = []
    values = [model.values(state) for state in range(states)]
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
                    **{f"state{k}": v[body.name] * unit for k, v in enumerate(values)},
                }
            )
    names = [b.name for b in model.bodies]
    write_json(
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
    write_json(folder / "meta.json", {"name": model.name, "seed": seed, "source": "hingesplat synth"})


def _obj(vertices: np.ndarray, faces: np.ndarray) -> str:
    """A Wavefront OBJ file."""
    lines = ["v {:.9g} {:.9g} {:.9g}".format(*v) for v in vertices]
    return "\n".join(lines + ["f {} {} {}".format(*f) for f in faces + 1]) + "\n"
