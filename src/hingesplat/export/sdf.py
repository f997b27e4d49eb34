"""SDF for Gazebo and whatever else libsdformat serves: a model folder."""

from pathlib import Path

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from hingesplat.export.links import Link, joint_dynamics, numbers, shapes, write_meshes
from hingesplat.files import write_text

VERSION = "1.7"
"""The oldest with ``relative_to``, so that Gazebo 11 reads it, too."""


def write_sdf(links: list[Link], out: Path) -> Path:
    """Write ``out/model.sdf`` and ``out/model.config`` with ``out/meshes/`` and ``out/collision/``.

    Links hang from their parents by ``relative_to``; the base is fixed to the world. Parts do not collide with
    each other (``self_collide`` is off by default), only with what else is in the world.

    Returns:
        The SDF's path.
    """
    write_meshes(links, out)
    root = etree.Element("sdf", version=VERSION)
    model = etree.SubElement(root, "model", name="twin")
    for link in links:
        _add_link(model, link)
    for link in links:
        _add_joint(model, link, links)
    config = etree.Element("model")
    _add(config, "name", "twin")
    _add(config, "version", "1.0")
    etree.SubElement(config, "sdf", version=VERSION).text = "model.sdf"
    head = '<?xml version="1.0"?>\n'
    write_text(out / "model.config", head + etree.tostring(config, pretty_print=True, encoding="unicode"))
    return write_text(out / "model.sdf", head + etree.tostring(root, pretty_print=True, encoding="unicode"))


def _add(parent: etree._Element, tag: str, value: object, **attributes: str) -> None:
    element = etree.SubElement(parent, tag, **attributes)
    element.text = value if isinstance(value, str) else numbers(value)


def _add_link(model: etree._Element, link: Link) -> None:
    element = etree.SubElement(model, "link", name=link.name)
    frame = {} if link.parent is None else {"relative_to": link.parent.name}
    _add(element, "pose", [*link.offset, 0, 0, 0], **frame)
    inertial = etree.SubElement(element, "inertial")
    _add(inertial, "pose", [*link.com, 0, 0, 0])
    _add(inertial, "mass", link.mass)
    inertia = etree.SubElement(inertial, "inertia")
    for name, moment in link.moments.items():
        _add(inertia, name, moment)
    for what, name, file, _ in shapes(link):
        geometry = etree.SubElement(etree.SubElement(element, what, name=name), "geometry")
        _add(etree.SubElement(geometry, "mesh"), "uri", file)


def _add_joint(model: etree._Element, link: Link, links: list[Link]) -> None:
    kind = link.joint.type if link.joint else "fixed"
    element = etree.SubElement(model, "joint", name=f"{link.name}_joint", type=kind)
    _add(element, "parent", "world" if link.parent is None else link.parent.name)
    _add(element, "child", link.name)
    if link.joint is None or not link.moves:
        return
    axis = etree.SubElement(element, "axis")
    _add(axis, "xyz", link.joint.axis)
    values = joint_dynamics(link, links)
    limit = etree.SubElement(axis, "limit")
    _add(limit, "lower", link.limits[0])
    _add(limit, "upper", link.limits[1])
    _add(limit, "effort", values["effort"])
    _add(limit, "velocity", values["velocity"])
    dynamics = etree.SubElement(axis, "dynamics")
    _add(dynamics, "damping", values["damping"])
    _add(dynamics, "friction", values["friction"])
