"""Read fiducials: points seen by the vibrometer that are known on the plate, the scan or the footplate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.measurement import mirror_sign
from legacy.kinematics.tidy.points_csv import finite_faults, require, sd_faults
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, raise_all
from legacy.stapeskit.tables.csv_table import Table, read_table

FRAMES = ("plate", "scan", "footplate")
# The least footplate is 2 mm long: points closer together are in another unit.
_LEAST_APART_MM = 0.1
_SEEN = ("x_mm", "y_mm", "z_mm")
_KNOWN = ("x_ref_mm", "y_ref_mm", "z_ref_mm")
_SD_AXES = ("sd_x_mm", "sd_y_mm", "sd_z_mm")
_SD = ("sd_mm", *_SD_AXES, "sd_ref_mm")


@dataclass(frozen=True)
class Fiducials:
    """Paired points.

    Attributes
    ----------
    names : tuple of str, (n,)
    vibrometer_mm : ndarray, (n, 3)
        In vibrometer coordinates.
    reference_mm : ndarray, (n, 3)
        In the frame of the same row of ``frames``.
    frames : tuple of str, (n,)
        ``plate``, ``scan`` or ``footplate``.
    sd_mm : ndarray, (n,) or (n, 3), or None
        Standard deviation per coordinate, or along each vibrometer axis; None when not stated.
    sd_ref_mm : ndarray, (n,), or None
        Standard deviation per coordinate of the reference; None: it is part of ``sd_mm``.
    """

    names: tuple[str, ...]
    vibrometer_mm: Array
    reference_mm: Array
    frames: tuple[str, ...]
    sd_mm: Array | None = None
    path: Path | None = None
    sd_ref_mm: Array | None = None

    def mirrored(self, axis: str) -> Fiducials:
        """Return the fiducials with one axis of the left-handed vibrometer coordinates reversed.

        Raises
        ------
        KinematicsError
            The axis is not x, y or z.
        """
        return replace(self, vibrometer_mm=self.vibrometer_mm * np.array(mirror_sign(axis)))


def read_fiducials(path: Path) -> Fiducials:
    """Read a fiducials file: name, x_mm, y_mm, z_mm, x_ref_mm, y_ref_mm, z_ref_mm [, frame] [, sd_mm].

    Instead of ``sd_mm`` there may be sd_x_mm, sd_y_mm, sd_z_mm along the vibrometer's axes (depth is often
    known less well), and beside either sd_ref_mm of the reference coordinates.

    Raises
    ------
    KinematicsError
        A column is missing, a cell is no finite number, a name is repeated, a frame is unknown, or
        an sd is not positive, stated for some fiducials or some axes only, or stated both for all axes and
        for each; all faults are listed. Or all fiducials lie next to each other: another unit.
    """

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        require(header, ("name", *_SEEN, *_KNOWN), file)
        return {*_SEEN, *_KNOWN, *(set(_SD) & set(header))}, {"name", *({"frame"} & set(header))}

    table = read_table(path, choose)
    faults = [*table.faults, *finite_faults(table, (*_SEEN, *_KNOWN))]
    names, frames = _words(table, faults)
    spread = _spread(table, faults)
    raise_all(KinematicsError, [_by_name(fault, table, names) for fault in faults])
    measured, known = (np.column_stack([table.numbers[name] for name in part]) for part in (_SEEN, _KNOWN))
    apart = max(float(np.max(np.ptp(points, axis=0))) for points in (measured, known))
    if len(names) > 1 and 0.0 < apart < _LEAST_APART_MM:
        expected, step = "apart by millimetres", "Multiply coordinates in metres by 1000"
        raise KinematicsError.of("the fiducials", expected, f"{apart:.3g} mm", table.file, step)
    sd = spread.get("sd_mm")
    if _SD_AXES[0] in spread:
        sd = np.column_stack([spread[name] for name in _SD_AXES])
    return Fiducials(names, measured, known, frames, sd, Path(path), spread.get("sd_ref_mm"))


def _by_name(fault: Fault, table: Table, names: Sequence[str]) -> Fault:
    """Return a fault with the name of the one fiducial whose line is at fault."""
    if not isinstance(fault.where, Place) or len(fault.where.numbers) != 1:
        return fault
    at_fault = [name for name, line in zip(names, table.lines, strict=True) if line == fault.where.numbers[0]]
    detail = ", ".join(
        part for part in (fault.where.detail, *(f"fiducial {n}" for n in at_fault if n)) if part
    )
    return replace(fault, where=replace(fault.where, detail=detail))


def _spread(table: Table, faults: list[Fault]) -> dict[str, Array]:
    """Return the columns of standard deviations that hold something, and add their faults."""
    columns = {name: table.numbers[name] for name in _SD if name in table.numbers}
    columns = {name: values for name, values in columns.items() if not np.all(np.isnan(values))}
    for name, values in columns.items():
        faults += sd_faults(table, values, name)
        faults += [
            Fault(
                name,
                "stated for all fiducials or for none",
                "an empty cell",
                table.where(int(row)),
                "Fill it in, or leave the column out",
            )
            for row in np.flatnonzero(np.isnan(values))
        ]
    axes = [name for name in _SD_AXES if name in columns]
    if axes and (len(axes) < 3 or "sd_mm" in columns):
        got = ", ".join(name for name in (*axes, "sd_mm") if name in columns)
        step = "Give one sd_mm, or one column for each axis"
        faults.append(Fault("the sd of the fiducials", "sd_mm, or all three of " + ", ".join(_SD_AXES),
                               got, table.file, step))  # fmt: skip
    return columns


def _words(table: Table, faults: list[Fault]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    column = table.texts["name"]
    names = tuple(column.names[code] if code >= 0 else "" for code in column.codes)
    for row, name in enumerate(names):
        if not name or name in names[:row]:
            got = f"{name} again" if name else "an empty cell"
            faults.append(
                Fault("name", "given, and different for each fiducial", got, table.where(row), "Name it")
            )
    if "frame" not in table.texts:
        return names, ("plate",) * len(names)
    column = table.texts["frame"]
    frames = tuple(column.names[code].lower() if code >= 0 else "plate" for code in column.codes)
    for row, frame in enumerate(frames):
        if frame not in FRAMES:
            faults.append(
                Fault("frame", "plate, scan or footplate", frame, table.where(row, "frame"), "Correct it")
            )
    return names, frames
