"""Paired points of two frames: checks, the least-squares pose between them, and its residuals."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.frames import cross_matrix

_THIN = 0.02  # of their extent: flatter points count as coplanar, since their mirror image fits as well
_FAMILIAR = ((1000.0, "m", "um"), (25.4, "inches", ""), (10.0, "cm", ""))


@dataclass(frozen=True)
class Pairs:
    """Paired points and the fit of them all.

    Attributes
    ----------
    source_mm, target_mm : ndarray, (n, 3)
    weights : ndarray, (n,)
        1 / sd^2, or ones.
    chi2 : float
        Weighted sum of squared residuals.
    flat_mm : float
        Largest distance of a target point from the best plane through all of them.
    stated : bool
        Whether the weights are absolute.
    mirrored : bool
        Whether a reflection would have fitted better.
    names : tuple of str
    source, to : str
        Names of the frames.
    """

    source_mm: Array
    target_mm: Array
    weights: Array
    chi2: float
    flat_mm: float
    stated: bool
    mirrored: bool
    names: tuple[str, ...]
    source: str
    to: str

    def __len__(self) -> int:
        return len(self.source_mm)

    @property
    def n_dof(self) -> int:
        """Degrees of freedom of the fit of all."""
        return 3 * len(self) - 6

    @property
    def coplanar(self) -> bool:
        """Whether a mirror image fits as well."""
        extent = float(np.max(np.linalg.norm(self.target_mm - self.target_mm.mean(axis=0), axis=1)))
        noise = 4.0 / np.sqrt(float(np.median(self.weights))) if self.stated else 0.0
        return len(self) < 4 or self.flat_mm < max(_THIN * extent, noise)

    def rms_mm(self, chi2: float) -> float:
        """Return the root mean square residual (of three coordinates) that belongs to a sum of squares."""
        return float(np.sqrt(3.0 * chi2 / np.sum(self.weights)))


def kabsch(
    source_mm: Array, target_mm: Array, weights: Array
) -> tuple[Array, Array, NDArray[np.bool_] | np.bool_]:
    """Return the rotation and shift of the weighted least-squares fit of one set of points, or of many.

    Parameters
    ----------
    source_mm, target_mm : ndarray, (..., n, 3)
    weights : ndarray, (..., n)

    Returns
    -------
    rotation : ndarray, (..., 3, 3)
        Proper.
    shift : ndarray, (..., 3)
        mm.
    mirrored : ndarray of bool, (...)
        Whether a reflection would have fitted better.

    Notes
    -----
    Kabsch 1976 (doi:10.1107/S0567739476001873) with the sign of Umeyama 1991 (doi:10.1109/34.88573).
    """
    share = (weights / np.sum(weights, axis=-1, keepdims=True))[..., None]
    source_centre, target_centre = (share.swapaxes(-1, -2) @ points for points in (source_mm, target_mm))
    cross = ((source_mm - source_centre) * share).swapaxes(-1, -2) @ (target_mm - target_centre)
    u, _, vt = np.linalg.svd(cross)
    mirrored = np.linalg.det(u) * np.linalg.det(vt) < 0.0
    u[..., 2] *= np.where(mirrored, -1.0, 1.0)[..., None]
    rotation = (u @ vt).swapaxes(-1, -2)
    return rotation, (target_centre - source_centre @ rotation.swapaxes(-1, -2))[..., 0, :], mirrored


def misfits(source_mm: Array, target_mm: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Return the sums of squares (...) that the best poses leave, residuals (..., n, 3) and rotations."""
    rotation, shift, _ = kabsch(source_mm, target_mm, weights)
    residuals = source_mm @ rotation.swapaxes(-1, -2) + shift[..., None, :] - target_mm
    return np.sum(weights[..., None] * residuals**2, axis=(-2, -1)), residuals, rotation


def pose_rows(points_m: Array) -> Array:
    """Return d(point)/d(displacement of its frame), (n, 3, 6), in the frame's own axes; points (n, 3), m."""
    return np.stack([np.hstack([np.eye(3), -cross_matrix(point)]) for point in points_m])


def check_pairs(source_mm: Array, target_mm: Array, source: str, to: str) -> None:
    """Refuse points that cannot be paired.

    Raises
    ------
    StapeskitError
        Fewer than 3 points, points on a line, numbers that are not finite, or distances that all differ by
        one factor beyond 1.5.
    """
    if (
        source_mm.ndim != 2
        or source_mm.shape[1:] != (3,)
        or source_mm.shape != target_mm.shape
        or len(source_mm) < 3
    ):
        got = f"{len(source_mm)} and {len(target_mm)} points"
        raise StapeskitError.of(
            "a registration", "made from at least 3 paired points", got, "", "Add fiducials"
        )
    if not (np.all(np.isfinite(source_mm)) and np.all(np.isfinite(target_mm))):
        raise StapeskitError.of("the coordinates of fiducials", "finite", "NaN or infinity")
    for points in (source_mm, target_mm):
        size = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if size[1] < 1e-3 * size[0] or size[0] == 0.0:
            want, step = "spread over a plane, not along a line", "Add a fiducial off the line"
            raise StapeskitError.of("fiducials", want, "points on one line", "", step)
    if sizes_differ(source_mm, target_mm, alike=True):
        raise size_error(source_mm, target_mm, source, to)


def sizes_differ(source_mm: Array, target_mm: Array, alike: bool = False) -> bool:
    """Return whether distances differ by half or more; ``alike``: whether by one common factor."""
    ratios = _distance_ratios(source_mm, target_mm)
    median = float(np.median(ratios))
    differ = not 1.0 / 1.5 < median < 1.5
    return differ and (not alike or bool(np.mean(np.abs(ratios / median - 1.0) < 0.1) > 0.8))


def size_error(source_mm: Array, target_mm: Array, source: str, to: str) -> StapeskitError:
    """Return the error on points whose distances differ; a factor that units make is named."""
    ratio = float(np.median(_distance_ratios(source_mm, target_mm)))
    return StapeskitError.of(
        f"the fiducials of the {source} and {to} frames",
        "both in mm, with the same distances between them",
        f"distances that are {ratio:.4g} times as large in the {source} frame",
        next_step=unit_hint(ratio, source, to) or "Check which fiducial is which, and the units",
    )


def unit_hint(ratio: float, source: str, to: str) -> str:
    """Name the mixed-up unit when sizes differ by a factor that units make; empty otherwise."""
    for factor, small, large in _FAMILIAR:
        for value, one, other in ((ratio / factor, to, source), (ratio * factor, source, to)):
            if abs(value - 1.0) < 0.2:
                also = f", or those of the {other} frame in {large}" if large else ""
                return f"The {one} coordinates seem to be in {small}{also}"
    return ""


def _distance_ratios(source_mm: Array, target_mm: Array) -> Array:
    """Return every distance between two source points over that between their targets."""
    pairs = np.array(list(combinations(range(len(source_mm)), 2)))
    first, second = (
        np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) for points in (source_mm, target_mm)
    )
    return np.asarray(first / np.maximum(second, 1e-300))
