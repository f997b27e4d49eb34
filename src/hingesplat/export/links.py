"""What every simulator writer needs: frames, inertia, collision hulls and mesh files of a twin's links."""

import hashlib
import logging
import re
from dataclasses import dataclass
from pathlib import Path

import coacd
import manifold3d
import numpy as np
import trimesh
from PIL import Image
from trimesh.exchange.obj import export_obj

from hingesplat.errors import HingesplatError
from hingesplat.twin import Joint, Part, Twin

GRAVITY = 9.81
_PALETTE_CELL = 8  # pixels a colour, so that no filter mixes neighbours

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Link:
    """One part as a rigid body, metres, kilograms.

    Its frame is parallel to the world's and lies, in state 0, at ``origin``: the joint's pivot (base: zero).
    """

    name: str
    part: Part
    joint: Joint | None
    parent: "Link | None"
    origin: np.ndarray
    """(3,) in the world frame of state 0."""
    mesh: trimesh.Trimesh | None
    """In the link frame."""
    hulls: tuple[trimesh.Trimesh, ...]
    """Convex, in the link frame."""
    mass: float
    com: np.ndarray
    """(3,) in the link frame."""
    inertia: np.ndarray
    """(3, 3) about the centre of mass, link axes."""
    colour: tuple[float, float, float]
    """Mean rgb in [0, 1]."""
    limits: tuple[float, float]
    """Radians or metres."""

    @property
    def offset(self) -> np.ndarray:
        """(3,) origin in the parent's frame."""
        return self.origin if self.parent is None else self.origin - self.parent.origin

    @property
    def moves(self) -> bool:
        return self.joint is not None and self.joint.type != "fixed"


def build_links(
    twin: Twin, meshes: dict[int, trimesh.Trimesh], out: Path, *, density: float = 500.0, scale: float = 1.0
) -> list[Link]:
    """Links of a twin, parents first; writes ``out/meshes/`` and ``out/collision/``.

    Args:
        twin: parts and joints, frame of state 0.
        meshes: closed part meshes by part id, frame of state 0, scene units; without one, a token mass.
        out: the folder to write into.
        density: kg/m³.
        scale: metres per scene unit.

    Raises:
        HingesplatError: a joint names a parent that does not exist, or the joints form a loop.
    """
    order = _parents_first(twin)
    (out / "meshes").mkdir(parents=True, exist_ok=True)
    (out / "collision").mkdir(parents=True, exist_ok=True)
    names = _unique_names(twin)
    links: dict[int, Link] = {}
    for part in order:
        joint = twin.joint_of(part.id)
        # A part without a joint is held by the base, which is the root.
        parent = links.get(joint.parent if joint else 0)
        links[part.id] = _link(names[part.id], part, joint, parent, meshes.get(part.id), out, density, scale)
    return list(links.values())


def axis_load(link: Link, links: list[Link]) -> tuple[float, float]:
    """What the joint of a link carries in state 0, descendants included.

    Returns:
        Inertia along the joint (kg; kg·m² for a hinge) and the most that gravity can weigh on it (N; N·m).
    """
    assert link.joint is not None
    axis = np.asarray(link.joint.axis)
    slides = link.joint.type == "prismatic"
    inertia = weight = 0.0
    for other in links:
        above: Link | None = other
        while above is not None and above is not link:
            above = above.parent
        if above is None:
            continue
        arm = np.cross(axis, other.origin + other.com - link.origin)
        inertia += other.mass if slides else float(other.mass * arm @ arm + axis @ other.inertia @ axis)
        weight += GRAVITY * other.mass * (1.0 if slides else float(np.linalg.norm(arm)))
    return inertia, weight


def servo_gain(link: Link, links: list[Link]) -> float:
    """Position gain (N/m; N·m/rad): gravity shifts the joint by 0.5 % of its range at most.

    Bounded below (60 rad/s) so that every joint answers briskly, above (250 rad/s) for stable 2 ms steps.
    """
    inertia, weight = axis_load(link, links)
    span = max(link.limits[1] - link.limits[0], 1e-4)
    rate = np.clip(np.sqrt(weight / (0.005 * span * inertia)), 60.0, 250.0)
    return float(inertia * rate**2)


