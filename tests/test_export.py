"""Exports: what is written loads, moves end to end, and comes back unchanged."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import manifold3d
import numpy as np
import pytest
import torch
import trimesh
from lxml import etree
from PIL import Image
from rich.console import Console
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree

from hingesplat import cli
from hingesplat.console import show_check
from hingesplat.errors import HingesplatError
from hingesplat.export import FORMATS, ExportConfig, export_twin
from hingesplat.export.check import Check, check_export, simulation, sweep
from hingesplat.export.links import UP, build_links, touching
from hingesplat.export.obj import bake, obj_files
from hingesplat.export.solids import closed_mesh, collision_hulls, colours, manifold
from hingesplat.export.splats import read_ply, transformed, write_ply
from hingesplat.gaussians import Gaussians, posed
from hingesplat.render import sh_to_rgb
from hingesplat.synth.objects import build
from hingesplat.synth.shapes import solid_mesh
from hingesplat.twin import Joint, Part, Twin

Triple = tuple[float, float, float]
Made = tuple[Twin, dict[int, trimesh.Trimesh]]

NAMES = ("base", "door", "door_2", "lift_up", "knob")
VALUES = {1: 0.7, 2: 0.03, 3: 0.1, 4: -0.4}


def box(extents: Triple, centre: Triple, rgb: tuple[int, int, int]) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents, trimesh.transformations.translation_matrix(centre))
    mesh.visual.vertex_colors = [*rgb, 255]
    return mesh


@pytest.fixture(scope="module")
def cabinet() -> Made:
    """A door hinged in front of a base, a handle that slides on it, a knob that turns on that; and a lift."""
    meshes = {
        0: box((0.6, 0.4, 0.8), (0, 0, 0), (180, 140, 100)),
        1: box((0.6, 0.02, 0.4), (0, -0.21, 0.2), (200, 40, 40)),
        2: box((0.04, 0.04, 0.1), (0.2, -0.24, 0.2), (40, 40, 200)),
        3: box((0.5, 0.3, 0.1), (0, 0, 0.455), (40, 200, 40)),
        4: box((0.03, 0.03, 0.05), (0.21, -0.285, 0.2), (90, 90, 90)),
    }
    parts = tuple(Part(i, name, 5) for i, name in enumerate(["base", "door", "door", "lift up!", "knob"]))
    joints = (
        Joint(4, 2, "revolute", (0.0, -0.6, 0.8), (0.2, -0.28, 0.2), (0.0, 0.5), (-0.5, 0.5)),
        Joint(1, 0, "revolute", (0.0, 0.0, -1.0), (-0.3, -0.2, 0.2), (0.0, 1.2), (0.0, 1.2)),
        Joint(2, 1, "prismatic", (0.0, 0.0, 1.0), (0.2, -0.24, 0.2), (0.0, 0.05), (-0.02, 0.05)),
        Joint(3, 0, "prismatic", (0.0, 0.0, 1.0), (0.0, 0.0, 0.455), (0.0, 0.2), (0.0, 0.2)),
    )
    return Twin(parts, joints), meshes


@pytest.fixture(scope="module")
def hulls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Meshes are cut into hulls once for all tests."""
    return tmp_path_factory.mktemp("hulls")


def export(made: Made, out: Path, form: str, hulls: Path | None = None, **options) -> Path:
    """The exported file of one format, its folder moved after it was written."""
    gaussians = random_gaussians(5 * len(made[0].parts), 1)
    gaussians = gaussians.with_part(torch.arange(len(gaussians)) // 5)
    path = export_twin(*made, gaussians, out, [form], ExportConfig(**options), cache=hulls)[form]
    shutil.move(path.parent, out / "moved")
    return out / "moved" / path.name


def link_poses(twin: Twin, values: dict[int, float], scale: float = 1.0, up_axis: str = "z") -> dict[str, np.ndarray]:
    """Where the twin's own transforms put the frame of each link, 4×4, in the export's frame."""
    R = UP[up_axis]
    poses = {}
    for part_id, T in twin.transforms(values).items():
        joint = twin.joint_of(part_id)
        start = np.zeros(3) if joint is None else np.asarray(joint.pivot)
        pose = np.eye(4)
        pose[:3, :3] = R @ T[:3, :3] @ R.T
        pose[:3, 3] = scale * R @ (T[:3, :3] @ start + T[:3, 3])
        poses[NAMES[part_id]] = pose
    return poses


def in_export(value: float, part_id: int, scale: float) -> float:
    """A joint's value in the export's units."""
    return value * scale if part_id in (2, 3) else value


@pytest.mark.parametrize("form", ["mjcf", "urdf"])
@pytest.mark.parametrize("options", [{}, {"scale": 2.5, "up_axis": "y"}])
def test_mujoco_puts_every_link_where_the_twin_does(cabinet: Made, tmp_path: Path, hulls: Path, form: str, options):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(export(cabinet, tmp_path, form, hulls, **options)))
    data = mujoco.MjData(model)
    for part_id, value in VALUES.items():
        place = model.joint(f"{NAMES[part_id]}_joint").qposadr[0]
        data.qpos[place] = in_export(value, part_id, options.get("scale", 1.0))
    mujoco.mj_forward(model, data)
    for name, pose in link_poses(cabinet[0], VALUES, **options).items():
        assert data.body(name).xpos == pytest.approx(pose[:3, 3], abs=1e-6)
        assert data.body(name).xmat.reshape(3, 3) == pytest.approx(pose[:3, :3], abs=1e-6)
    assert model.opt.gravity == pytest.approx([0, -9.81, 0] if options else [0, 0, -9.81])


