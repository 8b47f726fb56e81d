"""A folder of DICOM slices through SimpleITK (GDCM)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ct_inertia.errors import CtInertiaError
from ct_inertia.readers.checks import not_readable, settle_spacing
from ct_inertia.volume import Volume
from kinematics.errors import sentence

_UNEVEN = 0.02


def is_dicom(path: Path) -> bool:
    """Say whether a file is DICOM, by its name or its preamble."""
    if path.suffix.lower() in (".dcm", ".dicom", ".ima"):
        return True
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def holds_dicom(folder: Path) -> bool:
    """Say whether one of a folder's first files is DICOM."""
    files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    return any(is_dicom(path) for path in files[:5])


def read_dicom(folder: Path, spacing_mm: Sequence[float] | None = None) -> Volume:
    """Read the DICOM series of a folder, ordered by position.

    Raises
    ------
    CtInertiaError
        Several series, a damaged file, or slices at uneven distances.
    """
    import SimpleITK as sitk

    series = sitk.ImageSeriesReader.GetGDCMSeriesIDs(str(folder))
    if len(series) != 1:
        raise CtInertiaError(
            sentence(
                "the folder",
                "one DICOM series",
                f"{len(series)} series",
                folder.name,
                "Put the slices of one scan into a folder of their own",
            )
        )
    reader = sitk.ImageSeriesReader()
    names = sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), series[0])
    reader.SetFileNames(names)
    shown = sitk.ProcessObject.GetGlobalWarningDisplay()
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        image = reader.Execute()
    except RuntimeError as fault:
        raise not_readable(folder, "DICOM series", fault) from fault
    finally:
        sitk.ProcessObject.SetGlobalWarningDisplay(shown)
    if image.GetNumberOfComponentsPerPixel() > 1 or image.GetDimension() != 3 or len(names) < 2:
        raise CtInertiaError(
            sentence(
                "the DICOM series",
                "a three-dimensional grey-value volume",
                f"{len(names)} slices",
                next_step="Give the folder of the whole series",
            )
        )
    _check_even(names, np.array(image.GetDirection()).reshape(3, 3)[:, 2], folder)
    spacing, notices = settle_spacing(np.array(image.GetSpacing()), spacing_mm, folder.name)
    return Volume(
        sitk.GetArrayFromImage(image),
        spacing,
        np.array(image.GetOrigin()),
        np.array(image.GetDirection()).reshape(3, 3),
        handedness_confirmed=True,
        source=folder,
        notices=notices,
    )


def _check_even(names: Sequence[str], normal: np.ndarray, folder: Path) -> None:
    import SimpleITK as sitk

    places = []
    for name in names:
        header = sitk.ImageFileReader()
        header.SetFileName(name)
        header.ReadImageInformation()
        places.append(float(np.array(header.GetOrigin()) @ normal))
    steps = np.diff(places)
    middle = float(np.median(steps))
    worst = int(np.argmax(np.abs(steps - middle)))
    if abs(steps[worst] - middle) > _UNEVEN * abs(middle):
        raise CtInertiaError(
            sentence(
                "the distance of DICOM slices",
                f"even ({middle:.6g} mm)",
                f"{steps[worst]:.6g} mm after slice {worst + 1}",
                folder.name,
                "Slices are missing: export the whole series again",
            )
        )
