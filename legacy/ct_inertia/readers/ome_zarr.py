"""OME-Zarr images of versions 0.1 to 0.5, chunk by chunk when they are asked for.

The format: https://ngff.openmicroscopy.org
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.checks import beside, mm_per_unit, settle_spacing
from legacy.ct_inertia.readers.formats import ReadOptions
from legacy.ct_inertia.readers.header_grid import check_dimensions
from legacy.ct_inertia.readers.refusals import header_fault, no_grey_values, several_values
from legacy.ct_inertia.readers.zarr_chunks import Meta, ZarrArray, metadata, zarr_array
from legacy.ct_inertia.volume.lazy_arrays import BlockArray, Gaps, Level
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

_SPACE = ("z", "y", "x")


def read(folder: Path, options: ReadOptions) -> Volume:
    """Read an OME-Zarr image at full resolution, with its coarser levels for the first look.

    Raises
    ------
    CtInertiaError
        No image, several channels or times, not three-dimensional, no spacing, or damaged metadata.

    Notes
    -----
    The scale and translation of the level, then those of the whole image, give spacing and origin; the
    translation is that of the first voxel's centre. Chunks that are not stored hold the fill value.
    """
    image, notices = _image(folder)
    if image is None:
        array = zarr_array(folder)
        axes = list("tczyx")[-len(array.shape) :]
        placed: tuple[Array | None, Array, str] = (None, np.zeros(3), "a Zarr array alone does not have it")
        voxels = _spatial(array, axes, folder)
    else:
        where, scales = image
        axes = [str(axis["name"] if isinstance(axis, dict) else axis).lower() for axis in scales["axes"]]
        levels = scales["datasets"]
        array = zarr_array(_level_folder(where, levels[0], options.follow))
        placed = _place(scales, levels[0], axes)
        voxels = _spatial(array, axes, folder)
        voxels.levels = tuple(_levels(where, scales, axes, folder, voxels.shape, options.follow))
    absent, total = array.missing()
    if absent == total:
        raise header_fault(folder, "OME-Zarr image", "metadata without a single chunk")
    if absent:
        text = (
            f"{absent} of {total} chunks of {folder.name} are not stored and count as {array.fill_voxel:g}: "
            f"writers leave out empty chunks, but so does an incomplete copy."
        )
        notices.append(Notice("chunks_not_stored", text))
    stored_spacing, origin, known = placed
    spacing, settled = settle_spacing(stored_spacing, options.spacing_mm, folder.name, known)
    volume = Volume(
        voxels.as_array(), spacing, origin, np.eye(3), source=folder, notices=(*notices, *settled)
    )
    return volume.mirrored(options.mirror)


def recognises(folder: Path) -> bool:
    """Return whether a folder has the metadata of a Zarr group or array."""
    return any((folder / name).is_file() for name in (".zattrs", ".zgroup", ".zarray", "zarr.json"))


def _image(folder: Path) -> tuple[tuple[Path, Meta] | None, list[Notice]]:
    """Return the folder and the multiscales entry of the (first) image; None for an array alone."""
    notices: list[Notice] = []
    attributes = _attributes(folder)
    if "multiscales" not in attributes and (folder / "0").is_dir() and _attributes(folder / "0"):
        if (folder / "1").is_dir() and _attributes(folder / "1").get("multiscales"):
            text = f"{folder.name} holds several images; the first one, 0, was read."
            notices.append(Notice("first_series_read", text))
        folder = folder / "0"
        attributes = _attributes(folder)
    scales = attributes.get("multiscales")
    if scales:
        try:
            if scales[0].get("datasets"):
                # Versions 0.1 and 0.2 have no axes: theirs are always these.
                return (folder, {"axes": list("tczyx"), **scales[0]}), notices
        except (TypeError, LookupError, AttributeError):
            pass
        raise header_fault(folder, "OME-Zarr image", "multiscales without datasets")
    if (folder / ".zarray").is_file() or metadata(folder / "zarr.json").get("node_type") == "array":
        return None, notices
    raise header_fault(folder, "OME-Zarr image", "a group without multiscales")


def _attributes(folder: Path) -> Meta:
    if (folder / "zarr.json").is_file():
        attributes = metadata(folder / "zarr.json").get("attributes") or {}
        content: Meta = attributes.get("ome") or attributes
        return content
    return metadata(folder / ".zattrs") if (folder / ".zattrs").is_file() else {}


def _place(scales: Meta, level: Meta, axes: list[str]) -> tuple[Array | None, Array, str]:
    """Return spacing and origin x, y, z in mm, or None and what is known of the spacing."""
    scale, shift = np.ones(len(axes)), np.zeros(len(axes))
    has_scale = False
    for transform in [
        *level.get("coordinateTransformations", []),
        *scales.get("coordinateTransformations", []),
    ]:
        values = np.array(transform.get(transform.get("type"), np.nan), dtype=float)
        if values.shape != (len(axes),) or not np.all(np.isfinite(values)):
            continue
        if transform["type"] == "scale":
            scale, shift, has_scale = scale * values, shift * values, True
        elif transform["type"] == "translation":
            shift = shift + values
    order = [axes.index(axis) for axis in reversed(_SPACE) if axis in axes]
    if len(order) < 3:
        return None, np.zeros(3), "the image has no axes x, y and z"
    units = [scales["axes"][k].get("unit") if isinstance(scales["axes"][k], dict) else None for k in order]
    factors = [mm_per_unit(unit) for unit in units]
    values = scale[order]
    if not has_scale or np.any(values <= 0.0):
        return None, np.zeros(3), "the image has no scale"
    if any(factor is None for factor in factors):
        return (
            None,
            np.zeros(3),
            f"a scale of {' x '.join(f'{v:g}' for v in values)} without a unit of length",
        )
    lengths = np.array(factors, dtype=float)
    return values * lengths, shift[order] * lengths, ""


def _spatial(array: ZarrArray, axes: list[str], folder: Path) -> BlockArray:
    """Return the array's z, y, x axes; other axes must have one entry."""
    if len(axes) != len(array.shape):
        raise header_fault(folder, "OME-Zarr image", f"{len(axes)} axes for {len(array.shape)} dimensions")
    extra = [f"{n} {axis}" for axis, n in zip(axes, array.shape, strict=True) if axis not in _SPACE and n > 1]
    if extra:
        raise several_values(folder, f"{', '.join(extra)} (channels or times)")
    order = [axes.index(axis) for axis in _SPACE if axis in axes]
    check_dimensions([array.shape[k] for k in reversed(order)], folder.name)
    if array.dtype.kind not in "uif":
        raise no_grey_values(folder, array.dtype)
    rest = [k for k in range(len(axes)) if k not in order]

    def block(z: int, y: int, x: int) -> NDArray[Any]:
        at = [0] * len(axes)
        for axis, number in zip(order, (z, y, x), strict=True):
            at[axis] = number
        return array.read(at).transpose([*rest, *order])[(0,) * len(rest)]

    there = array.present().transpose([*rest, *order])[(0,) * len(rest)]
    gaps = None if there.all() else Gaps(there, array.fill_voxel)
    shape, chunks = ([numbers[k] for k in order] for numbers in (array.shape, array.chunks))
    return BlockArray(shape, array.dtype, chunks, block, gaps=gaps)


