"""``report.html``: self-contained, small, safe to open; and in a browser, sliders that move parts and nothing else."""

import base64
import gzip
import hashlib
import io
import json
import re
import shutil
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from html.parser import HTMLParser
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from hingesplat import cli
from hingesplat.camera import Camera
from hingesplat.capture.types import View
from hingesplat.export.spz import spz_bytes
from hingesplat.gaussians import SH_C0, Gaussians, posed
from hingesplat.render import render
from hingesplat.report import spread_views, write_report, write_views
from hingesplat.report.curves import chart_rows
from hingesplat.report.page import scene
from hingesplat.twin import Joint, JointStd, Part, Twin

SLIDE = Joint(
    *(1, 0, "prismatic", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.5), (0.0, 0.5), JointStd(0.1, None, 0.001), 0.995),
    "axis ±0.1°, seen in 3 of 4 views",
)
HINGE = Joint(
    *(2, 1, "revolute", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, np.pi / 2), (0.0, np.pi / 2)),
    *(JointStd(0.1, 0.01, 0.02), 0.6),
)
T = np.eye(4)
T[:3, 3] = 0.1, 0.15, -4.0
CAMERA = Camera(T, 160, 160, 80, 60, 160, 120)
"""Looks along +z, y downwards, at the middle of where the balls of ``made`` go."""
HOSTILE = "<script>alert('x')</script>"


def blobs(centres: list[tuple[float, float, float]], colours: list[tuple[float, float, float]]) -> Gaussians:
    """A ball a part."""
    n = len(centres)
    return Gaussians(
        torch.tensor(centres),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.full((n, 3), 0.03).log(),
        torch.full((n,), 6.0),
        ((torch.tensor(colours) - 0.5) / SH_C0)[:, None],
        torch.arange(n),
    )


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run: red stays, green slides right, and blue, that green carries, turns from right to below."""
    run = tmp_path_factory.mktemp("report") / "run"
    views = run / "views"
    views.mkdir(parents=True)
    # A part of which nothing is left has a joint, too.
    gaussians = blobs([(-0.6, 0, 0), (0, 0, 0), (0.3, 0, 0)], [(0.9, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.1, 0.9)])
    parts = (Part(0, "base", 1), Part(1, HOSTILE, 1, splats="parts/1.ply"), Part(2, "flap & co", 1), Part(3, "gone", 0))
    twin = Twin(parts, (SLIDE, HINGE, replace(SLIDE, child=3)))
    twin.save(run / "twin.json")
    gaussians.save(run / "gaussians.safetensors")
    states = []
    for t in range(2):
        there = posed(gaussians, twin.at_state(t))
        image = render(there, CAMERA)
        rgba = torch.cat([image.rgb / image.alpha.clamp(min=1e-4), image.alpha[None]]).clamp(0, 1)
        pixels = (rgba.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
        states.append(([View(CAMERA, pixels, f"state_{t}/{HOSTILE}.png")], there))
    write_views(views, states, np.array([0.0, -1.0, 0.0]), held_out=True)
    write = {
        "config.json": {"capture": f"/captures/{HOSTILE.replace('/', '')}"},
        "stages.json": {"fit": {"seconds": 124.2}, "joints": {"seconds": 1.0}},
        "curves.json": {
            "fit state 0": {"step": [1, 51, 100], "loss": [0.3, 0.1, 0.05], "psnr": [15.0, 22.5, 30.5]},
            "fit state 1": {"step": [1, 51, 100], "loss": [0.3, 0.2, 0.1], "psnr": [14.0, 20.0, 25.0]},
        },
    }
    for name, data in write.items():
        (run / name).write_text(json.dumps(data))
    (run / "export" / "mjcf").mkdir(parents=True)
    (run / "export" / "mjcf" / "twin.xml").touch()
    write_report(run)
    return run


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "run"))


class Links(HTMLParser):
    """Everything a page would fetch, and its visible text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.text: list[str] = []
        self.inside: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in ("script", "style"):
            self.inside.append(tag)
        for name, value in attrs:
            if name in ("src", "href", "srcset", "data", "poster", "action", "xlink:href"):
                self.found.append(value or "")
            elif name == "style":
                self.found += re.findall(r"url\(([^)]*)\)", value or "")

    def handle_endtag(self, tag: str) -> None:
        if tag in ("script", "style"):
            self.inside.pop()

    def handle_data(self, data: str) -> None:
        if self.inside == ["style"]:
            self.found += re.findall(r"url\(([^)]*)\)|@import\s*(\S+)", data)
        elif not self.inside:
            self.text.append(data)


