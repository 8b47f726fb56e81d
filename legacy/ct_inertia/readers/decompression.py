"""Unpack a chunk into as many bytes as it may have, whatever its content claims."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np


def unpack(codec: str, data: bytes, most: int) -> bytes:
    """Return the unpacked bytes, never more than ``most``.

    Parameters
    ----------
    codec : str
        One of `CODECS`.
    most : int
        Bytes that there can be.

    Raises
    ------
    Exception
        The data are damaged or longer; of many kinds, one per library.
    """
    return CODECS[codec](data, most)


def _decoder_of(name: str) -> Callable[[bytes, int], bytes]:
    """Return the decoder of imagecodecs, which fills a buffer of the size that it is handed."""

    def decode(data: bytes, most: int) -> bytes:
        import imagecodecs

        # One byte more: some decoders stop at the end of the buffer without an error.
        unpacked: bytes = getattr(imagecodecs, f"{name}_decode")(data, out=most + 1)
        return unpacked

    return decode


def _lz4(data: bytes, most: int) -> bytes:
    import imagecodecs

    if int.from_bytes(data[:4], "little") > most:
        raise ValueError("longer than its chunk")
    return bytes(imagecodecs.lz4_decode(data, header=True, out=most))


def _blosc(data: bytes, most: int) -> bytes:
    """Unpack a Blosc 1 chunk after a look at its table of blocks.

    Notes
    -----
    The decoder trusts sizes and offsets of the header and crashes on wrong ones. The format:
    https://github.com/Blosc/c-blosc/blob/main/README_CHUNK_FORMAT.rst
    """
    import imagecodecs

    if len(data) < 16:
        raise EOFError
    flags = data[2]
    unpacked, block, packed = struct.unpack_from("<3I", data, 4)
    if unpacked > most or packed != len(data) or not data[3]:
        raise ValueError("sizes of a header that are not those of the chunk")
    stored_plainly = bool(flags & 2)
    if stored_plainly and packed != unpacked + 16:
        raise ValueError("plain bytes of another size")
    if not stored_plainly and unpacked:
        if not 0 < block <= unpacked:
            raise ValueError("blocks of an impossible size")
        count = -(-unpacked // block)
        starts = np.frombuffer(data, "<u4", count, 16) if 16 + 4 * count <= packed else np.array([0])
        if starts.min() < 16 + 4 * count or starts.max() + 4 > packed:
            raise ValueError("blocks outside the chunk")
    return bytes(imagecodecs.blosc_decode(data, out=most, numthreads=1))


def _without_check_sum(data: bytes, most: int) -> bytes:
    if len(data) < 4:
        raise EOFError
    return data[:-4][: most + 1]


CODECS: dict[str, Callable[[bytes, int], bytes]] = {
    "blosc": _blosc,
    "zstd": _decoder_of("zstd"),
    "lz4": _lz4,
    "zlib": _decoder_of("zlib"),
    "gzip": _decoder_of("gzip"),
    "bz2": _decoder_of("bz2"),
    "lzma": _decoder_of("lzma"),
    "crc32c": _without_check_sum,
}
"""The codecs of Zarr that are known, by their names there."""
