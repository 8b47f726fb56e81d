"""Rigid frames, twists, vibrometer measurements and their rigid-body coordinates: the ground floor."""

__version__ = "0.1.0"
