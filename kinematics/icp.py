"""The pose of the vibrometer in the scan from points measured on a surface that the scan shows too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinematics.errors import KinematicsError, sentence
from kinematics.fiducial_faults import inconsistent, unit_hint
from kinematics.frames import RigidTransform, cross_matrix, rotation_from_vector
from kinematics.icp_search import Candidate, candidates, separation
from kinematics.mesh_distance import TriangleSurface
from kinematics.notices import Notice
from kinematics.registration import Registration, displacement
from kinematics.slides import undetermined

Array = NDArray[np.float64]
_ROUNDS = 40
_HUBER = 2.0
_OUTLIER = 4.5
_LEAST_SHARE = 0.6
_SURFACE_SHARE = 0.1
_SURFACE_MM = 0.005
_APART = 8.0
_EVIDENCE = 18.0


@dataclass(frozen=True)
class Cloud:
    """Points measured on a surface.

    Attributes
    ----------
    names : tuple of str, (n,)
    points_mm : ndarray, (n, 3)
        In the source frame.
    sd_mm : ndarray, (n,), or None
        Standard deviation per coordinate; None when not stated.
    kind : str
        ``plate`` or ``bone``, for messages.
    """

    names: tuple[str, ...]
    points_mm: Array
    sd_mm: Array | None = None
    kind: str = "plate"


@dataclass(frozen=True)
class SurfaceFit:
    """A cloud laid on a surface.

    Attributes
    ----------
    registration : Registration
        Source to scan; its residuals are the distances along the normals, its sd that of a distance.
    distance_mm : ndarray, (n,)
        Signed distance of each point from the surface, outside positive.
    used : ndarray of bool, (n,)
        Points that are no outliers.
    unseen : tuple of str
        Slides and turns that the points hardly determine.
    """

    registration: Registration
    distance_mm: Array
    used: NDArray[np.bool_]
    unseen: tuple[str, ...] = ()


def fit_to_surface(
    cloud: Cloud,
    surface: TriangleSurface,
    *,
    guess: tuple[RigidTransform, Array] | None = None,
    towards: Array | None = None,
    witnesses: Sequence[tuple[Array, TriangleSurface]] = (),
    axes: RigidTransform | None = None,
    source: str = "vibrometer",
) -> SurfaceFit:
    """Lay measured points on a surface of the scan: nearest planes, robust, never a reflection.

    Parameters
    ----------
    cloud : Cloud
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
    an offset of the whole surface (a level error of a tenth of its edge length, at most 5 um) does.
    """
    _check(cloud, surface, guess is None, source)
    if guess is not None:
        start = Candidate(guess[0].rotation, guess[0].translation_mm, 0.0)
        return _finished(_refined(cloud, surface, start, guess), cloud, surface, guess, axes, source, [])
    fits = [
        _refined(cloud, surface, start, None)
        for start in candidates(cloud.points_mm, surface, towards, 0.02 * surface.diagonal_mm)[:8]
    ]
    chosen, notices = _chosen(fits, cloud, witnesses, surface)
    fit = _finished(chosen, cloud, surface, None, axes, source, notices)
    _check_mirror(fit, cloud, surface, source)
    return fit


@dataclass(frozen=True)
class _Fit:
    """A refined pose with its distances, normals and weights."""

    pose: Candidate
    distance: Array
    normal: Array
    used: NDArray[np.bool_]
    scale: float
    energy: float


def _check(cloud: Cloud, surface: TriangleSurface, alone: bool, source: str) -> None:
    thing = f"the {cloud.kind} points"
    least = 7 if alone else 1
    if len(cloud.points_mm) < least:
        raise KinematicsError(
            sentence(
                thing,
                f"at least {least}, on three faces that are not parallel",
                str(len(cloud.points_mm)),
                next_step="Measure more points, or give fiducials too",
            )
        )
    if not np.all(np.isfinite(cloud.points_mm)):
        raise KinematicsError(sentence(thing, "finite", "NaN or infinity"))
    extent = float(np.linalg.norm(np.ptp(cloud.points_mm, axis=0)))
    ratio = extent / surface.diagonal_mm
    if (len(cloud.points_mm) > 6 and ratio < 0.02) or ratio > 1.5:
        hint = unit_hint(ratio, source, "scan") or "Check the unit, and which points lie on the " + cloud.kind
        if ratio < 0.02:
            hint = f"The {source} coordinates seem to be in m"
        elif ratio > 50.0:
            hint = f"The {source} coordinates seem to be in um"
        raise KinematicsError(
            sentence(
                f"{thing} (x_mm, y_mm, z_mm)",
                f"spread over a good part of the {cloud.kind}, which is {surface.diagonal_mm:.3g} mm across",
                f"points {extent:.3g} mm across",
                next_step=hint,
            )
        )


def _floor(surface: TriangleSurface) -> float:
    """Return how well the surface itself is known, mm."""
    return min(_SURFACE_SHARE * surface.edge_mm, _SURFACE_MM)


def _sd(cloud: Cloud, surface: TriangleSurface, scale: float) -> Array:
    """Return the standard deviation (n,) of the distances, mm."""
    if cloud.sd_mm is None:
        return np.full(len(cloud.points_mm), max(scale, 1e-6))
    return np.hypot(cloud.sd_mm, _floor(surface))


def _refined(
    cloud: Cloud,
    surface: TriangleSurface,
    start: Candidate,
    guess: tuple[RigidTransform, Array] | None,
) -> _Fit:
    """Iterate nearest planes from a start to the end."""
    rotation, shift = start.rotation, start.shift
    middle = cloud.points_mm.mean(axis=0)
    local = cloud.points_mm - middle
    scale = 0.0
    distance, normal = np.zeros(len(local)), np.zeros_like(local)
    used = np.ones(len(local), dtype=bool)
    for number in range(_ROUNDS):
        distance, normal, _ = surface.signed(cloud.points_mm @ rotation.T + shift)
        scale = max(1.4826 * float(np.median(np.abs(distance))), 1e-6)
        sd = _sd(cloud, surface, scale)
        width = np.maximum(sd, scale) if number < 8 else sd
        size = np.abs(distance) / width
        used = size < _OUTLIER if number >= 8 else np.ones(len(local), dtype=bool)
        if np.mean(used) < 0.3:
            used = np.ones(len(local), dtype=bool)
        weight = used * np.minimum(1.0, _HUBER / np.maximum(size, 1e-9)) / width**2
        gram, score = _normal_equations(local, rotation, distance, normal, weight)
        if guess is not None:
            pull, toward = _pull(guess, rotation, shift, middle)
            gram, score = gram + pull, score + toward
        ridge = np.diag(gram).max() * 1e-9 * np.eye(6)
        step = np.linalg.solve(gram + ridge, score)
        step[3:] *= min(1.0, 0.3 / max(float(np.linalg.norm(step[3:])), 1e-12))
        turn = rotation_from_vector(step[3:])
        shift = shift + rotation @ (step[:3] + middle - turn @ middle)
        rotation = rotation @ turn
        small = float(np.linalg.norm(step[:3])) + float(np.linalg.norm(step[3:])) * np.abs(local).max()
        if number > 9 and small < 1e-3 * float(np.median(sd)) + 1e-9:
            break
    distance, normal, _ = surface.signed(cloud.points_mm @ rotation.T + shift)
    count = max(int(np.sum(used)) - 6, 1)
    scale = float(np.sqrt(np.sum(distance[used] ** 2) / count))
    sd = _sd(cloud, surface, scale)
    energy = float(np.sum(np.minimum(np.abs(distance) / np.maximum(sd, 1e-9), _OUTLIER) ** 2))
    if cloud.sd_mm is None:
        energy = float(np.sum(np.minimum(np.abs(distance), _OUTLIER * max(scale, 1e-9)) ** 2))
    pose = Candidate(rotation, shift, float(np.mean(np.abs(distance[used]))))
    return _Fit(pose, distance, normal, used, scale, energy)


def _rows(local: Array, rotation: Array, normal: Array) -> Array:
    """Return d(distance)/d(displacement of the source frame about the centroid), (n, 6), mm and rad."""
    across = normal @ rotation
    return np.hstack([across, np.cross(local, across)])


def _normal_equations(
    local: Array, rotation: Array, distance: Array, normal: Array, weight: Array
) -> tuple[Array, Array]:
    rows = _rows(local, rotation, normal)
    return (rows * weight[:, None]).T @ rows, -rows.T @ (weight * distance)


def _about(middle_mm: Array) -> Array:
    """Return the map (6, 6) from a displacement about a frame's origin to that about a point, mm and rad."""
    move = np.eye(6)
    move[:3, 3:] = -cross_matrix(middle_mm)
    return move


