"""What a format says about a scan: where its voxels lie in files and in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.scan import Fetch
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

EXPORT_AGAIN = "The file is truncated or its header is wrong: copy or export it again"

_BEGINNINGS = {
    b"\x1f\x8b": "a gzip file",
    b"PK\x03\x04": "a ZIP archive",
    b"\x89HDF": "an HDF5 file",
    b"NRRD": "an NRRD file",
    b"II*\0": "a TIFF file",
    b"MM\0*": "a TIFF file",
    b"ObjectType": "a MetaImage (MHA, MHD)",
    b"version http": "a pointer of Git LFS",
    b"<": "a web page or XML",
}
"""First bytes of files that are given another name."""

_LONGEST_NAME = 255  # bytes of a file name in common file systems
HEADER_BYTES = 1 << 20
"""Most bytes of a text header or log, which has some kilobytes."""


@dataclass(frozen=True)
class RawLayout:
    """How voxels lie in a file without a header.

    Attributes
    ----------
    shape : tuple of 3 int
        Voxels along x, y, z; x runs fastest.
    dtype : str
        ``uint8``, ``int8``, ``uint16``, ``int16``, ``uint32``, ``int32``, ``float32`` or ``float64``.
    byte_order : str
        ``little`` or ``big``.
    header_bytes : int
        Bytes before the first voxel.
    """

    shape: tuple[int, ...]
    dtype: str
    byte_order: str = "little"
    header_bytes: int = 0


@dataclass(frozen=True)
class ReadOptions:
    """What the user says about a scan.

    Attributes
    ----------
    spacing_mm : sequence of 1 or 3 float, or None
        Voxel spacing along x, y, z, mm; it wins over that of the file.
    mirror : str or None
        ``x``, ``y`` or ``z``: the order of voxels along this axis of the grid is wrong.
    nan_as_air : bool
        Voxels that are not finite count as air.
    raw : RawLayout or None
        Of a file without a header.
    """

    spacing_mm: float | Sequence[float] | None = None
    mirror: str | None = None
    nan_as_air: bool = False
    raw: RawLayout | None = None


@dataclass(frozen=True)
class RawPlanes:
    """Planes of voxels that lie in files as they are.

    Attributes
    ----------
    files : tuple of Path
    file : ndarray of int, (nz,)
        Which file holds each plane.
    offset : ndarray of int, (nz,)
        Byte at which each plane begins in its file.
    """

    files: tuple[Path, ...]
    file: NDArray[np.int64]
    offset: NDArray[np.int64]


@dataclass
class Opened:
    """A scan as its format describes it, before the rules of `place` are applied.

    Attributes
    ----------
    shape : tuple of int
        Voxels along z, y, x.
    dtype : dtype
        Of a stored voxel, with its byte order.
    planes : RawPlanes or None
        Where the voxels lie when they are not packed; otherwise ``read`` decodes them.
    read : callable or None
        Decodes a box; stays in the child process in which a library has opened the file.
    depth : int
        Planes that are decoded together.
    spacing_mm : ndarray, (3,), or None
        Along x, y, z; NaN along an axis, or None, where the file does not have it.
    origin_mm : ndarray, (3,)
    direction : ndarray, (3, 3)
        Columns: directions of the grid's x, y, z axes; may be left-handed.
    anatomical : bool
        The file ties its axes to the patient.
    slope, intercept : float or ndarray, (nz,)
        Grey value = slope * stored + intercept, for the scan or for every plane.
    white_is_zero : bool
        Bright and dark are exchanged in the file.
    known : str
        What the file says of an incomplete spacing, for the message.
    notices : list of Notice
    names : dict of int to str
        Names of labels.
    files : tuple of Path
        Files that are read besides the one given.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    planes: RawPlanes | None = None
    read: Fetch | None = None
    depth: int = 1
    spacing_mm: Array | None = None
    origin_mm: Array = field(default_factory=lambda: np.zeros(3))
    direction: Array = field(default_factory=lambda: np.eye(3))
    anatomical: bool = False
    slope: float | Array = 1.0
    intercept: float | Array = 0.0
    white_is_zero: bool = False
    known: str = ""
    notices: list[Notice] = field(default_factory=list)
    names: dict[int, str] = field(default_factory=dict)
    files: tuple[Path, ...] = ()


