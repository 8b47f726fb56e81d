"""Did the sample keep its place between scan and measurement? Measured points against the scan's surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.measurement import Measurement
from legacy.kinematics.registration.free_motions import OPEN, open_motions, undetermined
from legacy.kinematics.registration.icp_refine import Cloud
from legacy.kinematics.registration.mesh_distance import TriangleSurface
from legacy.kinematics.registration.placement import Placement
from legacy.kinematics.registration.scan_surfaces import ScanSurfaces
from legacy.kinematics.registration.surface_check import SurfaceCheck, shift_words
from legacy.stapeskit.alignment.fiducial_faults import undo_mirror
from legacy.stapeskit.alignment.paired_points import pose_rows
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.records.mass_record import MassRecord
from legacy.stapeskit.spatial import point_rows
from legacy.stapeskit.warnings import Notice

# Points that are needed to compare with a surface.
LEAST = 3
_MOST_DISTANCE_MM: float = calibrated("sample_moved.most_distance_mm")
# Probability of a chi2 below which the sample is reported as moved, and above which the rest fits.
_UNLIKELY = 1e-3
_PLAUSIBLE = 1e-2
_SURFACE_SD_EDGES: float = calibrated("sample_moved.surface_sd_edges")
# Exact positions still have the rounding of the file.
_LEAST_SD_MM = 1e-4
_LEAST_MIRROR_MM: float = calibrated("sample_moved.least_mirror_mm")


def check_surfaces(
    measurement: Measurement,
    placement: Placement,
    mass: MassRecord,
    surfaces: ScanSurfaces,
    bone: Cloud | None = None,
) -> Placement:
    """Add to a placement the tests of the points' distances from the surfaces of the scan.

    Parameters
    ----------
    measurement : Measurement
        In its own frame, the source of ``placement``. Points of a body named stapes are held against the
        stapes, of a body named plate against the plate, all others against the nearer of bone and plate.
    bone : Cloud, optional
        More bone points, not measured by the beams.

    Returns
    -------
    Placement
        With ``checks`` and their notices.

    Raises
    ------
    KinematicsError
        ``bone`` holds fewer than 3 points or lies nowhere near the bone of the scan, or the points lie on the
        surfaces only as a mirror image.
    """
    to_scan = mass.scan_from_footplate @ placement.transform
    pairs = pair_with_surfaces(measurement, bone, to_scan, surfaces)
    _check_bone(bone, pairs)
    _check_mirror(pairs, placement, to_scan)
    checks = tuple(_check(cloud, surface, placement, mass, to_scan) for cloud, surface in pairs)
    notices = [notice for check in checks for notice in check.notices]
    return replace(placement, checks=checks, notices=(*placement.notices, *notices))


def clouds(measurement: Measurement, bone: Cloud | None = None) -> list[Cloud]:
    """Return the points of every body, once each, with their stated sd."""
    clouds = [] if bone is None else [bone]
    for body in measurement.bodies:
        first = [body.points.index(name) for name in dict.fromkeys(body.points)]
        sd = body.position_sd_mm[first]
        known = bool(np.all(np.isfinite(sd) & (sd > 0.0)))
        names = tuple(body.points[place] for place in first)
        clouds.append(Cloud(names, body.positions_mm[first], sd if known else None, body.body))
    return clouds


def pair_with_surfaces(
    measurement: Measurement, bone: Cloud | None, to_scan: RigidTransform, surfaces: ScanSurfaces
) -> list[tuple[Cloud, TriangleSurface]]:
    """Return the clouds of at least 3 points with the surface that each must lie on, where there is one."""
    pairs = []
    for cloud in clouds(measurement, bone):
        surface = _surface_of(cloud, to_scan.points(cloud.points_mm), surfaces)
        if surface is not None and len(cloud.points_mm) >= LEAST:
            pairs.append((cloud, surface))
    return pairs


def _surface_of(cloud: Cloud, placed: Array, surfaces: ScanSurfaces) -> TriangleSurface | None:
    if cloud.kind in ("stapes", "plate"):
        return surfaces.mesh(cloud.kind)
    near = [surfaces.bone_near(placed), surfaces.mesh("plate") if cloud.kind != "bone" else None]
    distances = [
        (float(np.median(surface.closest(placed)[1])), surface) for surface in near if surface is not None
    ]
    distances = [(away, surface) for away, surface in distances if away < _MOST_DISTANCE_MM]
    return min(distances, key=lambda pair: pair[0])[1] if distances else None


def _check_bone(bone: Cloud | None, pairs: Sequence[tuple[Cloud, TriangleSurface]]) -> None:
    if bone is None or any(cloud is bone for cloud, _ in pairs):
        return
    few = len(bone.points_mm) < LEAST
    raise KinematicsError.of(
        "{bone_points}",
        "at least 3 points"
        if few
        else f"points within {_MOST_DISTANCE_MM:g} mm of other bone in labels.nrrd",
        f"{len(bone.points_mm)}" if few else "points that lie elsewhere, or no such bone beside mass.json",
        next_step="Measure more" if few else "Check the registration, {mirror}, and that the scan shows bone",
    )


def _check_mirror(
    pairs: Sequence[tuple[Cloud, TriangleSurface]], placement: Placement, to_scan: RigidTransform
) -> None:
    """Refuse coplanar fiducials whose points lie on the surfaces only when mirrored at their plane."""
    fit = placement.registration
    if fit is None or fit.kind != "fiducials" or not pairs or fit.plane_mm is None:
        return
    if all(notice.code != "fiducials_coplanar" for notice in fit.notices):
        return
    to_fit = fit.transform @ to_scan.inverse()
    point, normal = to_fit.inverse().points(fit.plane_mm[0]), to_fit.inverse().vectors(fit.plane_mm[1])
    as_given, mirrored = [], []
    for cloud, surface in pairs:
        placed = to_scan.points(cloud.points_mm)
        as_given.append(surface.closest(placed)[1])
        flipped = placed - 2.0 * np.outer((placed - point) @ normal, normal)
        mirrored.append(surface.closest(flipped)[1])
    proper, other = (float(np.median(np.concatenate(part))) for part in (as_given, mirrored))
    if proper > _LEAST_MIRROR_MM and other < 0.3 * proper:
        raise KinematicsError.of(
            "the coordinates of the vibrometer frame",
            "right-handed",
            f"points that lie {proper:.2g} mm off the surfaces of the scan as given and {other:.2g} mm "
            "mirrored (coplanar fiducials fit both ways)",
            next_step=undo_mirror("scan", "vibrometer"),
        )


def _check(
    cloud: Cloud, surface: TriangleSurface, placement: Placement, mass: MassRecord, to_scan: RigidTransform
) -> SurfaceCheck:
    placed = to_scan.points(cloud.points_mm)
    distance, normal, _ = surface.signed(placed)
    own = _own_sd(cloud, surface)
    by_pose = _pose_part(cloud, placement, to_scan, normal)
    middle = placed.mean(axis=0)
    rows = point_rows(placed - middle, normal)
    axes = mass.scan_from_footplate
    lever = max(float(np.sqrt(np.mean(np.sum((placed - middle) ** 2, axis=1)))), 1e-9)
    values, motions = open_motions(rows, lever)
    observed = motions[:, values >= OPEN**2] / np.array([1.0] * 3 + [lever] * 3)[:, None]
    joint = np.diag(own**2) + by_pose
    chi2, n_dof, p = _test(rows @ observed, distance, joint, own, cloud.sd_mm is not None)
    if cloud.sd_mm is None:
        scale = _scatter(rows @ observed, distance)
        joint = np.diag(np.full(len(distance), max(scale, _LEAST_SD_MM) ** 2)) + by_pose
    shift, covariance = _shift(rows, observed, distance, joint)
    turn = np.kron(np.eye(2), axes.rotation.T)
    shift, covariance = turn @ shift, turn @ covariance @ turn.T
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    open_ = undetermined(rows, placed - middle, np.eye(3), middle, axes)
    surface_check = SurfaceCheck(
        cloud.kind,
        surface.name.removeprefix("surface of the "),
        cloud.names,
        distance,
        np.sqrt(np.diag(joint)),
        chi2,
        n_dof,
        p,
        cloud.sd_mm is not None,
        shift[:3],
        np.rad2deg(shift[3:]),
        sd[:3],
        np.rad2deg(sd[3:]),
        _size(shift[:3], covariance[:3, :3]),
        tuple(open_),
    )
    return _with_verdict(
        surface_check,
        _find_culprit(rows @ observed, distance, joint, chi2, surface_check) if p < _UNLIKELY else [],
    )


def _own_sd(cloud: Cloud, surface: TriangleSurface) -> Array:
    """Return the independent sd (n,) of the distances: position, and what a voxel leaves of the surface."""
    grain = min(_SURFACE_SD_EDGES * surface.edge_mm, 0.01)
    stated = np.zeros(len(cloud.points_mm)) if cloud.sd_mm is None else cloud.sd_mm
    return np.maximum(np.hypot(stated, grain), _LEAST_SD_MM)


def _pose_part(cloud: Cloud, placement: Placement, to_scan: RigidTransform, normal: Array) -> Array:
    """Return the covariance (n, n), mm2, that errors of the placement in the scan give the distances."""
    if not placement.names:
        return np.zeros((len(normal), len(normal)))
    keep = [k for k, name in enumerate(placement.names) if not name.startswith("footplate_frame")]
    moves = to_scan.rotation @ pose_rows(cloud.points_mm * 1e-3)
    slopes = np.einsum("ni,nij->nj", normal, moves) @ placement.derivative[:, keep] * 1e3
    return np.asarray(slopes @ placement.covariance[np.ix_(keep, keep)] @ slopes.T)


def _scatter(design: Array, distance: Array) -> float:
    """Return the root mean square distance that a rigid shift leaves, with its degrees of freedom."""
    residual = distance - design @ np.linalg.lstsq(design, distance, rcond=None)[0]
    return float(np.sqrt(np.sum(residual**2) / max(len(distance) - design.shape[1], 1)))


def _test(design: Array, distance: Array, joint: Array, own: Array, stated: bool) -> tuple[float, int, float]:
    """Return chi2, its degrees of freedom and the p-value.

    Notes
    -----
    Stated sd: chi2 of all distances with their joint covariance, and of the part that a rigid shift explains,
    the smaller p-value doubled. Otherwise the F test of a rigid shift against the scatter around it, when
    there are more points than its directions.
    """
    from scipy.special import chdtrc, fdtrc

    count, size = design.shape
    if stated:
        whole = np.asarray(np.linalg.inv(joint), dtype=float)
        chi2 = float(distance @ whole @ distance)
        moved = chi2 - _misfit(design, distance, whole)
        return chi2, count, min(1.0, 2.0 * float(min(chdtrc(count, chi2), chdtrc(size, moved))))
    if count <= size:
        return float("nan"), 0, 1.0
    scatter = max(_scatter(design, distance), _LEAST_SD_MM)
    around = joint + np.diag(np.maximum(scatter**2 - own**2, 0.0))
    weight = np.asarray(np.linalg.inv(around), dtype=float)
    gain = float(distance @ weight @ distance) - _misfit(design, distance, weight)
    return gain, size, float(fdtrc(size, count - size, gain / size))


def _misfit(design: Array, distance: Array, weight: Array) -> float:
    gram = design.T @ weight @ design
    score = design.T @ weight @ distance
    return float(distance @ weight @ distance - score @ np.linalg.solve(gram, score))


def _shift(rows: Array, seen: Array, distance: Array, joint: Array) -> tuple[Array, Array]:
    """Return the rigid displacement (6,), mm and rad, along the motions ``seen``, and its covariance."""
    design = rows @ seen
    weight = np.linalg.inv(joint)
    covariance = np.linalg.pinv(design.T @ weight @ design, hermitian=True)
    return seen @ (covariance @ (design.T @ (weight @ distance))), seen @ covariance @ seen.T


def _find_culprit(
    design: Array, distance: Array, joint: Array, chi2: float, check: SurfaceCheck
) -> list[str]:
    """Return the one point without which the others agree with the surface, if there is one."""
    from scipy.special import chdtrc

    count = len(distance)
    if count < 5:
        return []
    del design
    rest = []
    for out in range(count):
        keep = np.arange(count) != out
        rest.append(float(distance[keep] @ np.linalg.solve(joint[np.ix_(keep, keep)], distance[keep])))
    best = int(np.argmin(rest))
    fits = float(chdtrc(count - 1, rest[best])) > _PLAUSIBLE
    total = float(distance @ np.linalg.solve(joint, distance)) if np.isnan(chi2) else chi2
    return [check.points[best]] if fits and rest[best] < 0.6 * total else []


def _size(shift: Array, covariance: Array) -> tuple[float, float]:
    length = float(np.linalg.norm(shift))
    along = shift / length if length > 0.0 else np.zeros(3)
    return length, float(np.sqrt(max(float(along @ covariance @ along), 0.0)))


def _with_verdict(check: SurfaceCheck, alone: list[str]) -> SurfaceCheck:
    """Return the verdict in words."""
    if check.p_value >= _UNLIKELY:
        return check
    if alone:
        away = check.distance_mm[check.points.index(alone[0])]
        text = (
            f"point {alone[0]} of {check.body} lies {away * 1e3:+.0f} um off the {check.surface} of the "
            "scan, the others lie on it; check its position."
        )
        return replace(check, notices=(Notice("point_off_surface", text),))
    turn = ", ".join(
        f"{name} {value:+.2f} ± {sd:.2f}°"
        for name, value, sd in zip(("alpha", "beta", "gamma"), check.turn_deg, check.turn_sd_deg, strict=True)
    )
    unseen = f"; not seen: {'; '.join(check.open_motions)}" if check.open_motions else ""
    text = (
        f"the {len(check.points)} points of {check.body} lie {check.rms_mm * 1e3:.0f} um rms off the "
        f"{check.surface} of the scan (p {check.p_value:.1g}): it moved, or the registration is wrong. Best "
        f"rigid shift in footplate axes: {shift_words(check)}; {turn}{unseen}."
    )
    return replace(check, notices=(Notice("sample_moved", text),))
