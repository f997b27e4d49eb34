"""A run beside the truth: every number of the field, in ``RUN/metrics.json``."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from hingesplat.errors import HingesplatError
from hingesplat.files import read_json, write_text
from hingesplat.metrics.motion import joint_errors
from hingesplat.metrics.surface import SAMPLES, chamfer, clean, match, overlap, penetration, sample
from hingesplat.metrics.truth import Truth, load_mesh, load_truth
from hingesplat.metrics.views import score_views
from hingesplat.twin import Joint, Twin

SEEDS = (0, 1, 2)
MATCH_SAMPLES = 4000
MATCH_RADIUS = 0.02
"""Of the object's extent: points nearer than this are the same surface."""
STEPS = 11
NO_SIMULATION = {"simulation": None, "simulation_why_null": "not asked for"}
NO_LPIPS = "the weights of its network do not come with this package"


@dataclass(frozen=True)
class FoundPart:
    """A part of the twin as it stands in both states."""

    id: int
    meshes: tuple[trimesh.Trimesh, trimesh.Trimesh]
    """Cleaned, world frame, one a state."""


def evaluate(
    run: Path, truth: Path, simulation: Mapping[str, Any] = NO_SIMULATION, masks: Path | None = None
) -> dict[str, Any]:
    """Compare the twin in the folder ``run`` with the truth and write ``run/metrics.json``.

    Parts are counted with the base. Chamfer distances are squared, the sum of both directions, ×1000, of
    10 000 points a surface: means over both states and three draws of points. Where the photographs or the
    Gaussians are not there, ``views`` holds nulls and ``why_null``. ``simulation`` is what
    ``hingesplat.export.check.simulation`` gives and goes to the file as it is; ``masks`` are those that the run was
    given, if any.

    Returns:
        What it wrote.

    Raises:
        HingesplatError: no twin or no mesh in the run; no truth in its folder, or that of another object.
    """
    run, truth = Path(run), Path(truth)
    if not run.is_dir():
        raise HingesplatError(f"{run}: no such run folder")
    twin = Twin.load(run / "twin.json")
    known = load_truth(truth)
    found = _load_parts(run, twin)
    _check_same_object(known, found, run)
    true_of_found = match_parts(known, found)
    found_of_true = {true: part for part, true in true_of_found.items()}

    views, part_iou = _score_views(run, twin, known, true_of_found, masks)
    metrics = {
        "parts_true": len(known.parts),
        "parts_found": len(twin.parts),
        "superfluous_parts": len(twin.parts) - len(true_of_found),
        "joints": [_joint(known, i, twin, found_of_true) for i in range(len(known.joints))],
        "cd": _chamfers(known, found, found_of_true),
        "volumes": _volumes(known, found, found_of_true),
        "penetration": _penetrations(twin, found),
        "views": views,
        **part_iou,
        **simulation,
        "mesh_cleaning": "components below 10 % of the largest one's area dropped",
        "truth": str(truth),
    }
    write_text(run / "metrics.json", json.dumps(metrics, indent=1, allow_nan=False))
    return metrics


def match_parts(truth: Truth, found: Sequence[FoundPart]) -> dict[int, int]:
    """Part id of the twin → index of the true part; base to base, movers one to one by overlap of surfaces.

    Overlap is the mean of both states, so that the whole geometry counts; no joint is looked at.
    """
    rng = np.random.default_rng(0)
    radius = MATCH_RADIUS * truth.extent
    movers = [p for p in found if p.id != 0]
    true = [[sample([p.meshes[t]], MATCH_SAMPLES, rng) for t in (0, 1)] for p in truth.parts[1:]]
    ours = [[sample([p.meshes[t]], MATCH_SAMPLES, rng) for t in (0, 1)] for p in movers]
    table = np.array([[np.mean([overlap(a[t], b[t], radius) for t in (0, 1)]) for b in ours] for a in true])
    pairs = match(table.reshape(len(true), len(ours)))
    return {0: 0} | {movers[column].id: row + 1 for row, column in pairs.items()}


def _load_parts(run: Path, twin: Twin) -> list[FoundPart]:
    if not twin.parts or twin.parts[0].id != 0:
        raise HingesplatError(f"{run / 'twin.json'}: the first part is not the base (id 0)")
    short = [j.child for j in twin.joints if len(j.states) < 2]
    if short:
        raise HingesplatError(f"{run / 'twin.json'}: the joint of part {short[0]} has no value for state 1")
    poses = [twin.at_state(t) for t in (0, 1)]
    parts = []
    for part in twin.parts:
        if part.mesh is None:
            raise HingesplatError(f"{run / 'twin.json'}: part {part.id} ({part.name}) has no mesh to compare")
        mesh = clean(load_mesh(run / part.mesh))
        start, end = (mesh.copy().apply_transform(pose[part.id]) for pose in poses)
        parts.append(FoundPart(part.id, (start, end)))
    return parts


def _check_same_object(truth: Truth, found: Sequence[FoundPart], run: Path) -> None:
    a = np.concatenate([p.meshes[0].vertices for p in truth.parts])
    b = np.concatenate([p.meshes[0].vertices for p in found])
    ratio = np.linalg.norm(np.ptp(b, axis=0)) / np.linalg.norm(np.ptp(a, axis=0))
    apart = (a.min(0) > b.max(0)).any() or (b.min(0) > a.max(0)).any()
    if apart or not 1 / 3 < ratio < 3:
        raise HingesplatError(
            f"{truth.path}: not the truth of {run}: its box is {a.min(0).round(2)} … {a.max(0).round(2)}, "
            f"that of the twin {b.min(0).round(2)} … {b.max(0).round(2)}"
        )