def embedded(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="twin-data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def test_the_page_fetches_nothing_and_says_so_to_the_browser(made: Path):
    page = (made / "report.html").read_text()
    links = Links(page).found
    assert len(links) == 1 + 1 + 4  # The icon, the poster, two pictures a view.
    assert all(link.startswith("data:") for link in links)
    assert "default-src 'none'" in page


def test_the_page_shows_every_joint_and_escapes_names(made: Path):
    page = (made / "report.html").read_text()
    assert HOSTILE not in page
    text = " ".join("".join(Links(page).text).split())
    for words in (
        *(HOSTILE, "flap & co", "prismatic", "revolute", "0.000 … 0.500 units", "0.0° … 90.0°"),
        *("axis ±0.1°, seen in 3 of 4 views", "certain, 0.99", "uncertain, 0.60", "± 0.1°", "± 1.1°"),
        *("2 min 5 s", "fit, PSNR, dB", "30.5", "export/mjcf/twin.xml", "made without these photographs"),
    ):
        assert words in text, words
    assert [joint["child"] for joint in embedded(page)["joints"]] == [1, 2, 3]


def test_metrics_appear_once_there_are_some(run: Path):
    assert "Beside the truth" not in (run / "report.html").read_text()
    metrics = {
        "parts_true": 3,
        "parts_found": 2,
        "superfluous_parts": 1,
        "joints": [
            {"truth": "lid", "part": 2, "type_true": "revolute", "type_found": "prismatic"}
            | {"axis_deg": 1.25, "pivot": None, "motion_deg": 3.5, "motion_units": None},
            {"truth": "drawer", "part": None, "type_true": "prismatic", "type_found": None}
            | {"axis_deg": 90.0, "pivot": None, "motion_deg": None, "motion_units": None},
        ],
        "cd": {"whole": 1.5, "movable": [0.25, None]},
        "views": {"psnr": None, "ssim": None},
        "part_iou": None,
    }
    (run / "metrics.json").write_text(json.dumps(metrics))
    assert cli.main(["report", str(run), "--quiet"]) == 0
    text = " ".join("".join(Links((run / "report.html").read_text()).text).split())
    for words in (
        "Beside the truth",
        "2 of 3",
        "flap & co prismatic is revolute 1.250° – 3.500° 0.25",
        "drawer missed",
    ):
        assert words in text, words


def test_a_run_with_a_twin_and_nothing_else_gets_a_page(run: Path):
    for path in run.iterdir():
        if path.name not in ("twin.json", "gaussians.safetensors"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    twin = Twin.load(run / "twin.json")
    Twin(twin.parts[:1], ()).save(run / "twin.json")
    text = "".join(Links(write_report(run).read_text()).text)
    assert "this twin has no joints" in text and "Photographs and the twin" not in text


def test_broken_runs_give_one_clear_line(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    def line() -> str:
        assert cli.main(["report", str(run), "--quiet"]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        return error

    (run / "curves.json").write_text("{")
    assert "curves.json: not valid JSON" in line()
    (run / "curves.json").write_text('{"fit": {"step": [1]}}')
    assert "not of this version" in line()
    (run / "curves.json").unlink()
    (run / "views" / "state1_0_twin.webp").unlink()
    assert "state1_0_twin.webp: missing" in line()
    (run / "twin.json").unlink()
    assert "run `hingesplat reconstruct` first" in line()
    assert cli.main(["report", str(tmp_path / "nowhere")]) == 2


def test_a_hundred_thousand_gaussians_stay_below_ten_megabytes(run: Path):
    """The worst case: noise does not compress."""
    n = 100_000
    r = torch.Generator().manual_seed(0)
    noise = Gaussians(
        torch.randn(n, 3, generator=r),
        torch.randn(n, 4, generator=r),
        torch.randn(n, 3, generator=r) - 4,
        torch.randn(n, generator=r),
        torch.randn(n, 16, 3, generator=r) / 3,
        torch.randint(0, 3, (n,), generator=r),
    )
    noise.save(run / "gaussians.safetensors")
    assert write_report(run).stat().st_size < 9_500_000


def decoded(data: bytes) -> dict[str, np.ndarray]:
    """SPZ version 3 read by the letter of its description."""
    raw = gzip.decompress(data)
    magic, version, n, degree, places, _, _ = struct.unpack_from("<IIIBBBB", raw)
    assert (magic, version) == (0x5053474E, 3)
    k = (degree + 1) ** 2 - 1
    widths = {"centre": 9, "alpha": 1, "colour": 3, "scale": 3, "quat": 4, "sh": 3 * k}
    assert len(raw) == 16 + n * sum(widths.values())
    columns, at = {}, 16
    for name, width in widths.items():
        columns[name] = np.frombuffer(raw, np.uint8, n * width, at).reshape(n, width).astype(np.int64)
        at += n * width
    centre = columns["centre"].reshape(n, 3, 3) @ np.array([1, 256, 65536])
    quats = np.zeros((n, 4))
    for i, word in enumerate(columns["quat"] @ (256 ** np.arange(4))):
        largest = word >> 30
        for j in (j for j in (3, 2, 1, 0) if j != largest):
            quats[i, j] = (word & 511) / 511 / np.sqrt(2) * (-1 if word & 512 else 1)
            word >>= 10
        quats[i, largest] = np.sqrt(1 - (quats[i] ** 2).sum())
    return {
        "means": np.where(centre >= 1 << 23, centre - (1 << 24), centre) / 2**places,
        "opacities": columns["alpha"][:, 0] / 255,
        "sh0": (columns["colour"] / 255 - 0.5) / 0.15,
        "log_scales": columns["scale"] / 16 - 10,
        "quats": quats[:, [3, 0, 1, 2]],
        "sh": ((columns["sh"] - 128) / 128).reshape(n, k, 3),
    }


@pytest.mark.parametrize("size", [1e-3, 1.0, 300.0])
def test_spz_keeps_what_it_is_given(size: float):
    r = torch.Generator().manual_seed(1)
    n = 300
    g = Gaussians(
        torch.randn(n, 3, generator=r) * size,
        torch.randn(n, 4, generator=r),
        torch.rand(n, 3, generator=r) * 6 - 8,
        torch.randn(n, generator=r),
        torch.rand(n, 9, 3, generator=r) - 0.5,
        torch.zeros(n, dtype=torch.int64),
    )
    found = decoded(spz_bytes(g))
    assert np.abs(found["means"] - g.means.numpy()).max() < size * 2e-6
    assert np.abs(found["opacities"] - g.opacities.numpy()).max() < 0.003
    assert np.abs(found["log_scales"] - g.log_scales.numpy()).max() <= 1 / 32 + 1e-6
    assert np.abs(found["sh0"] - g.sh[:, 0].numpy()).max() < 0.014
    assert np.abs(found["sh"] - g.sh[:, 1:].numpy()).max() <= 1 / 256 + 1e-6
    q = torch.nn.functional.normalize(g.quats, dim=1).numpy()
    assert np.abs((found["quats"] * q).sum(1)).min() > np.cos(np.radians(0.2) / 2)
    assert decoded(spz_bytes(g, max_degree=0))["sh"].shape == (n, 0, 3)
    assert len(decoded(spz_bytes(g[:0]))["means"]) == 0


def test_the_scene_does_not_depend_on_units_or_place(made: Path):
    twin, g = Twin.load(made / "twin.json"), Gaussians.load(made / "gaussians.safetensors")
    first = json.loads((made / "views" / "views.json").read_text())["views"][1]
    here = scene(twin, g, [0, -1, 0], first)
    factor, away = 40.0, np.array([5.0, -3.0, 2.0])
    g.means, g.log_scales = g.means * factor + torch.tensor(away).float(), g.log_scales + np.log(factor)
    joints = []
    for joint in twin.joints:
        unit = factor if joint.type == "prismatic" else 1.0
        data = vars(joint) | {"pivot": tuple(np.array(joint.pivot) * factor + away)}
        joints.append(Joint(**data | {k: tuple(v * unit for v in data[k]) for k in ("states", "limits")}))
    first["camera"]["position"] = (np.array(first["camera"]["position"]) * factor + away).tolist()
    there = scene(Twin(twin.parts, tuple(joints)), g, [0, -1, 0], first)
    assert there["size"] == pytest.approx(factor * here["size"], rel=1e-5)
    assert there["pixel"] == pytest.approx(here["pixel"], rel=1e-5)
    for a, b in zip(here["joints"], there["joints"], strict=True):
        assert np.allclose(a["pivot"], b["pivot"], atol=1e-5)
    for a, b in zip(here["parts"][:3], there["parts"][:3], strict=True):
        one, other = (decoded(base64.b64decode(part["spz"])) for part in (a, b))
        assert np.allclose(one["means"], other["means"], atol=1e-5)
        assert np.allclose(one["log_scales"], other["log_scales"], atol=0.07)


def test_views_are_spread_and_as_large_as_the_photographs(tmp_path: Path):
    def looking(angle: float) -> View:
        turned = np.eye(4)
        turned[:3, 2] = np.sin(angle), 0, np.cos(angle)
        turned[:3, 0] = np.cos(angle), 0, -np.sin(angle)
        camera = Camera(turned, 50, 50, 30, 20, 60, 40)
        return View(camera, np.zeros((40, 60, 4), np.uint8), f"{angle}")

    views = [looking(angle) for angle in (0.0, 0.2, 1.5, 3.1)]
    assert [v.name for v in spread_views(views, views[1], 3)] == ["0.2", "3.1", "1.5"]
    assert len(spread_views(views, views[0], 9)) == 4
    far = blobs([(0.0, 0.0, -99.0)], [(1.0, 1.0, 1.0)])
    write_views(tmp_path, [(views[:1], far)], np.array([0.0, 0, 1]), held_out=False, size=30)
    write_views(tmp_path, [(views[:1], far)], np.array([0.0, 0, 1]), held_out=False)
    entry = json.loads((tmp_path / "views.json").read_text())["views"][0]
    assert entry["size"] == [60, 40] and entry["psnr"] == 100  # Both pictures are empty.
    with Image.open(tmp_path / entry["twin"]) as image:
        assert image.size == (60, 40)


def test_charts_group_states_and_survive_odd_numbers():
    flat = {"step": [5], "loss": [0.0], "psnr": [float("nan")]}
    rows = chart_rows({"fit state 0": flat, "fit state 1": flat, "joints": flat})
    assert [[chart["stage"] for chart in row] for row in rows] == [["fit", "joints"], ["fit", "joints"]]
    assert [line["label"] for line in rows[0][0]["lines"]] == ["state 0", "state 1"]
    assert chart_rows({}) == []


def test_the_bundle_is_what_web_builds():
    """After a change in web/ `make web` has to make the bundle anew."""
    web = Path(__file__).parents[1] / "web"
    recorded = dict(line.split("  ")[::-1] for line in (web / "bundle.sha256").read_text().splitlines())
    sources = {p.relative_to(web).as_posix() for p in (web / "src").rglob("*.js")}
    assert sources | {"package.json", "package-lock.json", "build.mjs"} == {p for p in recorded if p[0] != "."}
    for path, digest in recorded.items():
        assert hashlib.sha256((web / path).read_bytes()).hexdigest() == digest, f"{path} changed: run `make web`"
    bundle = files("hingesplat.report").joinpath("bundle.js").read_text()
    assert bundle.count("MIT License") >= 3  # Of three, Spark and fflate: their licence asks to be kept.


# In a browser.

Open = Callable[..., Any]


@pytest.fixture(scope="module")
def open_page(browser: Any, made: Path) -> Open:
    """Opens the report from disk; a message on the console or a request is kept in ``page.faults``."""

    def open_(within: Any = browser, **options: Any) -> Any:
        page = within.new_page(**{"viewport": {"width": 1000, "height": 700}, **options})
        page.faults = []
        page.on("console", lambda message: page.faults.append(message.text))
        page.on("pageerror", lambda error: page.faults.append(str(error)))
        page.on("request", lambda r: r.url.startswith(("data:", "blob:")) or page.faults.append(r.url))
        page.goto((made / "report.html").as_uri())
        page.wait_for_selector("#stage:not([aria-busy])", timeout=60_000)
        assert page.faults.pop(0) == (made / "report.html").as_uri()
        return page

    return open_


@pytest.fixture(scope="module")
def page(open_page: Open) -> Iterator[Any]:
    page = open_page()
    yield page
    assert page.faults == []
    page.close()


def picture(page: Any) -> np.ndarray:
    """The stage (height, width, 3) once its picture is final."""
    page.wait_for_timeout(50)
    stage = page.locator("#stage[data-still]")
    stage.wait_for()
    with Image.open(io.BytesIO(stage.screenshot())) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def places(image: np.ndarray) -> np.ndarray:
    """(3, 2) pixel centres x, y of the red, green and blue ball."""
    found = []
    for channel in range(3):
        others = np.delete(image, channel, axis=2).max(2)
        rows, columns = np.nonzero(image[..., channel] - others > 60)
        assert len(rows) > 20
        found.append((columns.mean(), rows.mean()))
    return np.array(found)


def slide(page: Any, number: int, share: float) -> None:
    slider = page.locator(".slider input").nth(number)
    slider.evaluate("(e, share) => { e.value = share * e.max; e.dispatchEvent(new Event('input')); }", share)


@pytest.fixture
def at_rest(page: Any) -> Any:
    page.click("[data-do=reset]")
    page.click("[data-state='0']")
    return page


def test_sliders_move_their_parts_along_the_chain_and_not_the_base(at_rest: Any):
    before = picture(at_rest)
    red, green, blue = places(before)
    unit = (green - red)[0] / 0.6  # Pixels.
    assert unit > 100 and blue - green == pytest.approx([0.3 * unit, 0], abs=2)
    slide(at_rest, 0, 1.0)
    after = picture(at_rest)
    slid = np.array([0.5 * unit, 0])
    assert places(after) == pytest.approx(np.array([red, green + slid, blue + slid]), abs=2)
    left = slice(0, round((red + green)[0] / 2))
    assert (before[:, left] == after[:, left]).all() and (before != after).any()
    slide(at_rest, 1, 1.0)
    turned = places(picture(at_rest))
    below = np.array([0, 0.3 * unit])
    assert turned == pytest.approx(np.array([red, green + slid, green + slid + below]), abs=3)
    at_rest.click("[data-state='0']")
    assert (picture(at_rest) == before).all()


def test_keys_move_sliders_and_say_what_they_did(at_rest: Any):
    slider = at_rest.locator(".slider input").nth(1)
    slider.focus()
    at_rest.keyboard.press("End")
    assert at_rest.locator(".slider output").nth(1).inner_text() == "90.0°"
    assert slider.get_attribute("aria-valuetext") == "90.0°"
    at_rest.keyboard.press("Home")
    at_rest.keyboard.press("ArrowRight")
    assert at_rest.locator(".slider output").nth(1).inner_text() == "0.5°"


def test_play_sweeps_and_stops(at_rest: Any):
    output = at_rest.locator(".slider output").first
    play = at_rest.locator("[data-do=play]")
    play.click()
    while output.inner_text() in ("0.000 units", "0.001 units"):
        at_rest.wait_for_timeout(50)
    play.click()
    stopped = output.inner_text()
    picture(at_rest)
    assert output.inner_text() == stopped and play.get_attribute("aria-pressed") == "false"


def test_switches_colour_parts_draw_axes_and_give_back_the_view(at_rest: Any):
    before = picture(at_rest)
    at_rest.click("[data-do=colours]")
    x, y = places(before)[0].round().astype(int)
    red, green, blue = picture(at_rest)[y, x]
    assert max(red, green, blue) - min(red, green, blue) < 12  # The base is grey.
    at_rest.click("[data-do=colours]")
    at_rest.click("[data-do=axes]")
    assert (picture(at_rest) != before).any(2).mean() > 0.003
    at_rest.click("[data-do=axes]")
    at_rest.locator("canvas").focus()
    at_rest.keyboard.press("ArrowLeft")
    at_rest.keyboard.press("+")
    assert (picture(at_rest) != before).any(2).mean() > 0.01
    at_rest.click("[data-do=reset]")
    at_rest.locator("canvas").blur()
    assert (picture(at_rest) == before).all()


def test_nothing_is_drawn_while_nothing_moves(at_rest: Any):
    picture(at_rest)
    frames = at_rest.locator("#stage").get_attribute("data-frames")
    at_rest.wait_for_timeout(500)
    assert at_rest.locator("#stage").get_attribute("data-frames") == frames


def test_the_wipe_follows_its_slider(page: Any):
    wipe = page.locator(".wipe input").first
    wipe.evaluate("e => { e.value = 80; e.dispatchEvent(new Event('input')); }")
    assert "inset(0px 20%" in page.locator(".wipe .over").first.evaluate("e => getComputedStyle(e).clipPath")


def test_a_phone_scrolls_down_only(open_page: Open):
    page = open_page(viewport={"width": 360, "height": 700})
    assert page.evaluate("document.documentElement.scrollWidth") == 360
    assert places(picture(page)).shape == (3, 2)
    page.close()


def test_without_webgl_a_line_says_so_and_the_pictures_stay(open_page: Open, chromium: Open):
    browser = chromium("--disable-3d-apis")
    page = open_page(browser)
    assert "no WebGL" in page.locator(".failed").inner_text()
    assert page.locator(".poster").is_visible() and page.locator("[data-do=play]").is_disabled()
    assert page.faults == []
    browser.close()
