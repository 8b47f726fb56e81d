"""The error class of this room."""

from __future__ import annotations

from kinematics.errors import StapeskitError


class FittingError(StapeskitError):
    """A fault in motion, mass matrix or options of a fit."""
