"""Modes on the page: table, shapes over the footplate, and what is published of the ligament."""

from __future__ import annotations

from typing import TYPE_CHECKING

from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.model import NORMALISATION
from legacy.fitting.model.principal_axes import PRINCIPAL_DOF
from legacy.fitting.report.mode_shapes import shape_figure
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page import page
from legacy.stapeskit.page.numbers import plus_minus
from legacy.stapeskit.page.page import Section
from legacy.stapeskit.spatial import DOF_UNITS

if TYPE_CHECKING:
    from markupsafe import Markup

# Elements of the stapes in the circuit of Hudde and Engel 1998, Acustica 84:720, 894 and 1091: 1.2 mm/N,
# 0.018 N s/m, 3 mg. Read as Sankowsky-Rothe et al. 2022, Acta Acustica, take them over for their program.
_CIRCUIT = "circuit model (Hudde and Engel 1998, Acustica 84, quoted by Sankowsky-Rothe et al. 2022)"
# Piston stiffness K(y), N/m, of human ears with the reference; CURAC 2019, p. 98 ff., cites the mean.
PUBLISHED_PISTON = (
    ("1722", "vibrations of one stapes, 400 to 5000 Hz (CURAC 2019, p. 98 ff.)"),
    ("1238 ± 973", "mean of published values (given there)"),
    ("833", _CIRCUIT),
    ("120", "atomic force microscopy (Kwacz et al. 2015, doi:10.1007/s10162-015-0525-9)"),
)
# Piston damping D(y), N s/m.
PUBLISHED_PISTON_DAMPING = (("0.0229", "one stapes (CURAC 2019, p. 98 ff.)"), ("0.018", _CIRCUIT))
# Damped frequencies of the modes, Hz, of that stapes, its incus removed and its cochlea open.
PUBLISHED_MODES_HZ = (1753.0, 2783.0, 3862.0)


def modes_section(fit: KDFit, outline_mm: Array | None) -> Section:
    """Return frequencies, damping ratios and shapes with their deviations, drawn on the footplate."""
    header = ["mode", "damped (Hz)", "undamped (Hz)", "damping ratio"]
    scales = [("nm", 1e9) if DOF_UNITS[name] == "m" else ("µrad", 1e6) for name in fit.dof]
    header += [f"|φ| {name} ({unit})" for name, (unit, _) in zip(fit.dof, scales, strict=True)]
    rows = []
    for place, mode in enumerate(fit.modes.pairs):
        derived = fit.derived
        cells = [
            str(place + 1),
            plus_minus(mode.frequency_hz, derived.frequency_sd_hz[place]),
            plus_minus(mode.undamped_frequency_hz, derived.undamped_frequency_sd_hz[place]),
            plus_minus(mode.damping_ratio, derived.damping_ratio_sd[place]),
        ]
        for index, (_, scale) in enumerate(scales):
            value, sd = abs(mode.shape[index]) * scale, derived.shape_sd[place, index] * scale
            cells.append(plus_minus(value, sd))
        rows.append(cells)
    section = Section("Modes", key="modes").add(
        page.table(header, rows),
        page.text(f"Shapes have {NORMALISATION}; the units only name the scaling (paper Table 2)."),
    )
    if fit.modes.overdamped_roots_1_s:
        roots = ", ".join(f"{value:.4g}" for value in fit.modes.overdamped_roots_1_s)
        section.add(page.text(f"Overdamped motions, real eigenvalues (1/s): {roots}."))
    if fit.dof == PRINCIPAL_DOF and fit.modes.pairs:
        caption = (
            "Piston and rocking of the footplate from lateral, where it is largest (above) and a quarter of "
            "a period later (below), with the nodal line, which moves where damping makes a mode complex."
        )
        section.add(page.figure(shape_figure(fit.modes, outline_mm), caption, "mode shapes on the footplate"))
        section.add(*_compare_published(fit))
    return section


def _compare_published(fit: KDFit) -> tuple[Markup, ...]:
    """Return heading and table that compare published stiffnesses and frequencies with those of the fit."""
    value, sd = fit.stiffness[0, 0], fit.standard_deviation[0][0, 0]
    rows = [("K(y) (N/m)", plus_minus(value, sd), other, source) for other, source in PUBLISHED_PISTON]
    if fit.law.name == "viscous":
        own = plus_minus(fit.damping[0, 0], fit.standard_deviation[1][0, 0])
        rows += [("D(y) (N s/m)", own, other, source) for other, source in PUBLISHED_PISTON_DAMPING]
    pairs = zip(fit.modes.pairs, fit.derived.frequency_sd_hz, PUBLISHED_MODES_HZ, strict=False)
    for place, (mode, frequency_sd, other) in enumerate(pairs, 1):
        own = plus_minus(mode.frequency_hz, float(frequency_sd))
        rows.append((f"mode {place}, damped (Hz)", own, f"{other:g}", "CURAC 2019, p. 98 ff."))
    return page.subheading("Beside what is published"), page.table(
        ("", "here", "published", "source"), rows, words=True
    )
