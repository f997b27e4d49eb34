"""URDF: a folder that can be moved, which loads in MuJoCo and in everything else that reads URDF."""

from pathlib import Path

import trimesh
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from hingesplat.export.links import Link, axis_load, build_links, numbers, servo_gain, write_text
from hingesplat.twin import Twin


def write_urdf(
    twin: Twin, meshes: dict[int, trimesh.Trimesh], out: Path, *, density: float = 500.0, scale: float = 1.0
) -> Path:
    """Write ``out/twin.urdf`` with ``out/meshes/`` and ``out/collision/``; paths inside are relative.

    Joint value 0 is state 0; limits are the twin's. URDF cannot exempt a part from touching the base it is
    hinged to, so a ``<mujoco>`` tag, which other programs ignore, switches contacts off in MuJoCo; use the
    MJCF to grasp and push there.

    Args:
        twin: parts and joints, frame of state 0.
        meshes: closed part meshes by part id, frame of state 0, scene units.
        out: the folder; made if absent.
        density: kg/m³.
        scale: metres per scene unit.

    Returns:
        The URDF's path.

    Raises:
        HingesplatError: the joints do not form a tree.
    """
    links = build_links(twin, meshes, out, density=density, scale=scale)
    robot = etree.Element("robot", name="twin")
    mujoco = etree.SubElement(robot, "mujoco")
    etree.SubElement(mujoco, "compiler", strippath="false", discardvisual="false", fusestatic="false")
    etree.SubElement(etree.SubElement(mujoco, "option"), "flag", contact="disable")
    for link in links:
        _add_link(robot, link)
    for link in links:
        if link.parent is not None:
            _add_joint(robot, link, link.parent, links)
    text = etree.tostring(robot, pretty_print=True, encoding="unicode")
    return write_text(out / "twin.urdf", '<?xml version="1.0"?>\n' + text)


def _add_link(robot: etree._Element, link: Link) -> None:
    element = etree.SubElement(robot, "link", name=link.name)
    inertial = etree.SubElement(element, "inertial")
    etree.SubElement(inertial, "origin", xyz=numbers(link.com), rpy="0 0 0")
    etree.SubElement(inertial, "mass", value=numbers(link.mass))
    I = link.inertia
    moments = {"ixx": I[0, 0], "ixy": I[0, 1], "ixz": I[0, 2], "iyy": I[1, 1], "iyz": I[1, 2], "izz": I[2, 2]}
    etree.SubElement(inertial, "inertia", **{k: numbers(v) for k, v in moments.items()})
    if link.mesh is None:
        return
    visual = etree.SubElement(element, "visual", name=f"{link.name}_visual")
    _add_mesh(visual, f"meshes/{link.name}.obj")
    material = etree.SubElement(visual, "material", name=f"{link.name}_colour")
    etree.SubElement(material, "color", rgba=numbers([*link.colour, 1]))
    for i in range(len(link.hulls)):
        collision = etree.SubElement(element, "collision", name=f"{link.name}_collision_{i}")
        _add_mesh(collision, f"collision/{link.name}_{i}.obj")


def _add_mesh(element: etree._Element, filename: str) -> None:
    etree.SubElement(element, "origin", xyz="0 0 0", rpy="0 0 0")
    etree.SubElement(etree.SubElement(element, "geometry"), "mesh", filename=filename)


def _add_joint(robot: etree._Element, link: Link, parent: Link, links: list[Link]) -> None:
    kind = link.joint.type if link.joint else "fixed"
    element = etree.SubElement(robot, "joint", name=f"{link.name}_joint", type=kind)
    etree.SubElement(element, "origin", xyz=numbers(link.offset), rpy="0 0 0")
    etree.SubElement(element, "parent", link=parent.name)
    etree.SubElement(element, "child", link=link.name)
    if link.joint is None or not link.moves:
        return
    etree.SubElement(element, "axis", xyz=numbers(link.joint.axis))
    lower, upper = link.limits
    load, _ = axis_load(link, links)
    span = max(upper - lower, 1e-4)
    etree.SubElement(
        element,
        "limit",
        lower=numbers(lower),
        upper=numbers(lower + span),
        # Twice what the servo asks for over the whole range; end to end in half a second.
        effort=numbers(2 * servo_gain(link, links) * span),
        velocity=numbers(2 * span),
    )
    etree.SubElement(element, "dynamics", damping=numbers(2 * load), friction=numbers(0.1 * load))
