"""Raw voxels: read plane by plane where they lie; a file of them alone by the layout that the user gives."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.header import Header
from ct_inertia.scan.scan import Box, Fetch
from stapeskit.faults import StapeskitError

_PAGE = 4096  # bytes that the system reads at least: shorter rows are not read one by one
_THREADS = 2
_THREADS_FROM = 5  # planes; fewer are read sooner than a thread starts


@dataclass(frozen=True)
class RawLayout:
    """How voxels lie in a file without a header.

    Attributes
    ----------
    shape : tuple of 3 int
        Voxels along x, y, z; x runs fastest.
    dtype : str
        As numpy calls it, ``uint16``.
    byte_order : str
        ``little`` or ``big``.
    header_bytes : int
        Bytes before the first voxel.
    """

    shape: tuple[int, ...]
    dtype: str
    byte_order: str = "little"
    header_bytes: int = 0


def open_raw(path: Path, layout: RawLayout | None) -> Header:
    """Return a raw file with the layout that the user gave.

    Raises
    ------
    StapeskitError
        No layout, or a file that is not exactly as long as it says.
    """
    if layout is None:
        step = (
            "Give the header beside them (.mhd, .nhdr, .vgi, .hdr) in their place, or "
            "--shape NX,NY,NZ --dtype uint16 [--byte-order big] [--header-bytes N] --spacing H"
        )
        raise StapeskitError.of("the scan", "a file with a header", "raw voxels alone", path.name, step)
    dtype = np.dtype(layout.dtype).newbyteorder("<" if layout.byte_order == "little" else ">")
    needed, size = dtype.itemsize * prod(layout.shape), path.stat().st_size
    if size - layout.header_bytes != needed:
        voxels = " x ".join(map(str, layout.shape))
        wanted = f"as long as {voxels} voxels of {layout.dtype} ({needed} bytes)"
        got = f"{size - layout.header_bytes} bytes after the header"
        step = "Check --shape, --dtype and --header-bytes"
        if path.suffix.lower() == ".gz":
            step = "The file is packed (gzip): unpack it first"
        elif size > needed:
            step += f"; --header-bytes {size - needed} would fit if the surplus is a header"
        raise StapeskitError.of("the raw file", wanted, got, path.name, step)
    header = Header(tuple(reversed(layout.shape)), dtype, known="raw voxels do not have it")
    header.set_planes(path, layout.header_bytes, path)
    return header


def plane_reader(planes: Sequence[tuple[Path, int]], shape: tuple[int, ...], dtype: np.dtype[Any]) -> Fetch:
    """Return a function that reads boxes of raw voxels; no map: a file that shrinks is an error.

    Parameters
    ----------
    planes : sequence of (Path, int)
        File of each plane, and the byte at which it begins there.
    shape : tuple of 3 int
        Voxels along z, y, x.
    dtype : dtype
        As stored.
    """
    width = shape[2]
    row_bytes = width * dtype.itemsize

    def fetch(box: Box) -> NDArray[Any]:
        zs, ys, xs = (range(n)[along] for along, n in zip(box, shape, strict=True))
        out = np.empty((len(zs), len(ys), len(xs)), dtype=dtype.newbyteorder("="))
        single = ys.step > 1 and row_bytes >= _PAGE

        def read(k: int) -> None:
            file, start = planes[zs[k]]
            with _open(file) as stream:
                if single:
                    rows = np.empty((len(ys), width), dtype)
                    for row, y in zip(rows, ys, strict=True):
                        _fill(stream, row, start + y * row_bytes)
                else:
                    rows = np.empty((ys[-1] - ys[0] + 1, width), dtype)
                    _fill(stream, rows, start + ys[0] * row_bytes)
                    rows = rows[:: ys.step]
            out[k] = rows[:, xs.start : xs.stop : xs.step]

        if out.size and len(zs) < _THREADS_FROM:
            for k in range(len(zs)):
                read(k)
        elif out.size:
            with ThreadPoolExecutor(_THREADS) as pool:
                list(pool.map(read, range(len(zs))))
        return out

    return fetch


def _open(path: Path) -> BinaryIO:
    try:
        return path.open("rb", buffering=0)
    except OSError as fault:  # it has gone, or may no longer be read
        wanted, step = "a file that can be read", "Check its name, permissions and disk"
        raise StapeskitError.of("the scan", wanted, fault.strerror, path.name, step) from fault


def _fill(stream: BinaryIO, out: NDArray[Any], place: int) -> None:
    """Read bytes at a place of a file into an array; a file that ends before is refused."""
    view = out.reshape(-1).view(np.uint8).data
    stream.seek(place)
    done = 0
    while done < len(view):
        count = stream.readinto(view[done:])  # type: ignore[attr-defined]
        if not count:
            got, name = f"a file that ends at byte {place + done}", Path(stream.name).name
            raise StapeskitError.of("the scan", "complete", got, name, "Copy or export it again")
        done += count
