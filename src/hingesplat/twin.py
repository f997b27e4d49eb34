"""The third noun: a base, movable parts, and the joints between them. ``twin.json`` is its file."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from hingesplat.errors import HingesplatError
from hingesplat.files import read_json, write_json
from hingesplat.screw import joint_motion

VERSION = 1
JointType = Literal["revolute", "prismatic", "fixed"]


@dataclass(frozen=True)
class Part:
    """A rigid piece; id 0 is the static base. Paths are relative to the run folder."""

    id: int
    name: str
    gaussians: int
    """Number of Gaussians that carry this part's id."""
    mesh: str | None = None
    """``parts/NAME.glb``: in the frame of state 0; an OBJ with vertex colours lies beside it."""
    splats: str | None = None
    """``parts/NAME.ply``: standard 3DGS PLY, frame of state 0."""


@dataclass(frozen=True)
class JointStd:
    """One standard deviation of what was estimated."""

    axis_deg: float | None = None
    pivot: float | None = None
    motion: float | None = None
    """Radians or scene units, as the joint's states."""


@dataclass(frozen=True)
class Joint:
    """One degree of freedom between a part and its parent, in the frame of state 0."""

    child: int
    parent: int
    type: JointType
    axis: tuple[float, float, float]
    """Unit vector; rotation is right-handed about it, translation along it."""
    pivot: tuple[float, float, float]
    """A point on the axis: the one nearest the part's centroid."""
    states: tuple[float, ...]
    """Radians or scene units, one per input state; the first is 0."""
    limits: tuple[float, float]
    std: JointStd = field(default_factory=JointStd)
    confidence: float | None = None
    """0 to 1: how much better this joint explains the photographs than the runner-up does."""
    verdict: str = ""
    """The same in words."""

    def transform(self, value: float) -> np.ndarray:
        """T_parent: moves the part's state-0 geometry to joint value ``value``; 4×4, frame of state 0."""
        return np.eye(4) if self.type == "fixed" else joint_motion(self.type, self.axis, self.pivot, value)


@dataclass(frozen=True)
class Twin:
    """The product: parts[0] is the base, and each other part has exactly one joint."""

    parts: tuple[Part, ...]
    joints: tuple[Joint, ...]
    units: str = "scene"
    """``metres`` or ``scene`` (multiply by ``metres_per_unit``)."""
    metres_per_unit: float = 1.0

    def joint_of(self, part_id: int) -> Joint | None:
        """The joint whose child is this part; None for the base."""
        return next((j for j in self.joints if j.child == part_id), None)

    def transforms(self, values: dict[int, float]) -> dict[int, np.ndarray]:
        """World pose 4×4 of every part id, relative to its state-0 pose, for joint values by child id."""
        poses: dict[int, np.ndarray] = {0: np.eye(4)}

        def pose(part_id: int) -> np.ndarray:
            if part_id not in poses:
                joint = self.joint_of(part_id)
                if joint is None:
                    poses[part_id] = np.eye(4)
                else:
                    poses[part_id] = pose(joint.parent) @ joint.transform(values.get(part_id, 0.0))
            return poses[part_id]

        return {part.id: pose(part.id) for part in self.parts}

    def at_state(self, state: int) -> dict[int, np.ndarray]:
        """``transforms`` with every joint at its value in input state ``state``."""
        return self.transforms({j.child: j.states[state] for j in self.joints})

    def on_the_way(self, state: int, steps: int) -> list[dict[int, np.ndarray]]:
        """``transforms`` in ``steps`` even steps from state 0 to another, all joints together."""
        shares = np.linspace(0, 1, steps)
        return [self.transforms({j.child: share * j.states[state] for j in self.joints}) for share in shares]

    def to_json(self) -> dict[str, Any]:
        return {
            "version": VERSION,
            "units": self.units,
            "metres_per_unit": self.metres_per_unit,
            "parts": [vars(p) for p in self.parts],
            "joints": [{**vars(j), "std": vars(j.std)} for j in self.joints],
        }

    def save(self, path: Path) -> None:
        """Write ``twin.json``, whole or not at all."""
        write_json(path, self.to_json())

    @staticmethod
    def load(path: Path) -> "Twin":
        """Read ``twin.json``.

        Raises:
            HingesplatError: missing, broken, of another version, lacking a key, or no tree of parts and joints.
        """
        if not path.is_file():
            raise HingesplatError(f"{path}: no such file; run `hingesplat reconstruct` first")
        data = read_json(path)
        try:
            if data["version"] != VERSION:
                raise HingesplatError(f"{path}: version {data['version']}, this program reads {VERSION}")
            parts = tuple(Part(**p) for p in data["parts"])
            joints = tuple(
                Joint(
                    **{
                        **j,
                        "axis": tuple(j["axis"]),
                        "pivot": tuple(j["pivot"]),
                        "states": tuple(j["states"]),
                        "limits": tuple(j["limits"]),
                        "std": JointStd(**j["std"]),
                    }
                )
                for j in data["joints"]
            )
            twin = Twin(parts, joints, data["units"], data["metres_per_unit"])
        except (KeyError, TypeError) as e:
            raise HingesplatError(f"{path}: key {e} missing or unknown") from e
        if fault := _fault(twin):
            raise HingesplatError(f"{path}: {fault}")
        return twin


def _fault(twin: Twin) -> str | None:
    """What is wrong with a twin that somebody else may have written, in words."""
    ids = [part.id for part in twin.parts]
    if len(set(ids)) < len(ids):
        return "parts: two have one id"
    parent_of = {}
    for joint in twin.joints:
        where = f"the joint of part {joint.child}"
        if joint.child not in ids or joint.child == 0 or joint.child in parent_of:
            return f"{where}: its child is no part, the base, or has another joint"
        if joint.parent not in ids:
            return f"{where}: its parent, {joint.parent}, is no part"
        if joint.type not in get_args(JointType):
            return f"{where}: type {joint.type!r}; use {', '.join(get_args(JointType))}"
        if not (_are_numbers(joint.axis, 3) and _are_numbers(joint.pivot, 3) and np.linalg.norm(joint.axis) > 1e-9):
            return f"{where}: axis and pivot must be three numbers each, and the axis not zero"
        if not _are_numbers(joint.limits, 2) or joint.limits[0] > joint.limits[1]:
            return f"{where}: limits must be two numbers, the lower first"
        if not _are_numbers(joint.states, len(twin.joints[0].states)):
            return f"{where}: states must be numbers, as many as those of the other joints"
        parent_of[joint.child] = joint.parent
    for part in parent_of:
        chain = [part]
        while chain[-1] in parent_of:
            chain.append(parent_of[chain[-1]])
            if chain[-1] == part:
                return f"part {part} hangs from itself; mend joints[].parent"
            if len(chain) > len(ids):
                break  # The ring is another's, who will be named.
    return None


def _are_numbers(values: Sequence[Any], count: int) -> bool:
    return len(values) == count and all(isinstance(v, int | float) and math.isfinite(v) for v in values)
