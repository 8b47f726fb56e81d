"""The partial-volume integral: volume and moments of a body from grey values, without a threshold."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Grey, Mask, Moments
from stapeskit.arrays import Array

_ENOUGH = 30_000  # voxels that a covariance is summed over, evenly picked: off by 0.6 %
ROWS, COLUMNS = np.array([0, 1, 2, 0, 1, 0]), np.array([0, 1, 2, 1, 2, 2])
"""Of the six entries of a symmetric matrix in the order of second moments."""


def partial_volume_moments(share: Grey, scan_from_index: Array, spread_mm2: Array) -> Moments:
    """Integrate the share of a body [z, y, x] over its voxels.

    Parameters
    ----------
    share : ndarray of float32, [z, y, x]
        The body's blurred share, not clipped, 0 in voxels that are not its own.
    scan_from_index : ndarray, (4, 4)
        Index x, y, z to scan coordinates, mm.
    spread_mm2 : ndarray, (3, 3)
        Covariance of the blur in scan axes, voxel included.

    Returns
    -------
    Moments
        Without contributions.

    Raises
    ------
    StapeskitError
        The shares sum to no positive volume.

    Notes
    -----
    A share is the body's indicator convolved with a point spread of unit integral. Its integral is the volume
    whatever the spread; its first moment too, for a symmetric spread; its second moments about the centroid
    are those of the body plus the volume times the spread's variance, which is subtracted. Sums over voxel
    centres are the integrals to within aliasing, for the spread acts as a low-pass filter. Shares are not
    clipped, for clipped noise does not average out.
    """
    about = scan_from_index[:3, :3] @ (0.5 * np.array(share.shape[::-1])) + scan_from_index[:3, 3]
    total = integrals(share, scan_from_index, about)
    volume, arm = float(total[0]), total[1:4] / max(float(total[0]), 1e-30)
    second = symmetric(total[4:]) - volume * (np.outer(arm, arm) + spread_mm2)
    return Moments(volume, about + arm, second)


def integrals(amount: Grey, scan_from_index: Array, about_mm: Array) -> Array:
    """Return the integrals (10,) of 1, d, dd^T (xx, yy, zz, xy, yz, xz) times an amount; d from a point.

    Notes
    -----
    Sums over each axis leave three planes, whose moments are those of the volume.
    """
    size = amount.shape
    planes = [np.sum(amount, axis=axis, dtype=np.float64) for axis in range(3)]
    z, y, x = (np.arange(n) - 0.5 * (n - 1) for n in size)
    along = {"z": planes[2].sum(axis=1), "y": planes[2].sum(axis=0), "x": planes[1].sum(axis=0)}
    total = float(along["z"].sum())
    first = np.array([x @ along["x"], y @ along["y"], z @ along["z"]])
    xy, yz, xz = y @ planes[0] @ x, z @ planes[2] @ y, z @ planes[1] @ x
    square = np.array([[x**2 @ along["x"], xy, xz], [xy, y**2 @ along["y"], yz], [xz, yz, z**2 @ along["z"]]])
    axes = scan_from_index[:3, :3]
    voxel = abs(float(np.linalg.det(axes)))
    middle = scan_from_index[:3, 3] + axes @ (0.5 * (np.array(size[::-1]) - 1.0)) - about_mm
    turned = axes @ first
    second = axes @ square @ axes.T + np.outer(turned, middle) + np.outer(middle, turned)
    second += total * np.outer(middle, middle)
    return voxel * np.array([total, *(turned + total * middle), *second[ROWS, COLUMNS]])


def effect(amount: Grey, scan_from_index: Array, moments: Moments) -> Array:
    """Return the change of (V, c, S), (10,), by a small change of the share in each voxel."""
    total = integrals(amount, scan_from_index, moments.centroid_mm)
    return np.concatenate([total[:1], total[1:4] / moments.volume_mm3, total[4:]])


def common(amount: Grey, scan_from_index: Array, moments: Moments) -> Array:
    """Return the covariance (10, 10) of an amount that is wrong by its own size everywhere alike."""
    step = effect(amount, scan_from_index, moments)
    return np.outer(step, step)


def octants(shape: tuple[int, ...], scan_from_index: Array, moments: Moments) -> list[tuple[slice, ...]]:
    """Return the eight parts of an array [z, y, x] around the centroid, as slices with both ends."""
    back = np.linalg.inv(scan_from_index)
    index = back[:3, :3] @ moments.centroid_mm + back[:3, 3]
    middle = np.clip(np.rint(index[::-1]).astype(int), 1, np.array(shape) - 1)
    halves = [(slice(0, int(m)), slice(int(m), n)) for m, n in zip(middle, shape, strict=True)]
    return list(product(*halves))


def by_octants(amount: Grey, scan_from_index: Array, moments: Moments) -> Array:
    """Return the covariance (10, 10) of an amount wrong by its size, each eighth of the space by itself."""
    covariance = np.zeros((10, 10))
    for part in octants(amount.shape, scan_from_index, moments):
        moved = scan_from_index.copy()
        moved[:3, 3] += scan_from_index[:3, :3] @ np.array([along.start for along in part[::-1]])
        covariance += common(amount[part], moved, moments)
    return covariance


def noise_covariance(
    noise: float, where: Mask, scan_from_index: Array, moments: Moments, sigma_mm: float
) -> Array:
    """Return the covariance (10, 10) of independent noise in the voxels of a mask; ``noise`` is a share.

    Notes
    -----
    With f = (1, (r - c) / V, (r - c)(r - c)^T - s^2 1) the sensitivity of (V, c, S) to the share of one voxel
    is its volume times f.
    """
    place = np.flatnonzero(where)
    step = max(1, place.size // _ENOUGH) | 1
    index = np.stack(np.unravel_index(place[::step], where.shape)[::-1], axis=1)
    rows = moments.sensitivity(index @ scan_from_index[:3, :3].T + scan_from_index[:3, 3], sigma_mm)
    voxel = abs(float(np.linalg.det(scan_from_index[:3, :3])))
    return np.asarray(step * (noise * voxel) ** 2 * rows.T @ rows)


def blur_covariance(moments: Moments, sigma_mm: float, sd: float) -> Array:
    """Return the covariance (10, 10) of an uncertain blur: it enters second moments only.

    Parameters
    ----------
    sigma_mm, sd : float
        Width of the blur and its relative standard deviation along any direction.

    Notes
    -----
    Half of the variance is common to all directions, half is that of a random symmetric matrix, whose
    entries off the diagonal have half the variance of those on it, in whatever axes.
    """
    square = 0.5 * (2.0 * moments.volume_mm3 * sigma_mm**2 * sd) ** 2
    covariance = np.zeros((10, 10))
    covariance[4:7, 4:7] = square * (np.ones((3, 3)) + np.eye(3))
    covariance[7:, 7:] = 0.5 * square * np.eye(3)
    return covariance


def voxel_moments(mask: NDArray[np.bool_], scan_from_index: Array) -> Moments:
    """Return the exact moments of a solid made of voxels, with the second moments of each brick."""
    axes = scan_from_index[:3, :3]
    points = partial_volume_moments(mask.astype(np.float32), scan_from_index, np.zeros((3, 3)))
    brick = points.volume_mm3 * axes @ axes.T / 12.0
    return Moments(points.volume_mm3, points.centroid_mm, points.second_mm5 + brick)


def symmetric(six: Array) -> Array:
    """Return the symmetric matrix (3, 3) of the entries 00, 11, 22, 01, 12, 02."""
    matrix = np.zeros((3, 3))
    matrix[ROWS, COLUMNS] = matrix[COLUMNS, ROWS] = six
    return matrix
