"""MJCF for MuJoCo: servos on the joints, textured parts, and contacts that do not jam the joints."""

from pathlib import Path

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from hingesplat.export.links import GRAVITY, Link, gravity, joint_dynamics, numbers, servo_gain, touching, write_meshes
from hingesplat.files import write_text


def write_mjcf(links: list[Link], out: Path, *, up_axis: str = "z") -> Path:
    """Write ``out/twin.xml`` with ``out/meshes/`` and ``out/collision/``; paths inside are relative.

    Every joint has a critically damped position actuator, in radians or metres. Contacts are excluded between
    a part and its parent (MuJoCo does not filter them when the parent is static) and between parts that meet
    on their ways. Geoms: group 2 what is seen, group 3 collision hulls. Gravity pulls against ``up_axis``.

    Returns:
        The MJCF's path.
    """
    write_meshes(links, out)
    root = etree.Element("mujoco", model="twin")
    etree.SubElement(root, "compiler", angle="radian", autolimits="true")
    down = [v / GRAVITY for v in gravity(up_axis)]
    etree.SubElement(root, "option", integrator="implicitfast", timestep="0.002", gravity=numbers(gravity(up_axis)))
    _add_defaults(root)
    asset = etree.SubElement(root, "asset")
    world = etree.SubElement(root, "worldbody")
    light = {"pos": numbers([-3 * v for v in down]), "dir": numbers([v or 0.3 for v in down])}
    etree.SubElement(world, "light", directional="true", castshadow="false", **light)
    bodies: dict[str, etree._Element] = {}
    for link in links:
        _add_assets(asset, link)
        parent = world if link.parent is None else bodies[link.parent.name]
        bodies[link.name] = _add_body(parent, link, links)
    contact = etree.SubElement(root, "contact")
    for a, b in touching(links):
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
                ctrlrange=numbers(link.limits),
            )
    return write_text(out / "twin.xml", etree.tostring(root, pretty_print=True, encoding="unicode"))


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
        etree.SubElement(asset, "mesh", name=f"{link.name}_collision_{i}", file=f"collision/{link.name}_{i}.obj")


def _add_body(parent: etree._Element, link: Link, links: list[Link]) -> etree._Element:
    body = etree.SubElement(parent, "body", name=link.name, pos=numbers(link.offset))
    I = link.inertia
    full = [I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]
    etree.SubElement(body, "inertial", pos=numbers(link.com), mass=numbers(link.mass), fullinertia=numbers(full))
    if link.joint is not None and link.moves:
        dynamics = joint_dynamics(link, links)
        etree.SubElement(
            body,
            "joint",
            name=f"{link.name}_joint",
            type="hinge" if link.joint.type == "revolute" else "slide",
            axis=numbers(link.joint.axis),
            range=numbers(link.limits),
            damping=numbers(dynamics["damping"]),
            frictionloss=numbers(dynamics["friction"]),
        )
    if link.mesh is not None:
        etree.SubElement(body, "geom", **{"class": "visual", "mesh": link.name, "material": link.name})
        for i in range(len(link.hulls)):
            etree.SubElement(body, "geom", **{"class": "collision", "mesh": f"{link.name}_collision_{i}"})
    return body
