"""DICOM series: headers by pydicom, packed pixels by SimpleITK; every slice is rescaled by its own header.

The standard: https://dicom.nema.org/medical/dicom/current/output/html/part03.html
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.formats import DICOM_SUFFIXES, has_preamble
from ct_inertia.scan.stored import Stored, by_planes, several_values, wrong_file
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError, list_some

_UNEVEN = 0.02  # share of the usual distance by which another one may differ: a missing slice doubles it
_ASIDE = 0.1  # share of a pixel by which slices may lie beside their common normal: rounding of positions
_ALIKE = {
    "Columns": (1, 0.0),
    "Rows": (1, 0.0),
    "PixelSpacing": (2, 1e-6),
    "ImageOrientationPatient": (6, 1e-4),
    "BitsAllocated": (1, 0.0),
    "PixelRepresentation": (1, 0.0),
}
"""Fields that all slices share: how many numbers, and their rounding."""
_APART = "Put the slices of one scan into a folder of their own"


@dataclass(frozen=True)
class _Slice:
    """A file of one picture, and its header."""

    file: Path
    head: Any

    def get(self, name: str, default: Any = None) -> Any:
        """Return a field, or the default where it is not there or empty."""
        value = self.head.get(name)
        return default if value in (None, "") else value

    def numbers(self, name: str, count: int) -> Array:
        """Return a field of so many numbers; NaN where the header does not have them."""
        try:
            values = np.atleast_1d(np.array(self.get(name), dtype=float))
        except (TypeError, ValueError):
            return np.full(count, np.nan)
        return values if values.shape == (count,) else np.full(count, np.nan)


def open_dicom(path: Path) -> Stored:
    """Open the DICOM series of a folder.

    Raises
    ------
    StapeskitError
        A file alone, several series, or slices that make no even stack of grey values.
    """
    if not path.is_dir():
        raise _not_a_series(_slice(path))
    slices, others = _only_series(path)
    if len(slices) < 2:
        raise _not_a_series(slices[0])
    _check_alike(slices)
    first = slices[0].head
    stored = Stored((len(slices), int(first.Rows), int(first.Columns)), _dtype(slices))
    stored.white_is_zero = slices[0].get("PhotometricInterpretation") == "MONOCHROME1"
    if others:
        stored.note(
            f"{others} single pictures of other series in {path.name}, such as scouts, were left out."
        )
    stored.voxels = by_planes(_placed(stored, slices), lambda one: _pixels(one, stored))
    return stored


def _not_a_series(one: _Slice) -> StapeskitError:
    """Return the error for a file that is no part of a series of slices."""
    got = "a single slice"
    if "Rows" not in one.head:
        got = f"{getattr(one.get('SOPClassUID'), 'name', 'another kind of DICOM file')}, without an image"
    elif int(one.get("NumberOfFrames", 1)) > 1:
        got = f"{one.get('NumberOfFrames')} frames in one file"
    step = "Give the folder of the whole series, with a file for each slice"
    return StapeskitError.of("the DICOM file", "one slice of a series in a folder", got, one.file.name, step)


def _only_series(folder: Path) -> tuple[list[_Slice], int]:
    """Return the slices of the only series of a folder, and the number of single pictures beside it."""
    series = defaultdict(list)
    for file in sorted(file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")):
        if has_preamble(file) or file.suffix.lower() in DICOM_SUFFIXES:
            one = _slice(file)
            if "Rows" in one.head:  # others are directories of a disk, reports, presentation states
                series[str(one.get("SeriesInstanceUID", ""))].append(one)
                if int(one.get("NumberOfFrames", 1)) > 1:
                    raise _not_a_series(one)
    stacks = [one for one in series.values() if len(one) > 1] if len(series) > 1 else [*series.values()]
    if len(stacks) != 1:
        titles = [f"{_title(one[0])} ({len(one)} files)" for one in series.values()]
        got = f"{len(series)} series{': ' if titles else ''}{list_some(titles, 6)}"
        raise StapeskitError.of("the folder", "one DICOM series", got, next_step=_APART)
    return stacks[0], sum(len(one) for one in series.values()) - len(stacks[0])


def _title(one: _Slice) -> str:
    return str(one.get("SeriesDescription") or f"series {one.get('SeriesNumber', '')}").strip()


def _slice(file: Path) -> _Slice:
    import pydicom

    head = pydicom.dcmread(file, stop_before_pixels=True, force=not has_preamble(file))
    if len(head) == 0 or ("Rows" in head and not (int(head.Rows) > 0 and int(head.Columns) > 0)):
        raise wrong_file("DICOM file", "one without fields or pixels", file.name)
    return _Slice(file, head)


def _check_alike(slices: Sequence[_Slice]) -> None:
    for name, (count, rounding) in _ALIKE.items():
        values = np.array([one.numbers(name, count) for one in slices])
        same = np.all(np.isclose(values, values[0], rtol=0.0, atol=rounding, equal_nan=True), axis=1)
        if not np.all(same):
            wanted, got = (", ".join(f"{v:.6g}" for v in values[k]) for k in (0, int(np.argmin(same))))
            wanted = f"of the {name} of {slices[0].file.name} ({wanted})"
            thing = f"slice {slices[int(np.argmin(same))].file.name}"
            raise StapeskitError.of(thing, wanted, got, next_step=_APART)


def _placed(stored: Stored, slices: Sequence[_Slice]) -> list[_Slice]:
    """Set the place of slices, and return them in the order of their positions."""
    places = np.array([one.numbers("ImagePositionPatient", 3) for one in slices])
    axes = slices[0].numbers("ImageOrientationPatient", 6)
    direction = np.column_stack([axes[:3], axes[3:], np.cross(axes[:3], axes[3:])])
    heights = places @ direction[:, 2]
    y, x = slices[0].numbers("PixelSpacing", 2)
    if not np.any(np.isfinite(heights)):
        stored.spacing_mm = np.array([x, y, np.nan])
        return _numbered(stored, slices)
    if not np.all(np.isfinite(heights)) or not np.ptp(heights) > 0.0:
        wanted, step = "at positions (ImagePositionPatient)", "Export them with positions, or as TIFF slices"
        got = "one for all" if np.all(np.isfinite(heights)) else "none in some of them"
        raise StapeskitError.of("the slices", wanted, got, next_step=step)
    order = np.argsort(heights, kind="stable")
    steps = np.diff(heights[order])
    middle = float(np.median(steps))
    worst = int(np.argmax(np.abs(steps - middle)))
    if not middle > 0.0 or abs(steps[worst] - middle) > _UNEVEN * middle:
        wanted, got = f"even ({middle:.6g} mm)", f"{steps[worst]:.6g} mm after slice {worst + 1}"
        step = (
            "Slices are missing or doubled, stacks are mixed, or positions were rounded: export the series "
            "again, or as TIFF slices"
        )
        raise StapeskitError.of("the distance of DICOM slices", wanted, got, next_step=step)
    aside = np.abs((places[order] - places[order[0]]) @ direction[:, :2])
    if np.any(aside > _ASIDE * np.array([x, y])):
        wanted = "one behind the other along their normal"
        got = f"slices up to {aside.max():.3g} mm beside the first one (tilted gantry)"
        step = "Resample the series to a grid of right angles, and export that"
        raise StapeskitError.of("the slices", wanted, got, next_step=step)
    stored.spacing_mm = np.array([x, y, np.mean(steps)])
    stored.origin_mm, stored.direction, stored.anatomical = places[order[0]], direction, True
    return [slices[k] for k in order]


def _numbered(stored: Stored, slices: Sequence[_Slice]) -> list[_Slice]:
    """Return slices without positions in the order of their numbers; the user states their distance."""
    numbers = np.array([one.numbers("InstanceNumber", 1)[0] for one in slices])
    if len(np.unique(numbers[np.isfinite(numbers)])) < len(slices):
        wanted, step = "at positions or numbered", "Export them with positions, or as TIFF slices"
        got = "neither ImagePositionPatient nor an InstanceNumber of its own in each"
        raise StapeskitError.of("the slices", wanted, got, next_step=step)
    stored.known = "the slices have no positions (ImagePositionPatient)"
    stored.note(
        "The slices have no positions: they were stacked in the order of their numbers, as far apart as "
        "stated.",
        "slices_missing",
    )
    return [slices[k] for k in np.argsort(numbers)]


def _dtype(slices: Sequence[_Slice]) -> np.dtype[Any]:
    """Return the type of the rescaled pixels of all slices."""
    first = slices[0]
    if int(first.get("SamplesPerPixel", 1)) > 1 or first.get("PhotometricInterpretation") == "PALETTE COLOR":
        raise several_values("a colour image", first.file.name)
    bits, signed = int(first.get("BitsAllocated", 0)), int(first.get("PixelRepresentation", 0))
    if bits not in (8, 16, 32):
        step = "Export grey values of one type"
        raise StapeskitError.of("the DICOM pixels", "of 8, 16 or 32 bits", f"{bits} bits", next_step=step)
    rescaling = {_rescaling(one) for one in slices}
    if not np.all(np.isfinite([*rescaling])):
        step = "Export the series again"
        raise StapeskitError.of("the rescaling", "a slope and an offset", "no numbers", next_step=step)
    return np.dtype("f4" if rescaling != {(1.0, 0.0)} else f"{'i' if signed else 'u'}{bits // 8}")


def _rescaling(one: _Slice) -> tuple[float, float]:
    return float(one.get("RescaleSlope", 1.0)), float(one.get("RescaleIntercept", 0.0))


def _pixels(one: _Slice, stored: Stored) -> NDArray[Any]:
    """Return the pixels [y, x] of a slice, rescaled by its own slope and offset."""
    import pydicom

    try:
        head = pydicom.dcmread(one.file, force=True)
        head.file_meta.setdefault("TransferSyntaxUID", pydicom.uid.ImplicitVRLittleEndian)
        if head.file_meta.TransferSyntaxUID.is_compressed:
            values = _unpacked(head)
        else:
            slope, intercept = _rescaling(one)
            values = head.pixel_array
            if stored.dtype.kind == "f":
                values = values * np.float32(slope) + np.float32(intercept)
        return values.reshape(stored.shape[1:]).astype(stored.dtype, casting="same_kind", copy=False)
    except (RuntimeError, ValueError, TypeError, AttributeError) as fault:
        raise wrong_file("DICOM file", "one whose pixels cannot be read", one.file.name) from fault


def _unpacked(head: Any) -> NDArray[Any]:
    """Return packed pixels, rescaled, from a copy of the file as an image of CT.

    SimpleITK unpacks every kind, but reads no class that a scanner's maker has added to those of the
    standard, and where 0 is white it exchanges bright and dark itself.
    """
    import pydicom
    import SimpleITK as sitk

    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    head.SOPClassUID = head.file_meta.MediaStorageSOPClassUID = pydicom.uid.CTImageStorage
    head.PhotometricInterpretation = "MONOCHROME2"
    with NamedTemporaryFile(suffix=".dcm") as copy:
        head.save_as(copy.name)
        values: NDArray[Any] = sitk.GetArrayFromImage(sitk.ReadImage(copy.name))
    return values
