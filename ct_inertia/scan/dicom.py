"""DICOM series and multi-frame files: headers by pydicom, packed pixels by SimpleITK.

Every slice is rescaled by its own slope and intercept.

The standard: https://dicom.nema.org/medical/dicom/current/output/html/part03.html
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.formats import DICOM_SUFFIXES, has_preamble
from ct_inertia.scan.opened import Opened, ReadOptions, several_values, wrong_header
from ct_inertia.scan.scan import Box
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError, list_some
from stapeskit.warnings import Notice

_UNEVEN = 0.02  # share of the usual distance by which another one may differ: a missing slice doubles it
_ASIDE = 0.1  # share of a pixel by which slices may lie beside their common normal: rounding of positions
_APART = "Put the slices of one scan into a folder of their own"


def open_file(path: Path, options: ReadOptions) -> Opened:
    """Open the DICOM series of a folder, or a file of several frames.

    Raises
    ------
    StapeskitError
        Several series, a damaged file, slices of different sizes or at uneven distances, a single slice, or
        colours.
    """
    if not path.is_dir():
        head = _head(path)
        if "Rows" not in head:
            raise wrong_header(path, "DICOM file", "one without pixels")
        return _frames(path, head)
    heads = {}
    for file in sorted(file for file in path.iterdir() if file.is_file() and not file.name.startswith(".")):
        if has_preamble(file) or file.suffix.lower() in DICOM_SUFFIXES:
            head = _head(file)
            if "Rows" in head:  # others are directories of a disk, reports, presentation states
                heads[file] = head
    series = defaultdict(list)
    for file, head in heads.items():
        series[str(head.get("SeriesInstanceUID", ""))].append(file)
    stacks = [files for files in series.values() if len(files) > 1]
    if len(series) == 1 and not stacks:
        ((file, head),) = heads.items()
        return _frames(file, head)
    if len(stacks) != 1:
        titles = [f"{_title(heads[files[0]])} ({len(files)} files)" for files in series.values()]
        listed = list_some(titles, 6)
        got = f"{len(series)} series{': ' if listed else ''}{listed}"
        raise StapeskitError.of("the folder", "one DICOM series", got, path.name, _APART)
    opened = _series(path, {file: heads[file] for file in stacks[0]}, options)
    if len(heads) > len(stacks[0]):
        count = len(heads) - len(stacks[0])
        text = f"{count} single pictures of other series in {path.name}, such as scouts, were left out."
        opened.notices.append(Notice("files_ignored", text))
    return opened


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


def _series(folder: Path, heads: dict[Path, Any], options: ReadOptions) -> Opened:
    """Return the slices of a series in the order of their positions along their normal."""
    files = list(heads)
    first = heads[files[0]]
    for file in files:
        _check_alike(file, heads[file], files[0], first)
    opened = Opened((len(files), int(first.Rows), int(first.Columns)), np.dtype(np.uint8), files=(folder,))
    order = _placed(opened, list(heads.values()), folder)
    if order is None:
        opened.known = "the slices have no positions"
        order = np.argsort([int(head.get("InstanceNumber") or 0) for head in heads.values()], kind="stable")
        if options.spacing_mm is not None:
            text = f"The slices in {folder.name} have no positions: the order of their numbers was taken."
            opened.notices.append(Notice("slice_positions_missing", text))
    return _with_pixels(opened, [(files[k], 0) for k in order], [heads[files[k]] for k in order])


def _frames(path: Path, head: Any) -> Opened:
    """Return the frames of a file in the order of their positions."""
    count = int(head.get("NumberOfFrames") or 1)
    if count < 2:
        step = "Give the folder of the whole series"
        raise StapeskitError.of("the DICOM file", "one of several frames", "a single slice", path.name, step)
    frames = [_frame_head(head, k) for k in range(count)]
    opened = Opened((count, int(head.Rows), int(head.Columns)), np.dtype(np.uint8), files=(path,))
    order = _placed(opened, frames, path)
    if order is None:
        _place_plain_frames(opened, head)
        order = np.arange(count)
    return _with_pixels(opened, [(path, int(k)) for k in order], [frames[k] for k in order])


def _placed(opened: Opened, heads: Sequence[Any], path: Path) -> NDArray[np.intp] | None:
    """Set the place of slices with positions, and return their order; None where they have none."""
    places = np.array([_numbers(head, "ImagePositionPatient", 3) for head in heads])
    axes = _numbers(heads[0], "ImageOrientationPatient", 6)
    direction = np.column_stack([axes[:3], axes[3:], np.cross(axes[:3], axes[3:])])
    heights = places @ direction[:, 2]
    if not np.all(np.isfinite(heights)) or not np.ptp(heights) > 0.0:
        return None
    order = np.argsort(heights, kind="stable")
    y, x = _numbers(heads[0], "PixelSpacing", 2)
    opened.spacing_mm = np.array([x, y, _even_step(heights[order], path)])
    opened.origin_mm, opened.direction, opened.anatomical = places[order[0]], direction, True
    _check_square(places[order] @ direction[:, :2], opened.spacing_mm[:2], path)
    return order


class _FrameHead:
    """The fields of one frame: its own groups, the shared ones, then the file's (PS3.3, C.7.6.16)."""

    def __init__(self, head: Any, groups: Sequence[Any]) -> None:
        self._head, self._groups = head, groups

    def get(self, name: str, default: Any = None) -> Any:
        """Return a field, or the default where no group has it."""
        for group in self._groups:
            for element in group:
                if element.VR == "SQ" and len(element.value) and name in element.value[0]:
                    return element.value[0].get(name)
        return self._head.get(name, default)


