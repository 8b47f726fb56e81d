"""The pose of one frame in another from paired points: weighted Kabsch, its covariance, target errors."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinematics.errors import KinematicsError, sentence
from kinematics.frames import RigidTransform, cross_matrix, vector_from_rotation
from kinematics.notices import Notice

Array = NDArray[np.float64]
_THIN = 0.02
_INCONSISTENT = 1e-3
_NOTICEABLE_MM = 0.05


@dataclass(frozen=True)
class Registration:
    """A fitted pose ``to_from_source``.

    Attributes
    ----------
    transform : RigidTransform
        Maps source coordinates to target coordinates (mm).
    covariance_si : ndarray, (6, 6)
        Covariance of the small displacement e of the SOURCE frame in its own axes, about its own origin,
        (x, y, z in m, alpha, beta, gamma in rad), for which ``transform.perturbed(e)`` is the true pose.
    residuals_mm : ndarray, (n, 3)
        Mapped source points minus target points, in target axes.
    sd_mm : ndarray, (n,)
        Standard deviation per coordinate of each point: as given, or estimated from the residuals.
    chi2, n_dof : float, int
        Sum of (residual / sd)^2 and 3 n - 6; chi2 is NaN when the sd was estimated.
    flat_mm : float
        Largest distance of a target point from the best plane through all of them.
    notices : tuple of Notice
        ``fiducials_coplanar``, ``fiducials_inconsistent``.
    """

    transform: RigidTransform
    covariance_si: Array
    residuals_mm: Array
    sd_mm: Array
    chi2: float
    n_dof: int
    flat_mm: float
    notices: tuple[Notice, ...] = field(default=())

    @property
    def rms_mm(self) -> float:
        """Root mean square length of the residuals, mm (the fiducial registration error)."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_mm**2, axis=1))))

    def target_covariance(self, points_mm: ArrayLike) -> Array:
        """Return the covariance (n, 3, 3), m2, in target axes, of mapped points (n, 3), source mm."""
        points = np.atleast_2d(np.asarray(points_mm, dtype=float)) * 1e-3
        jacobian = np.stack([np.hstack([np.eye(3), -cross_matrix(point)]) for point in points])
        jacobian = self.transform.rotation @ jacobian
        return np.asarray(jacobian @ self.covariance_si @ jacobian.transpose(0, 2, 1))

    def target_registration_error(self, points_mm: ArrayLike) -> Array:
        """Return the expected root mean square error (n,), mm, of mapped points (n, 3) given in source mm.

        Notes
        -----
        Fitzpatrick, West and Maurer 1998 (doi:10.1109/42.736021) give the same to first order for equal sd.
        """
        variance = np.trace(self.target_covariance(points_mm), axis1=1, axis2=2)
        return np.asarray(np.sqrt(variance) * 1e3)


def displacement(base: RigidTransform, moved: RigidTransform) -> Array:
    """Return the displacement e (6,), m and rad, for which ``base.perturbed(e)`` is ``moved``."""
    step = base.inverse().matrix @ moved.matrix
    return np.concatenate([step[:3, 3] * 1e-3, vector_from_rotation(step[:3, :3])])


def kabsch(source_mm: Array, target_mm: Array, weights: Array) -> tuple[Array, Array, bool]:
    """Return the proper rotation (3, 3) and the translation (3,), mm, of the weighted least-squares fit.

    The third value tells whether a reflection would have fitted better.

    Notes
    -----
    Kabsch 1976 (doi:10.1107/S0567739476001873) with the sign of Umeyama 1991 (doi:10.1109/34.88573).
    """
    share = weights / np.sum(weights)
    source_centre, target_centre = share @ source_mm, share @ target_mm
    cross = ((source_mm - source_centre) * share[:, None]).T @ (target_mm - target_centre)
    u, _, vt = np.linalg.svd(cross)
    mirrored = bool(np.linalg.det(u) * np.linalg.det(vt) < 0.0)
    sign = np.diag([1.0, 1.0, -1.0 if mirrored else 1.0])
    rotation = vt.T @ sign @ u.T
    return rotation, target_centre - rotation @ source_centre, mirrored


