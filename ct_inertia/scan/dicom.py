"""DICOM series and multi-frame files: headers by pydicom, packed pixels by SimpleITK.

A scan is a list of frames, each in a file; every frame is rescaled by its own slope and intercept.

The standard: https://dicom.nema.org/medical/dicom/current/output/html/part03.html
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.formats import DICOM_SUFFIXES, has_preamble
from ct_inertia.scan.opened import Opened, ReadOptions, several_values, wrong_header
from ct_inertia.scan.streams import by_planes
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError, list_some
from stapeskit.warnings import Notice

_UNEVEN = 0.02  # share of the usual distance by which another one may differ: a missing slice doubles it
_ASIDE = 0.1  # share of a pixel by which slices may lie beside their common normal: rounding of positions
_ALIKE = {"PixelSpacing": (2, 1e-6), "ImageOrientationPatient": (6, 1e-4)}
"""Fields that all slices share: how many numbers, and their rounding."""
_APART = "Put the slices of one scan into a folder of their own"


@dataclass(frozen=True)
class _Frame:
    """One picture.

    Attributes
    ----------
    file : Path
    number : int
        In the file.
    head : Dataset
        Of the file.
    groups : tuple of Dataset
        Fields of the frame alone, then those that the frames of the file share (PS3.3, C.7.6.16).
    """

    file: Path
    number: int
    head: Any
    groups: tuple[Any, ...] = ()

    def get(self, name: str, default: Any = None) -> Any:
        """Return a field, or the default where it is nowhere."""
        for group in self.groups:
            for element in group:
                if element.VR == "SQ" and len(element.value) and name in element.value[0]:
                    return element.value[0].get(name)
        return self.head.get(name, default)

    def numbers(self, name: str, count: int) -> Array:
        """Return a field of so many numbers; NaN where the header does not have them."""
        try:
            values = np.atleast_1d(np.array(self.get(name), dtype=float))
        except (TypeError, ValueError):
            return np.full(count, np.nan)
        return values if values.shape == (count,) else np.full(count, np.nan)

    def rescaling(self) -> tuple[float, float]:
        """Return slope and intercept from stored pixels to grey values."""
        pair = []
        for name, default in (("RescaleSlope", 1.0), ("RescaleIntercept", 0.0)):
            value = self.get(name)
            pair.append(default if value in (None, "") else float(value))
        return pair[0], pair[1]


def open_file(path: Path, options: ReadOptions) -> Opened:
    """Open the DICOM series of a folder, or a file of several frames.

    Raises
    ------
    StapeskitError
        Several series, a damaged file, slices of different sizes or at uneven distances, a single slice, or
        colours.
    """
    heads, notices = ({path: _head(path)}, []) if not path.is_dir() else _one_series(path)
    frames = [frame for file, head in heads.items() for frame in _frames(file, head)]
    if len(frames) < 2:
        step = "Give the folder of the whole series"
        raise StapeskitError.of("the DICOM file", "one of several frames", "a single slice", path.name, step)
    first = frames[0]
    for frame in frames:
        _check_alike(frame, first)
    shape = (len(frames), int(first.head.Rows), int(first.head.Columns))
    opened = Opened(shape, np.dtype(np.uint8), notices=notices)
    order = _placed(opened, frames, path)
    if order is None:
        opened.known = f"the {'slices' if len(heads) > 1 else 'frames'} have no positions"
        order = np.argsort([int(frame.head.get("InstanceNumber") or 0) for frame in frames], kind="stable")
        if len(heads) == 1:
            _place_plain_frames(opened, first)
        elif options.spacing_mm is not None:
            text = f"The slices in {path.name} have no positions: the order of their numbers was taken."
            opened.notices.append(Notice("slice_positions_missing", text))
    return _with_pixels(opened, [frames[k] for k in order], path)


def _one_series(folder: Path) -> tuple[dict[Path, Any], list[Notice]]:
    """Return the headers of the only series of a folder; single pictures beside it are left out."""
    heads, series = {}, defaultdict(list)
    for file in sorted(file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")):
        if has_preamble(file) or file.suffix.lower() in DICOM_SUFFIXES:
            head = _head(file)
            if "Rows" in head:  # others are directories of a disk, reports, presentation states
                heads[file] = head
                series[str(head.get("SeriesInstanceUID", ""))].append(file)
    stacks = [files for files in series.values() if len(files) > 1] if len(series) > 1 else [*series.values()]
    if len(stacks) != 1:
        titles = [f"{_title(heads[files[0]])} ({len(files)} files)" for files in series.values()]
        listed = list_some(titles, 6)
        got = f"{len(series)} series{': ' if listed else ''}{listed}"
        raise StapeskitError.of("the folder", "one DICOM series", got, folder.name, _APART)
    others = len(heads) - len(stacks[0])
    text = f"{others} single pictures of other series in {folder.name}, such as scouts, were left out."
    return {file: heads[file] for file in stacks[0]}, [Notice("file_read", text)] if others else []


def _head(file: Path) -> Any:
    import pydicom

    try:
        head = pydicom.dcmread(file, stop_before_pixels=True, force=not has_preamble(file))
        if "Rows" in head and not (int(head.Rows) > 0 and int(head.Columns) > 0):
            raise ValueError("no pixels")
        head.get("SeriesInstanceUID")
    except Exception as fault:
        raise wrong_header(file, "DICOM file", "one that pydicom cannot read") from fault
    return head


def _title(head: Any) -> str:
    return str(head.get("SeriesDescription") or f"series {head.get('SeriesNumber', '')}").strip()


def _frames(file: Path, head: Any) -> list[_Frame]:
    own = head.get("PerFrameFunctionalGroupsSequence") or []
    shared = list(head.get("SharedFunctionalGroupsSequence") or [])[:1]
    count = int(head.get("NumberOfFrames") or 1)
    if count > file.stat().st_size:
        raise wrong_header(file, "DICOM file", f"one of {count} frames")
    return [_Frame(file, k, head, (*own[k : k + 1], *shared)) for k in range(count)]


def _check_alike(frame: _Frame, first: _Frame) -> None:
    size, expected = ((int(head.Columns), int(head.Rows)) for head in (frame.head, first.head))
    same = size == expected
    for name, (count, rounding) in _ALIKE.items():
        one, two = frame.numbers(name, count), first.numbers(name, count)
        same = same and np.allclose(one, two, rtol=0.0, atol=rounding, equal_nan=True)
    if not same:
        raise StapeskitError.of(
            f"slice {frame.file.name}",
            f"of the size, pixel spacing and orientation of {first.file.name}",
            f"{size[0]} x {size[1]} at {frame.numbers('PixelSpacing', 2)[1]:.6g} mm",
            frame.file.parent.name,
            _APART,
        )


def _placed(opened: Opened, frames: Sequence[_Frame], path: Path) -> NDArray[np.intp] | None:
    """Set the place of frames with positions, and return their order; None where they have none."""
    places = np.array([frame.numbers("ImagePositionPatient", 3) for frame in frames])
    axes = frames[0].numbers("ImageOrientationPatient", 6)
    direction = np.column_stack([axes[:3], axes[3:], np.cross(axes[:3], axes[3:])])
    heights = places @ direction[:, 2]
    if not np.all(np.isfinite(heights)) or not np.ptp(heights) > 0.0:
        return None
    order = np.argsort(heights, kind="stable")
    y, x = frames[0].numbers("PixelSpacing", 2)
    opened.spacing_mm = np.array([x, y, _even_step(heights[order], path)])
    opened.origin_mm, opened.direction, opened.anatomical = places[order[0]], direction, True
    _check_square(places[order] @ direction[:, :2], opened.spacing_mm[:2], path)
    return order


def _place_plain_frames(opened: Opened, first: _Frame) -> None:
    """Place frames without positions of their own by the position of the first and the distance of frames."""
    y, x = first.numbers("PixelSpacing", 2)
    step = float(first.numbers("SpacingBetweenSlices", 1)[0])
    offsets = first.numbers("GridFrameOffsetVector", opened.shape[0])
    if np.all(np.isfinite(offsets)):
        step = float(np.mean(np.diff(offsets)))
    opened.spacing_mm = np.array([x, y, abs(step)])
    axes, place = first.numbers("ImageOrientationPatient", 6), first.numbers("ImagePositionPatient", 3)
    if np.all(np.isfinite(axes)) and np.all(np.isfinite(place)):
        normal = np.cross(axes[:3], axes[3:]) * (-1.0 if step < 0.0 else 1.0)
        opened.direction, opened.origin_mm = np.column_stack([axes[:3], axes[3:], normal]), place
        opened.anatomical = bool(np.isfinite(step))


def _even_step(heights: Array, path: Path) -> float:
    steps = np.diff(heights)
    middle = float(np.median(steps))
    worst = int(np.argmax(np.abs(steps - middle)))
    if not middle > 0.0 or abs(steps[worst] - middle) > _UNEVEN * middle:
        got = f"{steps[worst]:.6g} mm after slice {worst + 1}"
        step = "Slices are missing, or several stacks are mixed: export the series again"
        thing, wanted = "the distance of DICOM slices", f"even ({middle:.6g} mm)"
        raise StapeskitError.of(thing, wanted, got, path.name, step)
    return float(np.mean(steps))


def _check_square(aside: Array, spacing: Array, path: Path) -> None:
    """Refuse slices that lie beside each other, as a tilted gantry makes them: their voxels are no boxes."""
    shift = aside - aside[0]
    worst = int(np.argmax(np.max(np.abs(shift), axis=1)))
    if np.any(np.abs(shift[worst]) > _ASIDE * spacing):
        got = f"slice {worst + 1} {np.linalg.norm(shift[worst]):.3g} mm beside the first one (tilted gantry)"
        step = "Resample the series to a grid of right angles, and export that"
        raise StapeskitError.of("the slices", "one behind the other along their normal", got, path.name, step)


def _with_pixels(opened: Opened, frames: Sequence[_Frame], path: Path) -> Opened:
    """Set how the pixels of frames are read and rescaled.

    Raises
    ------
    StapeskitError
        Colours, several types of pixels, or a rescaling that is none.
    """
    first = frames[0]
    shown = str(first.get("PhotometricInterpretation"))
    if int(first.get("SamplesPerPixel") or 1) > 1 or shown == "PALETTE COLOR":
        raise several_values(first.file, "a colour image")
    kinds = {_stored_type(frame.head) for frame in frames}
    if len(kinds) != 1 or None in kinds:
        bits = sorted({str(frame.head.get("BitsAllocated")) for frame in frames})
        got, step = f"pixels of {', '.join(bits)} bits", "Export grey values of one type"
        raise StapeskitError.of("the DICOM pixels", "of 8, 16 or 32 bits, all alike", got, path.name, step)
    opened.dtype = np.dtype(kinds.pop())
    opened.white_is_zero = shown == "MONOCHROME1"
    opened.slope, opened.intercept = np.transpose([frame.rescaling() for frame in frames])
    if not np.all(np.isfinite(opened.slope * opened.intercept)) or np.any(opened.slope == 0.0):
        got, step = "a slope of 0 or no number", "Export the series again"
        raise StapeskitError.of("the rescaling", "finite numbers", got, path.name, step)
    held: dict[Path, NDArray[Any]] = {}
    opened.read = by_planes(frames, lambda frame: _stored(frame, opened.dtype, held))
    return opened


def _stored_type(head: Any) -> str | None:
    letter = "i" if int(head.get("PixelRepresentation") or 0) else "u"
    return {8: f"{letter}1", 16: f"{letter}2", 32: f"{letter}4"}.get(int(head.get("BitsAllocated") or 0))


def _stored(frame: _Frame, dtype: np.dtype[Any], held: dict[Path, NDArray[Any]]) -> NDArray[Any]:
    """Return the stored pixels of a frame: by pydicom as they lie, packed ones by SimpleITK.

    ``held`` keeps the frames of the packed file that was read last.
    """
    file, head = frame.file, frame.head
    try:
        syntax = head.file_meta.get("TransferSyntaxUID")
        if syntax is None or not syntax.is_compressed:
            from pydicom.pixels.utils import pixel_array

            several = int(head.get("NumberOfFrames") or 1) > 1
            values = pixel_array(file, index=frame.number if several else None, raw=True)
            values = _unmasked(values.astype(dtype, copy=False), head)
        else:
            if file not in held:
                held.clear()
                held[file] = _unpacked(frame, dtype)
            values = held[file][frame.number]
        if values.shape != (int(head.Rows), int(head.Columns)):
            raise ValueError(f"pixels of shape {values.shape}")
    except StapeskitError:
        raise
    except Exception as fault:
        raise wrong_header(file, "DICOM file", "one whose pixels cannot be read") from fault
    return values


def _unmasked(values: NDArray[Any], head: Any) -> NDArray[Any]:
    """Return pixels of fewer bits than they are stored in, without the other bits (PS3.5, 8.1.1)."""
    allocated, stored = int(head.BitsAllocated), int(head.get("BitsStored") or head.BitsAllocated)
    above = allocated - 1 - int(head.get("HighBit", stored - 1))
    if stored == allocated or not 0 <= above <= allocated - stored:
        return values
    return np.right_shift(np.left_shift(values, above), allocated - stored)


def _unpacked(frame: _Frame, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the stored pixels [frame, y, x] of a packed file.

    Notes
    -----
    SimpleITK applies the rescaling of the file, or that of the first frame; it is undone here, so that every
    frame is rescaled by its own.
    """
    import SimpleITK as sitk

    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    values = sitk.GetArrayFromImage(sitk.ReadImage(str(frame.file)))
    values = values.reshape(-1, *values.shape[-2:])
    slope, intercept = _frames(frame.file, frame.head)[0].rescaling()
    if (slope, intercept) == (1.0, 0.0):
        return values.astype(dtype, copy=False)
    stored = np.rint((values - intercept) / slope)
    limits = np.iinfo(dtype)
    if stored.min() < limits.min or stored.max() > limits.max:
        raise StapeskitError.of(
            "the rescaled grey values",
            "those of the stored pixels",
            "others, which SimpleITK gives for this packing",
            frame.file.name,
            "Export the series unpacked, or convert it to NRRD",
        )
    return stored.astype(dtype)
