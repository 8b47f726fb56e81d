"""The surface that the footplate frame is found on: the half level of the share of bone, coarse."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.grey.thin_walls import thin_wall_shift, vertex_normals
from legacy.ct_inertia.surface.isosurface import iso_surface
from legacy.ct_inertia.surface.surface import Surface
from legacy.ct_inertia.volume.grid_operations import gaussian
from legacy.ct_inertia.volume.normal_distribution import normal_quantile
from legacy.stapeskit.arrays import Array

# Largest blocks, mm: the scale of the normals in the definition of the frame (footplate_face).
_GRID_MM = 0.05
# Standard deviation of the smoothing where blocks would be single voxels, in voxels: about the least that
# leaves no stairs. It counts as blur, as blocks do.
_SMOOTH_VOXELS = 0.7
# Shares nearer than this to 0 and 1 are held at its quantile (2.05 standard deviations of the blur): beyond,
# noise is larger than what is left of the edge.
_LEAST_SHARE = 0.02
_CHORDS = calibrated("frame_surface.chords")
# Standard deviation of the shift at thin walls, as a share of it; a mean shift below this needs none.
_WALL_SD = calibrated("frame_surface.wall_sd")
_THIN_WALLS_MM = calibrated("frame_surface.thin_walls_mm")


class FrameSurface(NamedTuple):
    """A surface, the blur with which it is seen, mm, and how far its vertices were moved at thin walls."""

    surface: Surface
    blur_mm: float
    wall_shift_mm: Array


def frame_surface(share: NDArray[np.float32], scan_from_index: Array, sigma_mm: float) -> FrameSurface:
    """Return the half level of a body's share of bone, moved outward where walls are thin.

    Parameters
    ----------
    share : ndarray of float32, [z, y, x]
        1 inside the body, 0 outside, blurred.
    scan_from_index : ndarray, (4, 4)
        Index x, y, z to scan coordinates, mm.
    sigma_mm : float
        Standard deviation of the blur of the share, its voxels included.

    Notes
    -----
    Grey values are averaged over blocks of at most 0.05 mm, or smoothed by 0.7 voxels where a voxel is
    coarser than half of that; both widen the blur by what is known. The quantile of the normal
    distribution makes a blurred edge a straight line along its normal, so that linear interpolation
    between the coarse voxels meets the half level exactly where the surface is plane. Where it is curved,
    straight edges of the grid and flat triangles cut corners, as a blur with the variance 0.2 h^2 would at a
    spacing h (found on balls of every size; linear interpolation between points errs by h^2 / 12 times the
    curvature on average). That is counted as blur.
    """
    part, transform, variance = coarse_share(share, scan_from_index)
    surface = iso_surface(straightened(part), 0.0, transform)
    normals = vertex_normals(surface)
    shift = thin_wall_shift(surface, normals, part, transform, float(np.sqrt(sigma_mm**2 + variance)))
    return FrameSurface(_lift(surface, shift, normals), blur_on_grid(sigma_mm, transform, variance), shift)


def coarse_share(
    share: NDArray[np.float32], scan_from_index: Array
) -> tuple[NDArray[np.float32], Array, float]:
    """Return a share of bone on blocks or smoothed, its grid's transform (4, 4), and the variance added."""
    spacing = np.linalg.norm(scan_from_index[:3, :3], axis=0)
    block = _blocks(spacing)
    first, part = _crop_to_bone(share, block)
    if np.any(block > 1):
        part = _block_means(part, block)
        variance = spacing**2 * (block**2 - 1.0) / 12.0
    else:
        part = gaussian(part, _SMOOTH_VOXELS, truncate=3.0)
        variance = (_SMOOTH_VOXELS * spacing) ** 2
    transform = np.array(scan_from_index, dtype=float)
    transform[:3, :3] = scan_from_index[:3, :3] * block
    transform[:3, 3] = scan_from_index[:3, 3] + scan_from_index[:3, :3] @ (first + 0.5 * (block - 1.0))
    return part, transform, float(variance.mean())


