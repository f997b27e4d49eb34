"""Writers: a ``Twin`` in, files out."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import hingesplat
from hingesplat.errors import HingesplatError
from hingesplat.files import whole_folder, write_json

if TYPE_CHECKING:
    import trimesh

    from hingesplat.gaussians import Gaussians
    from hingesplat.twin import Twin

FORMATS = ("urdf", "mjcf", "usd", "sdf", "ply", "spz", "sog")
NOTE = "export.json"
"""In every folder that was written here: what it is, so that it may be replaced."""


@dataclass(frozen=True)
class ExportConfig:
    """How a twin is written for simulators and splat viewers."""

    density: float = 500.0
    """Of every part, kg/m³; mass and inertia follow from it and the closed mesh."""
    scale: float = 1.0
    """Everything is this much larger; metres per unit, where the capture does not say."""
    up_axis: Literal["z", "y"] = "z"
    """Axis that points up in what is written; captures are taken to have z up."""
    extend_limits: bool = False
    """Let joints go beyond the range seen, as far as the part stays free of the base."""
    max_triangles: int = 50_000
    """Of each part's mesh."""


def export_twin(
    twin: "Twin",
    meshes: "dict[int, trimesh.Trimesh]",
    gaussians: "Gaussians",
    out: Path,
    formats: Iterable[str] = ("urdf", "mjcf"),
    config: ExportConfig | None = None,
    *,
    cache: Path | None = None,
) -> dict[str, Path]:
    """Write a twin in several formats, each into a folder of its own, ``out/FORMAT``, that can be moved.

    Beside each stands ``export.json`` with the options and ``T_mesh_file``, the 4×4 that takes coordinates in
    splat files to those of the meshes. A folder is replaced as a whole or stays as it was.

    Args:
        twin: parts and joints, frame of state 0.
        meshes: part meshes by part id, frame of state 0, scene units.
        gaussians: of the whole, in state 0, with part ids.
        out: the folder for the folders; made if absent.
        formats: of ``FORMATS``.
        config: the defaults when None.
        cache: a folder that keeps collision hulls from one export to the next; ``out/.hulls`` when None.

    Returns:
        The file to open, by format.

    Raises:
        HingesplatError: an unknown format; no mesh; something else in the way of a folder; the joints form no tree; a
            number in the config makes no sense; a package that a format needs is absent.
    """
    from hingesplat.export.links import build_links, placement
    from hingesplat.export.splats import transformed, write_splats

    config = config or ExportConfig()
    formats = tuple(dict.fromkeys(formats))
    for form in formats:
        if form not in FORMATS:
            raise HingesplatError(f"format: unknown {form!r}; use {', '.join(FORMATS)}")
        _check_free(out / form)
    if not meshes:
        raise HingesplatError("no part has a mesh: the run is not finished; give its `hingesplat reconstruct` again")
    links = build_links(twin, meshes, config, cache or out / ".hulls")
    placed = transformed(gaussians, *placement(twin, config))
    note = {"hingesplat": hingesplat.__version__, **vars(config), "metres_per_unit": twin.metres_per_unit}
    written = {}
    for form in formats:
        T_mesh_file = [[float(i == j) for j in range(4)] for i in range(4)]
        with whole_folder(out / form) as folder:
            match form:
                case "urdf":
                    from hingesplat.export.urdf import write_urdf

                    path = write_urdf(links, folder, up_axis=config.up_axis)
                case "mjcf":
                    from hingesplat.export.mjcf import write_mjcf

                    path = write_mjcf(links, folder, up_axis=config.up_axis)
                case "usd":
                    from hingesplat.export.usd import write_usd

                    path = write_usd(links, placed, folder, up_axis=config.up_axis)
                case "sdf":
                    from hingesplat.export.sdf import write_sdf

                    path = write_sdf(links, folder)
                case _:
                    names = {link.part.id: link.name for link in links}
                    T_mesh_file = write_splats(placed, names, folder, form).tolist()
                    path = folder / f"twin.{form}"
            write_json(folder / NOTE, {"format": form, **note, "T_mesh_file": T_mesh_file})
        written[form] = out / form / path.name
    return written


def _check_free(folder: Path) -> None:
    """A folder may be written if it is absent, empty, or holds an earlier export."""
    above = next(p for p in (folder, *folder.parents) if p.exists())
    if not above.is_dir():
        raise HingesplatError(f"{above}: is a file and in the way; give another --out")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / NOTE).is_file():
        raise HingesplatError(f"{folder}: is in the way and holds no export; move it or give another --out")
