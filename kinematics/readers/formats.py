"""The table of vibrometer formats, and which of them a file or folder is.

A new format is a module with ``read(path, ...) -> Recordings`` and one entry of `FORMATS`; messages and the
table in docs/vibrometer_files.md follow. The help of ``points2dof``, which imports no reader, has the same
words in `kinematics.cli`: a test says where they differ. What a file holds decides first, its name
second; earlier entries win.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path

from kinematics.errors import KinematicsError
from kinematics.readers import proprietary_formats
from kinematics.readers.input_options import InputOptions
from kinematics.readers.mapping_file import mapping_of
from kinematics.readers.psv.fastscan import looks_like_fastscan
from kinematics.readers.psv.per_point import looks_like_points
from kinematics.readers.psv.text_blocks import EXPORT_ENDINGS, decoded, export_files
from kinematics.readers.recording import Recordings
from kinematics.readers.text import lines_of
from kinematics.readers.uff.datasets import looks_like_uff, plain_content
from kinematics.readers.wide.spectra import is_wide

TIDY, WIDE = "tidy", "wide"
_SERIES_READER = "kinematics.readers.series.frequency_responses"
_HEAD_BYTES = 1 << 16  # holds the header of every known format
_ZIP = b"PK\x03\x04"
_SOUND = (b"RIFF", b"RIFX", b"RF64")
_UTF16 = (b"\xff\xfe", b"\xfe\xff")


@dataclass(frozen=True)
class Head:
    """The first bytes of a file, the ending of its name in small letters, whether it has a mapping."""

    content: bytes
    suffix: str
    mapped: bool = False

    @cached_property
    def text(self) -> str:
        """The first bytes as text; empty for a ZIP archive and for sound."""
        if self.content.startswith((_ZIP, *_SOUND)):
            return ""
        whole = len(self.content) // 2 * 2 if self.content[:2] in _UTF16 else len(self.content)
        return decoded(self.content[:whole])


def _never(_head: Head) -> bool:
    return False


@dataclass(frozen=True)
class Format:
    """A format of vibrometer files.

    Attributes
    ----------
    module : str
        Has ``read(path, *options)``; empty for the tidy table, which `kinematics.tidy` reads.
    words : str
        What it is, in a message that lists the formats; empty where another entry says it.
    holds : callable
        Takes the Head of a file and returns whether it is of this format.
    suffixes : tuple of str
        Endings of names that decide where no content does.
    options : tuple of str
        Attributes of InputOptions that ``read`` takes.
    in_folders : bool
        Whether a folder of such files is one measurement.
    series : str
        ``channels``: may hold time series, which need a table of channels. ``described``: which it describes
        itself.
    reads : str
        What is read of it, for docs/vibrometer_files.md; empty where another entry says it.
    """

    name: str
    module: str
    words: str = ""
    holds: Callable[[Head], bool] = _never
    suffixes: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    in_folders: bool = False
    series: str = ""
    reads: str = ""

    def read(self, path: Path, options: InputOptions) -> Recordings:
        """Read a file or folder, as time series where a table of channels is given."""
        module, names = self.module, self.options
        if self.series == "channels" and options.series is not None and options.series.channels is not None:
            module, names = _SERIES_READER, ("series",)
        recordings: Recordings = import_module(module).read(path, *(getattr(options, name) for name in names))
        return replace(recordings, file=path.name)


def _is_archive_or_sound(head: Head) -> bool:
    is_npz = head.content.startswith(_ZIP) and (head.suffix == ".npz" or b".npy" in head.content)
    return is_npz or head.content.startswith(_SOUND)


def _has_time(head: Head) -> bool:
    """Return whether the header of a table has a column of times."""
    lines = [line for line in lines_of(head.text)[:20] if line.strip() and not line.startswith("#")]
    if not lines:
        return False
    cells = lines[0].split(max((",", ";", "\t"), key=lines[0].count))
    return "time_s" in [cell.strip().strip('"').lower() for cell in cells]


FORMATS = (
    Format(
        "vendor",
        "kinematics.readers.proprietary_formats",
        holds=lambda head: (
            head.suffix in proprietary_formats.SUFFIXES
            or head.content.startswith(proprietary_formats.COMPOUND)
        ),
        in_folders=True,
    ),
    Format(
        "matlab",
        "kinematics.readers.matlab.spectra",
        "a MATLAB file (.mat)",
        lambda head: head.content.startswith(b"MATLAB") or (head.suffix == ".mat" and bool(head.content)),
        options=("mapping",),
        series="channels",
        reads="v4 to v7.3, as File Access scripts save them; other layouts by `--mapping`",
    ),
    Format(
        "hdf5",
        "kinematics.readers.hdf5",
        "HDF5 (.h5)",
        lambda head: head.content.startswith(b"\x89HDF\r\n\x1a\n"),
        options=("mapping",),
        series="channels",
        reads="own documented layout with a writer; others by `--mapping`",
    ),
    Format(
        "uff",
        "kinematics.readers.uff.spectra",
        "a universal file (.uff, .unv)",
        lambda head: looks_like_uff(plain_content(head.content)),
        (".uff", ".unv", ".bunv", ".ufb"),
        ("series",),
        series="described",
        reads="functions 58 (all ASCII forms) and 58b (both byte orders): responses, cross and auto spectra, "
        "time responses; 15/2411 nodes, 18/2420 coordinate systems, 164 units; coherence with its response",
    ),
    Format(
        "fastscan",
        "kinematics.readers.psv.fastscan",
        "text exports of a scanning vibrometer (a folder, or .txt)",
        lambda head: looks_like_fastscan(head.text),
        in_folders=True,
        reads="Polytec PSV: FastScan folders (one file a frequency) and per-point files",
    ),
    Format(
        "points",
        "kinematics.readers.psv.per_point",
        holds=lambda head: looks_like_points(head.text),
        in_folders=True,
    ),
    Format(
        "time",
        _SERIES_READER,
        "time series (.csv, .npz, .wav)",
        lambda head: _is_archive_or_sound(head) or _has_time(head),
        options=("series",),
        series="channels",
        reads="with a channel table, also .mat and .h5; time responses in universal files: H1, H2, Hv, local "
        "polynomials without leakage (`--frf lpm`), periodic excitation, stepped sine by lock-in, each with "
        "its variance; clipped samples, spikes, dropouts and leakage are reported",
    ),
    Format(
        WIDE,
        "kinematics.readers.wide.spectra",
        "a wide table (.csv)",
        lambda head: head.mapped or is_wide(head.text),
        options=("mapping",),
        reads="one row a frequency and two columns a beam (`Frequency [Hz], P1 Vx Mag [mm/s], P1 Vx Phase "
        "[deg], ...`); other names by `--mapping`",
    ),
    Format(
        TIDY,
        "",
        "a tidy table (.csv)",
        suffixes=(".csv", ".tsv", ".txt"),
        reads="commas, semicolons or tabs, decimal commas, UTF-8 or UTF-16, BOM, any line ends, quotes, `#` "
        "comments, `sep=;`; anything else is refused with file, line and column, all faults in one message",
    ),
)


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
    if head.content.startswith(_ZIP):
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


def read_recordings(path: Path, options: InputOptions | None = None) -> Recordings:
    """Read a file of any format but the tidy table.

    Raises
    ------
    KinematicsError
        What its reader reports.
    """
    path = Path(path)
    return format_of(path).read(path, options or InputOptions())
