"""A scan as its file describes it, and what the readers of all formats share.

Every reader takes a path and returns `Stored`, and raises `StapeskitError` for a file that is no scan. A
header that makes no sense may raise anything: `open_scan` makes one sentence of it, and adds the name of the
file to faults without a place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.scan import Box, Fetch
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

HEADER_BYTES = 1 << 20
"""Most bytes of a text header or log, which has some kilobytes."""


@dataclass(frozen=True)
class Stream:
    """Voxels one behind the other in a file, x fastest.

    Attributes
    ----------
    start : int
        Byte at which they begin, or the packed stream that holds them.
    skip : int
        Bytes before them, in a packed stream after unpacking; -1: they are the last bytes.
    packed : bool
        The stream is packed by gzip, zlib or bzip2.
    exact : bool
        Nothing else may follow: in a file of its own no byte, behind a header less than a slice. More says
        that the header counts fewer voxels, or that another header comes before them.
    """

    file: Path
    start: int
    skip: int = 0
    packed: bool = False
    exact: bool = False


@dataclass
class Stored:
    """A scan as its file describes it, before the rules of `place` are applied.

    What is not listed is as in `Scan`.

    Attributes
    ----------
    shape : tuple of int
        As in `Scan`; leading ones are left out.
    dtype : dtype
        Of a stored voxel, with its byte order.
    voxels : Stream, sequence of (Path, int), callable or None
        Where they are: in a stream; in planes that each begin at a byte of a file; otherwise the function
        decodes a box in the child process that has opened the file.
    depth : int
        Planes that are decoded together.
    spacing_mm : ndarray, (3,), or None
        Along x, y, z; NaN along an axis, or None, where the file does not have it.
    unit_mm : float
        Unit in which the file states it, mm.
    direction : ndarray, (3, 3)
        As in `Scan`; may be left-handed.
    anatomical : bool
        The file ties its axes to the patient.
    slope, intercept : float
        Grey value = slope * stored + intercept.
    white_is_zero : bool
        Bright and dark are exchanged in the file.
    coloured : bool
        Its numbers stand for colours whose brightness does not grow with them: labels may, grey values not.
    known : str
        Why a spacing is incomplete, for the message.
    names : dict of int to str
        Names of labels.
    files : tuple of Path
        Files that are read besides the one given.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    voxels: Stream | Sequence[tuple[Path, int]] | Fetch | None = None
    depth: int = 1
    spacing_mm: Array | None = None
    unit_mm: float = 1.0
    origin_mm: Array = field(default_factory=lambda: np.zeros(3))
    direction: Array = field(default_factory=lambda: np.eye(3))
    anatomical: bool = False
    slope: float = 1.0
    intercept: float = 0.0
    white_is_zero: bool = False
    coloured: bool = False
    known: str = ""
    notices: list[Notice] = field(default_factory=list)
    names: dict[int, str] = field(default_factory=dict)
    files: tuple[Path, ...] = ()

    @property
    def is_scaled(self) -> bool:
        """Whether slope and intercept change anything; grey values are float32 then."""
        return (self.slope, self.intercept) != (1.0, 0.0)

    def note(self, text: str, code: str = "file_read") -> None:
        """Add what was turned, skipped or assumed."""
        self.notices.append(Notice(code, text))


def by_planes(planes: Sequence[Any], decode: Callable[[Any], NDArray[Any]]) -> Fetch:
    """Return a reader that decodes every plane it is asked for."""
    return lambda box: np.stack([decode(plane)[box[1:]] for plane in planes[box[0]]])


def unpack_once(unpack: Callable[[], NDArray[Any]]) -> Fetch:
    """Return a reader of an array that is unpacked as a whole when it is first asked for."""
    held: list[NDArray[Any]] = []

    def read(box: Box) -> NDArray[Any]:
        if not held:
            held.append(unpack())
        return native(held[0][box])

    return read


def native(values: NDArray[Any]) -> NDArray[Any]:
    """Return values in the byte order of the machine, masks of bits as numbers."""
    return values.astype(np.uint8 if values.dtype.kind == "b" else values.dtype.newbyteorder("="), copy=False)


def beside(header: Path, name: str) -> Path:
    """Return the data file that a header names, in the folder of the header or below it.

    A relative name that is there as it is written counts. Headers are also copied to other machines together
    with their data files: of any other name the last part is looked for, in the folder of the header.

    Raises
    ------
    StapeskitError
        There is no such file.
    """
    parts = name.replace("\\", "/").rstrip("/").split("/")
    stated, last = header.parent.joinpath(*parts), header.parent / parts[-1]
    file = stated if parts[0] and ".." not in parts and stated.is_file() else last
    if not file.is_file():
        raise no_data_file(file)
    return file


def no_data_file(file: Path) -> StapeskitError:
    """Return the error for a header whose data file is missing."""
    wanted, step = "in the folder of its header", "Copy both files together"
    return StapeskitError.of("the data file", wanted, f"no {file.name}", next_step=step)


def wrong_file(kind: str, got: str, where: str = "") -> StapeskitError:
    """Return the error for a file with an impossible value or without a needed one."""
    return StapeskitError.of("the scan", f"a readable {kind}", got, where, "Copy or export it again")


def several_values(got: str, where: str = "") -> StapeskitError:
    """Return the error for more than one number in a voxel: colours, vectors, channels, times."""
    step = "Export grey values of one channel, at one time"
    return StapeskitError.of("the volume", "a stack of one grey value per voxel", got, where, step)
