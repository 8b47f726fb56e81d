"""Formats of a measurement: one writer each, entered in a table by its name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from simulate.files.tables import write_tables
from simulate.vibrometer import Recording

WRITERS: dict[str, Callable[[Path, Recording], Path]] = {"csv": write_tables}
"""Writers by format: they write into a folder, points and fiducials included, and return the main file."""


def write_recording(folder: Path, recording: Recording, fmt: str = "csv") -> Path:
    """Write a recording into a folder in one of WRITERS and return the main file."""
    return WRITERS[fmt](folder, recording)
