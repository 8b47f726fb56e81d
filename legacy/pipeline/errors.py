"""The error class of this room."""

from __future__ import annotations

from legacy.stapeskit.faults import StapeskitError


class PipelineError(StapeskitError):
    """A fault in a study file or in what it points to."""
