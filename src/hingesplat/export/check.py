"""Exports tried out: loaded by the simulators that are installed, and every joint driven end to end.

Each simulator runs in a process of its own, ``python -m hingesplat.export.check NAME FILE``: what it prints is
heard, and one that crashes takes nothing with it.
"""

# pyright: reportAttributeAccessIssue=false

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

SECONDS = 2.0
"""Of a joint's way: from its lower limit to the upper one and back."""
TOLERANCE = 2.0
"""Percent of a joint's range by which it may miss its target."""
CHECKS = {"urdf": ("mujoco", "pybullet", "yourdfpy"), "mjcf": ("mujoco",), "usd": ("pxr",)}
"""Packages that can try a format."""
TIMEOUT = 300
"""Seconds that one program may take."""


@dataclass(frozen=True)
class Check:
    """What a program made of an export."""

    program: str
    """With its version."""
    joints: int = 0
    """That it found and moved."""
    error_percent: float | None = None
    """Worst distance from the target at either end, of the joint's range; None where nothing was driven."""
    contacts: tuple[str, ...] = ()
    """Pairs of parts that touched on the way."""
    ignored: tuple[str, ...] = ()
    """Pairs of parts, neither of which carries the other, that pass through each other: their meshes meet."""
    warnings: tuple[str, ...] = ()
    """Why it failed comes first."""

    @property
    def ok(self) -> bool:
        """No warning, and every joint reached both ends."""
        return not self.warnings and (self.error_percent or 0.0) <= TOLERANCE


def check_export(form: str, path: Path) -> list[Check]:
    """Try an exported file in each program for its format that is installed; none for splats.

    Args:
        form: urdf, mjcf, usd, …
        path: the file to open.
    """
    return [_check(program, path) for program in CHECKS.get(form, ()) if find_spec(program)]


def simulation(export: Path) -> dict[str, Any]:
    """The simulation row of ``metrics.json``: how MuJoCo takes a run's MJCF and URDF.

    Args:
        export: the run's export folder.

    Returns:
        ``simulation``: ``ok``, ``program``, and for ``mjcf`` and ``urdf`` what ``Check`` holds; or None, and
        ``simulation_why_null``.
    """
    files = {"mjcf": export / "mjcf" / "twin.xml", "urdf": export / "urdf" / "twin.urdf"}
    missing = next((path for path in files.values() if not path.is_file()), None)
    why = f"{missing}: no such file; run `hingesplat export`" if missing else None
    if not find_spec("mujoco"):
        why = "MuJoCo is not installed; pip install 'hingesplat[sim]'"
    if why:
        return {"simulation": None, "simulation_why_null": why}
    with ThreadPoolExecutor() as pool:
        checks = dict(zip(files, pool.map(partial(_check, "mujoco"), files.values()), strict=True))
    each = {form: asdict(check) | {"ok": check.ok} for form, check in checks.items()}
    ok = all(check.ok for check in checks.values())
    return {"simulation": {"ok": ok, "program": checks["mjcf"].program, **each}, "simulation_why_null": None}


def _check(program: str, path: Path) -> Check:
    with tempfile.TemporaryDirectory() as elsewhere:  # MuJoCo leaves a log file where it runs.
        command = [sys.executable, "-W", "ignore", "-m", __name__, program, str(path.resolve())]
        try:
            done = subprocess.run(
                command,
                cwd=elsewhere,
                env=os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if Path(p).is_absolute())},
                capture_output=True,
                text=True,
                errors="replace",
                timeout=TIMEOUT,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return Check(program, warnings=(f"took more than {TIMEOUT} s",))
    *said, result = done.stdout.splitlines() or [""]
    heard = [line for line in said if "warning" in line.lower() or "error" in line.lower()]
    heard += [line for line in done.stderr.splitlines() if line.strip() and "build time" not in line]
    warnings = tuple(line.strip() for line in heard)
    try:
        found = json.loads(result)
    except json.JSONDecodeError:
        return Check(program, warnings=(f"stopped with exit code {done.returncode}", *warnings[-3:]))
    lists: dict[str, Any] = {key: tuple(found.pop(key)) for key in ("contacts", "ignored", "warnings")}
    lists["warnings"] += warnings
    return Check(**found, **lists)


def target(t: float, low: float, high: float) -> float:
    """Where a joint should be at time t: gently up, rest, gently down, rest."""
    half = SECONDS / 2
    way = (1 - np.cos(np.pi * np.clip(t % half / (0.8 * half), 0, 1))) / 2
    return low + (high - low) * (way if t < half else 1 - way)


def sweep(
    limits: Mapping[Any, tuple[float, float]],
    timestep: float,
    start: Callable[[dict[Any, float]], None],
    step: Callable[[dict[Any, float]], dict[Any, float]],
) -> float:
    """Drive each joint end to end by itself while the others hold still.

    Args:
        limits: of the joints.
        timestep: of the simulator, seconds.
        start: puts all joints somewhere, at rest.
        step: takes targets, goes on by one timestep, and returns where the joints are.

    Returns:
        The worst error when a joint ought to rest at an end, the held ones included, in percent of its range.

    Raises:
        FloatingPointError: a position is infinite or no number.
    """
    worst, steps = 0.0, round(SECONDS / timestep)
    rest = {name: float(np.clip(0.0, *limit)) for name, limit in limits.items()}
    for name, (low, high) in limits.items():
        start(rest | {name: low})
        for i in range(steps):
            t = i * timestep
            wanted = rest | {name: target(t, low, high)}
            now = step(wanted)
            if not all(np.isfinite(v) for v in now.values()):
                raise FloatingPointError(f"the simulation exploded after {t:.2f} s of driving joint {name}")
            if t % (SECONDS / 2) > 0.95 * SECONDS / 2:
                errors = [abs(now[n] - wanted[n]) / (limits[n][1] - limits[n][0]) for n in limits]
                worst = max(worst, *errors)
    return 100 * float(worst)


