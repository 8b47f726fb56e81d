"""The rows of a fit on the terminal and at the top of pages: verdict, K, D, modes, axes, method."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fitting.likelihood import LOAD, PLANE
from fitting.ring import rim_of
from stapeskit.report.quantities import HERTZ, Quantity, diagonal_unit, plus_minus

if TYPE_CHECKING:
    from fitting.result import KDFit

# Principal axes are found to a right angle: a standard deviation of half of it says nothing.
_ANY_TURN_DEG = 45.0


def summary_rows(fit: KDFit) -> list[tuple[str, str]]:
    """Return the table of a fit."""
    rows = [("verdict", fit.verdict.sentence)]
    for letter, values, sds in zip("KD", (fit.stiffness, fit.damping), fit.standard_deviation, strict=True):
        for place, name in enumerate(fit.dof):
            unit = diagonal_unit(letter, name, fit.law.time_power)
            entry = Quantity(float(values[place, place]), float(sds[place, place]), unit, positive=True)
            rows.append((f"{letter}({name})", str(entry)))
    derived = fit.derived
    for number, mode in enumerate(fit.modes.pairs):
        frequency = Quantity(mode.frequency_hz, float(derived.frequency_sd_hz[number]), HERTZ, positive=True)
        damping = Quantity(mode.damping_ratio, float(derived.ratio_sd[number]), positive=True)
        rows.append((f"mode {number + 1}", f"{frequency}, damping ratio {damping}"))
    if not fit.modes.pairs:
        rows.append(("modes", "none oscillates"))
    rim = rim_of(fit)
    if rim is not None:
        rows.append(("along the rim", rim.sentence()))
    return [*rows, *model_rows(fit)]


def model_rows(fit: KDFit) -> list[tuple[str, str]]:
    """Return what follows from K and D, and whether the model holds."""
    rows, derived = [], fit.derived
    if derived.axes is not None and derived.axes_sd is not None:
        x, z = (plus_minus(1e3 * derived.axes[k], 1e3 * float(derived.axes_sd[k])) for k in (0, 1))
        angle, angle_sd = np.degrees(derived.axes[2]), float(np.degrees(derived.axes_sd[2]))
        turn = "by an undetermined angle" if angle_sd > _ANY_TURN_DEG else f"{plus_minus(angle, angle_sd)}°"
        rows.append(("principal axes", f"origin x {x}, z {z} mm, turned {turn} about y"))
    yes = {True: "yes", False: "NO"}
    rows.append(("stable, passive", f"{yes[fit.modes.stable]}, {yes[all(fit.passive)]}"))
    ratio_text = f"{fit.found.level:.3f} ({fit.found.n_dof})" if fit.found.n_dof > 0 else "none left"
    rows.append(("chi2 per degree of freedom", ratio_text))
    rows.append(("in-plane motion", inplane_words(fit)))
    for unknown, value, sd in fit.unknowns:
        rows.append((unknown.name, f"{plus_minus(value, sd)} {unknown.unit}, part of the model"))
    best = fit.search.best
    if fit.search.scores:
        outcome = "no cause is called for" if best is None else f"the best explanation is {best.title}"
        if best is None and not fit.found.explained:
            outcome = "NO, and nothing that was tried explains it"
        rows.append(("is the model right?", outcome))
    return rows


def inplane_words(fit: KDFit) -> str:
    """Return what was done with measured motion outside the model."""
    motion = fit.found.likelihood.model.motion
    if motion == PLANE and fit.height is not None:
        height, sd = fit.height
        return f"used; the plane of the ligament is {plus_minus(1e3 * height, 1e3 * sd)} mm above the centre"
    if motion == LOAD:
        return "used as a known inertial load"
    return "not used"
