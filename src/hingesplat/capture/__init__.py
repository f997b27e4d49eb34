"""Photographs in: ``load_capture`` recognises the layout, decodes, checks; ``write_state`` writes ours."""

from hingesplat.capture.hull import visual_hull
from hingesplat.capture.load import load_cameras, load_capture, recognise
from hingesplat.capture.types import Capture, State, View
from hingesplat.capture.write import write_state

__all__ = ["Capture", "State", "View", "load_cameras", "load_capture", "recognise", "visual_hull", "write_state"]
