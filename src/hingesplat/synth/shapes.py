"""Textured closed solids, put together from patches: small maps of a rectangle into space."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh

Texture = Callable[[np.ndarray, int], np.ndarray]
"""(points (n, 3) in the part's zero frame, face number) to sRGB colours (n, 3) in [0, 1]."""


@dataclass(frozen=True)
class Patch:
    """A piece of surface: the rectangle [0, size[0]] × [0, size[1]] mapped into the part's frame.

    ``at(s, t)`` takes arrays (n,) in model units to points (n, 3); ∂s × ∂t points outward.
    """

    at: Callable[[np.ndarray, np.ndarray], np.ndarray]
    size: tuple[float, float]
    """Lengths along s and t, model units."""
    cells: tuple[int, int]
    """Quads of the mesh along s and t; (1, 1) where the patch is flat."""
    texture: Texture
    face: int = 0
    """Given to the texture, so that the faces of one solid differ."""

    def mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (n, 3), their (s, t) (n, 2), and triangles (m, 3)."""
        a, b = self.cells
        s, t = np.meshgrid(np.linspace(0, self.size[0], a + 1), np.linspace(0, self.size[1], b + 1), indexing="ij")
        st = np.stack([s.ravel(), t.ravel()], 1)
        i = np.arange((a + 1) * (b + 1)).reshape(a + 1, b + 1)
        p00, p10, p11, p01 = (q.ravel() for q in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
        faces = np.concatenate([np.stack([p00, p10, p11], 1), np.stack([p00, p11, p01], 1)])
        return self.at(st[:, 0], st[:, 1]), st, faces

    def normals(self, s: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Outward unit normals (n, 3), by central differences."""
        e = 1e-4 * np.asarray(self.size)
        s, t = np.clip(s, 2 * e[0], self.size[0] - 2 * e[0]), np.clip(t, 2 * e[1], self.size[1] - 2 * e[1])
        ds = self.at(s + e[0], t) - self.at(s - e[0], t)
        dt = self.at(s, t + e[1]) - self.at(s, t - e[1])
        n = np.cross(ds, dt)
        return n / np.linalg.norm(n, axis=1, keepdims=True)


Solid = tuple[Patch, ...]
"""Patches that together close a volume."""


def solid_mesh(solid: Solid) -> trimesh.Trimesh:
    """The solid as one watertight mesh, model units."""
    vertices, _, faces = zip(*(p.mesh() for p in solid), strict=True)
    first = np.cumsum([0, *map(len, vertices)])
    numbered = np.concatenate([f + n for f, n in zip(faces, first, strict=False)])
    mesh = trimesh.Trimesh(np.concatenate(vertices), numbered, process=False)
    mesh.merge_vertices(digits_vertex=7)
    mesh.update_faces(mesh.nondegenerate_faces(height=1e-9))
    mesh.remove_unreferenced_vertices()
    return mesh


def _rectangle(corner: np.ndarray, u: np.ndarray, v: np.ndarray, texture: Texture, face: int) -> Patch:
    length_u, length_v = float(np.linalg.norm(u)), float(np.linalg.norm(v))
    du, dv = u / length_u, v / length_v
    return Patch(lambda s, t: corner + s[:, None] * du + t[:, None] * dv, (length_u, length_v), (1, 1), texture, face)


def box(low: tuple[float, float, float], high: tuple[float, float, float], texture: Texture) -> Solid:
    """An axis-aligned box; its faces are numbered −x, +x, −y, +y, −z, +z."""
    lo, hi = np.asarray(low, float), np.asarray(high, float)
    patches = []
    for face in range(6):
        axis, positive = divmod(face, 2)
        u, v = np.zeros(3), np.zeros(3)
        a, b = (axis + 1) % 3, (axis + 2) % 3
        u[a], v[b] = (hi - lo)[a], (hi - lo)[b]
        corner = lo.copy()
        if positive:
            corner[axis] = hi[axis]
        else:
            u, v = v, u
        patches.append(_rectangle(corner, u, v, texture, face))
    return tuple(patches)


def capsule(
    start: tuple[float, float, float], end: tuple[float, float, float], radius: float, texture: Texture
) -> Solid:
    """A rod with round ends; ``start`` and ``end`` are the centres of the two half spheres."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(b - a))
    w = (b - a) / length
    u = np.cross(w, np.eye(3)[np.argmin(np.abs(w))])
    u /= np.linalg.norm(u)
    v = np.cross(w, u)
    quarter = radius * np.pi / 2

    def at(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        around = s / radius
        cap = np.clip(quarter - t, 0, None) - np.clip(t - quarter - length, 0, None)  # Arc length into a cap.
        r = radius * np.cos(cap / radius)
        along = np.clip(t - quarter, 0, length) - radius * np.sin(cap / radius)
        ring = np.cos(around)[:, None] * u + np.sin(around)[:, None] * v
        return a + along[:, None] * w + r[:, None] * ring

    # Rows of the mesh have to meet the seams between rod and caps, or it would cut them off.
    rows = max(1, round(length / quarter * 5))
    knots = np.concatenate(
        [
            np.linspace(0, quarter, 6),
            quarter + np.linspace(0, length, rows + 1)[1:],
            quarter + length + np.linspace(0, quarter, 6)[1:],
        ]
    )
    total = 2 * quarter + length
    even = np.linspace(0, total, len(knots))
    return (
        Patch(
            lambda s, t: at(s, np.interp(t, even, knots)),
            (2 * np.pi * radius, total),
            (20, len(knots) - 1),
            texture,
        ),
    )
