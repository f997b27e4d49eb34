"""What the run folder holds, put into one page: text and pictures by Jinja, the moving twin by ``bundle.js``."""

import base64
import gzip
import math
from dataclasses import replace
from datetime import datetime
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import torch

from hingesplat.errors import HingesplatError
from hingesplat.export.spz import MAX_DEGREE, spz_bytes
from hingesplat.files import read_json, write_text
from hingesplat.gaussians import Gaussians, posed
from hingesplat.pictures import part_colour
from hingesplat.report.curves import chart_rows
from hingesplat.twin import Joint, Twin

SPLAT_BYTES = 5_500_000
"""Of splats before compression, above which higher spherical harmonics are left out of the page."""
EXPORTS = ("export/mjcf/twin.xml", "export/urdf/twin.urdf", "export/sdf/model.sdf", "export/usd/twin.usd")
"""Files that the page tells how to load."""


def write_report(folder: Path) -> Path:
    """Write ``report.html`` into a run folder, whole or not at all, and return its path.

    Needs ``twin.json`` and ``gaussians.safetensors``; shows what it finds of ``views/``, ``curves.json``,
    ``stages.json``, ``summary.json``, ``metrics.json`` and ``export/``, and leaves out the rest.

    Raises:
        HingesplatError: no twin in the folder, or a file of it is broken or of another version.
    """
    twin = Twin.load(folder / "twin.json")
    gaussians = Gaussians.load(folder / "gaussians.safetensors")
    try:
        page = _page(folder, twin, gaussians)
    except (KeyError, TypeError, IndexError, jinja2.UndefinedError) as e:
        raise HingesplatError(f"{folder}: one of its JSON files is not of this version ({e}); reconstruct again") from e
    return write_text(folder / "report.html", page)


def _page(folder: Path, twin: Twin, gaussians: Gaussians) -> str:
    def told(name: str) -> dict[str, Any]:
        return read_json(folder / name, "make it again or delete it", absent={})

    shown = {"up": [0, 0, 1], "held_out": False, "views": []} | told("views/views.json")
    views = [_embedded(view, folder / "views") for view in shown["views"]]
    first = next((view for view in views if view["state"] == views[-1]["state"]), None)
    config = told("config.json")
    stages = told("stages.json")
    bundle = gzip.compress(_resource("bundle.js").encode(), 9, mtime=0)
    template = _environment().get_template("page.html")
    return template.render(
        title=Path(config.get("capture", folder.resolve())).name,
        made=datetime.fromtimestamp((folder / "twin.json").stat().st_mtime),
        count=len(gaussians),
        twin=twin,
        unit=_unit(twin),
        names={part.id: part.name for part in twin.parts},
        colours={part.id: _css(part.id) for part in twin.parts},
        scene=scene(twin, gaussians, shown["up"], first),
        views=views,
        first=first,
        held_out=shown["held_out"],
        charts=chart_rows(told("curves.json")),
        seconds={name: entry["seconds"] for name, entry in stages.items()},
        summary=told("summary.json"),
        metrics=told("metrics.json"),
        exports=[path for path in EXPORTS if (folder / path).is_file()],
        style=_resource("page.css"),
        bundle=base64.b64encode(bundle).decode(),
    )


