"""OME-Zarr images of versions 0.1 to 0.5 by zarr, chunk by chunk when they are asked for.

The format: https://ngff.openmicroscopy.org
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.header import Header, several_values, wrong_header
from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.scan import Box, check_grey_values

_SPACE = ("z", "y", "x")
_MOST_CHUNK = 1 << 30  # bytes of one unpacked chunk; writers use 100 kB to 100 MB


def open_zarr(folder: Path) -> Header:
    """Open the (first) OME-Zarr image of a folder at full resolution, or an array alone.

    Raises
    ------
    StapeskitError
        No image, several channels or times, not three-dimensional, or damaged metadata.
    """
    import zarr

    node: Any = zarr.open(str(folder), mode="r")
    if isinstance(node, zarr.Array):
        header = _voxels(node, list("tczyx")[-node.ndim :], folder)
        header.known = "a Zarr array alone does not have it"
        return header
    several = False
    if "multiscales" not in _attributes(node) and "0" in node:
        several = "1" in node and "multiscales" in _attributes(node["1"])
        node = node["0"]
    scales = _attributes(node).get("multiscales")
    if not scales or not scales[0].get("datasets"):
        raise wrong_header(folder, "OME-Zarr image", "a group without multiscales")
    # Versions 0.1 and 0.2 have no axes: theirs are always these.
    axes = scales[0].get("axes", list("tczyx"))
    level = scales[0]["datasets"][0]
    name = str(level["path"])
    names = [str(axis["name"] if isinstance(axis, dict) else axis).lower() for axis in axes]
    header = _voxels(node[name] if name else node, names, folder)
    transforms = [
        *level.get("coordinateTransformations", []),
        *scales[0].get("coordinateTransformations", []),
    ]
    _place(header, transforms, names, axes)
    if several:
        header.note(f"{folder.name} holds several images; the first one, 0, was read.")
    return header


def _attributes(node: Any) -> Mapping[str, Any]:
    attributes = dict(node.attrs)
    inner: Mapping[str, Any] = attributes.get("ome", attributes)
    return inner


def _place(
    header: Header, transforms: Sequence[Mapping[str, Any]], names: Sequence[str], axes: Sequence[Any]
) -> None:
    """Set spacing and origin; the translation is that of the first voxel's centre.

    The scale and translation of the level come first, then those of the whole image.
    """
    scale, shift = np.full(len(names), np.nan), np.zeros(len(names))
    for transform in transforms:
        kind = transform.get("type")
        values = np.array(transform.get(kind, np.nan) if kind else np.nan, dtype=float)
        if values.shape == scale.shape and kind == "scale":
            scale, shift = np.where(np.isnan(scale), 1.0, scale) * values, shift * values
        elif values.shape == scale.shape and kind == "translation":
            shift = shift + values
    order = [names.index(axis) for axis in reversed(_SPACE)]
    scale, shift = scale[order], shift[order]
    units = [mm_per_unit(axes[k].get("unit")) if isinstance(axes[k], dict) else None for k in order]
    if not np.all(scale > 0.0):
        header.known = "the image has no scale"
    elif None in units:
        header.known = f"a scale of {' x '.join(f'{value:g}' for value in scale)} without a unit of length"
    else:
        lengths = np.array(units, dtype=float)
        header.spacing_mm, header.origin_mm = scale * lengths, shift * lengths


def _voxels(array: Any, names: Sequence[str], folder: Path) -> Header:
    """Return the array's z, y, x axes; other axes must have one entry."""
    if len(names) != array.ndim or not set(_SPACE) <= set(names):
        raise wrong_header(folder, "OME-Zarr image", f"{array.ndim} dimensions with axes {', '.join(names)}")
    extra = [
        f"{n} {axis}" for axis, n in zip(names, array.shape, strict=True) if axis not in _SPACE and n > 1
    ]
    if extra:
        raise several_values(folder, f"{', '.join(extra)} (channels or times)")
    order = [names.index(axis) for axis in _SPACE]
    shape = tuple(int(array.shape[k]) for k in order)
    dtype = np.dtype(array.dtype)
    check_grey_values(shape, dtype, folder.name)
    claimed = dtype.itemsize * prod(int(n) for n in array.chunks)
    if claimed > _MOST_CHUNK:
        raise wrong_header(folder, "OME-Zarr image", f"chunks of {claimed} bytes")
    back = np.argsort(np.argsort(order))

    def read(box: Box) -> NDArray[Any]:
        key: list[Any] = [0] * array.ndim
        for axis, along in zip(order, box, strict=True):
            key[axis] = along
        return np.asarray(array[tuple(key)]).transpose(back).astype(dtype.newbyteorder("="), copy=False)

    header = Header(shape, dtype, read=read, depth=min(int(array.chunks[order[0]]), shape[0]))
    missing = int(array.nchunks) - int(array.nchunks_initialized)
    if missing >= int(array.nchunks):
        raise wrong_header(folder, "OME-Zarr image", "metadata without a single chunk")
    if missing > 0:
        header.note(
            f"{missing} of {array.nchunks} chunks of {folder.name} are not stored and count as "
            f"{float(array.fill_value or 0):g}: writers leave out empty chunks, but so does a broken copy."
        )
    return header
