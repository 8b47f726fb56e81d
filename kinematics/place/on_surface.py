"""Lay points that were measured on the plate on its surface in the scan, from a rough pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinematics.calibrated import calibrated
from kinematics.measurement import MIRRORS
from kinematics.place.placement import Placement, place_by
from kinematics.place.surfaces import Surface
from kinematics.readers.points import position_faults, require, sd_faults
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.paired_points import pose_rows
from stapeskit.records.mass_record import MassRecord
from stapeskit.registration import Registration
from stapeskit.tables import read_table
from stapeskit.warnings import Notice

_PLACE = ("x_mm", "y_mm", "z_mm")
_USUAL_SD_MM = 0.02  # of a point on a surface where none is stated: as marks are set
_FAR_SD = 4.0  # points so many sd off the surface are listed, and have little weight
_LEAST_POINTS = 6
_UNLIKELY = 1e-3


@dataclass(frozen=True)
class SurfacePoints:
    """Points measured on a surface: names (n,), vibrometer coordinates (n, 3), mm, and their sd (n,), mm."""

    names: tuple[str, ...]
    points_mm: Array
    sd_mm: Array

    def mirrored(self, axis: str) -> SurfacePoints:
        """Return the points with one axis of left-handed coordinates reversed."""
        return SurfacePoints(self.names, self.points_mm * np.array(MIRRORS[axis]), self.sd_mm)


def read_surface_points(path: Path) -> SurfacePoints:
    """Read points on the plate: [name,] x_mm, y_mm, z_mm [, sd_mm].

    Raises
    ------
    StapeskitError
        A column is missing, a cell is no finite number, an sd is not positive, or points are too few; all
        faults are listed.
    """

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        require(header, _PLACE, file)
        return {*_PLACE, *({"sd_mm"} & set(header))}, {"name"} & set(header)

    table = read_table(Path(path), choose)
    faults: list[Fault] = [*table.faults, *position_faults(table, _PLACE)]
    sd = table.numbers.get("sd_mm", np.full(len(table), np.nan))
    faults += sd_faults(table, sd)
    if len(table) < _LEAST_POINTS:
        faults.append(Fault("the points on the plate", f"at least {_LEAST_POINTS}", len(table), table.file))
    raise_all(faults)
    column = table.texts.get("name")
    names = tuple(
        column.names[column.codes[row]] if column is not None and column.codes[row] >= 0 else f"line {line}"
        for row, line in enumerate(table.lines.tolist())
    )
    places = np.column_stack([table.numbers[name] for name in _PLACE])
    return SurfacePoints(names, places, np.where(np.isfinite(sd), sd, _USUAL_SD_MM))


def lay_on_surface(rough: Placement, points: SurfacePoints, plate: Surface, mass: MassRecord) -> Placement:
    """Refine a pose by points on the plate; fiducials count by their covariance.

    Parameters
    ----------
    rough : Placement
        From at least three fiducials.

    Raises
    ------
    StapeskitError
        Less than half of the points come to lie on the plate.

    Notes
    -----
    Least squares of signed distances over their sd with the loss 2 (sqrt(1 + r^2) - 1) (`scipy.optimize`,
    soft_l1), and of the displacement from the rough pose over its covariance. The covariance is that of the
    quadratic approximation, each point with the weight that the loss gives it (Triggs et al. 2000,
    doi:10.1007/3-540-44480-7_21); where points scatter more than stated it grows accordingly.
    """
    from scipy.optimize import least_squares
    from scipy.special import chdtrc

    start = mass.scan_from_footplate @ rough.transform
    known = [k for k, name in enumerate(rough.names) if not name.startswith("footplate_frame")]
    slope = rough.derivative[:, known]
    prior = slope @ rough.covariance[np.ix_(known, known)] @ slope.T
    scale = np.sqrt(np.maximum(np.diag(prior), 1e-12))
    root = np.linalg.cholesky(prior / np.outer(scale, scale) + 1e-9 * np.eye(6))
    sd = np.hypot(points.sd_mm, calibrated("sample_moved.surface_sd_edges") * plate.edge_mm)
    moves = 1e3 * pose_rows(1e-3 * points.points_mm)

    def residuals(u: Array) -> Array:
        pose = start.perturbed(scale * (root @ u))
        away = plate.signed(pose.points(points.points_mm))[0] / sd
        # the loss is applied to each residual: that of the prior stays quadratic by its inverse
        return np.concatenate([away, np.sqrt((1.0 + 0.5 * u**2) ** 2 - 1.0) * np.sign(u)])

    found = least_squares(residuals, np.zeros(6), loss="soft_l1", x_scale=1.0, diff_step=1e-4)
    pose = start.perturbed(scale * (root @ found.x))
    away, normal = plate.signed(pose.points(points.points_mm))
    size = away / sd
    near = np.abs(size) < _FAR_SD
    if np.sum(near) < max(3, 0.5 * len(size)):
        rms = float(np.sqrt(np.mean(away**2)))
        got = f"{int(np.sum(near))} of {len(size)} within {_FAR_SD:g} sd, rms {rms:.2g} mm"
        step = "Check the points and the fiducials, which must tie them roughly"
        raise StapeskitError.of("the points of --plate-points", "on the plate of the scan", got, "", step)
    rows = np.einsum("ni,nij->nj", pose.inverse().vectors(normal), moves) / sd[:, None]
    weight = (1.0 + size**2) ** -0.5
    whole = scale[:, None] * root
    information = (rows @ whole).T @ (weight[:, None] * (rows @ whole)) + np.eye(6)
    chi2, freedom = float(np.sum(size[near] ** 2)), max(int(np.sum(near)) - 6, 1)
    chance = float(chdtrc(freedom, chi2))
    spread = whole @ np.linalg.inv(information) @ whole.T * (chi2 / freedom if chance < _UNLIKELY else 1.0)
    notices = _notices(points, size, near, chance, np.sqrt(chi2 / freedom))
    fit = Registration(
        type(pose)(pose.matrix, "scan", start.source),
        spread,
        away[:, None] * normal,
        sd,
        chi2,
        freedom,
        float(np.ptp(away)),
        tuple(notices),
        points.names,
        "plate points",
    )
    return place_by(fit, mass, rough.notices)


def _notices(
    points: SurfacePoints, size: Array, near: NDArray[np.bool_], chance: float, level: float
) -> list[Notice]:
    notices = []
    off = [name for name, good in zip(points.names, near.tolist(), strict=True) if not good]
    if off:
        listed = ", ".join(off[:8])
        text = (
            f"points {listed} lie off the plate (up to {np.max(np.abs(size)):.0f} sd) and have little weight."
        )
        notices.append(Notice("surface_points_off", text))
    if chance < _UNLIKELY:
        text = (
            f"the points on the plate lie {level:.1f} times their sd off its surface; the covariance of the "
            "registration was enlarged accordingly."
        )
        notices.append(Notice("surface_points_off", text))
    return notices
