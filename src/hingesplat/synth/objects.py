"""All made objects by name."""

from collections.abc import Callable

import numpy as np

from hingesplat.synth import appliances, furniture, things
from hingesplat.synth.model import Model

MAKERS: dict[str, Callable[[np.random.Generator], Model]] = {
    "cabinet": furniture.cabinet,
    "laptop": things.laptop,
    "foldchair": furniture.foldchair,
    "fridge": appliances.fridge,
    "oven": appliances.oven,
    "scissor": things.scissor,
    "stapler": things.stapler,
    "usb": things.usb,
    "washer": appliances.washer,
    "blade": things.blade,
    "storage": furniture.storage,
    "fridge3": appliances.fridge3,
    "table4": furniture.table4,
    "table5": furniture.table5,
    "storage3": furniture.storage3,
    "storage4": furniture.storage4,
    "storage7": furniture.storage7,
    "oven4": appliances.oven4,
    "latchdoor": furniture.latchdoor,
    "stapler3": things.stapler3,
}
"""Add at the end: a name's place is part of what a seed means."""
NAMES = tuple(MAKERS)
CAMERAS = 3
"""The place whose random numbers are the cameras'."""


def build(name: str, seed: int) -> Model:
    """The object ``name``: shape, textures, joints and joint values, all drawn from ``seed``."""
    place = NAMES.index(name) + 1
    return MAKERS[name](np.random.default_rng((place + (place >= CAMERAS), seed)))