def planes_in(
    pieces: Sequence[tuple[Path, int]], shape: Sequence[int], dtype: np.dtype[Any], name: str, slab: int = 0
) -> RawPlanes:
    """Return where the planes of a scan lie in files that each hold some of them.

    Parameters
    ----------
    pieces : sequence of (Path, int)
        Files in the order of their planes, with the offset of the first voxel; -1 counts from the end.
    shape : sequence of 3 int
        Voxels along z, y, x.
    dtype : dtype
    name : str
        Of the header, for messages.
    slab : int
        Planes in each file but the last; 0 for equal numbers.

    Raises
    ------
    StapeskitError
        A file is missing or too short, or the planes cannot be shared out.
    """
    count = int(shape[0])
    depth = slab or -(-count // max(len(pieces), 1))
    if not pieces or not 0 <= len(pieces) * depth - count < depth:
        raise StapeskitError.of(
            "the list of data files",
            f"files of equal numbers of {count} slices",
            f"{len(pieces)} files",
            name,
        )
    plane = int(shape[1]) * int(shape[2]) * dtype.itemsize
    for file, _ in pieces:
        if not file.is_file():
            raise no_data_file(file, name)
    held = sum(file.stat().st_size for file, _ in pieces)
    if count * plane > held:  # before arrays as long as the claim are made
        raise too_short(shape, count * plane, held, name)
    number = np.arange(count) // depth
    offset = (np.arange(count) % depth) * plane
    for k, (file, start) in enumerate(pieces):
        held = min(depth, count - k * depth) * plane
        stored = file.stat().st_size
        first = stored - held if start == -1 else start
        if first < 0 or first + held > stored:
            raise too_short(shape, held, stored - max(first, 0), file.name)
        offset[number == k] += first
    return RawPlanes(tuple(file for file, _ in pieces), number, offset)


def too_short(shape: Sequence[int], claimed: int, stored: int, name: str) -> StapeskitError:
    """Return the error for a file that holds fewer bytes of voxels than its header claims."""
    size = " x ".join(str(int(n)) for n in reversed(list(shape)))
    return StapeskitError.of(
        "the scan",
        f"as large as its header says ({size} voxels, {claimed} bytes)",
        f"{max(stored, 0)} bytes of voxels",
        name,
        EXPORT_AGAIN,
    )


def check_surplus(opened: Opened, pieces: Sequence[tuple[Path, int]], attached: bool) -> None:
    """Refuse raw voxels with more behind them: the header counts fewer, or another header comes first.

    Raises
    ------
    StapeskitError
        A separate file is longer than its voxels, or a file with a header holds at least one more slice.
    """
    if any(start == -1 for _, start in pieces):
        return
    plane = opened.dtype.itemsize * int(opened.shape[1]) * int(opened.shape[2])
    needed = plane * int(opened.shape[0])
    stored = sum(file.stat().st_size - start for file, start in pieces)
    if stored - needed >= (plane if attached else 1):
        raise surplus(needed, stored, pieces[0][0].name)


def surplus(needed: int, stored: int, name: str) -> StapeskitError:
    """Return the error for a file that holds more bytes of voxels than its header counts."""
    step = (
        "The header counts other voxels than the file holds. If the file begins with a header of its own, "
        "let the voxels be counted from its end: byte skip: -1 in NRRD, HeaderSize = -1 in MetaImage"
    )
    wanted = f"as long as its header says ({needed} bytes)"
    return StapeskitError.of("the data file", wanted, f"{stored} bytes of voxels", name, step)


def beside(header: Path, name: str) -> Path:
    """Return the data file that a header names; it must lie in the folder of the header.

    A path of the machine that wrote the header counts as its last part when such a file lies in the folder.

    Raises
    ------
    StapeskitError
        The name leads out of the folder, or is no file name.
    """
    last = name.replace("\\", "/").rstrip("/").rsplit("/", 1)[-1]
    if not last or "\0" in name or any(len(part.encode()) > _LONGEST_NAME for part in Path(name).parts):
        got = repr(name[:60])
        raise StapeskitError.of("the data file", "a file name", got, header.name, "Correct the header")
    if "\\" not in name and not Path(name).is_absolute() and ".." not in Path(name).parts:
        return header.parent / name
    if (header.parent / last).is_file():
        return header.parent / last
    step = "Put both files into one folder"
    raise StapeskitError.of("the data file", "in the folder of its header", name, header.name, step)


def no_data_file(file: Path, header: str) -> StapeskitError:
    """Return the error for a header whose data file is missing."""
    return StapeskitError.of(
        "the data file", "in the folder of its header", f"no {file.name}", header, "Copy both files together"
    )


def wrong_header(path: Path, kind: str, got: str) -> StapeskitError:
    """Return the error for a header with an impossible value or without a needed one."""
    return StapeskitError.of("the scan", f"a readable {kind}", got, path.name, "Copy or export it again")


def looks_like(path: Path, title: str) -> str:
    """Return the format that the first bytes of a file suggest, where it is not the format ``title``."""
    if not path.is_file():
        return ""
    with path.open("rb") as stream:
        start = stream.read(12)
    found = next((name for begin, name in _BEGINNINGS.items() if start.startswith(begin)), title)
    return "" if title in found else f": it begins as {found}, whatever its name says"


def several_values(path: Path, got: str) -> StapeskitError:
    """Return the error for more than one number in a voxel: colours, vectors, channels, times."""
    step = "Export grey values of one channel, at one time"
    return StapeskitError.of("the volume", "a stack of one grey value per voxel", got, path.name, step)
