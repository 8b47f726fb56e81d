"""OME-Zarr images of versions 0.1 to 0.5 by zarr, chunk by chunk when they are asked for.

The format: https://ngff.openmicroscopy.org
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.opened import Opened, ReadOptions, beside, several_values, wrong_header
from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.scan import Box, check_grey_values
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

_SPACE = ("z", "y", "x")
_MOST_CHUNK = 1 << 30  # bytes of one unpacked chunk; writers use 100 kB to 100 MB


def open_file(folder: Path, _: ReadOptions) -> Opened:
    """Open an OME-Zarr image at full resolution.

    Raises
    ------
    StapeskitError
        No image, several channels or times, not three-dimensional, or damaged metadata.

    Notes
    -----
    The scale and translation of the level, then those of the whole image, give spacing and origin; the
    translation is that of the first voxel's centre. Chunks that are not stored hold the fill value.
    """
    import zarr

    node: Any = zarr.open(str(folder), mode="r")
    where, scales, notices = _image(node, folder)
    if scales is None:
        array, axes = node, list("tczyx")[-node.ndim :]
        spacing, origin, known = None, np.zeros(3), "a Zarr array alone does not have it"
    else:
        axes = [str(axis["name"] if isinstance(axis, dict) else axis).lower() for axis in scales["axes"]]
        level = scales["datasets"][0]
        beside(folder / "image", str(level["path"]) or ".")
        array = where[str(level["path"])] if str(level["path"]) else where
        spacing, origin, known = _place(scales, level, axes)
    opened = _voxels(array, axes, folder)
    opened.spacing_mm, opened.origin_mm, opened.known = spacing, origin, known
    opened.notices = [*notices, *_missing_chunks(array, folder)]
    return opened


def _image(node: Any, folder: Path) -> tuple[Any, Mapping[str, Any] | None, list[Notice]]:
    """Return the group and the multiscales entry of the (first) image; None for an array alone."""
    import zarr

    if isinstance(node, zarr.Array):
        return node, None, []
    notices: list[Notice] = []
    attributes = _attributes(node)
    if "multiscales" not in attributes and "0" in node and _attributes(node["0"]):
        if "1" in node and "multiscales" in _attributes(node["1"]):
            text = f"{folder.name} holds several images; the first one, 0, was read."
            notices.append(Notice("file_read", text))
        node = node["0"]
        attributes = _attributes(node)
    scales = attributes.get("multiscales")
    if not scales or not scales[0].get("datasets"):
        raise wrong_header(folder, "OME-Zarr image", "a group without multiscales")
    # Versions 0.1 and 0.2 have no axes: theirs are always these.
    return node, {"axes": list("tczyx"), **scales[0]}, notices


def _attributes(node: Any) -> Mapping[str, Any]:
    attributes = dict(node.attrs)
    inner: Mapping[str, Any] = attributes.get("ome", attributes)
    return inner


def _place(
    scales: Mapping[str, Any], level: Mapping[str, Any], axes: Sequence[str]
) -> tuple[Array | None, Array, str]:
    """Return spacing and origin (3,), mm, and what the image says of an incomplete spacing."""
    scale, shift, scaled = np.ones(len(axes)), np.zeros(len(axes)), False
    for transform in (
        *level.get("coordinateTransformations", []),
        *scales.get("coordinateTransformations", []),
    ):
        values = np.array(transform.get(transform.get("type"), np.nan), dtype=float)
        if values.shape != scale.shape or not np.all(np.isfinite(values)):
            continue
        if transform["type"] == "scale":
            scale, shift, scaled = scale * values, shift * values, True
        elif transform["type"] == "translation":
            shift = shift + values
    order = [axes.index(axis) for axis in reversed(_SPACE) if axis in axes]
    if len(order) < 3:
        return None, np.zeros(3), "the image has no axes x, y and z"
    if not scaled or np.any(scale[order] <= 0.0):
        return None, np.zeros(3), "the image has no scale"
    stated = [scales["axes"][k] for k in order]
    factors = [mm_per_unit(axis.get("unit")) if isinstance(axis, dict) else None for axis in stated]
    if any(factor is None for factor in factors):
        listed = " x ".join(f"{value:g}" for value in scale[order])
        return None, np.zeros(3), f"a scale of {listed} without a unit of length"
    lengths = np.array(factors, dtype=float)
    return scale[order] * lengths, shift[order] * lengths, ""


def _voxels(array: Any, axes: Sequence[str], folder: Path) -> Opened:
    """Return the array's z, y, x axes; other axes must have one entry."""
    if len(axes) != array.ndim:
        raise wrong_header(folder, "OME-Zarr image", f"{len(axes)} axes for {array.ndim} dimensions")
    extra = [f"{n} {axis}" for axis, n in zip(axes, array.shape, strict=True) if axis not in _SPACE and n > 1]
    if extra:
        raise several_values(folder, f"{', '.join(extra)} (channels or times)")
    order = [axes.index(axis) for axis in _SPACE if axis in axes]
    shape = tuple(int(array.shape[k]) for k in order)
    dtype = np.dtype(array.dtype)
    check_grey_values(shape, dtype, folder.name)
    claimed = dtype.itemsize
    for n in array.chunks:
        claimed *= int(n)
    if claimed > _MOST_CHUNK:
        size = " x ".join(map(str, array.chunks))
        raise wrong_header(folder, "OME-Zarr image", f"chunks of {size} voxels ({claimed} bytes)")
    back = np.argsort(np.argsort(order))

    def read(box: Box) -> NDArray[Any]:
        key: list[Any] = [0] * array.ndim
        for axis, along in zip(order, box, strict=True):
            key[axis] = along
        return np.asarray(array[tuple(key)]).transpose(back).astype(dtype.newbyteorder("="), copy=False)

    return Opened(shape, dtype, read=read, depth=min(int(array.chunks[order[0]]), shape[0]))


def _missing_chunks(array: Any, folder: Path) -> list[Notice]:
    stored, total = int(array.nchunks_initialized), int(array.nchunks)
    if not stored:
        raise wrong_header(folder, "OME-Zarr image", "metadata without a single chunk")
    if stored >= total:
        return []
    fill = float(array.fill_value or 0)
    text = (
        f"{total - stored} of {total} chunks of {folder.name} are not stored and count as {fill:g}: writers "
        f"leave out empty chunks, but so does an incomplete copy."
    )
    return [Notice("file_read", text)]