def _pull(
    guess: tuple[RigidTransform, Array], rotation: Array, shift: Array, middle: Array
) -> tuple[Array, Array]:
    """Return the information and the score of a first guess, about the centroid, mm and rad."""
    units = np.array([1e3] * 3 + [1.0] * 3)
    move = _about(middle)
    covariance = move @ (guess[1] * np.outer(units, units)) @ move.T
    scale = 1.0 / np.sqrt(np.diag(covariance))
    information = np.linalg.inv(covariance * np.outer(scale, scale)) * np.outer(scale, scale)
    here = RigidTransform.from_parts(rotation, shift, guess[0].to, guess[0].source)
    away = move @ (displacement(here, guess[0]) * units)
    return information, information @ away


def _chosen(
    fits: list[_Fit],
    cloud: Cloud,
    witnesses: Sequence[tuple[Array, TriangleSurface]],
    surface: TriangleSurface,
) -> tuple[_Fit, list[Notice]]:
    """Choose the placement; refuse when others fit alike and no other points tell them apart."""
    fits = sorted(fits, key=lambda fit: fit.energy)
    best = fits[0]
    apart = max(_APART * max(best.scale, _floor(surface)), 0.01 * surface.diagonal_mm)
    alike = [best]
    freedom = max(len(cloud.points_mm) - 6, 1)
    for fit in fits[1:]:
        if cloud.sd_mm is None:
            worse = freedom * float(np.log(max(fit.energy, 1e-18) / max(best.energy, 1e-18)))
        else:
            worse = (fit.energy - best.energy) / max(1.0, best.energy / freedom)
        if worse < _EVIDENCE and all(separation(fit.pose, o.pose, cloud.points_mm) > apart for o in alike):
            alike.append(fit)
    if len(alike) == 1:
        return best, []
    if witnesses:
        misses = [_witness_miss(fit.pose, witnesses) for fit in alike]
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
    raise KinematicsError(
        sentence(
            f"the {cloud.kind} points",
            "such that one placement fits best",
            f"{len(alike)} that fit alike (mean distance {best.pose.miss_mm * 1e3:.2g} and "
            f"{alike[1].pose.miss_mm * 1e3:.2g} um, turned by {angle:.0f} degrees)",
            next_step="Half turns of a box leave it as it is: give at least 3 --fiducials as a first "
            "guess, or measure points on the stapes or the bone too, whose surfaces decide",
        )
    )