def _level_folder(where: Path, level: Meta, follow: bool) -> Path:
    """Return the folder of a level; a level that is the image itself has the path "." or none."""
    return beside(where / ".zattrs", str(level["path"]) or ".", follow)


def _levels(
    where: Path, scales: Meta, axes: list[str], folder: Path, shape: tuple[int, ...], follow: bool
) -> list[Level]:
    """Return the coarser levels that are whole and whose voxels are whole numbers of voxels of the finest."""
    fine = _scale(scales["datasets"][0], len(axes))
    levels = []
    for level in scales["datasets"][1:]:
        try:
            array = zarr_array(_level_folder(where, level, follow))
            coarse = _spatial(array, axes, folder)
        except (CtInertiaError, KeyError):
            continue
        ratio = _scale(level, len(axes)) / fine
        if not np.all(np.isfinite(ratio)):
            continue
        factors = [int(np.rint(ratio[axes.index(axis)])) for axis in _SPACE]
        sizes = [-(-n // f) if f > 0 else 0 for n, f in zip(shape, factors, strict=True)]
        near = all(abs(c - n) <= 1 for c, n in zip(coarse.shape, sizes, strict=True))
        if near and np.max(np.abs(ratio - np.rint(ratio))) < 0.01 and array.missing()[0] == 0:
            levels.append(Level((factors[0], factors[1], factors[2]), coarse))
    return levels


def _scale(level: Meta, count: int) -> Array:
    for transform in level.get("coordinateTransformations", []):
        if transform.get("type") == "scale" and len(transform["scale"]) == count:
            return np.array(transform["scale"], dtype=float)
    return np.full(count, np.nan)
