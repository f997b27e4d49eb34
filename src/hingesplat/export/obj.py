"""OBJ files that show their colours everywhere: a vertex each, and baked into a texture."""

from io import BytesIO

import numpy as np
import trimesh
from PIL import Image

from hingesplat.export.solids import colours


def obj_files(mesh: trimesh.Trimesh, name: str) -> dict[str, bytes]:
    """A coloured mesh as ``name.obj`` with the files that belong beside it, the texture being what ``bake`` makes."""
    rgb = colours(mesh)
    picture, uv = bake(mesh)
    png = BytesIO()
    Image.fromarray(picture).save(png, "PNG")
    material = f"newmtl {name}\nKd 1 1 1\nKs 0 0 0\nmap_Kd {name}.png\n"
    lines = [f"mtllib {name}.mtl", f"usemtl {name}"]
    lines += [
        f"v {x:.7g} {y:.7g} {z:.7g} {r:.4g} {g:.4g} {b:.4g}"
        for (x, y, z), (r, g, b) in zip(
            mesh.vertices.tolist(), (rgb / 255).tolist(), strict=True
        )  # floats of Python format fast
    ]
    lines += [f"vt {u:.5f} {v:.5f}" for u, v in uv.reshape(-1, 2).tolist()]
    lines += [
        f"f {a}/{3 * i + 1} {b}/{3 * i + 2} {c}/{3 * i + 3}" for i, (a, b, c) in enumerate((mesh.faces + 1).tolist())
    ]
    text = "\n".join(lines) + "\n"
    return {f"{name}.png": png.getvalue(), f"{name}.mtl": material.encode(), f"{name}.obj": text.encode()}


def bake(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertex colours as a texture.

    Every triangle has 2 × 2 texels of its own and its corners lie on the centres of three of them, so that
    bilinear filtering gives what interpolating the vertex colours gives. Triangles that are near in space lie
    near in the picture (both along Z-curves), so that smaller versions of it mix neighbours.

    Returns:
        Picture (side, side, 3) uint8, and texture coordinates (m, 3, 2) of the faces' corners, v upwards.
    """
    corner = colours(mesh)[mesh.faces].astype(int)
    n = len(corner)
    bits = int(np.ceil(np.log2(max(n, 1)) / 2))
    centre = mesh.triangles.mean(1)
    span = max(float(np.ptp(centre, axis=0).max()), 1e-12) if n else 1.0
    grid = ((centre - centre.min(0)) / span * 1023).astype(np.int64) if n else np.zeros((0, 3), np.int64)
    curve = sum(((grid[:, k] >> i) & 1) << (3 * i + k) for i in range(10) for k in range(3))
    rank = np.empty(n, np.int64)
    rank[np.argsort(curve, kind="stable")] = np.arange(n)
    x, y = (sum(((rank >> (2 * i + k)) & 1) << i for i in range(bits + 1)) * 2 for k in (0, 1))
    side = 2 << bits
    mean = corner.reshape(-1, 3).mean(0) if n else np.full(3, 128)
    picture = np.tile(mean.astype(np.uint8), (side, side, 1))
    fourth = np.clip(corner[:, 1] + corner[:, 2] - corner[:, 0], 0, 255)
    places = ((0, 0), (1, 0), (0, 1))
    for (dx, dy), colour in zip((*places, (1, 1)), (*corner.transpose(1, 0, 2), fourth), strict=True):
        picture[y + dy, x + dx] = colour
    uv = np.stack([np.stack([x + dx + 0.5, side - (y + dy + 0.5)], 1) for dx, dy in places], 1) / side
    return picture, uv
