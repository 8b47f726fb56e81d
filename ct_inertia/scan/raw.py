"""Voxels as they lie in files: one check of sizes for all formats, planes that are read in place, streams."""

from __future__ import annotations

import bz2
import gzip
import zlib
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.place import check_grey_values
from ct_inertia.scan.scan import Box, Fetch
from ct_inertia.scan.stored import Stored, Stream, no_data_file, several_values, unpack_once, wrong_file
from stapeskit.faults import StapeskitError

_THREADS = 2  # that read planes at a time


@dataclass(frozen=True)
class RawLayout:
    """How voxels lie in a file without a header.

    ``shape`` along x, y, z, of which x runs fastest; ``dtype`` as numpy calls it, ``uint16``; ``byte_order``
    ``little`` or ``big``; ``header_bytes`` before the first voxel.
    """

    shape: tuple[int, ...]
    dtype: str
    byte_order: str = "little"
    header_bytes: int = 0


def open_raw(path: Path, layout: RawLayout | None = None) -> Stored:
    """Return a raw file with the layout that the user gave, which must be as long as it says."""
    if layout is None:
        step = (
            "Give the header beside them (.mhd, .nhdr, .vgi, .hdr) in their place, or "
            "--shape NX,NY,NZ --dtype uint16 [--byte-order big] [--header-bytes N] --spacing H"
        )
        raise StapeskitError.of("the scan", "a file with a header", "raw voxels alone", next_step=step)
    dtype = np.dtype(layout.dtype).newbyteorder("<" if layout.byte_order == "little" else ">")
    needed, size = dtype.itemsize * prod(layout.shape), path.stat().st_size
    if size - layout.header_bytes != needed:
        wanted = f"as long as {_times(layout.shape)} voxels of {layout.dtype} ({needed} bytes)"
        step = "Check --shape, --dtype and --header-bytes"
        if path.suffix.lower() == ".gz":
            step = "The file is packed (gzip): unpack it first"
        elif size > needed:
            step += f"; --header-bytes {size - needed} would fit if the surplus is a header"
        got = f"{size - layout.header_bytes} bytes after the header"
        raise StapeskitError.of("the raw file", wanted, got, next_step=step)
    stream, known = Stream(path, layout.header_bytes), "raw voxels do not have it"
    return Stored(tuple(reversed(layout.shape)), dtype, stream, known=known)


def find_voxels(stored: Stored, path: Path) -> None:
    """Check what a header says by one rule for all formats, and turn a stream into planes or into a reader.

    Raises
    ------
    StapeskitError
        No three-dimensional grey values; a file that is too short, or too long for its header.
    """
    shape = tuple(int(n) for n in stored.shape)
    while len(shape) > 3 and shape[0] == 1:
        shape = shape[1:]
    if len(shape) > 3 and min(shape[-3:]) > 1:
        raise several_values(f"{prod(shape[:-3])} values (a vector or time image)")
    check_grey_values(shape, stored.dtype)
    stored.shape, where = shape, stored.voxels
    plane = prod(shape[1:]) * stored.dtype.itemsize
    if isinstance(where, Stream):
        if not where.file.is_file():
            raise no_data_file(where.file)
        stored.files = (*stored.files, where.file)
        if where.packed:
            stored.voxels = unpack_once(lambda: unpacked(where, shape, stored.dtype, path))
            return
        first = _first_byte(where, where.start, where.file.stat().st_size, shape, plane, path)
        stored.voxels = [(where.file, first + plane * k) for k in range(shape[0])]
    elif isinstance(where, Sequence):
        for file in dict.fromkeys(file for file, _ in where):
            needed = max(start for one, start in where if one == file) + plane
            if needed > file.stat().st_size:
                raise _wrong_size(shape, needed, file.stat().st_size, file)


