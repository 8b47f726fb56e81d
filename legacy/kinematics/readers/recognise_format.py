"""Which of the formats of `kinematics.readers.formats` a file or folder is.

What a file holds decides first, its name second; earlier entries win.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers import proprietary_formats
from legacy.kinematics.readers.formats import FORMATS, TIDY, ZIP, Format, Head
from legacy.kinematics.readers.mapping_file import mapping_of
from legacy.kinematics.readers.psv.text_blocks import EXPORT_ENDINGS, export_files
from legacy.stapeskit.faults import PARSER_ERRORS, StapeskitError

_HEAD_BYTES = 1 << 16  # holds the header of every known format


def format_of(path: Path, mapped: bool = False) -> Format:
    """Return the format of a file or folder; with a mapping, a table that is not known is a wide one.

    Raises
    ------
    KinematicsError
        There is no such file, or nothing known in it.
    """
    path = Path(path)
    if path.is_dir():
        return _format_of_folder(path)
    if not path.is_file():
        raise KinematicsError.of("the vibrometer file", "an existing file", path, "", "Check its name")
    head = _head_of(path)
    for entry in FORMATS:
        if entry.holds(replace(head, mapped=head.mapped or mapped)):
            return entry
    *first, last = (entry.words for entry in (FORMATS[-1], *FORMATS[:-1]) if entry.words)
    known = f"{', '.join(first)} or {last}"
    by_name = [entry for entry in FORMATS if head.suffix in entry.suffixes]
    if head.content.startswith(ZIP):
        if head.suffix in proprietary_formats.WORKBOOKS:
            proprietary_formats.refuse_workbook(path)
        step = "Unpack it, and give the files or folders in it"
        raise KinematicsError.of("the vibrometer file", known, "a ZIP archive", path.name, step)
    if not head.content and [entry.name for entry in by_name] != [TIDY]:
        step = "Export or copy it again"
        raise KinematicsError.of("the vibrometer file", "one with content", "0 bytes", path.name, step)
    if by_name:
        return by_name[0]
    raise KinematicsError.of(
        "the vibrometer file", known, path.name, next_step="See points2dof --help for the layouts"
    )


def companion_files(path: Path) -> list[Path]:
    """Return the files that are read with a vibrometer file or folder: its mapping, and those of its format.

    Returns
    -------
    list of Path
        Those that exist. What is wrong with the file itself is said when it is read.
    """
    path = Path(path)
    path = path if path.name else path.resolve()  # the folder "." has no name
    mapping = mapping_of(path, None)
    files = [] if mapping is None else [mapping]
    if any(entry.companions for entry in FORMATS) and path.is_file():
        with suppress(StapeskitError, OSError, *PARSER_ERRORS):
            named = format_of(path).companions
            files += [] if named is None else [Path(file) for file in named(path)]
    return [file for file in files if file.is_file()]


def _head_of(path: Path) -> Head:
    with path.open("rb") as stream:
        return Head(stream.read(_HEAD_BYTES), path.suffix.lower(), mapping_of(path, None) is not None)


def _format_of_folder(path: Path) -> Format:
    """Return the format of the first text export in a folder; hidden files do not count."""
    formats = [entry for entry in FORMATS if entry.in_folders]
    files = export_files(path, endings=(*EXPORT_ENDINGS, *proprietary_formats.SUFFIXES))
    others: list[Format] = []
    for file in files:
        head = _head_of(file)
        for entry in formats:
            if entry.holds(head):
                if entry.name != "vendor":
                    return entry
                others.append(entry)
    if others:
        return others[0]
    step = "Give the files themselves, or the folder of a text export"
    expected = "one with text exports of a scanning vibrometer"
    got = f"{len(files)} text files of other kinds" if files else "none"
    raise KinematicsError.of("a vibrometer folder", expected, got, path.name, step)


def describes_series(path: Path) -> bool:
    """Return whether a file is of a format whose time series need no table of channels."""
    path = Path(path)
    if not path.is_file():
        return False
    head = _head_of(path)
    return any(entry.holds(head) for entry in FORMATS if entry.series == "described")
