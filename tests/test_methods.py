"""Methods of the literature as settings; what is given is an upper bound; runs that share their first stages."""

import json
import logging
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from hingesplat import cli, pipeline, run_folder
from hingesplat.capture import Capture
from hingesplat.capture.types import State
from hingesplat.errors import HingesplatError
from hingesplat.gaussians import Gaussians, concatenate, posed
from hingesplat.methods import configure
from hingesplat.pipeline import ReconstructConfig, Run, preset, reconstruct
from hingesplat.screw import prismatic
from hingesplat.search import Motion
from hingesplat.segment import Segmentation
from hingesplat.start import StartConfig
from scenes import Scene, box, one_thread, scene, transforms_of  # noqa: F401

UP = Motion("prismatic", np.array([0.0, 0, 1]), np.zeros(3), 0.4, 0.9)
MADE = scene("prismatic", 48, 0.08)


def capture_of(made: Scene) -> Capture:
    return Capture(Path("made"), "transforms", tuple(State(f"state_{t}", v, ()) for t, v in enumerate(made.views)))


CAPTURE = capture_of(MADE)


def test_ours_is_the_preset() -> None:
    assert configure("hingesplat") == ReconstructConfig()
    assert configure("hingesplat", "fast") == preset("fast")
    with pytest.raises(HingesplatError, match="part2gs"):
        configure("dta")  # pyright: ignore[reportArgumentType]


def test_methods_differ_from_ours_in_what_papers_claim() -> None:
    ours = ReconstructConfig()
    for name in ("part2gs", "artgs", "vanilla"):
        theirs = configure(name)
        for same in ("stereo", "fit", "mesh", "segment", "seed", "parts"):
            assert getattr(theirs, same) == getattr(ours, same)
        assert theirs.method == name and theirs.start.labels != "search" and theirs.joints.steps == 0
    part2gs, artgs, vanilla = (configure(n).articulate for n in ("part2gs", "artgs", "vanilla"))
    assert (part2gs.physics.art, part2gs.physics.contact, part2gs.identity.weight) == (1.0, 0.5, 0.1)
    assert part2gs.repel.points == 2000 and artgs.repel.points == vanilla.repel.points == 0
    assert artgs.physics.contact == artgs.physics.velocity == artgs.physics.vector == 0
    assert [c.identity.kind for c in (part2gs, artgs, vanilla)] == ["embedding", "centres", "none"]
    assert configure("part2gs", "paper").articulate.pose_rate == 1e-3


def test_a_method_is_an_option_and_its_switches_can_be_changed() -> None:
    args = ["reconstruct", "photos", "--out", "twin", "--method", "part2gs", "--preset", "fast", "--parts", "3"]
    command = cli.parse([*args, "--articulate.repel.points", "500"])
    assert isinstance(command, cli.Reconstruct)
    told = configure("part2gs", "fast")
    articulate = replace(told.articulate, repel=replace(told.articulate.repel, points=500))
    assert command.config == replace(told, parts=3, articulate=articulate)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (configure("artgs"), "method artgs .* --parts N"),
        (replace(ReconstructConfig(), parts=3, start=StartConfig(labels="random")), r"start\.motions"),
    ],
)
def test_what_is_missing_is_said(config: ReconstructConfig, words: str, tmp_path: Path) -> None:
    with pytest.raises(HingesplatError, match=words):
        reconstruct(CAPTURE, config, out=tmp_path / "run")


def two_parts() -> tuple[Gaussians, Gaussians, np.ndarray]:
    """A base and a box that goes up, in two states, and the true labels."""
    parts = [box((x, 0, 0), (x + 0.4, 0.4, 0.4), 0.025, seed=k, part=k) for k, x in ((0, 0.0), (1, 0.5))]
    first = concatenate(parts)
    second = posed(first, transforms_of(np.stack([np.eye(4), UP.T])))
    return first, second, first.part.numpy()


