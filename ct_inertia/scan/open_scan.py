"""Open a scan or a label volume of any format: the header, and packed voxels, in a child process."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.formats import RAW, Format, format_of
from ct_inertia.scan.header import Header, wrong_header
from ct_inertia.scan.place import place_scan
from ct_inertia.scan.raw import RawLayout, plane_reader
from ct_inertia.scan.scan import Fetch, Scan
from stapeskit.faults import StapeskitError
from stapeskit.sandbox import Answer, Session, can_fork, memory_limit, processor_limit_s

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
        three-dimensional picture of differing grey values.
    """
    path = _existing(Path(path))
    header, fetch, entry = _opened(path, raw)
    facts = {"nan_as_air": nan_as_air, "carries_place": entry.carries_place}
    scan = place_scan(header, fetch, path, spacing_mm, mirror, **facts)
    middle = scan.shape[0] // 2
    plane = scan.read((slice(middle, middle + 1), slice(None), slice(None)))
    first = plane.flat[0]
    if np.all(plane == first) and all(np.all(slab == first) for _, slab in scan.slabs()):
        raise _constant(scan, first)
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
    path = _existing(Path(path))
    header, fetch, entry = _opened(path)
    header.white_is_zero = False  # numbers that name bodies are neither bright nor dark
    own = header.spacing_mm is not None and np.all(np.isfinite(header.spacing_mm))
    grid = place_scan(
        header, fetch, path, None if own else spacing_mm, mirror, carries_place=entry.carries_place
    )
    labels = grid.read()
    if labels.dtype.kind == "f":
        whole = np.rint(labels)
        if np.any(whole != labels) or np.abs(whole).max() > np.iinfo(np.int32).max:
            step = "Export labels, not grey values"
            raise StapeskitError.of("the label volume", "whole numbers", "fractions", grid.name, step)
        labels = whole.astype(np.int32)
    if labels.min() == labels.max():
        raise _constant(grid, labels.flat[0])
    return labels, grid


def _constant(scan: Scan, value: object) -> StapeskitError:
    wanted, got = "a picture with differing grey values", f"{value} in every voxel"
    step = "Check that this is the reconstructed volume, and export it again"
    return StapeskitError.of("the volume", wanted, got, scan.name, step)


def _opened(path: Path, layout: RawLayout | None = None) -> tuple[Header, Fetch, Format]:
    """Read the header in a child process, which stays where it decodes voxels."""
    entry = format_of(path) if layout is None or path.is_dir() else RAW

    def open_source() -> tuple[Header, Answer]:
        given = (layout,) if entry is RAW else ()
        header = _plainly(entry, path, lambda: entry.open_file(path, *given))
        read, header.read = cast(Fetch, header.read), None  # asked only where no planes lie in files
        return header, lambda box: _plainly(entry, path, lambda: read(box))

    limit_s = max(_LEAST_LIMIT_S, processor_limit_s(path))
    half_of_all = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2 if can_fork() else 0
    memory = max(memory_limit(path), half_of_all)
    session = Session(open_source, path, f"the {entry.title} scan", limit_s, memory, entry.libraries)
    header = session.opened
    if header.planes is None:
        return header, session.ask, entry
    session.close()
    return header, plane_reader(header.planes, header.shape, header.dtype), entry


def _plainly(entry: Format, path: Path, work: Callable[[], Result]) -> Result:
    """Return what ``work`` returns; whatever a library raises on a damaged file becomes one sentence."""
    try:
        return work()
    except (StapeskitError, MemoryError):
        raise
    except Exception as fault:
        got = "a damaged one, or of another kind"
        if path.is_file():
            with path.open("rb") as stream:
                got += f": it begins with {stream.read(12)!r}"
        raise wrong_header(path, f"{entry.title} file", got) from fault


def _existing(path: Path) -> Path:
    """Return the path of a folder, or of a regular file with content.

    Raises
    ------
    StapeskitError
        Nothing is there, it cannot be looked at, it is empty, or it is a pipe or a device.
    """
    wanted, got, step = "a file or folder that can be read", "", "Check its path and permissions"
    try:
        if path.is_dir():
            next(path.iterdir(), None)
        elif not path.exists():
            wanted, got = "an existing file or folder", f"no {path}"
        elif not path.is_file():
            got, step = "a pipe or a device", "Save it as a file"
        elif path.stat().st_size == 0:
            got, step = "an empty file", "Copy it again"
        else:
            path.open("rb").close()
    except (OSError, ValueError) as fault:
        got = getattr(fault, "strerror", None) or str(fault)
    if got:
        raise StapeskitError.of("the scan", wanted, got, path.name, step)
    return path if path.name else path.resolve()
