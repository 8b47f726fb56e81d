"""Sections of cohort.html on the laws: pictures with bands and error ellipses, tables, components."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.cohort.cohort_laws import CohortLaw, CohortLaws
from pipeline.cohort.pairs import LogPairs
from pipeline.cohort.prediction import Predictor
from stapeskit.page import page
from stapeskit.page.page import Section

_BLUE, _GREY, _BAND = "#0b6e99", "#9aa5b1", "#d7e8f0"
# Quantities for people: label, factor from SI.
_SHOWN = {
    "mass_kg": ("mass (mg)", 1e6),
    "J1_kg_m2": ("J1 (mg mm²)", 1e12),
    "J2_kg_m2": ("J2 (mg mm²)", 1e12),
    "J3_kg_m2": ("J3 (mg mm²)", 1e12),
    "footplate_area_m2": ("footplate area (mm²)", 1e6),
    "footplate_length_m": ("footplate length (mm)", 1e3),
    "footplate_width_m": ("footplate width (mm)", 1e3),
    "height_m": ("height (mm)", 1e3),
    "gap_m": ("gap (mm)", 1e3),
}


def law_sections(cohort: CohortLaws) -> list[Section]:
    """Return the sections on laws; a cohort without laws says why."""
    said = [page.notices(cohort.notices)] if cohort.notices else []
    if not cohort.laws or cohort.table is None:
        return [Section("Laws", said)] if said else []
    primary = [law for law in cohort.laws if law.family == "primary"]
    others = sorted(
        (law for law in cohort.laws if law.family == "exploratory"), key=lambda law: law.law.p_value
    )
    blocks = [
        page.text(
            "Laws ln y = a + b ln x with errors of measurement in both and scatter of the ears about the law "
            "(restricted maximum likelihood; 95 % intervals by the profile). Planned laws come first; the "
            "others are exploratory: their q is the share of false findings among those with a q as small."
        ),
        *said,
        page.figure(
            laws_figure(cohort),
            "Planned laws. Points: ears with ellipses of one standard deviation of their own errors; line: "
            "law; band: 95 % of further ears.",
            "responses over predictors, with laws and bands",
        ),
        page.table(_HEADER, [_row(law) for law in primary]),
        page.subheading("Exponents of the planned laws"),
        page.figure(
            _forest(primary), "Exponents with 95 % intervals; arrows: not bounded by the data.", "forest plot"
        ),
        page.folded("Exploratory laws", page.table(_HEADER, [_row(law) for law in others])),
    ]
    return [Section("Laws", blocks), *_component_section(cohort)]


_HEADER = ("law", "exponent", "95 %", "p", "q", "scatter (ln)", "95 %", "prediction error (ln)", "ears")


def _row(one: CohortLaw) -> tuple[str, ...]:
    law = one.law
    low, high = law.sigma_interval
    return (
        f"{one.response} ~ {_label(one.predictor)}",
        f"{law.exponent:.2f}",
        " to ".join(f"{end:.2f}" if np.isfinite(end) else "open" for end in law.interval),
        f"{law.p_value:.2g}",
        f"{one.q_value:.2g}",
        f"{law.sigma:.3f}",
        f"{low:.3f} to {high:.3f}",
        f"{one.prediction_error:.3f}",
        str(law.n),
    )


def _label(predictor: str) -> str:
    return _SHOWN.get(predictor, (predictor, 1.0))[0]


def laws_figure(cohort: CohortLaws) -> Any:
    """Draw one panel for each planned law."""
    laws = [law for law in cohort.laws if law.family == "primary"]
    columns = 3
    lines = max(-(-len(laws) // columns), 1)
    drawing = page.new_figure(10.5, 3.1 * lines)
    panels = drawing.subplots(lines, columns, squeeze=False).ravel()
    for panel, one in zip(panels, laws, strict=False):
        if cohort.table is not None:
            _draw_law(panel, one, cohort.table.pairs(one.response, one.predictor)[0])
    for panel in panels[len(laws) :]:
        panel.set_axis_off()
    return drawing


def _draw_law(panel: Any, one: CohortLaw, pairs: LogPairs) -> None:
    factor = _SHOWN.get(one.predictor, ("", 1.0))[1]
    angle = np.linspace(0.0, 2.0 * np.pi, 41)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    for value, covariance in zip(pairs.values, pairs.own, strict=True):
        sizes, axes = np.linalg.eigh(covariance)
        ellipse = value[:, None] + axes * np.sqrt(np.maximum(sizes, 0.0)) @ circle
        panel.plot(np.exp(ellipse[0]) * factor, np.exp(ellipse[1]), color=_GREY, lw=0.7)
    margin = 0.1 * float(np.ptp(pairs.x))
    x = np.linspace(pairs.x.min() - margin, pairs.x.max() + margin, 25)
    predictor = Predictor(pairs)
    ends = np.array([predictor.predict(float(at)).interval for at in x])
    panel.fill_between(np.exp(x) * factor, np.exp(ends[:, 0]), np.exp(ends[:, 1]), color=_BAND, lw=0)
    panel.plot(np.exp(x) * factor, np.exp(one.law.intercept + one.law.exponent * x), color=_BLUE, lw=1.5)
    panel.plot(np.exp(pairs.x) * factor, np.exp(pairs.y), "o", color=_BLUE, ms=4)
    panel.set(xlabel=_label(one.predictor), ylabel=f"{one.response} (SI)")
    panel.tick_params(labelsize=8)
    panel.grid(True, color="#eef1f4")
    panel.spines[["top", "right"]].set_visible(False)


def _forest(laws: Sequence[CohortLaw]) -> Any:
    drawing = page.new_figure(7.5, 0.5 + 0.4 * len(laws))
    panel = drawing.subplots()
    ends = np.array([one.law.interval for one in laws], dtype=float)
    finite = ends[np.isfinite(ends)]
    exponents = [one.law.exponent for one in laws]
    limits = (min([*exponents, *finite]) - 1.0, max([*exponents, *finite]) + 1.0)
    for place, one in enumerate(laws):
        low, high = np.clip(np.nan_to_num(one.law.interval, neginf=limits[0], posinf=limits[1]), *limits)
        panel.plot([low, high], [place, place], color=_BLUE, lw=1.5)
        for end, open_end, marker in zip((low, high), ~np.isfinite(one.law.interval), "<>", strict=True):
            if open_end:
                panel.plot(end, place, marker, color=_BLUE, ms=6)
        panel.plot(one.law.exponent, place, "o", color=_BLUE, ms=5)
    panel.axvline(0.0, color=_GREY, lw=1)
    panel.set(
        xlim=limits,
        yticks=range(len(laws)),
        yticklabels=[f"{one.response} ~ {_label(one.predictor)}" for one in laws],
        xlabel="exponent",
    )
    panel.invert_yaxis()
    panel.spines[["top", "right"]].set_visible(False)
    return drawing


def _component_section(cohort: CohortLaws) -> list[Section]:
    """Return what is known of the number of independent parameters."""
    found, table = cohort.components, cohort.table
    if found is None or table is None:
        return []
    low, high = found.interval
    names = [name for name in table.responses if "principal" not in name]
    rows = [
        (str(k + 1), f"{size:.3f}", *(f"{value:+.3f}" for value in found.loadings[k]))
        for k, size in enumerate(found.sd[: max(high, 1)])
    ]
    words = (
        f"The ears vary in {found.estimate} independent way{'s' if found.estimate != 1 else ''} by more "
        f"than 5 % "
        f"beyond their errors (95 %: {low} to {high}). Rows: what one standard deviation of each changes in "
        "the logarithms."
    )
    return [Section("Independent parameters", [page.text(words), page.table(("", "sd (ln)", *names), rows)])]