def fit_rigid(
    source_mm: ArrayLike,
    target_mm: ArrayLike,
    sd_mm: ArrayLike | None = None,
    *,
    to: str,
    source: str,
    names: tuple[str, ...] = (),
) -> Registration:
    """Fit the rigid transform that maps source points onto target points; never a reflection.

    Parameters
    ----------
    source_mm, target_mm : array_like, (n, 3)
        Paired points, mm, in the frames ``source`` and ``to``; at least 3, not on a line.
    sd_mm : array_like, scalar or (n,), optional
        Standard deviation per coordinate of the difference of a pair, mm. Estimated from the residuals
        when not given.
    to, source : str
        Names of the two frames.
    names : tuple of str, optional
        Names of the pairs, for messages.

    Raises
    ------
    KinematicsError
        Fewer than 3 points, points on a line, numbers that are not finite, an sd that is not positive, or
        points that fit only as a mirror image (one set is left-handed).

    Notes
    -----
    With the model R (s + u + theta x s) + t the information matrix of (u, theta) is the sum of
    w J^T J, J = [1, -[s]x], w = 1/sd^2; it is inverted about the centroid and shifted to the origin.
    With given sd and residuals too large for them (p < 0.001) the covariance grows with chi2 / n_dof;
    without, one fiducial far off the others (p < 0.001 and 0.05 mm) is told.
    """
    a, b = np.asarray(source_mm, dtype=float), np.asarray(target_mm, dtype=float)
    _check_pairs(a, b)
    sd = None if sd_mm is None else np.broadcast_to(np.asarray(sd_mm, dtype=float), (len(a),))
    if sd is not None and not (np.all(np.isfinite(sd)) and np.all(sd > 0.0)):
        raise KinematicsError(sentence("sd_mm of a fiducial", "positive and finite", float(np.min(sd))))
    weights = np.ones(len(a)) if sd is None else 1.0 / sd**2
    rotation, shift, mirrored = kabsch(a, b, weights)
    residuals = a @ rotation.T + shift - b
    n_dof = 3 * len(a) - 6
    typical = 0.0 if sd is None else float(np.median(sd))
    flat, extent = _flatness(b)
    coplanar = len(a) < 4 or flat < max(_THIN * extent, 4.0 * typical)
    if mirrored and not coplanar:
        _refuse_mirror(a, b, weights, residuals, source)
    chi2 = float("nan")
    notices = [_coplanar_notice(len(a), flat)] if coplanar else []
    if sd is None:
        sd = np.full(len(a), np.sqrt(np.sum(residuals**2) / n_dof))
        scale = float(sd[0] ** 2)
        notices += _outlier_notice(a, b, names, float(np.sum(residuals**2)))
    else:
        chi2 = float(np.sum((residuals / sd[:, None]) ** 2))
        scale = 1.0
    if chi2 > _chi2_limit(n_dof):
        scale = chi2 / n_dof
        notices.append(_inconsistent_notice(a, b, weights, residuals, names, scale))
    transform = RigidTransform.from_parts(rotation, shift, to, source)
    covariance = scale * _pose_covariance(a * 1e-3, weights * 1e6)
    return Registration(transform, covariance, residuals, np.array(sd), chi2, n_dof, flat, tuple(notices))


def _check_pairs(a: Array, b: Array) -> None:
    if a.ndim != 2 or a.shape[1:] != (3,) or a.shape != b.shape or len(a) < 3:
        raise KinematicsError(
            sentence(
                "a registration",
                "made from at least 3 paired points",
                f"{len(a)} and {len(b)} points",
                next_step="Add fiducials",
            )
        )
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
        raise KinematicsError(sentence("the coordinates of fiducials", "finite", "NaN or infinity"))
    for points in (a, b):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] < 1e-3 * spread[0] or spread[0] == 0.0:
            raise KinematicsError(
                sentence(
                    "fiducials",
                    "spread over a plane at least",
                    "points on one line",
                    next_step="Add a fiducial beside the line",
                )
            )


def _flatness(points: Array) -> tuple[float, float]:
    """Return the largest distance from the best plane and the largest distance from the centroid, mm."""
    centred = points - points.mean(axis=0)
    normal = np.linalg.svd(centred)[2][2]
    return float(np.max(np.abs(centred @ normal))), float(np.max(np.linalg.norm(centred, axis=1)))


