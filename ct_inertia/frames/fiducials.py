"""The plate frame from points that a person measured in the scan, instead of from fitted faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ct_inertia.frames.plate_frame import PlateFrame, axis_notices, centroid, positive_sense
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.frames import RigidTransform, axes_matrix
from stapeskit.registration import displacement, fit_rigid
from stapeskit.tables import read_table

_SCAN = ("x_mm", "y_mm", "z_mm")
_PLATE = ("x_ref_mm", "y_ref_mm", "z_ref_mm")
_SIZES_MM = (0.5, 100.0)  # of what the points span: a plate of some millimetres, typed in mm
_FARTHEST = 5.0  # distance of the stapes from their middle, in what they span: the plate lies beside it
_LEAST_CORNERS, _FLAT_MM, _APART_SD = 4, 0.1, 4.0  # of a face; how far corners may be off its plane
_HAND_SD_MM = 0.03  # of points set by hand in a scan: some hundredths of a millimetre
_STEP_MM = 1e-6  # of finite differences
_REFERENCES = "give x_ref_mm, y_ref_mm, z_ref_mm"


@dataclass(frozen=True)
class PlateFiducials:
    """Points (n, 3) of the plate found in the scan, and the same in the plate frame.

    Without ``plate_mm`` they are corners of the plate's face.
    """

    names: tuple[str, ...]
    scan_mm: Array
    plate_mm: Array | None = None
    sd_mm: Array | None = None


def read_plate_fiducials(path: Path) -> PlateFiducials:
    """Read ``name, x_mm, y_mm, z_mm [, x_ref_mm, y_ref_mm, z_ref_mm] [, sd_mm]``.

    Raises
    ------
    StapeskitError
        A column is missing, a cell is empty, a name is repeated, or there are fewer than 3 points.
    """
    columns: list[str] = []

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        columns.extend(header)
        wanted = [*_SCAN, *(_PLATE if any(name in header for name in _PLATE) else ())]
        missing = [name for name in ("name", *wanted) if name not in header]
        if missing:
            expected = "name, x_mm, y_mm, z_mm, or these with x_ref_mm, y_ref_mm, z_ref_mm"
            got = f"no {', '.join(missing)}"
            raise StapeskitError.of("the columns of --plate-fiducials", expected, got, file, "Add them")
        return {*wanted, *(("sd_mm",) if "sd_mm" in header else ())}, {"name"}

    table = read_table(path, choose)
    faults = list(table.faults)
    for column, values in table.numbers.items():
        for row in np.flatnonzero(~np.isfinite(values) & ~table.invalid_rows(column)).tolist():
            got = f"{values[row]:g}" if np.isinf(values[row]) else "nothing"
            faults.append(Fault(column, "a finite number", got, table.where(row), "Fill in the cell"))
    codes, known = table.texts["name"].codes, table.texts["name"].names
    names = tuple(known[code] if code >= 0 else str(row + 1) for row, code in enumerate(codes))
    sd = table.numbers.get("sd_mm")
    if len(set(names)) != len(names):
        got, step = ", ".join(names), "Rename one of them"
        faults.append(Fault("the names of --plate-fiducials", "different", got, path.name, step))
    if len(names) < 3:
        step = "Add points that are not on one line"
        faults.append(Fault("--plate-fiducials", "at least 3 points", len(names), path.name, step))
    if sd is not None and np.any(sd <= 0.0):
        step = "Give the standard deviation of a point in mm, or leave the column out"
        faults.append(Fault("sd_mm", "positive", f"{np.nanmin(sd):g}", path.name, step))
    raise_all(faults)
    scan = np.column_stack([table.numbers[name] for name in _SCAN])
    plate = np.column_stack([table.numbers[name] for name in _PLATE]) if _PLATE[0] in columns else None
    return PlateFiducials(names, scan, plate, sd)


def plate_frame_from_fiducials(fiducials: PlateFiducials, stapes_mm: Array) -> PlateFrame:
    """Return the plate frame that fiducials define; ``stapes_mm`` (3,) is a point of the stapes in the scan.

    With coordinates in the plate frame: a rigid fit. Without: corners of the plate's face in any order; y out
    of their plane towards the stapes, x along the longest side, origin the centroid of the face.

    Raises
    ------
    StapeskitError
        Points on a line, far from the stapes, or that fit only as a mirror image; points in one plane that
        have the stapes behind the plate; fewer than 4 corners, or corners off one plane.
    """
    _check_place(fiducials.scan_mm, stapes_mm)
    if fiducials.plate_mm is None:
        return _from_corners(fiducials, stapes_mm)
    fit = fit_rigid(
        fiducials.plate_mm,
        fiducials.scan_mm,
        fiducials.sd_mm,
        to="scan",
        source="plate",
        names=fiducials.names,
    )
    behind = float(fit.transform.inverse().points(stapes_mm)[1])
    if behind < 0.0 and any(notice.code == "fiducials_coplanar" for notice in fit.notices):
        expected = "on the side of the plate's face, y > 0 in its frame"
        step = (
            "Check the signs of x_ref_mm, y_ref_mm, z_ref_mm: points in one plane do not show a mirror image"
        )
        raise StapeskitError.of("the stapes", expected, f"y = {behind:.3g} mm", next_step=step)
    return PlateFrame(fit.transform, fit.covariance_si, np.zeros((0, 3)), False, "fiducials", fit.notices)


def _check_place(points_mm: Array, stapes_mm: Array) -> None:
    """Refuse points that are not in mm, or not in the coordinates of the scan."""
    span = float(np.linalg.norm(np.ptp(points_mm, axis=0)))
    distance = float(np.linalg.norm(points_mm.mean(axis=0) - stapes_mm))
    if not _SIZES_MM[0] <= span <= _SIZES_MM[1] or distance > _FARTHEST * span:
        expected = "in mm in scan coordinates, beside the stapes"
        got = f"points that span {span:.3g} mm, their middle {distance:.3g} mm from it"
        step = "Check their unit and coordinate system (LPS or RAS)"
        raise StapeskitError.of("the points of --plate-fiducials", expected, got, next_step=step)


def _from_corners(fiducials: PlateFiducials, stapes_mm: Array) -> PlateFrame:
    """Return the frame of a face by its corners, in any order, with the covariance that theirs give it."""
    from scipy.spatial import ConvexHull

    points, sd = fiducials.scan_mm, fiducials.sd_mm
    sd = np.full(len(points), _HAND_SD_MM) if sd is None else sd
    away = points - points.mean(axis=0)
    _, size, axes = np.linalg.svd(away)
    if size[1] < 1e-3 * size[0]:
        raise _no_face("points on a line", "Add a point off that line")
    ring = ConvexHull(away @ axes[:2].T).vertices
    if len(ring) < _LEAST_CORNERS:
        raise _no_face(
            f"{len(ring)}, whose middle is not that of the face", f"Add the others, or {_REFERENCES}"
        )
    off = float(np.max(np.abs(away @ axes[2])))
    if off > max(_FLAT_MM, _APART_SD * float(sd.max())):
        raise _no_face(
            f"points {off:.2g} mm off their plane", f"Leave out what is no corner, or {_REFERENCES}"
        )
    corners = points[ring]
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    along = int(np.argmax(lengths))
    pose = _corner_pose(corners, along, stapes_mm)
    covariance = np.zeros((6, 6))
    for corner, axis in np.ndindex(corners.shape):
        moved = corners.copy()
        moved[corner, axis] += _STEP_MM
        step = displacement(pose, _corner_pose(moved, along, stapes_mm)) * sd[ring[corner]] / _STEP_MM
        covariance += np.outer(step, step)
    square = np.abs(sides @ sides[along]) < 0.7 * lengths * lengths[along]
    ratio = float(np.max(lengths[square], initial=0.0) / lengths[along])
    notices = tuple(axis_notices(pose.rotation[:, 0], ratio, "side between the --plate-fiducials"))
    return PlateFrame(pose, covariance, corners, False, "fiducials", notices)


def _corner_pose(corners: Array, along: int, stapes_mm: Array) -> RigidTransform:
    """Return scan_from_plate of a face by its corners (n, 3) in order; x along the side after ``along``."""
    middle = corners.mean(axis=0)
    axes = np.linalg.svd(corners - middle)[2]
    normal = axes[2] * (np.sign(axes[2] @ (stapes_mm - middle)) or 1.0)
    side = corners[(along + 1) % len(corners)] - corners[along]
    frame = axes_matrix(positive_sense(side - (side @ normal) * normal), normal)
    origin = middle + axes[:2].T @ centroid((corners - middle) @ axes[:2].T)
    return RigidTransform.from_parts(frame, origin, "scan", "plate")


def _no_face(got: str, step: str) -> StapeskitError:
    expected = f"at least {_LEAST_CORNERS} corners of the plate's face"
    return StapeskitError.of("the points of --plate-fiducials", expected, got, next_step=step)
