"""DICOM series and multi-frame files through SimpleITK (GDCM), slice by slice when they are asked for.

Damaged packed pixels crash the decoders of GDCM: a process of their own unpacks such series as a whole.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.checks import check_memory, settle_spacing
from legacy.ct_inertia.readers.dicom_lengths import DicomSize, dicom_size
from legacy.ct_inertia.readers.formats import ReadOptions
from legacy.ct_inertia.readers.refusals import not_readable, several_values, unreadable
from legacy.ct_inertia.volume.lazy_arrays import BlockArray
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.guard import Library, read_apart
from legacy.stapeskit.warnings import Notice

# Share of the usual distance of slices by which another one may differ: a missing slice doubles it.
_UNEVEN = 0.02
# Share of a pixel by which slices may lie beside the line along their normal: rounding of written positions.
_ASIDE = 0.1
# Lossless JPEG unpacks some 50 MB a second; a slow machine takes a tenth of that.
_PROCESSOR_S, _BYTES_PER_S = 5.0, 5e6
# Address space, of which little is used.
_MEMORY = 600 << 20
_GDCM = Library("SimpleITK", "DICOM")
_TYPES = {
    "8-bit unsigned integer": "u1",
    "8-bit signed integer": "i1",
    "16-bit unsigned integer": "u2",
    "16-bit signed integer": "i2",
    "32-bit unsigned integer": "u4",
    "32-bit signed integer": "i4",
    "32-bit float": "f4",
    "64-bit float": "f8",
}


@dataclass(frozen=True)
class _Slice:
    """The fields of the header of a DICOM file that are used."""

    file: str
    size: tuple[int, ...]
    dtype: np.dtype
    spacing: Array
    origin: Array
    direction: Array


def recognises(path: Path) -> bool:
    """Return whether a file, or one of the first files of a folder, is DICOM by its name or its preamble."""
    if not path.is_dir():
        return _is_dicom(path)
    files = sorted(p for p in path.iterdir() if p.is_file() and not p.name.startswith("."))
    return any(_is_dicom(file) for file in files[:5])


def read(path: Path, options: ReadOptions) -> Volume:
    """Read the DICOM series of a folder, or a file of several frames.

    Raises
    ------
    CtInertiaError
        Several series, a damaged file, slices of different sizes or at uneven distances, a single slice, or
        colours.
    """
    sizes = [_size(file) for file in _dicom_files(path)]
    read_one = _read_folder if path.is_dir() else _read_file
    if all(size is not None and size.native for size in sizes):
        return _read(read_one, path, options).mirrored(options.mirror)
    claimed = sum(size.claimed_bytes for size in sizes if size is not None)
    check_memory(claimed, path.name)

    def unpacked() -> Volume:
        import SimpleITK as sitk

        sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(1)
        volume = _read(read_one, path, options)
        return replace(volume, array=np.ascontiguousarray(volume.array))

    seconds = _PROCESSOR_S + claimed / _BYTES_PER_S
    volume = read_apart(unpacked, path, "the scan", CtInertiaError, seconds, 4 * claimed + _MEMORY, _GDCM)
    return volume.mirrored(options.mirror)


def _read(read_one: Callable[[Path, ReadOptions], Volume], path: Path, options: ReadOptions) -> Volume:
    try:
        return read_one(path, options)
    except RuntimeError as fault:
        raise not_readable(path, "DICOM series", fault) from fault


def _dicom_files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    return sorted(entry for entry in path.iterdir() if entry.is_file() and _is_dicom(entry))


def _size(file: Path) -> DicomSize | None:
    """Return what a file claims of its pixels; None of one without a preamble that is no DICOM for us."""
    try:
        size = dicom_size(file)
    except CtInertiaError:
        if _has_preamble(file):
            raise
        return None
    check_memory(2 * size.claimed_bytes, file.name)
    return size


def _is_dicom(path: Path) -> bool:
    return path.suffix.lower() in (".dcm", ".dicom", ".ima") or _has_preamble(path)


def _has_preamble(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            return stream.read(132)[128:] == b"DICM"
    except OSError as fault:
        raise unreadable(path, fault) from fault


def _read_folder(folder: Path, options: ReadOptions) -> Volume:
    """Read the series of a folder, ordered by position; rescale slope and intercept are applied."""
    import SimpleITK as sitk

    series = sitk.ImageSeriesReader.GetGDCMSeriesIDs(str(folder))
    if len(series) != 1:
        raise CtInertiaError.of(
            "the folder",
            "one DICOM series",
            f"{len(series)} series{_describe_series(folder, series)}",
            folder.name,
            "Put the slices of one scan into a folder of their own",
        )
    names = list(sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), series[0]))
    if len(names) == 1:
        return _read_file(Path(names[0]), options)
    slices = [_slice(name) for name in names]
    _check_alike(slices, folder)
    normal = slices[0].direction[:, 2]
    places = np.array([float(s.origin @ normal) for s in slices])
    notices: list[Notice] = []
    spacing_of_series = None
    if np.ptp(places) > 0.0:
        slices = [slices[k] for k in np.argsort(places, kind="stable")]
        step = _even_step(np.sort(places), folder)
        _check_square(slices, folder)
        spacing_of_series = np.array([*slices[0].spacing[:2], step])
    elif options.spacing_mm is not None:
        text = (
            f"The slices in {folder.name} have no positions: they were taken in the order of their numbers."
        )
        notices.append(Notice("positions_not_told", text))
    spacing, settled = settle_spacing(
        spacing_of_series, options.spacing_mm, folder.name, "the slices have no positions"
    )
    return Volume(
        _array(slices),
        spacing,
        slices[0].origin,
        slices[0].direction,
        handedness_confirmed=spacing_of_series is not None,
        source=folder,
        notices=(*notices, *settled),
    )


def _read_file(path: Path, options: ReadOptions) -> Volume:
    """Read a file of several frames, unpacked in memory."""
    import SimpleITK as sitk

    head = _slice(str(path))
    if len(head.size) < 3 or head.size[2] < 2:
        raise CtInertiaError.of(
            "the DICOM file",
            "one of several frames",
            "a single slice",
            path.name,
            next_step="Give the folder of the whole series",
        )
    try:
        image = sitk.ReadImage(str(path))
    except RuntimeError as fault:
        raise _refused(path, fault) from fault
    array = sitk.GetArrayFromImage(image)
    steps, origin = np.array(image.GetSpacing()), np.array(image.GetOrigin())
    direction = np.array(image.GetDirection()).reshape(3, 3)
    if np.linalg.det(direction) < 0.0:
        # Frames from the far end to the near one: they are turned round, and stay where they are.
        array = array[::-1]
        origin = origin + direction[:, 2] * steps[2] * (len(array) - 1)
        direction = direction * [1.0, 1.0, -1.0]
    spacing, notices = settle_spacing(steps, options.spacing_mm, path.name)
    return Volume(array, spacing, origin, direction, True, path, notices=notices)


def _slice(name: str) -> _Slice:
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetFileName(name)
    shown = sitk.ProcessObject.GetGlobalWarningDisplay()
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        reader.ReadImageInformation()
    except RuntimeError as fault:
        raise _refused(Path(name), fault) from fault
    finally:
        sitk.ProcessObject.SetGlobalWarningDisplay(shown)
    kind = sitk.GetPixelIDValueAsString(reader.GetPixelID())
    if reader.GetNumberOfComponents() > 1 or kind not in _TYPES:
        raise several_values(Path(name), f"{reader.GetNumberOfComponents()} ({kind})")
    return _Slice(
        name,
        tuple(reader.GetSize()),
        np.dtype(_TYPES[kind]),
        np.array(reader.GetSpacing()),
        np.array(reader.GetOrigin()),
        np.array(reader.GetDirection()).reshape(len(reader.GetSize()), -1),
    )


def _refused(path: Path, fault: RuntimeError) -> CtInertiaError:
    """Return the error for a slice that the library refuses: sound, but not readable by it, or damaged."""
    if "Pixel type larger than output type" not in str(fault):
        return not_readable(path, "DICOM file", fault)
    return CtInertiaError.of(
        "the rescaled grey values",
        "within the range of the stored type (RescaleSlope, RescaleIntercept)",
        "a rescaling that leaves it, which the DICOM library refuses",
        path.name,
        "The file may be sound: export unsigned grey values without rescaling, or convert it to NRRD",
    )


def _check_alike(slices: Sequence[_Slice], folder: Path) -> None:
    first = slices[0]
    for other in slices:
        turned = np.max(np.abs(other.direction - first.direction)) > 1e-4
        if other.size != first.size or turned or np.max(np.abs(other.spacing - first.spacing)[:2]) > 1e-6:
            raise CtInertiaError.of(
                f"slice {Path(other.file).name}",
                f"of the size, pixel spacing and orientation of {Path(first.file).name}",
                f"{other.size[0]} x {other.size[1]} at {other.spacing[0]:.6g} mm",
                folder.name,
                "Put the slices of one scan into a folder of their own",
            )


def _even_step(places: Array, folder: Path) -> float:
    steps = np.diff(places)
    middle = float(np.median(steps))
    worst = int(np.argmax(np.abs(steps - middle)))
    if abs(steps[worst] - middle) > _UNEVEN * abs(middle):
        raise CtInertiaError.of(
            "the distance of DICOM slices",
            f"even ({middle:.6g} mm)",
            f"{steps[worst]:.6g} mm after slice {worst + 1}",
            folder.name,
            "Slices are missing: export the whole series again",
        )
    return float(np.mean(steps))


def _check_square(slices: Sequence[_Slice], folder: Path) -> None:
    """Refuse slices that lie beside each other, as a tilted gantry makes them: their voxels are no boxes."""
    shift = np.array([one.origin - slices[0].origin for one in slices]) @ slices[0].direction[:, :2]
    worst = int(np.argmax(np.max(np.abs(shift), axis=1)))
    if np.any(np.abs(shift[worst]) > _ASIDE * slices[0].spacing[:2]):
        raise CtInertiaError.of(
            "the slices of the series",
            "one behind the other along their normal",
            f"slice {worst + 1} {np.linalg.norm(shift[worst]):.3g} mm beside the first one (tilted gantry)",
            folder.name,
            "Resample the series to a grid of right angles, and export that",
        )


def _array(slices: Sequence[_Slice]) -> NDArray[Any]:
    """Return the slices as one array; where slope and intercept give them different types, the widest."""
    import SimpleITK as sitk

    ny, nx = slices[0].size[1], slices[0].size[0]
    dtype = np.result_type(*{s.dtype for s in slices})
    one_by_one = Lock()

    def plane(z: int, _y: int, _x: int) -> NDArray[Any]:
        try:
            with one_by_one:
                image = sitk.GetArrayFromImage(sitk.ReadImage(slices[z].file))
        except RuntimeError as fault:
            raise _refused(Path(slices[z].file), fault) from fault
        return np.asarray(image).reshape(1, ny, nx)

    return BlockArray((len(slices), ny, nx), dtype, (1, ny, nx), plane).as_array()


def _describe_series(folder: Path, series: Sequence[str]) -> str:
    """Return what the series of a folder are called and how many slices each has."""
    import SimpleITK as sitk

    titles = []
    for uid in series[:6]:
        names = sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), uid)
        reader = sitk.ImageFileReader()
        reader.SetFileName(names[0])
        try:
            reader.ReadImageInformation()
            known = {key: reader.GetMetaData(key).strip() for key in reader.GetMetaDataKeys()}
        except RuntimeError:
            known = {}
        name = known.get("0008|103e") or f"series {known.get('0020|0011') or uid}"
        titles.append(f"{name} ({len(names)} files)")
    return ": " + ", ".join(titles) if titles else ""
