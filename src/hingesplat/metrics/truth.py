"""Reads the two kinds of truth folder: a tree of joints with part meshes, and that of PARIS and ArtGS."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh

from hingesplat.errors import HingesplatError
from hingesplat.files import read_json
from hingesplat.screw import joint_motion

PARIS_STATES = ("start", "end")


@dataclass(frozen=True)
class TruthPart:
    """A rigid piece as it stands in both states."""

    name: str
    meshes: tuple[trimesh.Trimesh, trimesh.Trimesh]
    """World frame, scene units, one a state."""


@dataclass(frozen=True)
class TruthJoint:
    """What moves a part between the states, relative to its parent, in the world frame of state 0."""

    child: int
    parent: int
    """Indices into ``Truth.parts``."""
    type: Literal["revolute", "prismatic"]
    axis: np.ndarray
    """Unit vector (3,)."""
    pivot: np.ndarray
    """The point of the axis nearest the part's centroid, (3,)."""
    motion: float
    """State 1 − state 0, radians or scene units."""

    def transform(self) -> np.ndarray:
        """The motion from state 0 to state 1 relative to the parent, 4×4."""
        return joint_motion(self.type, self.axis, self.pivot, self.motion)


@dataclass(frozen=True)
class Truth:
    """The articulated object as it really is; ``parts[0]`` is the static base."""

    path: Path
    parts: tuple[TruthPart, ...]
    joints: tuple[TruthJoint, ...]
    picture_ids: dict[int, int]
    """Grey value in the part-id pictures to index into ``parts``."""

    @property
    def extent(self) -> float:
        """Longest edge of the object's box in state 0."""
        v = np.concatenate([p.meshes[0].vertices for p in self.parts])
        return float(np.ptp(v, axis=0).max())

    def part_picture(self, state: int, stem: str) -> Path:
        """Where the part-id picture of a test view lies, if there is one."""
        return self.path / f"partid_state{state}" / f"test_{stem}.png"


def load_truth(path: Path) -> Truth:
    """Read the truth folder ``path``, or the one inside the capture folder ``path``.

    Read are ``joints.json`` with ``parts/*.obj`` (zero configuration), and ``trans.json`` with
    ``{start,end}/*.ply`` (PARIS and ArtGS; rotations in degrees).

    Raises:
        HingesplatError: no truth there, a file missing or broken, a key missing or of no use.
    """
    for folder in (path, path / "truth", path / "gt", path / "textured_objs"):
        if (folder / "joints.json").is_file():
            return _load_tree(folder, read_json(folder / "joints.json"))
        if (folder / "trans.json").is_file():
            return _load_paris(folder, read_json(folder / "trans.json"))
    raise HingesplatError(f"{path}: no truth here; looked for joints.json and trans.json (also in truth/, gt/)")


def load_mesh(path: Path) -> trimesh.Trimesh:
    """A triangle mesh, vertices as they stand in the file.

    Raises:
        HingesplatError: missing, unreadable, or without triangles.
    """
    if not path.is_file():
        raise HingesplatError(f"{path}: no such file")
    try:
        mesh = trimesh.load(path, process=False, force="mesh", skip_materials=True)
    except Exception as e:  # Readers of many formats raise errors of many kinds.
        raise HingesplatError(f"{path}: not a readable mesh ({str(e) or type(e).__name__})") from e
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        raise HingesplatError(f"{path}: holds no triangles, or a coordinate that is not finite")
    return mesh


