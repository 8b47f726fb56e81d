"""The error class of this room."""

from __future__ import annotations

from legacy.stapeskit.faults import StapeskitError


class FittingError(StapeskitError):
    """A fault in motion, mass matrix or options of a fit."""
