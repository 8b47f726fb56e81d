"""Report: how large a fault would have to be to be found, and what never shows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from legacy.kinematics.faults.detectable import SHIFT_UM, TURN_DEG, Detectable, detectable, invisible
from legacy.kinematics.faults.judges.phase_convention import rms_would_show
from legacy.kinematics.faults.packed_readings import MOST_CHANNELS
from legacy.kinematics.faults.proposals.two_bodies import Pair
from legacy.kinematics.faults.proposals.unit_slips import FASTEST, SLOWEST
from legacy.kinematics.faults.search import FALSE_ALARM
from legacy.kinematics.measurement import direction_name
from legacy.kinematics.registration.prior_errors import shown
from legacy.kinematics.report.draw_motion import full_motion
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page import page
from legacy.stapeskit.page.drawings import shorten_name

if TYPE_CHECKING:
    from markupsafe import Markup

    from legacy.kinematics.measurement import BodyChannels
    from legacy.kinematics.points2dof import Points2Dof

# Rows of the table; a direction that is off by more than 60 degrees is written as such.
_MOST_POINTS = 400
_MOST_DEG = 60.0


def detectable_blocks(result: Points2Dof) -> list[Markup]:
    """Return how large a fault would have to be to be found, per body and point, and what never shows."""
    return [*_detectable_items(result), *_undetectable_items(result)]


def _detectable_items(result: Points2Dof) -> list[Markup]:
    if result.options.robust != "none" or result.motion.reference:
        return []
    rows: list[tuple[str, ...]] = []
    points: list[tuple[str, ...]] = []
    for number, body in enumerate(result.measurement.bodies):
        fit = result.fits[0, number]
        if not fit.solution.good.any() or fit.is_rounding() or len(body.points) > MOST_CHANNELS:
            continue
        alarm = FALSE_ALARM / max(1, len(result.fits)) / (4.0 * len(body.points))
        least = detectable(fit, body, result.measurement.freq_hz, alarm)
        kinds = (
            ("gain of a channel", "%", 100.0 * least.gain),
            ("direction of a beam", "°", np.rad2deg(least.angle_rad)),
            ("position of a point", "µm", 1e6 * least.shift_m),
        )
        for what, unit, values in kinds:
            rows.append((body.body, what, *_typical_and_worst(values, unit, body)))
        rows += _joint_rows(least, body)
        points += _point_rows(body, [(unit, values) for _, unit, values in kinds])
    rows += _laser_rows(result)
    if not rows:
        return []
    large = [body.body for body in result.measurement.bodies if len(body.points) > MOST_CHANNELS]
    left_out = (
        f" Not computed for {', '.join(large)}, of more than {MOST_CHANNELS} channels." if large else ""
    )
    run = f" in run {result.motion.runs[0]}" if len(result.motion.runs) > 1 else ""
    blind = any(cell == "-" for row in (*rows, *points) for cell in row)
    dash = " A dash: it would never show." if blind else ""
    return [
        page.subheading("What would have been found"),
        page.table(("body", "error of", "typical", "largest", "at"), rows, words=True),
        page.text(
            f"The smallest error{run} that is found with 95 % probability, along the direction in which it "
            f"shows least; smaller ones can hide behind a clean verdict.{dash}{left_out}"
        ),
        page.folded(
            "Every point",
            page.table(("body", "point", "gain", "direction", "position"), points[:_MOST_POINTS]),
            page.text("The largest of the beams of each point."),
        ),
    ]


def _laser_rows(result: Points2Dof) -> list[tuple[str, ...]]:
    """Return the rows of errors of one laser next to the stated scatter of all."""
    lasers = result.lasers
    if lasers is None or any(body.sd is None or body.relative for body in result.measurement.bodies):
        return []
    rows: list[tuple[str, ...]] = []
    sizes = lasers.estimate.detectable.reshape(-1, len(lasers.directions))
    kinds = dict.fromkeys(name.partition(".")[0] for name in lasers.names)
    for kind, values in zip(kinds, sizes, strict=True):
        name, factor, unit = shown(kind)
        worst = int(np.argmax(values))
        both = (float(np.median(values)), float(values[worst]))
        cells = [size_of(factor * value, unit) if np.isfinite(value) else "-" for value in both]
        at = f"beams along ({direction_name(lasers.directions[worst])})"
        rows.append(("all", f"{name} of a laser", *cells, at))
    return rows


def _joint_rows(chances: Detectable, body: BodyChannels) -> list[tuple[str, ...]]:
    """Return the rows of turned axes and exchanged points."""
    turn = "-" if np.isnan(chances.axes_rad) else size_of(float(np.rad2deg(chances.axes_rad)), "°")
    rows: list[tuple[str, ...]] = [(body.body, "axes of all beams together", turn, turn, "all points")]
    for first, second, distance, chance in chances.pairs:
        words = "found in > 99.9 %" if chance > 0.999 else f"found in {100.0 * chance:.3g} %"
        where = f"{first} and {second}, {distance:.2g} mm apart"
        rows.append((body.body, "names of two points exchanged", words, words, where))
    return rows


def _point_rows(body: BodyChannels, kinds: list[tuple[str, Array]]) -> list[tuple[str, ...]]:
    rows = []
    for point in dict.fromkeys(body.points):
        own = [c for c, name in enumerate(body.points) if name == point]
        cells = []
        for unit, values in kinds:
            value = float(np.max(values[own]))
            cells.append("-" if np.isnan(value) else size_of(value, unit))
        rows.append((body.body, point, *cells))
    return rows


def _undetectable_items(result: Points2Dof) -> list[Markup]:
    """Return what errors that leave no residual at all would do to the motion."""
    q, rows = full_motion(result.motion), []
    dof = result.motion.dof
    for number, body in enumerate(result.measurement.bodies):
        if not np.any(np.isfinite(q[0, number]).all(axis=1)):
            continue
        errors = invisible(q[0, number], dof, body.directions)
        rows.append((body.body, f"points and beams turned together by {TURN_DEG:g}°", *_shares(errors.turn)))
        rows.append((body.body, f"all points shifted together by {SHIFT_UM:g} µm", *_shares(errors.shift)))
        if np.any(np.isfinite(errors.tilt)):
            what = f"the one beam direction tilted by {TURN_DEG:g}°, as much motion across as along"
            rows.append((body.body, what, *_shares(errors.tilt)))
    pair = Pair.of(result.motion, "stapes", "base", derivatives=result.measurement.order)
    rigid = not any(diagnosis.bends for diagnosis in result.diagnoses.values())
    slipped = any(notice.code == "unit_slip" for notice in result.notices)
    shown_rms = slipped or (pair is not None and rigid and rms_would_show(pair))
    if len(result.measurement.bodies) > 1 and not shown_rms:
        rms = [f"{100.0 * (1.0 - np.sqrt(0.5)):.2g} %"] * len(dof)
        rows.append(("one of them", "readings of that body alone in rms instead of peak values", *rms))
    if not rows:
        return []
    rows.append(("all", "all readings too large by 1 %", *["1 %"] * len(dof)))
    scale = ""
    if pair is not None and not slipped:
        scale = (
            " One of stapes and base in rms would have been found by the ligament that joins them."
            if shown_rms
            else " One of stapes and base in rms could not be told from these lines and this noise, not even "
            "by the ligament that joins them."
        )
    single = any("tilted" in row[1] for row in rows)
    tilt = "" if single else " A tilt of the beams against the points would show, as their directions differ."
    return [
        page.subheading("What never shows"),
        page.table(("body", "error", *dof), rows, words=True),
        page.text(
            "Such errors move beams and points alike, or scale a whole body, and leave residuals of exactly "
            f"zero: only markers and the alignment of the vibrometer guard against them.{scale} Change (rms "
            "over frequency) of each degree of freedom relative to itself, about the worst axis; "
            f"proportional to the error.{tilt}"
        ),
        page.text(
            "A factor that all readings of all bodies have (the gain of the whole system, amplitudes a "
            "thousand times too large or too small) changes no K and no D, for these are ratios of motions. "
            "It is recognised only where velocities leave the range of ears in experiments, "
            f"{SLOWEST:g} to {FASTEST:g} m/s."
        ),
    ]


def _shares(values: Array) -> list[str]:
    return ["-" if np.isnan(v) else ("0" if v < 1e-9 else f"{100.0 * v:.2g} %") for v in values]


def size_of(value: float, unit: str) -> str:
    """Write the size of a fault to three digits.

    Notes
    -----
    An angle is that of a small tilt, sin(angle) = angle; for large ones the result is given as a bound.
    """
    if unit == "°" and value > _MOST_DEG:
        return f"> {_MOST_DEG:g}°"
    if unit == "µm" and value >= 999.5:
        value, unit = 1e-3 * value, "mm"
    return f"{float(f'{value:.3g}'):g}{'' if unit == '°' else ' '}{unit}"


def _typical_and_worst(values: Array, unit: str, body: BodyChannels) -> tuple[str, str, str]:
    known = np.isfinite(values)
    if not np.any(known):
        return "-", "-", "-"
    worst = int(np.nanargmax(values))
    blind = [body.points[c] for c in np.flatnonzero(~known)]
    at = body.points[worst] + (f"; none at {', '.join(dict.fromkeys(blind))}" if blind else "")
    typical, largest = float(np.nanmedian(values)), float(values[worst])
    return size_of(typical, unit), size_of(largest, unit), shorten_name(at, 60)
