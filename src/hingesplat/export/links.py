"""What every simulator writer needs: the links of a twin as rigid bodies, in metres and in the export's axes."""

import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path

import manifold3d
import numpy as np
import trimesh
from trimesh.exchange.obj import export_obj

from hingesplat.errors import HingesplatError
from hingesplat.export import ExportConfig
from hingesplat.export.obj import obj_files
from hingesplat.export.solids import closed_mesh, collision_hulls, free_range, near
from hingesplat.files import write_text
from hingesplat.twin import Joint, Part, Twin

GRAVITY = 9.81
FEWEST_TRIANGLES = 100
"""With fewer, a simplified mesh may vanish."""
UP = {"z": np.eye(3), "y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}
"""R_export_twin by the axis that points up in the export; twins have z up."""
PLACES = 9
"""Along a joint's range, where it is asked whether two links meet."""


@dataclass(frozen=True)
class Link:
    """One part as a rigid body, metres, kilograms.

    Its frame is parallel to the export's and lies, in state 0, at ``origin``: the joint's pivot (base: zero).
    """

    name: str
    part: Part
    joint: Joint | None
    """In the export's axes, metres; its limits are those to write."""
    parent: "Link | None"
    origin: np.ndarray
    """(3,) in the export's frame, state 0."""
    mesh: trimesh.Trimesh | None
    """Closed, coloured, in the link frame."""
    hulls: tuple[trimesh.Trimesh, ...]
    """Convex, in the link frame."""
    mass: float
    com: np.ndarray
    """(3,) in the link frame."""
    inertia: np.ndarray
    """(3, 3) about the centre of mass, link axes."""

    @property
    def offset(self) -> np.ndarray:
        """(3,) origin in the parent's frame."""
        return self.origin if self.parent is None else self.origin - self.parent.origin

    @property
    def moments(self) -> dict[str, float]:
        """``inertia`` under the names that URDF and SDF share."""
        return {f"i{'xyz'[r]}{'xyz'[c]}": self.inertia[r, c] for r, c in zip(*np.triu_indices(3), strict=True)}

    @cached_property
    def visual_files(self) -> dict[str, bytes]:
        """What shows its mesh, by file name: the same in all formats."""
        return {} if self.mesh is None else obj_files(self.mesh, self.name)

    @property
    def moves(self) -> bool:
        return self.joint is not None and self.joint.type != "fixed"

    @property
    def limits(self) -> tuple[float, float]:
        """Radians or metres, at least 0.1 mrad or 0.1 mm apart: simulators refuse an empty range."""
        low, high = self.joint.limits if self.joint else (0.0, 0.0)
        return low, max(high, low + 1e-4)

    def pose(self, value: Callable[["Link"], float]) -> np.ndarray:
        """4×4 from where the link stands in state 0 to where joint values, given by link, take it; export's frame."""
        above = self.parent.pose(value) if self.parent else np.eye(4)
        return above @ self.joint.transform(value(self)) if self.moves and self.joint else above

    def chain(self) -> list["Link"]:
        """The link and what it hangs from, up to the root."""
        return [self, *(self.parent.chain() if self.parent else ())]

    def carries(self, other: "Link") -> bool:
        """Whether ``other`` is this link or hangs from it."""
        return other is self or (other.parent is not None and self.carries(other.parent))


def build_links(twin: Twin, meshes: dict[int, trimesh.Trimesh], config: ExportConfig, cache: Path) -> list[Link]:
    """Links of a twin, parents first.

    Args:
        twin: parts and joints, frame of state 0.
        meshes: part meshes by part id, frame of state 0, scene units; without one, a token mass.
        config: of the export.
        cache: a folder that keeps collision hulls from one export to the next.

    Raises:
        HingesplatError: the density or scale is not positive; too few triangles are allowed; a joint names a parent
            that does not exist, or the joints form a loop.
    """
    for name in ("density", "scale"):
        if not 0 < getattr(config, name) < float("inf"):
            raise HingesplatError(f"{name}: must be above 0, not {getattr(config, name)}")
    if config.max_triangles < FEWEST_TRIANGLES:
        raise HingesplatError(f"max_triangles: must be at least {FEWEST_TRIANGLES}, not {config.max_triangles}")
    order, names = _parents_first(twin), _unique_names(twin)
    solids = {i: closed_mesh(mesh, names[i], config.max_triangles) for i, mesh in meshes.items() if i in names}
    solids = {i: mesh for i, mesh in solids.items() if mesh is not None}
    if config.extend_limits:
        twin = replace(twin, joints=tuple(_extended(joint, twin, solids) for joint in twin.joints))
    # Hulls are cut in the twin's own frame, so that no option cuts the mesh anew.
    with ThreadPoolExecutor() as pool:
        hulls = dict(zip(solids, pool.map(lambda mesh: collision_hulls(mesh, cache), solids.values()), strict=True))
    links: dict[int, Link] = {}
    for part in order:
        joint = twin.joint_of(part.id)
        # A part without a joint is held by the base, which is the root.
        parent = links.get(joint.parent if joint else 0)
        solid, pieces = solids.get(part.id), hulls.get(part.id, ())
        links[part.id] = _link(names[part.id], part, joint, parent, solid, pieces, twin, config)
    return list(links.values())


def placement(twin: Twin, config: ExportConfig) -> tuple[np.ndarray, float]:
    """Rotation (3, 3) and factor that take the twin's coordinates to the export's: ``factor · R x``."""
    return UP[config.up_axis], config.scale * twin.metres_per_unit


def gravity(up_axis: str) -> list[float]:
    """(3,) m/s² in the export's frame."""
    return [-GRAVITY * (up_axis == axis) for axis in "xyz"]


def shapes(link: Link) -> list[tuple[str, str, str, trimesh.Trimesh]]:
    """What a link shows and what it collides with: ``visual`` or ``collision``, a name, a file in the folder, the mesh.

    Both in the link's frame.
    """
    if link.mesh is None:
        return []
    visual = ("visual", f"{link.name}_visual", f"meshes/{link.name}.obj", link.mesh)
    numbered = enumerate(link.hulls)
    hulls = [("collision", f"{link.name}_collision_{i}", f"collision/{link.name}_{i}.obj", h) for i, h in numbered]
    return [visual, *hulls]


def write_meshes(links: list[Link], out: Path) -> None:
    """Write the ``shapes`` of the links, those that are seen with textures."""
    for link in links:
        for what, _, file, mesh in shapes(link):
            path = out / file
            path.parent.mkdir(parents=True, exist_ok=True)
            if what == "collision":
                write_text(path, export_obj(mesh))
                continue
            for name, content in link.visual_files.items():
                (path.parent / name).write_bytes(content)


def touching(links: list[Link]) -> list[tuple[Link, Link]]:
    """Pairs that must not collide: parent and child, and links that meet somewhere in their ranges.

    The thing itself went through its ranges, so where two meshes come together there (within 1 % of the smaller one)
    they are too thick. The way through is looked at in nine places of each of the two.
    """
    return [
        (a, b)
        for a, b in combinations(links, 2)
        if a is b.parent or b is a.parent or (a.hulls and b.hulls and _meet(a, b))
    ]


def _meet(a: Link, b: Link) -> bool:
    gap = 0.01 * min(float(link.mesh.extents.max()) for link in (a, b) if link.mesh is not None)
    above = [set(map(id, link.chain())) for link in (a, b)]
    states = range(max((len(link.joint.states) for link in (a, b) if link.joint), default=1))
    hulls = [[manifold3d.Manifold.hull_points(np.asarray(h.vertices)) for h in link.hulls] for link in (a, b)]

    def placed(link: Link, value: Callable[[Link], float]) -> list[manifold3d.Manifold]:
        T = link.pose(value) @ trimesh.transformations.translation_matrix(link.origin)
        return [h.transform(T[:3]) for h in hulls[link is b]]

    def through(link: Link, own: set[int]) -> list[list[manifold3d.Manifold]]:
        """The link along its way, all its own joints together; those that carry both links rest."""

        def share(w: float) -> Callable[[Link], float]:
            return lambda k: k.limits[0] + w * (k.limits[1] - k.limits[0]) if id(k) in own else 0.0

        return [placed(link, share(w)) for w in (np.linspace(0, 1, PLACES) if id(link) in own else (0.0,))]

    def together(state: int) -> bool:
        at = [placed(link, lambda k: k.joint.states[state] if k.joint else 0.0) for link in (a, b)]
        return near(at[0], at[1], gap)

    return any(map(together, states)) or any(
        near(p, q, gap) for p in through(a, above[0] - above[1]) for q in through(b, above[1] - above[0])
    )


def axis_load(link: Link, links: list[Link]) -> tuple[float, float]:
    """What the joint of a link carries in state 0, descendants included.

    Returns:
        Inertia along the joint (kg; kg·m² for a hinge) and the most that gravity can weigh on it (N; N·m).
    """
    assert link.joint is not None
    axis = np.asarray(link.joint.axis)
    slides = link.joint.type == "prismatic"
    inertia = weight = 0.0
    for other in links:
        if link.carries(other):
            arm = np.cross(axis, other.origin + other.com - link.origin)
            inertia += other.mass if slides else float(other.mass * arm @ arm + axis @ other.inertia @ axis)
            weight += GRAVITY * other.mass * (1.0 if slides else float(np.linalg.norm(arm)))
    return inertia, weight


def servo_gain(link: Link, links: list[Link]) -> float:
    """Position gain (N/m; N·m/rad): gravity shifts the joint by 0.5 % of its range at most.

    Bounded below (60 rad/s) so that every joint answers briskly, above (250 rad/s) for stable 2 ms steps.
    """
    inertia, weight = axis_load(link, links)
    span = link.limits[1] - link.limits[0]
    rate = np.clip(np.sqrt(weight / (0.005 * span * inertia)), 60.0, 250.0)
    return float(inertia * rate**2)


def joint_dynamics(link: Link, links: list[Link]) -> dict[str, float]:
    """Defaults that suit any size: ``damping`` (N·s/m; N·m·s/rad) stops a free joint in about half a second,
    ``friction`` (N; N·m) is a tenth of what accelerates it by one unit; ``effort`` is twice what the servo asks
    for over the whole range, ``velocity`` goes end to end in half a second.
    """
    inertia, _ = axis_load(link, links)
    span = link.limits[1] - link.limits[0]
    return {
        "damping": 2 * inertia,
        "friction": 0.1 * inertia,
        "effort": 2 * servo_gain(link, links) * span,
        "velocity": 2 * span,
    }


def numbers(values: object) -> str:
    """Numbers separated by spaces, as XML attributes want them."""
    return " ".join(f"{v:.9g}" for v in np.asarray(values, float).ravel() + 0.0)


def _link(
    name: str,
    part: Part,
    joint: Joint | None,
    parent: Link | None,
    solid: trimesh.Trimesh | None,
    pieces: tuple[trimesh.Trimesh, ...],
    twin: Twin,
    config: ExportConfig,
) -> Link:
    R, factor = placement(twin, config)
    origin = np.zeros(3)
    if joint is not None:
        origin = factor * R @ np.asarray(joint.pivot, float)
        unit = factor if joint.type == "prismatic" else 1.0
        low, high = joint.limits
        axis = R @ np.asarray(joint.axis, float)
        x, y, z = axis / np.linalg.norm(axis)
        states = tuple(unit * value for value in joint.states)
        limits = (unit * low, unit * high)
        joint = replace(joint, axis=(x, y, z), pivot=tuple(origin), states=states, limits=limits)
    if solid is None:
        token = np.eye(3) * 1e-6
        return Link(name, part, joint, parent, origin, None, (), 1e-3, np.zeros(3), token)
    T_link_twin = np.eye(4)
    T_link_twin[:3, :3], T_link_twin[:3, 3] = factor * R, -origin
    hulls = tuple(piece.copy().apply_transform(T_link_twin) for piece in pieces)
    mesh = solid.copy().apply_transform(T_link_twin)
    mesh.density = config.density
    inertia = np.asarray(mesh.moment_inertia)
    com, mass = np.asarray(mesh.center_mass), float(mesh.mass)
    return Link(name, part, joint, parent, origin, mesh, hulls, mass, com, (inertia + inertia.T) / 2)


def _extended(joint: Joint, twin: Twin, solids: dict[int, trimesh.Trimesh]) -> Joint:
    """The joint with limits as far as its part, and what hangs from it, stays free of what it hangs from."""
    ancestors, above = {0}, joint.parent
    while above not in ancestors:
        ancestors.add(above)
        holder = twin.joint_of(above)
        above = holder.parent if holder else 0
    moving = [i for i in solids if _hangs_from(twin, i, joint.child)]
    if joint.type == "fixed" or not moving or not ancestors & solids.keys():
        return joint
    most, step = np.pi, np.radians(2)
    if joint.type == "prismatic":
        along = np.concatenate([solids[i].vertices for i in moving]) @ np.asarray(joint.axis)
        most = float(np.ptp(along))  # A slide is not pulled out farther than it is long.
        step = most / 50
    limits = free_range(
        [solids[i] for i in moving],
        [solids[i] for i in ancestors if i in solids],
        joint.transform,
        joint.limits,
        (-most, most),
        step,
    )
    return replace(joint, limits=limits)


def _hangs_from(twin: Twin, part: int, ancestor: int) -> bool:
    """Whether a part is ``ancestor`` or hangs from it."""
    while part != ancestor:
        joint = twin.joint_of(part)
        if joint is None:
            return False
        part = joint.parent
    return True


def _parents_first(twin: Twin) -> list[Part]:
    """The parts of a twin, each after the one it hangs from."""
    order: list[Part] = []
    waiting = list(twin.parts)
    while waiting:
        known = {p.id for p in order}
        ready = [p for p in waiting if (joint := twin.joint_of(p.id)) is None or joint.parent in known]
        if not ready:
            raise HingesplatError(f"twin: part {waiting[0].id} hangs from no base; mend joints[].parent in twin.json")
        order += sorted(ready, key=lambda p: p.id)
        waiting = [p for p in waiting if p not in ready]
    return order


def _unique_names(twin: Twin) -> dict[int, str]:
    """Names fit for files, XML and USD; the base is ``base``, and no part ``world``, which formats reserve."""
    names: dict[int, str] = {}
    for part in twin.parts:
        name = "base" if part.id == 0 else re.sub(r"\W+", "_", part.name, flags=re.ASCII).strip("_")
        if not name or name[0].isdigit() or name == "world":
            name = f"part_{name or part.id}"
        while name in names.values():
            name = f"{name}_{part.id}"
        names[part.id] = name
    return names
