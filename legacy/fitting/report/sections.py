"""The page of a fit, as sections that other reports can take over."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from legacy.fitting.budget import MODEL_ERROR
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.causality import causal_rise
from legacy.fitting.model.parameter_vector import join
from legacy.fitting.report.at_a_glance import summary_rows
from legacy.fitting.report.causes import causes_section
from legacy.fitting.report.figures import (
    correlation_figure,
    frequency_figure,
    principal_figure,
    residual_figure,
    response_figure,
)
from legacy.fitting.report.kd_json import principal_axes_json
from legacy.fitting.report.ligament_section import ligament_section
from legacy.fitting.report.modes_section import modes_section
from legacy.fitting.report.responses import responses
from legacy.fitting.report.ring_section import ring_of, ring_parts
from legacy.fitting.uncertainty.covariance import ATTENUATION, NOISE
from legacy.fitting.uncertainty.frequency_dependence import FrequencyDependence
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.option_values import WithSd
from legacy.stapeskit.page import page
from legacy.stapeskit.page.numbers import plus_minus
from legacy.stapeskit.page.page import Page, Section
from legacy.stapeskit.page.quantities import ROTATION_STIFFNESS, STIFFNESS, matrix_units
from legacy.stapeskit.records.mass_record import mass_source_words

# Runs drawn, and points up to which a figure is SVG: beyond it would be larger than its picture.
_MOST_RUNS = 4
_MOST_VECTOR_POINTS = 1000
SOURCE_WORDS = {
    NOISE: "channel noise",
    ATTENUATION: "attenuation bias",
    "registration": "registration of the vibrometer",
    "plate_frame": "plate frame in the scan",
    "footplate_frame": "footplate frame (motion and mass together)",
    "position": "point positions",
    "correction": "corrected faults of points and lasers",
    "inplane_stiffness": "stiffness in the plane of the ligament",
    "ligament_plane": "height and tilt of the ligament's plane (second order)",
    "damping_exponent": "exponent of the damping law",
    MODEL_ERROR: "what the model lacks, and weak data (chi2 is no parabola, or has several minima)",
}


def kd_sections(fit: KDFit, outline_mm: Array | None = None, gap_mm: WithSd | None = None) -> list[Section]:
    """Return the sections of a fit: warnings excepted, which the page puts first.

    Their places and headings in the report of a study are `_PARTS` in pipeline/report.py.

    Parameters
    ----------
    outline_mm : ndarray, (points, 3), optional
        Outline of the footplate in footplate axes, mm.
    gap_mm : WithSd, optional
        Width of the gap around the footplate.
    """
    sections = [
        _responses(fit),
        None if fit.diagnosis is None else causes_section(fit, fit.diagnosis),
        _matrices(fit),
        None if fit.ligament is None else ligament_section(fit, fit.ligament),
        modes_section(fit, outline_mm),
        _axes(fit, outline_mm, gap_mm),
        None if fit.frequency is None else _frequency(fit.frequency),
        _budget(fit),
        _residuals(fit),
        _identifiability(fit),
    ]
    return [section for section in sections if section is not None]


def kd_page(fit: KDFit, provenance: Mapping[str, Any], sections: Sequence[Section] | None = None) -> Page:
    """Return kd.html: summary, warnings, the sections (those of `kd_sections` by default), inputs."""
    report = Page(
        "Stiffness and damping of the annular ligament",
        f"{', '.join(fit.dof)} about the footplate centre in footplate axes; "
        f"estimator {fit.options.estimator}, "
        f"{fit.law.name} damping ({fit.law.formula}), {len(fit.observation.freq_hz)} lines.",
    )
    report.section(
        "At a glance", page.table(("", ""), summary_rows(fit), words=True), page.notices(fit.notices)
    )
    report.sections.extend(kd_sections(fit) if sections is None else sections)
    report.section("Inputs", page.inputs_table(dict(provenance)))
    return report


def _responses(fit: KDFit) -> Section:
    section = Section("Measured and simulated responses", key="responses")
    motion = responses(fit)
    load = " and to the measured in-plane load" if fit.inplane.used else ""
    section.add(
        page.text(
            "The stapes' motion at the footplate centre (dots) against the response of the fitted model "
            f"(line) to the measured base motion, transported to the same point{load}: paper Eq. 8, "
            "Figs. 4 and 5. The band "
            "is what the uncertainty of K and D leaves open (95 %); ripples of the line are noise "
            "of the measured base motion."
        )
    )
    vector = motion.measured.size <= _MOST_VECTOR_POINTS
    for run in np.unique(motion.run)[:_MOST_RUNS]:
        caption = (
            f"Run {fit.observation.runs[run]}." if len(fit.observation.runs) > 1 else "Amplitude and phase."
        )
        section.add(
            page.figure(
                response_figure(motion, int(run)), caption, "measured and simulated responses", vector=vector
            )
        )
    return section


def _residuals(fit: KDFit) -> Section:
    ratio = f"{fit.chi2 / fit.n_dof:.3f}" if fit.n_dof > 0 else "not defined"
    return Section("Residuals", key="kd_residuals").add(
        page.figure(
            residual_figure(responses(fit)),
            "Residuals of the equations of motion over their noise. Left: no pattern means that the model "
            "holds. "
            f"Right: against the normal distribution. chi2 = {fit.chi2:.1f} for "
            f"{fit.n_dof} degrees of freedom "
            f"(ratio {ratio}).",
            "normalised residuals",
        )
    )


def _frequency(dependence: FrequencyDependence) -> Section:
    verdict = dependence.verdict
    return Section("K and D over the band", key="kd_over_band").add(
        page.figure(
            frequency_figure(dependence),
            "Stiffness and damping of parts of the band over those of the whole, to first order, with 95 % "
            f"intervals of all sources. One pair of matrices {verdict}: chi2 = {dependence.chi2:.1f} for "
            f"{dependence.n_dof} degrees of freedom, p = {dependence.p_value:.2g}.",
            "local factors of stiffness and damping",
        )
    )


def _matrices(fit: KDFit) -> Section:
    stiffness_sd, damping_sd = fit.standard_deviation
    exponent = fit.law.time_power
    section = Section("Stiffness and damping", key="stiffness_and_damping")
    place = "about the footplate centre, footplate axes"
    section.add(
        page.quantity_matrix(
            fit.stiffness,
            matrix_units("K", fit.dof),
            fit.dof,
            f"K, {place}, ± sd of all sources.",
            stiffness_sd,
        ),
        page.quantity_matrix(
            fit.damping,
            matrix_units("D", fit.dof, exponent),
            fit.dof,
            f"D, {place}, ± sd of all sources; dynamic stiffness {fit.law.formula}.",
            damping_sd,
        ),
        page.quantity_matrix(fit.mass, matrix_units("M", fit.dof), fit.dof, f"M as used, {place}."),
        page.text(_numbering(fit.dof)),
        page.figure(
            correlation_figure(fit.covariance, fit.parameters),
            "Correlations of the errors of K and D, all sources, in percent: entries that are strongly "
            "correlated are known better together than each alone.",
            "correlation matrix of the entries",
        ),
    )
    freq = fit.observation.freq_hz
    loss = float(fit.damping[0, 0] / fit.stiffness[0, 0])
    rise = causal_rise(fit.law, loss, (float(freq.min()), float(freq.max())))
    if rise is not None:
        section.add(
            page.text(
                "A constant loss factor with a constant stiffness is not causal: by the relations of Kramers "
                f"and Kronig a loss factor of {loss:.2g} goes with a stiffness that rises by "
                f"{100.0 * rise:.0f} % over the band. Compare fractional and relaxation damping."
            )
        )
    if fit.law.estimated:
        slowest_us = 1e6 / (2.0 * np.pi * float(freq.min()))
        section.add(
            page.text(
                "This law describes what relaxes within the band. A part that takes some "
                f"{slowest_us:.0f} µs (1 / 2πf of the lowest line) or longer is a spring there: it is in K, "
                "which is smaller at rest, and the data cannot show it."
            )
        )
    if len(fit.laws) > 1:
        alike = fit.laws_alike
        rows = [
            (
                law.law.name,
                law.law.formula,
                f"{law.chi2:.1f}",
                f"{law.bic:.1f}",
                "chosen" if law.law == fit.law else "not told from it" if law.law.name in alike else "",
            )
            for law in fit.laws
        ]
        section.add(
            page.subheading("Damping laws compared"),
            page.table(("law", "dynamic stiffness", "chi2", "BIC", ""), rows),
        )
    return section


def _axes(fit: KDFit, outline_mm: Array | None, gap_mm: WithSd | None) -> Section | None:
    axes = principal_axes_json(fit)
    values, sd = fit.derived.principal, fit.derived.principal_sd
    if axes is None or values is None:
        return None
    mass = fit.mass
    centre = (1e3 * mass[0, 2] / mass[0, 0], -1e3 * mass[0, 1] / mass[0, 0])
    stiffness = zip(
        ("y′", "about x′", "about z′"),
        (STIFFNESS, ROTATION_STIFFNESS, ROTATION_STIFFNESS),
        axes["stiffness_si"],
        axes["stiffness_sd_si"],
        strict=True,
    )
    rows = [
        ("origin x (mm)", plus_minus(axes["origin_x_mm"], axes["origin_x_sd_mm"])),
        ("origin z (mm)", plus_minus(axes["origin_z_mm"], axes["origin_z_sd_mm"])),
        ("rotation about +y (degrees)", plus_minus(axes["angle_deg"], axes["angle_sd_deg"])),
        *((f"stiffness {name}", unit.with_sd(value, sd)) for name, unit, value, sd in stiffness),
    ]
    drawn = "over the footplate's outline " if outline_mm is not None else ""
    test = ring_of(fit, outline_mm, gap_mm)
    return Section("Principal axes", key="principal_axes").add(
        page.figure(
            principal_figure(values, sd, outline_mm, centre),
            f"Principal axes of K {drawn}seen along y from lateral (y towards the reader): a shift to "
            "the point where "
            "piston and rocking uncouple, then a rotation about y. Paper Fig. 6.",
            "principal axes of the stiffness",
        ),
        page.table(("", "value"), rows),
        *(() if test is None else ring_parts(test)),
    )


def _numbering(dof: Sequence[str]) -> str:
    """Explain the names of entries in tables, figures and kd.json."""
    numbered = ", ".join(f"{place} {name}" for place, name in enumerate(dof, 1))
    return f"Entries are numbered below and in kd.json, {numbered}: K11 is K({dof[0]})."


def _budget(fit: KDFit) -> Section:
    shares = fit.budget.shares()
    sd = np.sqrt(np.diag(fit.covariance))
    rows: list[list[str]] = []
    for source, entries in shares.items():
        rows.append([source_words(source), *(f"{100.0 * entries[name]:.0f} %" for name in fit.parameters)])
    rows.append(["sd, all sources (SI)", *(f"{value:.2g}" for value in sd)])
    half = len(fit.parameters) // 2
    section = Section("Where the uncertainty comes from", key="kd_uncertainty")
    for part in (slice(0, half), slice(half, None)):
        names = fit.parameters[part]
        section.add(page.table(["share of the variance", *names], [[row[0], *row[1:][part]] for row in rows]))
    section.add(page.text(" ".join(_leading(fit, shares))))
    if fit.budget.widened > 1.0:
        section.add(
            page.text(
                f"Channel noise was widened by the factor {np.sqrt(fit.budget.widened):.3f} because "
                "chi2 exceeds its "
                "degrees of freedom."
            )
        )
    return section


def _leading(fit: KDFit, shares: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Name the largest source of error of each diagonal entry."""
    if len(shares) == 1:
        return [f"All of it is {source_words(next(iter(shares)))}: no other source was stated."]
    led: dict[str, list[str]] = {}
    for letter in "KD":
        for place in range(1, len(fit.dof) + 1):
            name = f"{letter}{place}{place}"
            source = max(shares, key=lambda key, entry=name: shares[key][entry])  # type: ignore[misc]
            led.setdefault(source, []).append(f"{name} ({100.0 * shares[source][name]:.0f} %)")
    parts = [f"{source_words(source)} of {', '.join(names)}" for source, names in led.items()]
    return [f"The largest part of the variance is {'; '.join(parts)}."]


