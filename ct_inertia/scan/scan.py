"""The scan: a grid in scan coordinates and a function that reads a part of its grey values."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ct_inertia.scan.place import check_grey_values, nearest_rotation
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

Box = tuple[slice, slice, slice]
"""A part of the grid by index: slices along z, y, x, with positive steps."""

Fetch = Callable[[Box], NDArray[Any]]
"""Reads a box with whole, positive starts, stops and steps; returns a new array [z, y, x]."""

_SLAB_BYTES = 1 << 22  # read at a time: fewer are slower

LARGEST_GREY = 1e15
"""Squares of larger grey values, summed over a scan, overflow in single precision."""


@dataclass(frozen=True, eq=False)
class Scan:
    """Grey values or labels on a regular right-handed grid, read from their files when they are asked for.

    Attributes
    ----------
    shape : tuple of 3 int
        Number of voxels along z, y, x.
    dtype : dtype
        Of the values, in the byte order of the machine; integers or floating point numbers.
    spacing_mm : ndarray, (3,)
        Distance of voxel centres along x, y, z of the grid.
    fetch : callable
        Reads a box of the file; use `read`, which also takes care of non-finite voxels.
    origin_mm : ndarray, (3,)
        Scan coordinates of the CENTRE of the voxel with index 0, 0, 0.
    direction : ndarray, (3, 3)
        Columns: directions of the grid's x, y, z axes in scan coordinates; right-handed.
    source : Path or None
        The file or folder that was given.
    files : tuple of Path
        Every file that is read, the source first, for the provenance.
    notices : tuple of Notice
        What was turned, skipped or assumed while reading.
    segment_names : mapping of int to str
        Names of the numbers of a label volume, where its file has names.
    handedness_confirmed : bool
        The file says how its axes lie in the patient; otherwise the ear may be a mirror image.
    carries_place : bool
        Other programs read spacing, origin and direction of this format as they are read here.
    nan_as_air : bool
        Voxels that are not finite are read as `fill`; otherwise they are refused.
    chunk_planes : int
        Planes that are unpacked together: reading so many at a time unpacks every voxel once.

    Raises
    ------
    StapeskitError
        Not three-dimensional, no real numbers, no positive spacing, or directions that are sheared or
        left-handed.
    """

    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    spacing_mm: Array
    fetch: Fetch = field(repr=False)
    origin_mm: Array = field(default_factory=lambda: np.zeros(3))
    direction: Array = field(default_factory=lambda: np.eye(3))
    source: Path | None = None
    files: tuple[Path, ...] = ()
    notices: tuple[Notice, ...] = ()
    segment_names: Mapping[int, str] = field(default_factory=lambda: MappingProxyType({}))
    handedness_confirmed: bool = False
    carries_place: bool = False
    nan_as_air: bool = False
    chunk_planes: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        object.__setattr__(self, "dtype", np.dtype(self.dtype).newbyteorder("="))
        check_grey_values(self.shape, self.dtype, self.name)
        for name, least in (("spacing_mm", 0.0), ("origin_mm", -np.inf)):
            values = np.array(getattr(self, name), dtype=float)
            if values.shape != (3,) or not np.all((values > least) & (values < np.inf)):
                thing = "the voxel spacing" if name == "spacing_mm" else "the origin of the scan"
                step = "Correct the header, or give --spacing"
                raise StapeskitError.of(thing, "three proper numbers in mm", values, self.name, step)
            object.__setattr__(self, name, values)
        direction = nearest_rotation(np.array(self.direction, dtype=float), self.name)
        object.__setattr__(self, "direction", direction)

    @classmethod
    def from_array(cls, array: NDArray[Any], spacing_mm: ArrayLike, **fields: Any) -> Self:
        """Return a scan of an array [z, y, x] in memory; ``fields`` are further attributes of the scan."""
        native = array.dtype.newbyteorder("=")
        spacing = np.broadcast_to(np.asarray(spacing_mm, dtype=float), 3)
        return cls(array.shape, native, spacing, lambda box: array[box].astype(native, order="C"), **fields)

    @property
    def name(self) -> str:
        """Name of the file or folder for messages; empty for an array in memory."""
        return "" if self.source is None else self.source.name

    @property
    def size(self) -> NDArray[np.int64]:
        """Number of voxels along x, y, z."""
        return np.array(self.shape[::-1], dtype=np.int64)

    @property
    def voxel_mm3(self) -> float:
        """Volume of one voxel, mm3."""
        return float(np.prod(self.spacing_mm))

    @property
    def scan_from_index(self) -> Array:
        """Affine (4, 4) from an index (x, y, z) to scan coordinates, mm."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.direction * self.spacing_mm
        matrix[:3, 3] = self.origin_mm
        return matrix

    def scan_points(self, index_xyz: ArrayLike) -> Array:
        """Map indices (..., 3) in x, y, z to scan coordinates, mm."""
        return np.asarray(index_xyz, dtype=float) * self.spacing_mm @ self.direction.T + self.origin_mm

    def index_points(self, scan_mm: ArrayLike) -> Array:
        """Map scan coordinates (..., 3), mm, to fractional indices in x, y, z."""
        away = (np.asarray(scan_mm, dtype=float) - self.origin_mm) @ self.direction
        return np.asarray(away / self.spacing_mm)

    def read(self, box: Box | None = None) -> NDArray[Any]:
        """Read a part of the scan in its own type.

        The box (slices z, y, x) is clipped as numpy does; without it the whole scan is read. Returns a new
        array [z, y, x] in the byte order of the machine. Planes that steps leave out are not unpacked.

        Raises
        ------
        StapeskitError
            The file is damaged or too short there, or a voxel is not finite or too large to be squared
            (unless ``nan_as_air``).
        """
        values = self._fetch(self._ranges(box))
        return self._finite(values) if self.dtype.kind == "f" else values

    def slabs(self, planes: int = 1, box: Box | None = None) -> Iterator[tuple[int, NDArray[Any]]]:
        """Read a box slab by slab along z, so that the whole scan is never held.

        Yields the position of the slab's first plane among those of the box, and the slab [z, y, x] of so
        many planes, the last of fewer; some megabytes are read at a time, and whole `chunk_planes`.
        """
        every, *rest = self._ranges(box)
        plane = len(rest[0]) * len(rest[1]) * self.dtype.itemsize
        together = planes * max(-(-self.chunk_planes // planes), _SLAB_BYTES // max(planes * plane, 1))
        for first in range(0, len(every), together):
            values = self.read(_slices([every[first : first + together], *rest]))
            for k in range(0, len(values), planes):
                yield first + k, values[k : k + planes]

    def box_of(self, corners_mm: ArrayLike) -> Box:
        """Return the voxels whose centres lie between two corners x0, y0, z0, x1, y1, z1 in scan mm.

        Raises
        ------
        StapeskitError
            There are fewer than two along an axis.
        """
        corners = np.asarray(corners_mm, dtype=float).reshape(2, 3)
        index = self.index_points(list(product(*corners.T)))
        low = np.clip(np.ceil(index.min(axis=0) - 1e-6), 0, self.size).astype(int)
        high = np.clip(np.floor(index.max(axis=0) + 1e-6) + 1, 0, self.size).astype(int)
        if np.any(high - low < 2):
            ends = self.scan_points(np.array([0 * self.size, self.size - 1]))
            held, given = (",".join(f"{mm:.6g}" for mm in np.ravel(pair)) for pair in (ends, corners))
            wanted, step = f"a box in the scan ({held}, mm)", "Give two corners in scan coordinates, mm"
            raise StapeskitError.of("--box", wanted, given, self.name, step)
        return slice(low[2], high[2]), slice(low[1], high[1]), slice(low[0], high[0])

    def part(self, box: Box) -> Scan:
        """Return a box of the scan as a scan of its own, at its place; slices with steps make it coarser."""
        ranges = self._ranges(box)
        z, y, x = (len(along) for along in ranges)

        def fetch(inner: Box) -> NDArray[Any]:
            return self._fetch([along[asked] for along, asked in zip(ranges, inner, strict=True)])

        return replace(
            self,
            shape=(z, y, x),
            spacing_mm=self.spacing_mm * [along.step for along in ranges[::-1]],
            origin_mm=self.scan_points([along[0] for along in ranges[::-1]]),
            fetch=fetch,
        )

    @cached_property
    def fill(self) -> float:
        """Grey value that non-finite voxels are read as: the median of a subsample of the finite ones."""
        steps = [n // 40 + 1 for n in self.shape]
        ranges = [range(n // (2 * step), n, step) for n, step in zip(self.shape, steps, strict=True)]
        values = self._fetch(ranges)
        finite = values[np.abs(values) <= LARGEST_GREY]
        return float(np.median(finite)) if finite.size else 0.0

    def _ranges(self, box: Box | None) -> list[range]:
        """Return the indices of a box along z, y, x, clipped to the scan."""
        return [range(n)[along] for along, n in zip(box or (slice(None),) * 3, self.shape, strict=True)]

    def _fetch(self, ranges: Sequence[range]) -> NDArray[Any]:
        return self.fetch(_slices(ranges))

    def _finite(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return values as they are where all are proper numbers, which their extremes tell."""
        with np.errstate(invalid="ignore"):
            low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
        if low >= -LARGEST_GREY and high <= LARGEST_GREY:
            return values
        bad = ~(np.abs(values) <= LARGEST_GREY)
        if not self.nan_as_air:
            got = f"{int(bad.sum())} voxels of NaN or beyond {LARGEST_GREY:g}"
            step = "Replace them, or let them count as air with --nan-as-air"
            raise StapeskitError.of("the grey values", "finite", got, self.name, step)
        values[bad] = self.fill
        return values


def _slices(ranges: Sequence[range]) -> Box:
    z, y, x = (slice(along.start, along.stop, along.step) for along in ranges)
    return z, y, x


def block_means(scan: Scan, block: Sequence[int], box: Box) -> NDArray[np.float32]:
    """Average a box over blocks of so many voxels (x, y, z), a few planes at a time.

    The box has steps of 1 and holds a whole number of blocks. Sums over the means times the volume of a block
    are the sums over the voxels: the grey integral does not change, and its first moments only by what grey
    values vary within blocks.

    Raises
    ------
    StapeskitError
        A voxel cannot be read or is not finite.
    """
    bx, by, bz = (int(n) for n in block)
    means = []
    for _, slab in scan.slabs(bz, box):
        layer = reduce(np.add, slab[1:], slab[0].astype(np.float32))
        rows = reduce(np.add, (layer[k::by] for k in range(by)))
        means.append(reduce(np.add, (rows[:, k::bx] for k in range(bx))))
    return np.asarray(np.stack(means) / np.float32(bx * by * bz), dtype=np.float32)
