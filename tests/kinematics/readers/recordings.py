"""The recordings of one file, whatever its format."""

from __future__ import annotations

from pathlib import Path

from legacy.kinematics.readers.input_options import InputOptions
from legacy.kinematics.readers.recognise_format import format_of
from legacy.kinematics.readers.recording import Recordings


def read_recordings(path: Path, options: InputOptions | None = None) -> Recordings:
    return format_of(path).read(Path(path), options or InputOptions())
