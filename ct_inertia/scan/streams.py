"""Unpack streams of voxels: gzip, zlib and bzip2.

SimpleITK reads a stream that ends too early without an error.
"""

from __future__ import annotations

import bz2
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