def _load_tree(folder: Path, tree: dict[str, Any]) -> Truth:
    where = folder / "joints.json"
    try:
        names = [tree["root"], *(name for name in tree["parts"] if name != tree["root"])]
        ids = {value: names.index(name) for name, value in tree["part_ids"].items()}
        by_child = {j["child"]: j for j in tree["joints"]}
        lost = [name for name in names[1:] if name not in by_child]
        if lost or not set(j["parent"] for j in tree["joints"]) <= set(names):
            raise HingesplatError(f"{where}: joints and parts do not form a tree ({', '.join(lost) or 'parent'})")
        poses: list[dict[str, np.ndarray]] = [{names[0]: np.eye(4)}, {names[0]: np.eye(4)}]
        while len(poses[0]) < len(names):
            ready = [n for n in names if n not in poses[0] and by_child[n]["parent"] in poses[0]]
            if not ready:
                raise HingesplatError(f"{where}: the joints form a ring")
            for name, state in ((n, s) for n in ready for s in (0, 1)):
                j = by_child[name]
                value = float(j[f"state{state}"])
                axis, origin = _unit(j["axis"], where), _vector(j["origin"], where)
                local = joint_motion(_type(j["type"], where), axis, origin, value)
                poses[state][name] = poses[state][j["parent"]] @ local
        parts = []
        for name in names:
            mesh = load_mesh(folder / "parts" / f"{name}.obj")
            parts.append(TruthPart(name, (_moved(mesh, poses[0][name]), _moved(mesh, poses[1][name]))))
        joints = []
        for name in names[1:]:
            j = by_child[name]
            T = poses[0][j["parent"]]
            axis = T[:3, :3] @ _unit(j["axis"], where)
            origin = T[:3, :3] @ _vector(j["origin"], where) + T[:3, 3]
            child, parent = names.index(name), names.index(j["parent"])
            pivot = _nearest_on_axis(origin, axis, parts[child].meshes[0])
            motion = float(j["state1"]) - float(j["state0"])
            joints.append(TruthJoint(child, parent, _type(j["type"], where), axis, pivot, motion))
    except (KeyError, TypeError, ValueError) as e:
        raise HingesplatError(f"{where}: key missing or of the wrong kind ({e})") from e
    return Truth(folder, tuple(parts), tuple(joints), ids)


def _load_paris(folder: Path, data: dict[str, Any]) -> Truth:
    where = folder / "trans.json"
    meshes = []
    for state in PARIS_STATES:
        dynamic = sorted(
            (folder / state).glob(f"{state}_dynamic*_rotate.ply"),
            key=lambda p: [int(n) for n in re.findall(r"\d+", p.name)],
        )
        meshes.append([load_mesh(p) for p in (folder / state / f"{state}_static_rotate.ply", *dynamic)])
    try:
        movers = data["trans_info"]
        movers = movers if isinstance(movers, list) else [movers]
        if not len(movers) + 1 == len(meshes[0]) == len(meshes[1]):
            raise HingesplatError(
                f"{where}: {len(movers)} joints, but {len(meshes[0]) - 1} dynamic meshes in start/ "
                f"and {len(meshes[1]) - 1} in end/"
            )
        names = [
            "static",
            *(["dynamic"] if len(movers) == 1 else [f"dynamic_{i}" for i in range(len(movers))]),
        ]
        parts = tuple(TruthPart(n, (a, b)) for n, a, b in zip(names, *meshes, strict=True))
        joints = []
        for i, mover in enumerate(movers, start=1):
            kind = mover["type"] if "type" in mover else data["input"]["motion"]["type"]
            axis = _unit(mover["axis"]["d"], where)
            pivot = _nearest_on_axis(_vector(mover["axis"]["o"], where), axis, parts[i].meshes[0])
            amount = float(mover[kind]["r"]) - float(mover[kind]["l"])
            motion = float(np.radians(amount)) if kind == "rotate" else amount
            joints.append(TruthJoint(i, 0, _type(kind, where), axis, pivot, motion))
    except (KeyError, TypeError, ValueError) as e:
        raise HingesplatError(f"{where}: key missing or of the wrong kind ({e})") from e
    return Truth(folder, parts, tuple(joints), {})


def _type(name: str, where: Path) -> Literal["revolute", "prismatic"]:
    match name:
        case "revolute" | "rotate" | "continuous":
            return "revolute"
        case "prismatic" | "translate":
            return "prismatic"
    raise HingesplatError(f"{where}: unknown type of joint {name!r}")


def _vector(values: Any, where: Path) -> np.ndarray:
    v = np.asarray(values, float)
    if v.shape != (3,) or not np.isfinite(v).all():
        raise HingesplatError(f"{where}: an axis or origin is not three finite numbers: {values}")
    return v


def _unit(values: Any, where: Path) -> np.ndarray:
    v = _vector(values, where)
    length = float(np.linalg.norm(v))
    if length < 1e-9:
        raise HingesplatError(f"{where}: an axis has length 0")
    return v / length


def _moved(mesh: trimesh.Trimesh, T: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices @ T[:3, :3].T + T[:3, 3], mesh.faces, process=False)


def _nearest_on_axis(origin: np.ndarray, axis: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    """An origin may lie anywhere along its axis; distances are meant from where the part is."""
    centre = mesh.triangles_center.T @ mesh.area_faces / mesh.area
    return origin + axis * ((centre - origin) @ axis)