def _mujoco(path: Path) -> Check:
    import mujoco

    heard: list[str] = []
    mujoco.set_mju_user_warning(heard.append)
    spec = mujoco.MjSpec.from_file(str(path))
    if path.suffix == ".urdf":  # URDF has no servos: their gain is half the effort limit over the range.
        for joint in spec.joints:
            servo = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            span = joint.range[1] - joint.range[0]
            servo.set_to_position(kp=joint.actfrcrange[1] / (2 * span), dampratio=1.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    joints = [int(j) for j in model.actuator_trnid[:, 0]]
    limits = {a: (float(model.jnt_range[j][0]), float(model.jnt_range[j][1])) for a, j in enumerate(joints)}
    places = model.jnt_qposadr[joints]
    contacts: set[str] = set()
    warned = np.zeros(len(data.warning), int)

    def start(values: dict[int, float]) -> None:
        nonlocal warned
        warned += [w.number for w in data.warning]
        mujoco.mj_resetData(model, data)
        data.qpos[places] = data.ctrl[:] = [values[a] for a in limits]

    def step(values: dict[int, float]) -> dict[int, float]:
        data.ctrl[:] = [values[a] for a in limits]
        mujoco.mj_step(model, data)
        for pair in data.contact.geom:
            names = sorted(model.body(model.geom_bodyid[g]).name for g in pair)
            contacts.add(" and ".join(names))
        return dict(enumerate(data.qpos[places]))

    error = sweep(limits, model.opt.timestep, start, step)
    if not limits:
        step({})
    warned += [w.number for w in data.warning]
    heard += [mujoco.mjtWarning(i).name for i in np.flatnonzero(warned)]
    program = f"MuJoCo {version('mujoco')}"
    pairs = [divmod(int(signature), 1 << 16) for signature in model.exclude_signature]
    apart = [pair for pair in pairs if all(model.body_parentid[a] != b for a, b in (pair, pair[::-1]))]
    ignored = [" and ".join(sorted(model.body(i).name for i in pair)) for pair in apart]
    error = error if limits else None
    return Check(program, len(limits), error, tuple(sorted(contacts)), tuple(ignored), tuple(dict.fromkeys(heard)))


def _pybullet(path: Path) -> Check:
    import pybullet as p  # pyright: ignore[reportMissingImports]

    p.connect(p.DIRECT)
    p.setGravity(0, 0, -9.81)
    robot = p.loadURDF(str(path), useFixedBase=True, flags=p.URDF_USE_INERTIA_FROM_FILE)
    about = {j: p.getJointInfo(robot, j) for j in range(p.getNumJoints(robot))}
    moving = {j: a for j, a in about.items() if a[2] != p.JOINT_FIXED}
    names = {-1: p.getBodyInfo(robot)[0].decode()} | {j: a[12].decode() for j, a in about.items()}
    contacts: set[str] = set()

    def start(values: dict[int, float]) -> None:
        for j, value in values.items():
            p.resetJointState(robot, j, value)

    def step(values: dict[int, float]) -> dict[int, float]:
        for j, value in values.items():
            p.setJointMotorControl2(robot, j, p.POSITION_CONTROL, value, force=moving[j][10])
        p.stepSimulation()
        contacts.update(" and ".join(sorted((names[c[3]], names[c[4]]))) for c in p.getContactPoints())
        return {j: p.getJointState(robot, j)[0] for j in moving}

    error = sweep({j: (a[8], a[9]) for j, a in moving.items()}, 1 / 240, start, step)
    return Check(f"PyBullet {version('pybullet')}", len(moving), error if moving else None, tuple(sorted(contacts)))


def _yourdfpy(path: Path) -> Check:
    from yourdfpy import URDF  # pyright: ignore[reportMissingImports]

    robot = URDF.load(str(path), load_collision_meshes=True)
    robot.validate()
    for end in (0, 1):
        robot.update_cfg([(j.limit.lower, j.limit.upper)[end] for j in robot.actuated_joints])
    wrong = [str(e) for e in robot.errors]
    return Check(f"yourdfpy {version('yourdfpy')}", len(robot.actuated_joints), warnings=tuple(wrong))


def _pxr(path: Path) -> Check:
    from hingesplat.export.usd import validate

    joints, errors = validate(path)
    return Check(f"UsdValidation {version('usd-core')}", joints, warnings=tuple(errors))


def main(program: str, path: str) -> None:
    """Write a program's ``Check`` as one line of JSON."""
    try:
        check = {"mujoco": _mujoco, "pybullet": _pybullet, "yourdfpy": _yourdfpy, "pxr": _pxr}[program](Path(path))
    except Exception as e:  # Loaders raise errors of many kinds.
        check = Check(program, warnings=(f"{type(e).__name__}: {' '.join(str(e).split())}",))
    sys.stdout.write("\n" + json.dumps(asdict(check)) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
