"""Measure how time and memory grow with Gaussians, image size, views and parts, and fit an exponent to each.

    python benchmarks/growth.py [--page docs/performance.md] [--axes gaussians pixels views parts capture]

Every size is a process of its own, on one thread: its jobs' seconds are medians of CPU time, its memory is the most
that the process held. An exponent is the slope of log time over log size in the upper half of the sizes; n log n looks
like 1.1 here, and caches that overflow add to it, so what exceeds 1.35 is told. Draws docs/growth.png and writes
benchmarks/results/growth.json.
"""

import atexit
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

from common import machine, markdown, recorded, save, set_between  # it precedes torch

# isort: split
import numpy as np
import torch
import tyro
from PIL import Image, ImageDraw, ImageFont
from rasteriser import photographs, shell, view

from hingesplat.capture import load_capture, visual_hull, write_state
from hingesplat.export import export_twin
from hingesplat.fit import FitConfig, fit
from hingesplat.fuse import FuseConfig, fuse
from hingesplat.gaussians import SH_C0, Gaussians, posed
from hingesplat.losses.photometric import Target, photometric
from hingesplat.mesh import MeshConfig, mesh_parts
from hingesplat.optim import GaussianAdam, LearningRates
from hingesplat.pipeline import peak_memory_mb
from hingesplat.render import render
from hingesplat.stereo import StereoConfig, stereo
from hingesplat.surface import surface_of
from hingesplat.training import grow, seen_weight, training_view
from hingesplat.twin import Joint, Part, Twin

Axis = Literal["gaussians", "pixels", "views", "parts", "capture"]
SIZES: dict[str, tuple[int, ...]] = {
    "gaussians": (5_000, 20_000, 50_000, 100_000, 200_000, 500_000, 1_000_000),
    "pixels": (128, 200, 400, 800, 1600),
    "views": (20, 50, 100, 200, 400),
    "parts": (2, 4, 8, 16),
    "capture": (200,),
}
"""Number of Gaussians at 400²; image side at 20 000 Gaussians; photographs of a state at 96²; parts of 20 000
Gaussians; photographs, 1600 × 1200, of a capture of two states."""
NEARLY_LINEAR = 1.35
CAPTURE_LIMIT_MB = 4096
FIGURE = Path(__file__).resolve().parents[1] / "docs" / "growth.png"

Jobs = dict[str, Callable[[], Any]]


@dataclass(frozen=True)
class Options:
    """What to measure."""

    axes: tuple[Axis, ...] = ("gaussians", "pixels", "views", "parts", "capture")
    """Those not named keep what is recorded."""
    page: Path | None = None
    """Page whose tables are set."""
    child: tuple[str, int] | None = None
    """Axis and size: measure this one here and print it as JSON."""


def gaussians(n: int, parts: int = 1) -> Gaussians:
    """The shell, cut like an orange into so many parts."""
    means, quats, scales, opacities, colors = (t.detach() for t in shell(n))
    part = ((torch.atan2(means[:, 1], means[:, 0]) / torch.pi + 1) * parts / 2).long().clamp(0, parts - 1)
    sh = ((colors - 0.5) / SH_C0)[:, None]
    return Gaussians(means, quats, scales.log(), opacities.logit(), sh, part)


def learning(n: int) -> GaussianAdam:
    optimiser = GaussianAdam(gaussians(n), LearningRates(), 1.0)
    for value in optimiser.values.values():
        value.grad = torch.full_like(value, 1e-3)
    return optimiser


def draw(g: Gaussians, side: int) -> None:
    """Forward and backward."""
    leaf = replace(g, means=g.means.clone().requires_grad_(), sh=g.sh.clone().requires_grad_())
    r = render(leaf, view(side))
    (r.rgb.sum() + r.alpha.sum()).backward()


def scratch() -> Path:
    """A folder that goes when the process does."""
    folder = tempfile.TemporaryDirectory(prefix="hingesplat-growth-")
    atexit.register(folder.cleanup)
    return Path(folder.name)