def _frame_head(head: Any, number: int) -> _FrameHead:
    own = head.get("PerFrameFunctionalGroupsSequence") or []
    shared = head.get("SharedFunctionalGroupsSequence") or []
    groups = [own[number]] if number < len(own) else []
    return _FrameHead(head, [*groups, *shared[:1]])


def _place_plain_frames(opened: Opened, head: Any) -> None:
    """Place frames without positions of their own by the position of the first and the distance of frames."""
    y, x = _numbers(head, "PixelSpacing", 2)
    step = float(_numbers(head, "SpacingBetweenSlices", 1)[0])
    offsets = _numbers(head, "GridFrameOffsetVector", opened.shape[0])
    if np.all(np.isfinite(offsets)):
        step = float(np.mean(np.diff(offsets)))
    opened.spacing_mm, opened.known = np.array([x, y, abs(step)]), "the frames have no positions"
    axes, place = _numbers(head, "ImageOrientationPatient", 6), _numbers(head, "ImagePositionPatient", 3)
    if np.all(np.isfinite(axes)) and np.all(np.isfinite(place)):
        normal = np.cross(axes[:3], axes[3:]) * (-1.0 if step < 0.0 else 1.0)
        opened.direction, opened.origin_mm = np.column_stack([axes[:3], axes[3:], normal]), place
        opened.anatomical = bool(np.isfinite(step))


def _numbers(head: Any, name: str, count: int) -> Array:
    """Return a field of so many numbers; NaN where the header does not have them."""
    try:
        values = np.atleast_1d(np.array(head.get(name), dtype=float))
    except (TypeError, ValueError):
        return np.full(count, np.nan)
    return values if values.shape == (count,) else np.full(count, np.nan)


def _check_alike(file: Path, head: Any, other: Path, first: Any) -> None:
    same = (int(head.Rows), int(head.Columns)) == (int(first.Rows), int(first.Columns))
    for name, count, rounding in (("PixelSpacing", 2, 1e-6), ("ImageOrientationPatient", 6, 1e-4)):
        one, two = _numbers(head, name, count), _numbers(first, name, count)
        same = same and np.allclose(one, two, rtol=0.0, atol=rounding, equal_nan=True)
    if not same:
        spacing = _numbers(head, "PixelSpacing", 2)
        raise StapeskitError.of(
            f"slice {file.name}",
            f"of the size, pixel spacing and orientation of {other.name}",
            f"{int(head.Columns)} x {int(head.Rows)} at {spacing[1]:.6g} mm",
            file.parent.name,
            _APART,
        )


def _even_step(heights: Array, path: Path) -> float:
    steps = np.diff(heights)
    middle = float(np.median(steps))
    worst = int(np.argmax(np.abs(steps - middle)))
    if not middle > 0.0 or abs(steps[worst] - middle) > _UNEVEN * middle:
        step = "Slices are missing, or several stacks are mixed: export the series again"
        got = f"{steps[worst]:.6g} mm after slice {worst + 1}"
        raise StapeskitError.of(
            "the distance of DICOM slices", f"even ({middle:.6g} mm)", got, path.name, step
        )
    return float(np.mean(steps))


def _check_square(aside: Array, spacing: Array, path: Path) -> None:
    """Refuse slices that lie beside each other, as a tilted gantry makes them: their voxels are no boxes."""
    shift = aside - aside[0]
    worst = int(np.argmax(np.max(np.abs(shift), axis=1)))
    if np.any(np.abs(shift[worst]) > _ASIDE * spacing):
        got = f"slice {worst + 1} {np.linalg.norm(shift[worst]):.3g} mm beside the first one (tilted gantry)"
        step = "Resample the series to a grid of right angles, and export that"
        raise StapeskitError.of("the slices", "one behind the other along their normal", got, path.name, step)