def _witness_miss(pose: Candidate, witnesses: Sequence[tuple[Array, TriangleSurface]]) -> float:
    away = np.concatenate([surface.closest(pose.points(points))[1] for points, surface in witnesses])
    return float(np.median(away))


def _finished(
    fit: _Fit,
    cloud: Cloud,
    surface: TriangleSurface,
    guess: tuple[RigidTransform, Array] | None,
    axes: RigidTransform | None,
    source: str,
    notices: list[Notice],
) -> SurfaceFit:
    """Judge a refined fit and give it its covariance."""
    used = fit.used
    if np.mean(used) < _LEAST_SHARE or fit.scale > 0.05 * surface.diagonal_mm:
        _refuse_off(fit, cloud, surface)
    middle = cloud.points_mm.mean(axis=0)
    local = cloud.points_mm - middle
    rows = _rows(local, fit.pose.rotation, fit.normal)
    open_ = undetermined(rows[used], local[used], fit.pose.rotation, fit.pose.points(middle[None])[0], axes)
    if open_ and guess is None:
        raise KinematicsError(
            sentence(
                f"the {cloud.kind} points",
                "on at least three faces that are not parallel, spread over each",
                f"points that leave open: {'; '.join(open_)}",
                next_step="Measure points on the faces that stop these motions, or give --fiducials too",
            )
        )
    sd = _sd(cloud, surface, fit.scale)
    gram, _ = _normal_equations(local, fit.pose.rotation, fit.distance, fit.normal, used / sd**2)
    n_dof = int(np.sum(used)) - 6
    pulled = 0.0
    if guess is not None:
        information, toward = _pull(guess, fit.pose.rotation, fit.pose.shift, middle)
        gram = gram + information
        pulled = float(toward @ np.linalg.solve(information, toward))
        n_dof += 6
    chi2 = (
        float("nan") if cloud.sd_mm is None else float(np.sum((fit.distance[used] / sd[used]) ** 2)) + pulled
    )
    if guess is not None and cloud.sd_mm is None and inconsistent(pulled, 6):
        notices = [*notices, _against_guess(pulled, cloud.kind)]
    scale = 1.0
    if inconsistent(chi2, n_dof):
        scale = chi2 / n_dof
        notices = [*notices, _misfit(scale, cloud.kind)]
    offset = np.linalg.solve(gram, rows[used].T @ (1.0 / sd[used] ** 2)) * _floor(surface)
    units = np.array([1e-3] * 3 + [1.0] * 3)
    back = np.linalg.inv(_about(middle))
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
    return SurfaceFit(registration, fit.distance, used, tuple(open_))


