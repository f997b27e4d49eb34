"""URDF: a folder that can be moved, which loads in MuJoCo and in everything else that reads URDF."""

from pathlib import Path

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from hingesplat.export.links import Link, gravity, joint_dynamics, numbers, shapes, write_meshes
from hingesplat.files import write_text


def write_urdf(links: list[Link], out: Path, *, up_axis: str = "z") -> Path:
    """Write ``out/twin.urdf`` with ``out/meshes/`` and ``out/collision/``; paths inside are relative.

    Joint value 0 is state 0. URDF cannot exempt a part from touching the base it is hinged to, so a
    ``<mujoco>`` tag, which other programs ignore, switches contacts off in MuJoCo; use the MJCF to grasp and
    push there. The tag also names the integrator with which stiff servos on light chains are stable, and which way is
    down.

    Returns:
        The URDF's path.
    """
    write_meshes(links, out)
    robot = etree.Element("robot", name="twin")
    mujoco = etree.SubElement(robot, "mujoco")
    etree.SubElement(mujoco, "compiler", strippath="false", discardvisual="false", fusestatic="false")
    option = etree.SubElement(mujoco, "option", integrator="implicitfast", gravity=numbers(gravity(up_axis)))
    etree.SubElement(option, "flag", contact="disable")
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
    # Without a material of its own, so that the mesh's texture shows: PyBullet would multiply the two.
    for what, name, file, _ in shapes(link):
        shape = etree.SubElement(element, what, name=name)
        etree.SubElement(shape, "origin", xyz="0 0 0", rpy="0 0 0")
        etree.SubElement(etree.SubElement(shape, "geometry"), "mesh", filename=file)


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
