"""The error class of this room."""

from __future__ import annotations

from legacy.stapeskit.faults import StapeskitError


class CtInertiaError(StapeskitError):
    """A fault in a volume, a segmentation, a surface, or in the options about them."""
