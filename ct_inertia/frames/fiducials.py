"""The plate frame from points that a person measured in the scan, instead of from fitted faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ct_inertia.frames.plate_frame import PlateFrame, axis_notices, positive_sense
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.frames import RigidTransform, axes_matrix
from stapeskit.registration import fit_rigid
from stapeskit.tables import read_table

_SCAN = ("x_mm", "y_mm", "z_mm")
_PLATE = ("x_ref_mm", "y_ref_mm", "z_ref_mm")
_SIZES_MM = (0.5, 100.0)  # of what the points span: a plate of some millimetres, typed in mm
_FARTHEST = 5.0  # distance of the stapes from their middle, in what they span: the plate lies beside it
_LEAST_SD_MM = 1e-3  # of corners typed to a micrometre that happen to lie in one plane


@dataclass(frozen=True)
class PlateFiducials:
    """Points of the plate found in the scan.

    Attributes
    ----------
    names : tuple of str, (n,)
    scan_mm : ndarray, (n, 3)
    plate_mm : ndarray, (n, 3), or None
        The same points in the plate frame; None: the points are corners of the plate's face.
    sd_mm : ndarray, (n,), or None
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
    """Return the plate frame that fiducials define.

    Parameters
    ----------
    fiducials : PlateFiducials
        With coordinates in the plate frame: a rigid fit. Without: corners of the plate's face in any order;
        y out of their plane towards the stapes, x along the longest side, origin their centroid.
    stapes_mm : ndarray, (3,)
        A point of the stapes, scan coordinates.

    Raises
    ------
    StapeskitError
        Points on a line, far from the stapes, or that fit only as a mirror image; points in one plane that
        have the stapes behind the plate.
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
    points = fiducials.scan_mm
    centre = points.mean(axis=0)
    _, size, axes = np.linalg.svd(points - centre)
    if size[1] < 1e-3 * size[0]:
        step = "Add a point off that line"
        thing = "the points of --plate-fiducials"
        raise StapeskitError.of(thing, "corners of a face", "points on a line", next_step=step)
    normal = axes[2] * (np.sign(axes[2] @ (stapes_mm - centre)) or 1.0)
    flat = (points - centre) @ axes[:2].T
    ring = points[np.argsort(np.arctan2(flat[:, 1], flat[:, 0]))]
    sides = np.roll(ring, -1, axis=0) - ring
    lengths = np.linalg.norm(sides, axis=1)
    longest = sides[int(np.argmax(lengths))]
    frame = axes_matrix(positive_sense(longest - (longest @ normal) * normal), normal)
    square = np.abs(sides @ longest) < 0.7 * lengths * lengths.max()
    ratio = float(np.max(lengths[square], initial=0.0) / lengths.max())
    transform = RigidTransform.from_parts(frame, centre, "scan", "plate")
    local = transform.inverse().points(points)
    sd = fiducials.sd_mm
    if sd is None:  # the scatter of the corners about their plane
        scatter = float(np.sqrt(np.sum(local[:, 1] ** 2) / max(len(local) - 3, 1)))
        sd = np.full(len(local), max(scatter, _LEAST_SD_MM))
    fit = fit_rigid(local, points, sd, to="scan", source="plate")
    notices = tuple(axis_notices(frame[:, 0], ratio, "side between the --plate-fiducials"))
    return PlateFrame(transform, fit.covariance_si, ring, False, "fiducials", notices)