def test_pybullet_and_yourdfpy_put_every_link_where_the_twin_does(cabinet: Made, tmp_path: Path, hulls: Path):
    path = export(cabinet, tmp_path, "urdf", hulls)
    yourdfpy = pytest.importorskip("yourdfpy")
    robot = yourdfpy.URDF.load(str(path))
    robot.update_cfg({f"{NAMES[i]}_joint": value for i, value in VALUES.items()})
    for name, pose in link_poses(cabinet[0], VALUES).items():
        assert robot.get_transform(name, "base") == pytest.approx(pose, abs=1e-6)
    p = pytest.importorskip("pybullet")
    client = p.connect(p.DIRECT)
    body = p.loadURDF(str(path), useFixedBase=True)
    index = {p.getJointInfo(body, j)[12].decode(): j for j in range(p.getNumJoints(body))}
    for part_id, value in VALUES.items():
        p.resetJointState(body, index[NAMES[part_id]], value)
    for name, j in index.items():
        place = p.getLinkState(body, j, computeForwardKinematics=True)[4]
        assert place == pytest.approx(link_poses(cabinet[0], VALUES)[name][:3, 3], abs=1e-6)
    p.disconnect(client)


@pytest.mark.parametrize("options", [{}, {"scale": 2.5, "up_axis": "y"}])
def test_usd_joints_put_every_link_where_the_twin_does(cabinet: Made, tmp_path: Path, hulls: Path, options):
    pytest.importorskip("pxr")
    from pxr import Gf, Usd, UsdGeom, UsdPhysics  # pyright: ignore[reportMissingImports]

    stage = Usd.Stage.Open(str(export(cabinet, tmp_path, "usd", hulls, **options)))
    assert UsdGeom.GetStageUpAxis(stage) == options.get("up_axis", "z").upper()
    scale = options.get("scale", 1.0)

    def frame(position, rotation) -> np.ndarray:
        return np.array(Gf.Matrix4d(Gf.Rotation(Gf.Quatd(rotation)), Gf.Vec3d(position))).T

    rest = link_poses(cabinet[0], {}, **options)
    wanted = link_poses(cabinet[0], VALUES, **options)
    found = {"base": np.eye(4)}
    for part_id in (1, 2, 3, 4):
        name = NAMES[part_id]
        xform = UsdGeom.Xformable(stage.GetPrimAtPath(f"/twin/links/{name}"))
        assert np.array(xform.GetLocalTransformation()).T == pytest.approx(rest[name], abs=1e-6)  # noqa: SIM300
        prim = stage.GetPrimAtPath(f"/twin/joints/{name}_joint")
        joint = UsdPhysics.Joint(prim)
        parent = joint.GetBody0Rel().GetTargets()[0].name
        value = in_export(VALUES[part_id], part_id, scale)
        move = np.eye(4)
        if prim.IsA(UsdPhysics.RevoluteJoint):
            assert UsdPhysics.RevoluteJoint(prim).GetUpperLimitAttr().Get() == pytest.approx(
                np.degrees(cabinet[0].joint_of(part_id).limits[1])
            )
            move = trimesh.transformations.rotation_matrix(value, [1, 0, 0])
        else:
            move[0, 3] = value
        before = frame(joint.GetLocalPos0Attr().Get(), joint.GetLocalRot0Attr().Get())
        after = frame(joint.GetLocalPos1Attr().Get(), joint.GetLocalRot1Attr().Get())
        found[name] = found[parent] @ before @ move @ np.linalg.inv(after)
        assert found[name] == pytest.approx(wanted[name], abs=1e-6)


