"""What a file says about a scan, the size check of raw voxels, and faults that formats share."""

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


@dataclass
class Header:
    """A scan as its file describes it, before the rules of `place` are applied.

    What is not listed is as in `Scan`.

    Attributes
    ----------
    dtype : dtype
        Of a stored voxel, with its byte order.
    planes : sequence of (Path, int), or None
        File and byte of each plane of voxels that lie there as they are; otherwise ``read`` decodes them.
    read : callable or None
        Decodes a box; stays in the child process in which a library has opened the file.
    depth : int
        Planes that are decoded together.
    spacing_mm : ndarray, (3,), or None
        Along x, y, z; NaN along an axis, or None, where the file does not have it.
    direction : ndarray, (3, 3)
        As in `Scan`; may be left-handed.
    anatomical : bool
        The file ties its axes to the patient.
    slope, intercept : float
        Grey value = slope * stored + intercept.
    white_is_zero : bool
        Bright and dark are exchanged in the file.
    known : str
        What the file says of an incomplete spacing, for the message.
    names : dict of int to str
        Names of labels.
    files : tuple of Path
        Files that are read besides the one given.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    planes: Sequence[tuple[Path, int]] | None = None
    read: Fetch | None = None
    depth: int = 1
    spacing_mm: Array | None = None
    origin_mm: Array = field(default_factory=lambda: np.zeros(3))
    direction: Array = field(default_factory=lambda: np.eye(3))
    anatomical: bool = False
    slope: float = 1.0
    intercept: float = 0.0
    white_is_zero: bool = False
    known: str = ""
    notices: list[Notice] = field(default_factory=list)
    names: dict[int, str] = field(default_factory=dict)
    files: tuple[Path, ...] = ()

    def note(self, text: str) -> None:
        """Add how the file was read."""
        self.notices.append(Notice("file_read", text))

    def set_planes(self, file: Path, start: int, header: Path, exact: bool = False) -> None:
        """Say that the voxels lie in a file, one plane behind the other.

        Parameters
        ----------
        file : Path
        start : int
            Byte of the first voxel; -1: the voxels are the last bytes.
        header : Path
            File of the header, which may be the same.
        exact : bool
            Refuse a separate file with more bytes, and one file of both with at least one more slice: the
            header counts fewer voxels, or another header comes before them.

        Raises
        ------
        StapeskitError
            The file is missing, too short, or too long.
        """
        if not file.is_file():
            raise no_data_file(file, header)
        plane = int(self.shape[1]) * int(self.shape[2]) * self.dtype.itemsize
        needed, stored = plane * int(self.shape[0]), file.stat().st_size
        held = stored - max(start, 0)
        surplus = exact and start >= 0 and held - needed >= (plane if file == header else 1)
        if held < needed or surplus:
            raise wrong_size(self.shape, needed, held, file)
        first = stored - needed if start == -1 else start
        self.planes = [(file, first + plane * k) for k in range(int(self.shape[0]))]
        self.files = tuple(dict.fromkeys((*self.files, file)))


def wrong_size(shape: Sequence[int], needed: int, held: int, file: Path) -> StapeskitError:
    """Return the error for a file that holds fewer or more bytes of voxels than its header counts."""
    size = " x ".join(str(int(n)) for n in reversed(shape))
    step = "The file is truncated or its header is wrong: copy or export it again"
    if held > needed:
        step = (
            "If the data file begins with a header of its own, let the voxels be counted from its end: "
            "byte skip: -1 in NRRD, HeaderSize = -1 in MetaImage, SkipHeader in VGStudio"
        )
    wanted = f"as large as its header says ({size} voxels, {needed} bytes)"
    return StapeskitError.of("the scan", wanted, f"{max(held, 0)} bytes of voxels", file.name, step)


def by_planes(planes: Sequence[Any], decode: Callable[[Any], NDArray[Any]]) -> Fetch:
    """Return a reader that decodes every plane it is asked for."""
    return lambda box: np.stack([decode(plane)[box[1:]] for plane in planes[box[0]]])


def unpack_once(unpack: Callable[[], NDArray[Any]]) -> Fetch:
    """Return a reader of an array that is unpacked as a whole when it is first asked for."""
    held: list[NDArray[Any]] = []

    def read(box: Box) -> NDArray[Any]:
        if not held:
            held.append(unpack())
        values = held[0][box]
        return values.astype(values.dtype.newbyteorder("="), copy=False)

    return read


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
        raise no_data_file(file, header)
    return file


def no_data_file(file: Path, header: Path) -> StapeskitError:
    """Return the error for a header whose data file is missing."""
    wanted, step = "in the folder of its header", "Copy both files together"
    return StapeskitError.of("the data file", wanted, f"no {file.name}", header.name, step)


def wrong_header(path: Path, kind: str, got: str) -> StapeskitError:
    """Return the error for a header with an impossible value or without a needed one."""
    return StapeskitError.of("the scan", f"a readable {kind}", got, path.name, "Copy or export it again")


def several_values(path: Path, got: str) -> StapeskitError:
    """Return the error for more than one number in a voxel: colours, vectors, channels, times."""
    step = "Export grey values of one channel, at one time"
    return StapeskitError.of("the volume", "a stack of one grey value per voxel", got, path.name, step)
