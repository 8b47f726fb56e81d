"""Unpack voxels that are stored as a stream into the array that they fill, piece by piece.

A decoder takes the stream, the bytes to pass over once it is unpacked, and the flat array; it returns how
many bytes of the array it filled, never more, whatever the stream claims.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

# Unpacked at once: bounds the memory in addition to the volume itself.
_STREAM_BYTES = 16 << 20
# Read at once of what holds numbers as text: each word becomes objects of some ten times its length.
_TEXT_BYTES = 1 << 20
_BLANKS = b" \t\r\n\v\f"


def _gzip(stream: BinaryIO, skip: int, array: NDArray[Any]) -> int:
    import gzip

    return _read_through(gzip.GzipFile(fileobj=stream), skip, array)


def _bzip2(stream: BinaryIO, skip: int, array: NDArray[Any]) -> int:
    import bz2

    return _read_through(bz2.BZ2File(stream), skip, array)


def _read_through(source: Any, skip: int, array: NDArray[Any]) -> int:
    room = _bytes_of(array)
    while skip > 0 and (passed := len(source.read(min(skip, _STREAM_BYTES)))):
        skip -= passed
    filled = 0
    while filled < len(room):
        count = source.readinto(room[filled : filled + _STREAM_BYTES])
        if not count:
            break
        filled += count
    if filled == len(room):
        source.read(1 << 16)  # to the end, where the checksum is
    return filled


def _zlib(stream: BinaryIO, _skip: int, array: NDArray[Any]) -> int:
    room = _bytes_of(array)
    unpack = zlib.decompressobj(47)
    filled = 0
    while filled < len(room) and not unpack.eof:
        data = unpack.unconsumed_tail or stream.read(_STREAM_BYTES >> 2)
        if not data:
            break
        piece = unpack.decompress(data, min(len(room) - filled, _STREAM_BYTES))
        room[filled : filled + len(piece)] = piece
        filled += len(piece)
    if filled == len(room) and not unpack.eof:
        unpack.decompress(unpack.unconsumed_tail + stream.read(1 << 16), 1 << 16)
    return filled


def _text(stream: BinaryIO, _skip: int, array: NDArray[Any]) -> int:
    """Read decimal numbers between blanks.

    Raises
    ------
    ValueError
        A word is no number, or one that the type of the array cannot hold.
    """
    filled, rest = 0, b""
    while filled < array.size and (piece := stream.read(_TEXT_BYTES)):
        words = (rest + piece).split()
        rest = b"" if piece[-1:] in _BLANKS else words.pop()
        filled += _store(words, array[filled:])
    if filled < array.size and rest:
        filled += _store([rest], array[filled:])
    return filled * array.itemsize


def _store(words: list[bytes], room: NDArray[Any]) -> int:
    values = np.array([float(word) for word in words[: room.size]])
    part = room[: values.size]
    with np.errstate(invalid="ignore", over="ignore"):
        part[...] = values
    if room.dtype.kind in "ui" and not np.array_equal(part, values):
        raise ValueError("a number beyond the type of the voxels")
    return values.size


def _hex(stream: BinaryIO, _skip: int, array: NDArray[Any]) -> int:
    room = _bytes_of(array)
    filled, rest = 0, b""
    while filled < len(room) and (piece := stream.read(_TEXT_BYTES)):
        digits = rest + piece.translate(None, _BLANKS)
        even = len(digits) & ~1
        data, rest = bytes.fromhex(digits[:even].decode("ascii")), digits[even:]
        data = data[: len(room) - filled]
        room[filled : filled + len(data)] = data
        filled += len(data)
    return filled


def _amira_runs(stream: BinaryIO, _skip: int, array: NDArray[Any]) -> int:
    """Unpack HxByteRLE: a count and the byte that it repeats, or 128 + a count and so many bytes."""
    room = _bytes_of(array)
    filled, data, at = 0, b"", 0
    while filled < len(room):
        if at + 128 > len(data):
            data, at = data[at:] + stream.read(_TEXT_BYTES), 0
        head = data[at : at + 1]
        count = min(head[0] & 0x7F, len(room) - filled) if head else 0
        if not count:
            break
        piece = data[at + 1 : at + 1 + count] if head[0] & 0x80 else data[at + 1 : at + 2] * count
        room[filled : filled + len(piece)] = piece
        filled += len(piece)
        if len(piece) < count:
            break
        at += 1 + (count if head[0] & 0x80 else 1)
    return filled


def _bytes_of(array: NDArray[Any]) -> memoryview:
    return memoryview(cast(Any, array.view(np.uint8)))


DECODERS: dict[str, Callable[[BinaryIO, int, NDArray[Any]], int]] = {
    "gzip": _gzip,
    "bzip2": _bzip2,
    "zlib": _zlib,
    "text": _text,
    "hex": _hex,
    "HxByteRLE": _amira_runs,
}
"""By the name of the packing in `grid.Grid`."""
