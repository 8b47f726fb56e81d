"""The grid that a header of NRRD, MetaImage, NIfTI, raw or another format describes, as a volume."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.checks import check_size, settle_spacing
from legacy.ct_inertia.readers.formats import ReadOptions
from legacy.ct_inertia.readers.memory_mapping import mapped
from legacy.ct_inertia.readers.refusals import header_fault, no_data_file, not_readable, not_three_dimensional
from legacy.ct_inertia.readers.streams import DECODERS
from legacy.ct_inertia.volume.lazy_arrays import BlockArray, scaled
from legacy.ct_inertia.volume.volume import Volume, unmirrored_frame
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

# Kinds of limits in readers.checks by the packing.
_LIMITS = {"gzip": "deflate", "zlib": "deflate", "HxByteRLE": "packbits"}
# Bytes of an unpacked stream before its voxels; headers have some thousands.
_MOST_SKIPPED = 1 << 30


@dataclass(frozen=True)
class Grid:
    """Where the voxels of a volume lie in its files, and where the volume lies in scan coordinates.

    Attributes
    ----------
    size : tuple of 3 int
        Voxels along x, y, z.
    dtype : dtype
        With its byte order.
    files : tuple of (Path, int)
        Files of equal numbers of slices in order, each with the offset of its first voxel; an offset of -1
        counts back from the end.
    spacing_mm : ndarray, (3,), or None
        None where the header does not have it.
    origin_mm : ndarray, (3,)
    direction : ndarray, (3, 3)
    packing : str
        ``raw``, or how the stream of voxels is unpacked: one of `streams.DECODERS`.
    anatomical : bool
        The header ties the axes to the patient.
    slope, intercept : float
        Grey value = slope * stored + intercept.
    layers : int
        Values per voxel, the fastest index; 1 but for layered segmentations.
    skip : int
        Bytes of the unpacked stream before the first voxel.
    slab : int
        Slices in each file but the last, which may hold fewer; 0: as many in each.
    known : str
        The part of an incomplete spacing that the header has, for the message.
    """

    size: tuple[int, int, int]
    dtype: np.dtype
    files: tuple[tuple[Path, int], ...]
    spacing_mm: Array | None
    origin_mm: Array = field(default_factory=lambda: np.zeros(3))
    direction: Array = field(default_factory=lambda: np.eye(3))
    packing: str = "raw"
    anatomical: bool = False
    slope: float = 1.0
    intercept: float = 0.0
    layers: int = 1
    skip: int = 0
    slab: int = 0
    known: str = ""
    notices: tuple[Notice, ...] = ()


def grid_volume(
    grid: Grid,
    path: Path,
    options: ReadOptions,
    array: NDArray[Any] | None = None,
) -> Volume:
    """Return the volume behind a header.

    ``options.mirror`` reverses the slices along one axis; on a left-handed grid that makes it right-handed.

    Raises
    ------
    CtInertiaError
        A file is missing or too short, no spacing, or a left-handed direction matrix without ``mirror``.
    """
    spacing, settled = settle_spacing(grid.spacing_mm, options.spacing_mm, path.name, grid.known)
    origin, direction, mirror = grid.origin_mm, grid.direction, options.mirror
    notices = [*grid.notices, *settled]
    if mirror is not None and np.linalg.det(direction) < 0.0:
        origin, direction = unmirrored_frame(origin, direction, np.array(grid.size), spacing, mirror)
        text = (
            f"The directions of {path.name} are left-handed, and {named('mirror')} {mirror} reversed its "
            f"slices. That is right only where the order of slices is wrong; where the directions are right, "
            f"the ear is a mirror image now. Check a known asymmetry in the report."
        )
        notices.append(Notice("handedness_unconfirmed", text))
        mirror = None
    voxels = grid_array(grid, path) if array is None else array
    return Volume(
        scaled(voxels, grid.slope, grid.intercept),
        spacing,
        origin,
        direction,
        grid.anatomical,
        path,
        notices=tuple(notices),
    ).mirrored(mirror)


def grid_array(grid: Grid, path: Path) -> NDArray[Any]:
    """Return the voxels [z, y, x] (with layers [z, y, x, layer]): memory-mapped, or unpacked in their type.

    Raises
    ------
    CtInertiaError
        A file is missing, too short or damaged, or the sizes are not those of a volume.
    """
    check_dimensions(grid.size, path.name)
    shape = grid.size[::-1] + ((grid.layers,) if grid.layers > 1 else ())
    for file, _ in grid.files:
        if not file.is_file():
            raise no_data_file(path, file)
    if len(grid.files) > 1:
        return _stack(grid, path)
    file, offset = grid.files[0]
    if grid.packing == "raw":
        return mapped(file, grid.dtype, offset, shape, path.name)
    return _unpack(file, offset, grid, shape, path)


def check_dimensions(size: Sequence[int], name: str) -> None:
    """Refuse sizes that are not those of a volume."""
    if len(size) != 3 or min(size) < 2:
        raise not_three_dimensional(name, size)


def _stack(grid: Grid, path: Path) -> NDArray[Any]:
    """Return slabs of a volume that lie in a file each, mapped when they are asked for."""
    nx, ny, nz = grid.size
    count = len(grid.files)
    depth = grid.slab or nz // max(count, 1)
    rest = nz - (count - 1) * depth
    if not 0 < rest <= depth or (rest != depth and not grid.slab) or grid.layers > 1:
        raise CtInertiaError.of(
            "the list of data files",
            f"files of equal numbers of the {nz} slices",
            f"{count} files",
            path.name,
            "Export the volume as one file",
        )
    shapes = [(depth, ny, nx)] * (count - 1) + [(rest, ny, nx)]
    if grid.packing == "raw":
        for shape, (file, offset) in zip(shapes, grid.files, strict=True):
            check_size(shape, grid.dtype, file.stat().st_size - max(offset, 0), file.name)

    def slab(z: int, _y: int, _x: int) -> NDArray[Any]:
        file, offset = grid.files[z]
        if grid.packing == "raw":
            return mapped(file, grid.dtype, offset, shapes[z], file.name)
        return _unpack(file, offset, grid, shapes[z], path)

    return BlockArray((nz, ny, nx), grid.dtype, (depth, ny, nx), slab).as_array()


def _unpack(file: Path, offset: int, grid: Grid, shape: Sequence[int], path: Path) -> NDArray[Any]:
    if grid.skip > _MOST_SKIPPED:
        raise header_fault(path, "header", f"voxels at byte {grid.skip}")
    stored = file.stat().st_size - max(offset, 0)
    check_size(
        shape, grid.dtype, stored, file.name, packing=_LIMITS.get(grid.packing, grid.packing), in_memory=True
    )
    array = np.empty(tuple(shape), dtype=grid.dtype)
    try:
        with file.open("rb") as stream:
            stream.seek(max(offset, 0))
            filled = DECODERS[grid.packing](stream, grid.skip, array.reshape(-1))
    except (OSError, EOFError, ValueError, zlib.error) as fault:
        raise not_readable(path, f"{grid.packing} file", fault) from fault
    if filled < array.nbytes:
        raise CtInertiaError.of(
            "the packed volume",
            f"complete ({array.nbytes} bytes of voxels)",
            f"{filled} bytes",
            path.name,
            "Copy or export it again",
        )
    return array
