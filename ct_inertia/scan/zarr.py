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

from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.scan import Box
from ct_inertia.scan.stored import Stored, native, several_values, wrong_file

_SPACE = ("z", "y", "x")
_MOST_CHUNK = 1 << 30  # bytes of one unpacked chunk; writers use 100 kB to 100 MB


def open_zarr(folder: Path) -> Stored:
    """Open the (first) OME-Zarr image of a folder at full resolution, or an array alone."""
    import zarr

    node: Any = zarr.open(str(folder), mode="r")
    if isinstance(node, zarr.Array):
        stored = _voxels(node, list("tczyx")[-node.ndim :], folder.name)
        stored.known = "a Zarr array alone does not have it"
        return stored
    several = False
    if "multiscales" not in _attributes(node) and "0" in node:
        several = "1" in node and "multiscales" in _attributes(node["1"])
        node = node["0"]
    image: dict[str, Any] = next(iter(_attributes(node).get("multiscales") or ()), {})
    if not image.get("datasets"):
        raise wrong_file("OME-Zarr image", "a group without multiscales")
    # Versions 0.1 and 0.2 have no axes: theirs are always these.
    axes = [axis if isinstance(axis, dict) else {"name": axis} for axis in image.get("axes", "tczyx")]
    names = [str(axis["name"]).lower() for axis in axes]
    level = image["datasets"][0]
    stored = _voxels(node[str(level["path"])] if level["path"] else node, names, folder.name)
    transforms = [one for part in (level, image) for one in part.get("coordinateTransformations", [])]
    _place(stored, transforms, names, [axis.get("unit") for axis in axes])
    if several:
        stored.note(f"{folder.name} holds several images; the first one, 0, was read.")
    return stored


def _attributes(node: Any) -> Mapping[str, Any]:
    attributes = dict(node.attrs)
    inner: Mapping[str, Any] = attributes.get("ome", attributes)
    return inner


def _place(
    stored: Stored, transforms: Sequence[Mapping[str, Any]], names: Sequence[str], stated: Sequence[object]
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
    units = np.array([mm_per_unit(stated[k]) or np.nan for k in order])
    if not np.all(scale > 0.0):
        stored.known = "the image has no scale"
    elif np.any(np.isnan(units)):
        stored.known = f"a scale of {' x '.join(f'{value:g}' for value in scale)} without a unit of length"
    else:
        stored.spacing_mm, stored.origin_mm = scale * units, shift * units


def _voxels(array: Any, names: Sequence[str], folder: str) -> Stored:
    """Return the array's z, y, x axes; other axes must have one entry."""
    if len(names) != array.ndim or not set(_SPACE) <= set(names):
        raise wrong_file("OME-Zarr image", f"{array.ndim} dimensions with axes {', '.join(names)}")
    sizes = dict(zip(names, array.shape, strict=True))
    extra = [f"{n} {axis}" for axis, n in sizes.items() if axis not in _SPACE and n > 1]
    if extra:
        raise several_values(f"{', '.join(extra)} (channels or times)")
    dtype = np.dtype(array.dtype)
    claimed = dtype.itemsize * prod(int(n) for n in array.chunks)
    if claimed > _MOST_CHUNK:
        raise wrong_file("OME-Zarr image", f"chunks of {claimed} bytes")
    stated = [axis for axis in names if axis in _SPACE]

    def read(box: Box) -> NDArray[Any]:
        along = dict(zip(_SPACE, box, strict=True))
        values = np.asarray(array[tuple(along.get(axis, 0) for axis in names)])
        return native(values.transpose([stated.index(axis) for axis in _SPACE]))

    stored = Stored(tuple(sizes[axis] for axis in _SPACE), dtype, read)
    stored.depth = max(1, min(int(array.chunks[names.index("z")]), int(sizes["z"])))
    missing = int(array.nchunks) - int(array.nchunks_initialized)
    if missing >= int(array.nchunks):
        raise wrong_file("OME-Zarr image", "metadata without a single chunk")
    if missing > 0:
        stored.note(
            f"{missing} of {array.nchunks} chunks of {folder} are not stored and count as "
            f"{float(array.fill_value or 0):g}: writers leave out empty chunks, but so does a broken copy."
        )
    return stored
