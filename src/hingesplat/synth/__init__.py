"""Made objects: articulated, textured, ray-traced, written as a capture with its truth beside it."""

from hingesplat.synth.make import NAMES, make

__all__ = ["NAMES", "make"]