def straightened(part: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the quantiles of a share: straight lines across its edges, 0 at the half level."""
    edge = (part > _LEAST_SHARE) & (part < 1.0 - _LEAST_SHARE)
    limit = float(normal_quantile(_LEAST_SHARE))
    steep = np.where(part > 0.5, np.float32(-limit), np.float32(limit))
    steep[edge] = normal_quantile(part[edge])
    return steep


def blur_on_grid(sigma_mm: float, transform: Array, variance_mm2: float) -> float:
    """Return the blur of a surface on a grid: of the scan, of blocks or smoothing, of chords of curves."""
    chords = _CHORDS * float(np.mean(np.sum(transform[:3, :3] ** 2, axis=0)))
    return float(np.sqrt(sigma_mm**2 + variance_mm2 + chords))


def _lift(surface: Surface, shift_mm: Array, normals: Array) -> Surface:
    return Surface(surface.vertices_mm + shift_mm[:, None] * normals, surface.faces)


def height_noise_of(noise: float, correlation: float, scan_from_index: Array, blur_mm: float) -> float:
    """Return the spectral density of the height noise that shared noise of the grey values makes, mm4.

    That is what the frame surface has at long waves beyond what white noise would give it.

    Parameters
    ----------
    noise : float
        Standard deviation of the share of bone in one voxel.
    correlation : float
        Variance of sums of noise over that of white noise.
    scan_from_index : ndarray, (4, 4)
        Index x, y, z to scan coordinates, mm.
    blur_mm : float
        As ``frame_surface`` returns it.

    Notes
    -----
    Noise of standard deviation s has at long waves the spectral density s^2 c V in space, c the correlation
    and V the volume of a voxel, (c - 1) / c of it more than white noise; on a surface it is 1 / L of that, L
    the length over which noise is averaged along the normal: blocks or smoothing, and its own correlation. A
    share that errs by e moves the half level by e over the slope 1 / (sqrt(2 pi) blur).
    """
    shared = max(correlation - 1.0, 0.0)
    spacing = np.linalg.norm(scan_from_index[:3, :3], axis=0)
    block = _blocks(spacing)
    size = float(np.prod(spacing))
    mean = (
        float(np.prod(block)) ** (1.0 / 3.0) if np.any(block > 1) else 2.0 * np.sqrt(np.pi) * _SMOOTH_VOXELS
    )
    length = size ** (1.0 / 3.0) * np.sqrt(mean**2 + (1.0 + shared) ** (2.0 / 3.0) - 1.0)
    return float(noise**2 * shared * size / length * 2.0 * np.pi * blur_mm**2)


def _blocks(spacing_mm: Array) -> NDArray[np.int64]:
    """Return over how many voxels along x, y, z grey values are averaged."""
    return np.maximum(np.floor(_GRID_MM / spacing_mm + 1e-6), 1.0).astype(np.int64)


def doubted_surface(
    share: NDArray[np.float32],
    doubt: NDArray[np.float32] | None,
    scan_from_index: Array,
    sigma_mm: float,
    known: FrameSurface,
) -> Surface | None:
    """Return the surface a standard deviation away: of what is soft around it, and of the shift at walls.

    ``doubt`` is by how much the share may be wrong. None where nothing soft was subtracted and no wall is
    thin.
    """
    if doubt is not None:
        known = frame_surface(share + doubt, scan_from_index, sigma_mm)
    elif float(np.mean(known.wall_shift_mm)) < _THIN_WALLS_MM:
        return None
    return _lift(known.surface, _WALL_SD * known.wall_shift_mm, vertex_normals(known.surface))


def _crop_to_bone(share: NDArray[np.float32], block: NDArray[np.int64]) -> tuple[Array, NDArray[np.float32]]:
    """Return the first index of the box in whole blocks that holds bone with air around, and its share."""
    inside = share > 0.1
    first, box, missing = [], [], []
    for axis in range(3):
        size = int(block[2 - axis])
        place = np.flatnonzero(inside.any(axis=tuple(k for k in range(3) if k != axis)))
        low = max(int(place[0]) - 2 * size, 0) if len(place) else 0
        count = -(-((int(place[-1]) if len(place) else 0) + 1 + 2 * size - low) // size)
        first.append(low)
        box.append(slice(low, low + count * size))
        missing.append((0, max(low + count * size - share.shape[axis], 0)))
    part = share[tuple(box)]
    if any(after for _, after in missing):
        part = np.pad(part, missing)
    return np.array(first[::-1], dtype=float), part


def _block_means(part: NDArray[np.float32], block: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return means over blocks of x, y, z voxels, axis after axis."""
    for axis in range(3):
        size = int(block[2 - axis])
        if size > 1:
            shape = (*part.shape[:axis], part.shape[axis] // size, size, *part.shape[axis + 1 :])
            part = part.reshape(shape).mean(axis=axis + 1, dtype=np.float32)
    return part
