"""The files that are read together with a scan: voxels of a separate header, or the header of voxels."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.formats import format_of
from legacy.ct_inertia.surface.surface import SURFACE_SUFFIXES


def with_data_files(inputs: Mapping[str, Path | None]) -> dict[str, Path | None]:
    """Return inputs by role, with the data files of headers as ``<role>_data``, ``<role>_data_2``, ..."""
    files: dict[str, Path | None] = {}
    for role, path in inputs.items():
        files[role] = path
        for number, data in enumerate(data_files(path), start=1):
            files[f"{role}_data" if number == 1 else f"{role}_data_{number}"] = data
    return files


def data_files(path: Path | None) -> list[Path]:
    """Return the other files that are read with a scan: voxels of a header, or the header of raw voxels.

    Returns
    -------
    list of Path
        Empty for files that hold their own voxels, and for headers that cannot be read.
    """
    if path is None or not Path(path).is_file():
        return []
    path = Path(path)
    if path.suffix.lower() in SURFACE_SUFFIXES:
        return []
    try:
        files = format_of(path).companion_files(path)
        return [file for file in files if file != path and file.is_file()]
    except (CtInertiaError, OSError):
        return []
