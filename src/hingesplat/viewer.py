"""A run or a capture in the browser, live; the one door to viser.

A part is a frame whose children never change: its splats, its mesh, the axis of its joint. A slider moves frames, so
parts follow at once, however many Gaussians they have.
"""

import io
import logging
import math
import socket
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from scipy import ndimage

from hingesplat.camera import Camera, common_up
from hingesplat.capture import Capture, View, load_capture, recognise, visual_hull
from hingesplat.errors import HingesplatError
from hingesplat.gaussians import SH_C0, Gaussians, posed
from hingesplat.pictures import fitted, in_part_colours, movable_share, part_colour, photograph, picture, sweep_values
from hingesplat.run_folder import capture_of, load_meshes, load_result, repel_points_of
from hingesplat.se3 import wxyz_to_matrix
from hingesplat.twin import Joint, Twin

try:
    import viser
    from viser.transforms import SO3
except ModuleNotFoundError as e:
    raise HingesplatError("the viewer needs viser: pip install 'hingesplat[view]'") from e

log = logging.getLogger(__name__)

EXTENT = 10.0
"""Size of the object in the browser: viser keeps covariances as float16, and those of a small object would vanish."""
PHOTO = 400
"""Longest side, pixels, of a photograph beside the scene."""
THUMBNAIL = 192
"""Of one on a camera's frustum."""
HULL = 64
"""Voxels along the longest side of a visual hull."""
PERIOD = 3.0
"""Seconds in which a joint plays out and back."""
LOOKS = ("splats", "splats, parts coloured", "meshes", "meshes, parts coloured")
RED = (0.86, 0.12, 0.24)


