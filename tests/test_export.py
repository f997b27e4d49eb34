"""Exports: what is written loads, moves end to end, and comes back unchanged."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from lxml import etree

from hingesplat.errors import HingesplatError
from hingesplat.export.links import collision_hulls, write_obj
from hingesplat.export.mjcf import write_mjcf
from hingesplat.export.splats import read_ply, write_ply
from hingesplat.export.urdf import write_urdf
from hingesplat.gaussians import Gaussians, posed
from hingesplat.twin import Joint, Part, Twin

Triple = tuple[float, float, float]


def box(extents: Triple, centre: Triple, rgb: tuple[int, int, int]) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents, trimesh.transformations.translation_matrix(centre))
    mesh.visual.vertex_colors = [*rgb, 255]
    return mesh


@pytest.fixture(scope="module")
def cabinet() -> tuple[Twin, dict[int, trimesh.Trimesh]]:
    """A solid base, a door hinged in front of it, a handle that slides on the door, a lift that moves up."""
    meshes = {
        0: box((0.6, 0.4, 0.8), (0, 0, 0), (180, 140, 100)),
        1: box((0.6, 0.02, 0.4), (0, -0.21, 0.2), (200, 40, 40)),
        2: box((0.04, 0.04, 0.1), (0.2, -0.24, 0.2), (40, 40, 200)),
        3: box((0.5, 0.3, 0.1), (0, 0, 0.455), (40, 200, 40)),
    }
    parts = tuple(Part(i, name, 0) for i, name in enumerate(["base", "door", "door", "lift up!"]))
    joints = (
        Joint(1, 0, "revolute", (0.0, 0.0, -1.0), (-0.3, -0.2, 0.2), (0.0, 1.2), (0.0, 1.2)),
        Joint(2, 1, "prismatic", (0.0, 0.0, 1.0), (0.2, -0.24, 0.2), (0.0, 0.05), (-0.02, 0.05)),
        Joint(3, 0, "prismatic", (0.0, 0.0, 1.0), (0.0, 0.0, 0.455), (0.0, 0.2), (0.0, 0.2)),
    )
    return Twin(parts, joints), meshes


def drive(model) -> None:
    """Send every joint to either end of its range and back; the actuators must hold it there."""
    mujoco = pytest.importorskip("mujoco")
    data = mujoco.MjData(model)
    joint = model.actuator_trnid[:, 0]
    assert sorted(joint) == list(range(model.njnt))
    low, high = model.jnt_range[joint].T
    for target in (high, low, high):
        data.ctrl[:] = target
        for _ in range(round(1.0 / model.opt.timestep)):
            mujoco.mj_step(model, data)
        assert (np.abs(data.qpos[joint] - target) <= 0.02 * (high - low)).all()
        assert np.abs(data.qvel).max() < 1e-2
    assert sum(w.number for w in data.warning) == 0


def test_mjcf_moves_end_to_end_and_its_poses_are_the_twins(cabinet, tmp_path: Path):
    mujoco = pytest.importorskip("mujoco")
    twin, meshes = cabinet
    write_mjcf(twin, meshes, tmp_path / "a")
    shutil.move(tmp_path / "a", tmp_path / "b")  # the folder can be moved
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "b" / "twin.xml"))
    drive(model)
    data = mujoco.MjData(model)
    values = {1: 0.7, 2: 0.03, 3: 0.1}
    data.qpos[[model.joint(f"{name}_joint").qposadr[0] for name in ("door", "door_2", "lift_up")]] = [
        0.7,
        0.03,
        0.1,
    ]
    mujoco.mj_forward(model, data)
    for part_id, T in twin.transforms(values).items():
        start = np.zeros(3) if part_id == 0 else np.asarray(twin.joint_of(part_id).pivot)
        body = data.body(["base", "door", "door_2", "lift_up"][part_id])
        assert body.xpos == pytest.approx(T[:3, :3] @ start + T[:3, 3], abs=1e-6)
        assert body.xmat.reshape(3, 3) == pytest.approx(T[:3, :3], abs=1e-6)


def test_urdf_loads_and_moves_end_to_end(cabinet, tmp_path: Path):
    mujoco = pytest.importorskip("mujoco")
    twin, meshes = cabinet
    path = write_urdf(twin, meshes, tmp_path / "a")
    shutil.move(path.parent, tmp_path / "b")
    spec = mujoco.MjSpec.from_file(str(tmp_path / "b" / "twin.urdf"))
    for joint in spec.joints:
        servo = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        gain = joint.actfrcrange[1] / (2 * np.ptp(joint.range))  # the effort limit is twice gain · range
        servo.set_to_position(kp=gain, dampratio=1.0)
    model = spec.compile()
    assert model.nbody == 5 and model.njnt == 3
    drive(model)


def test_link_frames_sit_at_the_pivots_and_inertia_is_a_boxs(cabinet, tmp_path: Path):
    twin, meshes = cabinet
    root = etree.parse(str(write_urdf(twin, meshes, tmp_path, density=100.0, scale=2.0))).getroot()
    joint = next(j for j in root.iter("joint") if j.get("name") == "door_joint")
    assert [float(v) for v in joint.find("origin").get("xyz").split()] == pytest.approx([-0.6, -0.4, 0.4])
    link = next(e for e in root.iter("link") if e.get("name") == "door")
    a, b, c = 1.2, 0.04, 0.8
    mass = 100 * a * b * c
    assert float(link.find("inertial/mass").get("value")) == pytest.approx(mass)
    inertia = link.find("inertial/inertia")
    assert float(inertia.get("izz")) == pytest.approx(mass / 12 * (a * a + b * b))
    assert float(inertia.get("ixx")) == pytest.approx(mass / 12 * (b * b + c * c))
    assert [float(v) for v in link.find("inertial/origin").get("xyz").split()] == pytest.approx([0.6, -0.02, 0])
    files = [m.get("filename") for m in root.iter("mesh")]
    assert files and all(not Path(f).is_absolute() and (tmp_path / f).is_file() for f in files)
    names = [e.get("name") for e in root.iter("link")]
    assert len(set(names)) == 4  # two parts are both called door
    slide = next(j for j in root.iter("joint") if j.get("name") == "lift_up_joint")
    assert float(slide.find("limit").get("upper")) == pytest.approx(0.4)


def test_a_part_without_a_base_is_refused(cabinet, tmp_path: Path):
    _, meshes = cabinet
    loop = Twin(
        (Part(0, "base", 0), Part(1, "a", 0), Part(2, "b", 0)),
        tuple(Joint(c, p, "revolute", (0, 0, 1), (0, 0, 0), (0, 1), (0, 1)) for c, p in [(1, 2), (2, 1)]),
    )
    with pytest.raises(HingesplatError, match="parent"):
        write_urdf(loop, meshes, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_collision_hulls_are_convex_cover_the_mesh_and_are_cached(tmp_path: Path, monkeypatch):
    ell = trimesh.boolean.union(
        [box((1, 0.2, 0.2), (0, 0, 0), (9, 9, 9)), box((0.2, 0.2, 1), (0.4, 0, 0.4), (9, 9, 9))]
    )
    hulls = collision_hulls(ell, tmp_path)
    assert all(h.is_convex and h.is_watertight for h in hulls)
    total = sum(h.volume for h in hulls)
    assert ell.volume * 0.95 < total < ell.volume * 1.15 < ell.convex_hull.volume
    monkeypatch.setattr("coacd.run_coacd", lambda *a, **k: pytest.fail("cut again"))
    again = collision_hulls(ell, tmp_path)
    assert [h.volume for h in again] == pytest.approx([h.volume for h in hulls])


def test_when_the_decomposition_fails_the_convex_hull_stands_in(tmp_path: Path, monkeypatch):
    def fail(*args, **kwargs):
        raise RuntimeError("no luck")

    monkeypatch.setattr("coacd.run_coacd", fail)
    mesh = box((1, 1, 1), (0, 0, 0), (9, 9, 9))
    (hull,) = collision_hulls(mesh, tmp_path)
    assert hull.volume == pytest.approx(1.0)


def test_an_obj_keeps_its_colours(tmp_path: Path):
    mesh = box((1, 1, 1), (0, 0, 0), (200, 30, 60))
    write_obj(mesh, tmp_path / "cube.obj")
    rows = [line.split() for line in (tmp_path / "cube.obj").read_text().splitlines()]
    colours = np.array([[float(x) for x in r[4:]] for r in rows if r[0] == "v"])
    assert colours == pytest.approx(np.tile([200 / 255, 30 / 255, 60 / 255], (8, 1)), abs=1e-3)
    textured = trimesh.load(tmp_path / "cube.obj")
    assert np.asarray(textured.visual.to_color().vertex_colors)[:, :3] == pytest.approx(
        np.tile([200, 30, 60], (len(textured.vertices), 1)), abs=2
    )


def random_gaussians(n: int, degree: int) -> Gaussians:
    torch.manual_seed(0)
    return Gaussians(
        torch.randn(n, 3),
        torch.nn.functional.normalize(torch.randn(n, 4), dim=1),
        torch.randn(n, 3),
        torch.randn(n),
        torch.randn(n, (degree + 1) ** 2, 3),
        torch.zeros(n, dtype=torch.int64),
    )


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("n", [0, 7])
def test_splats_come_back_to_the_last_bit_but_for_the_quaternions_length(n: int, degree: int, tmp_path: Path):
    before = random_gaussians(n, degree)
    write_ply(before, tmp_path / "a.ply")
    after = read_ply(tmp_path / "a.ply")
    for name in ("means", "log_scales", "logit_opacities", "sh"):
        assert torch.equal(getattr(after, name), getattr(before, name))
    assert torch.allclose(after.quats, before.quats, atol=1e-6)
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def test_the_rest_coefficients_are_channel_major(tmp_path: Path):
    gaussians = random_gaussians(1, 1)
    write_ply(gaussians, tmp_path / "a.ply")
    head, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[2] for line in head.decode().splitlines() if line.startswith("property")]
    row = dict(zip(names, np.frombuffer(body, "<f4"), strict=True))
    assert row["f_rest_1"] == gaussians.sh[0, 2, 0] and row["f_rest_3"] == gaussians.sh[0, 1, 1]
    assert row["rot_0"] == pytest.approx(float(gaussians.quats[0, 0]))


@pytest.mark.parametrize(
    ("content", "says"),
    [(b"", "not a binary"), (b"ply\nformat ascii 1.0\nend_header\n", "not a binary"), (None, "no such file")],
)
def test_a_broken_ply_is_refused(content: bytes | None, says: str, tmp_path: Path):
    path = tmp_path / "a.ply"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(HingesplatError, match=says):
        read_ply(path)


def test_a_ply_that_was_cut_off_is_refused(tmp_path: Path):
    write_ply(random_gaussians(5, 0), tmp_path / "a.ply")
    (tmp_path / "b.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-3])
    with pytest.raises(HingesplatError, match="cut off"):
        read_ply(tmp_path / "b.ply")


def test_posing_moves_one_part_and_back():
    gaussians = random_gaussians(20, 1).with_part(torch.arange(20) % 2)
    joint = Joint(1, 0, "revolute", (0.0, 0.6, 0.8), (0.3, -0.1, 0.2), (0.0, 1.0), (0.0, 1.0))
    there = posed(gaussians, {1: joint.transform(0.9)})
    base = gaussians.part == 0
    assert torch.equal(there.means[base], gaussians.means[base])
    assert not torch.allclose(there.means[~base], gaussians.means[~base], atol=0.1)
    back = posed(there, {1: joint.transform(-0.9)})
    assert torch.allclose(back.means, gaussians.means, atol=1e-5)
    same_turn = (back.quats * gaussians.quats).sum(1).abs()
    assert torch.allclose(same_turn, torch.ones(20), atol=1e-5)
