"""Time the CPU rasteriser and the photometric loss beside others, all in one process, taking turns.

    python benchmarks/rasteriser.py [--check] [--page docs/performance.md]

Medians of CPU time on one thread (so that a busy machine disturbs little), forward and backward: our engine, its
definition in torch, and the rasterisers of ``peers/``. Each is held against the definition before it is timed. Then two
threads against one, by the clock, beside two pictures at once, and the rasteriser's share of a training step.
``--check`` compares the ratios with those recorded and fails where one is more than 15 % worse; without it they are
recorded.
"""

import importlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from common import machine, markdown, recorded, save, set_between  # it precedes torch

# isort: split
import numpy as np
import torch
import tyro
from peers import draw
from torch import Tensor

import hingesplat.render.numba_backend as engine
from hingesplat.camera import Camera, look_at
from hingesplat.capture import View
from hingesplat.fit import FitConfig, fit
from hingesplat.losses.photometric import Target, photometric, ssim_map
from hingesplat.render import Backend, rasterize
from hingesplat.stereo import Cloud

SCENES = ((10_000, 200), (20_000, 400))
"""Gaussians and image side."""
SMALL = (500, 100)
"""At which all are compared with the definition, and the definition is timed: it is brute force over pixels times
Gaussians, so what ours gains on it only grows with the scene."""
PEERS = {"C++": "cpp", "Numba, pixel by pixel": "pixelwise", "Warp": "warp_port", "Taichi": "taichi_port"}
IMAGE_ERROR, GRADIENT_ERROR = 1e-3, 1e-3
"""Largest and relative: a rasteriser that errs by more is not timed."""
WORSE = 0.85
"""A ratio below this share of the recorded one fails the check."""
SLOW_REPEATS = 5
STEPS = 60
"""Of training, timed."""

Job = tuple[Callable[[], Sequence[Tensor]], list[Tensor], list[Tensor]]
"""Draws outputs, from leaves; gradients of a loss in these outputs."""


@dataclass(frozen=True)
class Options:
    """What to do with what was measured."""

    check: bool = False
    """Compare with what is recorded instead of recording."""
    page: Path | None = None
    """Page whose table is set."""
    repeats: int = 25
    """Of ours beside the C++ build, and of two threads beside one."""


def shell(n: int, seed: int = 0) -> list[Tensor]:
    """n flat Gaussians on a sphere of radius 0.5, as wide as their spacing: an object's surface."""
    g = torch.Generator().manual_seed(seed)
    normal = torch.nn.functional.normalize(torch.randn((n, 3), generator=g), dim=1)
    spacing = 0.5 * (4 * np.pi / n) ** 0.5
    scales = 0.6 * spacing * torch.exp(0.4 * torch.randn((n, 3), generator=g)) * torch.tensor([1, 1, 0.25])
    # The rotation that takes the z axis to the normal: half way between the two.
    quats = torch.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], torch.zeros(n)], dim=1) + 1e-6
    colors, opacities = torch.rand((n, 3), generator=g), 0.1 + 0.89 * torch.rand(n, generator=g)
    return [t.requires_grad_() for t in (0.5 * normal, quats, scales, opacities, colors)]


def view(side: int) -> Camera:
    """Looks at the shell from outside."""
    pose = np.eye(4)
    pose[2, 3] = -1.6
    return Camera(pose, 1.3 * side, 1.3 * side, side / 2, side / 2, side, side)


def gradients_of(outputs: Sequence[Tensor]) -> list[Tensor]:
    """The same random ones for every rasteriser, however it cuts its image."""
    g = torch.Generator().manual_seed(1)
    return [torch.randn(o.shape, generator=g) for o in outputs]


def ours(n: int, side: int, backend: Backend = "numba") -> Job:
    leaves, camera = shell(n), view(side)

    def run() -> Sequence[Tensor]:
        r = rasterize(*leaves, camera, backend=backend)
        return r.rgba, r.depth

    whole = gradients_of([torch.empty(5, side, side)])[0]
    return run, leaves, [whole[[0, 1, 2, 4]], whole[3].contiguous()]


def peer(module: Any, n: int, side: int) -> Job:
    leaves, rasteriser = shell(n), module.Rasteriser(n, view(side))
    return lambda: (draw(rasteriser, *leaves),), leaves, gradients_of([torch.empty(5, side, side)])


