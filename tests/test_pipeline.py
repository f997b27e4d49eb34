"""The order of the stages, the run folder, and one small object from photographs to twin."""

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hingesplat import pipeline
from hingesplat.capture import Capture, load_capture
from hingesplat.errors import HingesplatError
from hingesplat.gaussians import Gaussians
from hingesplat.metrics import evaluate
from hingesplat.pipeline import ReconstructConfig, Run, initial_transforms, preset, reconstruct
from hingesplat.search import Motion
from hingesplat.segment import Segmentation
from hingesplat.stereo import StereoConfig
from hingesplat.synth import make
from hingesplat.twin import Part, Twin


@pytest.fixture(scope="module")
def cabinet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "cabinet"
    return make("cabinet", out, size=128, train_views=30, test_views=3, below=0.125)


@pytest.fixture(scope="module")
def capture(cabinet: Path) -> Capture:
    return load_capture(cabinet)


def gaussians(n: int = 5, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn((n, 3), generator=g),
        quats=torch.randn((n, 4), generator=g),
        log_scales=torch.full((n, 3), -3.0),
        logit_opacities=torch.zeros(n),
        sh=torch.zeros((n, 1, 3)),
        part=torch.zeros(n, dtype=torch.int64),
    )


class Toy:
    """Three stages that count how often they ran; the second one may fail."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.error: BaseException | None = None

    def first(self, run: Run) -> None:
        self.calls.append("first")
        gaussians().save(run / "gaussians.safetensors")

    def second(self, run: Run) -> None:
        self.calls.append("second")
        (run / "half.json.tmp").write_text("{")
        (run / "parts.tmp").mkdir()
        if self.error:
            raise self.error

    def third(self, run: Run) -> None:
        self.calls.append("third")
        Twin((Part(0, "base", len(Gaussians.load(run / "gaussians.safetensors"))),), ()).save(run / "twin.json")


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Toy:
    toy = Toy()
    stages = {"first": toy.first, "second": toy.second, "third": toy.third}
    monkeypatch.setattr(pipeline, "STAGES", stages)
    return toy


def test_a_stopped_run_goes_on_after_its_last_finished_stage(toy: Toy, capture: Capture, tmp_path: Path) -> None:
    toy.error = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        reconstruct(capture, out=tmp_path / "run")
    assert list(json.loads((tmp_path / "run" / "stages.json").read_text())) == ["first"]
    assert not list((tmp_path / "run").glob("*.tmp"))  # Nothing half-written stays.

    toy.error = None
    twin = reconstruct(capture, out=tmp_path / "run")
    assert toy.calls == ["first", "second", "second", "third"]
    assert twin.parts[0].gaussians == 5
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert set(summary["seconds"]) == {"first", "second", "third", "total"}
    assert summary["given"] == {"parts": False, "types": False, "depth": False}
    assert summary["peak_memory_mb"] > 0

    reconstruct(capture, out=tmp_path / "run")
    assert len(toy.calls) == 4


def test_stages_report_their_beginning_and_end(toy: Toy, capture: Capture, tmp_path: Path) -> None:
    heard: list[dict] = []
    reconstruct(capture, out=tmp_path / "run", report=lambda **k: heard.append(k))
    assert [h["stage"] for h in heard] == ["first", "first", "second", "second", "third", "third"]
    assert all(h["seconds"] >= 0 for h in heard[1::2])


def test_a_run_is_bound_to_its_capture_and_config(toy: Toy, capture: Capture, tmp_path: Path) -> None:
    out = tmp_path / "run"
    reconstruct(capture, out=out)
    with pytest.raises(HingesplatError, match=r"belongs to another capture \(.*cabinet\)"):
        reconstruct(replace(capture, path=tmp_path / "elsewhere"), out=out)
    config = replace(ReconstructConfig(), seed=3)
    with pytest.raises(HingesplatError, match=r"another config \(seed was 0, is 3\).*--overwrite"):
        reconstruct(capture, config, out=out)
    nested = replace(config, fit=replace(config.fit, steps=7))
    with pytest.raises(HingesplatError, match=r"fit\.steps was \d+, is 7"):
        reconstruct(capture, replace(nested, seed=0), out=out)

    state = capture.states[0]
    view = replace(state.train[0], rgba=255 - state.train[0].rgba)
    changed = replace(capture, states=(replace(state, train=(view, *state.train[1:])), *capture.states[1:]))
    with pytest.raises(HingesplatError, match=r"photographs .* have changed"):
        reconstruct(changed, out=out)
    assert toy.calls == ["first", "second", "third"]

    (out / "notes.txt").write_text("mine")
    for name in ("metrics.json", "depth_state0.safetensors"):
        (out / name).write_text("{}")
    reconstruct(capture, config, out=out, overwrite=True)
    assert len(toy.calls) == 6
    assert json.loads((out / "config.json").read_text())["seed"] == 3
    assert (out / "notes.txt").is_file() and not (out / "metrics.json").exists()
    assert not (out / "depth_state0.safetensors").exists()


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_that_is_no_run_is_left_alone(toy: Toy, capture: Capture, tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(HingesplatError, match="holds no run"):
        reconstruct(capture, out=tmp_path, overwrite=overwrite)
    (tmp_path / "config.json").write_text('{"model": "of another program"}')
    with pytest.raises(HingesplatError, match="not that of a run"):
        reconstruct(capture, out=tmp_path, overwrite=overwrite)
    assert {p.name for p in tmp_path.iterdir()} == {"precious.txt", "config.json"}
    assert toy.calls == []


def test_stages_add_up_in_one_order(toy: Toy, capture: Capture, monkeypatch, tmp_path: Path) -> None:
    """On two threads, the gradient of an indexed tensor is else another one each time."""
    sums = []

    def stage(run: Run) -> None:
        generator = torch.Generator().manual_seed(0)
        points = torch.randn((8000, 3), generator=generator)
        part = torch.randint(0, 3, (8000,), generator=generator)
        for _ in range(20):
            R = torch.eye(3).repeat(3, 1, 1).requires_grad_()
            ((R[part] @ points[..., None])[..., 0] * points.sin()).sum().backward()
            sums.append(R.grad)

    monkeypatch.setitem(pipeline.STAGES, "second", stage)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    reconstruct(capture, out=tmp_path / "run")
    torch.set_num_threads(threads)
    assert all(torch.equal(s, sums[0]) for s in sums)
    assert not torch.are_deterministic_algorithms_enabled()


def test_max_size_caps_the_photographs(toy: Toy, capture: Capture, monkeypatch, tmp_path: Path) -> None:
    seen = []
    monkeypatch.setitem(pipeline.STAGES, "second", lambda run: seen.extend(v.camera.width for v in run.views[0]))
    reconstruct(capture, replace(ReconstructConfig(), max_size=40), out=tmp_path / "run")
    assert set(seen) == {40}


@pytest.mark.parametrize("bad", [{"parts": 1}, {"max_size": 0}])
def test_config_that_makes_no_sense(toy: Toy, capture: Capture, tmp_path: Path, bad: dict) -> None:
    with pytest.raises(HingesplatError, match=next(iter(bad))):
        reconstruct(capture, replace(ReconstructConfig(), **bad), out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_presets_differ_in_size_only() -> None:
    fast, standard, paper = preset("fast"), preset("standard"), preset("paper")
    assert standard == ReconstructConfig()
    assert fast.fit.steps < standard.fit.steps < paper.fit.steps == 30_000
    assert paper.articulate.steps == 25_000
    assert fast.segment == standard.segment == paper.segment
    with pytest.raises(HingesplatError, match="preset"):
        preset("quick")  # pyright: ignore[reportArgumentType]


def test_initial_transforms_move_the_last_state_only() -> None:
    T = np.stack([np.eye(4), np.eye(4)])
    T[1, :3, 3] = 1, 2, 3
    T_state_0 = initial_transforms(T, 3)
    assert T_state_0.shape == (3, 2, 4, 4)
    np.testing.assert_array_equal(T_state_0[-1], T)
    np.testing.assert_array_equal(T_state_0[:2], np.broadcast_to(np.eye(4), (2, 2, 4, 4)))


MOTION = Motion("prismatic", np.array([0.0, 0, 1]), np.zeros(3), 0.1, 0.9)


@pytest.mark.parametrize(
    ("motions", "unexplained", "seeds", "outcome"),
    [
        ((), 0.0, 10, "static"),
        ((), 1.0, 167, "static"),
        ((), 0.0, 400, "100%"),
        ((MOTION,), 0.9, 400, "90%"),
        ((MOTION,), 0.3, 400, "moves"),
        ((MOTION,), 0.1, 10, "moves"),
    ],
)
def test_motion_that_is_none_or_not_rigid(capture, tmp_path, caplog, motions, unexplained, seeds, outcome) -> None:
    run = Run(tmp_path, capture, ReconstructConfig(), lambda **_: None)
    nothing = np.zeros(0, int)
    found = Segmentation((nothing, nothing), motions, unexplained, seeds)
    if outcome.endswith("%"):
        with pytest.raises(HingesplatError, match=f"no rigid parts explain {outcome}"):
            pipeline._check_explained(run, found, 1)
        return
    with caplog.at_level(logging.WARNING, "hingesplat"):
        pipeline._check_explained(run, found, 1)
    assert ("no motion found between state 0 and state 1" in caplog.text) == (outcome == "static")


def test_depth_is_found_by_stereo_or_taken_as_measured(cabinet: Path, tmp_path: Path) -> None:
    deep = load_capture(cabinet, with_depth=True)
    small = StereoConfig(image_size=64, planes=64)
    maps = {}
    for depth in (False, True):
        (tmp_path / str(depth)).mkdir()
        run = Run(tmp_path / str(depth), deep, ReconstructConfig(depth=depth, stereo=small), lambda **_: None)
        pipeline._stereo(run)
        maps[depth] = pipeline._depth(run, 1)
    assert len(maps[False]) == len(maps[True]) == len(deep.states[1].train)
    assert {m.depth.shape for m in maps[False] + maps[True]} == {(64, 64)}
    found, known = (np.stack([m.depth for m in maps[depth]]) for depth in (False, True))
    on_object = np.stack([v.rgba[..., 3] for v in deep.states[1].train])[:, ::2, ::2] > 128
    assert (known > 0)[on_object].mean() > 0.9 and (found > 0)[on_object].mean() > 0.3
    both = (found > 0) & (known > 0)
    assert np.median(np.abs(found - known)[both]) < 0.02
    for view in deep.states[1].train[:3]:
        points = maps[True][7].points()[0]
        uv, z = view.camera.project(points)
        u, v = np.floor(uv).astype(int).T
        assert view.depth is not None
        there = view.depth[v.clip(0, 127), u.clip(0, 127)]
        assert np.mean(z > there - 0.05) > 0.9  # On the surface or behind it, not in front.


def test_a_capture_without_depth_pictures_has_none_to_measure(capture: Capture, tmp_path: Path) -> None:
    run = Run(tmp_path, capture, ReconstructConfig(depth=True), lambda **_: None)
    with pytest.raises(HingesplatError, match="state 0 has no depth pictures"):
        pipeline._stereo(run)


def small_config() -> ReconstructConfig:
    config = ReconstructConfig()
    return replace(
        config,
        stereo=replace(config.stereo, planes=64),
        fit=replace(config.fit, steps=600, start_gaussians=2500, max_gaussians=4500),
        articulate=replace(config.articulate, steps=1000),
        joints=replace(config.joints, steps=150, uncertainty_views=4),
        mesh=replace(config.mesh, views=12, image_size=96, resolution=48),
    )


def test_identical_states_give_a_static_twin(cabinet: Path, tmp_path: Path) -> None:
    for state in ("state_0", "state_1"):
        shutil.copytree(cabinet / "state_0", tmp_path / "still" / state)
    capture = load_capture(tmp_path / "still")
    config = replace(small_config(), fit=replace(small_config().fit, steps=200))
    twin = reconstruct(capture, config, out=tmp_path / "run")
    assert [part.name for part in twin.parts] == ["base"] and twin.joints == ()
    curves = json.loads((tmp_path / "run" / "curves.json").read_text())
    assert sorted(curves) == ["fit state 0", "fit state 1"] and curves["fit state 1"]["step"][-1] == 200
    assert "no motion found between state 0 and state 1" in (tmp_path / "run" / "log.txt").read_text()
    for name in (
        *("parts/base.ply", "parts/base.glb", "parts/base.obj", "export/urdf/twin.urdf", "export/mjcf/twin.xml"),
        *("gaussians_state0.safetensors", "gaussians_state1.safetensors", "motion.gif", "summary.png"),
        *("report.html", "views/views.json"),
    ):
        assert (tmp_path / "run" / name).stat().st_size > 0, name


def test_a_door_and_a_drawer_from_photographs_alone(cabinet: Path, capture: Capture, tmp_path: Path) -> None:
    """Neither the number of parts nor the types of joints are told. The bounds are loose: 128 pixels."""
    run = tmp_path / "run"
    twin = reconstruct(capture, small_config(), out=run)
    assert sorted(j.type for j in twin.joints) == ["prismatic", "revolute"]
    config = json.loads((run / "config.json").read_text())
    assert config["capture"] == str(cabinet) and config["fit"]["steps"] == 600
    metrics = evaluate(run, cabinet)
    assert metrics["parts_found"] == metrics["parts_true"] == 3
    for joint in metrics["joints"]:
        assert joint["type_found"] == joint["type_true"]
        assert joint["axis_deg"] < 2
        assert (joint["motion_deg"] or 0) < 2 and (joint["motion_units"] or 0) < 0.02
    assert metrics["views"]["psnr"] > 24
    again = Twin.load(run / "twin.json")
    assert again == twin


def test_curves_go_on_where_a_run_goes_on(tmp_path: Path) -> None:
    heard: list[dict] = []
    curves = pipeline.Curves(tmp_path / "curves.json", lambda **k: heard.append(k))

    def step(n: int) -> dict:
        return {"stage": "fit", "state": 0, "step": n, "steps": 9, "loss": 1.0 / n, "psnr": 3.0 * n, "gaussians": 7}

    events = [{"stage": "fit"}, step(1), step(5), step(9), step(2), {"stage": "fit", "seconds": 1.5}]
    for event in events:
        curves.report(**event)
    assert len(heard) == 6 and heard[1] == step(1) and heard[-1] == {"stage": "fit", "seconds": 1.5}
    curves.save()
    again = pipeline.Curves(tmp_path / "curves.json", lambda **_: None)
    assert again.series["fit state 0"]["step"] == [1, 5, 9]  # Step 2 belongs to a trial after the fit.
    again.report(stage="joints")
    assert again.series == curves.series
    again.report(stage="fit")
    assert again.series == {}
