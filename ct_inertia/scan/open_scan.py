"""Open a scan or a label volume of any format: the header, and packed voxels, in a child process."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.formats import RAW, Format, format_of
from ct_inertia.scan.place import choose_spacing, turn_right_handed
from ct_inertia.scan.raw import RawLayout, find_voxels, open_raw, plane_reader
from ct_inertia.scan.scan import Box, Fetch, Scan
from ct_inertia.scan.stored import Stored, wrong_file
from stapeskit.faults import StapeskitError
from stapeskit.sandbox import Answer, Session, can_fork, memory_limit, no_requests, processor_limit_s

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
    spacing_mm : float or sequence of 3 float, optional
        Voxel spacing along x, y, z, mm; needed where the file has none; wins over that of the file.
    mirror : str, optional
        ``x``, ``y`` or ``z``: reverse the voxels along that axis of the grid inside the box of the scan.
    nan_as_air : bool
        Let voxels that are not finite count as air.

    Raises
    ------
    StapeskitError
        The file is missing, of an unknown kind, damaged or truncated, has no spacing, or is no
        three-dimensional picture of differing grey values.
    """
    scan = replace(_open(Path(path), spacing_mm, mirror, raw), nan_as_air=nan_as_air)
    middle = scan.shape[0] // 2
    plane = scan.read((slice(middle, middle + 1), slice(None), slice(None)))
    first = plane.flat[0]
    if np.all(plane == first) and all(np.all(slab == first) for _, slab in scan.slabs()):
        raise _constant(scan, first)
    return scan


def open_labels(
    path: Path | str, spacing_mm: float | Sequence[float] | None = None, mirror: str | None = None
) -> tuple[NDArray[np.integer[Any]], Scan]:
    """Read a label volume of any format as a whole; for the rest see `open_scan`.

    ``spacing_mm`` is that of the scan, for a label file without one: its own wins.
    Returns labels [z, y, x] and their grid, with the names of the segments.

    Raises
    ------
    StapeskitError
        As `open_scan`; also values that are not whole numbers.
    """
    grid = _open(Path(path), spacing_mm, mirror, labels=True)
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
    step = "Check that it is the right volume, and export it again"
    return StapeskitError.of("the volume", wanted, got, scan.name, step)


def _open(
    path: Path,
    spacing_mm: float | Sequence[float] | None,
    mirror: str | None,
    raw: RawLayout | None = None,
    labels: bool = False,
) -> Scan:
    """Open a file or folder as a scan on a right-handed grid; spacing and mirror are the user's."""
    path = _existing(path)
    name = path.name
    entry = format_of(path) if raw is None or path.is_dir() else RAW
    stored, fetch = _voxels(entry, path, raw)
    if labels:  # numbers that name bodies are neither bright nor dark, and their own spacing wins
        stored.white_is_zero = False
        own = stored.spacing_mm is not None and np.all(np.isfinite(stored.spacing_mm))
        spacing_mm = None if own else spacing_mm
    elif stored.coloured:
        got, step = "numbers of colours whose brightness does not grow with them", "Export grey values"
        raise StapeskitError.of("the volume", "grey values", got, name, step)
    spacing = choose_spacing(stored, spacing_mm, name)
    if stored.white_is_zero:
        stored.note(
            f"{name} says that 0 is white (WhiteIsZero): bright and dark were exchanged, so that bone is "
            f"bright. Grey values count from the other end of their range (255 less the stored one, 65535 "
            f"less it; floats change sign). If bone was bright as stored, correct the tag in its program."
        )
    turned = {turn_right_handed(stored, spacing, name)} - {None}
    if mirror is not None:
        turned ^= {"xyz".index(mirror)}
    elif not stored.anatomical:
        stored.note(
            f"Nothing in {name} confirms that its slices are in right-handed order: if they are not, the "
            f"ear is a mirror image. Check a known asymmetry in the report; --mirror x, y or z undoes it.",
            "handedness_unconfirmed",
        )
    return Scan(
        shape=cast(tuple[int, int, int], stored.shape),
        dtype=np.dtype(np.float32) if stored.is_scaled else stored.dtype,
        spacing_mm=spacing,
        fetch=_grey_values(stored, fetch, tuple(2 - axis for axis in turned if axis is not None)),
        origin_mm=stored.origin_mm,
        direction=stored.direction,
        source=path,
        files=tuple(dict.fromkeys((path, *stored.files))),
        notices=tuple(stored.notices),
        segment_names=stored.names,
        handedness_confirmed=stored.anatomical,
        carries_place=entry.carries_place,
        chunk_planes=stored.depth,
    )


