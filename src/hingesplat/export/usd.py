"""USD for Isaac Sim, Omniverse and whatever else reads UsdPhysics: meshes and Gaussians on one articulation.

The one file that may import pxr.
"""

# pyright: reportAttributeAccessIssue=false

from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from hingesplat.errors import HingesplatError
from hingesplat.export.links import Link, axis_load, joint_dynamics, servo_gain, touching
from hingesplat.export.solids import colours
from hingesplat.gaussians import Gaussians
from hingesplat.screw import axes_across

try:
    from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdPhysics, UsdValidation, UsdVol, Vt  # pyright: ignore[reportMissingImports]
except ImportError as e:
    raise HingesplatError("usd: needs the package usd-core; pip install 'hingesplat[usd]'") from e
if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
    raise HingesplatError("usd: needs usd-core 26.3 or later, which knows Gaussian splats; pip install -U usd-core")


def write_usd(links: list[Link], gaussians: Gaussians, out: Path, *, up_axis: str = "z") -> Path:
    """Write ``out/twin.usd``, one binary file with everything in it.

    ``/twin`` is the articulation; under ``/twin/links`` is an Xform a part (flat: USD nests no rigid bodies)
    with ``mesh``, ``hull_N`` (collision, guide) and ``splats``, all in the link's frame; under ``/twin/joints``
    the joints, each with a drive. Values are in state 0, angles in degrees.

    Args:
        links: parents first.
        gaussians: in the export's frame, part ids as in the twin.
        out: an existing folder.
        up_axis: z or y.

    Returns:
        The file's path.

    Raises:
        HingesplatError: when the module is imported: usd-core is absent or too old.
    """
    path = out / "twin.usd"
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, up_axis.upper())
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/twin").GetPrim()
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    UsdPhysics.ArticulationRootAPI.Apply(root)
    UsdGeom.Scope.Define(stage, "/twin/links")
    UsdGeom.Scope.Define(stage, "/twin/joints")
    for link in links:
        _add_link(stage, link, gaussians[gaussians.part == link.part.id])
    for link in links:
        _add_joint(stage, link, links)
    for a, b in touching(links):
        UsdPhysics.FilteredPairsAPI.Apply(stage.GetPrimAtPath(_path(a))).CreateFilteredPairsRel().AddTarget(_path(b))
    stage.Export(str(path))
    return path


def validate(path: Path) -> tuple[int, list[str]]:
    """The number of joints that move in a USD file, and what UsdValidation finds wrong with it."""
    stage = Usd.Stage.Open(str(path))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    kinds = (UsdPhysics.RevoluteJoint, UsdPhysics.PrismaticJoint)
    joints = sum(any(prim.IsA(kind) for kind in kinds) for prim in stage.Traverse())
    return joints, [f"{e.GetName()}: {' '.join(e.GetMessage().split())}" for e in errors]


def _path(link: Link) -> Sdf.Path:
    return Sdf.Path(f"/twin/links/{link.name}")


def _add_link(stage: Usd.Stage, link: Link, gaussians: Gaussians) -> None:
    xform = UsdGeom.Xform.Define(stage, _path(link))
    xform.AddTranslateOp().Set(Gf.Vec3d(*link.origin.tolist()))
    UsdPhysics.RigidBodyAPI.Apply(xform.GetPrim())
    moments, axes = np.linalg.eigh(link.inertia)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    mass = UsdPhysics.MassAPI.Apply(xform.GetPrim())
    mass.CreateMassAttr(link.mass)
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*link.com.tolist()))
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments.tolist()))
    mass.CreatePrincipalAxesAttr(_quat(axes))
    if link.mesh is not None:
        mesh = _add_mesh(stage, _path(link).AppendChild("mesh"), link.mesh)
        rgb = np.ascontiguousarray(colours(link.mesh) / 255, np.float32)
        mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(rgb))
    for i, hull in enumerate(link.hulls):
        mesh = _add_mesh(stage, _path(link).AppendChild(f"hull_{i}"), hull)
        mesh.CreatePurposeAttr(UsdGeom.Tokens.guide)
        UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
        UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
    if len(gaussians):
        _add_splats(stage, _path(link).AppendChild("splats"), gaussians, link.origin)


