"""Open a scan or a label volume of any format, in a child process where a library reads it."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.formats import RAW, Format, format_of
from ct_inertia.scan.opened import Opened, RawLayout, ReadOptions, looks_like, wrong_header
from ct_inertia.scan.place import place_scan, without_inversion
from ct_inertia.scan.raw import header_beside, plane_reader
from ct_inertia.scan.scan import Fetch, Scan
from stapeskit.faults import StapeskitError
from stapeskit.sandbox import Session, memory_limit, processor_limit_s

Result = TypeVar("Result")

_LEAST_LIMIT_S = 20.0  # processor time of a request: a small packed file can hold gigabytes of one value


def open_scan(
    path: Path | str,
    spacing_mm: float | Sequence[float] | None = None,
    mirror: str | None = None,
    nan_as_air: bool = False,
    raw: RawLayout | None = None,
) -> Scan:
    """Open a scan of any format of the table `ct_inertia.scan.formats.FORMATS`.

    Parameters
    ----------
    path : Path or str
        A file, or a folder of slices.
    spacing_mm : float or sequence of 3 float, optional
        Voxel spacing along x, y, z, mm; needed where the file has none; wins over that of the file.
    mirror : str, optional
        ``x``, ``y`` or ``z``: reverse the voxels along that axis of the grid inside the box of the scan.
    nan_as_air : bool
        Let voxels that are not finite count as air.
    raw : RawLayout, optional
        How voxels lie in a file without a header.

    Returns
    -------
    Scan
        Its voxels are read when they are asked for.

    Raises
    ------
    StapeskitError
        The file is missing, of an unknown kind, damaged or truncated, has no spacing, or is no
        three-dimensional picture of grey values.
    """
    scan = _opened(Path(path), ReadOptions(spacing_mm, mirror, nan_as_air, raw))
    check_differs(scan)
    return scan


def open_labels(
    path: Path | str, spacing_mm: float | Sequence[float] | None = None, mirror: str | None = None
) -> tuple[NDArray[np.integer[Any]], Scan]:
    """Read a label volume of any format as a whole.

    Parameters
    ----------
    path : Path or str
    spacing_mm : float or sequence of 3 float, optional
        That of the scan, where the label file has none; its own wins.
    mirror : str, optional
        As in `open_scan`.

    Returns
    -------
    ndarray of int, [z, y, x]
        The labels.
    Scan
        Their grid, with the names of the segments.

    Raises
    ------
    StapeskitError
        As `open_scan`; also values that are not whole numbers.
    """
    scan = without_inversion(_opened(Path(path), ReadOptions(spacing_mm, mirror), own_spacing=True))
    labels = scan.read()
    if labels.dtype.kind == "f":
        whole = np.rint(labels)
        if np.any(whole != labels) or np.abs(whole).max() > np.iinfo(np.int32).max:
            step = "Export labels, not grey values"
            raise StapeskitError.of("the label volume", "whole numbers", "fractions", scan.name, step)
        labels = whole.astype(np.int32)
    if labels.min() == labels.max():
        raise _constant(scan, labels.flat[0])
    return labels, scan


def check_differs(scan: Scan) -> None:
    """Refuse a volume with one value in every voxel.

    Raises
    ------
    StapeskitError
        All voxels are equal.
    """
    middle = scan.shape[0] // 2
    plane = scan.read((slice(middle, middle + 1), slice(None), slice(None)))
    first = plane.flat[0]
    if np.all(plane == first) and all(np.all(slab == first) for _, slab in scan.slabs()):
        raise _constant(scan, first)


def _constant(scan: Scan, value: object) -> StapeskitError:
    wanted, got = "a picture with differing grey values", f"{value} in every voxel"
    step = "Check that this is the reconstructed volume, and export it again"
    return StapeskitError.of("the volume", wanted, got, scan.name, step)


def _opened(path: Path, options: ReadOptions, own_spacing: bool = False) -> Scan:
    path = _existing(path)
    entry = format_of(path, options)
    source = path
    if entry is RAW and options.raw is None and (header := header_beside(path)) is not None:
        source, entry = header, format_of(header, options)
    opened, fetch = _read_header(entry, source, options)
    opened.files = tuple(dict.fromkeys((path, source, *opened.files)))
    if own_spacing and opened.spacing_mm is not None and np.all(np.isfinite(opened.spacing_mm)):
        options = replace(options, spacing_mm=None)
    return place_scan(opened, fetch, path, options, entry.carries_place)


def _read_header(entry: Format, path: Path, options: ReadOptions) -> tuple[Opened, Fetch]:
    """Read the header, in a child process where a library does it, and return how voxels are read."""
    if not entry.libraries:
        opened = _plainly(entry, path, lambda: entry.open_file(path, options))
        return opened, _fetch_of(opened)

    def open_source() -> tuple[Opened, Fetch]:
        found = _plainly(entry, path, lambda: entry.open_file(path, options))
        if found.read is None:
            return found, _fetch_of(found)
        read, found.read = found.read, None
        return found, lambda box: _plainly(entry, path, lambda: read(box))

    session = Session(
        open_source,
        path,
        f"the {entry.title} scan",
        max(_LEAST_LIMIT_S, processor_limit_s(path)),
        max(memory_limit(path), _half_of_memory()),
        entry.libraries,
    )
    opened = session.opened
    if opened.planes is not None:
        session.close()
        return opened, _fetch_of(opened)
    return opened, lambda box: session.ask(box)


def _plainly(entry: Format, path: Path, work: Callable[[], Result]) -> Result:
    """Return what ``work`` returns; whatever a library raises on a damaged file becomes one sentence."""
    try:
        return work()
    except (StapeskitError, MemoryError):
        raise
    except Exception as fault:
        library = entry.libraries[0].split(".")[0] if entry.libraries else "its reader"
        got = f"one that {library} cannot read{looks_like(path, entry.title)}"
        raise wrong_header(path, f"{entry.title} file", got) from fault


def _fetch_of(opened: Opened) -> Fetch:
    if opened.planes is None:
        raise StapeskitError.of("the scan", "one with voxels", "a header alone")
    return plane_reader(opened.planes, opened.shape, opened.dtype)


def _half_of_memory() -> int:
    """Return half of the memory of the machine, bytes; 0 where the system does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    except (ValueError, OSError, AttributeError):
        return 0


def _existing(path: Path) -> Path:
    """Return the path of a folder, or of a regular file with content.

    Raises
    ------
    StapeskitError
        Nothing is there, it cannot be looked at, it is empty, or it is a pipe or a device.
    """
    try:
        status = path.stat()
        if path.is_file():
            path.open("rb").close()
        elif path.is_dir():
            next(path.iterdir(), None)
    except (FileNotFoundError, NotADirectoryError):
        raise StapeskitError.of(
            "the scan", "an existing file or folder", path, next_step="Check the path"
        ) from None
    except (OSError, ValueError) as fault:
        why, step = getattr(fault, "strerror", None) or str(fault), "Check its permissions"
        raise StapeskitError.of("the scan", "a file that can be read", why, path.name, step) from None
    if not stat.S_ISREG(status.st_mode) and not stat.S_ISDIR(status.st_mode):
        step = "Save it as a file"
        raise StapeskitError.of("the scan", "a file or folder", "a pipe or a device", path.name, step)
    if stat.S_ISREG(status.st_mode) and status.st_size == 0:
        step = "Copy it again"
        raise StapeskitError.of("the scan", "a file with content", "an empty file", path.name, step)
    return path if path.name else path.resolve()