def check(name: str, job: Job) -> None:
    """Hold a rasteriser against the definition at the small scene: a wrong result is not worth a time."""
    run, leaves, gradients = job
    image = run()
    found = torch.autograd.grad(image, leaves, gradients)
    exact_leaves = [t.detach().double().requires_grad_() for t in shell(SMALL[0])]
    r = rasterize(*exact_leaves, view(SMALL[1]), backend="torch")
    exact_image = torch.cat([r.rgb, r.depth[None], r.alpha[None]])
    weights = gradients_of([exact_image])[0].double()
    exact = torch.autograd.grad(exact_image, exact_leaves, weights)
    flat = image[0] if len(image) == 1 else torch.cat([image[0][:3], image[1][None], image[0][3:]])
    worst = float((flat - exact_image).detach().abs().max())
    worst_gradient = max(float((a - b).norm() / b.norm()) for a, b in zip(found, exact, strict=True))
    if worst > IMAGE_ERROR or worst_gradient > GRADIENT_ERROR:
        raise SystemExit(f"{name}: wrong by {worst:.1e} in the image, {worst_gradient:.1e} in the gradients")


def medians(
    jobs: dict[str, Job], repeats: int, clock: Callable[[], float] = time.process_time
) -> dict[str, list[float]]:
    """Milliseconds of (forward, backward) of each job; the jobs take turns, the first turn does not count."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in jobs}
    for turn in range(repeats + 1):
        for name, (run, leaves, gradients) in jobs.items():
            start = clock()
            outputs = run()
            middle = clock()
            torch.autograd.grad(outputs, leaves, gradients)
            if turn:
                times[name].append((middle - start, clock() - middle))
            del outputs
    return {name: (1e3 * np.median(t, axis=0)).round(3).tolist() for name, t in times.items()}


def rasterisers(repeats: int, say: Callable[[str], None]) -> tuple[dict[str, Any], dict[str, float], dict[str, str]]:
    """Times, ratios to ours, and why some are absent."""
    modules, absent = {}, {}
    for name, module in PEERS.items():
        found = importlib.import_module(f"peers.{module}")
        why = found.why_not() if hasattr(found, "why_not") else None
        if why is not None:
            absent[name] = why
            continue
        say(f"{name}: checked against the definition")
        check(name, peer(found, *SMALL))
        modules[name] = found
    check("ours", ours(*SMALL))
    times, ratios = {}, {}

    def compare(n: int, side: int, others: dict[str, Job], repeats: int) -> None:
        if others:
            label, jobs = f"{n} at {side}²", {"ours": ours(n, side)} | others
            found = medians(jobs, repeats)
            times[label] = found | times.get(label, {})  # Ours as it ran beside the fastest of the others.
            for name in others:
                ratios[f"{name} / ours, {label}"] = round(sum(found[name]) / sum(found["ours"]), 2)
            say(f"{label}: {found}")

    compare(*SMALL, {"torch": ours(*SMALL, backend="torch")}, SLOW_REPEATS)
    for n, side in SCENES:
        others = {name: peer(module, n, side) for name, module in modules.items()}
        compare(n, side, {name: job for name, job in others.items() if name == "C++"}, repeats)
        compare(n, side, {name: job for name, job in others.items() if name != "C++"}, SLOW_REPEATS)
    return times, ratios, absent


def losses(side: int) -> dict[str, Job]:
    image, photo = (torch.rand((4, side, side)).requires_grad_(k) for k in (True, False))
    target = Target.of(photo)

    def plain() -> Tensor:
        return 0.8 * (image - photo).abs().mean() + 0.2 * (1 - ssim_map(image, target).mean())

    one = [torch.ones(())]
    return {"ours": (lambda: [photometric(image, target)], [image], one), "torch": (lambda: [plain()], [image], one)}


def threads_gain(repeats: int) -> dict[str, float]:
    """How many times faster two threads draw a picture than one, by the clock, taking turns.

    Beside it, what the machine has to give: two pictures drawn at once on a thread each, against one after the other.
    They share nothing, but their cores may be one.
    """
    if (os.cpu_count() or 1) < 2:
        return {}

    def draw(job: Job, threads: int) -> None:
        torch.set_num_threads(threads)  # Of this Python thread only.
        run, leaves, gradients = job
        torch.autograd.grad(run(), leaves, gradients)

    gains = {}
    for n, side in SCENES:
        pair = [ours(n, side) for _ in range(2)]
        turns = []
        with ThreadPoolExecutor(2) as pool:
            for _ in range(10 * repeats + 1):  # Where the system puts the threads changes now and then.
                start = time.perf_counter()
                draw(pair[0], 1)
                one = time.perf_counter()
                draw(pair[0], 2)
                two = time.perf_counter()
                list(pool.map(draw, pair, [1, 1]))
                turns.append((one - start, two - one, time.perf_counter() - two))
        alone, together, both = np.median(turns[1:], axis=0)
        gains[f"1 thread / 2 threads, {n} at {side}²"] = round(float(alone / together), 2)
        gains[f"2 pictures in turn / at once, {n} at {side}²"] = round(float(2 * alone / both), 2)
    torch.set_num_threads(1)
    return gains


def photographs(count: int, side: int) -> list[View]:
    """The shell as cameras around it see it."""
    leaves, views = [t.detach() for t in shell(20_000)], []
    for i in range(count):
        turn, height = 2.4 * i, 1.5 * (i + 0.5) / count - 0.75
        eye = 1.6 * np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
        camera = replace(view(side), T_world_camera=look_at(eye, np.zeros(3), np.array([0.0, 0, 1])))
        r = rasterize(*leaves, camera)
        rgba = torch.cat([r.rgb / r.alpha.clamp_min(1e-3), r.alpha[None]]).permute(1, 2, 0)
        views.append(View(camera, (rgba.clamp(0, 1) * 255).round().byte().numpy(), f"{i:03d}"))
    return views


def rasteriser_share(n: int, side: int) -> tuple[float, float]:
    """Milliseconds of a training step, and the rasteriser's share of it: of a real fit, first to last step."""
    spent, marks = [0.0], {}

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            start = time.process_time()
            result = function(*args)
            spent[0] += time.process_time() - start
            return result

        return call

    def report(step: int, **_: Any) -> None:
        marks.setdefault(step, (time.process_time(), spent[0]))

    normal = torch.nn.functional.normalize(torch.randn((n, 3), generator=torch.Generator().manual_seed(0)), dim=1)
    cloud = Cloud(0.5 * normal.numpy(), normal.numpy(), np.full((n, 3), 0.5))
    config = FitConfig(steps=STEPS + 1, max_gaussians=n, densify_until=0, max_sh_degree=0)
    kept = engine._draw, engine._undraw
    engine._draw, engine._undraw = (timed(f) for f in kept)
    try:
        for _ in range(2):  # The first compiles.
            marks.clear()
            fit(photographs(8, side), config, cloud=cloud, report=report)
    finally:
        engine._draw, engine._undraw = kept
    first, last = min(marks), max(marks)
    (start, before), (end, after) = marks[first], marks[last]
    return 1e3 * (end - start) / (last - first), (after - before) / (end - start)