def _add_mesh(stage: Usd.Stage, path: Sdf.Path, mesh: trimesh.Trimesh) -> Any:
    prim = UsdGeom.Mesh.Define(stage, path)
    points = np.ascontiguousarray(mesh.vertices, np.float32)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces.ravel(), np.int32)))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)])))
    return prim


def _add_splats(stage: Usd.Stage, path: Sdf.Path, gaussians: Gaussians, origin: np.ndarray) -> None:
    g = gaussians.detached()
    means = (g.means.double() - torch.from_numpy(origin)).float()
    unit = torch.nn.functional.normalize(g.quats, dim=1)
    splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, path)

    def array(tensor: torch.Tensor) -> np.ndarray:
        return np.ascontiguousarray(tensor.cpu().numpy(), np.float32)

    splats.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(array(means)))
    splats.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(array(g.scales)))
    splats.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(array(unit[:, [1, 2, 3, 0]])))  # Columns xyzw.
    splats.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(array(g.opacities)))
    splats.CreateRadianceSphericalHarmonicsDegreeAttr(g.sh_degree)
    splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(array(g.sh.reshape(-1, 3))))
    reach = 3 * g.scales.amax(1, keepdim=True)
    extent = torch.stack([(means - reach).amin(0), (means + reach).amax(0)])
    splats.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(array(extent)))


def _add_joint(stage: Usd.Stage, link: Link, links: list[Link]) -> None:
    path = f"/twin/joints/{link.name}_joint"
    slides = link.joint is not None and link.joint.type == "prismatic"
    kind = UsdPhysics.FixedJoint
    if link.moves:
        kind = UsdPhysics.PrismaticJoint if slides else UsdPhysics.RevoluteJoint
    joint = kind.Define(stage, path)
    joint.CreateBody1Rel().SetTargets([_path(link)])
    if link.parent is not None:
        joint.CreateBody0Rel().SetTargets([_path(link.parent)])
    # All link frames are parallel in state 0, so one rotation takes x to the axis on both sides.
    turn = _quat(_x_to(np.asarray(link.joint.axis))) if link.joint is not None and link.moves else Gf.Quatf(1)
    joint.CreateLocalPos0Attr(Gf.Vec3f(*link.offset.tolist()))
    joint.CreateLocalPos1Attr(Gf.Vec3f(0))
    joint.CreateLocalRot0Attr(turn)
    joint.CreateLocalRot1Attr(turn)
    if not link.moves:
        return
    unit = 1.0 if slides else 180 / np.pi
    joint.CreateAxisAttr(UsdPhysics.Tokens.x)
    joint.CreateLowerLimitAttr(link.limits[0] * unit)
    joint.CreateUpperLimitAttr(link.limits[1] * unit)
    gain, (inertia, _) = servo_gain(link, links), axis_load(link, links)
    drive = UsdPhysics.DriveAPI.Apply(joint.GetPrim(), "linear" if slides else "angular")
    drive.CreateTypeAttr(UsdPhysics.Tokens.force)
    drive.CreateTargetPositionAttr(0.0)
    drive.CreateMaxForceAttr(joint_dynamics(link, links)["effort"])
    drive.CreateStiffnessAttr(gain / unit)
    drive.CreateDampingAttr(2 * (gain * inertia) ** 0.5 / unit)  # Critical.


def _x_to(axis: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) that takes x to a unit vector."""
    return np.column_stack([axis, *axes_across(axis)])


def _quat(R: np.ndarray) -> Gf.Quatf:
    w, x, y, z = trimesh.transformations.quaternion_from_matrix(R)
    return Gf.Quatf(float(w), float(x), float(y), float(z))