def _pose_covariance(points_m: Array, weights: Array) -> Array:
    centre = weights @ points_m / np.sum(weights)
    rows = np.concatenate([np.hstack([np.eye(3), -cross_matrix(p - centre)]) for p in points_m])
    information = rows.T @ (np.repeat(weights, 3)[:, None] * rows)
    scale = 1.0 / np.sqrt(np.diag(information))
    about_centre = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    shift = np.eye(6)
    shift[:3, 3:] = cross_matrix(centre)
    covariance = shift @ about_centre @ shift.T
    return np.asarray(0.5 * (covariance + covariance.T))


def _refuse_mirror(a: Array, b: Array, weights: Array, residuals: Array, source: str) -> None:
    flipped = a * np.array([1.0, 1.0, -1.0])
    rotation, shift, _ = kabsch(flipped, b, weights)
    proper = float(np.sqrt(np.mean(residuals**2) * 3.0))
    mirror = float(np.sqrt(np.mean((flipped @ rotation.T + shift - b) ** 2) * 3.0))
    if mirror < 0.5 * proper:
        raise KinematicsError(
            sentence(
                f"the coordinates of the {source} frame",
                "right-handed",
                f"points that fit only as a mirror image (residual {proper:.3g} mm as given, "
                f"{mirror:.3g} mm mirrored)",
                next_step="Undo the mirrored axis with --mirror x, y or z (scanning heads often count one "
                "axis the other way)",
            )
        )


def _coplanar_notice(count: int, flat: float) -> Notice:
    why = f"only {count} fiducials" if count < 4 else f"all fiducials within {flat:.3g} mm of one plane"
    return Notice(
        "fiducials_coplanar",
        f"{why}: a mirrored coordinate system would fit as well; add a fiducial off the plane.",
    )


def _chi2_limit(n_dof: int) -> float:
    from scipy.special import chdtri

    return float(chdtri(n_dof, _INCONSISTENT))


def _left_out(a: Array, b: Array, weights: Array) -> tuple[Array, Array]:
    """Return, without each point in turn, the weighted sum of squares and how far that point lies, mm."""
    energies, distances = np.zeros(len(a)), np.zeros(len(a))
    for out in range(len(a)):
        keep = np.arange(len(a)) != out
        rotation, shift, _ = kabsch(a[keep], b[keep], weights[keep])
        rest = a @ rotation.T + shift - b
        energies[out] = np.sum(weights[keep, None] * rest[keep] ** 2)
        distances[out] = np.linalg.norm(rest[out])
    return energies, distances


def _outlier_notice(a: Array, b: Array, names: tuple[str, ...], energy: float) -> list[Notice]:
    """Judge the worst fiducial against the others, whose scatter is the only scale when no sd is stated.

    Notes
    -----
    F test of the three coordinates of one fiducial that its removal takes out of the residual, corrected for
    the number of fiducials (Cook and Weisberg 1982, Residuals and Influence in Regression, section 2.2).
    """
    from scipy.special import fdtrc

    freedom = 3 * len(a) - 9
    if len(a) < 4:
        return []
    energies, distances = _left_out(a, b, np.ones(len(a)))
    worst = int(np.argmin(energies))
    others = max(float(energies[worst]), 1e-24) / freedom
    p = len(a) * float(fdtrc(3, freedom, max(energy - energies[worst], 0.0) / 3.0 / others))
    if p > _INCONSISTENT or distances[worst] < _NOTICEABLE_MM:
        return []
    name = names[worst] if names else str(worst + 1)
    text = (
        f"fiducial {name} lies {distances[worst]:.3g} mm from where the others put it, which scatter by "
        f"{np.sqrt(others) * 1e3:.2g} um; check its coordinates or leave it out."
    )
    return [Notice("fiducials_inconsistent", text)]


def _inconsistent_notice(
    a: Array, b: Array, weights: Array, residuals: Array, names: tuple[str, ...], scale: float
) -> Notice:
    worst = int(np.argmax(np.sum(residuals**2, axis=1) * weights))
    if len(a) > 4:
        worst = int(np.argmin(_left_out(a, b, weights)[0]))
    name = names[worst] if names else str(worst + 1)
    return Notice(
        "fiducials_inconsistent",
        f"the fiducials disagree by {np.sqrt(scale):.1f} times their sd_mm, {name} most; the covariance of "
        "the registration was enlarged accordingly.",
    )
