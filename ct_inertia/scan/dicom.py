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


def open_dicom(path: Path) -> Stored:
    """Open the DICOM series of a folder, or a file of several frames."""
    heads, others = _only_series(path) if path.is_dir() else ({path: _head(path)}, 0)
    frames = [frame for file, head in heads.items() for frame in _frames(file, head)]
    first, step = frames[0], "Give the folder of the whole series"
    if "Rows" not in first.head:
        kind = getattr(first.head.get("SOPClassUID"), "name", "another kind of DICOM file")
        raise StapeskitError.of(
            "the DICOM file", "one of images", f"{kind}, without an image", next_step=step
        )
    if len(frames) < 2:
        raise StapeskitError.of("the DICOM file", "one of several frames", "a single slice", next_step=step)
    _check_alike(frames)
    stored = Stored((len(frames), int(first.head.Rows), int(first.head.Columns)), _dtype(frames))
    stored.white_is_zero = first.get("PhotometricInterpretation") == "MONOCHROME1"
    if others:
        stored.note(
            f"{others} single pictures of other series in {path.name}, such as scouts, were left out."
        )
    held: dict[Path, NDArray[Any]] = {}  # the frames of the file that was read last

    def decode(frame: _Frame) -> NDArray[Any]:
        if frame.file not in held:
            held.clear()
            held[frame.file] = _pixels(frame, stored)
        return held[frame.file][frame.number]

    stored.voxels = by_planes(_placed(stored, frames), decode)
    return stored


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
        raise StapeskitError.of("the folder", "one DICOM series", got, next_step=_APART)
    return {file: heads[file] for file in stacks[0]}, len(heads) - len(stacks[0])


def _title(head: Any) -> str:
    return str(head.get("SeriesDescription") or f"series {head.get('SeriesNumber', '')}").strip()


def _head(file: Path) -> Any:
    import pydicom

    head = pydicom.dcmread(file, stop_before_pixels=True, force=not has_preamble(file))
    if len(head) == 0 or ("Rows" in head and not (int(head.Rows) > 0 and int(head.Columns) > 0)):
        raise wrong_file("DICOM file", "one without fields or pixels", file.name)
    return head


def _frames(file: Path, head: Any) -> list[_Frame]:
    own = head.get("PerFrameFunctionalGroupsSequence") or []
    shared = list(head.get("SharedFunctionalGroupsSequence") or [])[:1]
    count = int(head.get("NumberOfFrames") or 1)
    if count > file.stat().st_size:
        raise wrong_file("DICOM file", f"one of {count} frames", file.name)
    return [_Frame(file, k, head, (*own[k : k + 1], *shared)) for k in range(count)]


def _check_alike(frames: Sequence[_Frame]) -> None:
    for name, (count, rounding) in _ALIKE.items():
        values = np.array([frame.numbers(name, count) for frame in frames])
        same = np.all(np.isclose(values, values[0], rtol=0.0, atol=rounding, equal_nan=True), axis=1)
        if not np.all(same):
            wanted, got = (", ".join(f"{v:.6g}" for v in values[k]) for k in (0, int(np.argmin(same))))
            wanted = f"of the {name} of {frames[0].file.name} ({wanted})"
            thing = f"slice {frames[int(np.argmin(same))].file.name}"
            raise StapeskitError.of(thing, wanted, got, next_step=_APART)


def _placed(stored: Stored, frames: Sequence[_Frame]) -> list[_Frame]:
    """Set the place of frames, and return them in the order of their positions.

    Raises
    ------
    StapeskitError
        Some have no positions, their distances are uneven, or they lie beside each other, as a tilted gantry
        makes them: their voxels are no boxes.
    """
    places = np.array([frame.numbers("ImagePositionPatient", 3) for frame in frames])
    axes = frames[0].numbers("ImageOrientationPatient", 6)
    direction = np.column_stack([axes[:3], axes[3:], np.cross(axes[:3], axes[3:])])
    heights = places @ direction[:, 2]
    y, x = frames[0].numbers("PixelSpacing", 2)
    if not np.any(np.isfinite(heights)):
        stored.spacing_mm = np.array([x, y, np.nan])
        return _numbered(stored, frames)
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
        step = "Slices are missing, or several stacks are mixed: export the series again"
        raise StapeskitError.of("the distance of DICOM slices", wanted, got, next_step=step)
    aside = np.abs((places[order] - places[order[0]]) @ direction[:, :2])
    if np.any(aside > _ASIDE * np.array([x, y])):
        wanted = "one behind the other along their normal"
        got = f"slices up to {aside.max():.3g} mm beside the first one (tilted gantry)"
        step = "Resample the series to a grid of right angles, and export that"
        raise StapeskitError.of("the slices", wanted, got, next_step=step)
    stored.spacing_mm = np.array([x, y, np.mean(steps)])
    stored.origin_mm, stored.direction, stored.anatomical = places[order[0]], direction, True
    return [frames[k] for k in order]