def by_gaussians(n: int) -> Jobs:
    g, steps = gaussians(n), [learning(n) for _ in range(4)]
    statistics = torch.rand((n, 3))
    labels, move = np.zeros(n, np.int64), np.eye(4)[None]

    def step() -> None:
        steps[0].step(0.5)
        for value in steps[0].values.values():
            value.grad = torch.full_like(value, 1e-3)

    def densify() -> None:
        grow(steps.pop(), statistics, n + n // 8, 0.02, 1.0, torch.Generator().manual_seed(0))

    return {
        "draw, both ways": lambda: draw(g, 400),
        "step of Adam": step,
        "densify, sort": densify,
        "fuse two states": lambda: fuse((g, g), (labels, labels), move, FuseConfig()),
        "who is seen (2 views)": lambda: seen_weight(g, [view(400)] * 2),
    }


def by_pixels(side: int) -> Jobs:
    g, photo = gaussians(20_000), torch.rand((4, side, side))
    leaf, target = torch.rand((4, side, side)).requires_grad_(), Target.of(photo)
    folder = scratch()
    views = photographs(4, side)
    for state in (0, 1):
        write_state(folder / f"state{state}", views, "train")
    return {
        "draw, both ways": lambda: draw(g, side),
        "loss, both ways": lambda: photometric(leaf, target).backward(),
        "a photograph's statistics": lambda: Target.of(photo),
        "load 8 photographs": lambda: load_capture(folder),
    }


def by_views(count: int) -> Jobs:
    views = photographs(count, 96)
    g, config = gaussians(5_000), StereoConfig(image_size=64, planes=16)
    maps = stereo(views, config)
    folder = scratch()
    for state in (0, 1):
        write_state(folder / f"state{state}", views, "train")

    def targets() -> None:
        kept = [training_view(v) for v in views]
        sum(float(v.target.mean[0, 0, 0]) for v in kept)

    return {
        "load two states": lambda: load_capture(folder),
        "stereo": lambda: stereo(views, config),
        "visual hull": lambda: visual_hull(views, 64),
        "visible surface": lambda: surface_of(g, views, maps, 64, 0.02, 0.02),
        "prepare for training": targets,
        "who is seen": lambda: seen_weight(g, [v.camera for v in views]),
    }


def by_parts(count: int) -> Jobs:
    g, cameras = gaussians(20_000, count), [v.camera for v in photographs(16, 96)]
    ids = range(1, count)
    joints = [Joint(i, 0, "prismatic", (0, 0, 1.0), (0, 0, 0.0), (0, 0.1), (0, 0.1)) for i in ids]
    parts = [Part(i, f"part_{i}", int((g.part == i).sum())) for i in range(count)]
    twin, config = Twin(tuple(parts), tuple(joints)), MeshConfig(image_size=96, resolution=48)
    states = [(cameras, twin.at_state(t)) for t in (0, 1)]
    meshes = mesh_parts(g, states, config)

    def export() -> None:
        with tempfile.TemporaryDirectory() as folder:
            export_twin(twin, meshes, g, Path(folder) / "out", ["urdf"])

    return {
        "pose and draw": lambda: draw(posed(g, twin.at_state(1)), 200),
        "mesh": lambda: mesh_parts(g, states, config),
        "export": export,
    }


def big_capture(folder: Path, count: int) -> None:
    """So many photographs of 1600 × 1200 in two states, written one at a time."""
    size = (1600, 1200)
    for state in (0, 1):
        home = folder / f"state{state}"
        path = write_state(home, photographs(count // 2, 200), "train")
        data = json.loads(path.read_text())
        data |= {"fl_x": 6 * data["fl_x"], "fl_y": 6 * data["fl_y"]}
        data |= {"cx": size[0] / 2, "cy": size[1] / 2, "w": size[0], "h": size[1]}
        for frame in data["frames"]:
            with Image.open(home / frame["file_path"]) as small:
                whole = Image.new("RGBA", size)
                whole.paste(small.resize((1200, 1200), Image.Resampling.NEAREST), (200, 0))
            whole.save(home / frame["file_path"], compress_level=1)
        path.write_text(json.dumps(data))


def by_capture(count: int) -> Jobs:
    """Each needs what those before it made."""
    folder = scratch()
    big_capture(folder, count)
    made: dict[str, Any] = {}

    def load() -> None:
        made["capture"] = load_capture(folder)

    def look() -> None:
        for state in made["capture"].states:
            made[state.name] = [training_view(v) for v in state.train]
        for state in made["capture"].states:
            for photo in made[state.name]:
                float(photo.target.mean[0, 0, 0])

    return {
        "load": load,
        "stereo of a state": lambda: stereo(made["capture"].states[0].train, StereoConfig(planes=16)),
        "20 steps of fit": lambda: fit(made["capture"].states[0].train, FitConfig(steps=20, max_sh_degree=0)),
        "look at every photograph": look,
    }


JOBS: dict[str, Callable[[int], Jobs]] = {
    "gaussians": by_gaussians,
    "pixels": by_pixels,
    "views": by_views,
    "parts": by_parts,
    "capture": by_capture,
}


def measure_here(axis: str, size: int) -> dict[str, Any]:
    """Seconds of CPU time of every job, and the most memory after it."""
    torch.set_num_threads(1)
    before, seconds, peak = peak_memory_mb(), {}, {}
    for name, job in JOBS[axis](size).items():
        times = []
        while len(times) < (4 if axis != "capture" and times[:1] < [2.0] else 1):
            start = time.process_time()
            job()
            times.append(time.process_time() - start)
        seconds[name] = round(float(np.median(times[1:] or times)), 5)  # The first loads what is compiled.
        peak[name] = peak_memory_mb()
    return {"size": size, "seconds": seconds, "peak_mb": peak, "mb_before": before}


def measure(axis: str) -> list[dict[str, Any]]:
    rows = []
    warm_up = SIZES[axis][:1] if axis != "capture" else ()  # What it compiles, those after it find on disk.
    for size in (*warm_up, *SIZES[axis]):
        sys.stderr.write(f"{axis} {size}\n")
        command = [sys.executable, __file__, "--child", axis, str(size)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
    return rows[len(warm_up) :]


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Slope of log value over log size in the upper half of the sizes."""
    k = max(min(len(sizes) // 2, len(sizes) - 2), 0)
    return round(float(np.polyfit(np.log(sizes[k:]), np.log(np.maximum(values[k:], 1e-6)), 1)[0]), 2)


def work(axis: str, size: float) -> float:
    """What time should be proportional to: the number of things, which for an image are its pixels."""
    return size * size if axis == "pixels" else size


def fits(rows: dict[str, list[dict[str, Any]]]) -> dict[str, dict[str, float]]:
    """Exponents of every job's seconds, and of the memory beyond what a process needs anyway."""
    found = {}
    for axis, measured in rows.items():
        if len(measured) > 1:
            sizes = [work(axis, row["size"]) for row in measured]
            jobs = {job: [row["seconds"][job] for row in measured] for job in measured[0]["seconds"]}
            jobs["memory"] = [max(max(row["peak_mb"].values()) - row["mb_before"], 1) for row in measured]
            found[axis] = {job: exponent(sizes, values) for job, values in jobs.items()}
    return found


def table(found: dict[str, Any]) -> str:
    """For the page."""
    lines = []
    for axis, rows in found["rows"].items():
        several = axis in found["exponents"]
        told = found["exponents"].get(axis, {})
        cells = [
            [job, *(f"{row['seconds'][job]:.3g}" for row in rows), *([f"{told[job]:.2f}"] if several else [])]
            for job in rows[0]["seconds"]
        ]
        most = [f"{max(row['peak_mb'].values()):.0f}" for row in rows]
        cells.append(["memory, MB", *most, *([f"{told['memory']:.2f}"] if several else [])])
        head = [f"{axis}: seconds at", *(f"{row['size']:,}" for row in rows), *(["exponent"] if several else [])]
        lines += [markdown(head, cells), ""]
    steep = [f"{job} ({axis}, {e:.2f})" for axis, jobs in found["exponents"].items() for job, e in jobs.items()]
    steep = [
        s
        for s, e in zip(steep, (e for j in found["exponents"].values() for e in j.values()), strict=True)
        if e > NEARLY_LINEAR
    ]
    lines.append(f"Worse than n log n: {'; '.join(steep) or 'nothing'}.")
    return "\n".join([*lines, "", f"Machine: {found['machine']}; one thread."])


def figure(rows: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Log-log curves, one panel an axis, n log n dashed; drawn with Pillow, since a plot library is not needed else."""
    panels = {axis: measured for axis, measured in rows.items() if len(measured) > 1}
    w, h, margin = 560, 420, 60
    image = Image.new("RGB", (2 * w, h * -(-len(panels) // 2)), "white")
    pen, font = ImageDraw.Draw(image), ImageFont.load_default(14)
    colours = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#8c564b")
    for k, (axis, measured) in enumerate(panels.items()):
        left, top = k % 2 * w + margin, k // 2 * h + 30
        wide, high = w - margin - 20, h - 80
        sizes = np.array([row["size"] for row in measured], float)
        curves = {job: np.array([row["seconds"][job] for row in measured]) for job in measured[0]["seconds"]}
        everything = np.maximum(np.concatenate(list(curves.values())), 1e-5)
        low, top_value = np.floor(np.log10(everything.min())), np.ceil(np.log10(everything.max()))
        span = np.log(sizes[-1] / sizes[0])

        def at(size, value, left=left, top=top, wide=wide, high=high, low=low, up=top_value, span=span, sizes=sizes):
            x = left + wide * np.log(size / sizes[0]) / span
            return float(x), float(top + high * (up - np.log10(max(value, 1e-9))) / max(up - low, 1))

        pen.rectangle((left, top, left + wide, top + high), outline="#999999")
        pen.text((left, top - 22), f"seconds by {axis}", fill="black", font=font)
        for power in range(int(low), int(top_value) + 1):
            pen.text((left - 45, at(sizes[0], 10.0**power)[1] - 8), f"1e{power}", fill="black", font=font)
        for size in sizes:
            pen.text((at(size, 1)[0] - 14, top + high + 4), f"{size:g}", fill="black", font=font)
        for j, (job, values) in enumerate(curves.items()):
            pen.line([at(s, v) for s, v in zip(sizes, values, strict=True)], fill=colours[j], width=2)
            pen.text((left + 8, top + 4 + 17 * j), job, fill=colours[j], font=font)
        things = work(axis, sizes)
        guide = things * np.log2(things) / (things[-1] * np.log2(things[-1])) * 10.0**top_value
        points = [at(s, v) for s, v in zip(sizes, guide, strict=True) if v >= 10.0**low]
        for a, b in pairwise(points):
            for f in np.arange(0, 1, 0.1):
                p, q = ((a[i] + (b[i] - a[i]) * f, a[i] + (b[i] - a[i]) * (f + 0.05)) for i in (0, 1))
                pen.line([(p[0], q[0]), (p[1], q[1])], fill="#777777", width=1)
    draft = path.with_suffix(".tmp.png")
    image.quantize(64).save(draft, optimize=True)
    draft.replace(path)


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    if options.child is not None:
        sys.stdout.write(json.dumps(measure_here(*options.child)) + "\n")
        return
    known = recorded("growth") or {"rows": {}}
    rows = {axis: measure(axis) if axis in options.axes else known["rows"].get(axis, []) for axis in SIZES}
    rows = {axis: measured for axis, measured in rows.items() if measured}
    found = {"machine": machine(), "exponents": fits(rows), "rows": rows}
    save("growth", found)
    figure(rows, FIGURE)
    if options.page is not None:
        set_between(options.page, "growth", table(found))
    if "capture" in rows and (most := max(rows["capture"][0]["peak_mb"].values())) > CAPTURE_LIMIT_MB:
        raise SystemExit(f"a capture of {SIZES['capture'][0]} photographs takes {most:.0f} MB, over {CAPTURE_LIMIT_MB}")


if __name__ == "__main__":
    main()
