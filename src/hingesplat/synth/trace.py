"""Ray-traced pictures of a model: light is traced once a state into texels, and pictures look it up.

What a matt surface sends out is the same in all directions and can be kept with the texel; the clear coat of a
glossy one is added picture by picture. Light comes from suns and a sky dome that stay fixed in the world;
shading, cast shadows and highlights thus change with the motion.
"""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene
from scipy.ndimage import gaussian_filter, zoom

from hingesplat.camera import Camera
from hingesplat.synth.model import Model
from hingesplat.synth.shapes import Patch

SAMPLES = 3  # A side: 3 × 3 rays a pixel.
LIGHT_STEP = 2  # Light is traced on every second texel each way; it is smoother than the textures.
AMBIENT = 0.14  # Of full light, everywhere: what bounces between surfaces.
GAMMA = 2.2
SUNS = 3
SKY = np.array([0.95, 1.0, 1.08], np.float32)
SHININESS = 60.0  # Of Blinn's highlight; cosines below GLINT leave nothing of it.
GLINT = 0.92
F0 = 0.05  # A clear coat reflects so much of what meets it head-on.


def _lights() -> tuple[np.ndarray, np.ndarray]:
    """Directions towards the lights (m, 3) and their linear colours (m, 3): three suns and a dome of 32."""
    suns = np.array([[-0.45, -0.75, 0.9], [0.9, -0.25, 0.55], [-0.2, 0.9, 0.5]])
    sun_colours = np.array([[0.62, 0.58, 0.52], [0.22, 0.24, 0.27], [0.20, 0.19, 0.18]])
    i = np.arange(32) + 0.5
    z, turn = 1 - 1.35 * i / 32, np.pi * (1 + 5**0.5) * i  # Reaches a little below the horizon.
    r = np.sqrt(1 - z**2)
    dome = np.stack([r * np.cos(turn), r * np.sin(turn), z], 1)
    dome_colours = np.array([0.95, 1.0, 1.08]) * (0.035 * (0.6 + 0.4 * z))[:, None]
    suns /= np.linalg.norm(suns, axis=1, keepdims=True)
    return np.concatenate([suns, dome]), np.concatenate([sun_colours, dome_colours])


@dataclass(frozen=True)
class Texels:
    """Where a patch keeps its texels in the flat array of all colours, and the points they stand on."""

    body: str
    shape: tuple[int, int]
    offset: int
    light_shape: tuple[int, int]
    points: np.ndarray
    """Part frame, zero configuration, (light texels, 3)."""
    normals: np.ndarray