def source_words(source: str) -> str:
    """Return a source of error in words."""
    if source.startswith("mass."):
        return f"mass matrix: {mass_source_words(source.removeprefix('mass.'))}"
    return SOURCE_WORDS.get(source, source.replace("_", " "))


def _identifiability(fit: KDFit) -> Section:
    known = fit.identifiability
    combinations = [(known.describe(place), known.percent(place)) for place in range(len(known.combinations))]
    bounds = [
        (name, f"{value:.2g}", f"{100.0 * relative:.2g} %")
        for name, value, relative in zip(known.names, known.bound_si, known.relative, strict=True)
    ]
    section = Section("What the data can tell", key="identifiability").add(
        page.text(
            f"Column-scaled condition number of the equations: {known.condition:.3g}. Relative means "
            "relative to "
            "sqrt(Xii Xjj). The worst determined combinations of relative entries:"
        ),
        page.table(("combination", "relative sd"), combinations),
        page.text("Smallest sd that any unbiased estimator can reach (Cramér-Rao, channel noise only):"),
        page.table(("entry", "sd (SI)", "relative"), bounds),
    )
    if fit.profile is not None:
        values = join(fit.stiffness, fit.damping)
        rows = [
            (name, f"{value:.4g}", f"{low:.4g}", f"{high:.4g}")
            for name, value, (low, high) in zip(fit.parameters, values, fit.intervals, strict=True)
        ]
        section.add(
            page.text(
                "The data are weak, so that standard deviations mislead; 95 % intervals by profile "
                "likelihood, with all sources:"
            ),
            page.table(("entry", "value (SI)", "from", "to"), rows),
        )
    return section
