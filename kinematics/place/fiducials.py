"""Read fiducials: points seen by the vibrometer that are known on the plate, the scan or the footplate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kinematics.measurement import MIRRORS
from kinematics.readers.points import POSITION, REFERENCE, read_named, text_of
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError, raise_all

FRAMES = ("plate", "scan", "footplate")

_APART_MM = (0.1, 300.0)  # a footplate is 2 mm long, a holder 100 mm: beyond, they are in another unit


@dataclass(frozen=True)
class Fiducials:
    """Paired points (n, 3), the references in ``frame`` out of `FRAMES`; ``file`` is for messages.

    ``sd_mm`` (n,) is the standard deviation per coordinate of the difference of a pair; None when not stated.
    """

    names: tuple[str, ...]
    vibrometer_mm: Array
    reference_mm: Array
    frame: str
    sd_mm: Array | None = None
    file: str = ""

    def mirrored(self, axis: str) -> Fiducials:
        """Return the fiducials with one axis of the left-handed vibrometer coordinates reversed."""
        return replace(self, vibrometer_mm=self.vibrometer_mm * np.array(MIRRORS[axis]))


def read_fiducials(path: Path) -> Fiducials:
    """Read a fiducials file: name, x_mm, y_mm, z_mm, x_ref_mm, y_ref_mm, z_ref_mm [, frame] [, sd_mm].

    Raises
    ------
    StapeskitError
        A column is missing, a cell is no finite number, a name is repeated, a frame is unknown or not the
        same for all, an sd is not positive or stated for some fiducials only; all faults are listed. Or all
        fiducials lie next to each other or far apart, as in another unit.
    """
    table, faults = read_named(path, ("name", *POSITION, *REFERENCE), ("frame", "sd_mm"))
    rows = range(len(table))
    names = tuple(text_of(table, "name", row) for row in rows)
    frames = [text_of(table, "frame", row).lower() or "plate" for row in rows]
    sd = table.numbers.get("sd_mm", np.full(len(table), np.nan))
    stated = not np.all(np.isnan(sd))
    for row, (name, frame) in enumerate(zip(names, frames, strict=True)):
        if not name or name in names[:row]:
            got, want = f"{name} again" if name else "an empty cell", "given, and different for each fiducial"
            faults.append(Fault("name", want, got, table.where(row), "Name it"))
        if frame not in FRAMES:
            where = table.where(row, "frame")
            faults.append(Fault("frame", "plate, scan or footplate", frame, where, "Correct it"))
        elif frame != frames[0] and frames[0] in FRAMES:
            step = "Give all references in one frame: ct2mass and 3D Slicer know the scan's"
            faults.append(Fault("frame", f"the same for all, {frames[0]}", frame, table.where(row), step))
        if stated and np.isnan(sd[row]):
            step, want = "Fill it in, or leave the column out", "stated for all fiducials or for none"
            faults.append(Fault("sd_mm", want, "an empty cell", table.where(row), step))
    named = dict(zip(table.lines.tolist(), names, strict=True))
    raise_all(_with_name(fault, named) for fault in faults)
    seen, known = (np.column_stack([table.numbers[name] for name in part]) for part in (POSITION, REFERENCE))
    apart = [float(np.max(np.ptp(points, axis=0))) for points in (seen, known)]
    small, large = 0.0 < max(apart) < _APART_MM[0], min(apart) > _APART_MM[1]
    if len(names) > 1 and (small or large):
        step = (
            f"{'Multiply coordinates in metres by' if small else 'Divide coordinates in micrometres by'} 1000"
        )
        got = f"{max(apart):.3g} mm"
        raise StapeskitError.of("the fiducials", "apart by millimetres", got, table.file, step)
    return Fiducials(names, seen, known, frames[0], sd if stated else None, table.file)


def _with_name(fault: Fault, names: dict[int, str]) -> Fault:
    """Return a fault with the name of the one fiducial whose line is at fault."""
    if not isinstance(fault.where, Place) or len(fault.where.numbers) != 1:
        return fault
    name = names.get(fault.where.numbers[0])  # a row that is too short has none
    detail = ", ".join(filter(None, (fault.where.detail, f"fiducial {name}" if name else "")))
    return replace(fault, where=replace(fault.where, detail=detail))