class Surface:
    """What of a model does not depend on its state: mesh, texels and their linear albedo."""

    def __init__(self, model: Model, texel: float) -> None:
        """``texel`` is the edge of a texel in model units."""
        self.model = model
        vertices, coords, faces, patch_of, body_of, albedo, normals, gloss = [], [], [], [], [], [], [], []
        self.texels: list[Texels] = []
        n_vertices = offset = 0
        for number, body in enumerate(model.bodies):
            for patch in (p for solid in body.solids for p in solid):
                v, st, f = patch.mesh()
                shape = (max(2, round(patch.size[0] / texel)), max(2, round(patch.size[1] / texel)))
                light_shape = (-(-shape[0] // LIGHT_STEP), -(-shape[1] // LIGHT_STEP))
                s, t = _grid(patch, light_shape)
                self.texels.append(Texels(body.name, shape, offset, light_shape, patch.at(s, t), patch.normals(s, t)))
                albedo.append(patch.texture(patch.at(*_grid(patch, shape)), patch.face))
                normals.append(patch.normals(st[:, 0], st[:, 1]))
                gloss.append(patch.gloss)
                vertices.append(v)
                coords.append(st / np.asarray(patch.size) * shape)
                faces.append(f + n_vertices)
                patch_of.append(np.full(len(f), len(self.texels) - 1))
                body_of.append(np.full(len(v), number))
                n_vertices += len(v)
                offset += shape[0] * shape[1]
        self.vertices, self.faces = np.concatenate(vertices), np.concatenate(faces)
        self.corner_texel = np.concatenate(coords)[self.faces].astype(np.float32)  # (triangles, 3, 2)
        self.patch_of, self.body_of_vertex = np.concatenate(patch_of), np.concatenate(body_of)
        self.normals, self.gloss = np.concatenate(normals), np.array(gloss, np.float32)
        self.albedo = np.clip(np.concatenate(albedo), 0.01, 1) ** GAMMA


def _grid(patch: Patch, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """(s, t) of the texel centres, row by row."""
    s, t = ((np.arange(n) + 0.5) / n * size for n, size in zip(shape, patch.size, strict=True))
    return np.repeat(s, shape[1]), np.tile(t, shape[0])


class LitScene:
    """A model in one state, lit, ready to be photographed."""

    def __init__(self, surface: Surface, poses: dict[str, np.ndarray]) -> None:
        self.surface, self.poses = surface, poses
        per_body = np.stack([poses[b.name] for b in surface.model.bodies])[surface.body_of_vertex]
        self.vertices = (per_body[:, :3, :3] @ surface.vertices[:, :, None])[..., 0] + per_body[:, :3, 3]
        self.shift = 1e-3 * float(np.ptp(self.vertices, axis=0).max())  # Rays start so far off the surface.
        normals = (per_body[:, :3, :3] @ surface.normals[:, :, None])[..., 0]
        self.corner_normal = normals[surface.faces].astype(np.float32)
        self.device = EmbreeDevice()
        self.scene = EmbreeScene(self.device)
        TriangleMesh(self.scene, self.vertices.astype(np.float32), surface.faces.astype(np.int32))
        self.colours = self._light()
        self.offsets = np.array([t.offset for t in surface.texels])
        self.shapes = np.array([t.shape for t in surface.texels])
        self.body_of_face = surface.body_of_vertex[surface.faces[:, 0]]

    def _light(self) -> np.ndarray:
        """sRGB bytes leaving every texel, (texels, 3) float32 in 0–255."""
        directions, colours = _lights()
        points, normals = [], []
        for texels in self.surface.texels:
            T = self.poses[texels.body]
            n = texels.normals @ T[:3, :3].T
            points.append(texels.points @ T[:3, :3].T + T[:3, 3] + self.shift * n)
            normals.append(n)
        x, n = np.concatenate(points).astype(np.float32), np.concatenate(normals)
        light = np.full(x.shape, AMBIENT)
        for direction, colour in zip(directions, colours, strict=True):
            cosine = n @ direction
            facing = np.flatnonzero(cosine > 0)
            towards = np.broadcast_to(direction.astype(np.float32), (len(facing), 3)).copy()
            seen = facing[self.scene.run(x[facing], towards, query="OCCLUDED") < 0]
            light[seen] += cosine[seen, None] * colour
        out = np.empty_like(self.surface.albedo)
        start = 0
        for texels in self.surface.texels:
            a, b = texels.light_shape
            coarse = gaussian_filter(light[start : start + a * b].reshape(a, b, 3), (0.6, 0.6, 0), mode="nearest")
            h, w = texels.shape
            fine = np.asarray(zoom(coarse, (h / a, w / b, 1), order=1, mode="nearest", grid_mode=True))
            out[texels.offset : texels.offset + h * w] = fine.reshape(-1, 3)
            start += a * b
        return (255 * np.clip(out * self.surface.albedo, 0, 1) ** (1 / GAMMA)).astype(np.float32)

    def photograph(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """RGBA (height, width, 4) uint8 with straight alpha; z-depth and body number at each pixel's centre.

        Depth is float32 in model units; bodies count from 1. Both are 0 where nothing is.
        """
        x0, y0, w, h = self._window(camera)
        fine = camera.cropped(x0, y0, w, h).scaled(w * SAMPLES, h * SAMPLES)
        origin, directions = fine.rays()
        d = directions.reshape(-1, 3).astype(np.float32)
        hit = self.scene.run(np.tile(origin.astype(np.float32), (len(d), 1)), d, output=True)
        face = hit["primID"]
        found = np.flatnonzero(face >= 0)
        face = face[found]
        u, v = hit["u"][found, None], hit["v"][found, None]
        corner = self.surface.corner_texel[face]
        at = (1 - u - v) * corner[:, 0] + u * corner[:, 1] + v * corner[:, 2]
        patch = self.surface.patch_of[face]
        ij = np.clip(at.astype(np.int64), 0, self.shapes[patch] - 1)
        rgba = np.zeros((len(d), 4), np.float32)
        rgba[found, :3] = self.colours[self.offsets[patch] + ij[:, 0] * self.shapes[patch, 1] + ij[:, 1]]
        rgba[found, 3] = 255
        if (coat := np.flatnonzero(self.surface.gloss[patch])).size:
            here, (u, v) = found[coat], (u[coat], v[coat])
            x = origin.astype(np.float32) + d[here] * hit["tfar"][here, None]
            shine = self._shine(x, d[here], face[coat], np.concatenate([1 - u - v, u, v], 1))
            under = (rgba[here, :3] / 255) ** GAMMA + shine * self.surface.gloss[patch[coat], None]
            rgba[here, :3] = 255 * np.clip(under, 0, 1) ** (1 / GAMMA)
        # One raw array for what only the pixel's centre tells: z-depth and body.
        centre = np.zeros((len(d), 2), np.float32)
        centre[found, 0] = hit["tfar"][found] * (d[found] @ camera.T_world_camera[:3, 2])
        centre[found, 1] = self.body_of_face[face] + 1

        mean = rgba.reshape(h, SAMPLES, w, SAMPLES, 4).mean((1, 3))
        mean[..., :3] *= 255 / np.maximum(mean[..., 3:], 1)
        picture = np.zeros((camera.height, camera.width, 4), np.uint8)
        picture[y0 : y0 + h, x0 : x0 + w] = np.round(mean).clip(0, 255)
        middle = np.zeros((camera.height, camera.width, 2), np.float32)
        m = SAMPLES // 2
        middle[y0 : y0 + h, x0 : x0 + w] = centre.reshape(h, SAMPLES, w, SAMPLES, 2)[:, m, :, m]
        return picture, middle[..., 0], middle[..., 1].astype(np.uint8)

    def _shine(self, x: np.ndarray, towards: np.ndarray, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
        """What a clear coat at the points (n, 3) adds, seen along the rays ``towards`` them: suns, and the sky.

        Linear RGB (n, 3). Bodies of the object darken the sky, but are not mirrored. All float32.
        """
        n = np.einsum("nk,nki->ni", bary, self.corner_normal[face])
        n /= np.sqrt(np.einsum("ni,ni->n", n, n))[:, None]
        facing = np.clip(-np.einsum("ni,ni->n", n, towards), 0, 1)
        mirrored = towards + 2 * facing[:, None] * n
        start = x + 2 * self.shift * n
        out = np.zeros_like(x)
        sky = np.clip(0.35 + 0.65 * mirrored[:, 2], 0.1, 1) * (F0 + (1 - F0) * (1 - facing) ** 5)
        free = self.scene.run(start, mirrored, query="OCCLUDED") < 0
        out[free] = sky[free, None] * SKY
        for sun, colour in zip(*(a[:SUNS].astype(np.float32) for a in _lights()), strict=True):
            half = sun - towards
            cosine = np.einsum("ni,ni->n", n, half) / np.sqrt(np.einsum("ni,ni->n", half, half))
            lit = np.flatnonzero((cosine > GLINT) & (n @ sun > 0))
            rays = np.broadcast_to(sun, (len(lit), 3)).copy()
            lit = lit[self.scene.run(start[lit], rays, query="OCCLUDED") < 0]
            out[lit] += 0.6 * cosine[lit, None] ** SHININESS * colour
        return out

    def _window(self, camera: Camera) -> tuple[int, int, int, int]:
        """Pixels (x0, y0, width, height) that the object can touch; the whole picture if it is very near."""
        uv, z = camera.project(self.vertices)
        if z.min() <= 0:
            return 0, 0, camera.width, camera.height
        size = np.array([camera.width, camera.height])
        low = np.clip(np.floor(uv.min(0)).astype(int), 0, size - 1)
        high = np.clip(np.ceil(uv.max(0)).astype(int), low + 1, size)
        return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])
