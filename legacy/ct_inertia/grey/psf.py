"""The scanner's blur, read off the edges of the bone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.native import compiled, shape_of
from legacy.ct_inertia.volume.grid_operations import interpolated
from legacy.ct_inertia.volume.mask_statistics import places_between
from legacy.ct_inertia.volume.normal_distribution import normal_density, normal_quantile
from legacy.stapeskit.arrays import Array

# Reach of the Gaussian gradient in its standard deviations: 0.03 % of its weight is cut off.
_REACH_WIDTHS = 3.6
# Most edge voxels that are measured: for time only.
_MOST = 4_000
_LEAST = calibrated("psf.least_edges")
_FLAT = calibrated("psf.flat")
# Distance along an edge, in its own widths, at which its curvature is read.
_BESIDE = 2.5
_BENT_SD = calibrated("psf.bent_sd")
_IN_COMMON = calibrated("psf.edges_in_common")
_MODEL_SD = calibrated("psf.model_sd")
_TOO_SHARP, _TOO_SHARP_SD = calibrated("psf.too_sharp")


def edge_sigma(
    grey: NDArray[np.float32],
    near_edge: NDArray[np.bool_],
    air: float,
    bone: float,
    spacing_mm: Array,
    noise: float = 0.0,
    seed: int = 0,
    most: int = _MOST,
) -> tuple[float, float] | None:
    """Estimate the standard deviation of the point spread (voxel included) from edges of bone in air.

    Parameters
    ----------
    grey : ndarray of float32, [z, y, x]
    near_edge : ndarray of bool, [z, y, x]
        Where to look; voxels of middle grey value are taken from it.
    air, bone : float
        Grey levels.
    spacing_mm : ndarray, (3,)
    noise : float
        Standard deviation of a voxel, in shares of bone minus air.
    seed : int
        Of the choice among many voxels.
    most : int
        How many voxels to look at.

    Returns
    -------
    sigma_mm, sd_mm : float
        None when there are too few clean edges.

    Notes
    -----
    Across a plane edge blurred by a Gaussian, w = Phi(d / s) and |grad w| = phi(d / s) / s, so that every
    voxel near the middle gives s = phi(Phi^-1(w)) / |grad w|. w and its gradient are taken with a Gaussian
    of known width, whose variance is subtracted. Edges that do not reach bone on one side and air on the
    other within a few widths (thin walls, corners, gaps) are left out, and curved ones too where there are
    enough flat ones: a radius of curvature R lets s seem longer by the order of (s / R)^2. Beside a flat
    edge, 2.5 s along its tangents, the share is still 1/2.
    """
    edges = _clean_edges(grey, near_edge, (air, bone), spacing_mm, noise, seed, most)
    if edges is None:
        return None
    total, bent, width = edges.total_mm, edges.bent, edges.smoothing_mm
    variance = np.median(total) ** 2 - width**2
    if not variance > 0.0:
        return _TOO_SHARP * width, _TOO_SHARP_SD * width
    sigma = float(np.sqrt(variance))
    low_part, high_part = np.percentile(total, [25.0, 75.0])
    several = max(len(total) / _IN_COMMON, 1.0)
    sd = 0.5 * float(high_part - low_part) / np.sqrt(several) + _MODEL_SD * float(np.median(edges.every_mm))
    # What bent edges add to the width: with a curvature k some (k s)^2 of it, of which ``bent`` is a measure.
    sd += _BENT_SD * float(np.median(bent)) ** 2 * float(np.median(edges.every_mm))
    return sigma, sd * float(np.median(edges.every_mm)) / sigma


@dataclass(frozen=True)
class _Edges:
    """Clean edges of bone in air: their width with the smoothing (n,).

    ``bent`` (n,) is their curvature, ``every_mm`` the widths of all edges, ``smoothing_mm`` the width of the
    Gaussian that grey values were smoothed by.
    """

    total_mm: Array
    bent: Array
    every_mm: Array
    smoothing_mm: float


@dataclass(frozen=True)
class Candidates:
    """Voxels near the middle of an edge, clean or not.

    Attributes
    ----------
    places_mm : ndarray, (n, 3)
        Along z, y, x from the first voxel of the box.
    inward : ndarray, (n, 3)
        Unit normals z, y, x.
    total_mm : ndarray, (n,)
        Width of the edge, smoothing included.
    quantile : ndarray, (n,)
        Distance of the voxel from the surface, inwards, in these widths.
    spacing_mm : ndarray, (3,)
        Along z, y, x.
    smoothing_mm : float
        Width of the Gaussian that grey values were smoothed by.
    """

    places_mm: Array
    inward: Array
    total_mm: Array
    quantile: Array
    spacing_mm: Array
    smoothing_mm: float


def candidate_edges(
    grey: NDArray[np.float32],
    near_edge: NDArray[np.bool_],
    levels: tuple[float, float],
    spacing_mm: Array,
    noise: float,
    seed: int,
    most: int,
) -> Candidates | None:
    """Measure width and normal at voxels of middle grey value; None where there are too few.

    Parameters as for ``edge_sigma``.
    """
    spacing = np.asarray(spacing_mm)[::-1]
    width = float(spacing.mean())
    reach = np.ceil(_REACH_WIDTHS * width / spacing).astype(int)
    index = _find_middle_grey(grey, near_edge, levels, reach)
    if len(index) < _LEAST:
        return None
    if len(index) > most:
        index = index[np.random.default_rng(seed).choice(len(index), most, replace=False)]
    w, gradient, spread = _smooth_gradient(grey, index, levels, spacing, width, reach)
    size = np.linalg.norm(gradient, axis=1)
    # Noise lengthens every gradient: its share of the square is known for white noise.
    size = np.sqrt(np.maximum(size**2 - noise**2 * spread, 1e-12))
    good = (np.abs(w - 0.5) < 0.25) & (size > 0.05 / width)
    w, size, gradient, index = w[good], size[good], gradient[good], index[good]
    if len(w) < _LEAST:
        return None
    z = normal_quantile(w)
    total = normal_density(z) / size
    inward = gradient / np.linalg.norm(gradient, axis=1)[:, None]
    return Candidates(index * spacing, inward, total, z, spacing, width)


def _clean_edges(
    grey: NDArray[np.float32],
    near_edge: NDArray[np.bool_],
    levels: tuple[float, float],
    spacing_mm: Array,
    noise: float,
    seed: int,
    most: int,
) -> _Edges | None:
    air, bone = levels
    edges = candidate_edges(grey, near_edge, levels, spacing_mm, noise, seed, most)
    if edges is None:
        return None
    total, inward, spacing = edges.total_mm, edges.inward, edges.spacing_mm
    middle = float(np.median(total))
    foot = edges.places_mm - edges.quantile[:, None] * middle * inward

    def share_at(points: Array) -> Array:
        return np.asarray((interpolated(grey, points / spacing) - air) / (bone - air))

    low, high, deep = (share_at(foot + reach * middle * inward) for reach in (-2.6, 2.6, 3.6))
    slack = max(0.15, 2.5 * noise)
    clean = (np.abs(low) < slack) & (np.abs(high - 1.0) < slack) & (np.abs(deep - 1.0) < slack)
    if np.count_nonzero(clean) < _LEAST:
        clean = np.abs(low) < slack + 0.05
    if np.count_nonzero(clean) < _LEAST:
        return None
    bent = np.zeros(len(foot))
    for tangent in tangents(inward):
        beside = [share_at(foot + sign * _BESIDE * middle * tangent) for sign in (-1.0, 1.0)]
        bent = np.maximum(bent, np.abs(0.5 * (beside[0] + beside[1]) - 0.5))
    flat = clean & (bent < max(_FLAT, 1.2 * noise))
    if np.count_nonzero(flat) >= 2 * _LEAST:
        clean = flat
    return _Edges(total[clean], bent[clean], total, edges.smoothing_mm)


def _find_middle_grey(
    grey: NDArray[np.float32],
    near_edge: NDArray[np.bool_],
    levels: tuple[float, float],
    reach: NDArray[np.int_],
) -> NDArray[np.int64]:
    """Return the places z, y, x of voxels of middle grey value, away from the border of the box."""
    air, bone = levels
    low, high = air + 0.2 * (bone - air), air + 0.8 * (bone - air)
    return places_between(grey, near_edge, min(low, high), max(low, high), reach)


def _smooth_gradient(
    grey: NDArray[np.float32],
    index: NDArray[np.int64],
    levels: tuple[float, float],
    spacing: Array,
    width: float,
    reach: NDArray[np.int_],
) -> tuple[Array, Array, float]:
    """Return share (n,) and its gradient (n, 3) per mm, smoothed by a Gaussian of deviation ``width``.

    The third value is the variance of the gradient per variance of white noise.
    """
    air, bone = levels
    offsets = [np.arange(-r, r + 1) for r in reach]
    pairs = []
    for o, h in zip(offsets, spacing, strict=True):
        k = np.exp(-0.5 * (o * h / width) ** 2)
        pairs.append(np.column_stack([k / k.sum(), k * (o * h) / (k @ (o * h) ** 2)]))
    every = _smooth(grey, index, pairs, reach)
    w, gradient = (every[:, 0] - air) / (bone - air), every[:, 1:] / (bone - air)
    square = [(pair**2).sum(axis=0) for pair in pairs]
    spread = sum(float(np.prod([square[m][1 if m == axis else 0] for m in range(3)])) for axis in range(3))
    return w, gradient, spread


def _smooth(
    grey: NDArray[np.float32], index: NDArray[np.int64], pairs: list[Array], reach: NDArray[np.int_]
) -> Array:
    """Return the value and its slopes along z, y, x at places, (n, 4), by weights (k, 2) for each axis."""
    kernels = compiled()
    if kernels is not None:
        grey = np.ascontiguousarray(grey)
        place = np.ascontiguousarray(index, dtype=np.int64)
        wide = np.ascontiguousarray(reach, dtype=np.int64)
        weights = np.concatenate([pair.T.ravel() for pair in pairs])
        smoothed = np.empty((len(place), 4))
        kernels.smooth_slopes(
            *(grey.ctypes.data, shape_of(grey), place.ctypes.data, len(place), wide.ctypes.data),
            *(weights.ctypes.data, smoothed.ctypes.data),
        )
        return smoothed
    offsets = [np.arange(-r, r + 1) for r in reach]
    blocks = grey[
        (index[:, 0, None] + offsets[0])[:, :, None, None],
        (index[:, 1, None] + offsets[1])[:, None, :, None],
        (index[:, 2, None] + offsets[2])[:, None, None, :],
    ].astype(float)
    along_yx = np.einsum("nijc,jb->nibc", blocks @ pairs[2], pairs[1], optimize=True)
    every = np.einsum("nibc,ia->nabc", along_yx, pairs[0], optimize=True)
    return np.stack([every[:, 0, 0, 0], every[:, 1, 0, 0], every[:, 0, 1, 0], every[:, 0, 0, 1]], axis=1)


def tangents(normal: Array) -> tuple[Array, Array]:
    """Return two unit vectors (n, 3) across each normal (n, 3) and each other."""
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(normal, axis)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return first, np.cross(normal, first)
