"""The pose of one frame in another from paired points: weighted Kabsch, its covariance, target errors."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from legacy.stapeskit.alignment.fiducial_faults import (
    check_size,
    clear_improvement_limit,
    explanations,
    fault_notices,
    inconsistent,
    refuse_exchanged,
    refuse_mirrored,
)
from legacy.stapeskit.alignment.paired_points import kabsch, pair_weights, pose_covariance, pose_rows, refined
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.frames import RigidTransform, vector_from_rotation
from legacy.stapeskit.warnings import Notice

# Points thinner than this share of their extent count as coplanar: their mirror image fits as well.
_THIN = 0.02


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
        Standard deviation per coordinate of each point (root mean square over the axes): as given, or
        estimated from the residuals.
    chi2, n_dof : float, int
        Sum of (residual / sd)^2 and 3 n - 6; chi2 is NaN when the sd was estimated.
    flat_mm : float
        Largest distance of a target point from the best plane through all of them.
    notices : tuple of Notice
        ``fiducials_coplanar``, ``fiducials_inconsistent``.
    kind : str
        What was fitted: ``fiducials``, ``plate points`` ...
    plane_mm : (ndarray (3,), ndarray (3,)) or None
        Centroid and normal of the best plane through the target points.
    names : tuple of str, (n,)
        Names of the pairs; empty for points without.
    """

    transform: RigidTransform
    covariance_si: Array
    residuals_mm: Array
    sd_mm: Array
    chi2: float
    n_dof: int
    flat_mm: float
    notices: tuple[Notice, ...] = field(default=())
    kind: str = "fiducials"
    plane_mm: tuple[Array, Array] | None = None
    names: tuple[str, ...] = ()

    @property
    def rms_mm(self) -> float:
        """Root mean square length of the residuals, mm (the fiducial registration error)."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_mm**2, axis=1))))

    def target_covariance(self, points_mm: ArrayLike) -> Array:
        """Return the covariance (n, 3, 3), m2, in target axes, of mapped points (n, 3), source mm."""
        points = np.atleast_2d(np.asarray(points_mm, dtype=float)) * 1e-3
        jacobian = self.transform.rotation @ pose_rows(points)
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


def fit_rigid(
    source_mm: ArrayLike,
    target_mm: ArrayLike,
    sd_mm: ArrayLike | None = None,
    *,
    to: str,
    source: str,
    names: tuple[str, ...] = (),
    target_sd_mm: ArrayLike | None = None,
) -> Registration:
    """Fit the rigid transform that maps source points onto target points; never a reflection.

    Parameters
    ----------
    source_mm, target_mm : array_like, (n, 3)
        Paired points, mm, in the frames ``source`` and ``to``; at least 3, not on a line.
    sd_mm : array_like, scalar, (n,) or (n, 3), optional
        Standard deviation of the source points, mm: per coordinate, or along each source axis. Alone, it
        is that of the difference of a pair. Estimated from the residuals when no sd is given.
    to, source : str
        Names of the two frames.
    names : tuple of str, optional
        Names of the pairs, for messages.
    target_sd_mm : array_like, scalar, (n,) or (n, 3), optional
        The same of the target points, along target axes; none: they are exact.

    Raises
    ------
    StapeskitError
        Fewer than 3 points, points on a line, numbers that are not finite, an sd that is not positive,
        sizes that differ (millimetres against metres), points that fit only as a mirror image (one set
        is left-handed), or only with names exchanged.

    Notes
    -----
    With the model R (s + u + theta x s) + t the information matrix of (u, theta) is the sum of
    J^T W J, J = [1, -[s]x], W the inverse covariance of a pair's difference; it is inverted about the
    centroid and shifted to the origin. With given sd and residuals too large for them (p < 0.001) the
    covariance grows with chi2 / n_dof; the fault that explains the misfit best is named.
    """
    a, b = np.asarray(source_mm, dtype=float), np.asarray(target_mm, dtype=float)
    _check_pairs(a, b)
    check_size(a, b, source, to)
    stated = sd_mm is not None or target_sd_mm is not None
    source_var, target_var = (_variances(sd, len(a)) for sd in (sd_mm, target_sd_mm))
    total = np.mean(source_var + target_var, axis=1)
    if stated and not np.all(total > 0.0):
        raise StapeskitError.of("sd_mm of a fiducial", "positive and finite", "0 in both frames")
    weights = 1.0 / total if stated else np.ones(len(a))
    rotation, shift, mirrored = kabsch(a, b, weights)
    if np.ptp(source_var, axis=1).any() or np.ptp(target_var, axis=1).any():
        rotation, shift = refined(a, b, rotation, shift, source_var, target_var)
    residuals = a @ rotation.T + shift - b
    if stated:
        matrices = pair_weights(rotation, source_var, target_var)
    else:
        matrices = np.broadcast_to(np.eye(3), (len(a), 3, 3))
    energy = float(np.einsum("ni,nij,nj->", residuals, matrices, residuals))
    return _check(
        a, b, RigidTransform.from_parts(rotation, shift, to, source), residuals, matrices, weights, energy,
        stated, bool(mirrored), names or tuple(str(place + 1) for place in range(len(a))),
    )  # fmt: skip


def _check(
    a: Array,
    b: Array,
    transform: RigidTransform,
    residuals: Array,
    matrices: Array,
    weights: Array,
    energy: float,
    stated: bool,
    mirrored: bool,
    names: tuple[str, ...],
) -> Registration:
    """Add to a fit its covariance and the warnings about its residuals."""
    n_dof = 3 * len(a) - 6
    sd = 1.0 / np.sqrt(weights) if stated else np.full(len(a), np.sqrt(energy / n_dof))
    flat, extent = _flatness(b)
    coplanar = len(a) < 4 or flat < max(_THIN * extent, 4.0 * float(np.median(sd)) if stated else 0.0)
    notices = [_coplanar_notice(len(a), flat)] if coplanar else []
    if len(a) > 3:
        suspects = explanations(a, b, weights)
        least = {
            kind: min(explanation.energy for explanation in suspects if explanation.kind == kind)
            for kind in ("wrong", "mirrored")
        }
        flipped = mirrored and not coplanar
        rivals = [least["wrong"]] * (len(a) > 4) + [
            clear_improvement_limit(least["mirrored"], stated)
        ] * flipped
        refuse_exchanged(a, b, weights, energy, stated, names, min(rivals, default=np.inf))
        if flipped:
            frames = (transform.to, transform.source)
            refuse_mirrored(suspects, energy, float(np.sum(weights)), stated, frames, names)
        notices += fault_notices(suspects, transform.rotation, energy, names, stated)
    elif stated and inconsistent(energy, n_dof):
        notices.append(_three_notice(energy, n_dof))
    scale = energy / n_dof if not stated or inconsistent(energy, n_dof) else 1.0
    in_source = np.einsum("ji,njk,kl->nil", transform.rotation, matrices, transform.rotation)
    covariance = scale * pose_covariance(a, in_source)
    chi2 = energy if stated else float("nan")
    plane = b.mean(axis=0), np.linalg.svd(b - b.mean(axis=0))[2][2]
    return Registration(
        transform, covariance, residuals, sd, chi2, n_dof, flat, tuple(notices), plane_mm=plane, names=names
    )


def _variances(sd_mm: ArrayLike | None, count: int) -> Array:
    """Return variances (n, 3), mm2, of a scalar, (n,) or (n, 3) standard deviation; zero for none."""
    if sd_mm is None:
        return np.zeros((count, 3))
    sd = np.asarray(sd_mm, dtype=float)
    if not (np.all(np.isfinite(sd)) and np.all(sd > 0.0)):
        got = "NaN or infinity" if not np.all(np.isfinite(sd)) else f"{np.min(sd):g}"
        raise StapeskitError.of("sd_mm of a fiducial", "positive and finite", got)
    return np.array(np.broadcast_to(sd[:, None] if sd.ndim == 1 else sd, (count, 3))) ** 2


def _check_pairs(a: Array, b: Array) -> None:
    if a.ndim != 2 or a.shape[1:] != (3,) or a.shape != b.shape or len(a) < 3:
        raise StapeskitError.of(
            "a registration",
            "made from at least 3 paired points",
            f"{len(a)} and {len(b)} points",
            next_step="Add fiducials",
        )
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
        raise StapeskitError.of("the coordinates of fiducials", "finite", "NaN or infinity")
    for points in (a, b):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] < 1e-3 * spread[0] or spread[0] == 0.0:
            raise StapeskitError.of(
                "fiducials",
                "spread over a plane, not along a line",
                "points on one line",
                next_step="Add a fiducial off the line",
            )


def _flatness(points: Array) -> tuple[float, float]:
    """Return the largest distance from the best plane and the largest distance from the centroid, mm."""
    centred = points - points.mean(axis=0)
    normal = np.linalg.svd(centred)[2][2]
    return float(np.max(np.abs(centred @ normal))), float(np.max(np.linalg.norm(centred, axis=1)))


def _coplanar_notice(count: int, flat: float) -> Notice:
    why = f"only {count} fiducials" if count < 4 else f"all fiducials within {flat:.3g} mm of one plane"
    return Notice(
        "fiducials_coplanar",
        f"{why}: a mirrored coordinate system would fit as well; add a fiducial off the plane.",
    )


def _three_notice(energy: float, n_dof: int) -> Notice:
    return Notice(
        "fiducials_inconsistent",
        f"the fiducials disagree by {np.sqrt(energy / n_dof):.1f} times their sd_mm, and three cannot tell "
        "which; the covariance of the registration was enlarged accordingly. Add a fourth.",
    )
