"""Which files of a Zarr array are stored: every folder is listed once, however many chunks are claimed."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.readers.refusals import header_fault, unreadable

# Most files of an array: 1024^3 voxels in chunks of 8^3 have 2 million; damaged shapes claim more.
_MOST_FILES = 4_000_000
_SEPARATORS = (".", "/")


@dataclass(frozen=True)
class ZarrFiles:
    """The files of a Zarr array: chunks or, of a sharded array, shards.

    Attributes
    ----------
    shape, stored : tuple of int
        Voxels of the array and of a file along every axis.
    separator : str
        ``.`` or ``/``: the separator between the numbers of a file name.
    leading : tuple of str
        The prefix of the numbers.
    """

    folder: Path
    shape: tuple[int, ...]
    stored: tuple[int, ...]
    separator: str
    leading: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        # Any other one could lead out of the folder.
        if self.separator not in _SEPARATORS:
            got = f"the separator {str(self.separator)[:40]!r}"
            raise header_fault(self.folder, "Zarr array", got)

    def path(self, at: Sequence[int]) -> Path:
        """Return the path of the file of a number along every axis."""
        return self.folder / self.separator.join([*self.leading, *map(str, at)])

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """Which files are there, by their number along every axis.

        Raises
        ------
        CtInertiaError
            The array claims more files than a folder can hold, or a folder cannot be read.
        """
        counts = tuple(-(-n // c) for n, c in zip(self.shape, self.stored, strict=True))
        if math.prod(counts) > _MOST_FILES:
            size = " x ".join(map(str, reversed(self.shape)))
            raise header_fault(self.folder, "Zarr array", f"a claim of {size} voxels")
        there = np.zeros(counts, dtype=np.bool_)
        for at in self._existing_chunks(counts):
            there[at] = True
        return there

    def _existing_chunks(self, counts: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
        """Yield the numbers of the files that are there; folders that are not there hold none."""
        nested = self.separator == "/"
        folders: list[tuple[Path, tuple[int, ...]]] = [
            (self.folder.joinpath(*self.leading) if nested else self.folder, ())
        ]
        looked_at = 0
        while folders:
            folder, above = folders.pop()
            for entry in _entries(folder):
                looked_at += 1
                if looked_at > _MOST_FILES:
                    raise header_fault(self.folder, "Zarr array", f"more than {_MOST_FILES} files")
                at = (*above, *([_number(entry.name)] if nested else self._parse_numbers(entry.name)))
                if not all(0 <= n < count for n, count in zip(at, counts, strict=False)):
                    continue
                if len(at) == len(counts) and entry.is_file():
                    yield at
                elif nested and len(at) < len(counts) and entry.is_dir():
                    folders.append((Path(entry.path), at))

    def _parse_numbers(self, name: str) -> list[int]:
        """Return the numbers in the name of a file, -1 for each part of the name that is no number."""
        parts = name.split(self.separator)
        count = len(self.leading)
        return [_number(part) for part in parts[count:]] if tuple(parts[:count]) == self.leading else [-1]


def _entries(folder: Path) -> Iterator[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            yield from entries
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as fault:
        raise unreadable(folder, fault) from fault


def _number(text: str) -> int:
    """Return the number that a name spells as writers do, without zeros in front; otherwise -1."""
    spelled = text.isascii() and text.isdigit() and len(text) < 10 and (text[0] != "0" or text == "0")
    return int(text) if spelled else -1