class Viewer:
    """A server and what it shows. ``close`` it, or use it in a ``with``."""

    def __init__(self, server: viser.ViserServer, shown: "TwinView | CaptureView") -> None:
        self.server, self.shown = server, shown

    @property
    def url(self) -> str:
        host = self.server.get_host()
        reached = {"0.0.0.0": "localhost", "::": "localhost"}.get(host, f"[{host}]" if ":" in host else host)
        return f"http://{reached}:{self.server.get_port()}"

    def close(self) -> None:
        self.shown.close()
        with redirect_stdout(io.StringIO()):  # It bids farewell, too.
            self.server.stop()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_viewer(path: Path, *, host: str = "127.0.0.1", port: int = 8080, masks: Path | None = None) -> Viewer:
    """Serve a run, or a capture, until the viewer is closed; ``port`` 0 takes a free one.

    ``masks`` are those of ``load_capture``.

    Raises:
        HingesplatError: the folder is neither, or broken; the port is taken; there is no such host.
    """
    if not path.is_dir():
        raise HingesplatError(f"{path}: {'is not a folder' if path.exists() else 'does not exist'}")
    _check_address(host, port)
    if (path / "twin.json").is_file():
        show = _open_run(path, masks)
    elif (path / "config.json").is_file():
        raise HingesplatError(f"{path}: this run has no twin yet; finish it with the same `hingesplat reconstruct`")
    else:
        try:
            recognise(path)
        except HingesplatError as e:
            raise HingesplatError(f"{path}: is no run, for it has no twin.json, and no capture ({e})") from e
        show = _open_capture(path, masks)
    with redirect_stdout(io.StringIO()):  # It greets, quiet or not.
        server = viser.ViserServer(host=host, port=port, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.set_panel_label(f"hingesplat · {path.resolve().name}")
    server.gui.main_panel.dock_left()
    server.gui.main_panel.set_width(420)
    return Viewer(server, show(server))


def _check_address(host: str, port: int) -> None:
    """viser would try the next ports by itself, and wait for ever where it may have none."""
    if not 0 <= port < 2**16:
        raise HingesplatError(f"port: must be 0 to 65535, not {port}")
    try:
        socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError as e:
        remedy = "give another --host or --port"
        raise HingesplatError(f"cannot listen on {host}, port {port} ({e.strerror}); {remedy}") from e


def _open_run(folder: Path, masks: Path | None) -> "Callable[[viser.ViserServer], TwinView]":
    gaussians, twin = load_result(folder)
    meshes, repel, source = load_meshes(folder, twin), repel_points_of(folder), capture_of(folder)
    capture = None
    try:
        capture = load_capture(source, max_size=PHOTO, masks=masks) if source else None
    except HingesplatError as e:
        log.warning("without its photographs: %s", e)
    return lambda server: TwinView(server, gaussians, twin, meshes, repel, capture)


def _open_capture(path: Path, masks: Path | None) -> "Callable[[viser.ViserServer], CaptureView]":
    capture, hulls = load_capture(path, max_size=PHOTO, masks=masks), []
    for state in capture.states:
        try:
            hulls.append(_surface(*visual_hull(state.train, HULL)))
        except HingesplatError as e:  # Bad cameras are worth a look, too.
            log.warning("%s", e)
            hulls.append((np.zeros((0, 3)), np.zeros((0, 3))))
    return lambda server: CaptureView(server, capture, hulls)


class Stage:
    """The object's place in the browser: world coordinates times ``scale``, its middle at ``scale`` · ``centre``."""

    def __init__(self, server: viser.ViserServer, points: np.ndarray, cameras: Sequence[Camera]) -> None:
        """``points`` (n, 3) are the object's; ``cameras``, maybe none, say where up is."""
        low, high = np.quantile(points, [0.002, 0.998], axis=0)
        self.server, self.centre = server, (low + high) / 2
        self.scale = EXTENT / max(float((high - low).max()), 1e-9)
        server.scene.set_up_direction(common_up(cameras) if cameras else np.array([0.0, 0.0, 1.0]))
        server.initial_camera.fov = math.radians(40)
        server.initial_camera.look_at = self.scale * self.centre
        self.begin_at(cameras[0].centre if cameras else self.centre + np.array([0.5, -0.8, 0.4]))

    def begin_at(self, eye: np.ndarray, away: float = 2.9) -> None:
        """New clients see the object from the side where ``eye`` (3,) is, from ``away`` extents."""
        towards = (eye - self.centre) / np.linalg.norm(eye - self.centre)
        self.server.initial_camera.position = self.scale * self.centre + away * EXTENT * towards

    def look_through(self, client: viser.ClientHandle, camera: Camera) -> None:
        """Put a client's camera where a photograph's was, so that it sees all of the photograph."""
        eye, R = self.scale * camera.centre, camera.T_world_camera[:3, :3]
        far = max(float((self.scale * self.centre - eye) @ R[:, 2]), 0.1 * EXTENT)
        across, upright = camera.width / camera.fx, camera.height / camera.fy
        with client.atomic():
            client.camera.position = eye
            client.camera.look_at = eye + far * R[:, 2]
            client.camera.wxyz = SO3.from_matrix(R).wxyz
            client.camera.fov = 2 * math.atan(max(upright, across / client.camera.aspect) / 2)


class Photographs:
    """Below the controls: a state's photograph, and beside it what the same camera sees of the twin."""

    def __init__(self, stage: Stage, capture: Capture) -> None:
        self.capture, self._server, gui = capture, stage.server, stage.server.gui
        with gui.add_folder("Photographs"):
            self._state = gui.add_dropdown("State", [state.name for state in capture.states])
            self._number = gui.add_slider("Photograph", 1, 2, 1, 1)
            self._caption = gui.add_markdown("")
            self._image = gui.add_image(np.full((PHOTO // 2, PHOTO, 3), 255, np.uint8))
            look = gui.add_button("Look from there", icon=viser.Icon.CAMERA)
        self._state.on_update(lambda _: self._fit_slider())
        look.on_click(lambda event: event.client and stage.look_through(event.client, self.view.camera))
        self._fit_slider()

    def on_change(self, changed: Callable[[], None]) -> None:
        """Call when another photograph is chosen."""
        for control in (self._state, self._number):
            control.on_update(lambda _: changed())

    @property
    def state(self) -> int:
        return [state.name for state in self.capture.states].index(self._state.value)

    @property
    def view(self) -> View:
        views = self.capture.states[self.state].train
        return views[min(self._number.value, len(views)) - 1]

    @property
    def picture(self) -> np.ndarray:
        """What stands there now, (height, width, 3) uint8."""
        return self._image.image

    @property
    def caption(self) -> str:
        return self._caption.content

    def choose(self, state: int, number: int) -> None:
        """Show a training photograph of a state; both count from 0."""
        self._state.value, self._number.value = self.capture.states[state].name, number + 1

    def show(self, *beside: Callable[[Camera], Image.Image]) -> None:
        """Draw the panel anew: the photograph, then what is made for its camera."""
        view = self.view
        camera = fitted(view.camera, PHOTO)
        pictures = [photograph(view, camera), *(make(camera) for make in beside)]
        gap = np.full((camera.height, 8, 3), 255, np.uint8)
        row = [x for p in pictures for x in (gap, np.asarray(p))][1:]
        with self._server.atomic():
            self._image.image = np.concatenate(row, axis=1)
            self._caption.content = f"`{view.name}`" + (" · the twin from there" if beside else "")

    def _fit_slider(self) -> None:
        self._number.max = len(self.capture.states[self.state].train)
        self._number.value = min(self._number.value, self._number.max)


class TwinView:
    """Parts on frames, a slider a joint, and the photographs beside renders from the same cameras.

    The sliders' values *are* the pose: whoever sets them, a hand or ``play``, the frames follow.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        gaussians: Gaussians,
        twin: Twin,
        meshes: Mapping[int, trimesh.Trimesh],
        repel: np.ndarray,
        capture: Capture | None,
    ) -> None:
        """``repel`` (n, 3) are repel points, maybe none; without a ``capture`` there are no photographs."""
        self.server, self.gaussians, self.twin = server, gaussians.detached(), twin
        self.joints = [j for j in twin.joints if j.type != "fixed"]
        cameras = [] if capture is None else [v.camera for state in capture.states for v in state.train]
        self.stage = Stage(server, gaussians.means.double().numpy(), cameras)
        self.frames = {p.id: server.scene.add_frame(f"/part_{p.id}", show_axes=False) for p in twin.parts}
        self.sliders: dict[int, viser.GuiSliderHandle[float]] = {}
        self._posing, self._playing = threading.Lock(), threading.Event()
        self._stale, self._closed = threading.Event(), threading.Event()
        self._add_controls()
        self._add_looks(meshes, repel)
        self.photos = None if capture is None else self._add_photographs(capture)
        self._stale.set()
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    @property
    def values(self) -> dict[int, float]:
        """Joint values by child: radians or scene units, within the limits."""
        return {
            j.child: min(max(self.sliders[j.child].value / _unit(j), j.limits[0]), j.limits[1]) for j in self.joints
        }

    def move(self, values: Mapping[int, float]) -> None:
        """Set the sliders, and so the parts, to joint values by child; the others to 0."""
        for joint in self.joints:
            slider = self.sliders[joint.child]
            slider.value = min(max(values.get(joint.child, 0.0) * _unit(joint), slider.min), slider.max)

    def to_state(self, state: int) -> None:
        """Set the joints as they were in an input state."""
        self.move({j.child: j.states[state] for j in self.joints})

    def play(self, on: bool) -> None:
        """Start or stop the joints' way through their ranges, one after another."""
        (self._playing.set if on else self._playing.clear)()
        self._play.label, self._play.icon = (
            ("Pause", viser.Icon.PLAYER_PAUSE) if on else ("Play", viser.Icon.PLAYER_PLAY)
        )

    def close(self) -> None:
        self._closed.set()
        self._thread.join()

    def _pose(self, _: object = None) -> None:
        """Every frame to where the twin's own transforms put its part."""
        with self._posing, self.server.atomic():
            for part_id, T in self.twin.transforms(self.values).items():
                self.frames[part_id].wxyz = SO3.from_matrix(T[:3, :3]).wxyz
                self.frames[part_id].position = self.stage.scale * T[:3, 3]
        self._stale.set()

    def _add_photographs(self, capture: Capture) -> "Photographs":
        """Begins with the photograph of the last state that shows most of what moved."""
        photos = Photographs(self.stage, capture)

        def follow() -> None:
            self.to_state(photos.state)
            self._stale.set()

        photos.on_change(follow)
        last = len(capture.states) - 1
        there, views = posed(self.gaussians, self.twin.at_state(last)), capture.states[last].train
        best = max(range(len(views)), key=lambda i: movable_share(there, views[i].camera))
        photos.choose(last, best)
        self.stage.begin_at(views[best].camera.centre)
        return photos

    def _live(self) -> None:
        """Plays, and draws what the photograph's camera sees once nothing plays."""
        time, tick = 0.0, 1 / 30
        while not self._closed.wait(tick):
            if self._playing.is_set():
                time = (time + tick / (PERIOD * len(self.joints))) % 1
                self.move(sweep_values(self.joints, time))
            elif self.photos is not None and self._stale.is_set():
                self._stale.clear()
                there = posed(self.gaussians, self.twin.transforms(self.values))
                self.photos.show(lambda camera, there=there: picture(there, camera))

    def _add_controls(self) -> None:
        gui, names = self.server.gui, {p.id: p.name for p in self.twin.parts}
        if self.joints:
            with gui.add_folder("Joints"):
                for joint in self.joints:
                    self.sliders[joint.child] = slider = _slider(gui, joint, names)
                    slider.on_update(self._pose)
                states = gui.add_button_group("State", [str(t) for t in range(len(self.joints[0].states))])
                states.on_click(lambda _: self.to_state(int(states.value)))
                self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
                self._play.on_click(lambda _: self.play(not self._playing.is_set()))
        shot = gui.add_button("Screenshot", icon=viser.Icon.PHOTO)
        shot.on_click(lambda event: event.client and _screenshot(event.client))

    def _add_looks(self, meshes: Mapping[int, trimesh.Trimesh], repel: np.ndarray) -> None:
        scene, scale, coloured = self.server.scene, self.stage.scale, in_part_colours(self.gaussians)
        looks: dict[str, list[Any]] = {look: [] for look in LOOKS}
        for part in self.twin.parts:
            root, rows = f"/part_{part.id}", self.gaussians.part == part.id
            if rows.any():
                looks[LOOKS[0]].append(_add_splats(scene, f"{root}/splats", self.gaussians[rows], scale))
                looks[LOOKS[1]].append(_add_splats(scene, f"{root}/coloured_splats", coloured[rows], scale))
            if part.id in meshes:
                mesh, colour = meshes[part.id], _rgb8(part_colour(part.id))
                looks[LOOKS[2]].append(scene.add_mesh_trimesh(f"{root}/mesh", mesh, scale=scale))
                looks[LOOKS[3]].append(
                    scene.add_mesh_simple(
                        f"{root}/coloured_mesh",
                        np.asarray(mesh.vertices),
                        np.asarray(mesh.faces),
                        color=colour,
                        scale=scale,
                    )
                )
        gui = self.server.gui
        with gui.add_folder("Show"):
            self.look = gui.add_dropdown("Parts as", [look for look in LOOKS if looks[look]])
            _follow(
                self.look, lambda: [(node, self.look.value == name) for name, nodes in looks.items() for node in nodes]
            )
            if self.joints:
                axes = gui.add_checkbox("Joint axes", True)
                arrows = [self._add_axis(joint) for joint in self.joints]
                _follow(axes, lambda: [(arrow, axes.value) for arrow in arrows])
            if len(repel):
                wall = gui.add_checkbox("Repel points", False)
                points = _add_points(scene, "/part_0/repel", repel, np.array(RED), scale, 0.004)
                _follow(wall, lambda: [(points, wall.value)])

    def _add_axis(self, joint: Joint) -> viser.ArrowsHandle:
        """An arrow on the child's frame: the joint's own motion does not take its axis elsewhere."""
        scale, axis, pivot = self.stage.scale, np.asarray(joint.axis), np.asarray(joint.pivot)
        means = self.gaussians.means[self.gaussians.part == joint.child].double().numpy()
        low, high = np.quantile((means - pivot) @ axis, [0.01, 0.99]) * scale if len(means) else (0.0, 0.0)
        start, end = (
            (low - 0.1 * EXTENT, high + 0.12 * EXTENT) if joint.type == "revolute" else (high, high + 0.25 * EXTENT)
        )
        return self.server.scene.add_arrows(
            f"/part_{joint.child}/axis",
            scale * pivot + np.array([[start * axis, end * axis]]),
            _rgb8(part_colour(joint.child)),
            shaft_radius=0.006 * EXTENT,
            head_radius=0.016 * EXTENT,
            head_length=0.045 * EXTENT,
        )


class CaptureView:
    """The cameras of every state with their photographs on them, and the visual hulls of the masks."""

    def __init__(
        self, server: viser.ViserServer, capture: Capture, hulls: Sequence[tuple[np.ndarray, np.ndarray]]
    ) -> None:
        """``hulls``: for each state points (n, 3), maybe none, and their normals (n, 3)."""
        cameras = [view.camera for state in capture.states for view in state.train]
        points = np.concatenate([h for h, _ in hulls if len(h)] or [[c.centre for c in cameras]])
        self.stage = Stage(server, points, cameras)
        scale, gui = self.stage.scale, server.gui
        away = float(np.median([np.linalg.norm(c.centre - self.stage.centre) for c in cameras]))
        self.stage.begin_at(cameras[0].centre + 0.5 * away * common_up(cameras), 2.2 * scale * away / EXTENT)
        frusta, clouds = [], []
        for t, (state, (points, normals)) in enumerate(zip(capture.states, hulls, strict=True)):
            colour = part_colour(t + 1)
            frusta.append([self._add_camera(t, i, v, colour, 0.07 * scale * away) for i, v in enumerate(state.train)])
            light = 0.7 + 0.3 * normals @ (np.array([1.0, -2.0, 3.0]) / 14**0.5)
            cloud = _add_points(server.scene, f"/hull_{t}", points, light[:, None] * colour, scale, 0.6 / HULL)
            clouds.append([cloud])
        names = [state.name for state in capture.states]
        shown = gui.add_dropdown("State", [*names, "all"], initial_value=names[0])
        with_cameras, with_hull = gui.add_checkbox("Cameras", True), gui.add_checkbox("Visual hull", True)

        def visible() -> list[tuple[Any, bool]]:
            return [
                (node, box.value and shown.value in (names[t], "all"))
                for box, groups in ((with_cameras, frusta), (with_hull, clouds))
                for t, nodes in enumerate(groups)
                for node in nodes
            ]

        for control in (shown, with_cameras, with_hull):
            _follow(control, visible)
        self.photos = Photographs(self.stage, capture)
        self.photos.on_change(self.photos.show)
        self.photos.show()

    def close(self) -> None:
        """Nothing of its own is running."""

    def _add_camera(self, state: int, number: int, view: View, colour: tuple[float, float, float], size: float) -> Any:
        camera = view.camera
        node = self.stage.server.scene.add_camera_frustum(
            f"/state_{state}/camera_{number}",
            2 * math.atan(camera.height / camera.fy / 2),
            camera.width / camera.height,
            scale=size,
            thickness=0.02 * size,
            color=_rgb8(colour),
            image=np.asarray(photograph(view, fitted(camera, THUMBNAIL))),
            wxyz=SO3.from_matrix(camera.T_world_camera[:3, :3]).wxyz,
            position=self.stage.scale * camera.centre,
            cast_shadow=False,
            receive_shadow=False,
        )
        node.on_click(lambda _: self.photos.choose(state, number))
        return node


def _surface(points: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Of a hull's voxels (n, 3) those at its surface (m, 3), and their outward normals (m, 3)."""
    cells = np.round((points - points.min(0)) / voxel).astype(int) + 2
    full = np.zeros(cells.max(0) + 3)
    full[tuple(cells.T)] = 1
    smooth = ndimage.gaussian_filter(full, 1.5)
    outward = -np.stack([np.asarray(ndimage.sobel(smooth, axis))[tuple(cells.T)] for axis in range(3)], 1)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    outer = np.asarray(ndimage.binary_erosion(full))[tuple(cells.T)] == 0
    return points[outer], outward[outer]


def _unit(joint: Joint) -> float:
    """Slider units a joint unit: hinges show degrees."""
    return math.degrees(1) if joint.type == "revolute" else 1.0


def _slider(gui: viser.GuiApi, joint: Joint, names: Mapping[int, str]) -> viser.GuiSliderHandle[float]:
    """Round numbers that just hold the limits."""
    low, high = (value * _unit(joint) for value in joint.limits)
    step = 10.0 ** math.floor(math.log10(max(high - low, 1e-9) / 100))
    low, high = (
        round(f(value / step - s) * step, 12) for f, value, s in ((math.floor, low, -1e-9), (math.ceil, high, 1e-9))
    )
    return gui.add_slider(
        f"{names[joint.child]}{' (°)' if joint.type == 'revolute' else ''}",
        low,
        high,
        step,
        min(max(0.0, low), high),
        hint=f"{joint.type} on {names[joint.parent]}" + (f": {joint.verdict}" if joint.verdict else ""),
    )


def _follow(control: Any, visible: Callable[[], Iterable[tuple[Any, bool]]]) -> None:
    """Keep nodes as visible as a control's value says."""

    def apply(_: object = None) -> None:
        for node, on in visible():
            node.visible = on

    control.on_update(apply)
    apply()


def _screenshot(client: viser.ClientHandle) -> None:
    """What the client sees, as a file it saves; transparent behind the object."""
    file = io.BytesIO()
    with suppress(RuntimeError):  # The page is closed before it has answered.
        seen = client.get_render(client.camera.image_height, client.camera.image_width, transport_format="png")
        Image.fromarray(seen).save(file, "PNG")
        client.send_file_download("hingesplat.png", file.getvalue(), save_immediately=True)


def _add_splats(scene: viser.SceneApi, name: str, g: Gaussians, scale: float) -> Any:
    axes = wxyz_to_matrix(g.quats.double()) * (scale * g.scales.double())[:, None, :]
    return scene.add_gaussian_splats(
        name,
        scale * g.means.double().numpy(),
        (axes @ axes.mT).numpy(),
        (0.5 + SH_C0 * g.sh[:, 0]).clamp(0, 1).numpy(),
        g.opacities[:, None].numpy(),
    )


def _add_points(
    scene: viser.SceneApi, name: str, points: np.ndarray, colours: np.ndarray, scale: float, size: float
) -> Any:
    """``colours`` (3,) or (n, 3) in [0, 1]; ``size`` of a point as a share of the object's."""
    cloud = (scale * points).astype(np.float32)
    return scene.add_point_cloud(
        name, cloud, colours, point_size=size * EXTENT, point_shape="circle", precision="float32"
    )


def _rgb8(colour: Iterable[float]) -> tuple[int, int, int]:
    r, g, b = (round(255 * c) for c in colour)
    return r, g, b