def numbers(values: object) -> str:
    """Numbers separated by spaces, as XML attributes want them."""
    return " ".join(f"{v:.9g}" for v in np.asarray(values, float).ravel() + 0.0)


def write_text(path: Path, text: str) -> Path:
    """Write a file whole or not at all."""
    tmp = path.with_name(path.name + ".tmp")
    tmp.write_text(text)
    tmp.replace(path)
    return path


def collision_hulls(mesh: trimesh.Trimesh, cache: Path, *, most: int = 12) -> tuple[trimesh.Trimesh, ...]:
    """Convex pieces that cover a mesh (CoACD, seeded); its one convex hull where that fails.

    ``cache`` is a folder of ``HASH.npz`` files: the same mesh is cut only once.
    """
    vertices = np.ascontiguousarray(mesh.vertices, np.float64)
    faces = np.ascontiguousarray(mesh.faces, np.int32)
    key = hashlib.sha256(vertices.tobytes() + faces.tobytes() + bytes([most])).hexdigest()[:16]
    file = cache / f"{key}.npz"
    if file.is_file():
        with np.load(file, allow_pickle=False) as data:
            return tuple(trimesh.convex.convex_hull(data[name]) for name in sorted(data.files))
    coacd.set_log_level("error")
    try:
        pieces = coacd.run_coacd(
            _coarse(vertices, faces),
            threshold=0.1,
            max_convex_hull=most,
            preprocess_mode="off",
            resolution=500,
            mcts_nodes=8,
            mcts_iterations=20,
            mcts_max_depth=2,
            seed=0,
        )
        hulls = [trimesh.convex.convex_hull(points) for points, _ in pieces]
    except (RuntimeError, ValueError, AssertionError) as e:
        log.warning("convex decomposition failed (%s); the convex hull stands in", e)
        hulls = []
    hulls = [h for h in hulls if h.is_watertight and h.volume > 1e-9 * np.ptp(vertices, axis=0).max() ** 3]
    hulls = hulls or [mesh.convex_hull]
    tmp = file.with_name(file.stem + ".tmp.npz")
    np.savez(tmp, **{f"{i:03d}": h.vertices for i, h in enumerate(hulls)})
    tmp.replace(file)
    return tuple(hulls)


def _coarse(vertices: np.ndarray, faces: np.ndarray) -> coacd.Mesh:
    """The mesh simplified to 1.5 % of its size, ten times faster to cut; unchanged if it is no manifold."""
    solid = manifold3d.Manifold(manifold3d.Mesh(vertices.astype(np.float32), faces.astype(np.uint32)))
    coarse = solid.simplify(0.015 * float(np.ptp(vertices, axis=0).max())).to_mesh()
    if len(coarse.tri_verts) == 0:
        return coacd.Mesh(vertices, faces)
    points = np.asarray(coarse.vert_properties, np.float64)[:, :3]
    return coacd.Mesh(points, np.asarray(coarse.tri_verts, np.int32))