def scene(twin: Twin, gaussians: Gaussians, up: list[float], first: dict[str, Any] | None) -> dict[str, Any]:
    """What the moving picture needs, moved and scaled so that the object, its joints at their ends, fills a unit ball.

    Args:
        twin: its parts and joints.
        gaussians: in state 0, with part ids.
        up: away from the ground, world frame.
        first: the entry of ``views.json`` whose camera shows the twin at first, if there is any.
    """
    means = gaussians.means.detach().cpu().double().numpy()
    ends = [{}, {j.child: j.states[-1] for j in twin.joints}, *({j.child: v} for j in twin.joints for v in j.limits)]
    there = [posed(gaussians, twin.transforms(values)).means.detach().cpu().numpy() for values in ends]
    low, high = np.quantile(np.concatenate(there), (0.005, 0.995), axis=0) if len(means) else np.zeros((2, 3))
    centre, size = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-9)
    small = replace(
        gaussians.detached(),
        means=torch.from_numpy((means - centre) / size).float(),
        log_scales=gaussians.log_scales.detach() - math.log(size),
    )
    degree = MAX_DEGREE
    while degree > 0 and len(gaussians) * (14 + 3 * (degree + 1) ** 2) > SPLAT_BYTES:
        degree -= 1
    parts = []
    for part in twin.parts:
        own = small[small.part == part.id]
        spz = base64.b64encode(spz_bytes(own, max_degree=degree)).decode() if len(own) else None
        parts.append({"id": part.id, "colour": _css(part.id), "spz": spz})
    joints = [
        {
            **{name: getattr(joint, name) for name in ("child", "parent", "type", "axis", "states", "limits")},
            "pivot": ((np.asarray(joint.pivot) - centre) / size).tolist(),
            "outward": _outward(joint, means[(gaussians.part == joint.child).cpu().numpy()]),
        }
        for joint in twin.joints
    ]
    view, pixel = _aside(np.asarray(up, float)), 0.0
    if first is not None:
        view = np.asarray(first["camera"]["position"]) - centre
        pixel = float(np.linalg.norm(view)) / first["camera"]["focal_pixels"] / size
    return {
        "size": size,
        "unit": _unit(twin),
        "up": up,
        "from": view.tolist(),
        "outline": _outline((np.concatenate(there) - centre) / size),
        "pixel": pixel,
        "parts": parts,
        "joints": joints,
    }


def confidence_word(joint: Joint) -> str:
    """How sure the type of a joint is, in words."""
    if joint.confidence is None:
        return ""
    for least, word in ((0.99, "certain"), (0.9, "very likely"), (0.7, "likely")):
        if joint.confidence >= least:
            return word
    return "uncertain"


def _aside(up: np.ndarray) -> np.ndarray:
    """Somewhere to look from, a little above the ground."""
    side = np.eye(3)[int(np.abs(up).argmin())]
    return side - (side @ up) * up + 0.5 * np.cross(up, side) + 0.4 * up


def _outline(points: np.ndarray) -> list[list[float]]:
    """The outermost points (n, 3) in many directions, stray ones left out: what the first picture has to hold."""
    if not len(points):
        return [[0.0, 0.0, 0.0]]
    along = points @ np.random.default_rng(0).normal(size=(3, 64))
    stray = len(points) // 1000
    rows = np.argpartition(along, -1 - stray, axis=0)[-1 - stray]
    return points[np.unique(rows)].round(3).tolist()


def _outward(joint: Joint, means: np.ndarray) -> list[float]:
    """From the joint to the middle of its part."""
    return (means.mean(0) - np.asarray(joint.pivot)).tolist() if len(means) else [1.0, 0.0, 0.0]


def _unit(twin: Twin) -> str:
    return "m" if twin.units == "metres" else "units"


def _css(part_id: int) -> str:
    return "#" + "".join(f"{round(255 * c):02x}" for c in part_colour(part_id))


def _embedded(view: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The view with its pictures as data addresses."""
    try:
        data = {what: base64.b64encode((folder / view[what]).read_bytes()).decode() for what in ("photo", "twin")}
    except FileNotFoundError as e:
        raise HingesplatError(f"{e.filename}: missing; reconstruct again") from e
    return view | {what: f"data:image/webp;base64,{text}" for what, text in data.items()}


def _resource(name: str) -> str:
    return files("hingesplat.report").joinpath(name).read_text(encoding="utf-8")


def _environment() -> jinja2.Environment:
    loader = jinja2.FunctionLoader(_resource)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"degrees": math.degrees, "confidence": confidence_word}
    return environment
