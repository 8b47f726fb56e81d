"""The pose of one frame in another from paired points: weighted Kabsch, its covariance, target errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.fiducial_faults import Pairs, inconsistent, notices_of
from stapeskit.frames import RigidTransform, cross_matrix, vector_from_rotation
from stapeskit.paired_points import check_pairs, misfits, pose_rows
from stapeskit.warnings import Notice


@dataclass(frozen=True)
class Registration:
    """A fitted pose ``to_from_source``.

    Attributes
    ----------
    covariance_si : ndarray, (6, 6)
        Covariance of the small displacement e of the SOURCE frame in its own axes, about its own origin,
        m and rad, for which ``transform.perturbed(e)`` is the true pose.
    residuals_mm, sd_mm : ndarray, (n, 3) and (n,)
        Mapped source points minus target points, in target axes; standard deviation per coordinate of each
        pair's difference, as given, or estimated from the residuals.
    chi2
        Sum of (residual / sd)^2, NaN when the sd was estimated.
    """

    transform: RigidTransform
    covariance_si: Array
    residuals_mm: Array
    sd_mm: Array
    chi2: float
    n_dof: int
    notices: tuple[Notice, ...] = ()
    names: tuple[str, ...] = ()

    @property
    def rms_mm(self) -> float:
        """Root mean square length of the residuals, mm (the fiducial registration error)."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_mm**2, axis=1))))

    def target_registration_error(self, points_mm: ArrayLike) -> Array:
        """Return the expected root mean square error (n,), mm, of mapped points (n, 3) given in source mm.

        Fitzpatrick, West and Maurer 1998 (doi:10.1109/42.736021) give the same to first order for equal sd.
        """
        rows = pose_rows(1e-3 * np.atleast_2d(np.asarray(points_mm, dtype=float)))
        return 1e3 * np.sqrt(np.einsum("nij,jk,nik->n", rows, self.covariance_si, rows))


def fit_rigid(
    source_mm: ArrayLike,
    target_mm: ArrayLike,
    sd_mm: ArrayLike | None = None,
    *,
    to: str,
    source: str,
    names: Sequence[str] = (),
) -> Registration:
    """Fit the rigid transform that maps source points (n, 3) onto target points; never a reflection.

    ``sd_mm``, scalar or (n,), is the standard deviation per coordinate of the difference of a pair; else the
    residuals give it. The names of the two frames and of the pairs are for messages.

    Raises
    ------
    StapeskitError
        Fewer than 3 points, points on a line, numbers that are not finite, an sd that is not positive,
        sizes that differ (millimetres against metres), points that fit only as a mirror image (one set
        is left-handed), only with two names exchanged, or not within a millimetre.

    Notes
    -----
    With the model R (s + u + theta x s) + t the information matrix of (u, theta) is the sum of
    J^T J / sd^2, J = [1, -[s]x]; it is inverted about the centroid and shifted to the origin. With given sd
    and residuals too large for them (p < 0.001) the covariance grows with chi2 / n_dof.
    """
    first, second = np.asarray(source_mm, dtype=float), np.asarray(target_mm, dtype=float)
    check_pairs(first, second)
    labels = tuple(names) or tuple(str(place + 1) for place in range(len(first)))
    sd = np.array(np.broadcast_to(1.0 if sd_mm is None else np.asarray(sd_mm, dtype=float), len(first)))
    if not np.all((sd > 0.0) & np.isfinite(sd)):
        raise StapeskitError.of("sd_mm of a fiducial", "positive and finite", f"{np.min(sd):g}")
    weights = 1.0 / sd**2
    left, residuals, rotation = misfits(first, second, weights)
    shift = np.average(second - first @ rotation.T, axis=0, weights=weights)
    chi2, n_dof = float(left), 3 * len(first) - 6
    centred = second - second.mean(axis=0)
    flat_mm = float(np.max(np.abs(centred @ np.linalg.svd(centred)[2][2])))
    stated = sd_mm is not None
    notices = notices_of(Pairs(first, second, weights, chi2, flat_mm, stated, labels, source, to))
    scale = chi2 / n_dof if not stated or inconsistent(chi2, n_dof) else 1.0
    return Registration(
        RigidTransform.from_parts(rotation, shift, to, source),
        scale * _pose_covariance(first, weights),
        residuals,
        sd if stated else np.full(len(first), np.sqrt(chi2 / n_dof)),
        chi2 if stated else float("nan"),
        n_dof,
        tuple(notices),
        labels,
    )


def displacement(base: RigidTransform, moved: RigidTransform) -> Array:
    """Return the displacement e (6,), m and rad, for which ``base.perturbed(e)`` is ``moved``."""
    step = base.inverse().matrix @ moved.matrix
    return np.concatenate([step[:3, 3] * 1e-3, vector_from_rotation(step[:3, :3])])


def _pose_covariance(points_mm: Array, weights: Array) -> Array:
    """Return the covariance (6, 6), SI, of the displacement of the source frame; weights (n,), 1/mm2."""
    centre = weights @ points_mm / np.sum(weights) * 1e-3
    rows = pose_rows(points_mm * 1e-3 - centre)
    information = np.einsum("nji,n,njk->ik", rows, weights * 1e6, rows)
    scale = 1.0 / np.sqrt(np.diag(information))
    about_centre = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    move = np.eye(6)
    move[:3, 3:] = cross_matrix(centre)
    covariance = move @ about_centre @ move.T
    return np.asarray(0.5 * (covariance + covariance.T))
