"""Solids out of part meshes: closed, cut into convex pieces, and swept to where they meet something."""

import hashlib
import json
import logging
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import manifold3d
import numpy as np
import trimesh
from scipy.spatial import KDTree, QhullError
from trimesh.visual import ColorVisuals, TextureVisuals

from hingesplat.files import whole_file

COARSE, THIN = 0.015, 0.25
"""Of a mesh's size, and of how thick it is: what may be shaved off where only the rough shape counts."""

log = logging.getLogger(__name__)


def colours(mesh: trimesh.Trimesh) -> np.ndarray:
    """(n, 3) uint8, one a vertex."""
    visual = mesh.visual.to_color() if isinstance(mesh.visual, TextureVisuals) else mesh.visual
    return np.asarray(visual.vertex_colors)[:, :3]  # type: ignore[union-attr]


def manifold(mesh: trimesh.Trimesh) -> manifold3d.Manifold | None:
    """The mesh as a solid; None where it is not closed, not 2-manifold, or holds no volume."""
    points, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)
    solid = manifold3d.Manifold(manifold3d.Mesh(points, faces))
    good = solid.status() == manifold3d.Error.NoError and not solid.is_empty() and solid.volume() > 0
    return solid if good else None


def closed_mesh(mesh: trimesh.Trimesh, name: str, max_triangles: int) -> trimesh.Trimesh | None:
    """A watertight 2-manifold of at most ``max_triangles`` with the mesh's colours, a vertex each.

    Where the mesh cannot be closed its convex hull stands in, and where that has no volume nothing does; the
    log names the part.
    """
    solid = manifold(mesh)
    if solid is not None and len(mesh.faces) <= max_triangles:
        return mesh
    if solid is None:
        merged = mesh.copy()
        merged.merge_vertices(merge_tex=True, merge_norm=True)
        merged.fix_normals()
        solid = manifold(merged)
    if solid is None:
        with suppress(QhullError, ValueError, IndexError):
            solid = manifold(mesh.convex_hull)
        if solid is None:
            log.warning("%s: its mesh is flat; it goes without a shape", name)
            return None
        log.warning("%s: its mesh does not close; its convex hull stands in", name)
    tolerance = 1e-4 * float(np.ptp(mesh.vertices, axis=0).max())
    while solid.num_tri() > max_triangles:
        solid = solid.simplify(tolerance)
        tolerance *= 1.5
    out = _as_trimesh(solid)
    nearest = KDTree(mesh.vertices).query(out.vertices)[1]
    out.visual = ColorVisuals(out, vertex_colors=colours(mesh)[nearest])
    return out


DECOMPOSITION: dict[str, Any] = dict(
    threshold=0.1,
    preprocess_mode="off",
    resolution=500,
    mcts_nodes=8,
    mcts_iterations=10,
    mcts_max_depth=1,
    seed=0,
)
"""How CoACD cuts: a look one cut ahead is a third faster than two, and its pieces fit no worse."""


CONVEX = Path(__file__).with_name("convex.py")


def collision_hulls(mesh: trimesh.Trimesh, cache: Path, *, most: int = 12) -> tuple[trimesh.Trimesh, ...]:
    """Convex pieces that cover a closed mesh (CoACD, seeded, on a coarse copy); its one convex hull where that fails.

    ``cache`` is a folder of ``HASH.npz`` files: the same mesh is cut only once in the same way.
    """
    vertices = np.ascontiguousarray(mesh.vertices, np.float64)
    faces = np.ascontiguousarray(mesh.faces, np.int32)
    how = f"{most} {COARSE} {THIN} {DECOMPOSITION}".encode()
    key = hashlib.sha256(vertices.tobytes() + faces.tobytes() + how).hexdigest()[:16]
    file = cache / f"{key}.npz"
    with suppress(OSError, ValueError, EOFError), np.load(file, allow_pickle=False) as data:
        return tuple(_as_trimesh(manifold3d.Manifold.hull_points(data[name])) for name in sorted(data.files))
    least = 1e-9 * np.ptp(vertices, axis=0).max() ** 3  # Some pieces are flat.
    solids = [manifold3d.Manifold.hull_points(points) for points in _convex_pieces(mesh, most)]
    hulls = [_as_trimesh(solid) for solid in solids if solid.volume() > least]
    hulls = _covering(hulls, vertices) if hulls else [mesh.convex_hull]
    with suppress(OSError):  # A folder that cannot be written costs only time.
        cache.mkdir(parents=True, exist_ok=True)
        with whole_file(file) as tmp, tmp.open("wb") as opened:  # Given a name, savez would add a suffix.
            np.savez(opened, allow_pickle=False, **{f"{i:03d}": h.vertices for i, h in enumerate(hulls)})
    return tuple(hulls)


