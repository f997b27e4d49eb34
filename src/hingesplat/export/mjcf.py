"""MJCF for MuJoCo: servos on the joints, textured parts, and contacts that do not jam the joints."""

from itertools import combinations
from pathlib import Path

import manifold3d
import numpy as np
import trimesh
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from hingesplat.export.links import Link, axis_load, build_links, numbers, servo_gain, write_text
from hingesplat.twin import Twin


def write_mjcf(
    twin: Twin, meshes: dict[int, trimesh.Trimesh], out: Path, *, density: float = 500.0, scale: float = 1.0
) -> Path:
    """Write ``out/twin.xml`` with ``out/meshes/`` and ``out/collision/``; paths inside are relative.

    Every joint has a critically damped position actuator, in radians or metres. Contacts are excluded between
    a part and its parent (MuJoCo does not filter them when the parent is static) and between parts that touch
    in state 0. Geoms: group 2 what is seen, group 3 collision hulls.

    Args:
        twin: parts and joints, frame of state 0.
        meshes: closed part meshes by part id, frame of state 0, scene units.
        out: the folder; made if absent.
        density: kg/m³.
        scale: metres per scene unit.

    Returns:
        The MJCF's path.

    Raises:
        HingesplatError: the joints do not form a tree.
    """
    links = build_links(twin, meshes, out, density=density, scale=scale)
    root = etree.Element("mujoco", model="twin")
    etree.SubElement(root, "compiler", angle="radian", autolimits="true")
    etree.SubElement(root, "option", integrator="implicitfast", timestep="0.002")
    _add_defaults(root)
    asset = etree.SubElement(root, "asset")
    world = etree.SubElement(root, "worldbody")
    etree.SubElement(world, "light", directional="true", pos="0 0 3", dir="0.3 0.4 -1", castshadow="false")
    bodies: dict[str, etree._Element] = {}
    for link in links:
        _add_assets(asset, link)
        parent = world if link.parent is None else bodies[link.parent.name]
        bodies[link.name] = _add_body(parent, link, axis_load(link, links)[0] if link.moves else 0.0)
    contact = etree.SubElement(root, "contact")
    for a, b in combinations(links, 2):
        if a is b.parent or b is a.parent or _touch(a, b):
            etree.SubElement(contact, "exclude", body1=a.name, body2=b.name)
    actuator = etree.SubElement(root, "actuator")
    for link in links:
        if link.moves:
            etree.SubElement(
                actuator,
                "position",
                name=f"{link.name}_servo",
                joint=f"{link.name}_joint",
                kp=numbers(servo_gain(link, links)),
                dampratio="1",
                ctrlrange=numbers(_range(link)),
            )
    return write_text(out / "twin.xml", etree.tostring(root, pretty_print=True, encoding="unicode"))


def _range(link: Link) -> tuple[float, float]:
    return link.limits[0], max(link.limits[1], link.limits[0] + 1e-4)


def _add_defaults(root: etree._Element) -> None:
    default = etree.SubElement(root, "default")
    visual = etree.SubElement(default, "default", **{"class": "visual"})
    etree.SubElement(visual, "geom", type="mesh", group="2", contype="0", conaffinity="0", mass="0")
    collision = etree.SubElement(default, "default", **{"class": "collision"})
    etree.SubElement(collision, "geom", type="mesh", group="3", mass="0", rgba="0.3 0.6 0.9 0.4")


def _add_assets(asset: etree._Element, link: Link) -> None:
    if link.mesh is None:
        return
    etree.SubElement(asset, "texture", name=link.name, type="2d", file=f"meshes/{link.name}.png")
    etree.SubElement(asset, "material", name=link.name, texture=link.name, specular="0.1")
    # Inertia comes from the link; for the mesh asset itself any will do, and a shell's never fails.
    etree.SubElement(asset, "mesh", name=link.name, file=f"meshes/{link.name}.obj", inertia="shell")
    for i in range(len(link.hulls)):
        etree.SubElement(asset, "mesh", name=f"{link.name}_{i}", file=f"collision/{link.name}_{i}.obj")


def _add_body(parent: etree._Element, link: Link, load: float) -> etree._Element:
    body = etree.SubElement(parent, "body", name=link.name, pos=numbers(link.offset))
    I = link.inertia
    full = [I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]
    etree.SubElement(body, "inertial", pos=numbers(link.com), mass=numbers(link.mass), fullinertia=numbers(full))
    if link.joint is not None and link.moves:
        etree.SubElement(
            body,
            "joint",
            name=f"{link.name}_joint",
            type="hinge" if link.joint.type == "revolute" else "slide",
            axis=numbers(link.joint.axis),
            range=numbers(_range(link)),
            damping=numbers(2 * load),
            frictionloss=numbers(0.1 * load),
        )
    if link.mesh is not None:
        etree.SubElement(body, "geom", **{"class": "visual", "mesh": link.name, "material": link.name})
        for i in range(len(link.hulls)):
            etree.SubElement(body, "geom", **{"class": "collision", "mesh": f"{link.name}_{i}"})
    return body


def _touch(a: Link, b: Link) -> bool:
    """Whether the hulls of two links overlap or nearly so (1 % of the smaller link) in state 0."""
    if not a.hulls or not b.hulls:
        return False
    gap = 0.01 * min(float(link.mesh.extents.max()) for link in (a, b) if link.mesh is not None)
    solids = [
        [manifold3d.Manifold.hull_points(np.asarray(h.vertices + link.origin)) for h in link.hulls] for link in (a, b)
    ]
    return any(p.min_gap(q, gap) < gap for p in solids[0] for q in solids[1])
