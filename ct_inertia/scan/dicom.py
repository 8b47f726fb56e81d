"""DICOM series and multi-frame files: headers by pydicom, packed pixels by SimpleITK.

A scan is a list of frames, each in a file; every frame is rescaled by its own slope and intercept.

The standard: https://dicom.nema.org/medical/dicom/current/output/html/part03.html
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.formats import DICOM_SUFFIXES, has_preamble
from ct_inertia.scan.header import Header, by_planes, several_values, wrong_header
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
        """Return a field, or the default where it is nowhere or empty."""
        for group in self.groups:
            for element in group:
                if element.VR == "SQ" and len(element.value) and name in element.value[0]:
                    return element.value[0].get(name)
        value = self.head.get(name)
        return default if value in (None, "") else value

    def numbers(self, name: str, count: int) -> Array:
        """Return a field of so many numbers; NaN where the header does not have them."""
        try:
            values = np.atleast_1d(np.array(self.get(name), dtype=float))
        except (TypeError, ValueError):
            return np.full(count, np.nan)
        return values if values.shape == (count,) else np.full(count, np.nan)

    def rescaling(self) -> tuple[float, float]:
        """Return slope and intercept from stored pixels to grey values."""
        return float(self.get("RescaleSlope", 1.0)), float(self.get("RescaleIntercept", 0.0))


def open_dicom(path: Path) -> Header:
    """Open the DICOM series of a folder, or a file of several frames.

    Raises
    ------
    StapeskitError
        Several series, a damaged file, slices of different sizes or at uneven distances, a single slice, no
        image, or colours.
    """
    heads, others = ({path: _head(path)}, 0) if not path.is_dir() else _only_series(path)
    frames = [frame for file, head in heads.items() for frame in _frames(file, head)]
    first = frames[0]
    if "Rows" not in first.head:
        kind = getattr(first.head.get("SOPClassUID"), "name", "another kind of DICOM file")
        step = "Give the folder of the slices"
        raise StapeskitError.of(
            "the DICOM file", "one of images", f"{kind}, without an image", path.name, step
        )
    if len(frames) < 2:
        step = "Give the folder of the whole series"
        raise StapeskitError.of("the DICOM file", "one of several frames", "a single slice", path.name, step)
    for frame in frames:
        _check_alike(frame, first)
    header = Header((len(frames), int(first.head.Rows), int(first.head.Columns)), np.dtype(np.uint8))
    if others:
        header.note(
            f"{others} single pictures of other series in {path.name}, such as scouts, were left out."
        )
    order = _placed(header, frames, path)
    if order is None:
        order = np.argsort([int(frame.head.get("InstanceNumber") or 0) for frame in frames], kind="stable")
        text = f"The slices in {path.name} have no positions: the order of their numbers was taken."
        header.notices.append(Notice("slice_positions_missing", text))
        header.known = "the slices have no positions"
    _add_pixels(header, [frames[k] for k in order], path)
    return header


def _only_series(folder: Path) -> tuple[dict[Path, Any], int]:
    """Return the headers of the only series of a folder, and the number of single pictures beside it."""
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
        got = f"{len(series)} series{': ' if titles else ''}{list_some(titles, 6)}"
        raise StapeskitError.of("the folder", "one DICOM series", got, folder.name, _APART)
    return {file: heads[file] for file in stacks[0]}, len(heads) - len(stacks[0])


def _head(file: Path) -> Any:
    import pydicom

    head = pydicom.dcmread(file, stop_before_pixels=True, force=not has_preamble(file))
    if len(head) == 0 or ("Rows" in head and not (int(head.Rows) > 0 and int(head.Columns) > 0)):
        raise wrong_header(file, "DICOM file", "one without fields or pixels")
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
        wanted = f"of the size, pixel spacing and orientation of {first.file.name}"
        got = f"{size[0]} x {size[1]} at {frame.numbers('PixelSpacing', 2)[1]:.6g} mm"
        raise StapeskitError.of(f"slice {frame.file.name}", wanted, got, frame.file.parent.name, _APART)


def _placed(header: Header, frames: Sequence[_Frame], path: Path) -> NDArray[np.intp] | None:
    """Set the place of frames with positions, and return their order; None where they have none.

    Raises
    ------
    StapeskitError
        Their distances are uneven, or they lie beside each other, as a tilted gantry makes them: their voxels
        are no boxes.
    """
    places = np.array([frame.numbers("ImagePositionPatient", 3) for frame in frames])
    axes = frames[0].numbers("ImageOrientationPatient", 6)
    direction = np.column_stack([axes[:3], axes[3:], np.cross(axes[:3], axes[3:])])
    heights = places @ direction[:, 2]
    if not np.all(np.isfinite(heights)) or not np.ptp(heights) > 0.0:
        return None
    order = np.argsort(heights, kind="stable")
    steps = np.diff(heights[order])
    middle = float(np.median(steps))
    worst = int(np.argmax(np.abs(steps - middle)))
    if not middle > 0.0 or abs(steps[worst] - middle) > _UNEVEN * middle:
        got = f"{steps[worst]:.6g} mm after slice {worst + 1}"
        step = "Slices are missing, or several stacks are mixed: export the series again"
        thing, wanted = "the distance of DICOM slices", f"even ({middle:.6g} mm)"
        raise StapeskitError.of(thing, wanted, got, path.name, step)
    y, x = frames[0].numbers("PixelSpacing", 2)
    aside = np.abs((places[order] - places[order[0]]) @ direction[:, :2])
    if np.any(aside > _ASIDE * np.array([x, y])):
        got = f"slices up to {aside.max():.3g} mm beside the first one (tilted gantry)"
        step = "Resample the series to a grid of right angles, and export that"
        raise StapeskitError.of("the slices", "one behind the other along their normal", got, path.name, step)
    header.spacing_mm = np.array([x, y, np.mean(steps)])
    header.origin_mm, header.direction, header.anatomical = places[order[0]], direction, True
    return order


def _add_pixels(header: Header, frames: Sequence[_Frame], path: Path) -> None:
    """Set how the pixels of frames are read and rescaled.

    Raises
    ------
    StapeskitError
        Colours, several types of pixels, or a rescaling that is none.
    """
    first = frames[0]
    shown = str(first.get("PhotometricInterpretation"))
    if int(first.get("SamplesPerPixel", 1)) > 1 or shown == "PALETTE COLOR":
        raise several_values(first.file, "a colour image")
    kinds = {(int(one.get("BitsAllocated", 0)), int(one.get("PixelRepresentation", 0))) for one in frames}
    ((bits, signed), *more) = kinds
    if more or bits not in (8, 16, 32):
        got, step = f"pixels of {bits} bits, {len(kinds)} types", "Export grey values of one type"
        raise StapeskitError.of("the DICOM pixels", "of 8, 16 or 32 bits, all alike", got, path.name, step)
    rescaling = {frame.file: frame.rescaling() for frame in frames}
    if not np.all(np.isfinite([*rescaling.values()])) or any(
        frame.rescaling() != rescaling[frame.file] for frame in frames
    ):
        got, step = "others in one file, or no numbers", "Export the series as single slices"
        raise StapeskitError.of("the rescaling", "one slope and offset a file", got, path.name, step)
    scaled = set(rescaling.values()) != {(1.0, 0.0)}
    header.dtype = np.dtype(np.float32 if scaled else f"{'i' if signed else 'u'}{bits // 8}")
    header.white_is_zero = shown == "MONOCHROME1"
    held: dict[Path, NDArray[Any]] = {}

    def decode(frame: _Frame) -> NDArray[Any]:
        if frame.file not in held:
            held.clear()  # the frames of the file that was read last
            held[frame.file] = _pixels(frame, header)
        return held[frame.file][frame.number]

    header.read = by_planes(frames, decode)


def _pixels(frame: _Frame, header: Header) -> NDArray[Any]:
    """Return the pixels [frame, y, x] of the file of a frame, rescaled by the slope and offset of the file.

    Notes
    -----
    SimpleITK reads no classes that the standard does not have; scanners write some of their own, which
    pydicom reads where the pixels are not packed. Where 0 is white SimpleITK exchanges bright and dark itself
    (8 and 16 bit) or returns numbers that are none (32 bit): these are read by pydicom as they are stored.
    """
    import pydicom
    import SimpleITK as sitk

    file = frame.file
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    values: NDArray[Any] | None = None
    try:
        if not header.white_is_zero:
            with suppress(RuntimeError):
                values = sitk.GetArrayFromImage(sitk.ReadImage(str(file)))
        if values is None:
            values = pydicom.dcmread(file, force=True).pixel_array
            if header.dtype.kind == "f":
                slope, intercept = frame.rescaling()
                values = values * np.float32(slope) + np.float32(intercept)
        return values.reshape(-1, *header.shape[1:]).astype(header.dtype, casting="same_kind", copy=False)
    except (RuntimeError, ValueError, TypeError, AttributeError) as fault:
        raise wrong_header(file, "DICOM file", "one whose pixels cannot be read") from fault