def _convex_pieces(mesh: trimesh.Trimesh, most: int) -> list[np.ndarray]:
    """Vertices (n, 3) of each piece; none, and a warning, where CoACD fails.

    Where it fails on the mesh as it is, it gets the mesh remeshed by itself.
    """
    coarse = _as_trimesh(_coarse(mesh))
    told = ""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "mesh.npz", Path(folder) / "pieces.npz"
        for more in ({}, {"preprocess_mode": "on", "preprocess_resolution": 40}):
            options = json.dumps(DECOMPOSITION | {"max_convex_hull": most} | more)
            vertices, faces = np.asarray(coarse.vertices, np.float64), np.asarray(coarse.faces, np.int32)
            np.savez(source, allow_pickle=False, vertices=vertices, faces=faces, options=options)
            done = subprocess.run([sys.executable, CONVEX, source, target], capture_output=True, text=True)
            if done.returncode == 0:
                with np.load(target, allow_pickle=False) as data:
                    return [data[name] for name in data.files]
            told = done.stderr.strip().rpartition("\n")[2] or f"exit code {done.returncode}"
    log.warning("convex decomposition failed (%s); the convex hull stands in", told)
    return []


def _covering(hulls: Sequence[trimesh.Trimesh], points: np.ndarray) -> list[trimesh.Trimesh]:
    """The hulls, each with those of the points (n, 3) outside of all that stick out of it the least."""
    facets = [(h.face_normals, (h.face_normals * h.triangles[:, 0]).sum(1)) for h in hulls]
    out = np.stack([(points @ normals.T - offsets).max(1) for normals, offsets in facets])
    nearest = np.where(out.min(0) > 0, out.argmin(0), -1)
    grown = (np.concatenate([h.vertices, points[nearest == k]]) for k, h in enumerate(hulls))
    return [_as_trimesh(manifold3d.Manifold.hull_points(p)) for p in grown]


def free_range(
    moving: Sequence[trimesh.Trimesh],
    standing: Sequence[trimesh.Trimesh],
    pose: Callable[[float], np.ndarray],
    limits: tuple[float, float],
    most: tuple[float, float],
    step: float,
) -> tuple[float, float]:
    """How far a joint may go until what it moves enters what stands.

    Overlaps of the observed range are the noise of the meshes: what exceeds them by more than 0.2 % of the
    moving volume is a collision.

    Args:
        moving, standing: closed meshes, where joint value 0 puts them.
        pose: joint value to the 4×4 that moves ``moving``.
        limits: observed range.
        most: never go beyond these.
        step: of the search; the limit found is finer (1/16 of it).

    Returns:
        A range that contains ``limits``.
    """
    movers, walls = [_coarse(m) for m in moving], [_coarse(m) for m in standing]

    def overlap(value: float) -> float:
        T = pose(value)[:3]
        return sum((m.transform(T) ^ wall).volume() for m in movers for wall in walls)

    allowed = max(overlap(v) for v in np.linspace(*limits, 9)) + 0.002 * sum(m.volume() for m in movers)

    def reach(start: float, end: float) -> float:
        size = step if end > start else -step
        free = start
        while abs(end - free) > 1e-9:
            following = free + size if abs(end - free) > step else end
            if overlap(following) > allowed:
                for _ in range(4):
                    middle = (free + following) / 2
                    free, following = (middle, following) if overlap(middle) <= allowed else (free, middle)
                break
            free = following
        return free

    return reach(limits[0], min(most[0], limits[0])), reach(limits[1], max(most[1], limits[1]))


def near(a: Sequence[manifold3d.Manifold], b: Sequence[manifold3d.Manifold], gap: float) -> bool:
    """Whether a piece of one comes nearer than ``gap`` to one of the other."""
    boxes = [np.array([p.bounding_box() for p in pieces]) for pieces in (a, b)]
    low, high = (box[:, :3] for box in boxes), (box[:, 3:] for box in boxes)
    (low_a, low_b), (high_a, high_b) = low, high
    close = ((low_a[:, None] - gap < high_b) & (low_b - gap < high_a[:, None])).all(-1)
    return any(a[i].min_gap(b[j], gap) < gap for i, j in np.argwhere(close))


def _coarse(mesh: trimesh.Trimesh) -> manifold3d.Manifold:
    """A closed mesh simplified, ten times faster to cut and to sweep."""
    solid = manifold(mesh)
    assert solid is not None
    thickness = 2 * solid.volume() / solid.surface_area()
    coarse = solid.simplify(min(COARSE * float(np.ptp(mesh.vertices, axis=0).max()), THIN * thickness))
    return solid if coarse.is_empty() else coarse


def _as_trimesh(solid: manifold3d.Manifold) -> trimesh.Trimesh:
    out = solid.to_mesh()
    return trimesh.Trimesh(np.asarray(out.vert_properties)[:, :3], np.asarray(out.tri_verts), process=False)
