"""The volume: grey values on a grid, and where that grid lies in scan coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.volume.lazy_arrays import part_of
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

# Largest error of the products of direction vectors: files round cosines to four or more digits, and shear
# above it would move points of a stapes by more than 0.3 um.
_ORTHONORMAL = 1e-4
_AXES = "xyz"


@dataclass(frozen=True)
class Volume:
    """Grey values with their place in scan coordinates.

    Attributes
    ----------
    array : ndarray, memmap or BlockArray, [z, y, x]
        Grey values in the type of the file; never copied to float as a whole. Index it with slices: a block
        array reads and unpacks what is asked for.
    spacing_mm : ndarray, (3,)
        Distance of voxel centres along x, y, z of the array.
    origin_mm : ndarray, (3,)
        Scan coordinates of the CENTRE of the voxel with index 0, 0, 0.
    direction : ndarray, (3, 3)
        Columns: directions of the array's x, y, z axes in scan coordinates; right-handed.
    handedness_confirmed : bool
        The file says how its axes lie in the patient; otherwise a stack may be a mirror image.
    source : Path or None
    nan_as_air : bool
        Voxels that are not finite count as air; otherwise they are refused.
    notices : tuple of Notice
    segment_names : mapping of int to str
        Names of the numbers of a label volume, where its file has names.

    Raises
    ------
    CtInertiaError
        Not three-dimensional, complex, no positive spacing, or a direction matrix that is not orthonormal
        or is left-handed.
    """

    array: NDArray[Any]
    spacing_mm: Array
    origin_mm: Array
    direction: Array
    handedness_confirmed: bool = False
    source: Path | None = None
    nan_as_air: bool = False
    notices: tuple[Notice, ...] = ()
    segment_names: Mapping[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        where = "" if self.source is None else Path(self.source).name
        _check_array(self.array, where)
        spacing = np.array(self.spacing_mm, dtype=float)
        if spacing.shape != (3,) or not np.all(np.isfinite(spacing)) or np.any(spacing <= 0.0):
            raise CtInertiaError.of(
                "the voxel spacing",
                "three positive numbers in mm",
                spacing.tolist(),
                where,
                "Give it with {spacing}",
            )
        origin = np.array(self.origin_mm, dtype=float)
        if origin.shape != (3,) or not np.all(np.isfinite(origin)):
            raise CtInertiaError.of(
                "the origin of the volume",
                "three numbers in mm",
                origin.tolist(),
                where,
                next_step="Export it again",
            )
        direction = _right_handed(np.array(self.direction, dtype=float), where)
        for name, value in (("spacing_mm", spacing), ("origin_mm", origin), ("direction", direction)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @property
    def size(self) -> NDArray[np.int64]:
        """Number of voxels along x, y, z."""
        return np.array(self.array.shape[::-1], dtype=np.int64)

    @property
    def voxel_mm3(self) -> float:
        """Volume of one voxel, mm3."""
        return float(np.prod(self.spacing_mm))

    @property
    def scan_from_index(self) -> Array:
        """Affine 4x4 from an index (x, y, z) to scan coordinates, mm."""
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

    def cropped(self, box_mm: ArrayLike) -> Volume:
        """Return the part of the volume between two corners x0, y0, z0, x1, y1, z1 in scan mm.

        Raises
        ------
        CtInertiaError
            The box holds fewer than two voxels along an axis.
        """
        corners = np.asarray(box_mm, dtype=float).reshape(2, 3)
        grid = np.stack(np.meshgrid(*corners.T, indexing="ij"), axis=-1).reshape(-1, 3)
        index = self.index_points(grid)
        low = np.clip(np.ceil(index.min(axis=0) - 1e-6), 0, self.size - 1).astype(np.int64)
        high = np.clip(np.floor(index.max(axis=0) + 1e-6) + 1, 0, self.size).astype(np.int64)
        if np.any(high - low < 2):
            far = self.scan_points(self.size - 1)
            raise CtInertiaError.of(
                "{box}",
                f"a box that overlaps the scan ({_format_numbers(self.origin_mm)} to "
                f"{_format_numbers(far)} mm)",
                f"{_format_numbers(corners[0])} to {_format_numbers(corners[1])} mm",
                next_step="Give two corners in scan coordinates, mm",
            )
        z, y, x = (slice(int(a), int(b)) for a, b in zip(low[::-1], high[::-1], strict=True))
        return replace(self, array=part_of(self.array, (z, y, x)), origin_mm=self.scan_points(low))

    def mirrored(self, axis: str | None) -> Volume:
        """Reverse the slices along the array's ``x``, ``y`` or ``z`` axis; None leaves them as they are.

        The volume keeps its place: origin, spacing and direction stay, the content is reflected inside
        the same box.

        Raises
        ------
        CtInertiaError
            ``axis`` is none of x, y, z.
        """
        return self if axis is None else replace(self, array=reversed_axis(self.array, axis))


def unmirrored_frame(
    origin_mm: Array, direction: Array, size: Array, spacing_mm: Array, axis: str
) -> tuple[Array, Array]:
    """Return origin and direction that make a left-handed grid right-handed by turning one axis round.

    The array stays as it is, so that its content is reflected inside the same box: what reversing the
    slices does to a right-handed grid.

    Parameters
    ----------
    origin_mm, size, spacing_mm : ndarray, (3,)
        Of the left-handed grid; x, y, z.
    direction : ndarray, (3, 3)
    axis : str
        ``x``, ``y`` or ``z``.
    """
    k = _AXES.index(axis)
    turned = np.array(direction, dtype=float)
    turned[:, k] = -turned[:, k]
    return origin_mm + direction[:, k] * (size[k] - 1) * spacing_mm[k], turned


def reversed_axis(array: NDArray[Any], axis: str) -> NDArray[Any]:
    """Return a view of an array [z, y, x] with its x, y or z axis reversed."""
    check_axis(axis)
    every = [slice(None)] * 3
    every[2 - _AXES.index(axis)] = slice(None, None, -1)
    return part_of(array, (every[0], every[1], every[2]))


def check_axis(axis: str) -> None:
    """Refuse what is not the name of an axis.

    Raises
    ------
    CtInertiaError
        ``axis`` is none of x, y, z.
    """
    if axis not in tuple(_AXES):
        raise CtInertiaError.of("{mirror}", "x, y or z", axis, next_step="Name one of the three axes")


def _format_numbers(values: Array) -> str:
    return ", ".join(f"{v:.6g}" for v in values)


def _check_array(array: NDArray[Any], where: str) -> None:
    if np.iscomplexobj(array):
        raise CtInertiaError.of(
            "the volume", "real grey values", "complex numbers", where, "Export the magnitude"
        )
    if array.ndim == 4 and array.shape[-1] in (3, 4) and array.dtype == np.uint8:
        raise CtInertiaError.of(
            "the volume", "grey values", "a colour (RGB) image", where, "Export it as grey values"
        )
    if array.ndim != 3 or min(array.shape) < 2:
        raise CtInertiaError.of(
            "the volume",
            "three-dimensional",
            f"an image of shape {' x '.join(map(str, array.shape[::-1]))}",
            where,
            "Give the whole stack, or the folder of slices",
        )
    if array.dtype.kind not in "uif" or array.dtype.itemsize > 8:
        raise CtInertiaError.of(
            "the grey values",
            "integers or floating point numbers",
            array.dtype,
            where,
            next_step="Export it as grey values",
        )


def _right_handed(direction: Array, where: str) -> Array:
    if direction.shape != (3, 3) or not np.all(np.isfinite(direction)):
        raise CtInertiaError.of(
            "the direction matrix", "a finite 3x3 matrix", direction, where, next_step="Export it again"
        )
    if np.max(np.abs(direction.T @ direction - np.eye(3))) > _ORTHONORMAL:
        raise CtInertiaError.of(
            "the direction matrix",
            "orthonormal (no shear)",
            np.round(direction, 6).tolist(),
            where,
            "Resample the volume onto a rectangular grid",
        )
    if np.linalg.det(direction) < 0.0:
        raise CtInertiaError.of(
            "the direction matrix",
            "right-handed (determinant +1)",
            f"the left-handed {np.round(direction, 6).tolist()}",
            where,
            "Save it with right-handed axes, which keeps every place (nibabel.as_closest_canonical, "
            "fslswapdim); only where its slice order itself is wrong, reverse it with {mirror} x, y or z",
        )
    # Headers hold six digits or so; the nearest rotation makes the matrix orthonormal to rounding.
    u, _, vt = np.linalg.svd(direction)
    return np.asarray(u @ vt)