def write_obj(mesh: trimesh.Trimesh, path: Path) -> None:
    """Write an OBJ that shows its colours everywhere: per vertex, and per face through a palette texture.

    ``NAME.png`` and ``NAME.mtl`` beside it hold the palette, for programs without vertex colours (MuJoCo).
    """
    vertex = np.asarray(mesh.visual.vertex_colors)[:, :3]  # type: ignore[union-attr]
    face = vertex[mesh.faces].mean(1).round().astype(np.uint8)
    image = Image.fromarray(face[None]).quantize(256, dither=Image.Dither.NONE)
    entry = np.asarray(image)[0].astype(int)
    palette = np.zeros((256, 3), np.uint8)
    known = np.asarray(image.getpalette(), np.uint8).reshape(-1, 3)
    palette[: len(known)] = known
    picture = palette.reshape(16, 16, 3).repeat(_PALETTE_CELL, 0).repeat(_PALETTE_CELL, 1)
    Image.fromarray(picture).save(path.with_suffix(".png"))
    write_text(path.with_suffix(".mtl"), f"newmtl {path.stem}\nKd 1 1 1\nKs 0 0 0\nmap_Kd {path.stem}.png\n")
    cells = np.arange(256)
    uv = np.column_stack([(cells % 16 + 0.5) / 16, 1 - (cells // 16 + 0.5) / 16])
    lines = [f"mtllib {path.stem}.mtl", f"usemtl {path.stem}"]
    lines += [
        f"v {x:.7g} {y:.7g} {z:.7g} {r:.4g} {g:.4g} {b:.4g}"
        for (x, y, z), (r, g, b) in zip(mesh.vertices, vertex / 255, strict=True)
    ]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in uv]
    lines += [f"f {a}/{t} {b}/{t} {c}/{t}" for (a, b, c), t in zip(mesh.faces + 1, entry + 1, strict=True)]
    write_text(path, "\n".join(lines) + "\n")


def _link(
    name: str,
    part: Part,
    joint: Joint | None,
    parent: Link | None,
    mesh: trimesh.Trimesh | None,
    out: Path,
    density: float,
    scale: float,
) -> Link:
    origin = np.zeros(3) if joint is None else scale * np.asarray(joint.pivot, float)
    limits = joint.limits if joint else (0.0, 0.0)
    if joint and joint.type == "prismatic":
        limits = (scale * limits[0], scale * limits[1])
    if mesh is None:
        token = np.eye(3) * 1e-6
        return Link(name, part, joint, parent, origin, None, (), 1e-3, np.zeros(3), token, (0.5, 0.5, 0.5), limits)
    local = mesh.copy()
    local.apply_scale(scale)
    local.apply_translation(-origin)
    write_obj(local, out / "meshes" / f"{name}.obj")
    # Hulls are cached in the frame of state 0, so that a moved pivot does not cut the mesh anew.
    hulls = [h.copy() for h in collision_hulls(mesh, out / "collision")]
    for number, hull in enumerate(hulls):
        hull.apply_scale(scale)
        hull.apply_translation(-origin)
        write_text(out / "collision" / f"{name}_{number}.obj", export_obj(hull))
    solid = local if local.is_watertight and local.volume > 0 else local.convex_hull
    solid.density = density
    inertia = np.asarray(solid.moment_inertia)
    inertia = (inertia + inertia.T) / 2
    colour = np.asarray(mesh.visual.vertex_colors)[:, :3].mean(0) / 255  # type: ignore[union-attr]
    rgb = (float(colour[0]), float(colour[1]), float(colour[2]))
    com = np.asarray(solid.center_mass)
    return Link(name, part, joint, parent, origin, local, tuple(hulls), float(solid.mass), com, inertia, rgb, limits)


def _parents_first(twin: Twin) -> list[Part]:
    """The parts of a twin, each after the one it hangs from."""
    order: list[Part] = []
    waiting = list(twin.parts)
    while waiting:
        known = {p.id for p in order}
        ready = [p for p in waiting if (joint := twin.joint_of(p.id)) is None or joint.parent in known]
        if not ready:
            raise HingesplatError(f"twin: part {waiting[0].id} hangs from no base; mend joints[].parent in twin.json")
        order += sorted(ready, key=lambda p: p.id)
        waiting = [p for p in waiting if p not in ready]
    return order


def _unique_names(twin: Twin) -> dict[int, str]:
    """Names fit for files and XML; the base is ``base``."""
    names: dict[int, str] = {}
    for part in twin.parts:
        name = "base" if part.id == 0 else re.sub(r"\W+", "_", part.name).strip("_") or f"part_{part.id}"
        names[part.id] = f"{name}_{part.id}" if name in names.values() else name
    return names
