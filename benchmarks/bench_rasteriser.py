"""Time the CPU rasteriser and the photometric loss, interleaved with their definitions in torch.

    python benchmarks/bench_rasteriser.py

Forward and backward times on one thread: medians of CPU time (so that a busy machine disturbs little), in
milliseconds. The brute-force torch rasteriser is timed on fewer Gaussians and pixels, where both can run.
Writes benchmarks/results/rasteriser.json.
"""

import json
import platform
import time
from pathlib import Path

import numba
import numpy as np
import torch

from hingesplat.camera import Camera
from hingesplat.losses.photometric import Target, photometric, ssim_map
from hingesplat.render import Backend, rasterize
from hingesplat.simd import LANES

REPEATS = 25
SCENES = ((10_000, 200), (20_000, 400))
SMALL = (500, 100)
"""Gaussians and image side at which the torch definition is timed."""


def shell(n: int, seed: int = 0) -> list[torch.Tensor]:
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
    pose = np.eye(4)
    pose[2, 3] = -1.6
    return Camera(pose, 1.3 * side, 1.3 * side, side / 2, side / 2, side, side)


def cpu_times(jobs: dict, repeats: int) -> dict[str, list[float]]:
    """Median milliseconds of (forward, backward) of each job; the jobs take turns."""
    times = {name: [] for name in jobs}
    for repeat in range(repeats + 1):
        for name, (forward, leaves) in jobs.items():
            start = time.thread_time()
            value = forward()
            middle = time.thread_time()
            value.backward()
            times[name].append((middle - start, time.thread_time() - middle))
            for leaf in leaves:
                leaf.grad = None
        if repeat == 0:  # compiling
            times = {name: [] for name in jobs}
    return {name: (1e3 * np.median(t, axis=0)).round(3).tolist() for name, t in times.items()}


def rasterising(n: int, side: int, backend: Backend) -> tuple:
    leaves, camera = shell(n), view(side)
    means, quats, scales, opacities, colors = leaves

    def forward():
        r = rasterize(means, quats, scales, opacities, colors, camera, backend=backend)
        return (r.rgb.sum() + r.depth.sum()) + r.alpha.sum()

    return forward, leaves


def losses(side: int) -> dict:
    image, photo = (torch.rand((3, side, side)).requires_grad_(k) for k in (True, False))
    target = Target.of(photo)

    def plain():
        return 0.8 * (image - photo).abs().mean() + 0.2 * (1 - ssim_map(image, target).mean())

    return {"fused": (lambda: photometric(image, target), [image]), "torch": (plain, [image])}


def main() -> None:
    torch.set_num_threads(1)
    rows, ratios = {}, {}
    n, side = SMALL
    small = cpu_times({"numba": rasterising(n, side, "numba"), "torch": rasterising(n, side, "torch")}, repeats=7)
    ratios["torch / numba"] = round(sum(small["torch"]) / sum(small["numba"]), 1)
    rows |= {f"{b}, {n} Gaussians, {side}×{side}": t for b, t in small.items()}
    sizes = {f"numba, {n} Gaussians, {side}×{side}": rasterising(n, side, "numba") for n, side in SCENES}
    rows |= cpu_times(sizes, REPEATS)
    for _, side in SCENES:
        pair = cpu_times(losses(side), 7)
        ratios[f"torch loss / fused loss, {side}×{side}"] = round(sum(pair["torch"]) / sum(pair["fused"]), 1)
        rows |= {f"{name} loss, {side}×{side}": t for name, t in pair.items()}
    result = {
        "machine": {"processor": platform.machine(), "lanes": LANES, "python": platform.python_version()},
        "versions": {"torch": torch.__version__, "numba": numba.__version__},
        "forward and backward, ms of CPU time on one thread": rows,
        "ratios": ratios,
    }
    target = Path(__file__).parent / "results" / "rasteriser.json"
    target.parent.mkdir(exist_ok=True)
    draft = target.with_suffix(".tmp")
    draft.write_text(json.dumps(result, indent=2, ensure_ascii=False) + "\n")
    draft.replace(target)
    print(target.read_text())  # noqa: T201


if __name__ == "__main__":
    main()
