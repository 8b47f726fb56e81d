"""Report: how large a fault would have to be to be found."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.detectable import detectable
from kinematics.faults.diagnose import FALSE_ALARM
from kinematics.pages import page
from kinematics.pages.draw_motion import full_motion
from kinematics.pages.drawings import shortened

if TYPE_CHECKING:
    from markupsafe import Markup

    from kinematics.measurement import BodyChannels
    from kinematics.points2dof import Points2Dof

Array = NDArray[np.float64]


def detectable_blocks(result: Points2Dof) -> list[Markup]:
    """Return how large a fault would have to be to be found, typical and at the worst channel of a body."""
    if result.options.robust != "none" or result.motion.reference:
        return []
    q, rows = full_motion(result.motion), []
    for number, body in enumerate(result.measurement.bodies):
        fit = result.fits[0, number]
        if not fit.solution.good.any() or fit.is_rounding():
            continue
        alarm = FALSE_ALARM / max(1, len(result.fits)) / (4.0 * len(body.points))
        least = detectable(fit, body, q[0, number], alarm)
        for what, unit, values in (
            ("gain of a channel", "%", 100.0 * least.gain),
            ("direction of a beam", "°", np.rad2deg(least.angle_rad)),
            ("position of a point", "µm", 1e6 * least.shift_m),
        ):
            rows.append((body.body, what, *_typical_and_worst(values, unit, body)))
    if not rows:
        return []
    run = f" in run {result.motion.runs[0]}" if len(result.motion.runs) > 1 else ""
    return [
        page.subheading("What would have been found"),
        page.table(("body", "error of", "typical", "largest", "at"), rows, words=True),
        page.text(
            f"The smallest error{run} that is found with 95 % probability, along the direction in which it "
            "shows least; smaller ones can hide behind a clean verdict. A dash: it would never show."
        ),
    ]


def _typical_and_worst(values: Array, unit: str, body: BodyChannels) -> tuple[str, str, str]:
    known = np.isfinite(values)
    if not np.any(known):
        return "-", "-", "-"
    worst = int(np.nanargmax(values))
    blind = [body.points[c] for c in np.flatnonzero(~known)]
    at = body.points[worst] + (f"; none at {', '.join(dict.fromkeys(blind))}" if blind else "")
    typical, largest = float(np.nanmedian(values)), float(values[worst])
    return f"{typical:.3g} {unit}", f"{largest:.3g} {unit}", shortened(at, 60)