def _joint(truth: Truth, index: int, twin: Twin, found_of_true: dict[int, int]) -> dict[str, Any]:
    joint = truth.joints[index]
    part = found_of_true.get(joint.child)
    found = twin.joint_of(part) if part is not None else None
    T_found = np.eye(4)
    if part is not None:
        # A parent that was not found counts as standing still.
        end = twin.at_state(1)
        T_found = np.linalg.inv(end[found_of_true.get(joint.parent, 0)]) @ end[part]
    mesh = truth.parts[joint.child].meshes[0]
    centre = mesh.area_faces @ mesh.triangles_center / mesh.area
    return {
        "truth": truth.parts[joint.child].name,
        "part": part,
        "type_true": joint.type,
        "type_found": found.type if found else None,
        **joint_errors(joint, found, T_found, centre),
        "std": _stds(found),
    }


def _stds(joint: Joint | None) -> dict[str, float | None]:
    """What the twin says of its errors, under the names that these have."""
    if joint is None or joint.std.motion is None:
        return {}
    turn = joint.type == "revolute"
    motion = {"motion_deg": float(np.degrees(joint.std.motion))} if turn else {"motion_units": joint.std.motion}
    return {"axis_deg": joint.std.axis_deg, "pivot": joint.std.pivot, **motion}


def _chamfers(truth: Truth, found: Sequence[FoundPart], found_of_true: dict[int, int]) -> dict[str, Any]:
    """Chamfer distances of both states and all draws: means, and those of the start state alone."""
    by_id = {p.id: i for i, p in enumerate(found)}
    rows: dict[int, list[list[float]]] = {0: [], 1: []}  # A state's rows: static, movers, whole.
    for state in (0, 1):
        for seed in SEEDS:
            rng = np.random.default_rng((seed, state))
            true = [sample([p.meshes[state]], SAMPLES, rng) for p in truth.parts]
            ours = [sample([p.meshes[state]], SAMPLES, rng) for p in found]
            row = [chamfer(ours[0], true[0])]
            for k in range(1, len(true)):
                # A part that was not found is held against the nearest one.
                candidates = [by_id[found_of_true[k]]] if k in found_of_true else range(len(found))
                row.append(min(chamfer(ours[i], true[k]) for i in candidates))
            whole = [sample([p.meshes[state] for p in side], SAMPLES, rng) for side in (found, truth.parts)]
            rows[state].append([*row, chamfer(*whole)])

    def named(mean: np.ndarray) -> dict[str, Any]:
        movable = [float(v) for v in mean[1:-1]]
        average = float(np.mean(movable)) if movable else None
        return {
            "static": float(mean[0]),
            "movable": movable,
            "movable_mean": average,
            "whole": float(mean[-1]),
        }

    return named(np.mean(rows[0] + rows[1], axis=0)) | {"start": named(np.mean(rows[0], axis=0))}


def _volumes(truth: Truth, found: Sequence[FoundPart], found_of_true: dict[int, int]) -> list[float | None]:
    """Each true part's volume as found, over the true one; None for a part not found, or where a mesh is not closed."""
    mesh_of = {p.id: p.meshes[0] for p in found}
    ratios: list[float | None] = []
    for k, part in enumerate(truth.parts):
        true, ours = part.meshes[0], mesh_of.get(found_of_true.get(k, -1))
        closed = ours is not None and true.is_watertight and ours.is_watertight and true.volume > 0
        ratios.append(float(ours.volume / true.volume) if ours is not None and closed else None)
    return ratios


def _penetrations(twin: Twin, found: Sequence[FoundPart]) -> dict[str, Any]:
    """Of each mover into the base, all joints going from state 0 to state 1 together; the worst counts."""
    steps = twin.on_the_way(1, STEPS)
    each = {
        p.id: asdict(penetration(found[0].meshes[0], p.meshes[0], [poses[p.id] for poses in steps])) for p in found[1:]
    }
    worst = {key: max((e[key] for e in each.values()), default=0.0) for key in ("volume_fraction", "depth")}
    return worst | {"each": {str(part): e for part, e in each.items()}}


def _score_views(
    run: Path, twin: Twin, truth: Truth, true_of_found: dict[int, int], masks: Path | None
) -> tuple[dict, dict]:
    views: dict[str, Any] = {"psnr": None, "ssim": None, "lpips": None, "lpips_why_null": NO_LPIPS}
    try:
        capture, max_size = _capture_of(run)
        scores = score_views(run, twin, truth, true_of_found, capture, max_size, masks)
    except HingesplatError as e:
        return views | {"why_null": str(e)}, {"part_iou": None}
    views |= {
        "psnr": scores.psnr,
        "ssim": scores.ssim,
        "psnr_by_state": list(scores.psnr_by_state),
        "count": scores.count,
    }
    return views, {"part_iou": scores.part_iou, "part_iou_each": scores.part_iou_each}


def _capture_of(run: Path) -> tuple[Path, int | None]:
    """The capture a run was made from and the size its photographs were reduced to, from its config.json."""
    path = run / "config.json"
    config = read_json(path, "the photographs are not known")
    if not isinstance(config.get("capture"), str):
        raise HingesplatError(f"{path}: lacks the key 'capture'; the photographs are not known")
    return Path(config["capture"]), config.get("max_size")
