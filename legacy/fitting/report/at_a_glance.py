"""The first table of a result: whether to believe K and D, their diagonals, modes, axes, how they came."""

from __future__ import annotations

import numpy as np

from legacy.fitting.causes.catalogue import title_of
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.report.kd_json import principal_axes_json
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page.numbers import plus_minus
from legacy.stapeskit.page.quantities import MASS, diagonal_unit
from legacy.stapeskit.warnings import VERDICTS, table

# Principal axes are found to a right angle: a standard deviation of half of it says nothing.
_ANY_TURN_DEG = 45.0


def summary_rows(fit: KDFit) -> list[tuple[str, str]]:
    """Return the table that a command prints."""
    stiffness_sd, damping_sd = fit.standard_deviation
    rows = [("believe K and D?", _belief(fit))]
    for letter, values, sds in (("K", fit.stiffness, stiffness_sd), ("D", fit.damping, damping_sd)):
        for place, name in enumerate(fit.dof):
            unit, value, sd = (
                diagonal_unit(letter, name, fit.law.time_power),
                values[place, place],
                sds[place, place],
            )
            rows.append((f"{letter}({name})", _format_determined(value, sd, unit.with_sd(value, sd))))
    deviations = (fit.derived.frequency_sd_hz, fit.derived.damping_ratio_sd)
    for number, (mode, sd, ratio) in enumerate(zip(fit.modes.pairs, *deviations, strict=True), 1):
        frequency = _format_determined(mode.frequency_hz, sd, f"{plus_minus(mode.frequency_hz, sd)} Hz")
        damping = _format_determined(mode.damping_ratio, ratio, plus_minus(mode.damping_ratio, ratio))
        rows.append((f"mode {number}", f"{frequency}, damping ratio {damping}"))
    if not fit.modes.pairs:
        rows.append(("modes", "none oscillates"))
    axes = principal_axes_json(fit)
    if axes is not None:
        rows.append(
            (
                "principal axes",
                f"origin x {axes['origin_x_mm']:.3f} ± {_sd(axes['origin_x_sd_mm'])}, "
                f"z {axes['origin_z_mm']:.3f} ± {_sd(axes['origin_z_sd_mm'])} mm, "
                f"turned {_angle(axes['angle_deg'], axes['angle_sd_deg'])} about y",
            )
        )
    rows.append(("stable, passive", f"{_yes(fit.modes.stable)}, {_yes(all(fit.passive))}"))
    ratio = f"{fit.chi2 / fit.n_dof:.3f}" if fit.n_dof > 0 else "none left"
    rows.append(("chi2 per degree of freedom", f"{ratio} ({fit.n_dof})"))
    rows.append(("in-plane motion", f"{'load' if fit.inplane.used else 'not used'}: {fit.inplane.reason}"))
    if fit.ligament is not None:
        height, height_sd = (1e3 * value for value in fit.ligament.height)
        rows.append(
            ("plane of the ligament", f"{plus_minus(height, height_sd)} mm above the footplate centre")
        )
    if fit.fluid is not None:
        mass, sd = fit.fluid.mass_kg, fit.fluid.mass_sd_kg
        used = "none" if mass is None or sd is None else MASS.with_sd(mass, sd)
        rows.append(("mass of fluid", f"{used}: {fit.fluid.reason}"))
    if fit.diagnosis is not None:
        named = fit.diagnosis.named
        outcome = "no cause is called for" if named is None else f"the data speak for {title_of(named.name)}"
        if named is None and fit.diagnosis.searched:
            outcome = "NO, and no cause of the catalogue explains it"
        rows.append(("is the model right?", outcome))
    worst = fit.identifiability
    rows.append(("worst combination", f"{worst.describe(0)}: relative sd {worst.percent(0)}"))
    return rows


def _belief(fit: KDFit) -> str:
    """Return whether to believe K and D: by what their warnings lead to, and by what is undetermined."""
    stiffness_sd, damping_sd = (np.diag(sd) for sd in fit.standard_deviation)
    lost = _undetermined_entries("K", fit.dof, np.diag(fit.stiffness), stiffness_sd)
    weak = _undetermined_entries("D", fit.dof, np.diag(fit.damping), damping_sd)
    if lost:
        return f"{VERDICTS[-1]}: {', '.join([*lost, *weak])} undetermined"
    entries = table()
    codes = dict.fromkeys(notice.code for notice in fit.notices)
    named = None if fit.diagnosis is None else fit.diagnosis.named
    words = {} if named is None else {"cause_found": title_of(named.name)}
    for level in reversed(VERDICTS[1:]):
        reasons = [
            words.get(code, code)
            for code in codes
            if (entries[code].verdict if code in entries else VERDICTS[1]) == level
        ]
        if level == VERDICTS[1] and weak:
            reasons.append(f"{', '.join(weak)} undetermined")
        if reasons:
            return f"{level}: {', '.join(reasons)}"
    return "yes: no warning speaks against them"


def _undetermined_entries(letter: str, dof: tuple[str, ...], values: Array, sds: Array) -> list[str]:
    """Name the entries of a diagonal that are not above their standard deviation."""
    return [
        f"{letter}({name})" for name, value, sd in zip(dof, values, sds, strict=True) if not sd <= abs(value)
    ]


def _format_determined(value: float, sd: float | None, text: str) -> str:
    """Return the text of a positive value; one below its standard deviation is undetermined."""
    return f"undetermined ({text})" if sd is not None and sd > abs(value) else text


def _angle(value_deg: float, sd_deg: float | None) -> str:
    """Return a turn; known to no better than half a right angle it is undetermined."""
    if sd_deg is not None and sd_deg > _ANY_TURN_DEG:
        return "by an undetermined angle"
    return f"{value_deg:.2f} ± {_sd(sd_deg)} degrees"


def _yes(value: bool) -> str:
    return "yes" if value else "NO"


def _sd(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2g}"
