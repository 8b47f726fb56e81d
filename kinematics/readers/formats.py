"""The table of vibrometer formats, and which of them a file or folder is.

A new format is a module with ``read(path, facts) -> Recording`` and one entry of `FORMATS`; the help of
``points2dof``, messages, docs and the contract test follow. What a file holds decides, its name second; the
first entry that holds it reads it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from kinematics.readers.text import TEXT_ENDINGS, decoded, export_files
from stapeskit.faults import StapeskitError

if TYPE_CHECKING:
    from kinematics.readers.facts import FileFacts
    from kinematics.readers.recording import Recording

TIDY = "tidy"
WORKBOOKS = (".xls", ".xlsx", ".xlsm", ".ods")

_LIMIT_S, _LIMIT_S_PER_BYTE = 5.0, 2e-6  # of processor time: pyuff takes 0.1e-6 s a byte of text
_HEAD_BYTES = 1 << 16  # holds the header of every known format
_ZIP, _COMPOUND = b"PK\x03\x04", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"
_SOUND = (b"RIFF", b"RIFX", b"RF64")
_UFF = re.compile(rb"[\r\n]*(?:\xef\xbb\xbf)?[ \t]*-1[ \t]*\r?\n[ \t]*\d{1,6}[bB ]?")
_EXPORT_STEP = (
    "Export the spectra of all points in the program that wrote it, as UFF (universal file, with geometry) "
    "or as ASCII (Real & Imag.), and give that file or folder"
)


@dataclass(frozen=True)
class Head:
    """The first bytes of a file, its ending in small letters, and whether it has a mapping."""

    content: bytes
    suffix: str
    mapped: bool = False

    def is_archive_of(self, ending: bytes) -> bool:
        """Return whether the file is an archive that begins with a file of an ending."""
        return self.content.startswith(_ZIP) and ending in self.content

    @cached_property
    def kind(self) -> str:
        """As what table of numbers its text begins; see `kinematics.readers.wide.kind_of`."""
        from kinematics.readers.wide import kind_of

        return "" if self.content.startswith((_ZIP, _COMPOUND, *_SOUND)) else kind_of(decoded(self.content))


@dataclass(frozen=True)
class Format:
    """A format of vibrometer files.

    Attributes
    ----------
    words, reads : str
        What it is, in messages; what is read of it, for the help and the documentation.
    holds : callable
        Takes the Head of a file and returns whether it is of this format.
    module : str
        Below this package; has ``read(path, facts)``.
    suffixes : tuple of str
        Endings of names that decide where no content does.
    libraries : tuple of str
        What reads the file in a child process with limits; empty: plain text, read in this process.
    in_folders, series, mapped : bool
        Whether a folder of such files is one measurement, a table of channels makes it time series, a mapping
        may say what is what in it.
    """

    name: str
    words: str
    holds: Callable[[Head], bool]
    module: str
    reads: str
    suffixes: tuple[str, ...] = ()
    libraries: tuple[str, ...] = ()
    in_folders: bool = False
    series: bool = False
    mapped: bool = False


FORMATS = (
    Format(
        "svd", "a scan file of Polytec (.svd)", lambda head: head.content.startswith(_COMPOUND), "svd",
        "PSV 10, averaged FFT with one head: cross and auto spectra, H1, coherence, positions, direction",
        libraries=("olefile",),
    ),
    Format(
        "matlab", "a MATLAB file (.mat)",
        lambda head: head.content.startswith(b"MATLAB") or (head.suffix == ".mat" and bool(head.content)),
        "matlab",
        "v4 to v7.3, as File Access scripts save them; other layouts by `--mapping`",
        libraries=("scipy.io",), series=True, mapped=True,
    ),
    Format(
        "hdf5", "HDF5 (.h5)", lambda head: head.content.startswith(b"\x89HDF\r\n\x1a\n"), "matlab",
        "data sets by their names (`freq_hz`, `re`, `im`, `direction`, `position_mm`, ...); others by "
        "`--mapping`",
        libraries=("h5py",), series=True, mapped=True,
    ),
    Format(
        "uff", "a universal file (.uff, .unv)", lambda head: bool(_UFF.match(head.content)), "uff",
        "functions 58 and 58b: responses, spectra, coherence; 15 and 2411 nodes, 18 and 2420 coordinate "
        "systems, 164 units",
        (".uff", ".unv", ".bunv", ".ufb"), libraries=("pyuff",),
    ),
    Format(
        "fastscan", "text exports of a scanning vibrometer (a folder, or .txt)",
        lambda head: head.kind == "fastscan", "wide",
        "Polytec PSV: FastScan folders (one file a frequency)", in_folders=True,
    ),
    Format(
        "points", "per-point text exports of a scanning vibrometer",
        lambda head: head.kind == "points", "wide",
        "Polytec PSV: a file, or a block of one file, for each point", in_folders=True,
    ),
    Format(
        "time", "time series (.csv, .npz, .wav)",
        lambda head: head.content.startswith(_SOUND) or head.is_archive_of(b".npy") or head.kind == "time",
        "series",
        "with a channel table, also .mat and .h5: H1 with its noise, periodic excitation, stepped sine by "
        "lock-in",
        libraries=("numpy", "scipy.io"), series=True,
    ),
    Format(
        "wide", "a wide table (.csv)", lambda head: head.mapped or head.kind == "wide", "wide",
        "one row a frequency and two columns a beam (`Frequency [Hz], P1 Vx Mag [mm/s], P1 Vx Phase [deg], "
        "...`); "
        "other names by `--mapping`", mapped=True,
    ),
    Format(
        TIDY, "a tidy table (.csv)", lambda _head: False, "tidy",
        "commas, semicolons or tabs, decimal commas, UTF-8 or UTF-16, BOM, any line ends, quotes, `#` "
        "comments, `sep=;`; anything else is refused with file, line and column, all faults in one message",
        (".csv", ".tsv", ".txt"),
    ),
)  # fmt: skip
"""In the order in which they are tried."""


def read_file(path: Path, facts: FileFacts) -> Recording:
    """Read a file or folder of any known format; libraries run in a child process with limits.

    Raises
    ------
    StapeskitError
        There is no such file, nothing known is in it, or it is damaged.
    """
    path = Path(path)
    path = path if path.name else path.resolve()  # the folder "." has no name
    entry = format_of(path, facts.mapping is not None)
    series = entry.series and facts.channels is not None
    read: Callable[[Path, FileFacts], Recording]
    read = import_module(f"kinematics.readers.{'series' if series else entry.module}").read
    try:
        if not entry.libraries or (entry.name == "time" and path.suffix.lower() in TEXT_ENDINGS):
            return read(path, facts)
        from stapeskit.sandbox import read_apart, size_on_disk

        modules = (f"kinematics.readers.{entry.module}", *entry.libraries)
        limit_s = _LIMIT_S + _LIMIT_S_PER_BYTE * size_on_disk(path)
        return read_apart(lambda: read(path, facts), path, entry.words, limit_s, modules=modules)
    except OSError as fault:
        got, step = fault.strerror or "an error of the system", "Check its name, folder and permissions"
        raise StapeskitError.of("the vibrometer file", "readable", got, path.name, step) from fault


def format_of(path: Path, mapped: bool = False) -> Format:
    """Return the format of a file or folder; with a mapping, a table that is not known is a wide one.

    Raises
    ------
    StapeskitError
        There is no such file, or nothing known in it.
    """
    if path.is_dir():
        return _format_of_folder(path)
    if not path.is_file():
        step = "Check its name and folder"
        raise StapeskitError.of("the vibrometer file", "an existing file", path.name, "", step)
    head = head_of(path)
    head = replace(head, mapped=head.mapped or mapped)
    for entry in FORMATS:
        if entry.holds(head):
            return entry
    by_name = next((entry for entry in FORMATS if head.suffix in entry.suffixes), None)
    archive, scan = head.content.startswith(_ZIP), head.suffix in (".svd", ".pvd", ".set")
    if by_name is not None and not archive and (head.content or by_name.name == TIDY):
        return by_name
    want, got, step = f"one of {', '.join(entry.words for entry in FORMATS)}", path.suffix or path.name, ""
    if archive:
        got = "a workbook" if head.suffix in WORKBOOKS else "a ZIP archive"
        step = "Save its sheet as CSV, or unpack it, and give the files in it"
    elif scan:
        want, got, step = "a compound file of PSV 10", "another scan file, or a damaged one", _EXPORT_STEP
    elif not head.content:
        got, step = "0 bytes", "Export it again"
    raise StapeskitError.of(
        "the vibrometer file", want, got, path.name, step or "See points2dof --help for the layouts"
    )


def head_of(path: Path) -> Head:
    """Return the beginning of a file."""
    from kinematics.readers.mapping import mapping_beside

    with path.open("rb") as stream:
        return Head(stream.read(_HEAD_BYTES), path.suffix.lower(), mapping_beside(path) is not None)


def _format_of_folder(path: Path) -> Format:
    """Return the format of the first text export in a folder."""
    files = export_files(path)
    found = (entry for head in map(head_of, files) for entry in FORMATS if entry.holds(head))
    entry = next((entry for entry in found if entry.in_folders), None)
    if entry is None:
        step, got = (
            "Give the files themselves, or the folder of a text export",
            f"{len(files)} other text files",
        )
        want = "one with text exports of a scanning vibrometer"
        raise StapeskitError.of("a vibrometer folder", want, got, path.name, step)
    return entry


def companion_files(path: Path, facts: FileFacts) -> dict[str, Path]:
    """Return the files that are read with a vibrometer file by role: mapping, channels, steps."""
    from kinematics.readers.mapping import mapping_beside

    beside = mapping_beside(Path(path), facts.mapping)
    mapped = beside is not None and format_of(Path(path), facts.mapping is not None).mapped
    files = {
        "mapping" if facts.mapping else f"mapping of {path.name}": beside if mapped else None,
        "channels": facts.channels,
        "steps": facts.steps,
    }
    return {role: file for role, file in files.items() if file is not None}
