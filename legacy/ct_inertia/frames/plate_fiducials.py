"""The plate frame from points that a person measured in the scan, instead of from fitted faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legacy.ct_inertia.bodies import PlateFrame
from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.plate_frame import positive_sense
from legacy.stapeskit.alignment.registration import fit_rigid
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.frames import RigidTransform, axes_matrix
from legacy.stapeskit.option_names import named
from legacy.stapeskit.tables.csv_table import read_table
from legacy.stapeskit.warnings import Notice

_SCAN = ("x_mm", "y_mm", "z_mm")
_PLATE = ("x_ref_mm", "y_ref_mm", "z_ref_mm")
_AMBIGUOUS = calibrated("plate_frame.ambiguous_edges")


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
    plate_mm: Array | None
    sd_mm: Array | None


def read_plate_fiducials(path: Path) -> PlateFiducials:
    """Read ``name, x_mm, y_mm, z_mm [, x_ref_mm, y_ref_mm, z_ref_mm] [, sd_mm]``.

    Raises
    ------
    CtInertiaError
        A column is missing, a cell is empty, a name is repeated, or there are fewer than 3 points.
    """
    columns: list[str] = []

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        columns.extend(header)
        wanted = [*_SCAN, *(_PLATE if any(name in header for name in _PLATE) else ())]
        missing = [name for name in ("name", *wanted) if name not in header]
        if missing:
            raise CtInertiaError.of(
                "the columns of {plate_fiducials}",
                "name, x_mm, y_mm, z_mm, or these with x_ref_mm, y_ref_mm, z_ref_mm",
                f"no {', '.join(missing)}",
                file,
                next_step="Add the missing columns",
            )
        return {*wanted, *(("sd_mm",) if "sd_mm" in header else ())}, {"name"}

    table = read_table(path, choose)
    faults = list(table.faults)
    for column, values in table.numbers.items():
        faults += [
            Fault(column, "a finite number", "nothing", table.where(int(row)), next_step="Fill in the cell")
            for row in np.flatnonzero(~np.isfinite(values))
        ]
    raise_all(CtInertiaError, faults)
    codes, known = table.texts["name"].codes, table.texts["name"].names
    names = tuple(known[code] if code >= 0 else str(row + 1) for row, code in enumerate(codes))
    if len(set(names)) != len(names):
        raise CtInertiaError.of(
            "the names of {plate_fiducials}",
            "different",
            ", ".join(names),
            path.name,
            next_step="Rename one of them",
        )
    if len(names) < 3:
        raise CtInertiaError.of(
            "{plate_fiducials}",
            "at least 3 points",
            len(names),
            path.name,
            next_step="Add points that are not on one line",
        )
    scan = np.column_stack([table.numbers[name] for name in _SCAN])
    plate = np.column_stack([table.numbers[name] for name in _PLATE]) if _PLATE[0] in columns else None
    sd = table.numbers.get("sd_mm")
    if sd is not None and np.any(sd <= 0.0):
        raise CtInertiaError.of(
            "sd_mm",
            "positive",
            float(sd.min()),
            path.name,
            next_step="Give the standard deviation of a point in mm, or leave the column out",
        )
    return PlateFiducials(names, scan, plate, sd)


def plate_frame_from_fiducials(fiducials: PlateFiducials, stapes_mm: Array) -> PlateFrame:
    """Return the plate frame that fiducials define.

    Parameters
    ----------
    fiducials : PlateFiducials
        With coordinates in the plate frame: a rigid fit. Without: corners of the plate's face in any
        order; y out of their plane towards the stapes, x along the longest side, origin their centroid.
    stapes_mm : ndarray, (3,)
        A point of the stapes, scan coordinates.

    Raises
    ------
    CtInertiaError
        Corners on a line.
    KinematicsError
        Points that fit only as a mirror image, or lie on a line.
    """
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
    return PlateFrame(fit.transform, fit.covariance_si, np.zeros((0, 3)), False, "fiducials", fit.notices)


def _from_corners(fiducials: PlateFiducials, stapes_mm: Array) -> PlateFrame:
    points = fiducials.scan_mm
    centre = points.mean(axis=0)
    _, size, axes = np.linalg.svd(points - centre)
    if size[1] < 1e-3 * size[0]:
        raise CtInertiaError.of(
            "the points of {plate_fiducials}",
            "corners of a face",
            "points on a line",
            next_step="Add a point off that line",
        )
    normal = axes[2] * (np.sign(axes[2] @ (stapes_mm - centre)) or 1.0)
    flat = (points - centre) @ axes[:2].T
    ring = points[np.argsort(np.arctan2(flat[:, 1], flat[:, 0]))]
    sides = np.roll(ring, -1, axis=0) - ring
    lengths = np.linalg.norm(sides, axis=1)
    longest = sides[int(np.argmax(lengths))]
    frame = axes_matrix(positive_sense(longest - (longest @ normal) * normal), normal)
    other = [
        length
        for side, length in zip(sides, lengths, strict=True)
        if abs(side @ longest) < 0.7 * length * lengths.max()
    ]
    listed = ", ".join(f"{value:+.3f}" for value in frame[:, 0])
    notices = [
        Notice(
            "plate_axis_sign",
            f"x of the plate frame is the longest side between the {named('plate_fiducials')} in the "
            "sense with the "
            f"positive component along scan x, [{listed}] in scan axes.",
        )
    ]
    if max(other, default=0.0) > _AMBIGUOUS * lengths.max():
        notices.append(
            Notice(
                "plate_axis_ambiguous",
                f"Two sides between the {named('plate_fiducials')} are nearly equally long: which of them "
                "is x is "
                "ambiguous. Give their x_ref_mm, y_ref_mm, z_ref_mm.",
            )
        )
    transform = RigidTransform.from_parts(frame, centre, "scan", "plate")
    local = transform.inverse().points(points)
    fit = fit_rigid(local, points, _sd(fiducials, local), to="scan", source="plate")
    return PlateFrame(transform, fit.covariance_si, ring, False, "fiducials", tuple(notices))


def _sd(fiducials: PlateFiducials, local: Array) -> Array:
    """Return the sd given, or the scatter of the corners about their plane (at least 1 um)."""
    if fiducials.sd_mm is not None:
        return fiducials.sd_mm
    freedom = max(len(local) - 3, 1)
    scatter = float(np.sqrt(np.sum(local[:, 1] ** 2) / freedom))
    return np.full(len(local), max(scatter, 1e-3))