def measure(repeats: int, say: Callable[[str], None]) -> dict[str, Any]:
    torch.set_num_threads(1)
    times, ratios, absent = rasterisers(repeats, say)
    for _, side in SCENES:
        pair = medians(losses(side), SLOW_REPEATS)
        times[f"loss at {side}²"] = pair
        ratios[f"torch / ours, loss at {side}²"] = round(sum(pair["torch"]) / sum(pair["ours"]), 2)
    step, share = rasteriser_share(*SCENES[0])
    ratios[f"rasteriser / training step, {SCENES[0][0]} at {SCENES[0][1]}²"] = round(share, 2)
    ratios |= threads_gain(repeats)
    return {
        "machine": machine(),
        "forward and backward, ms of CPU time on one thread": times,
        "training step, ms of CPU time on one thread": round(step, 2),
        "ratios": ratios,
        "absent": absent,
    }


def table(found: dict[str, Any]) -> str:
    """For the page."""
    rows = []
    for scene, times in found["forward and backward, ms of CPU time on one thread"].items():
        for name, (forward, backward) in times.items():
            ratio = "1.00" if name == "ours" else found["ratios"].get(f"{name} / ours, {scene}", "")
            rows.append((scene, name, f"{forward:.2f}", f"{backward:.2f}", ratio))
    head = ("Gaussians at pixels", "", "forward, ms", "backward, ms", "times ours")
    lines = [markdown(head, rows), "", markdown(("ratio", ""), list(found["ratios"].items())), ""]
    lines += [f"{name} is left out: {why}.  " for name, why in found["absent"].items()]
    step = found["training step, ms of CPU time on one thread"]
    return "\n".join(
        [*lines, f"A training step takes {step} ms of CPU time on one thread.", f"Machine: {found['machine']}."]
    )


def worse(found: dict[str, float], known: dict[str, float]) -> list[str]:
    """A line for each ratio that is more than 15 % worse than recorded; what could not be measured is no worse."""
    return [
        f"{name}: {found[name]}, was {before}"
        for name, before in known.items()
        if found.get(name, before) < WORSE * before
    ]


def main() -> None:
    options = tyro.cli(Options, description=__doc__)

    def say(line: str) -> None:
        sys.stderr.write(line + "\n")

    known = recorded("rasteriser")
    if options.check and known is None:
        raise SystemExit("nothing is recorded yet: run make bench first")
    found = measure(options.repeats, say)
    if options.check:
        for name, ratio in found["ratios"].items():
            say(f"{name}: {ratio}, recorded {known['ratios'].get(name, 'never')}")
        if lines := worse(found["ratios"], known["ratios"]):
            raise SystemExit("more than 15 % worse than recorded:\n" + "\n".join(lines))
        return
    save("rasteriser", found)
    if options.page is not None:
        set_between(options.page, "rasteriser", table(found))


if __name__ == "__main__":
    main()
