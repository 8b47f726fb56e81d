"""TIFF stacks: plain multi-page, ImageJ, OME and BigTIFF, with their spacing and origin."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.ct_inertia.readers.checks import mm_per_unit, settle_spacing
from legacy.ct_inertia.readers.formats import ReadOptions
from legacy.ct_inertia.readers.ome import Calibration, ome_calibration
from legacy.ct_inertia.readers.tiff_directories import check_directories, check_ome_files, ome_file_names
from legacy.ct_inertia.readers.tiff_log import listening
from legacy.ct_inertia.readers.tiff_pages import (
    first_stack,
    plane_calibration,
    resolution,
    stack_array,
    turned_notice,
    white_is_zero,
)
from legacy.ct_inertia.volume.lazy_arrays import invert_grey_values
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

if TYPE_CHECKING:
    import tifffile


def read(path: Path, options: ReadOptions) -> Volume:
    """Read a TIFF stack with its spacing from OME, ImageJ or resolution tags.

    Raises
    ------
    CtInertiaError
        Not readable, truncated, two-dimensional, coloured, complex, or without a complete spacing.

    Notes
    -----
    Where the file says that 0 is white, bright and dark are exchanged, with a notice: bone is bright then.
    OME has the position of the first plane, ImageJ its zero; no TIFF has direction or handedness:
    identity, not confirmed. Plain resolution tags hold x and y only; the distance of slices is then asked
    for, not guessed.
    """
    import tifffile

    check_directories(path)
    with listening(path, "TIFF"), tifffile.TiffFile(path) as tif:
        check_ome_files(path, tif.ome_metadata if tif.is_ome else None, options.follow)
        series = first_stack(tif)
        array = stack_array(series, path)
        place = _calibration(tif, series)
        notices = _notices(tif, path)
        if white_is_zero(series.keyframe):
            array, notices = invert_grey_values(array), [*notices, turned_notice(path)]
    spacing, settled = settle_spacing(place.spacing_mm, options.spacing_mm, path.name, place.known)
    volume = Volume(array, spacing, place.origin_mm, np.eye(3), source=path, notices=(*notices, *settled))
    return volume.mirrored(options.mirror)


def companion_files(path: Path) -> list[Path]:
    """Return the files that hold the planes of an OME-TIFF, where its metadata name them."""
    import tifffile

    with listening(path, "TIFF"), tifffile.TiffFile(path) as tif:
        names = ome_file_names(tif.ome_metadata if tif.is_ome else None)
    return [path.parent / name for name in names if "\0" not in name]


def _calibration(tif: tifffile.TiffFile, series: Any) -> Calibration:
    """Return spacing and origin x, y, z in mm of an image, or the part of them that the file has."""
    page: Any = series.keyframe
    if tif.is_ome and tif.ome_metadata:
        every = list(tif.series)
        calibration = ome_calibration(tif.ome_metadata, every.index(series), len(every), series.shape)
        if calibration is not None:
            return calibration
    if tif.is_imagej and tif.imagej_metadata is not None:
        return _imagej(tif.imagej_metadata, resolution(page))
    return plane_calibration(page)


def _imagej(meta: dict[str, Any], plane: Array | None) -> Calibration:
    """Return spacing and origin of ImageJ; the origin is the voxel at 0, counted in voxels."""
    unit = mm_per_unit(str(meta.get("unit", "")))
    depth = meta.get("spacing")
    if unit is None:
        return Calibration(None, known=f"the ImageJ unit is {meta.get('unit') or 'not set'}")
    if plane is None or not depth:
        part, text = None, ""
        if plane is not None:
            part = np.array([*(plane * unit), np.nan])
            text = f" ({part[0]:.6g} x {part[1]:.6g} mm in a slice)"
        return Calibration(part, known=f"the ImageJ header has a unit but no complete spacing{text}")
    # Fiji writes a unit of its own for y and z where they differ from that of x.
    units = np.array([unit, *(mm_per_unit(str(meta.get(f"{a}unit", ""))) or unit for a in "yz")])
    spacing = np.array([plane[0], plane[1], abs(float(depth))]) * units
    zero = np.array([float(meta.get(f"{axis}origin") or 0.0) for axis in "xyz"])
    return Calibration(spacing, -zero * spacing if np.all(np.isfinite(zero)) else np.zeros(3))


def _notices(tif: tifffile.TiffFile, path: Path) -> list[Notice]:
    notices = []
    if len(tif.series) > 1 and not tif.series[0].is_pyramidal:
        text = f"{path.name} holds {len(tif.series)} images; the first stack was read."
        notices.append(Notice("first_series_read", text))
    meta = tif.imagej_metadata if tif.is_imagej else None
    if meta and float(meta.get("spacing") or 1.0) < 0.0:
        text = (
            f"{path.name} has a negative slice distance; its size was used and the order of slices kept. "
            f"Reverse them with {named('mirror')} z if the ear is a mirror image."
        )
        notices.append(Notice("negative_slice_distance", text))
    return notices