def unpacked(stream: Stream, shape: Sequence[int], dtype: np.dtype[Any], path: Path) -> NDArray[Any]:
    """Return the voxels of a stream, if packed read to the check sum at its end; ``path`` is the header's.

    Raises
    ------
    StapeskitError
        It is damaged, truncated, or of another length than its header says.

    Notes
    -----
    SimpleITK reads a stream that ends too early without an error, nibabel stops before the check sum.
    """
    try:
        with stream.file.open("rb") as source:
            source.seek(stream.start)
            content = source.read()
        if stream.packed:
            packing: Any = {b"\x1f\x8b": gzip, b"BZ": bz2}.get(content[:2], zlib)
            content = packing.decompress(content)
    except (EOFError, zlib.error, OSError) as fault:
        raise wrong_file("packed stream", "a damaged or truncated one", stream.file.name) from fault
    first = _first_byte(stream, 0, len(content), shape, prod(shape[1:]) * dtype.itemsize, path)
    return np.frombuffer(content, dtype, prod(shape), first).reshape(shape)


def _first_byte(stream: Stream, begin: int, held: int, shape: Sequence[int], plane: int, path: Path) -> int:
    """Return the byte of the first voxel in a stream of so many bytes that begins at one of them."""
    first = begin + max(stream.skip, 0)
    needed, found = plane * shape[0], held - first
    spare = 1 if stream.file != path else plane
    if found < needed or (stream.exact and stream.skip >= 0 and found - needed >= spare):
        raise _wrong_size(shape, needed, found, stream.file)
    return held - needed if stream.skip == -1 else first


def _wrong_size(shape: Sequence[int], needed: int, held: int, file: Path) -> StapeskitError:
    """Return the error for a file that holds fewer or more bytes of voxels than its header counts."""
    step = "The file is truncated or its header is wrong: copy or export it again"
    if held > needed:
        step = (
            "If the data file begins with a header of its own, let the voxels be counted from its end: "
            "byte skip: -1 in NRRD, HeaderSize = -1 in MetaImage, SkipHeader in VGStudio"
        )
    wanted = f"as large as its header says ({_times(reversed(shape))} voxels, {needed} bytes)"
    return StapeskitError.of("the scan", wanted, f"{max(held, 0)} bytes of voxels", file.name, step)


def _times(numbers: Iterable[int]) -> str:
    return " x ".join(str(n) for n in numbers)


def plane_reader(planes: Sequence[tuple[Path, int]], shape: tuple[int, ...], dtype: np.dtype[Any]) -> Fetch:
    """Return a function that reads boxes of raw voxels; no map: a file that shrinks is an error.

    ``planes``: file of each plane, and the byte at which it begins there; ``shape`` along z, y, x.
    """
    width = shape[2]

    def fetch(box: Box) -> NDArray[Any]:
        zs, ys, xs = (range(n)[along] for along, n in zip(box, shape, strict=True))
        out = np.empty((len(zs), len(ys), len(xs)), dtype=dtype.newbyteorder("="))

        def read(k: int) -> None:
            file, start = planes[zs[k]]
            rows = _values(file, start + ys[0] * width * dtype.itemsize, dtype, (ys[-1] - ys[0] + 1) * width)
            out[k] = rows.reshape(-1, width)[:: ys.step, xs.start : xs.stop : xs.step]

        with ThreadPoolExecutor(_THREADS) as pool:
            list(pool.map(read, range(len(zs) if out.size else 0)))
        return out

    return fetch


def _values(file: Path, start: int, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
    """Return so many values at a byte of a file."""
    try:
        values = np.fromfile(file, dtype, count, offset=start)
    except OSError as fault:
        wanted, step = "a file that can be read", "Check its name, permissions and disk"
        raise StapeskitError.of("the scan", wanted, fault.strerror, file.name, step) from fault
    if len(values) < count:
        got = f"a file that ends at byte {start + values.nbytes}"
        raise StapeskitError.of("the scan", "complete", got, file.name, "Copy or export it again")
    return values