def found_with(parts, motions: tuple[Motion, ...], labels: np.ndarray, unexplained: float, caplog) -> Segmentation:
    first, second, _ = two_parts()
    run = Run(Path(), CAPTURE, replace(ReconstructConfig(), parts=parts), lambda **_: None)
    found = Segmentation((labels, labels), motions, unexplained, 500)
    with caplog.at_level(logging.WARNING, "hingesplat"):
        T_state_0 = np.stack([np.tile(np.eye(4), (1 + len(motions), 1, 1)), [np.eye(4), *(m.T for m in motions)]])
        found, T_state_0 = pipeline._without_redundant(run, found, T_state_0, (first, second), 1)
    assert T_state_0.shape[1] == 1 + len(found.motions)
    return found


def test_the_right_number_of_parts_is_taken_as_it_is(caplog) -> None:
    true = two_parts()[2]
    found = found_with(2, (UP,), true, 0.05, caplog)
    assert found.motions == (UP,) and not caplog.text
    np.testing.assert_array_equal(found.labels[0], true)
    np.testing.assert_array_equal(found.labels[1], true)


def test_redundant_parts_die_and_it_is_said(caplog) -> None:
    true = two_parts()[2]
    halves = np.where((true == 1) & (np.arange(len(true)) % 2 == 0), 2, true)
    found = found_with(4, (UP, replace(UP, value=0.402), replace(UP, value=0.2)), halves, 0.05, caplog)
    assert found.motions == (UP,) and "4 given, but only 2" in caplog.text
    np.testing.assert_array_equal(found.labels[0], true)


def test_too_few_parts_are_warned_of(caplog) -> None:
    true = two_parts()[2]
    found_with(2, (UP,), true, 0.35, caplog)
    assert "2 given" in caplog.text and "35%" in caplog.text


def test_parts_found_by_themselves_are_left_alone(caplog) -> None:
    true = two_parts()[2]
    labels = np.where((true == 1) & (np.arange(len(true)) % 2 == 0), 2, true)
    found = found_with("auto", (UP, UP), labels, 0.9, caplog)
    assert found.motions == (UP, UP) and not caplog.text


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """A run that has come to its segmentation."""
    MADE.gaussians.save(tmp_path / "fit_state0.safetensors")
    MADE.at(1).save(tmp_path / "fit_state1.safetensors")
    for t, state in enumerate(CAPTURE.states):  # Nothing is known of depth.
        unknown = {str(i): torch.zeros(view.rgba.shape[:2]) for i, view in enumerate(state.train)}
        run_folder.write_tensors(tmp_path / f"depth_state{t}.safetensors", unknown)
    return Run(tmp_path, CAPTURE, ReconstructConfig(), lambda **_: None)


@pytest.mark.parametrize("method", ["part2gs", "artgs", "vanilla"])
def test_methods_come_from_fits_to_motions(method, run: Run) -> None:
    config = replace(configure(method), parts=3)
    articulate = replace(config.articulate, steps=12, densify_every=5)
    run = replace(run, config=replace(config, articulate=articulate, fuse=replace(config.fuse, matched=400)))
    pipeline._segment(run)
    start = load_file(run / "segmentation.safetensors")
    assert start["T_state_0"].shape == (2, 3, 4, 4)
    assert bool(start["labels_0"].any()) == (method == "artgs")
    pipeline._align(run)
    pipeline._fuse(run)
    pipeline._articulate(run)
    moved = load_file(run / "articulation.safetensors")
    T, part = moved["T_state_0"].numpy(), moved["part"]
    assert part.unique().tolist() == list(range(T.shape[1])) and 1 <= T.shape[1] <= 3
    np.testing.assert_allclose(T[0], np.broadcast_to(np.eye(4), T[0].shape), atol=1e-6)
    assert np.isfinite(T).all()


