"""The table of vibrometer formats.

A new format is a module with ``read(path, ...) -> Recordings`` and one entry of `FORMATS`; the help of
``points2dof``, messages and the table in docs/vibrometer_files.md follow. The first entry that holds a file
reads it. The contract test wants a writer of every entry in tests/kinematics/readers/contract.py. Help stays
quick: what recognises a format is imported where it is used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from legacy.kinematics.readers.input_options import InputOptions
    from legacy.kinematics.readers.recording import Recordings

TIDY = "tidy"
ZIP = b"PK\x03\x04"
_SOUND = (b"RIFF", b"RIFX", b"RF64")
_UTF16 = (b"\xff\xfe", b"\xfe\xff")
_SERIES_READER = "legacy.kinematics.readers.series.frequency_responses"


@dataclass(frozen=True)
class Head:
    """The first bytes of a file, the ending of its name in small letters, whether it has a mapping."""

    content: bytes
    suffix: str
    mapped: bool = False

    @cached_property
    def text(self) -> str:
        """The first bytes as text; empty for a ZIP archive and for sound."""
        if self.content.startswith((ZIP, *_SOUND)):
            return ""
        from legacy.kinematics.readers.psv.text_blocks import decoded

        whole = len(self.content) // 2 * 2 if self.content[:2] in _UTF16 else len(self.content)
        return decoded(self.content[:whole])


def _matches_nothing(_head: Head) -> bool:
    return False


@dataclass(frozen=True)
class Format:
    """A format of vibrometer files.

    Attributes
    ----------
    module : str
        Full name; has ``read(path, *options)``. Empty for the tidy table, which `kinematics.tidy` reads.
    words : str
        What it is, in a message that lists the formats; empty where another entry says it.
    holds : callable
        Takes the Head of a file and returns whether it is of this format.
    suffixes : tuple of str
        Endings of names that decide where no content does.
    options : tuple of str
        Attributes of InputOptions that ``read`` takes.
    in_folders : bool
        Whether a folder of such files is one measurement; of a folder only files with the endings
        ``EXPORT_ENDINGS`` (psv/text_blocks.py) are looked at.
    series : str
        ``channels``: may hold time series, which need a table of channels. ``described``: which it describes
        itself. With a table of channels a file is read by series/series_files.py, which must know it too.
    reads : str
        What is read of it, for the help and docs/vibrometer_files.md; empty where another entry says it.
    companions : callable, optional
        From a path to the other files that ``read`` opens, where a measurement may lie in several: they are
        hashed, watched and copied with it, as a mapping ``FILE.toml`` is. See `companion_files`.
    """

    name: str
    module: str
    words: str = ""
    holds: Callable[[Head], bool] = _matches_nothing
    suffixes: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    in_folders: bool = False
    series: str = ""
    reads: str = ""
    companions: Callable[[Path], Sequence[Path]] | None = None

    def read(self, path: Path, options: InputOptions) -> Recordings:
        """Read a file or folder, as time series where a table of channels is given."""
        module, names = self.module, self.options
        if self.series == "channels" and options.series is not None and options.series.channels is not None:
            module, names = _SERIES_READER, ("series",)
        recordings: Recordings = import_module(module).read(path, *(getattr(options, name) for name in names))
        return replace(recordings, file=path.name)


def _is_of_a_vendor(head: Head) -> bool:
    from legacy.kinematics.readers.proprietary_formats import COMPOUND, SUFFIXES

    return head.suffix in SUFFIXES or head.content.startswith(COMPOUND)


def _is_universal(head: Head) -> bool:
    from legacy.kinematics.readers.uff.datasets import looks_like_uff, plain_content

    return looks_like_uff(plain_content(head.content))


def _is_fastscan(head: Head) -> bool:
    from legacy.kinematics.readers.psv.fastscan import looks_like_fastscan

    return looks_like_fastscan(head.text)


def _is_point_file(head: Head) -> bool:
    from legacy.kinematics.readers.psv.per_point import looks_like_points

    return looks_like_points(head.text)


def _is_wide(head: Head) -> bool:
    from legacy.kinematics.readers.wide.spectra import is_wide

    return head.mapped or is_wide(head.text)


def _is_archive_or_sound(head: Head) -> bool:
    is_npz = head.content.startswith(ZIP) and (head.suffix == ".npz" or b".npy" in head.content)
    return is_npz or head.content.startswith(_SOUND)


def _has_time(head: Head) -> bool:
    """Return whether the header of a table has a column of times."""
    from legacy.kinematics.readers.text import lines_of

    lines = [line for line in lines_of(head.text)[:20] if line.strip() and not line.startswith("#")]
    if not lines:
        return False
    cells = lines[0].split(max((",", ";", "\t"), key=lines[0].count))
    return "time_s" in [cell.strip().strip('"').lower() for cell in cells]


FORMATS = (
    Format(
        "vendor",
        "legacy.kinematics.readers.proprietary_formats",
        holds=_is_of_a_vendor,
        in_folders=True,
    ),
    Format(
        "matlab",
        "legacy.kinematics.readers.matlab.spectra",
        "a MATLAB file (.mat)",
        lambda head: head.content.startswith(b"MATLAB") or (head.suffix == ".mat" and bool(head.content)),
        options=("mapping",),
        series="channels",
        reads="v4 to v7.3, as File Access scripts save them; other layouts by `--mapping`",
    ),
    Format(
        "hdf5",
        "legacy.kinematics.readers.hdf5",
        "HDF5 (.h5)",
        lambda head: head.content.startswith(b"\x89HDF\r\n\x1a\n"),
        options=("mapping",),
        series="channels",
        reads="own documented layout with a writer; others by `--mapping`",
    ),
    Format(
        "uff",
        "legacy.kinematics.readers.uff.spectra",
        "a universal file (.uff, .unv)",
        _is_universal,
        (".uff", ".unv", ".bunv", ".ufb"),
        ("series",),
        series="described",
        reads="functions 58 (all ASCII forms) and 58b (both byte orders): responses, cross and auto spectra, "
        "time responses; 15/2411 nodes, 18/2420 coordinate systems, 164 units; coherence with its response",
    ),
    Format(
        "fastscan",
        "legacy.kinematics.readers.psv.fastscan",
        "text exports of a scanning vibrometer (a folder, or .txt)",
        _is_fastscan,
        in_folders=True,
        reads="Polytec PSV: FastScan folders (one file a frequency) and per-point files",
    ),
    Format(
        "points",
        "legacy.kinematics.readers.psv.per_point",
        holds=_is_point_file,
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
        "wide",
        "legacy.kinematics.readers.wide.spectra",
        "a wide table (.csv)",
        _is_wide,
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