def _with_pixels(opened: Opened, places: Sequence[tuple[Path, int]], heads: Sequence[Any]) -> Opened:
    """Set how the pixels of slices (file, frame) are read and rescaled.

    Raises
    ------
    StapeskitError
        Colours, several types of pixels, or packed frames whose rescaling differs.
    """
    first = heads[0]
    if (
        int(first.get("SamplesPerPixel") or 1) > 1
        or str(first.get("PhotometricInterpretation")) == "PALETTE COLOR"
    ):
        raise several_values(places[0][0], "a colour image")
    kinds = {_stored_type(head) for head in heads}
    if len(kinds) != 1:
        got = ", ".join(sorted(str(kind) for kind in kinds))
        raise StapeskitError.of(
            "the slices", "of one type of pixels", got, opened.files[0].name, "Export them again"
        )
    (opened.dtype,) = kinds
    opened.white_is_zero = str(first.get("PhotometricInterpretation")) == "MONOCHROME1"
    opened.slope = np.array([_rescaling(head, "RescaleSlope", 1.0) for head in heads])
    opened.intercept = np.array([_rescaling(head, "RescaleIntercept", 0.0) for head in heads])
    if (
        np.any(~np.isfinite(opened.slope))
        or np.any(opened.slope == 0.0)
        or np.any(~np.isfinite(opened.intercept))
    ):
        got = "a slope of 0 or no number"
        raise StapeskitError.of(
            "the rescaling", "finite numbers", got, opened.files[0].name, "Export the series again"
        )
    rows = opened.shape[1:]
    held: dict[Path, NDArray[Any]] = {}

    def read(box: Box) -> NDArray[Any]:
        planes = [_stored(file, frame, opened.dtype, held) for file, frame in places[box[0]]]
        for (file, _), plane in zip(places[box[0]], planes, strict=True):
            if plane.shape != rows:
                raise wrong_header(file, "DICOM file", f"pixels of shape {plane.shape}")
        return np.stack([plane[box[1:]] for plane in planes])

    opened.read = read
    return opened


def _rescaling(head: Any, name: str, default: float) -> float:
    value = head.get(name)
    try:
        return default if value is None or value == "" else float(value)
    except (TypeError, ValueError):
        return float("nan")


def _stored_type(head: Any) -> np.dtype[Any]:
    bits = int(head.get("BitsAllocated") or 0)
    if bits not in (8, 16, 32):
        raise StapeskitError.of(
            "the DICOM pixels", "of 8, 16 or 32 bits", f"{bits} bits", next_step="Export grey values"
        )
    return np.dtype(f"{'i' if int(head.get('PixelRepresentation') or 0) else 'u'}{bits // 8}")


def _stored(file: Path, frame: int, dtype: np.dtype[Any], held: dict[Path, NDArray[Any]]) -> NDArray[Any]:
    """Return the stored pixels of one frame: by pydicom as they lie, packed ones by SimpleITK."""
    import pydicom
    from pydicom.pixels.utils import pixel_array

    if file not in held:
        try:
            with pydicom.dcmread(file, stop_before_pixels=True, force=True) as head:
                packed = (
                    head.file_meta.TransferSyntaxUID.is_compressed
                    if "TransferSyntaxUID" in head.file_meta
                    else False
                )
            if not packed:
                frames = int(head.get("NumberOfFrames") or 1)
                values = pixel_array(file, index=frame if frames > 1 else None, raw=True)
                return _unmasked(values.astype(dtype, copy=False), head)
        except Exception as fault:
            raise wrong_header(file, "DICOM file", "one whose pixels pydicom cannot read") from fault
        held.clear()
        held[file] = _unpacked(file, head, dtype)
    values = held[file]
    return values[frame]


def _unmasked(values: NDArray[Any], head: Any) -> NDArray[Any]:
    """Return pixels of fewer bits than they are stored in, without the other bits (PS3.5, 8.1.1)."""
    allocated, stored = int(head.BitsAllocated), int(head.get("BitsStored") or head.BitsAllocated)
    above = allocated - 1 - int(head.get("HighBit", stored - 1))
    if stored == allocated or not 0 <= above <= allocated - stored:
        return values
    return np.right_shift(np.left_shift(values, above), allocated - stored)


def _unpacked(file: Path, head: Any, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the stored pixels [frame, y, x] of a packed file.

    Notes
    -----
    SimpleITK applies the rescaling of the file, or that of the first frame; it is undone here, so that every
    frame is rescaled by its own.
    """
    import SimpleITK as sitk

    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        values = sitk.GetArrayFromImage(sitk.ReadImage(str(file)))
    except RuntimeError as fault:
        raise wrong_header(file, "DICOM file", "one whose packed pixels SimpleITK cannot read") from fault
    values = values.reshape(-1, *values.shape[-2:])
    slope = _rescaling(_frame_head(head, 0), "RescaleSlope", 1.0)
    intercept = _rescaling(_frame_head(head, 0), "RescaleIntercept", 0.0)
    if (slope, intercept) == (1.0, 0.0):
        return values.astype(dtype, copy=False)
    stored = np.rint((values - intercept) / slope)
    limits = np.iinfo(dtype)
    if stored.min() < limits.min or stored.max() > limits.max:
        raise StapeskitError.of(
            "the rescaled grey values",
            "those of the stored pixels",
            "others, which SimpleITK gives for this packing",
            file.name,
            "Export the series unpacked, or convert it to NRRD",
        )
    return stored.astype(dtype)