def _existing(path: Path) -> Path:
    """Return the path of a folder, or of a regular file with content."""
    wanted, got, step = "a file or folder that can be read", "", "Check its path and permissions"
    try:
        if not path.exists():
            wanted, got = "an existing file or folder", f"no {path}"
        elif path.is_dir():
            next(path.iterdir(), None)
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


def _described(entry: Format, path: Path, layout: RawLayout | None) -> Stored:
    stored = open_raw(path, layout) if entry is RAW else entry.open_file(path)
    find_voxels(stored, path)
    return stored


def _voxels(entry: Format, path: Path, layout: RawLayout | None) -> tuple[Stored, Fetch]:
    """Read the header in a child process, which stays where it decodes voxels."""

    def open_source() -> tuple[Stored, Answer]:
        stored = _plainly(entry, path, lambda: _described(entry, path, layout))
        decode = stored.voxels
        if not callable(decode):
            return stored, no_requests
        stored.voxels = None
        return stored, lambda box: _plainly(entry, path, lambda: decode(box))

    limit_s = max(_LEAST_LIMIT_S, processor_limit_s(path))
    half_of_all = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2 if can_fork() else 0
    memory = max(memory_limit(path), half_of_all)
    session = Session(open_source, path, f"the {entry.title} scan", limit_s, memory, entry.libraries)
    stored = session.opened
    if stored.voxels is None:
        return stored, session.ask
    session.close()
    planes = cast(Sequence[tuple[Path, int]], stored.voxels)
    return stored, plane_reader(planes, stored.shape, stored.dtype)


def _plainly(entry: Format, path: Path, work: Callable[[], Result]) -> Result:
    """Return what ``work`` returns; whatever a library raises on a damaged file becomes one sentence."""
    try:
        return work()
    except MemoryError:
        raise
    except StapeskitError as error:
        named = (replace(fault, where=fault.where or path.name) for fault in error.faults)
        raise StapeskitError(*named) from error
    except Exception as fault:
        got = "a damaged one, or of another kind"
        if path.is_file():
            with path.open("rb") as stream:
                got += f": it begins with {stream.read(12)!r}"
        raise wrong_file(f"{entry.title} file", got, path.name) from fault


def _grey_values(stored: Stored, fetch: Fetch, reverse: tuple[int, ...]) -> Fetch:
    """Return a reader that reverses axes z, y, x (0, 1, 2), rescales, and exchanges bright and dark."""
    if not (reverse or stored.is_scaled or stored.white_is_zero):
        return fetch

    def read(box: Box) -> NDArray[Any]:
        asked = list(box)
        for k in reverse:
            last, indices = stored.shape[k] - 1, range(stored.shape[k])[box[k]]
            if len(indices):
                asked[k] = slice(last - indices[-1], last - indices[0] + 1, indices.step)
        values = np.ascontiguousarray(np.flip(fetch((asked[0], asked[1], asked[2])), reverse))
        if stored.is_scaled:
            values = np.asarray(values * stored.slope + stored.intercept, dtype=np.float32)
        if stored.white_is_zero:
            values = -values if values.dtype.kind == "f" else np.invert(values)
        return values

    return read