def test_usd_holds_the_gaussians_of_each_link(cabinet: Made, tmp_path: Path, hulls: Path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdVol  # pyright: ignore[reportMissingImports]

    stage = Usd.Stage.Open(str(export(cabinet, tmp_path, "usd", hulls)))
    before = random_gaussians(25, 1)[torch.arange(5, 10)]
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/twin/links/door/splats"))
    places = np.array(splats.GetPositionsAttr().Get()) + cabinet[0].joint_of(1).pivot
    assert places == pytest.approx(before.means.numpy(), abs=1e-5)
    assert np.array(splats.GetScalesAttr().Get()) == pytest.approx(before.scales.numpy(), rel=1e-5)
    turned = [[q.real, *q.imaginary] for q in splats.GetOrientationsAttr().Get()]
    assert np.array(turned) == pytest.approx(before.quats.numpy(), abs=1e-6)
    harmonics = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    assert harmonics.reshape(5, 4, 3) == pytest.approx(before.sh.numpy(), abs=1e-5)


SDF_READER = """
#include <iostream>
#include <sdf/sdf.hh>
int main(int, char **args) {
  sdf::Root root;
  auto errors = root.Load(args[1]);
  for (auto &e : errors) std::cerr << e.Message() << std::endl;
  auto model = root.Model();
  if (!errors.empty() || !model) return 1;
  for (size_t i = 0; i < model->LinkCount(); ++i) {
    auto link = model->LinkByIndex(i);
    decltype(link->RawPose()) raw = link->RawPose();
    auto pose = raw;
    if (!link->SemanticPose().Resolve(pose, "__model__").empty()) return 2;
    std::cout.precision(12);
    std::cout << link->Name() << " " << pose.Pos() << " " << link->VisualCount() << std::endl;
  }
  std::cout << model->JointCount();
}
"""


@pytest.fixture(scope="session")
def sdf_reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """libsdformat behind a main function."""
    if not (shutil.which("pkg-config") and shutil.which("g++")):
        pytest.skip("no compiler for libsdformat")
    listed = subprocess.run(["pkg-config", "--list-package-names"], capture_output=True, text=True, check=True)
    known = [name for name in listed.stdout.split() if name.startswith("sdformat")]
    if not known:
        pytest.skip("libsdformat-dev is not installed")
    flags = subprocess.run(["pkg-config", "--cflags", "--libs", known[-1]], capture_output=True, text=True, check=True)
    folder = tmp_path_factory.mktemp("sdf")
    (folder / "read.cc").write_text(SDF_READER)
    command = ["g++", "-O0", "read.cc", *flags.stdout.split(), "-o", "read"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return folder / "read"


def test_libsdformat_reads_the_sdf_and_puts_every_link_in_its_place(
    cabinet: Made, tmp_path: Path, hulls: Path, sdf_reader: Path
):
    path = export(cabinet, tmp_path, "sdf", hulls)
    done = subprocess.run([sdf_reader, path], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and not done.stderr, done.stderr
    *rows, joints = done.stdout.splitlines()
    found = {row.split()[0]: np.array(row.split()[1:], float) for row in rows}
    for name, pose in link_poses(cabinet[0], {}).items():
        assert found[name] == pytest.approx([*pose[:3, 3], 1], abs=1e-6)
    assert int(joints) == 5  # The base's is to the world.
    for uri in etree.parse(path).iter("uri"):
        assert not Path(uri.text).is_absolute() and (path.parent / uri.text).is_file()
    assert etree.parse(path.parent / "model.config").findtext("sdf") == "model.sdf"


@pytest.mark.parametrize(
    ("form", "options"),
    [
        *((form, {"up_axis": "y", "extend_limits": True, "scale": 0.1}) for form in ("urdf", "mjcf", "usd")),
        *((form, {}) for form in ("urdf", "mjcf")),
    ],
)
def test_programs_take_the_exports_without_a_warning(cabinet: Made, tmp_path: Path, hulls: Path, form: str, options):
    checks = check_export(form, export(cabinet, tmp_path, form, hulls, **options))
    if not checks:
        pytest.skip(f"no program for {form} is installed")
    for check in checks:
        assert check.ok and check.joints == 4 and check.contacts == (), check
        assert (check.error_percent is None) == (not check.program.startswith(("MuJoCo", "PyBullet")))


def from_truth(name: str) -> Made:
    """A made object as its own truth has it: meshes, joints, and the range between its two states."""
    model = build(name, 0)
    start, ids = model.state(0), {body.name: i for i, body in enumerate(model.bodies)}
    meshes, joints = {}, []
    for i, body in enumerate(model.bodies):
        whole = trimesh.boolean.union([solid_mesh(solid) for solid in body.solids], engine="manifold")
        meshes[i] = whole.apply_transform(start[body.name])
        if hinge := body.hinge:
            T, way = start[hinge.parent], hinge.states[1] - hinge.states[0]
            axis, pivot = T[:3, :3] @ hinge.axis, T[:3, :3] @ hinge.origin + T[:3, 3]
            span = (min(way, 0.0), max(way, 0.0))
            joints.append(Joint(i, ids[hinge.parent], hinge.type, tuple(axis), tuple(pivot), (0.0, way), span))
    return Twin(tuple(Part(i, name, 5) for name, i in ids.items()), tuple(joints)), meshes


OLD_MUJOCO = Path(sys.prefix) / "mujoco-3.3"
"""Where `make test` puts the oldest MuJoCo that is promised."""


@pytest.mark.parametrize("form", ["urdf", "mjcf"])
@pytest.mark.parametrize("name", ["latchdoor", "stapler3"])
@pytest.mark.parametrize("old", [False, True], ids=["current", "3.3"])
def test_mujoco_drives_chained_objects_end_to_end(
    name: str, form: str, old: bool, tmp_path: Path, hulls: Path, monkeypatch
):
    pytest.importorskip("mujoco")
    if old and not (OLD_MUJOCO / "mujoco").is_dir():
        pytest.skip(f"no MuJoCo 3.3 in {OLD_MUJOCO}")
    twin, meshes = made = from_truth(name)
    assert len(meshes) == 3 and any(joint.parent != 0 for joint in twin.joints)
    path = export(made, tmp_path, form, hulls)
    if old:
        monkeypatch.syspath_prepend(OLD_MUJOCO)
    check = check_export(form, path)[0]
    assert check.program.startswith("MuJoCo 3.3.") == old
    assert check.ok and check.joints == 2 and check.error_percent < 2, check


@pytest.mark.parametrize("form", ["urdf", "mjcf"])
def test_a_twin_that_does_not_move_is_taken_too(cabinet: Made, tmp_path: Path, hulls: Path, form: str):
    still = Twin(cabinet[0].parts[:1], ()), {0: cabinet[1][0]}
    for check in check_export(form, export(still, tmp_path, form, hulls)):
        assert check.ok and check.joints == 0 and check.error_percent is None, check


def test_a_simulation_that_explodes_is_no_number_but_an_error():
    with pytest.raises(FloatingPointError, match="joint door"):
        sweep({"door": (0.0, 1.0)}, 0.01, lambda at: None, lambda to: {"door": float("nan")})
    assert sweep({"a": (0, 2), "b": (1, 2)}, 0.01, lambda at: None, lambda to: to | {"b": to["b"] + 0.1}) == (
        pytest.approx(10)
    )


@pytest.mark.parametrize("spoil", ["weak", "gone", "blocked"])
def test_the_check_finds_what_is_wrong(cabinet: Made, tmp_path: Path, hulls: Path, spoil: str):
    pytest.importorskip("mujoco")
    path = export(cabinet, tmp_path, "mjcf", hulls)
    root = etree.parse(path)
    if spoil == "weak":
        for servo in root.iter("position"):
            servo.set("kp", "1e-3")
    elif spoil == "gone":
        (path.parent / "meshes" / "door.obj").unlink()
    else:
        etree.SubElement(root.find("worldbody"), "geom", type="box", size="1 .1 1", pos="0 -.5 0")
    root.write(path)
    (check,) = check_export("mjcf", path)
    assert not check.ok
    if spoil == "gone":
        assert "door.obj" in check.warnings[0]
    else:
        assert check.error_percent > 2
    if spoil == "blocked":
        assert any("door" in pair and "world" in pair for pair in check.contacts)


def test_the_simulation_row_of_the_metrics(cabinet: Made, tmp_path: Path, hulls: Path, monkeypatch):
    pytest.importorskip("mujoco")
    missing = simulation(tmp_path)
    assert missing["simulation"] is None and "hingesplat export" in missing["simulation_why_null"]
    export_twin(*cabinet, random_gaussians(3, 0), tmp_path, cache=hulls)
    row = simulation(tmp_path)["simulation"]
    assert row["ok"] and row["mjcf"]["joints"] == row["urdf"]["joints"] == 4
    assert row["mjcf"]["error_percent"] < 2 and row["mjcf"]["warnings"] == ()
    json.dumps(row, allow_nan=False)
    monkeypatch.setattr("hingesplat.export.check.find_spec", lambda name: None)
    assert "not installed" in simulation(tmp_path)["simulation_why_null"]


def test_link_frames_sit_at_the_pivots_and_inertia_is_a_boxs(cabinet: Made, tmp_path: Path, hulls: Path):
    path = export(cabinet, tmp_path, "urdf", hulls, density=100.0, scale=2.0)
    root = etree.parse(path).getroot()
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
    assert files and all(not Path(f).is_absolute() and (path.parent / f).is_file() for f in files)
    assert {e.get("name") for e in root.iter("link")} == set(NAMES)  # Two parts are both called door.
    slide = next(j for j in root.iter("joint") if j.get("name") == "lift_up_joint")
    assert float(slide.find("limit").get("upper")) == pytest.approx(0.4)


def test_limits_reach_as_far_as_the_part_stays_free(cabinet: Made, hulls: Path):
    def limits(extend: bool) -> dict[str, tuple[float, float]]:
        links = build_links(*cabinet, ExportConfig(extend_limits=extend), hulls)
        return {link.name: link.limits for link in links}

    seen, free = limits(False), limits(True)
    assert seen["door"] == (0.0, 1.2)
    # The door shuts against the base and opens until it lies beside it.
    assert free["door"] == (pytest.approx(0, abs=0.003), pytest.approx(np.pi))
    # Five millimetres of air below the lift; above it no more than was seen, which is more than its height.
    assert free["lift_up"] == (pytest.approx(-0.005, abs=3e-4), pytest.approx(0.2))
    assert all(free[n][0] <= seen[n][0] and free[n][1] >= seen[n][1] for n in NAMES)


def test_a_part_without_a_base_is_refused(cabinet: Made, tmp_path: Path):
    loop = Twin(
        (Part(0, "base", 0), Part(1, "a", 0), Part(2, "b", 0)),
        tuple(Joint(c, p, "revolute", (0, 0, 1), (0, 0, 0), (0, 1), (0, 1)) for c, p in [(1, 2), (2, 1)]),
    )
    for extend in (False, True):
        with pytest.raises(HingesplatError, match="parent"):
            config = ExportConfig(extend_limits=extend)
            export_twin(loop, cabinet[1], random_gaussians(3, 0), tmp_path / "out", config=config)
    assert not (tmp_path / "out").exists()


def test_hulls_of_one_part_are_not_taken_for_another_of_its_name(tmp_path: Path, hulls: Path):
    mujoco = pytest.importorskip("mujoco")
    walls = [box((0.4, 0.02, 0.2), (0, y, 0), (90, 90, 90)) for y in (-0.2, 0.2)]
    tray = trimesh.boolean.union([*walls, box((0.4, 0.4, 0.02), (0, 0, -0.1), (90, 90, 90))])
    parts = tuple(Part(i, "drawer", 5) for i in range(3))
    joints = tuple(Joint(i, 0, "prismatic", (1.0, 0, 0), (0, 0, 0), (0, 0.1), (0, 0.1)) for i in (1, 2))
    meshes = {0: box((0.5, 0.5, 0.5), (0, 0, 1), (90, 90, 90)), 1: tray, 2: box((0.1, 0.1, 0.1), (1, 0, 0), (9, 9, 9))}
    model = mujoco.MjModel.from_xml_path(str(export((Twin(parts, joints), meshes), tmp_path, "mjcf", hulls)))
    assert model.nmesh > 3 + 3  # Three are seen; the tray collides as three at least.


def test_too_few_triangles_are_refused(cabinet: Made, tmp_path: Path, hulls: Path):
    with pytest.raises(HingesplatError, match="max_triangles"):
        export(cabinet, tmp_path, "urdf", hulls, max_triangles=3)


def test_names_are_fit_for_every_format(hulls: Path):
    parts = [Part(0, "x", 0), Part(1, "world", 0), Part(2, "3 Türen", 0), Part(3, "a", 0), Part(4, "a", 0)]
    links = build_links(Twin((*parts, Part(5, "a_4", 0), Part(6, "", 0)), ()), {}, ExportConfig(), hulls)
    names = [link.name for link in links]
    assert names[:3] == ["base", "part_world", "part_3_T_ren"]
    assert len(set(names)) == 7 and all(name.isidentifier() and name.isascii() for name in names)


def test_a_mesh_that_does_not_close_gives_way_to_its_hull(caplog):
    bowl = box((1, 1, 1), (0, 0, 0), (200, 30, 60))
    assert closed_mesh(bowl, "bowl", 100) is bowl
    bowl.update_faces(np.arange(12) > 1)
    closed = closed_mesh(bowl, "bowl", 100)
    assert closed.is_watertight and closed.volume == pytest.approx(1) and manifold(closed) is not None
    assert (colours(closed) == [200, 30, 60]).all()
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    assert closed_mesh(flat, "sheet", 100) is None
    assert [r.getMessage() for r in caplog.records] == [
        "bowl: its mesh does not close; its convex hull stands in",
        "sheet: its mesh is flat; it goes without a shape",
    ]


def test_a_mesh_is_simplified_to_the_triangles_allowed():
    ball = trimesh.creation.icosphere(4)
    ball.visual.vertex_colors = np.where(ball.vertices[:, 2:] > 0, [[250, 0, 0, 255]], [[0, 0, 250, 255]])
    small = closed_mesh(ball, "ball", 500)
    assert len(small.faces) <= 500 and small.is_watertight and small.volume == pytest.approx(ball.volume, rel=0.05)
    red = colours(small)[:, 0] > 0
    assert (red == (small.vertices[:, 2] > 0)).all()


TRAPEZE = np.array([[0, 0, 0], [0.1, 0, 0.8], [0.4, 0, 0.8], [0.5, 0, 0], [0, 0, 0]])


def test_collision_hulls_are_convex_cover_the_mesh_and_are_cached(tmp_path: Path, monkeypatch):
    ell = trimesh.boolean.union(
        [box((1, 0.2, 0.2), (0, 0, 0), (9, 9, 9)), box((0.2, 0.2, 1), (0.4, 0, 0.4), (9, 9, 9))]
    )
    hulls = collision_hulls(ell, tmp_path)
    assert all(h.is_convex and h.is_watertight for h in hulls)
    total = sum(h.volume for h in hulls)
    assert ell.volume * 0.95 < total < ell.volume * 1.15 < ell.convex_hull.volume
    monkeypatch.setattr("hingesplat.export.solids._convex_pieces", lambda *_: pytest.fail("cut again"))
    again = collision_hulls(ell, tmp_path)
    assert [h.volume for h in again] == pytest.approx([h.volume for h in hulls])


def test_collision_hulls_cover_thin_things_and_do_not_bulge_far(tmp_path: Path):
    """The coarse copy that is cut must not lose half of a panel, nor a bar."""
    frame = [trimesh.creation.cylinder(0.012, segment=[a, b], sections=12) for a, b in pairwise(TRAPEZE)]
    bars = trimesh.boolean.union([*frame, trimesh.creation.icosphere(3, 0.02)])
    panel = trimesh.creation.icosphere(5).apply_scale((0.5, 0.4, 0.01))
    for mesh in (bars.subdivide_to_size(0.03, max_iter=20), panel):
        mesh.merge_vertices()
        hulls = [manifold(h) for h in collision_hulls(mesh, tmp_path)]
        whole = manifold3d.Manifold.batch_boolean([h for h in hulls if h], manifold3d.OpType.Add)
        solid = manifold(mesh)
        assert solid and (solid - whole).volume() < 0.005 * solid.volume()
        assert whole.volume() < 2 * solid.volume()


@pytest.mark.parametrize("end", ["import os; os.abort()", "raise RuntimeError('no luck')"])
def test_when_the_decomposition_dies_the_convex_hull_stands_in(tmp_path: Path, monkeypatch, caplog, end: str):
    script = tmp_path / "dies.py"
    script.write_text(end)
    monkeypatch.setattr("hingesplat.export.solids.CONVEX", script)
    mesh = box((1, 1, 1), (0, 0, 0), (9, 9, 9))
    (hull,) = collision_hulls(mesh, tmp_path / "cache")
    assert hull.volume == pytest.approx(1.0)
    assert ("no luck" if "luck" in end else "exit code -6") in caplog.text


def gaudy_ball() -> trimesh.Trimesh:
    """Colours that change from vertex to vertex, and keep away from black and white."""
    ball = trimesh.creation.icosphere(2)
    rgb = 128 + 40 * ball.vertices
    ball.visual.vertex_colors = np.column_stack([rgb, np.full(len(rgb), 255)]).astype(np.uint8)
    return ball


def test_the_texture_shows_what_the_vertex_colours_do():
    ball = gaudy_ball()
    picture, uv = bake(ball)
    rng = np.random.default_rng(0)
    weights = rng.dirichlet([1, 1, 1], len(ball.faces))
    wanted = np.einsum("fc,fck->fk", weights, colours(ball)[ball.faces].astype(float))
    at = np.einsum("fc,fck->fk", weights, uv) * len(picture) - 0.5
    rows = len(picture) - 1 - at[:, 1]
    shown = np.stack([map_coordinates(picture[..., k].astype(float), [rows, at[:, 0]], order=1) for k in range(3)], 1)
    assert shown == pytest.approx(wanted, abs=0.6)
    # Half the size, it still shows each triangle its own colour, and at an eighth one much like it.
    small = np.asarray(Image.fromarray(picture).reduce(8)).reshape(-1, 3).astype(int)
    assert np.abs(np.diff(small, axis=0)).mean() < 25


def test_an_obj_keeps_its_colours(tmp_path: Path):
    ball = gaudy_ball()
    for name, content in obj_files(ball, "ball").items():
        (tmp_path / name).write_bytes(content)
    rows = [line.split() for line in (tmp_path / "ball.obj").read_text().splitlines()]
    vertex = np.array([[float(x) for x in r[4:]] for r in rows if r[0] == "v"])
    assert vertex == pytest.approx(colours(ball) / 255, abs=1e-3)
    textured = trimesh.load(tmp_path / "ball.obj")
    assert textured.is_watertight or textured.volume == pytest.approx(ball.volume, rel=1e-5)
    nearest = KDTree(ball.vertices).query(textured.vertices)[1]
    assert colours(textured) == pytest.approx(colours(ball)[nearest], abs=2)


def finished_run(cabinet: Made, folder: Path) -> Path:
    """A run folder with what an export reads."""
    twin, meshes = cabinet
    (folder / "parts").mkdir(parents=True)
    parts = []
    for part in twin.parts:
        meshes[part.id].export(folder / "parts" / f"{part.id}.glb")
        parts.append(replace(part, mesh=f"parts/{part.id}.glb"))
    replace(twin, parts=tuple(parts)).save(folder / "twin.json")
    gaussians = random_gaussians(25, 1)
    gaussians.with_part(torch.arange(25) // 5).save(folder / "gaussians.safetensors")
    (folder / "stages.json").write_text("{}")
    return folder


def test_the_command_writes_checks_and_writes_again(cabinet: Made, tmp_path: Path, capfd):
    pytest.importorskip("mujoco")
    run = finished_run(cabinet, tmp_path / "run")
    assert cli.main(["export", str(run), "--format", "mjcf", "ply", "--up-axis", "y", "--scale", "3"]) == 0
    out, err = capfd.readouterr()
    assert "mjcf in MuJoCo" in out and "4 joints, worst tracking error" in out and err == ""
    note = json.loads((run / "export" / "mjcf" / "export.json").read_text())
    assert (note["up_axis"], note["scale"], note["density"]) == ("y", 3, 500)
    whole, door = (read_ply(run / "export" / "ply" / f"{name}.ply") for name in ("twin", "door"))
    assert len(whole) == 25 and len(door) == 5
    wanted = 3 * random_gaussians(25, 1).means.numpy() @ UP["y"].T
    assert whole.means.numpy() == pytest.approx(wanted, abs=1e-5)
    assert cli.main(["export", str(run), "--format", "ply", "--no-check"]) == 0  # An export may be replaced.
    assert "MuJoCo" not in capfd.readouterr().out
    assert read_ply(run / "export" / "ply" / "twin.ply").means.numpy() == pytest.approx(wanted @ UP["y"] / 3, abs=1e-5)
    assert sorted(p.name for p in (run / "export").iterdir()) == [".hulls", "mjcf", "ply"]


BAD = {
    "no run": (lambda run: shutil.rmtree(run), [], "no such run folder"),
    "no joints yet": (lambda run: (run / "twin.json").unlink(), [], "not finished"),
    "no meshes yet": (lambda run: edit(run / "twin.json"), [], "not finished"),
    "a mesh is gone": (lambda run: (run / "parts" / "1.glb").unlink(), [], "1.glb"),
    "unknown format": (lambda run: None, ["--format", "urdf", "fbx"], "unknown 'fbx'; use urdf, mjcf, usd"),
    "a file in the way": (lambda run: (run / "export").write_text(""), [], "in the way"),
    "a folder in the way": (lambda run: (run / "export" / "mjcf" / "x").mkdir(parents=True), [], "in the way"),
    "no density": (lambda run: None, ["--density", "0"], "density"),
    "no number": (lambda run: None, ["--scale", "nan"], "scale"),
}


def edit(path: Path) -> None:
    data = json.loads(path.read_text())
    for part in data["parts"]:
        part["mesh"] = None
    path.write_text(json.dumps(data))


@pytest.mark.parametrize("name", BAD)
def test_bad_input_gets_one_clear_line(name: str, cabinet: Made, tmp_path: Path, capfd):
    spoil, options, word = BAD[name]
    spoil(run := finished_run(cabinet, tmp_path / "run"))
    assert cli.main(["export", str(run), *options]) == 2
    out, err = capfd.readouterr()
    assert err.startswith("hingesplat: ") and err.count("\n") == 1 and out == ""
    assert word in err
    assert not list(run.glob("export/*/twin.*"))


def test_a_mesh_that_cannot_be_closed_is_named_and_the_export_goes_on(cabinet: Made, tmp_path: Path, capfd):
    pytest.importorskip("mujoco")
    run = finished_run(cabinet, tmp_path / "run")
    torn = cabinet[1][1].copy()
    torn.update_faces(np.arange(12) > 1)
    torn.export(run / "parts" / "1.glb")
    assert cli.main(["export", str(run), "--format", "mjcf"]) == 0
    out, err = capfd.readouterr()
    assert err == "hingesplat: door: its mesh does not close; its convex hull stands in\n"
    assert "mjcf in MuJoCo" in out and "4 joints" in out and "warnings: none" in out


def test_a_check_that_fails_is_heard(capfd):
    show_check(Console(), "mjcf", Check("MuJoCo 0", 2, 31.4, ("base and door",)))
    show_check(Console(), "usd", Check("UsdValidation 0", 2, warnings=("no root",)))
    out, err = capfd.readouterr()
    assert "contacts: base and door" in out and "warnings: 1" in out
    assert "misses its end by 31 %" in err and "usd in UsdValidation 0: no root" in err


def test_formats_without_their_package_say_so(cabinet: Made, tmp_path: Path, hulls: Path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gaussforge", None)
    with pytest.raises(HingesplatError, match=r"hingesplat\[splats\]"):
        export(cabinet, tmp_path, "sog", hulls)
    assert not (tmp_path / "sog").exists()


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


def from_gaussforge(path: Path, T_mesh_file: np.ndarray) -> Gaussians:
    """A splat file read by gaussforge, put where the meshes are."""
    gaussforge = pytest.importorskip("gaussforge")
    ply = gaussforge.GaussForge().convert(path.read_bytes(), path.suffix[1:], "ply")["data"]
    path.with_suffix(".back.ply").write_bytes(ply)
    found = read_ply(path.with_suffix(".back.ply"))
    assert (T_mesh_file[:3, 3] == 0).all()
    return transformed(found, T_mesh_file[:3, :3])


@pytest.mark.parametrize("form", ["spz", "sog"])
@pytest.mark.parametrize("size", [0.05, 1.0, 300.0])
def test_splats_come_back_from_spz_and_sog(cabinet: Made, tmp_path: Path, hulls: Path, form: str, size: float):
    pytest.importorskip("gaussforge")
    n = 300
    before = random_gaussians(n, 0)
    before = replace(before, means=size * (before.means + 7), log_scales=0.3 * before.log_scales + np.log(0.01 * size))
    before = before.with_part(torch.arange(n) % 5)
    out = export_twin(*cabinet, before, tmp_path, [form], cache=hulls)[form].parent
    T_mesh_file = np.array(json.loads((out / "export.json").read_text())["T_mesh_file"])
    for name, part in [("twin", before), *((NAMES[i], before[before.part == i]) for i in range(5))]:
        after = from_gaussforge(out / f"{name}.{form}", T_mesh_file)
        assert len(after) == len(part)
        extent = float(np.ptp(before.means.numpy(), axis=0).max())
        off, order = KDTree(after.means.numpy()).query(part.means.numpy())  # SOG sorts.
        assert sorted(order) == list(range(len(part)))
        # SPZ keeps 23 bits; SOG 16 of a logarithm.
        assert off.max() < (2e-6 if form == "spz" else 3e-4) * extent
        after = after[torch.from_numpy(order)]
        assert (after.log_scales - part.log_scales).abs().max() < (0.04 if form == "spz" else 0.2)
        same_turn = (after.quats * part.quats).sum(1).abs() / after.quats.norm(dim=1)
        assert same_turn.min() > 0.999
    if form == "spz":
        assert np.linalg.det(T_mesh_file[:3, :3]) > 0 and T_mesh_file[1, 1] < 0 < T_mesh_file[0, 0]


def test_turned_gaussians_show_the_same_colours_from_turned_directions():
    before = random_gaussians(40, 3)
    R = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.5, 0.9]))[:3, :3]
    after = transformed(before, R, 2.0)
    turn = torch.from_numpy(R).float()
    seen = torch.nn.functional.normalize(torch.randn(40, 3), dim=1)
    assert torch.allclose(sh_to_rgb(after.sh, seen @ turn.T), sh_to_rgb(before.sh, seen), atol=1e-4)
    assert torch.allclose(after.means, 2 * before.means @ turn.T, atol=1e-5)
    back = transformed(after, R.T, 0.5)
    assert torch.allclose(back.sh, before.sh, atol=1e-4)
    assert torch.allclose(back.log_scales, before.log_scales, atol=1e-5)
    assert torch.allclose((back.quats * before.quats).sum(1).abs(), torch.ones(40), atol=1e-5)


def test_every_format_is_written_and_moves_as_a_folder(cabinet: Made, tmp_path: Path, hulls: Path):
    for package in ("pxr", "gaussforge"):
        pytest.importorskip(package)
    paths = export_twin(*cabinet, random_gaussians(5, 0), tmp_path, FORMATS, cache=hulls)
    assert list(paths) == list(FORMATS)
    for form, path in paths.items():
        assert path.is_file() and path.parent == tmp_path / form and (path.parent / "export.json").is_file()
        for file in path.parent.rglob("*"):
            assert file.suffix in {".spz", ".sog", ".ply", ".usd", ".png"} | {
                ".obj", ".mtl", ".json", ".xml", ".urdf", ".sdf", ".config", ""
            }  # fmt: skip
            if file.is_file():
                assert str(tmp_path).encode() not in file.read_bytes()
    assert not list(tmp_path.rglob("*.tmp*"))


def drawers(gap: float, reach: tuple[float, float], states: tuple[float, float]) -> Made:
    """Two drawers with wide fronts, one above the other's way: they slide towards each other."""
    meshes = {
        0: box((1, 0.2, 0.2), (0, 0.5, 0), (180, 140, 100)),
        1: box((0.2, 0.2, 0.2), (-0.1 - gap / 2, 0, 0), (200, 40, 40)),
        2: box((0.2, 0.2, 0.2), (0.1 + gap / 2, 0, 0), (40, 40, 200)),
    }
    joints = tuple(
        Joint(i, 0, "prismatic", (x, 0.0, 0.0), (0.0, 0.0, 0.0), states, reach) for i, x in ((1, 1.0), (2, -1.0))
    )
    return Twin(tuple(Part(i, f"p{i}", 5) for i in range(3)), joints), meshes


@pytest.mark.parametrize("scale", [1.0, 2.5])
@pytest.mark.parametrize(
    ("reach", "states", "meet"),
    [
        ((0.0, 0.2), (0.0, 0.1), True),  # In a photographed state.
        ((0.0, 0.2), (0.0, 0.02), True),  # Beyond both, where the limits let them go.
        ((0.0, 0.05), (0.0, 0.02), False),
    ],
)
def test_parts_whose_ways_cross_pass_through_each_other(
    tmp_path: Path, scale: float, reach, states, meet: bool
) -> None:
    links = build_links(*drawers(0.2, reach, states), ExportConfig(scale=scale), tmp_path)
    pose = links[1].pose(lambda link: link.joint.states[1] if link.joint else 0.0)
    np.testing.assert_allclose(pose[:3, 3], [states[1] * scale, 0, 0], atol=1e-12)
    pairs = {frozenset((a.name, b.name)) for a, b in touching(links)}
    assert (frozenset(("p1", "p2")) in pairs) == meet
    assert {frozenset(("base", "p1")), frozenset(("base", "p2"))} <= pairs


def test_parts_that_pass_through_each_other_are_named_by_the_check(tmp_path: Path, capfd) -> None:
    pytest.importorskip("mujoco")
    # The one's way crosses where the other rests: with contacts it would be stopped at half of its range.
    made = drawers(0.1, (0.0, 0.2), (0.0, 0.05))
    path = export(made, tmp_path, "mjcf", tmp_path)
    (check,) = check_export("mjcf", path)
    assert check.ok and check.contacts == () and check.ignored == ("p1 and p2",)
    show_check(Console(), "mjcf", check)
    assert "may pass through each other, as their meshes meet: p1 and p2" in " ".join(capfd.readouterr().out.split())
    root = etree.parse(path)
    for exclude in root.findall("contact/exclude"):
        if exclude.get("body2") == "p2" and exclude.get("body1") == "p1":
            exclude.getparent().remove(exclude)
    root.write(path)
    (check,) = check_export("mjcf", path)
    assert not check.ok and check.error_percent > 10 and check.contacts == ("p1 and p2",)
