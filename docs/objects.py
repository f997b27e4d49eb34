"""Draw the made objects on one sheet: ``python docs/objects.py [--out docs/objects.png]``."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from PIL import Image, ImageDraw

from hingesplat.synth.make import FIELD_OF_VIEW, camera_at, fine_texel, unit_box
from hingesplat.synth.objects import NAMES, build
from hingesplat.synth.trace import LitScene, Surface


@dataclass(frozen=True)
class Options:
    out: Path = Path("docs/objects.png")
    names: tuple[str, ...] = NAMES
    seed: int = 0
    size: int = 160
    """Pixels of one picture."""
    columns: int = 5
    """Objects in a row; each is shown in both states."""
    eye: tuple[float, float, float] = (-0.5, -0.78, 0.55)
    """Direction from the object to the camera."""


def pictures(name: str, seed: int, size: int, eye: tuple[float, float, float]) -> list[Image.Image]:
    """The object in state 0 and in state 1, on white."""
    model = build(name, seed)
    centre, scale, radius = unit_box(model)
    distance = 0.95 * radius / scale / np.sin(FIELD_OF_VIEW / 2)
    camera = camera_at(centre + distance * np.asarray(eye) / np.linalg.norm(eye), centre, size)
    surface, drawn = Surface(model, fine_texel(model, size, scale)), []
    for state in (0, 1):
        rgba = Image.fromarray(LitScene(surface, model.state(state)).photograph(camera)[0])
        drawn.append(Image.alpha_composite(Image.new("RGBA", rgba.size, "white"), rgba).convert("RGB"))
    return drawn


def main() -> None:
    o = tyro.cli(Options, description=__doc__)
    rows = -(-len(o.names) // o.columns)
    sheet = Image.new("RGB", (2 * o.columns * o.size, rows * (o.size + 14)), "white")
    pen = ImageDraw.Draw(sheet)
    for i, name in enumerate(o.names):
        x, y = i % o.columns * 2 * o.size, i // o.columns * (o.size + 14)
        for k, picture in enumerate(pictures(name, o.seed, o.size, o.eye)):
            sheet.paste(picture, (x + k * o.size, y))
        pen.text((x + o.size, y + o.size), name, fill="black", anchor="ma")
    sheet.quantize(256, dither=Image.Dither.NONE).save(o.out, optimize=True)


if __name__ == "__main__":
    main()
