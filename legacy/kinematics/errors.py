"""The error class of this room."""

from __future__ import annotations

from legacy.stapeskit.faults import StapeskitError


class KinematicsError(StapeskitError):
    """A fault in vibrometer files, registration, or what the beams can observe."""
