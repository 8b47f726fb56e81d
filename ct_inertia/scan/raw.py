"""Raw voxels: read plane by plane where they lie, by the user's layout or a header beside them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.opened import Opened, RawPlanes, ReadOptions, planes_in
from ct_inertia.scan.scan import Box, Fetch
from stapeskit.faults import StapeskitError

VOXEL_TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64")

HEADERS = (".mhd", ".nhdr", ".vgi")
"""Endings of headers whose voxels lie in a raw file of the same name."""

_PAGE = 4096  # bytes that the system reads at least: shorter rows are not read one by one
_THREADS = 2
_THREADS_FROM = 5  # planes; fewer are read sooner than a thread starts


def plane_reader(planes: RawPlanes, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Fetch:
    """Return a function that reads boxes of raw voxels; no map: a file that shrinks is an error.

    Parameters
    ----------
    planes : RawPlanes
    shape : tuple of 3 int
        Voxels along z, y, x.
    dtype : dtype
        As stored.
    """
    width = shape[2]
    native = dtype.newbyteorder("=")

    def fetch(box: Box) -> NDArray[Any]:
        zs, ys, xs = (range(n)[along] for along, n in zip(box, shape, strict=True))
        out = np.empty((len(zs), len(ys), len(xs)), dtype=native)
        if not out.size:
            return out
        row_bytes = width * dtype.itemsize
        single = ys.step > 1 and row_bytes >= _PAGE

        def read(k: int) -> None:
            z = zs[k]
            start = int(planes.offset[z])
            with _open(planes.files[planes.file[z]]) as stream:
                if single:
                    rows = np.empty((len(ys), width), dtype)
                    for row, y in zip(rows, ys, strict=True):
                        _fill(stream, row, start + y * row_bytes)
                else:
                    rows = np.empty((ys[-1] - ys[0] + 1, width), dtype)
                    _fill(stream, rows, start + ys[0] * row_bytes)
                    rows = rows[:: ys.step]
            out[k] = rows[:, xs.start : xs.stop : xs.step]

        if len(zs) < _THREADS_FROM:
            for k in range(len(zs)):
                read(k)
        else:
            with ThreadPoolExecutor(_THREADS) as pool:
                list(pool.map(read, range(len(zs))))
        return out

    return fetch


def _open(path: Path) -> BinaryIO:
    """Open a file without a buffer.

    Raises
    ------
    StapeskitError
        It has gone, or may not be read.
    """
    try:
        return path.open("rb", buffering=0)
    except OSError as fault:
        wanted, step = "a file that can be read", "Check its name, permissions and disk"
        raise StapeskitError.of("the scan", wanted, fault.strerror, path.name, step) from fault


def _fill(stream: BinaryIO, out: NDArray[Any], place: int) -> None:
    """Read bytes at a place of a file into an array.

    Raises
    ------
    StapeskitError
        The file ends before.
    """
    view = out.reshape(-1).view(np.uint8).data
    stream.seek(place)
    done = 0
    while done < len(view):
        count = stream.readinto(view[done:])  # type: ignore[attr-defined]
        if not count:
            got, name = f"a file that ends at byte {place + done}", Path(stream.name).name
            raise StapeskitError.of("the scan", "complete", got, name, "Copy or export it again")
        done += count


def open_file(path: Path, options: ReadOptions) -> Opened:
    """Return a raw file with the layout that the user gave.

    Raises
    ------
    StapeskitError
        No layout, an impossible one, or a file that is not exactly as long as it says.
    """
    layout = options.raw
    if layout is None:
        wanted = f"in the folder of their header ({', '.join(HEADERS)}) or described by --shape and --dtype"
        step = "Give --shape NX,NY,NZ --dtype uint16 [--byte-order big] [--header-bytes N] --spacing H"
        raise StapeskitError.of("raw voxels", wanted, "neither", path.name, step)
    sound = len(layout.shape) == 3 and min(layout.shape) >= 2
    for option, good, wanted, got in (
        ("--shape", sound, "three whole numbers NX,NY,NZ of at least 2, x fastest", layout.shape),
        ("--dtype", layout.dtype in VOXEL_TYPES, f"one of {', '.join(VOXEL_TYPES)}", layout.dtype),
        ("--byte-order", layout.byte_order in ("little", "big"), "little or big", layout.byte_order),
        ("--header-bytes", layout.header_bytes >= 0, "0 or more", layout.header_bytes),
    ):
        if not good:
            raise StapeskitError.of(option, wanted, got)
    dtype = np.dtype(layout.dtype).newbyteorder("<" if layout.byte_order == "little" else ">")
    shape = tuple(int(n) for n in reversed(layout.shape))
    needed, stored = dtype.itemsize * prod(shape), path.stat().st_size - layout.header_bytes
    if stored != needed:
        size = " x ".join(map(str, layout.shape))
        wanted = f"as long as {size} voxels of {layout.dtype} ({needed} bytes)"
        got = f"{stored} bytes after the header"
        raise StapeskitError.of("the raw file", wanted, got, path.name, _length_step(path, needed))
    planes = planes_in([(path, layout.header_bytes)], shape, dtype, path.name)
    return Opened(shape, dtype, planes, known="raw voxels do not have it")


def _length_step(path: Path, needed: int) -> str:
    with path.open("rb") as stream:
        if stream.read(2) == b"\x1f\x8b":
            return "The file is packed (gzip): unpack it first"
    step, rest = "Check --shape, --dtype and --header-bytes", path.stat().st_size - needed
    return f"{step}; --header-bytes {rest} would fit if the surplus is a header" if rest > 0 else step


def header_beside(path: Path) -> Path | None:
    """Return the header of a raw file (``scan.mhd``, ``scan.raw.mhd``, ``scan.vgi``, ...), or None."""
    names = [name for end in HEADERS for name in (path.with_suffix(end), path.with_name(path.name + end))]
    if path.suffix.lower() == ".img":
        names.append(path.with_suffix(".hdr"))
    return next((name for name in names if name.is_file()), None)