def _refuse_off(fit: _Fit, cloud: Cloud, surface: TriangleSurface) -> None:
    raise KinematicsError(
        sentence(
            f"the {cloud.kind} points",
            f"on the {surface.name} of the scan",
            f"{int(np.sum(fit.used))} of {len(fit.used)} that fit, {fit.scale:.2g} mm rms off it",
            next_step=f"Check that they were measured on the {cloud.kind} that was scanned, their unit, and "
            "--mirror; or give --fiducials as a first guess",
        )
    )


def _misfit(scale: float, kind: str) -> Notice:
    return Notice(
        "surface_points_inconsistent",
        f"the {kind} points lie {np.sqrt(scale):.1f} times farther from the {kind} of the scan than their "
        "sd_mm; the covariance of the registration was enlarged accordingly.",
    )


def _against_guess(pulled: float, kind: str) -> Notice:
    return Notice(
        "surface_points_inconsistent",
        f"the {kind} points and the fiducials contradict each other (chi2 {pulled:.3g} for 6).",
    )


def _off_notice(fit: _Fit, cloud: Cloud) -> list[Notice]:
    off = np.flatnonzero(~fit.used)
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
    if known and fit.registration.chi2 < 2.0 * fit.registration.n_dof and np.all(fit.used):
        return
    flipped = Cloud(cloud.names, cloud.points_mm * [1.0, 1.0, -1.0], cloud.sd_mm, cloud.kind)
    starts = candidates(flipped.points_mm, surface, None, 0.02 * surface.diagonal_mm)[:3]
    mirrored = min(
        (_refined(flipped, surface, start, None) for start in starts), key=lambda found: found.energy
    )
    other = float(np.mean(np.minimum(np.abs(mirrored.distance), 0.3)))
    if other > 0.4 * proper or (known and proper < 2.0 * scale):
        return
    raise KinematicsError(
        sentence(
            f"the coordinates of the {source} frame",
            "right-handed",
            f"{cloud.kind} points that fit only as a mirror image (mean distance {proper:.2g} mm as given, "
            f"{other:.2g} mm mirrored)",
            next_step="Undo the mirrored axis with --mirror x, y or z",
        )
    )
