"""Metrics: made cases whose figures are known exactly."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from hingesplat.capture import load_capture
from hingesplat.errors import HingesplatError
from hingesplat.gaussians import Gaussians
from hingesplat.metrics import evaluate, load_truth
from hingesplat.metrics.evaluate import FoundPart, match_parts
from hingesplat.metrics.motion import axis_angle_deg, joint_errors, rotation_angle_deg
from hingesplat.metrics.surface import chamfer, clean, inside, match, overlap, penetration, sample
from hingesplat.metrics.truth import Truth, TruthJoint
from hingesplat.screw import revolute
from hingesplat.synth import make
from hingesplat.twin import Joint, Part, Twin


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("metrics") / "cabinet"
    return make("cabinet", out, seed=1, size=96, train_views=3, test_views=2)


def perfect_twin(truth: Truth) -> Twin:
    """The truth itself, said as a twin."""
    joints = []
    for j in truth.joints:
        states = (0.0, j.motion)
        limits = (min(states), max(states))
        joints.append(Joint(j.child, j.parent, j.type, tuple(j.axis), tuple(j.pivot), states, limits))
    parts = tuple(Part(i, p.name, 0, f"parts/{p.name}.obj") for i, p in enumerate(truth.parts))
    return Twin(parts, tuple(joints))


def write_run(run: Path, truth: Truth, twin: Twin) -> Path:
    (run / "parts").mkdir(parents=True)
    for part in truth.parts:
        part.meshes[0].export(run / "parts" / f"{part.name}.obj")
    twin.save(run / "twin.json")
    return run


def surface_gaussians(truth: Truth, count: int = 6000) -> Gaussians:
    """Small opaque balls on the true surfaces of state 0."""
    rng = np.random.default_rng(0)
    points = [sample([p.meshes[0]], count, rng) for p in truth.parts]
    n = count * len(points)
    return Gaussians(
        means=torch.tensor(np.concatenate(points), dtype=torch.float32),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        log_scales=torch.full((n, 3), float(np.log(0.008))),
        logit_opacities=torch.full((n,), 4.0),
        sh=torch.zeros(n, 1, 3),
        part=torch.arange(len(points)).repeat_interleave(count),
    )


def change(twin: Twin, index: int, edit: Callable[[Joint], dict]) -> Twin:
    joints = [Joint(**(vars(j) | edit(j))) if i == index else j for i, j in enumerate(twin.joints)]
    return Twin(twin.parts, tuple(joints))


# Joints.


def test_axis_angle_knows_no_sense_and_is_exact_for_small_angles() -> None:
    a = np.array([0, 0, 1.0])
    assert axis_angle_deg(a, -a) == 0
    tilted = revolute([1, 0, 0], [0, 0, 0], np.radians(1e-4))[:3, :3] @ a
    assert axis_angle_deg(a, tilted) == pytest.approx(1e-4, rel=1e-6)
    assert rotation_angle_deg(revolute([1, 2, 3], [0, 0, 0], np.pi)[:3, :3]) == pytest.approx(180)


def test_revolute_errors() -> None:
    truth = TruthJoint(1, 0, "revolute", np.array([0, 0, 1.0]), np.zeros(3), 0.5)
    far = Joint(1, 0, "revolute", (0, 0, 1), (0.02, 0, 7), (0, 0.6), (0, 1))
    errors = joint_errors(truth, far, far.transform(0.6), np.ones(3))
    assert errors == {
        "axis_deg": 0,
        "position_x10": pytest.approx(0.2),
        "pivot": pytest.approx(0.02),
        "motion_deg": pytest.approx(np.degrees(0.1)),
        "motion_units": None,
    }
    backward = Joint(1, 0, "revolute", (0, 0, -1), (0, 0, 0), (0, 0.5), (0, 1))
    assert joint_errors(truth, backward, backward.transform(0.5), np.ones(3))["motion_deg"] == pytest.approx(
        np.degrees(1.0)
    )
    same = Joint(1, 0, "revolute", (0, 0, -1), (0, 0, 0), (0, -0.5), (-1, 0))
    assert joint_errors(truth, same, same.transform(-0.5), np.ones(3))["motion_deg"] == pytest.approx(0, abs=1e-9)


def test_crossing_axes_have_no_line_distance_but_a_pivot_distance() -> None:
    truth = TruthJoint(1, 0, "revolute", np.array([0, 0, 1.0]), np.zeros(3), 0.5)
    tilted = Joint(1, 0, "revolute", (np.sin(0.1), 0, np.cos(0.1)), (0.3, 0, 3), (0, 0.5), (0, 1))
    crossing = Joint(**(vars(tilted) | {"pivot": (0, 0, -2.0)}))
    errors = joint_errors(truth, crossing, crossing.transform(0.5), np.ones(3))
    assert errors["position_x10"] == pytest.approx(0, abs=1e-9)
    assert errors["pivot"] == pytest.approx(2 * np.sin(0.1))


def test_prismatic_errors_and_wrong_type() -> None:
    truth = TruthJoint(1, 0, "prismatic", np.array([0, -1.0, 0]), np.zeros(3), 0.2)
    short = Joint(1, 0, "prismatic", (0, 1, 0), (9, 9, 9), (0, -0.17), (0, 0))
    errors = joint_errors(truth, short, short.transform(-0.17), np.ones(3))
    assert errors["motion_units"] == pytest.approx(0.03)
    assert errors["axis_deg"] == 0 and errors["motion_deg"] is None
    assert errors["position_x10"] is None and errors["pivot"] is None
    # A turn that carries the part's middle to the right place has no error in translation.
    turn = Joint(1, 0, "revolute", (0, 0, 1), (1, 0, 0), (0, np.pi), (0, 4))
    errors = joint_errors(truth, turn, turn.transform(np.pi), np.array([1.0, 0.1, 0]))
    assert errors["motion_units"] == pytest.approx(0, abs=1e-9) and errors["axis_deg"] == pytest.approx(90)


@pytest.mark.parametrize("found", [None, Joint(1, 0, "fixed", (0, 0, 1), (0, 0, 0), (0, 0), (0, 0))])
def test_undetected_joint_counts_90_degrees(found: Joint | None) -> None:
    turn = TruthJoint(1, 0, "revolute", np.array([0, 0, 1.0]), np.zeros(3), 0.5)
    errors = joint_errors(turn, found, np.eye(4), np.ones(3))
    assert (errors["axis_deg"], errors["motion_deg"], errors["position_x10"]) == (90, 90, None)
    slide = TruthJoint(1, 0, "prismatic", np.array([0, 0, 1.0]), np.zeros(3), -0.2)
    errors = joint_errors(slide, found, np.eye(4), np.ones(3))
    assert (errors["axis_deg"], errors["motion_deg"], errors["motion_units"]) == (90, None, 0.2)


# Surfaces.


def square(z: float) -> trimesh.Trimesh:
    corners = np.array([[0, 0, z], [1, 0, z], [1, 1, z], [0, 1, z]], float)
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def test_chamfer_of_offset_squares_is_twice_the_offset_squared() -> None:
    rng = np.random.default_rng(0)
    a, b = sample([square(0)], 10_000, rng), sample([square(0.1)], 10_000, rng)
    # On top of 2·0.1² comes what the spacing of the points adds: 1 / (π n) a direction.
    assert chamfer(a, b) == pytest.approx(1000 * 2 * (0.01 + 1 / (np.pi * 10_000)), rel=1e-3)
    assert chamfer(a, a) == 0
    assert chamfer(a, b) == pytest.approx(chamfer(b, a))


def test_samples_are_uniform_over_the_area_of_all_meshes() -> None:
    big = square(0).apply_scale(2)
    points = sample([big, square(5)], 20_000, np.random.default_rng(0))
    assert (points[:, 2] > 1).mean() == pytest.approx(0.2, abs=0.01)
    assert points[points[:, 2] < 1][:, :2].mean(0) == pytest.approx([1, 1], abs=0.03)


def test_cleaning_drops_small_islands_only() -> None:
    big, small, speck = (trimesh.creation.box([s] * 3) for s in (1.0, 0.5, 0.2))
    mesh = trimesh.util.concatenate([big, small.apply_translation([3, 0, 0]), speck.apply_translation([6, 0, 0])])
    loose = trimesh.Trimesh(mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3), process=False)
    for m in (mesh, loose):  # The second shares no vertices: its triangles still belong together.
        assert clean(m).area == pytest.approx(6 + 1.5)
        assert clean(m).bounds[1, 0] < 4


def test_overlap_is_one_for_the_same_surface_and_nought_apart() -> None:
    rng = np.random.default_rng(0)
    a, b = sample([square(0)], 4000, rng), sample([square(0)], 4000, rng)
    assert overlap(a, b, 0.05) == 1
    assert overlap(a, b + np.array([0, 0, 0.1]), 0.05) == 0
    assert overlap(a, b + np.array([0.5, 0, 0]), 0.02) == pytest.approx(0.5, abs=0.05)


def test_match_takes_the_best_sum_and_drops_what_does_not_overlap() -> None:
    assert match(np.array([[0.9, 0.8], [0.85, 0.1]])) == {0: 1, 1: 0}
    assert match(np.array([[0.9, 0.1], [0.2, 0.05]])) == {0: 0}
    assert match(np.zeros((2, 0))) == {}


def test_inside_and_penetration_of_boxes() -> None:
    base = trimesh.creation.box([1, 1, 1])
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    assert (inside(base, points) == (np.abs(points) < 0.5).all(1)).all()
    part = trimesh.creation.box([0.4, 0.4, 0.4]).apply_translation([1, 0, 0])
    slides = [trimesh.transformations.translation_matrix([-x, 0, 0]) for x in np.linspace(0, 0.4, 11)]
    result = penetration(base, part, slides)
    assert result.volume_fraction == pytest.approx(0.25, abs=0.03)
    assert result.depth == pytest.approx(0.1, abs=0.003)
    assert penetration(base, part, slides[:5]).volume_fraction == 0


# Whole runs.


def test_the_truth_itself_scores_nought(capture: Path, tmp_path: Path) -> None:
    truth = load_truth(capture)
    run = write_run(tmp_path / "run", truth, perfect_twin(truth))
    surface_gaussians(truth).save(run / "gaussians.safetensors")
    (run / "config.json").write_text(json.dumps({"capture": str(capture)}))
    metrics = evaluate(run, capture / "truth")
    assert json.loads((run / "metrics.json").read_text()) == metrics
    assert (metrics["parts_true"], metrics["parts_found"], metrics["superfluous_parts"]) == (3, 3, 0)
    door, drawer = metrics["joints"]
    assert (door["truth"], door["part"], door["type_true"], door["type_found"]) == (
        "door",
        1,
        "revolute",
        "revolute",
    )
    for key in ("axis_deg", "position_x10", "pivot", "motion_deg"):
        assert door[key] == pytest.approx(0, abs=1e-6)
    assert drawer["motion_units"] == pytest.approx(0, abs=1e-9) and drawer["motion_deg"] is None
    assert metrics["cd"]["whole"] < 0.5 and max(metrics["cd"]["movable"]) < 0.2 and metrics["cd"]["static"] < 0.4
    assert metrics["volumes"] == pytest.approx([1, 1, 1], abs=1e-6)
    assert metrics["penetration"]["volume_fraction"] < 0.005
    assert metrics["part_iou"] > 0.75
    assert metrics["views"]["psnr"] > 5 and 0 < metrics["views"]["ssim"] < 1
    assert metrics["views"]["lpips"] is None and metrics["views"]["lpips_why_null"]


def test_a_tilted_axis_and_swapped_names_give_exact_figures(capture: Path, tmp_path: Path) -> None:
    truth = load_truth(capture)
    twin = perfect_twin(truth)
    tilt = revolute([1, 0, 0], [0, 0, 0], np.radians(1))[:3, :3]
    twin = change(twin, 0, lambda j: {"axis": tuple(tilt @ np.asarray(j.axis))})
    # Part 1 is now the drawer and part 2 the door.
    swap = {0: 0, 1: 2, 2: 1}
    twin = Twin(
        tuple(Part(i, twin.parts[swap[i]].name, 0, twin.parts[swap[i]].mesh) for i in range(3)),
        tuple(Joint(**(vars(j) | {"child": swap[j.child]})) for j in twin.joints),
    )
    metrics = evaluate(write_run(tmp_path / "run", truth, twin), capture)
    door, drawer = metrics["joints"]
    assert (door["part"], drawer["part"]) == (2, 1)
    assert door["axis_deg"] == pytest.approx(1, abs=1e-6)
    assert door["position_x10"] == pytest.approx(0, abs=1e-6)
    assert 0 < door["motion_deg"] < 1.1
    assert metrics["views"]["psnr"] is None and "config.json" in metrics["views"]["why_null"]
    assert metrics["part_iou"] is None


def test_a_missing_part_and_a_superfluous_one(capture: Path, tmp_path: Path) -> None:
    truth = load_truth(capture)
    twin = perfect_twin(truth)
    run = write_run(tmp_path / "run", truth, twin)
    speck = trimesh.creation.box([0.05] * 3).apply_translation(truth.parts[0].meshes[0].centroid)
    speck.export(run / "parts" / "speck.obj")
    parts = (twin.parts[0], Part(1, "speck", 0, "parts/speck.obj"), twin.parts[2])
    Twin(parts, twin.joints).save(run / "twin.json")
    metrics = evaluate(run, capture)
    door, drawer = metrics["joints"]
    assert (door["part"], door["axis_deg"], door["motion_deg"], door["type_found"]) == (None, 90, 90, None)
    assert drawer["part"] == 2 and drawer["axis_deg"] == pytest.approx(0, abs=1e-6)
    assert metrics["superfluous_parts"] == 1
    assert metrics["cd"]["movable"][0] > 10 > metrics["cd"]["movable"][1]


def test_masks_that_the_run_was_given_are_given_again(capture: Path, tmp_path: Path) -> None:
    truth = load_truth(capture)
    run = write_run(tmp_path / "run", truth, perfect_twin(truth))
    surface_gaussians(truth, 500).save(run / "gaussians.safetensors")
    plain, masks = tmp_path / "plain", tmp_path / "masks"
    shutil.copytree(capture, plain)
    for path in sorted(plain.glob("state_*/train/*.png")) + sorted(plain.glob("state_*/test/*.png")):
        image, mask = Image.open(path), masks / path.relative_to(plain)
        mask.parent.mkdir(parents=True, exist_ok=True)
        image.getchannel("A").save(mask)
        image.convert("RGB").save(path)
    scores = []
    for folder, given in ((capture, None), (plain, None), (plain, masks)):
        (run / "config.json").write_text(json.dumps({"capture": str(folder)}))
        scores.append(evaluate(run, capture, masks=given)["views"])
    with_alpha, without, with_masks = scores
    assert without["psnr"] is None and "--masks" in without["why_null"]
    assert with_masks["psnr"] == pytest.approx(with_alpha["psnr"])


def test_files_of_a_state_win_over_the_canonical_ones(capture: Path, tmp_path: Path) -> None:
    truth = load_truth(capture)
    run = write_run(tmp_path / "run", truth, perfect_twin(truth))
    gaussians = surface_gaussians(truth, 500)
    gaussians.save(run / "gaussians.safetensors")
    (run / "config.json").write_text(json.dumps({"capture": str(capture)}))
    before = evaluate(run, capture)["views"]["psnr_by_state"]
    views = load_capture(capture).states[1].test
    assert len(views) == 2
    gaussians.logit_opacities[:] = -20
    gaussians.save(run / "gaussians_state1.safetensors")
    after = evaluate(run, capture)["views"]["psnr_by_state"]
    white = []
    for view in views:
        alpha = view.rgba[..., 3:] / 255
        white.append(-10 * np.log10((((1 - view.rgba[..., :3] / 255) * alpha) ** 2).mean()))
    assert after[0] == before[0]
    assert after[1] == pytest.approx(np.mean(white), abs=1e-3)


# Truth folders.


def chain(folder: Path) -> Path:
    """A slide on the base and a hinge on the slide."""
    (folder / "parts").mkdir(parents=True)
    for i, name in enumerate(("base", "slide", "flap")):
        trimesh.creation.box([0.5, 0.5, 0.1]).apply_translation([0, 0, 0.3 * i]).export(folder / f"parts/{name}.obj")
    common = {"limits": [0, 2]}
    joints = [
        {"parent": "slide", "child": "flap", "type": "revolute", "axis": [0, 0, 2], "origin": [0.5, 0, 0]}
        | common
        | {"state0": 0.3, "state1": 1.0},
        {"parent": "base", "child": "slide", "type": "prismatic", "axis": [1, 0, 0], "origin": [0, 0, 0]}
        | common
        | {"state0": 0.1, "state1": 0.4},
    ]
    ids = {"base": 1, "slide": 2, "flap": 3}
    data = {"root": "base", "parts": ["base", "slide", "flap"], "part_ids": ids, "joints": joints}
    (folder / "joints.json").write_text(json.dumps(data))
    return folder


def test_chained_joints_are_posed_and_compared_relative_to_the_parent(tmp_path: Path) -> None:
    truth = load_truth(chain(tmp_path / "truth"))
    slide, flap = truth.joints
    assert (slide.parent, flap.parent, flap.motion) == (0, 1, pytest.approx(0.7))
    assert flap.axis == pytest.approx([0, 0, 1])
    assert flap.pivot[:2] == pytest.approx([0.6, 0])  # Carried along by the slide's 0.1 of state 0.
    moved = perfect_twin(truth).at_state(1)
    for i, part in enumerate(truth.parts):
        expected = part.meshes[0].copy().apply_transform(moved[i])
        assert expected.vertices == pytest.approx(part.meshes[1].vertices, abs=1e-9)
    metrics = evaluate(write_run(tmp_path / "run", truth, perfect_twin(truth)), tmp_path / "truth")
    assert metrics["joints"][1]["motion_deg"] == pytest.approx(0, abs=1e-6)
    # A star that puts the flap on the base, with the same motion in the world, has the same relative motion.
    world = moved[2]
    angle = 0.7
    pivot = np.linalg.lstsq(np.eye(3) - world[:3, :3], world[:3, 3], rcond=None)[0]
    star = change(perfect_twin(truth), 1, lambda j: {"parent": 0, "pivot": tuple(pivot), "states": (0.0, angle)})
    again = evaluate(write_run(tmp_path / "star", truth, star), tmp_path / "truth")
    assert again["joints"][1]["motion_deg"] == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("many", [False, True])
def test_paris_and_artgs_truth(tmp_path: Path, many: bool) -> None:
    lid = {"axis": {"o": [0, 0.5, 7], "d": [0, 0, 2]}, "type": "rotate", "rotate": {"l": 10, "r": -80}}
    tray = {"axis": {"o": [0, 0, 0], "d": [1, 0, 0]}, "type": "translate", "translate": {"l": 0.1, "r": 0.3}}
    movers = [lid, tray] if many else [lid]
    folder = tmp_path / "gt"
    for state in ("start", "end"):
        (folder / state).mkdir(parents=True)
        box = trimesh.creation.box([1, 1, 1])
        box.export(folder / state / f"{state}_static_rotate.ply")
        for i in range(len(movers)):
            name = f"{state}_dynamic_{i}_rotate.ply" if many else f"{state}_dynamic_rotate.ply"
            box.copy().apply_translation([2 + i, 0, 0]).export(folder / state / name)
    (folder / "trans.json").write_text(json.dumps({"input": {}, "trans_info": movers if many else lid}))
    truth = load_truth(tmp_path)
    assert [p.name for p in truth.parts] == (["static", "dynamic_0", "dynamic_1"] if many else ["static", "dynamic"])
    hinge = truth.joints[0]
    assert (hinge.type, hinge.motion) == ("revolute", pytest.approx(np.radians(-90)))
    assert hinge.axis == pytest.approx([0, 0, 1]) and hinge.pivot == pytest.approx([0, 0.5, 0])
    if many:
        assert (truth.joints[1].type, truth.joints[1].motion) == ("prismatic", pytest.approx(0.2))
        assert truth.parts[2].meshes[1].centroid == pytest.approx([3, 0, 0])


def test_swapped_parts_are_matched_by_geometry_alone(tmp_path: Path) -> None:
    truth = load_truth(chain(tmp_path / "truth"))
    found = [
        FoundPart(0, truth.parts[0].meshes),
        FoundPart(1, truth.parts[2].meshes),
        FoundPart(2, truth.parts[1].meshes),
    ]
    assert match_parts(truth, found) == {0: 0, 1: 2, 2: 1}
    assert match_parts(truth, found[:2]) == {0: 0, 1: 2}
    assert match_parts(truth, found[:1]) == {0: 0}


@pytest.mark.captures
@pytest.mark.parametrize("name", ["mw_lever", "mw_window", "fk_hinge_cabinet", "ss_cabinet5", "inf_dishwasher"])
def test_truth_of_the_development_captures(captures: Path, name: str) -> None:
    truth = load_truth(captures / name)
    twin = perfect_twin(truth)
    moved = twin.at_state(1)
    for i, part in enumerate(truth.parts):
        there = part.meshes[0].vertices @ moved[i][:3, :3].T + moved[i][:3, 3]
        assert there == pytest.approx(part.meshes[1].vertices, abs=1e-9)
    assert set(truth.picture_ids.values()) == set(range(len(truth.parts)))


# Bad input: one line that names the file.


def test_bad_input_is_refused(capture: Path, tmp_path: Path) -> None:
    truth = load_truth(capture)
    with pytest.raises(HingesplatError, match="no such run folder"):
        evaluate(tmp_path / "none", capture)
    run = write_run(tmp_path / "run", truth, perfect_twin(truth))
    with pytest.raises(HingesplatError, match="no truth here"):
        evaluate(run, tmp_path)
    (run / "twin.json").unlink()
    with pytest.raises(HingesplatError, match=r"twin\.json: no such file"):
        evaluate(run, capture)
    perfect_twin(truth).save(run / "twin.json")
    (run / "parts" / "door.obj").write_text("v 0 0 0\n")
    with pytest.raises(HingesplatError, match=r"door\.obj"):
        evaluate(run, capture)
    (run / "parts" / "door.obj").unlink()
    with pytest.raises(HingesplatError, match=r"door\.obj: no such file"):
        evaluate(run, capture)
    assert not (run / "metrics.json").exists()


def test_truth_of_another_object_is_refused(capture: Path, tmp_path: Path) -> None:
    truth = load_truth(capture)
    run = write_run(tmp_path / "run", truth, perfect_twin(truth))
    for part in truth.parts:
        part.meshes[0].copy().apply_scale(20).export(run / "parts" / f"{part.name}.obj")
    with pytest.raises(HingesplatError, match="not the truth of"):
        evaluate(run, capture)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d["joints"][0].pop("axis"), "axis"),
        (lambda d: d["joints"][0].update(axis=[0, 0, 0]), "length 0"),
        (lambda d: d["joints"][0].update(origin=[0, float("nan"), 0]), "finite"),
        (lambda d: d["joints"][0].update(type="ball"), "unknown type"),
        (lambda d: d["joints"].pop(), "tree"),
        (lambda d: d["joints"][1].update(parent="flap"), "ring"),
        (lambda d: d["parts"].append("lamp"), "tree"),
    ],
)
def test_broken_trees_are_refused(tmp_path: Path, edit: Callable, message: str) -> None:
    folder = chain(tmp_path / "truth")
    data = json.loads((folder / "joints.json").read_text())
    edit(data)
    (folder / "joints.json").write_text(json.dumps(data))
    with pytest.raises(HingesplatError, match=message) as error:
        load_truth(folder)
    assert "joints.json" in str(error.value) and "\n" not in str(error.value)
