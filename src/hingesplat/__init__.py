"""Photographs of an articulated thing in two states in, a moving digital twin out."""

__version__ = "0.1.0"
