"""Photographs in, twin out: the one file that knows the order of the stages.

Every stage reads what those before it wrote into the run folder and writes its own, so a run that was stopped
goes on where it was. ``stages.json`` says which stages are finished; files are written whole or not at all.
"""

import logging
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from threading import Event, Lock
from typing import Any, Literal

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

from hingesplat.align import AlignConfig, align, shown_movers
from hingesplat.articulate import ArticulateConfig, Articulation, articulate
from hingesplat.camera import common_up
from hingesplat.capture import Capture, View
from hingesplat.capture.images import downsampled
from hingesplat.errors import HingesplatError
from hingesplat.export import export_twin
from hingesplat.export.splats import write_ply
from hingesplat.files import whole_folder, write_json
from hingesplat.fit import FitConfig, fit
from hingesplat.fuse import FuseConfig, fuse
from hingesplat.gaussians import Gaussians, posed
from hingesplat.joints import JointsConfig, find_joints
from hingesplat.mesh import MeshConfig, mesh_parts
from hingesplat.pictures import movable_share, write_motion_gif, write_summary
from hingesplat.render import cuda_lacks
from hingesplat.report import spread_views, write_report, write_views
from hingesplat.run_folder import (
    load_meshes,
    load_result,
    log_file,
    open_folder,
    read_record,
    take_over,
    versions,
    write_tensors,
)
from hingesplat.segment import Segmentation, SegmentConfig
from hingesplat.slots import living_slots
from hingesplat.start import StartConfig, clusters, random_motions
from hingesplat.states import segment_states
from hingesplat.stereo import DepthMap, StereoConfig, depth_map, measured, stereo
from hingesplat.training import Report
from hingesplat.twin import Joint, Part, Twin

log = logging.getLogger(__name__)

PresetName = Literal["fast", "standard", "paper"]
MethodName = Literal["hingesplat", "part2gs", "artgs", "vanilla"]

MAX_UNEXPLAINED = 0.8
"""Share of what moved that no rigid part explains, above which there is no point in going on."""
PLAIN_UNEXPLAINED = 0.15
"""Share of what moved that the given number of parts leaves unexplained, above which there must be more parts."""
NOISE = 10
"""Seeds, in those of the smallest part, below which nothing need have moved: one state photographed twice had 167."""
SHOWN_VIEWS = 3
"""Photographs of each state that the report shows beside the twin."""