def _numbered(stored: Stored, frames: Sequence[_Frame]) -> list[_Frame]:
    """Return frames without positions in the order of their numbers; the user states their distance.

    Raises
    ------
    StapeskitError
        They have no numbers, or one twice.
    """
    numbers = [(frame.numbers("InstanceNumber", 1)[0], frame.number) for frame in frames]
    single = len({frame.file for frame in frames}) == 1
    if not single and (np.any(np.isnan(numbers)) or len(set(numbers)) < len(frames)):
        wanted, step = "at positions or numbered", "Export them with positions, or as TIFF slices"
        got = "neither ImagePositionPatient nor an InstanceNumber of its own in each"
        raise StapeskitError.of("the slices", wanted, got, next_step=step)
    stored.known = "the slices have no positions (ImagePositionPatient)"
    stored.note(
        "The slices have no positions: they were stacked in the order of their numbers, as far apart as "
        "stated.",
        "slice_positions_missing",
    )
    if single:
        return list(frames)
    return [frames[k] for k in sorted(range(len(frames)), key=numbers.__getitem__)]


def _dtype(frames: Sequence[_Frame]) -> np.dtype[Any]:
    """Return the type of the rescaled pixels of all frames.

    Raises
    ------
    StapeskitError
        Colours, another type of pixels, or a rescaling that is none or differs within a file.
    """
    first = frames[0]
    if int(first.get("SamplesPerPixel", 1)) > 1 or first.get("PhotometricInterpretation") == "PALETTE COLOR":
        raise several_values("a colour image", first.file.name)
    bits, signed = int(first.get("BitsAllocated", 0)), int(first.get("PixelRepresentation", 0))
    if bits not in (8, 16, 32):
        step = "Export grey values of one type"
        raise StapeskitError.of("the DICOM pixels", "of 8, 16 or 32 bits", f"{bits} bits", next_step=step)
    rescaling = {frame.file: _rescaling(frame) for frame in frames}
    alike = all(_rescaling(frame) == rescaling[frame.file] for frame in frames)
    if not alike or not np.all(np.isfinite([*rescaling.values()])):
        got, step = "others in one file, or no numbers", "Export the series as single slices"
        raise StapeskitError.of("the rescaling", "one slope and offset a file", got, next_step=step)
    scaled = set(rescaling.values()) != {(1.0, 0.0)}
    return np.dtype(np.float32 if scaled else f"{'i' if signed else 'u'}{bits // 8}")


def _rescaling(frame: _Frame) -> tuple[float, float]:
    return float(frame.get("RescaleSlope", 1.0)), float(frame.get("RescaleIntercept", 0.0))


def _pixels(frame: _Frame, stored: Stored) -> NDArray[Any]:
    """Return the pixels [frame, y, x] of the file of a frame, rescaled by the slope and offset of the file.

    Notes
    -----
    SimpleITK reads no classes that the standard does not have; scanners write some of their own, which
    pydicom reads where the pixels are not packed, and SimpleITK from a copy under the class of CT images.
    Where 0 is white SimpleITK exchanges bright and dark itself (8 and 16 bit) or returns numbers that are
    none (32 bit): these are read as they are stored, in the same two ways.
    """
    import pydicom

    try:
        values = None if stored.white_is_zero else _by_itk(frame.file)
        if values is None:
            head = pydicom.dcmread(frame.file, force=True)
            try:
                values = head.pixel_array
            except RuntimeError:  # packed
                with NamedTemporaryFile(suffix=".dcm") as copy:
                    head.SOPClassUID = head.file_meta.MediaStorageSOPClassUID = pydicom.uid.CTImageStorage
                    head.PhotometricInterpretation = "MONOCHROME2"
                    head.save_as(copy.name)
                    values = _by_itk(Path(copy.name))
            else:
                slope, intercept = _rescaling(frame)
                if stored.dtype.kind == "f":
                    values = values * np.float32(slope) + np.float32(intercept)
        if values is None:
            raise ValueError
        return values.reshape(-1, *stored.shape[1:]).astype(stored.dtype, casting="same_kind", copy=False)
    except (RuntimeError, ValueError, TypeError, AttributeError) as fault:
        raise wrong_file("DICOM file", "one whose pixels cannot be read", frame.file.name) from fault


def _by_itk(file: Path) -> NDArray[Any] | None:
    """Return the rescaled pixels of a file, or None where SimpleITK does not read it."""
    import SimpleITK as sitk

    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    with suppress(RuntimeError):
        values: NDArray[Any] = sitk.GetArrayFromImage(sitk.ReadImage(str(file)))
        return values
    return None
