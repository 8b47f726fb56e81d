"""The partial-volume integral: volume and moments of a body from grey values, without a threshold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.native import compiled
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array

# Voxels a piece: ten values each, 4 MB.
_PIECE = 50_000
# About how many voxels covariances are summed over, thinned evenly: a sum of so many is off by 0.3 % of the
# scatter of its terms.
_ENOUGH = 100_000


@dataclass(frozen=True)
class Share:
    """The grey values that belong to a body.

    Attributes
    ----------
    index : ndarray, (n, 3)
        Voxel indices x, y, z in the scan.
    grey : ndarray, (n,)
        Their grey values, other bodies subtracted.
    noise : ndarray, (n,)
        Standard deviation of each.
    air, bone, air_sd, bone_sd : float
        Grey levels and their standard uncertainty.
    sigma_mm, sigma_sd_mm : float
        Point spread (voxel included) and its standard uncertainty.
    correlation : float
        Variance of a sum of noise over that of independent noise; 1 for white noise.
    """

    index: Array
    grey: Array
    noise: Array
    air: float
    bone: float
    air_sd: float
    bone_sd: float
    sigma_mm: float
    sigma_sd_mm: float
    correlation: float = 1.0


def partial_volume_moments(share: Share, scan_from_index: Array) -> Moments:
    """Integrate w = (g - air) / (bone - air) over a body's voxels.

    Parameters
    ----------
    share : Share
    scan_from_index : ndarray, (4, 4)
        Index x, y, z to scan coordinates, mm.

    Returns
    -------
    Moments
        With contributions ``noise``, ``levels`` and ``psf``.

    Notes
    -----
    w is the body's indicator convolved with a point spread of unit integral. Its integral is the volume
    whatever the spread; its first moment too, for a symmetric spread; its second moments about the centroid
    are those of the body plus the volume times the spread's variance, which is subtracted. Sums over voxel
    centres are the integrals to within aliasing, for the spread acts as a low-pass filter; w is not
    clipped, for clipped noise does not average out.

    Contributions are linear. With f = (1, (r - c) / V, (r - c)(r - c)^T - s^2 1) the sensitivity of
    (V, c, S) to w of one voxel is its volume times f; noise enters voxel by voxel, the levels through
    dw/d(air) = -(1 - w) / (bone - air) and dw/d(bone) = -w / (bone - air) in all voxels at once. These sums
    are taken over some hundred thousand voxels, evenly picked: uncertainties are needed to a percent.
    """
    voxel = abs(float(np.linalg.det(scan_from_index[:3, :3])))
    axes = scan_from_index[:3, :3]
    middle = share.index.mean(axis=0)
    raw = voxel * _raw(share, axes, middle)
    volume = float(raw[0, 0])
    centroid = np.ascontiguousarray(raw[0, 1:] / volume)
    second = raw[1:, 1:] - volume * (np.outer(centroid, centroid) + share.sigma_mm**2 * np.eye(3))
    to_air, to_bone, noise = _answers(share, axes, middle, centroid, volume, voxel)
    to_air, to_bone = to_air * share.air_sd, to_bone * share.bone_sd
    to_sigma = np.zeros(10)
    to_sigma[4:7] = 2.0 * volume * share.sigma_mm * share.sigma_sd_mm
    contributions = {
        "noise": share.correlation * noise,
        "levels": np.outer(to_air, to_air) + np.outer(to_bone, to_bone),
        "psf": np.outer(to_sigma, to_sigma),
    }
    place = axes @ middle + scan_from_index[:3, 3] + centroid
    return Moments(volume, place, 0.5 * (second + second.T), contributions)


def _raw(share: Share, axes: Array, middle: Array) -> Array:
    """Return the sums of w p p^T with p = (1, place about the middle), (4, 4)."""
    kernels, contrast, raw = compiled(), share.bone - share.air, np.zeros((4, 4))
    if kernels is not None:
        index, grey, turn = _select(share.index, share.grey, axes)
        given = (index.ctypes.data, grey.ctypes.data, len(grey), turn.ctypes.data, middle.ctypes.data)
        kernels.raw_moments(*given, share.air, contrast, raw.ctypes.data)
        return raw
    for part in _pieces(len(share.grey)):
        points = np.empty((len(share.grey[part]), 4))
        points[:, 0] = 1.0
        points[:, 1:] = (share.index[part] - middle) @ axes.T
        w = (share.grey[part] - share.air) / contrast
        raw += (points * w[:, None]).T @ points
    return raw


def _answers(
    share: Share, axes: Array, middle: Array, centroid: Array, volume: float, voxel: float
) -> tuple[Array, Array, Array]:
    """Return how the moments answer to the levels of air and bone (10,), and to noise (10, 10)."""
    kernels, contrast = compiled(), share.bone - share.air
    noise, to_air, to_bone = np.zeros((10, 10)), np.zeros(10), np.zeros(10)
    step = max(1, len(share.grey) // _ENOUGH) | 1
    if kernels is not None:
        index, grey, own, turn = _select(share.index, share.grey, share.noise, axes)
        kernels.answers(
            *(index.ctypes.data, grey.ctypes.data, own.ctypes.data, len(grey), step),
            *(turn.ctypes.data, middle.ctypes.data, centroid.ctypes.data),
            *(volume, share.sigma_mm, voxel / contrast, share.air, contrast),
            *(to_air.ctypes.data, to_bone.ctypes.data, noise.ctypes.data),
        )
        return to_air, to_bone, noise
    for part in _pieces(len(share.grey), step):
        away = (share.index[part] - middle) @ axes.T - centroid
        f = sensitivity(away, volume, share.sigma_mm) * (voxel / contrast)
        w = (share.grey[part] - share.air) / contrast
        to_air += step * (f.T @ (1.0 - w))
        to_bone += step * (f.T @ w)
        f *= share.noise[part][:, None]
        noise += step * (f.T @ f)
    return to_air, to_bone, noise


def _select(*arrays: Array) -> list[Array]:
    return [np.ascontiguousarray(array, dtype=float) for array in arrays]


def _pieces(count: int, step: int = 1) -> list[slice]:
    """Return slices that fit the processor's cache, of every voxel or one in ``step``."""
    piece = _PIECE * step
    return [slice(k, min(k + piece, count), step) for k in range(0, count, piece)]


