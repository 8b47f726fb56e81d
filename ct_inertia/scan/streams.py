"""Readers of voxels that are packed: plane by plane, or as one stream (gzip, bzip2, zlib) once.

SimpleITK reads a stream that ends too early without an error.
"""

from __future__ import annotations

import bz2
import gzip
import io
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.opened import surplus, too_short, wrong_header
from ct_inertia.scan.scan import Box, Fetch
from stapeskit.faults import StapeskitError

Plane = TypeVar("Plane")

_PIECE = 1 << 22  # bytes that are unpacked at a time


def unpack(
    pieces: Sequence[tuple[Path, int]], skip: int, shape: Sequence[int], dtype: np.dtype[Any], attached: bool
) -> NDArray[Any]:
    """Return the voxels of packed files that hold equal parts of a volume.

    Parameters
    ----------
    pieces : sequence of (Path, int)
        Files, each with the byte at which its stream begins.
    skip : int
        Unpacked bytes before the first voxel; -1: the voxels are the last bytes.
    shape : sequence of int
    dtype : dtype
    attached : bool
        The file has the header as well; a separate file may hold nothing but voxels.

    Raises
    ------
    StapeskitError
        A stream is damaged, too short or, in a separate file, too long.
    """
    out = np.empty(tuple(shape), dtype)
    if out.shape[0] % len(pieces):
        wanted = "files of equal numbers of slices"
        raise StapeskitError.of("the list of data files", wanted, f"{len(pieces)} files", pieces[0][0].name)
    for part, (file, start) in zip(np.split(out.reshape(-1), len(pieces)), pieces, strict=True):
        voxels = part.view(np.uint8).data
        try:
            with file.open("rb") as packed:
                packed.seek(start)
                stream = _unpacking(packed, len(voxels) + max(skip, 0))
                filled, more = _fill(voxels, stream, skip)
        except (EOFError, zlib.error, OSError) as fault:
            raise wrong_header(file, "packed stream", "a damaged or truncated one") from fault
        if filled < len(voxels):
            raise too_short(shape, len(voxels), filled, file.name)
        if more and not attached:
            raise surplus(len(voxels), filled + more, file.name)
    return out


def _unpacking(packed: IO[bytes], needed: int) -> IO[bytes]:
    """Return a stream of unpacked bytes; at least one more than are needed, where it holds more."""
    begin = packed.read(2)
    packed.seek(-len(begin), io.SEEK_CUR)
    if begin == b"\x1f\x8b":
        return gzip.GzipFile(fileobj=packed)  # type: ignore[return-value]
    if begin == b"BZ":
        return bz2.BZ2File(packed)
    return io.BytesIO(zlib.decompressobj().decompress(packed.read(), needed + _PIECE))


def _fill(voxels: memoryview, stream: IO[bytes], skip: int) -> tuple[int, int]:
    """Fill the voxels; return the bytes that were filled, and how many are left over (at most one piece)."""
    if skip == -1:
        whole = stream.read()[-len(voxels) :]
        voxels[len(voxels) - len(whole) :] = whole
        return len(whole), 0
    while skip > 0 and (passed := len(stream.read(min(skip, _PIECE)))):
        skip -= passed
    done = 0
    while done < len(voxels) and (piece := stream.read(min(_PIECE, len(voxels) - done))):
        voxels[done : done + len(piece)] = piece
        done += len(piece)
    return done, len(stream.read(_PIECE)) if done == len(voxels) else 0


def by_planes(planes: Sequence[Plane], decode: Callable[[Plane], NDArray[Any]]) -> Fetch:
    """Return a reader that decodes every plane it is asked for."""

    def read(box: Box) -> NDArray[Any]:
        return np.stack([decode(plane)[box[1:]] for plane in planes[box[0]]])

    return read


def unpack_once(work: Callable[[], NDArray[Any]]) -> Fetch:
    """Return a reader of an array that is unpacked when it is first asked for."""
    held: list[NDArray[Any]] = []

    def read(box: Box) -> NDArray[Any]:
        if not held:
            held.append(work())
        values = held[0][box]
        return values.astype(values.dtype.newbyteorder("="), copy=False)

    return read
