"""Formats of a measurement: one writer each, entered in a table by its name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from simulate.files import spectra
from simulate.files.tables import write_fiducials, write_tables
from simulate.vibrometer import Recording

WRITERS: dict[str, Callable[[Path, Recording], Path]] = {
    "csv": write_tables,
    "wide": spectra.write_wide,
    "uff": spectra.write_uff_binary,
    "fastscan": spectra.write_fastscan,
    "mat": spectra.write_matlab,
}
"""Writers by format: they write into a folder, points included, and return the main file or folder."""


def write_recording(folder: Path, recording: Recording, fmt: str = "csv") -> Path:
    """Write a recording, its points and fiducials into a folder in one of WRITERS; return the main file."""
    folder.mkdir(parents=True, exist_ok=True)
    path = WRITERS[fmt](folder, recording)
    if recording.fiducials:
        write_fiducials(folder / "fiducials.csv", recording)
    return path