@dataclass(frozen=True)
class ReconstructConfig:
    """Everything that a reconstruction can be told."""

    preset: PresetName = "standard"
    """Where the numbers of the stages come from: about half the steps, ours, or the paper's."""
    method: MethodName = "hingesplat"
    """Where the switches of the stages come from: ours, or a method of the literature (docs/method.md), which needs
    ``parts``."""
    parts: Literal["auto"] | int = "auto"
    """Number of rigid parts with the base, an upper bound: redundant ones die. ``auto`` finds it."""
    seed: int = 0
    """Of every random choice; the same seed on the same machine gives the same joints."""
    max_size: int | None = None
    """Photographs longer than this many pixels are downsampled."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where Gaussians are optimised. ``auto`` takes CUDA where there is a device and gsplat is installed."""
    depth: bool = False
    """Take depth from the capture's depth pictures instead of finding it by stereo."""
    stereo: StereoConfig = field(default_factory=StereoConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    segment: SegmentConfig = field(default_factory=SegmentConfig)
    start: StartConfig = field(default_factory=StartConfig)
    align: AlignConfig = field(default_factory=AlignConfig)
    fuse: FuseConfig = field(default_factory=FuseConfig)
    articulate: ArticulateConfig = field(default_factory=ArticulateConfig)
    joints: JointsConfig = field(default_factory=JointsConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)


def preset(name: PresetName) -> ReconstructConfig:
    """``standard``: the defaults. ``fast``: about half the steps. ``paper``: its iterations and sizes.

    The paper fits for 30 000 iterations and fuses for 5 000 (Part²GS, supplementary); for its joint
    optimisation it gives no number, so that is the 20 000 of ArtGS. What it calls fusion, photographs of both
    states and one set of Gaussians, our ``articulate`` does, so it gets both. Caps are out of the way: 3DGS
    knows none.
    """
    config = ReconstructConfig(preset=name)
    match name:
        case "standard":
            return config
        case "fast":
            return replace(
                config,
                fit=replace(config.fit, steps=config.fit.steps // 2),
                articulate=replace(config.articulate, steps=config.articulate.steps // 2),
                joints=replace(config.joints, steps=config.joints.steps // 2),
                mesh=replace(config.mesh, views=config.mesh.views // 2, image_size=200),
            )
        case "paper":
            return replace(
                config,
                fit=replace(config.fit, steps=30_000, start_gaussians=50_000, max_gaussians=500_000, max_sh_degree=3),
                articulate=replace(config.articulate, steps=25_000, max_gaussians=500_000),
                mesh=replace(config.mesh, views=100, image_size=400, resolution=256),
            )
    raise HingesplatError(f"preset: unknown {name!r}; use fast, standard or paper")


class Curves:
    """What the stages report on their way, kept as ``{stage or "stage state t": {number: [...]}}``."""

    NUMBERS = ("step", "loss", "psnr", "gaussians")

    def __init__(self, path: Path, report: Report) -> None:
        self.path, self.pass_on = path, report
        self.series: dict[str, dict[str, list[float]]] = read_record(path)

    def report(self, *, stage: str, state: int | None = None, **numbers: Any) -> None:
        """Pass on, and take down every step that goes further than the last."""
        self.pass_on(stage=stage, **({} if state is None else {"state": state}), **numbers)
        if not numbers:  # The stage begins.
            self.series = {label: s for label, s in self.series.items() if label.split()[0] != stage}
        elif all(name in numbers for name in self.NUMBERS):
            label = stage if state is None else f"{stage} state {state}"
            series = self.series.setdefault(label, {name: [] for name in self.NUMBERS})
            if not series["step"] or numbers["step"] > series["step"][-1]:
                for name, values in series.items():
                    values.append(round(numbers[name], 5))

    def save(self) -> None:
        write_json(self.path, self.series)


@dataclass(frozen=True)
class Run:
    """What every stage sees: photographs, what to do with them, and the folder that stages talk through."""

    folder: Path
    capture: Capture
    config: ReconstructConfig
    report: Report
    maps: dict[int, list[DepthMap]] = field(default_factory=dict)
    """What stereo found in each state, once it has been read."""

    def __truediv__(self, name: str) -> Path:
        return self.folder / name

    def reporting(self, stage: str, **more: Any) -> Report:
        return partial(self.report, stage=stage, **more)

    @property
    def device(self) -> str:
        """Where Gaussians are optimised: cpu or cuda."""
        return optimising_device(self.config.device)

    @property
    def views(self) -> list[Sequence[View]]:
        """The training photographs of every state."""
        return [state.train for state in self.capture.states]


def reconstruct(
    capture: Capture,
    config: ReconstructConfig | None = None,
    *,
    out: Path | None = None,
    overwrite: bool = False,
    parents: Sequence[Path] = (),
    report: Report = lambda **_: None,
) -> Twin:
    """Photographs of an object in two or more states to a twin of it that moves.

    Args:
        capture: what ``load_capture`` gives.
        config: the defaults if None; see ``preset``.
        out: the run folder, made if absent; a run of the same capture and config goes on after its last
            finished stage. A new temporary folder, named in the log, if None.
        overwrite: start afresh where ``out`` holds another run.
        parents: run folders of the same capture; a new run takes over the first stages of the one whose config
            agrees with its own the longest, times and all.
        report: called with ``stage`` when a stage begins, with ``stage, seconds`` when it ends, and between
            with ``stage, step, steps, loss, psnr, gaussians`` (and ``state`` while fitting).

    Returns:
        The twin; the paths in it are relative to ``out``.

    Raises:
        HingesplatError: ``out`` belongs to another capture or config; the config makes no sense; or
            no rigid parts explain the motion.
    """
    config = config or ReconstructConfig()
    _check(config)
    optimising_device(config.device)
    capture = _capped(capture, config.max_size)
    folder = Path(tempfile.mkdtemp(prefix="hingesplat-")) if out is None else Path(out)
    open_folder(folder, capture, config, overwrite)
    take_over(folder, parents, INHERITED)
    curves = Curves(folder / "curves.json", report)
    run = Run(folder, capture, config, curves.report)
    try:
        with log_file(folder / "log.txt"), _repeatable(run.device):
            log.info("%s to %s", capture.path, folder)
            _run_stages(run, curves)
    finally:
        for leftover in folder.glob("**/*.tmp"):
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink(missing_ok=True)
    return Twin.load(run / "twin.json")


def _run_stages(run: Run, curves: Curves) -> None:
    finished = read_record(run / "stages.json")
    for name, stage in STAGES.items():
        if name in finished:
            log.info("%s: done before", name)
            continue
        run.report(stage=name)
        started = time.perf_counter()
        stage(run)
        seconds = time.perf_counter() - started
        finished[name] = {"seconds": round(seconds, 2), "peak_memory_mb": peak_memory_mb()}
        curves.save()
        write_json(run / "stages.json", finished)
        run.report(stage=name, seconds=seconds)
        log.info("%s: %.1f s", name, seconds)
    _write_summary(run, finished)
    write_report(run.folder)


# The stages, each a function of the run that reads files and writes files.


def _stereo(run: Run) -> None:
    for t, views in enumerate(run.views):
        config = run.config.stereo
        if run.config.depth and all(view.depth is None for view in views):
            raise HingesplatError(f"depth: {run.capture.path}, state {t} has no depth pictures; leave out --depth")
        maps = measured(views, config.image_size) if run.config.depth else stereo(views, config)
        write_tensors(
            run / f"depth_state{t}.safetensors", {str(i): torch.from_numpy(m.depth) for i, m in enumerate(maps)}
        )
        run.report(stage="stereo", state=t, step=t + 1, steps=len(run.views))


def _fit(run: Run) -> None:
    """The states know nothing of each other: cores are better used by several fits than by several threads a fit."""
    paths = {t: run / f"fit_state{t}.safetensors" for t in range(len(run.views))}
    left = [t for t, path in paths.items() if not path.is_file()]
    threads, stopped, one_at_a_time = torch.get_num_threads(), Event(), Lock()
    # Kernels of a GPU are called one after another in any case.
    at_once = max(1, min(threads, len(left))) if run.device == "cpu" else 1

    def fit_state(t: int) -> None:
        torch.set_num_threads(threads // at_once)  # Of this Python thread only.

        def report(**numbers: Any) -> None:
            if stopped.is_set():
                raise InterruptedError("another state's fit has failed")
            with one_at_a_time:  # Who listens need not know of threads.
                run.report(stage="fit", state=t, **numbers)

        config, seed = run.config.fit, run.config.seed
        fit(run.views[t], config, seed=seed, maps=_depth(run, t), device=run.device, report=report).save(paths[t])

    with ThreadPoolExecutor(at_once) as pool:
        fits = [pool.submit(fit_state, t) for t in left]
        try:
            for done in as_completed(fits):
                done.result()
        except BaseException:  # Ctrl-C too: who is still at work stops at the next report.
            stopped.set()
            pool.shutdown(cancel_futures=True)
            raise
    torch.set_num_threads(threads)  # Threads to come follow whoever said so last.


def _segment(run: Run) -> None:
    if run.config.start.labels != "search":
        return _start_without_search(run)
    fitted, seed = [_fitted(run, t) for t in range(len(run.views))], run.config.seed
    parts = None if run.config.parts == "auto" else run.config.parts - 1
    found, other, T_state_0 = segment_states(
        fitted, run.views, run.config.segment, maps=_depths(run), parts=parts, seed=seed
    )
    _check_explained(run, found, other)
    found, T_state_0 = _without_redundant(run, found, T_state_0, (fitted[0], fitted[other]), other)
    if run.config.start.motions == "random":
        T_1_0 = random_motions(T_state_0.shape[1], fitted[0].means.numpy(), run.config.start.spread, seed)
        T_state_0 = initial_transforms(T_1_0, len(fitted))
    # What texture says of a motion, it says of one pair of states.
    settled = [m.by_texture and len(run.views) == 2 and run.config.start.motions == "search" for m in found.motions]
    _write_start(run, found.labels, other, T_state_0, settled)
    motions = [{k: np.asarray(v).tolist() for k, v in asdict(m).items()} for m in found.motions]
    known = {"states": [0, other], "seeds": found.seeds, "unexplained": found.unexplained, "motions": motions}
    write_json(run / "segmentation.json", known)


def _start_without_search(run: Run) -> None:
    """Clusters or no labels at all, and random motions, for as many parts as were asked for."""
    config, parts, last = run.config.start, run.config.parts, len(run.views) - 1
    assert parts != "auto"
    pair = (_fitted(run, 0), _fitted(run, last))
    labels = (np.zeros(len(pair[0]), int), np.zeros(len(pair[1]), int))
    if config.labels == "clusters":
        labels = clusters(pair, parts, config, run.config.seed)
    T_1_0 = random_motions(parts, pair[0].means.numpy(), config.spread, run.config.seed)
    _write_start(run, labels, last, initial_transforms(T_1_0, len(run.views)), [False] * (parts - 1))
    write_json(run / "segmentation.json", {"states": [0, last], "motions": []})


def _without_redundant(
    run: Run, found: Segmentation, T_state_0: np.ndarray, pair: tuple[Gaussians, Gaussians], other: int
) -> tuple[Segmentation, np.ndarray]:
    """A number of parts that was given is an upper bound: what is left over dies, and what is missing is said."""
    wanted = run.config.parts
    if wanted == "auto":
        return found, T_state_0
    labelled = pair[1].with_part(torch.from_numpy(np.asarray(found.labels[1], np.int64)))
    back = posed(labelled, {k: np.linalg.inv(T) for k, T in enumerate(T_state_0[other])})
    both = np.concatenate([back.means.numpy(), pair[0].means.numpy()])
    low, high = np.quantile(both, [0.002, 0.998], axis=0)
    label = np.concatenate([found.labels[1], found.labels[0]])
    slots = run.config.articulate.slots
    label, living = living_slots(both, label, T_state_0[1:], float((high - low).max()), slots)
    if len(living) < wanted:
        log.warning("parts: %d given, but only %d are seen", wanted, len(living))
    if found.unexplained > PLAIN_UNEXPLAINED:
        log.warning("parts: %d given, but %.0f%% of what moved needs more", wanted, 100 * found.unexplained)
    motions = tuple(found.motions[k - 1] for k in living[1:])
    labels = (label[len(pair[1]) :], label[: len(pair[1])])
    return replace(found, labels=labels, motions=motions), T_state_0[:, living]


def _write_start(
    run: Run, labels: tuple[np.ndarray, np.ndarray], other: int, T_state_0: np.ndarray, known: Sequence[bool]
) -> None:
    """Labels of the Gaussians of state 0 and of the state ``other``, and where every part is in each state.

    ``known`` says of every mover whether that needs no alignment.
    """
    found = {f"labels_{s}": torch.from_numpy(np.asarray(labels[s], np.int64)) for s in (0, 1)}
    found |= {"other": torch.tensor(other), "T_state_0": torch.from_numpy(T_state_0)}
    found |= {"known": torch.tensor(known, dtype=torch.bool)}
    write_tensors(run / "segmentation.safetensors", found)


def _align(run: Run) -> None:
    found = load_file(run / "segmentation.safetensors")
    T_state_0, other = found["T_state_0"].numpy(), int(found["other"])
    kept = {f"kept_{s}": torch.ones_like(found[f"labels_{s}"], dtype=torch.bool) for s in (0, 1)}
    if T_state_0.shape[1] > 1 and run.config.start.motions == "search":
        config = run.config.align
        for s, t in enumerate((0, other)):
            labels = found[f"labels_{s}"].numpy()
            kept[f"kept_{s}"] = torch.from_numpy(shown_movers(_fitted(run, t), labels, run.views[t], config.shown))
        pair, labels, _ = _pair(run, found | kept)
        T_state_0 = align(
            pair, labels, other, T_state_0, run.views, config,
            known=found["known"].numpy(), seed=run.config.seed, device=run.device,
        )  # fmt: skip
    write_tensors(run / "alignment.safetensors", {"T_state_0": torch.from_numpy(T_state_0)} | kept)


def _fuse(run: Run) -> None:
    aligned = load_file(run / "alignment.safetensors")
    if aligned["T_state_0"].shape[1] == 1:  # Nothing moved: the first state is all there is.
        canonical = _fitted(run, 0)
    else:
        pair, labels, other = _pair(run, load_file(run / "segmentation.safetensors") | aligned)
        T_1_0 = aligned["T_state_0"][other].numpy()
        canonical = fuse(pair, labels, T_1_0, run.config.fuse, seed=run.config.seed)
    canonical.save(run / "canonical.safetensors")


def _pair(
    run: Run, found: Mapping[str, Tensor]
) -> tuple[tuple[Gaussians, Gaussians], tuple[np.ndarray, np.ndarray], int]:
    """The kept Gaussians of state 0 and of the other state of the search, their labels, and which state that is."""
    other = int(found["other"])
    (first, second), (a, b) = (_fitted(run, 0), _fitted(run, other)), (found["kept_0"], found["kept_1"])
    return (first[a], second[b]), (found["labels_0"][a].numpy(), found["labels_1"][b].numpy()), other


def initial_transforms(T_1_0: np.ndarray, states: int) -> np.ndarray:
    """T_state_0 (states, parts, 4, 4) to start from where no motion is known but that of the last state.

    ``T_1_0`` (parts, 4, 4) are the motions from the first state to the last, the identity for the base. The states
    between are left to the optimisation.
    """
    T_state_0 = np.tile(np.eye(4), (states, len(T_1_0), 1, 1))
    T_state_0[-1] = T_1_0
    return T_state_0


def _articulate(run: Run) -> None:
    canonical = Gaussians.load(run / "canonical.safetensors")
    T_state_0 = load_file(run / "alignment.safetensors")["T_state_0"].numpy()
    moved = Articulation(canonical, T_state_0, torch.zeros(len(T_state_0), len(canonical), 3))
    if T_state_0.shape[1] > 1:
        moved = articulate(
            canonical, T_state_0, run.views, run.config.articulate,
            fitted=[_fitted(run, t) for t in range(len(T_state_0))], maps=_depths(run),
            seed=run.config.seed, device=run.device, report=run.reporting("articulate"),
        )  # fmt: skip
    extra = {"T_state_0": torch.from_numpy(np.asarray(moved.T_state_0)), "state_sh": moved.state_sh}
    write_tensors(run / "articulation.safetensors", vars(moved.gaussians) | extra)


def _joints(run: Run) -> None:
    """Joints, the final Gaussians, and these posed and coloured as they stand in each state."""
    gaussians = Gaussians.load(run / "articulation.safetensors")
    extra = load_file(run / "articulation.safetensors")
    T_state_0, state_sh = extra["T_state_0"].numpy(), extra["state_sh"]
    joints: tuple[Joint, ...] = ()
    if T_state_0.shape[1] > 1:
        config, report = run.config.joints, run.reporting("joints")
        maps, seed = _depths(run), run.config.seed
        found = find_joints(
            gaussians, T_state_0, state_sh, run.views, config, maps=maps, seed=seed, device=run.device, report=report
        )
        gaussians, state_sh, joints = found.gaussians, found.state_sh, found.joints
    gaussians = gaussians.detached()
    ids = [0, *sorted(j.child for j in joints)]
    parts = [Part(i, f"part_{i}" if i else "base", int((gaussians.part == i).sum())) for i in ids]
    twin = Twin(tuple(parts), joints, metres_per_unit=run.capture.metres_per_unit)
    for t in range(len(run.capture.states)):
        there = coloured(posed(gaussians, twin.at_state(t)), state_sh[t]) if joints else _fitted(run, t)
        there.save(run / f"gaussians_state{t}.safetensors")
    gaussians.save(run / "gaussians.safetensors")
    twin.save(run / "twin.json")


def _mesh(run: Run) -> None:
    gaussians, twin = load_result(run.folder)
    states = [([v.camera for v in views], twin.at_state(t)) for t, views in enumerate(run.views)]
    path = [poses for t in range(1, len(states)) for poses in twin.on_the_way(t, run.config.mesh.steps)]
    meshes = mesh_parts(gaussians, states, run.config.mesh, maps=_depths(run), path=path)
    parts = []
    with whole_folder(run / "parts") as folder:
        for part in twin.parts:
            write_ply(gaussians[gaussians.part == part.id], folder / f"{part.name}.ply")
            part = replace(part, splats=f"parts/{part.name}.ply")
            if part.id in meshes:
                meshes[part.id].export(folder / f"{part.name}.glb")
                meshes[part.id].export(folder / f"{part.name}.obj")
                part = replace(part, mesh=f"parts/{part.name}.glb")
            parts.append(part)
    replace(twin, parts=tuple(parts)).save(run / "twin.json")


def _export(run: Run) -> None:
    gaussians, twin = load_result(run.folder)
    export_twin(twin, load_meshes(run.folder, twin), gaussians, run / "export")


def _pictures(run: Run) -> None:
    gaussians, twin = load_result(run.folder)
    poses = [twin.at_state(t) for t in range(len(run.capture.states))]
    best = [telling_view(posed(gaussians, T), views) for T, views in zip(poses, run.views, strict=True)]
    write_summary(run / "summary.png", gaussians, list(zip(best, poses, strict=True)))
    write_motion_gif(run / "motion.gif", gaussians, twin, best[-1].camera)
    _show_views(run)


def _show_views(run: Run) -> None:
    """Photographs for the report: those held back from the reconstruction if every state has some."""
    states = run.capture.states
    held_out = all(state.test for state in states)
    shown = []
    for t, state in enumerate(states):
        views = state.test if held_out else state.train
        gaussians = Gaussians.load(run / f"gaussians_state{t}.safetensors")
        shown.append((spread_views(views, telling_view(gaussians, views), SHOWN_VIEWS), gaussians))
    up = common_up([view.camera for views in run.views for view in views])
    with whole_folder(run / "views") as folder:
        write_views(folder, shown, up, held_out=held_out)


STAGES: dict[str, Callable[[Run], None]] = {
    "stereo": _stereo,
    "fit": _fit,
    "segment": _segment,
    "align": _align,
    "fuse": _fuse,
    "articulate": _articulate,
    "joints": _joints,
    "mesh": _mesh,
    "export": _export,
    "pictures": _pictures,
}
INHERITED: dict[str, tuple[tuple[str, ...], str]] = {
    "stereo": (("photographs", "stereo", "depth", "max_size"), "depth_state*.safetensors"),
    "fit": (("fit", "seed"), "fit_state*.safetensors"),
    "segment": (("segment", "start", "parts", "articulate.slots"), "segmentation.*"),
    "align": (("align",), "alignment.safetensors"),
    "fuse": (("fuse",), "canonical.safetensors"),
    "articulate": (("articulate",), "articulation.safetensors"),
}
"""Stages that one run may take over from another: the options that decide their results beside those of the stages
before, and their files."""


# What the stages lean on.


def _fitted(run: Run, state: int) -> Gaussians:
    return Gaussians.load(run / f"fit_state{state}.safetensors")


def _depth(run: Run, state: int) -> list[DepthMap]:
    if state not in run.maps:
        known, views = load_file(run / f"depth_state{state}.safetensors"), run.views[state]
        run.maps[state] = [depth_map(view, known[str(i)].numpy()) for i, view in enumerate(views)]
    return run.maps[state]


def _depths(run: Run) -> list[list[DepthMap]]:
    """Those of every state."""
    return [_depth(run, t) for t in range(len(run.views))]


def optimising_device(wanted: Literal["auto", "cpu", "cuda"]) -> str:
    """``cpu`` or ``cuda``; see ``ReconstructConfig.device``.

    Raises:
        HingesplatError: CUDA is wanted and there is none, or gsplat is not installed.
    """
    if wanted == "cpu":
        return wanted
    lacking = cuda_lacks()
    if lacking and wanted == "cuda":
        raise HingesplatError(f"device: cuda is wanted, but {lacking}")
    return "cpu" if lacking else "cuda"


def _check(config: ReconstructConfig) -> None:
    if config.parts != "auto" and config.parts < 2:
        raise HingesplatError(f"parts: must be auto, or at least 2 (the base and a mover), not {config.parts}")
    if config.seed < 0:
        raise HingesplatError(f"seed: must be at least 0, not {config.seed}")
    if config.max_size is not None and config.max_size < 1:
        raise HingesplatError(f"max_size: must be at least 1 pixel, not {config.max_size}")
    if config.start.labels != "search" and config.parts == "auto":
        raise HingesplatError(f"parts: method {config.method} does not find it; give --parts N, the base included")
    if config.start.labels != "search" and config.start.motions == "search":
        raise HingesplatError(f"start.motions: {config.start.labels} labels come without; give random")


def _check_explained(run: Run, found: Segmentation, last: int) -> None:
    """Nothing moved is a result; something moved but not rigidly is none."""
    if not found.motions and found.seeds < NOISE * run.config.segment.min_part_seeds:
        log.warning("no motion found between state 0 and state %d: the twin will be static", last)
    elif not found.motions or found.unexplained > MAX_UNEXPLAINED:
        share = found.unexplained if found.motions else 1.0
        raise HingesplatError(
            f"{run.capture.path}: no rigid parts explain {share:.0%} of what moved between state 0 and "
            f"state {last}; check that the poses of both states share one frame, that the masks hold the "
            "object only, and that its parts are rigid"
        )


def coloured(gaussians: Gaussians, offset: Tensor) -> Gaussians:
    """A state's own colours: ``offset`` (n, 3) added to the constant spherical harmonic."""
    sh = gaussians.sh.clone()
    sh[:, 0] += offset
    return replace(gaussians, sh=sh).detached()


def telling_view(gaussians: Gaussians, views: Sequence[View]) -> View:
    """The photograph in which the movable parts cover most pixels; the first one if nothing moves."""
    return max(views, key=lambda view: movable_share(gaussians, view.camera))


def _capped(capture: Capture, max_size: int | None) -> Capture:
    """The capture with its photographs at most ``max_size`` pixels long."""
    if max_size is None:
        return capture

    def cap(views: Sequence[View]) -> tuple[View, ...]:
        return tuple(downsampled(v, max_size) for v in views)

    states = (replace(s, train=cap(s.train), test=cap(s.test)) for s in capture.states)
    return replace(capture, states=tuple(states))


def _write_summary(run: Run, finished: dict[str, Any]) -> None:
    seconds = {name: entry["seconds"] for name, entry in finished.items()}
    peaks = [entry["peak_memory_mb"] for entry in finished.values()]
    summary = {
        "seconds": seconds | {"total": round(sum(seconds.values()), 2)},
        "peak_memory_mb": max((p for p in peaks if p is not None), default=None),
        "given": {"parts": run.config.parts != "auto", "types": False, "depth": run.config.depth},
        "preset": run.config.preset,
        "method": run.config.method,
        "seed": run.config.seed,
        "device": run.device,
        "backend": "gsplat" if run.device == "cuda" else "numba",
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads",
        "versions": versions(),
    }
    write_json(run / "summary.json", summary)


def peak_memory_mb() -> float | None:
    """Most memory this process ever held, MB; None where the system does not tell."""
    try:
        import resource
    except ImportError:  # Windows.
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)


@contextmanager
def _repeatable(device: str) -> Iterator[None]:
    """Torch's threads add up gradients of indexed tensors in one order: the same seed gives the same joints.

    On the CPU; gsplat's kernels add as they come.
    """
    before = torch.get_deterministic_debug_mode()
    # Not use_deterministic_algorithms: that imports torch's compiler, for over a second.
    torch.set_deterministic_debug_mode("error" if device == "cpu" else "default")
    try:
        yield
    finally:
        torch.set_deterministic_debug_mode(before)
