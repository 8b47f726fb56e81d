"""The pose of the vibrometer in the scan from points measured on a surface that the scan shows too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.registration.free_motions import undetermined
from legacy.kinematics.registration.icp_refine import (
    Cloud,
    Guess,
    Refined,
    about,
    distance_rows,
    distance_sd,
    normal_equations,
    pull,
    refined,
    surface_floor,
)
from legacy.kinematics.registration.icp_search import Candidate, candidates, separation
from legacy.kinematics.registration.mesh_distance import TriangleSurface
from legacy.stapeskit.alignment.fiducial_faults import inconsistent, undo_mirror, unit_hint
from legacy.stapeskit.alignment.registration import Registration
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.warnings import Notice

_LEAST_SHARE_NEAR: float = calibrated("surface_fit.least_share_near")
_APART_SD: float = calibrated("surface_fit.distinct_placements_sd")
_LEAST_EVIDENCE: float = calibrated("surface_fit.least_evidence")
# Points of the surface with which ambiguity is judged.
_SAMPLES = 2_000
_FACING_AWAY: float = calibrated("surface_fit.facing_away_cosine")
_MOST_FACING_AWAY: float = calibrated("surface_fit.most_facing_away")


@dataclass(frozen=True)
class SurfaceFit:
    """A cloud laid on a surface.

    Attributes
    ----------
    registration : Registration
        Source to scan; its residuals are the distances along the normals, its sd that of a distance.
    distance_mm : ndarray, (n,)
        Signed distance of each point from the surface, outside positive.
    near, used : ndarray of bool, (n,)
        Points that are no outliers, and those of them so far from edges that their face is certain.
    unseen : tuple of str
        Slides and turns that the points hardly determine.
    """

    registration: Registration
    distance_mm: Array
    near: NDArray[np.bool_]
    used: NDArray[np.bool_]
    unseen: tuple[str, ...] = ()


def fit_to_surface(
    cloud: Cloud,
    surface: TriangleSurface,
    *,
    guess: Guess | None = None,
    towards: Array | None = None,
    witnesses: Sequence[tuple[Array, TriangleSurface]] = (),
    axes: RigidTransform | None = None,
    source: str = "vibrometer",
    surface_sd_mm: float | None = None,
) -> SurfaceFit:
    """Fit measured points to a surface of the scan: nearest planes, robust, never a reflection.

    Parameters
    ----------
    surface : TriangleSurface
        In scan coordinates.
    guess : (RigidTransform, ndarray (6, 6)), optional
        scan_from_source from elsewhere with the covariance of its displacement (SI, source axes): the start,
        and a measurement that counts by its covariance.
    towards : ndarray, (3,), optional
        Mean direction to the laser heads, source axes.
    witnesses : sequence of (points (k, 3), surface), optional
        Other points in the source frame and the surface they must lie on: they choose between placements
        that fit alike, and do not enter the fit.
    axes : RigidTransform, optional
        ``scan_from_<frame>``: the axes in which undetermined motions are named.

    surface_sd_mm : float, optional
        How well the surface itself is known; if not given, a tenth of its edge length (a voxel), at most
        5 um.

    Raises
    ------
    KinematicsError
        Too few points, another unit, points that do not lie on the surface, motions that they leave open,
        or several placements that fit alike.

    Notes
    -----
    Rows n^T R [1, -[s]x] of the displacement of the source frame (Chen and Medioni 1992,
    doi:10.1016/0262-8856(92)90066-C); Huber weights, then points beyond 4.5 sd are left out. The covariance
    is the inverse information, raised by chi2 / n_dof where the residuals exceed the stated sd, plus what
    an offset of the whole surface by its sd does (an error of the level at which the scan was cut). Points
    within 3 sd of an edge do not count: noise decides there which face is nearest.
    """
    if surface_sd_mm is not None:
        surface = replace(surface, sd_mm=surface_sd_mm)
    _check(cloud, surface, guess is None, source)
    if guess is not None:
        return _finish(_from_guess(cloud, surface, guess, towards), cloud, surface, guess, axes, source, [])
    fits = [
        refined(cloud, surface, start, None)
        for start in candidates(cloud.points_mm, surface, towards, 0.02 * surface.diagonal_mm)[:8]
    ]
    for best in sorted(fits, key=lambda fit: fit.energy)[:2]:
        fits += [refined(cloud, surface, start, None) for start in _half_turned(best.pose, surface)]
    fits = _drop_hidden(fits, towards)
    chosen, notices = _choose_placement(fits, cloud, witnesses, surface)
    fit = _finish(chosen, cloud, surface, None, axes, source, notices)
    _check_mirror(fit, cloud, surface, source)
    return fit


def _half_turned(pose: Candidate, surface: TriangleSurface) -> list[Candidate]:
    """Return a pose turned by half about each principal axis of the surface, where a box fits as well."""
    samples, _ = surface.samples(_SAMPLES)
    centre = samples.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((samples - centre).T))
    turned = []
    for axis in axes.T:
        turn = 2.0 * np.outer(axis, axis) - np.eye(3)
        turned.append(Candidate(turn @ pose.rotation, turn @ (pose.shift - centre) + centre, pose.miss_mm))
    return turned


def _drop_hidden(fits: list[Refined], towards: Array | None) -> list[Refined]:
    """Leave out placements that put many points on faces which no laser reaches, unless all do."""
    if towards is None:
        return fits
    hidden = [np.mean(fit.normal @ (fit.pose.rotation @ towards) < _FACING_AWAY) for fit in fits]
    reachable = [fit for fit, share in zip(fits, hidden, strict=True) if share < _MOST_FACING_AWAY]
    return reachable or fits


def _from_guess(cloud: Cloud, surface: TriangleSurface, guess: Guess, towards: Array | None) -> Refined:
    """Refine from a first guess; where that ends off the surface, from all starts, the guess as a prior."""
    near = Candidate(guess[0].rotation, guess[0].translation_mm, 0.0)
    fit = refined(cloud, surface, near, guess)
    good = np.mean(fit.near) > 0.8 and fit.scale < 0.01 * surface.diagonal_mm
    if good or len(cloud.points_mm) < 7:
        return fit
    starts = candidates(cloud.points_mm, surface, towards, 0.02 * surface.diagonal_mm)[:6]
    fits = [fit, *(refined(cloud, surface, start, guess) for start in starts)]
    middle = cloud.points_mm.mean(axis=0)

    def misfit(fit: Refined) -> float:
        information, toward = pull(guess, fit.pose.rotation, fit.pose.shift, middle)
        pulled = float(toward @ np.linalg.solve(information, toward))
        return fit.energy / (1.0 if cloud.sd_mm is not None else max(fits[-1].scale, 1e-6) ** 2) + pulled

    return min(fits, key=misfit)


def _check(cloud: Cloud, surface: TriangleSurface, alone: bool, source: str) -> None:
    thing = f"the {cloud.kind} points"
    least = 7 if alone else 1
    if len(cloud.points_mm) < least:
        raise KinematicsError.of(
            thing,
            f"at least {least}, on three faces that are not parallel",
            str(len(cloud.points_mm)),
            next_step="Measure more points, or give fiducials too",
        )
    if not np.all(np.isfinite(cloud.points_mm)):
        raise KinematicsError.of(thing, "finite", "NaN or infinity")
    extent = float(np.linalg.norm(np.ptp(cloud.points_mm, axis=0)))
    ratio = extent / surface.diagonal_mm
    if (len(cloud.points_mm) > 6 and ratio < 0.02) or ratio > 1.5:
        hint = unit_hint(ratio, source, "scan") or "Check the unit, and which points lie on the " + cloud.kind
        if ratio < 0.02:
            hint = f"The {source} coordinates seem to be in m"
        elif ratio > 50.0:
            hint = f"The {source} coordinates seem to be in um"
        raise KinematicsError.of(
            f"{thing} (x_mm, y_mm, z_mm)",
            f"spread over a good part of the {cloud.kind}, which is {surface.diagonal_mm:.3g} mm across",
            f"points {extent:.3g} mm across",
            next_step=hint,
        )


def _choose_placement(
    fits: list[Refined],
    cloud: Cloud,
    witnesses: Sequence[tuple[Array, TriangleSurface]],
    surface: TriangleSurface,
) -> tuple[Refined, list[Notice]]:
    """Choose the placement; refuse when others fit as well and no other points decide between them."""
    fits = sorted(fits, key=lambda fit: fit.energy)
    best = fits[0]
    apart = max(_APART_SD * max(best.scale, surface_floor(surface)), 0.03 * surface.diagonal_mm)
    alike = [best]
    freedom = max(len(cloud.points_mm) - 6, 1)
    for fit in fits[1:]:
        if cloud.sd_mm is None:
            worse = freedom * float(np.log(max(fit.energy, 1e-18) / max(best.energy, 1e-18)))
        else:
            worse = (fit.energy - best.energy) / max(1.0, best.energy / freedom)
        if worse < _LEAST_EVIDENCE and all(
            separation(fit.pose, o.pose, cloud.points_mm) > apart for o in alike
        ):
            alike.append(fit)
    if len(alike) == 1:
        return best, []
    if witnesses:
        misses = [_witness_distance(fit.pose, witnesses) for fit in alike]
        order = np.argsort(misses)
        if misses[order[0]] < 0.5 * misses[order[1]]:
            text = (
                f"{len(alike)} placements lay the {cloud.kind} points on the {cloud.kind} alike; the one was "
                f"taken that has the other measured points {misses[order[0]]:.2g} mm from their surfaces "
                f"(next best {misses[order[1]]:.2g} mm)."
            )
            return alike[order[0]], [Notice("registration_ambiguous", text)]
    turn = alike[1].pose.rotation @ best.pose.rotation.T
    angle = np.rad2deg(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0)))
    raise KinematicsError.of(
        f"the {cloud.kind} points",
        "such that one placement fits best",
        f"{len(alike)} that fit alike (mean distance {best.pose.miss_mm * 1e3:.2g} and "
        f"{alike[1].pose.miss_mm * 1e3:.2g} um, turned by {angle:.0f} degrees)",
        next_step="Half turns of a box leave it as it is: give at least 3 {fiducials} as a first "
        "guess, or measure points on the stapes or the bone too, whose surfaces decide",
    )


def _witness_distance(pose: Candidate, witnesses: Sequence[tuple[Array, TriangleSurface]]) -> float:
    away = np.concatenate([surface.closest(pose.points(points))[1] for points, surface in witnesses])
    return float(np.median(away))


def _finish(
    fit: Refined,
    cloud: Cloud,
    surface: TriangleSurface,
    guess: Guess | None,
    axes: RigidTransform | None,
    source: str,
    notices: list[Notice],
) -> SurfaceFit:
    """Check a refined fit and compute its covariance."""
    used = fit.used
    if np.mean(fit.near) < _LEAST_SHARE_NEAR or np.sum(used) < 4 or fit.scale > 0.05 * surface.diagonal_mm:
        _refuse_off(fit, cloud, surface)
    middle = cloud.points_mm.mean(axis=0)
    local = cloud.points_mm - middle
    rows = distance_rows(local, fit.pose.rotation, fit.normal)
    open_ = undetermined(rows[used], local[used], fit.pose.rotation, fit.pose.points(middle[None])[0], axes)
    if open_ and guess is None:
        raise KinematicsError.of(
            f"the {cloud.kind} points",
            "on at least three faces that are not parallel, spread over each",
            f"points that leave open: {'; '.join(open_)}",
            next_step="Measure points on the faces that stop these motions, or give {fiducials} too",
        )
    sd = distance_sd(cloud, surface, fit.scale)
    gram, _ = normal_equations(local, fit.pose.rotation, fit.distance, fit.normal, used / sd**2)
    n_dof = int(np.sum(used)) - 6
    pulled = 0.0
    if guess is not None:
        information, toward = pull(guess, fit.pose.rotation, fit.pose.shift, middle)
        gram = gram + information
        pulled = float(toward @ np.linalg.solve(information, toward))
        n_dof += 6
    chi2 = (
        float("nan") if cloud.sd_mm is None else float(np.sum((fit.distance[used] / sd[used]) ** 2)) + pulled
    )
    if guess is not None and cloud.sd_mm is None and inconsistent(pulled, 6):
        notices = [*notices, _contradiction_notice(pulled, cloud.kind)]
    scale = 1.0
    if inconsistent(chi2, n_dof):
        scale = chi2 / n_dof
        notices = [*notices, _misfit_notice(scale, cloud.kind)]
    offset = np.linalg.solve(gram, rows[used].T @ (1.0 / sd[used] ** 2)) * surface_floor(surface)
    units = np.array([1e-3] * 3 + [1.0] * 3)
    back = np.linalg.inv(about(middle))
    covariance = back @ (scale * np.linalg.inv(gram) + np.outer(offset, offset)) @ back.T
    covariance = covariance * np.outer(units, units)
    transform = RigidTransform.from_parts(fit.pose.rotation, fit.pose.shift, "scan", source)
    notices = [*notices, *_off_notice(fit, cloud)]
    if open_:
        text = f"the {cloud.kind} points alone leave open: {'; '.join(open_)}; the first guess decides there."
        notices.append(Notice("unobservable", text))
    registration = Registration(
        transform,
        0.5 * (covariance + covariance.T),
        (fit.distance[:, None] * fit.normal)[used],
        sd[used],
        chi2,
        n_dof,
        float("nan"),
        tuple(notices),
        f"{cloud.kind} points",
    )
    return SurfaceFit(registration, fit.distance, fit.near, used, tuple(open_))


def _refuse_off(fit: Refined, cloud: Cloud, surface: TriangleSurface) -> None:
    raise KinematicsError.of(
        f"the {cloud.kind} points",
        f"on the {surface.name} of the scan",
        f"{int(np.sum(fit.near))} of {len(fit.near)} that fit, {fit.scale:.2g} mm rms off it",
        next_step=f"Check that they were measured on the {cloud.kind} that was scanned, their unit, and "
        "{mirror}; or give {fiducials} as a first guess",
    )


def _misfit_notice(scale: float, kind: str) -> Notice:
    return Notice(
        "surface_points_inconsistent",
        f"the {kind} points lie {np.sqrt(scale):.1f} times farther from the {kind} of the scan than their "
        "sd_mm; the covariance of the registration was enlarged accordingly.",
    )


def _contradiction_notice(pulled: float, kind: str) -> Notice:
    return Notice(
        "surface_points_inconsistent",
        f"the {kind} points and the fiducials contradict each other (chi2 {pulled:.3g} for 6).",
    )


def _off_notice(fit: Refined, cloud: Cloud) -> list[Notice]:
    off = np.flatnonzero(~fit.near)
    if not len(off):
        return []
    named = ", ".join(f"{cloud.names[k]} ({fit.distance[k] * 1e3:+.0f} um)" for k in off[:8])
    more = f" and {len(off) - 8} more" if len(off) > 8 else ""
    text = f"{cloud.kind} points off the surface were left out: {named}{more}."
    return [Notice("surface_points_off", text)]


def _check_mirror(fit: SurfaceFit, cloud: Cloud, surface: TriangleSurface, source: str) -> None:
    """Refuse points that lie on the surface far better as a mirror image.

    Raises
    ------
    KinematicsError
        The source frame is left-handed.
    """
    scale = float(np.median(fit.registration.sd_mm))
    proper = float(np.mean(np.minimum(np.abs(fit.distance_mm), 0.3)))
    known = cloud.sd_mm is not None
    wide = scale > 0.01 * surface.diagonal_mm
    if known:
        wide = fit.registration.chi2 > 2.0 * fit.registration.n_dof
    if not wide and np.mean(fit.near) > 0.9:
        return
    flipped = Cloud(cloud.names, cloud.points_mm * [1.0, 1.0, -1.0], cloud.sd_mm, cloud.kind)
    starts = candidates(flipped.points_mm, surface, None, 0.02 * surface.diagonal_mm)[:3]
    mirrored = min((refined(flipped, surface, start, None) for start in starts), key=lambda fit: fit.energy)
    other = float(np.mean(np.minimum(np.abs(mirrored.distance), 0.3)))
    if other > 0.4 * proper or (known and proper < 2.0 * scale):
        return
    raise KinematicsError.of(
        f"the coordinates of the {source} frame",
        "right-handed",
        f"{cloud.kind} points that fit only as a mirror image (mean distance {proper:.2g} mm as given, "
        f"{other:.2g} mm mirrored)",
        next_step=undo_mirror("scan", source),
    )
