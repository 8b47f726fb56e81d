"""Exact distances from a mask up to a cap: cheap when only a rim of a few voxels matters."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.native import checked, compiled, shape_of
from legacy.ct_inertia.volume.grid_operations import used_box
from legacy.stapeskit.arrays import Array

# Voxels a piece: 0.2 to 0.8 MB by the type of the counts.
_PIECE = 200_000
# Relative difference up to which spacings are equal, and squared distances are counted in whole voxels.
_SAME = 1e-9


def closed(mask: NDArray[np.bool_], spacing_mm: Array, radius_mm: float) -> NDArray[np.bool_]:
    """Return a mask [z, y, x] with what a closing by a ball adds: gaps and holes narrower than the ball."""
    cap = radius_mm + float(np.max(spacing_mm))
    wide = capped_distance(mask, spacing_mm, cap) <= radius_mm
    return np.asarray(mask | (capped_distance(~wide, spacing_mm, cap) > radius_mm))


def capped_distance(mask: NDArray[np.bool_], spacing_mm: Array, cap_mm: float) -> NDArray[np.float32]:
    """Return the distance of each voxel to the nearest voxel of the mask, at most ``cap_mm``.

    Parameters
    ----------
    mask : ndarray of bool, [z, y, x]
    spacing_mm : ndarray, (3,)
        Along x, y, z.
    cap_mm : float

    Returns
    -------
    ndarray of float32, [z, y, x]
        Between voxel centres, mm; 0 in the mask.

    Notes
    -----
    Squared distances are separable: a minimum over shifted parabolas is taken along x, y and z (Felzenszwalb
    and Huttenlocher 2012, doi:10.4086/toc.2012.v008a019), only over the few shifts that stay below the cap,
    only within the cap of the mask, and in pieces that fit the processor's cache. Cubic voxels are counted in
    whole numbers, as short as the cap allows.
    """
    result = np.full(mask.shape, cap_mm, dtype=np.float32)
    used = used_box(mask)
    if used is None:
        return result
    steps = [int(cap_mm / float(h)) for h in spacing_mm]
    box = tuple(slice(max(0, s.start - n), s.stop + n) for s, n in zip(used, steps[::-1], strict=True))
    unit, dtype, far = _scale(np.asarray(spacing_mm, dtype=float), steps, cap_mm)
    parabolas = [(np.arange(n + 1) ** 2 * u).astype(dtype) for n, u in zip(steps, unit, strict=True)]
    edge = np.float32(spacing_mm[0] if dtype.kind == "u" else 1.0)

    kernels = compiled()
    if kernels is not None:
        result[box] = _by_kernel(kernels, mask[box], steps, unit, (dtype, far, edge, cap_mm))
        return result
    inside, within = mask[box], result[box]
    squares = np.empty(inside.shape, dtype=dtype)
    depth, height, width = inside.shape
    # Pieces of some layers: small enough for the cache, large enough that other threads seldom interrupt.
    deep = max(1, _PIECE // (height * width))
    for start in range(0, depth, deep):
        layers = inside[start : start + deep]
        # Columns beyond the last keep the rows apart, so that one shift of all voxels does.
        padded = np.full((*layers.shape[:2], width + steps[0]), far, dtype=dtype)
        np.copyto(padded[:, :, :width], dtype.type(0), where=layers)
        _transform_along(padded.reshape(-1), 0, parabolas[0])
        part = np.ascontiguousarray(padded[:, :, :width])
        _transform_along(part, 1, parabolas[1])
        squares[start : start + deep] = part
    high = max(1, _PIECE // (depth * width))
    for start in range(0, height, high):
        piece = np.ascontiguousarray(squares[:, start : start + high])
        _transform_along(piece, 0, parabolas[2])
        roots = np.sqrt(piece, dtype=np.float32)
        roots *= edge
        np.minimum(roots, np.float32(cap_mm), out=within[:, start : start + high])
    return result


def _by_kernel(
    kernels: Any,
    mask: NDArray[np.bool_],
    steps: list[int],
    unit: Array,
    scale: tuple[np.dtype[Any], Any, np.float32, float],
) -> NDArray[np.float32]:
    dtype, far, edge, cap_mm = scale
    kernel = kernels.capped_whole if dtype.kind == "u" else kernels.capped_float
    mask = np.ascontiguousarray(mask)
    result = np.empty(mask.shape, dtype=np.float32)
    reach, square = np.array(steps, dtype=np.int64), np.ascontiguousarray(unit, dtype=float)
    given = (mask.ctypes.data, shape_of(mask), reach.ctypes.data, square.ctypes.data)
    checked(kernel(*given, float(far), float(edge), cap_mm, result.ctypes.data))
    return result


def _scale(spacing_mm: Array, steps: list[int], cap_mm: float) -> tuple[Array, np.dtype[Any], Any]:
    """Return the square of a voxel along x, y, z as counted, the type of counts, and one beyond the cap."""
    if float(np.ptp(spacing_mm)) <= _SAME * float(spacing_mm[0]):
        far = int(np.ceil((cap_mm / float(spacing_mm[0])) ** 2 * 1.002)) + 1
        for dtype in (np.dtype(np.uint8), np.dtype(np.uint16)):
            if far + steps[0] ** 2 <= np.iinfo(dtype).max:
                return np.ones(3), dtype, dtype.type(far)
    return np.square(spacing_mm), np.dtype(np.float32), np.float32(cap_mm**2 * 1.002)


def _transform_along(square: NDArray[Any], axis: int, squares: NDArray[Any]) -> None:
    """Replace squared distances by their minimum over shifted parabolas along an axis, in place."""
    source, raised = square.copy(), np.empty_like(square)
    ahead: list[slice] = [slice(None)] * square.ndim
    back: list[slice] = [slice(None)] * square.ndim
    for k in range(1, min(square.shape[axis], len(squares))):
        np.add(source, squares[k], out=raised)
        ahead[axis], back[axis] = slice(k, None), slice(None, -k)
        np.minimum(square[tuple(ahead)], raised[tuple(back)], out=square[tuple(ahead)])
        np.minimum(square[tuple(back)], raised[tuple(ahead)], out=square[tuple(back)])
