"""URDF: a folder that can be moved, which loads in MuJoCo and in everything else that reads URDF."""

from pathlib import Path

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from hingesplat.export.links import Link, joint_dynamics, numbers, write_meshes
from hingesplat.files import write_text


def write_urdf(links: list[Link], out: Path) -> Path:
    """Write ``out/twin.urdf`` with ``out/meshes/`` and ``out/collision/``; paths inside are relative.

    Joint value 0 is state 0. URDF cannot exempt a part from touching the base it is hinged to, so a
    ``<mujoco>`` tag, which other programs ignore, switches contacts off in MuJoCo; use the MJCF to grasp and
    push there.

    Returns:
        The URDF's path.
    """
    write_meshes(links, out)
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
    etree.SubElement(inertial, "inertia", **{k: numbers(v) for k, v in link.moments.items()})
    if link.mesh is None:
        return
    # Without a material of its own, so that the mesh's texture shows: PyBullet would multiply the two.
    _add_mesh(etree.SubElement(element, "visual", name=f"{link.name}_visual"), f"meshes/{link.name}.obj")
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
    dynamics = {k: numbers(v) for k, v in joint_dynamics(link, links).items()}
    lower, upper = (numbers(v) for v in link.limits)
    etree.SubElement(
        element, "limit", lower=lower, upper=upper, effort=dynamics["effort"], velocity=dynamics["velocity"]
    )
    etree.SubElement(element, "dynamics", damping=dynamics["damping"], friction=dynamics["friction"])
