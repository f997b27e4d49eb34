"""Splat files: the standard 3D Gaussian splatting PLY, SPZ and SOG, a file a part and one of the whole."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from hingesplat.errors import HingesplatError
from hingesplat.export.spz import spz_bytes
from hingesplat.files import whole_file
from hingesplat.gaussians import Gaussians
from hingesplat.render import sh_basis
from hingesplat.se3 import matrix_to_wxyz, quat_multiply

RUB = np.diag([1.0, -1.0, -1.0])
"""Turns the axes of splat PLYs (x right, y down, z forward) to those of SPZ (x right, y up, z back)."""


def _names(rest: int) -> list[str]:
    """Property names in file order, with ``rest`` spherical-harmonic values above degree 0."""
    return (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        + [f"f_rest_{i}" for i in range(rest)]
        + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    )


def transformed(gaussians: Gaussians, R: np.ndarray, factor: float = 1.0) -> Gaussians:
    """Gaussians turned and scaled about the origin, ``factor · R x``, their harmonics with them."""
    g = gaussians.detached()
    turn = torch.as_tensor(R, dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(64, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    d, count = directions.double(), g.sh.shape[1]
    # The turned harmonics say in direction d what the old ones said in Rᵀ d.
    mix = torch.linalg.lstsq(sh_basis(d, count), sh_basis(d @ turn, count)).solution
    return replace(
        g,
        means=(factor * g.means.double() @ turn.T).to(g.means.dtype),
        quats=quat_multiply(matrix_to_wxyz(turn).to(g.quats.dtype).expand_as(g.quats), g.quats),
        log_scales=g.log_scales + float(np.log(factor)),
        sh=torch.einsum("ab,nbc->nac", mix.to(g.sh.dtype), g.sh),
    )


def write_splats(gaussians: Gaussians, names: dict[int, str], out: Path, form: str) -> np.ndarray:
    """Write ``out/twin.FORM`` and ``out/NAME.FORM``, a file a part, in state 0.

    PLY and SOG keep the coordinates given; the axes of SPZ are those that its viewers expect.

    Args:
        gaussians: in the export's frame.
        names: of the parts, by part id; parts without Gaussians get no file.
        out: an existing folder.
        form: ply, spz or sog.

    Returns:
        T_mesh_file (4, 4): takes coordinates in the files to those given.

    Raises:
        HingesplatError: gaussforge, which writes SOG, is absent or fails.
    """
    T_mesh_file = np.eye(4)
    g = gaussians.detached()
    if form == "spz":
        g, T_mesh_file[:3, :3] = transformed(g, RUB), RUB.T
    files = {"twin": g} | {name: g[g.part == i] for i, name in names.items()}
    for name, part in files.items():
        path = out / f"{name}.{form}"
        if len(part) and form == "spz":
            path.write_bytes(spz_bytes(part))
        elif len(part):
            write_ply(part, path.with_suffix(".ply"))
            if form == "sog":
                _to_sog(path.with_suffix(".ply"), path)
    return T_mesh_file


def _to_sog(source: Path, target: Path) -> None:
    """A PLY to SOG; the PLY goes."""
    try:
        from gaussforge import GaussForge
    except ImportError as e:
        raise HingesplatError("sog: needs the package gaussforge; pip install 'hingesplat[splats]'") from e
    made = GaussForge().convert(source.read_bytes(), "ply", "sog")
    source.unlink()
    if "error" in made:
        raise HingesplatError(f"{target}: cannot be made: {made['error']}; export PLY instead")
    target.write_bytes(made["data"])


def write_ply(gaussians: Gaussians, path: Path) -> None:
    """Write a binary little-endian PLY, whole or not at all.

    Log scales, logit opacities, unit quaternions wxyz, ``f_rest`` channel-major (all red, all green,
    all blue). Part ids have no place in it: write one file a part.
    """
    g = gaussians.detached()
    n = len(g)
    rest = g.sh[:, 1:].transpose(1, 2).flatten(1)
    quats = torch.nn.functional.normalize(g.quats, dim=1)
    columns = [g.means, torch.zeros(n, 3), g.sh[:, 0], rest, g.logit_opacities[:, None], g.log_scales, quats]
    table = torch.cat([c.cpu().float() for c in columns], 1).numpy().astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    header += [f"property float {name}" for name in _names(rest.shape[1])]
    with whole_file(path) as tmp:
        tmp.write_bytes(("\n".join([*header, "end_header"]) + "\n").encode() + table.tobytes())


def read_ply(path: Path) -> Gaussians:
    """Read a 3DGS PLY; every part id is 0.

    Raises:
        HingesplatError: the file is missing, cut off, not binary little-endian floats, or lacks a property.
    """
    if not path.is_file():
        raise HingesplatError(f"{path}: no such file; give the path of a 3DGS PLY")
    head, found, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.split() for line in head.decode("latin-1").splitlines()]
    if not found or lines[0] != ["ply"] or ["format", "binary_little_endian", "1.0"] not in lines:
        raise HingesplatError(f"{path}: not a binary little-endian PLY; convert it first")
    counts = [int(line[2]) for line in lines if line[:2] == ["element", "vertex"]]
    properties = [line for line in lines if line[:1] == ["property"]]
    if len(counts) != 1 or any(line[1] not in ("float", "float32") for line in properties):
        raise HingesplatError(f"{path}: wants one element, vertex, of float properties; it is no 3DGS PLY")
    names = [line[2] for line in properties]
    rest = sum(name.startswith("f_rest_") for name in names)
    missing = [name for name in _names(rest) if name not in names and not name.startswith("n")]
    if missing:
        raise HingesplatError(f"{path}: lacks {', '.join(missing)}; it is no 3DGS PLY")
    n, width = counts[0], len(names)
    if len(body) < 4 * n * width:
        raise HingesplatError(f"{path}: cut off after {len(body)} of {4 * n * width} bytes; write it again")
    table = torch.from_numpy(np.frombuffer(body, "<f4", n * width).astype(np.float32).reshape(n, width))

    def column(*wanted: str) -> torch.Tensor:
        return table[:, [names.index(name) for name in wanted]]

    higher = column(*(f"f_rest_{i}" for i in range(rest))).reshape(n, 3, rest // 3).transpose(1, 2)
    return Gaussians(
        means=column("x", "y", "z"),
        quats=column("rot_0", "rot_1", "rot_2", "rot_3"),
        log_scales=column("scale_0", "scale_1", "scale_2"),
        logit_opacities=column("opacity")[:, 0],
        sh=torch.cat([column("f_dc_0", "f_dc_1", "f_dc_2")[:, None], higher], 1).contiguous(),
        part=torch.zeros(n, dtype=torch.int64),
    )