def test_displacements_without_parts_find_a_slide_that_is_plain(run: Run) -> None:
    """A short way: the matches are right."""
    near = posed(MADE.gaussians, {1: prismatic([0, -1, 0], 0.03)})
    near.save(run / "fit_state1.safetensors")
    config = replace(configure("vanilla"), parts=2)
    articulate = replace(config.articulate, steps=1)
    run = replace(run, config=replace(config, articulate=articulate))
    for stage in (pipeline._segment, pipeline._align, pipeline._fuse, pipeline._articulate):
        stage(run)
    T = load_file(run / "articulation.safetensors")["T_state_0"].numpy()
    np.testing.assert_allclose(T[1, 1, :3, 3], [0, -0.03, 0], atol=0.01)


def test_random_motions_can_be_set_on_labels_that_were_found(run: Run, monkeypatch) -> None:
    labels = MADE.gaussians.part.numpy()
    found = Segmentation((labels, labels.copy()), (UP,), 0.0, 500), 1, np.stack([[np.eye(4)] * 2, [np.eye(4), UP.T]])
    monkeypatch.setattr(pipeline, "segment_states", lambda *_, **__: found)
    monkeypatch.setattr(pipeline, "_depth", lambda *_: [])
    run = replace(run, config=replace(ReconstructConfig(), start=StartConfig(motions="random")))
    pipeline._segment(run)
    start = load_file(run / "segmentation.safetensors")
    np.testing.assert_array_equal(start["labels_0"], labels)
    assert np.abs(start["T_state_0"][1, 1].numpy() - UP.T).max() > 0


class Stages:
    """Toy stages with the real ones' names that count how often they ran."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def stage(self, name: str):
        def run(run: Run) -> None:
            self.calls.append(name)
            for file in {"fit": ["fit_state0.safetensors"], "fuse": ["canonical.safetensors"]}.get(name, []):
                MADE.gaussians.save(run / file)
            if name == "joints":
                MADE.gaussians.save(run / "gaussians.safetensors")
                pipeline.Twin((pipeline.Part(0, "base", 1),), ()).save(run / "twin.json")

        return run


@pytest.fixture
def stages(monkeypatch) -> Stages:
    toy = Stages()
    monkeypatch.setattr(pipeline, "STAGES", {n: toy.stage(n) for n in ("stereo", "fit", "segment", "fuse", "joints")})
    return toy


def test_a_run_takes_over_the_first_stages_of_one_that_agrees(stages: Stages, tmp_path: Path) -> None:
    base = ReconstructConfig()
    fuse = replace(base, fuse=replace(base.fuse, strategy="none"))
    reconstruct(CAPTURE, base, out=tmp_path / "a")
    reconstruct(CAPTURE, replace(base, seed=1), out=tmp_path / "b", parents=[tmp_path / "a"])
    assert stages.calls[5:] == ["fit", "segment", "fuse", "joints"]
    stages.calls.clear()
    reconstruct(CAPTURE, fuse, out=tmp_path / "c", parents=[tmp_path / "b", tmp_path / "a", tmp_path / "none"])
    assert stages.calls == ["fuse", "joints"]
    seconds = [json.loads((tmp_path / n / "summary.json").read_text())["seconds"] for n in "ac"]
    assert seconds[0]["fit"] == seconds[1]["fit"]
    assert (tmp_path / "c" / "fit_state0.safetensors").is_file()


def test_other_photographs_share_nothing(stages: Stages, tmp_path: Path) -> None:
    reconstruct(CAPTURE, out=tmp_path / "a")
    capture = capture_of(scene("revolute", 48, 0.08))
    stages.calls.clear()
    reconstruct(capture, out=tmp_path / "b", parents=[tmp_path / "a"])
    assert stages.calls == ["stereo", "fit", "segment", "fuse", "joints"]


def test_every_inherited_option_is_one() -> None:
    known = run_folder.flat(asdict(ReconstructConfig())) | {"photographs": ""}
    for options, _ in pipeline.INHERITED.values():
        for option in options:
            assert any(k == option or k.startswith(f"{option}.") for k in known), option