def sensitivity(away_mm: Array, volume_mm3: float, sigma_mm: float) -> Array:
    """Return d(V, c, S) per unit of volume added at points (n, 3) relative to the centroid, (n, 10)."""
    x, y, z = away_mm.T
    s2 = sigma_mm**2
    return np.column_stack(
        [
            np.ones(len(x)),
            away_mm / volume_mm3,
            x * x - s2,
            y * y - s2,
            z * z - s2,
            x * y,
            y * z,
            x * z,
        ]
    )


def voxel_effects(
    share: NDArray[np.float32],
    where: NDArray[np.bool_],
    first: NDArray[np.int64],
    volume: Volume,
    moments: Moments,
) -> tuple[Array, Array]:
    """Return the contribution of each voxel to (V, c, S), and its position from the centroid.

    Parameters
    ----------
    share : ndarray of float32, [z, y, x]
    where : ndarray of bool, [z, y, x]
        Voxels that count.
    first : ndarray of int, (3,)
        Index x, y, z in the volume of the first voxel.
    volume : Volume
    moments : Moments

    Returns
    -------
    effects : ndarray, (n, 10)
    away_mm : ndarray, (n, 3)
    """
    index = np.argwhere(where)
    away = volume.scan_points(index[:, ::-1] + first) - moments.centroid_mm
    amount = share[where].astype(float) * volume.voxel_mm3
    return sensitivity(away, moments.volume_mm3, 0.0) * amount[:, None], away


def by_octants(effects: Array, away_mm: Array) -> Array:
    """Return the covariance (10, 10) of effects (n, 10): common to an eighth, independent between eighths."""
    octant = (away_mm > np.median(away_mm, axis=0)) @ np.array([1, 2, 4])
    parts = np.array([effects[octant == part].sum(axis=0) for part in range(8)])
    return parts.T @ parts


def with_voxel_size(moments: Moments, relative_sd: float, origin_mm: Array) -> Moments:
    """Add the contribution of a voxel size known to ``relative_sd`` (one factor for all axes).

    Volume scales by 3, position by 1 and second moments by 5 times the relative error of the voxel.
    """
    second = moments.second_mm5
    step = relative_sd * np.array(
        [
            3.0 * moments.volume_mm3,
            *(moments.centroid_mm - origin_mm),
            *(5.0 * second[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]]),
        ]
    )
    return with_contribution(moments, "voxel_size", np.outer(step, step))


def with_contribution(moments: Moments, name: str, covariance: Array) -> Moments:
    """Return the moments with one more independent source of uncertainty, (10, 10)."""
    parts = {**moments.contributions, name: covariance}
    return Moments(moments.volume_mm3, moments.centroid_mm, moments.second_mm5, parts)


def as_vector(moments: Moments) -> Array:
    """Return (V, cx, cy, cz, Sxx, Syy, Szz, Sxy, Syz, Sxz)."""
    s = moments.second_mm5
    return np.array([moments.volume_mm3, *moments.centroid_mm, *s[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]]])
