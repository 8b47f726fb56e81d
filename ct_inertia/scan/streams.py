"""Unpack streams of voxels: gzip, zlib and bzip2.

SimpleITK reads a stream that ends too early without an error.
"""

from __future__ import annotations

import bz2
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.opened import Opened, too_short
from ct_inertia.scan.scan import Box, Fetch
from stapeskit.faults import StapeskitError

_PIECE = 1 << 20  # bytes that are read and unpacked at a time
_ZLIB_OR_GZIP = 47  # wbits of zlib: the widest window (15), either header (32)


def unpacked(packing: str, file: Path, start: int, skip: int, out: NDArray[Any]) -> tuple[int, int]:
    """Unpack the voxels of a file into an array.

    Parameters
    ----------
    packing : str
        ``deflate`` (gzip or zlib) or ``bzip2``.
    file : Path
    start : int
        Byte at which the packed stream begins.
    skip : int
        Unpacked bytes before the first voxel; -1: the voxels are the last bytes.
    out : ndarray, (n,)

    Returns
    -------
    int
        Bytes that were filled; fewer than the array has when the stream ends too early.
    int
        Unpacked bytes that are left over, at most one piece of them.

    Raises
    ------
    StapeskitError
        The stream is damaged.
    """
    view = out.view(np.uint8).data
    if skip == -1:
        whole = b"".join(_inflated(packing, file, start))[-len(view) :]
        view[len(view) - len(whole) :] = whole
        return len(whole), 0
    done, left = 0, skip
    for piece in _inflated(packing, file, start):
        passed = min(left, len(piece))
        left -= passed
        rest = memoryview(piece)[passed:]
        taken = min(len(rest), len(view) - done)
        view[done : done + taken] = rest[:taken]
        done += taken
        if len(rest) > taken:
            return done, len(rest) - taken
    return done, 0


def _inflated(packing: str, file: Path, start: int) -> Iterator[bytes]:
    """Yield a packed stream piece by piece; several streams one behind the other count as one."""
    new: Callable[[], Any] = (
        bz2.BZ2Decompressor if packing == "bzip2" else lambda: zlib.decompressobj(_ZLIB_OR_GZIP)
    )
    with file.open("rb") as stream:
        stream.seek(start)
        decoder, data = new(), b""
        try:
            while True:
                if decoder.eof:
                    data = decoder.unused_data.lstrip(b"\0") or stream.read(_PIECE)
                    if not data:
                        return
                    if len(data) < 2 or data[:2] not in (b"\x1f\x8b", b"BZ"):
                        return  # what follows the last stream is none of it
                    decoder = new()
                if not data and getattr(decoder, "needs_input", True):
                    data = stream.read(_PIECE)
                    if not data:
                        return  # the caller sees that voxels are missing
                piece = decoder.decompress(data, 4 * _PIECE)
                data = getattr(decoder, "unconsumed_tail", b"")
                if piece:
                    yield piece
        except (zlib.error, OSError, ValueError) as fault:
            raise _damaged(file, "a damaged packed stream") from fault


def _damaged(file: Path, got: str) -> StapeskitError:
    return StapeskitError.of("the voxels", "readable", got, file.name, "Copy or export it again")


def unpack(
    pieces: Sequence[tuple[Path, int]],
    packing: str,
    skip: int,
    shape: Sequence[int],
    dtype: np.dtype[Any],
    attached: bool,
) -> NDArray[Any]:
    """Return the voxels of packed files that hold equal parts of a volume.

    Parameters
    ----------
    pieces : sequence of (Path, int)
        Files, each with the byte at which its stream begins.
    packing, skip
        As in `unpacked`.
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
        filled, more = unpacked(packing, file, start, skip, part)
        if filled < part.nbytes:
            raise too_short(shape, part.nbytes, filled, file.name)
        if more and not attached:
            raise _surplus(part.nbytes, filled + more, file.name)
    return out


def unpack_once(work: Callable[[], NDArray[Any]]) -> Fetch:
    """Return a reader of an array that is unpacked when it is first asked for."""
    held: list[NDArray[Any]] = []

    def read(box: Box) -> NDArray[Any]:
        if not held:
            held.append(work())
        values = held[0][box]
        return values.astype(values.dtype.newbyteorder("="), copy=False)

    return read


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
        raise _surplus(needed, stored, pieces[0][0].name)


def _surplus(needed: int, stored: int, name: str) -> StapeskitError:
    step = (
        "The header counts other voxels than the file holds. If the file begins with a header of its own, "
        "let the voxels be counted from its end: byte skip: -1 in NRRD, HeaderSize = -1 in MetaImage"
    )
    wanted = f"as long as its header says ({needed} bytes)"
    return StapeskitError.of("the data file", wanted, f"{stored} bytes of voxels", name, step)
