"""Text of measuring programs: files that hold it, names of points, and how messages quote it."""

from __future__ import annotations

import re
from itertools import islice
from pathlib import Path

from stapeskit.faults import StapeskitError

TEXT_ENDINGS = (".txt", ".asc", ".csv", ".tsv", ".dat")
ENDINGS = (*TEXT_ENDINGS, ".uff", ".unv", ".mat", ".h5", ".hdf5", ".npz", ".svd")
"""Of files that may be a measurement."""
CUT = "It looks cut short: export or copy it again"

_MOST_FILES = 100_000  # a point and axis each of 30 000 points; a home folder has more


def shown(text: str, most: int = 60) -> str:
    """Return text from a file as messages quote it: printable and short."""
    printable = "".join(letter if letter.isprintable() else "?" for letter in text.strip())
    return printable if len(printable) <= most else f"{printable[:most]}..."


def plain_name(name: str) -> str:
    """Return the name of a point or body; ``1.0``, which a spreadsheet made of ``1``, is ``1``."""
    match = re.fullmatch(r"(\d+)[.,]0+", name.strip())
    return match[1] if match else name.strip()


def export_files(folder: Path) -> list[Path]:
    """Return the files in a folder and its folders that may be text exports: by ending, not hidden.

    Raises
    ------
    StapeskitError
        It holds more files than a measurement has.
    """
    files = list(islice(folder.rglob("*"), _MOST_FILES + 1))
    if len(files) > _MOST_FILES:
        got, step = f"more than {_MOST_FILES}", "Give the folder of the exported text files"
        raise StapeskitError.of("the folder", "one with the files of a measurement", got, folder.name, step)
    chosen = [file for file in files if file.suffix.lower() in TEXT_ENDINGS and not file.name.startswith(".")]
    return sorted(file for file in chosen if file.is_file())
