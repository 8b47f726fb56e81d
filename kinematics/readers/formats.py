"""The table of vibrometer formats, and which of them a file or folder is.

A new format is a module with ``read(path, facts) -> Recording`` and one entry of `FORMATS`; the help of
``points2dof``, messages, docs and the contract test follow. What a file holds decides, its name second; the
first entry that holds it reads it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from kinematics.readers.text import TEXT_ENDINGS, export_files
from stapeskit.faults import StapeskitError

if TYPE_CHECKING:
    from kinematics.readers.recording import Recording
    from kinematics.readers.stated_by_user import FileFacts

_LIMIT_S, _LIMIT_S_PER_BYTE = 5.0, 2e-6  # of processor time: pyuff takes 0.1e-6 s a byte of text
_HEAD_BYTES = 1 << 16  # holds the header of every known format
_ZIP, _COMPOUND, _HDF5 = b"PK\x03\x04", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", b"\x89HDF\r\n\x1a\n"
_TABLES = (".csv", ".tsv", ".txt")
_TIDY = {"body", "point", "dir", "dir_x"}
_UFF = re.compile(rb"[\r\n]*(?:\xef\xbb\xbf)?[ \t]*-1[ \t]*\r?\n[ \t]*\d{1,6}[bB ]?")
_EXPORT_STEP = (
    "Export the spectra of all points in the program that wrote it, as UFF (universal file, with geometry) "
    "or as ASCII (Real & Imag.), and give that file or folder"
)


@dataclass(frozen=True)
class Head:
    """The first bytes of a file, and its ending in small letters."""

    content: bytes
    suffix: str

    @cached_property
    def kind(self) -> str:
        """As what table of numbers its text begins: ``psv``, ``series``, ``wide`` or none of them, empty."""
        from kinematics.readers.psv import is_fastscan, is_of_point
        from kinematics.readers.sheets import sheets_of
        from kinematics.readers.wide import is_frequency
        from stapeskit.tables import decoded
        from stapeskit.units import unit_of

        binary = self.content.startswith((_ZIP, _COMPOUND))
        sheets = [] if binary else sheets_of(decoded(self.content), "", [])
        if not sheets:
            return ""
        if is_of_point(sheets[0]) or is_fastscan(sheets[0]):
            return "psv"
        low = {name.strip('"').lower() for name in sheets[0].names}
        if not _TIDY.isdisjoint(low) or any(map(unit_of, low)):
            return ""
        if any(name.startswith(("time", "zeit")) for name in low):
            return "series"
        return "wide" if any(map(is_frequency, sheets[0].names)) else ""


@dataclass(frozen=True)
class Format:
    """A format of vibrometer files.

    ``name`` is also the module that has ``read(path, facts)``; ``words`` say what it is, ``reads`` what is
    read of it, in help and docs; ``holds`` says whether a file is of it. ``libraries`` read it in a child
    process with limits; without any it is plain text, read in this process. With ``series`` a table of
    channels makes it time series.
    """

    name: str
    words: str
    holds: Callable[[Head], bool]
    reads: str
    libraries: tuple[str, ...] = ()
    series: bool = False


FORMATS = (
    Format(
        "svd", "a scan file of Polytec (.svd)", lambda head: head.content.startswith(_COMPOUND),
        "PSV 10, averaged FFT with one head: cross and auto spectra, H1, coherence, positions, direction",
        libraries=("olefile",),
    ),
    Format(
        "matlab", "a MATLAB or HDF5 file (.mat, .h5)",
        lambda head: head.content.startswith((b"MATLAB", _HDF5))
        or (head.suffix == ".mat" and bool(head.content)),
        "v4 to v7.3 and HDF5: variables by their names, as File Access scripts save them",
        libraries=("scipy.io", "h5py"), series=True,
    ),
    Format(
        "uff", "a universal file (.uff, .unv)", lambda head: bool(_UFF.match(head.content)),
        "functions (58, 58b), nodes (15, 2411), coordinate systems (18, 2420), units (164)",
        libraries=("pyuff",),
    ),
    Format(
        "psv", "text exports of a scanning vibrometer (a folder, or .txt)", lambda head: head.kind == "psv",
        "Polytec PSV: FastScan (a file or block for each frequency), or a file or block for each point",
    ),
    Format(
        "series", "time series (.csv, .npz)",
        lambda head: head.kind == "series" or (head.content.startswith(_ZIP) and b".npy" in head.content),
        "with a channel table, also .mat and .h5: H1 with its noise, or periodic excitation",
        libraries=("numpy", "scipy.signal"), series=True,
    ),
    Format(
        "wide", "a wide table (.csv)", lambda head: head.kind == "wide",
        "one row a frequency, two columns a beam: `Frequency [Hz], P1 Vx Mag [mm/s], P1 Vx Phase [deg], ...`",
    ),
    Format(
        "tidy", "a tidy table (.csv)",
        lambda head: head.suffix in _TABLES and not head.content.startswith(_ZIP),
        "commas, semicolons or tabs, decimal commas, UTF-8, UTF-16 or Latin-1, BOM, any line ends, quotes, "
        "`#` lines, `sep=;`",
    ),
)  # fmt: skip
"""In the order in which they are tried."""


def read_file(path: Path, facts: FileFacts) -> Recording:
    """Read and settle a file or folder of any known format; libraries run in a child process with limits.

    Raises
    ------
    StapeskitError
        There is no such file, nothing known is in it, or it is damaged; as `kinematics.readers.in_si`.
    """
    from kinematics.readers.in_si import settled
    from stapeskit.sandbox import read_apart, size_on_disk

    path = path if path.name else path.resolve()  # the folder "." has no name
    entry = format_of(path)
    module = f"kinematics.readers.{'series' if entry.series and facts.channels else entry.name}"
    read: Callable[[Path, FileFacts], Recording] = import_module(module).read
    try:
        if not entry.libraries or (entry.name == "series" and path.suffix.lower() in TEXT_ENDINGS):
            return settled(read(path, facts), facts)
        limit_s, modules = _LIMIT_S + _LIMIT_S_PER_BYTE * size_on_disk(path), (module, *entry.libraries)
        found = read_apart(lambda: read(path, facts), path, entry.words, limit_s, modules=modules)
        return settled(found, facts)
    except OSError as fault:
        got, step = fault.strerror or "an error of the system", "Check its name, folder and permissions"
        raise StapeskitError.of("the vibrometer file", "readable", got, path.name, step) from fault


def format_of(path: Path) -> Format:
    """Return the format of a file or folder; the first text export in a folder says whether it is of it.

    Raises
    ------
    StapeskitError
        There is no such file, or nothing known in it.
    """
    want, step = (
        f"one of {', '.join(entry.words for entry in FORMATS)}",
        "See points2dof --help for the layouts",
    )
    if path.is_dir():
        files = export_files(path)
        if any(_head_of(file).kind == "psv" for file in files):
            return next(entry for entry in FORMATS if entry.name == "psv")
        want, got = "a folder with text exports of a scanning vibrometer", f"{len(files)} other text files"
        step = "Give the files themselves, or the folder of a text export"
    elif not path.is_file():
        want, got, step = "an existing file", "none of this name", "Check its name and folder"
    else:
        head = _head_of(path)
        held = next((entry for entry in FORMATS if entry.holds(head)), None)
        if held is not None:
            return held
        got = path.suffix or path.name
        if head.content.startswith(_ZIP):
            got, step = (
                "a workbook or archive",
                "Save its sheet as CSV, or unpack it, and give the files in it",
            )
        elif head.suffix in (".svd", ".pvd", ".set"):
            want, got, step = "a compound file of PSV 10", "another scan file, or a damaged one", _EXPORT_STEP
        elif head.suffix in (".wav", ".wave"):
            step = "Save its samples as .npz or CSV, one array a channel, and give --channels"
        elif not head.content:
            got, step = "0 bytes", "Export it again"
    raise StapeskitError.of("the vibrometer file", want, got, path.name, step)


def _head_of(path: Path) -> Head:
    with path.open("rb") as stream:
        return Head(stream.read(_HEAD_BYTES), path.suffix.lower())
