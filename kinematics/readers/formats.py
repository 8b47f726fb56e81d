"""Which reader a file or folder is for: by what it holds first, by its name second."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from kinematics.errors import KinematicsError
from kinematics.readers import vendor
from kinematics.readers.input_options import InputOptions
from kinematics.readers.psv.blocks import decoded
from kinematics.readers.psv.fastscan import looks_like_fastscan
from kinematics.readers.psv.per_point import looks_like_points
from kinematics.readers.recording import Recordings
from kinematics.readers.text import lines_of
from kinematics.readers.uff.datasets import looks_like_uff, plain_content
from stapeskit.faults import Fault

TIDY = "tidy"
_HEAD = 1 << 16
_ZIP = b"PK\x03\x04"
_MODULES = {
    "uff": "kinematics.readers.uff.spectra",
    "fastscan": "kinematics.readers.psv.fastscan",
    "points": "kinematics.readers.psv.per_point",
    "vendor": "kinematics.readers.vendor",
    "matlab": "kinematics.readers.matlab.spectra",
    "hdf5": "kinematics.readers.hdf5",
    "time": "kinematics.readers.series.frequency_responses",
}
_BY_SUFFIX = {
    ".uff": "uff",
    ".unv": "uff",
    ".bunv": "uff",
    ".ufb": "uff",
    ".csv": TIDY,
    ".tsv": TIDY,
    ".txt": TIDY,
}
READ = (
    "a tidy table (.csv), a universal file (.uff, .unv), text exports of a scanning vibrometer (a folder, or "
    ".txt), a MATLAB file (.mat), HDF5 (.h5) or time series (.csv, .npz, .wav)"
)


def kind_of(path: Path) -> str:
    """Return ``tidy`` or the name of a reader.

    Raises
    ------
    KinematicsError
        There is no such file, or nothing known in it.
    """
    path = Path(path)
    if path.is_dir():
        return _kind_of_folder(path)
    if not path.is_file():
        raise KinematicsError(Fault("the vibrometer file", "an existing file", path, "", "Check its name"))
    with path.open("rb") as stream:
        head = stream.read(_HEAD)
    suffix = path.suffix.lower()
    if suffix in vendor.SUFFIXES or head.startswith(vendor.COMPOUND):
        return "vendor"
    if head.startswith(b"MATLAB") or (suffix == ".mat" and head):
        return "matlab"
    if head.startswith(b"\x89HDF\r\n\x1a\n"):
        return "hdf5"
    if head.startswith((b"RIFF", b"RIFX")) or (head.startswith(_ZIP) and _is_npz(suffix, head)):
        return "time"
    if head.startswith(_ZIP):
        step = "Unpack it, and give the files or folders in it"
        raise KinematicsError(Fault("the vibrometer file", READ, "a ZIP archive", path.name, step))
    if not head and _BY_SUFFIX.get(suffix) != TIDY:
        step = "Export or copy it again"
        raise KinematicsError(Fault("the vibrometer file", "one with content", "0 bytes", path.name, step))
    if looks_like_uff(plain_content(head)):
        return "uff"
    text = decoded(head if head[:2] not in (b"\xff\xfe", b"\xfe\xff") else head[: len(head) // 2 * 2])
    if looks_like_fastscan(text):
        return "fastscan"
    if looks_like_points(text):
        return "points"
    if _has_time(text):
        return "time"
    if suffix in _BY_SUFFIX:
        return _BY_SUFFIX[suffix]
    raise KinematicsError(
        Fault("the vibrometer file", READ, path.name, next_step="See points2dof --help for the layouts")
    )


def _is_npz(suffix: str, head: bytes) -> bool:
    return suffix == ".npz" or b".npy" in head


def _kind_of_folder(path: Path) -> str:
    """Tell what the text files of a folder are by the first one that is known; hidden files do not count."""
    is_vendor = False
    for file in sorted(p for p in path.rglob("*") if p.is_file() and not p.name.startswith(".")):
        with file.open("rb") as stream:
            text = decoded(stream.read(_HEAD))
        if looks_like_fastscan(text):
            return "fastscan"
        if looks_like_points(text):
            return "points"
        is_vendor |= file.suffix.lower() in vendor.SUFFIXES
    if is_vendor:
        return "vendor"
    step = "Give the files themselves, or the folder of a text export"
    expected = "one with text exports of a scanning vibrometer"
    raise KinematicsError(Fault("a vibrometer folder", expected, path.name, next_step=step))


def describes_series(path: Path) -> bool:
    """Tell whether a file is of a kind whose time series need no table of channels."""
    if not Path(path).is_file():
        return False
    with Path(path).open("rb") as stream:
        return looks_like_uff(plain_content(stream.read(_HEAD)))


def _has_time(text: str) -> bool:
    """Tell whether the header of a table has a column of times."""
    lines = [line for line in lines_of(text)[:20] if line.strip() and not line.startswith("#")]
    names = [] if not lines else [name.strip().strip('"').lower() for name in _split(lines[0])]
    return "time_s" in names


def _split(line: str) -> list[str]:
    return line.split(max((",", ";", "\t"), key=line.count))


def read_recordings(path: Path, options: InputOptions | None = None) -> Recordings:
    """Read any file but a tidy table, and note its name.

    Raises
    ------
    KinematicsError
        What its reader says.
    """
    from dataclasses import replace

    path, said = Path(path), options or InputOptions()
    kind = kind_of(path)
    listed = said.series is not None and said.series.channels is not None
    if kind == "time" or (listed and kind in ("matlab", "hdf5")):
        from kinematics.readers.series import frequency_responses as time_series

        made = time_series.read(path, said.series)
    elif kind == "uff":
        from kinematics.readers.uff import spectra as uff

        made = uff.read(path, said.series)
    elif kind in ("matlab", "hdf5"):
        made = import_module(_MODULES[kind]).read(path, said.mapping)
    else:
        made = import_module(_MODULES[kind]).read(path)
    return replace(made, file=path.name)
