"""Figures of a cohort: laws with bands, exponents, residuals and influence, components, pairs of ears."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.pipeline.cohort.cohort_laws import CohortLaw, CohortLaws
from legacy.pipeline.cohort.covariates import stated
from legacy.pipeline.cohort.independent_parameters import Components
from legacy.pipeline.cohort.law_labels import SHOWN, label, law_name, response_unit
from legacy.pipeline.cohort.log_pairs import LogPairs
from legacy.pipeline.cohort.prediction import Predictor
from legacy.stapeskit.page import page

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from legacy.stapeskit.page.quantities import ShownUnit

_BLUE, _GREY, _BAND = "#0b6e99", "#9aa5b1", "#d7e8f0"
# Ears up to which ellipses are drawn, and columns of panels.
_MOST_ELLIPSES = 200
_COLUMNS = 3


def _panels(count: int, height: float) -> tuple[Figure, list[Any]]:
    """Return a figure and its panels in rows of three; panels beyond the count are empty."""
    lines = max(-(-count // _COLUMNS), 1)
    drawing = page.new_figure(10.5, height * lines)
    panels = list(drawing.subplots(lines, _COLUMNS, squeeze=False).ravel())
    for panel in panels[count:]:
        panel.set_axis_off()
    for panel in panels[:count]:
        panel.tick_params(labelsize=8)
        panel.locator_params(nbins=5)
        panel.grid(True, color="#eef1f4")
        panel.spines[["top", "right"]].set_visible(False)
    return drawing, panels[:count]


def laws_figure(cohort: CohortLaws) -> Figure:
    """Draw one panel for each planned law."""
    drawing, panels = _panels(len(cohort.primary), 3.1)
    for panel, planned in zip(panels, cohort.primary, strict=True):
        unit = response_unit(planned.response, cohort.ears)
        _draw_law(panel, planned, cohort.pairs(planned), cohort.predictor(planned), unit)
    return drawing


def _draw_law(panel: Any, law: CohortLaw, pairs: LogPairs, predictor: Predictor, unit: ShownUnit) -> None:
    factor, size = SHOWN.get(law.predictor, ("", 1.0))[1], unit.per_si
    angle = np.linspace(0.0, 2.0 * np.pi, 41)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    few = pairs.n <= _MOST_ELLIPSES
    for value, covariance in zip(pairs.values, pairs.own, strict=True) if few else ():
        sizes, axes = np.linalg.eigh(covariance)
        ellipse = value[:, None] + axes * np.sqrt(np.maximum(sizes, 0.0)) @ circle
        panel.plot(np.exp(ellipse[0]) * factor, np.exp(ellipse[1]) * size, color=_GREY, lw=0.7)
    margin = 0.1 * float(np.ptp(pairs.x))
    x = np.linspace(pairs.x.min() - margin, pairs.x.max() + margin, 25)
    ends = np.array([predictor.predict(float(at)).interval for at in x])
    band = np.exp(ends) * size
    panel.fill_between(np.exp(x) * factor, band[:, 0], band[:, 1], color=_BAND, lw=0)
    line = np.exp(law.law.intercept + law.law.exponent * x) * size
    panel.plot(np.exp(x) * factor, line, color=_BLUE, lw=1.5)
    panel.plot(np.exp(pairs.x) * factor, np.exp(pairs.y) * size, "o", color=_BLUE, ms=4 if few else 2)
    panel.set(xlabel=label(law.predictor), ylabel=f"{law.response} ({unit.symbol})")


def exponents_figure(laws: Sequence[CohortLaw]) -> Figure:
    """Draw the exponents of laws with their intervals, one below another."""
    drawing = page.new_figure(7.5, 0.5 + 0.4 * max(len(laws), 1))
    panel = drawing.subplots()
    ends = np.array([cohort_law.law.interval for cohort_law in laws], dtype=float)
    finite = ends[np.isfinite(ends)]
    exponents = [cohort_law.law.exponent for cohort_law in laws]
    shown = [*exponents, *finite] or [0.0]  # a cohort of few ears has no laws
    limits = (min(shown) - 1.0, max(shown) + 1.0)
    for place, law in enumerate(laws):
        low, high = np.clip(np.nan_to_num(law.law.interval, neginf=limits[0], posinf=limits[1]), *limits)
        panel.plot([low, high], [place, place], color=_BLUE, lw=1.5)
        for end, open_end, marker in zip((low, high), ~np.isfinite(law.law.interval), "<>", strict=True):
            if open_end:
                panel.plot(end, place, marker, color=_BLUE, ms=6)
        panel.plot(law.law.exponent, place, "o", color=_BLUE, ms=5)
    panel.axvline(0.0, color=_GREY, lw=1)
    panel.set(
        xlim=limits,
        yticks=range(len(laws)),
        yticklabels=[law_name(cohort_law) for cohort_law in laws],
        xlabel="exponent",
    )
    panel.invert_yaxis()
    panel.spines[["top", "right"]].set_visible(False)
    return drawing


def residuals_figure(cohort: CohortLaws, laws: Sequence[CohortLaw]) -> Figure:
    """Draw the residuals of ears left out, one panel for each law."""
    drawing, panels = _panels(len(laws), 2.4)
    for panel, law in zip(panels, laws, strict=True):
        factor, pairs = SHOWN.get(law.predictor, ("", 1.0))[1], cohort.pairs(law)
        panel.axhspan(-2.0 * law.law.sigma, 2.0 * law.law.sigma, color=_BAND, lw=0)
        panel.axhline(0.0, color=_GREY, lw=1)
        few = pairs.n <= _MOST_ELLIPSES
        panel.plot(np.exp(pairs.x) * factor, law.left_out.errors, "o", color=_BLUE, ms=4 if few else 2)
        panel.set(xlabel=label(law.predictor), ylabel=f"residual of ln {law.response}")
    return drawing


def components_figure(names: Sequence[str], components: Components, count: int) -> Figure:
    """Draw what one standard deviation of each component changes in every quantity."""
    drawing = page.new_figure(7.5, 1.2 + 1.5 * count)
    panels = drawing.subplots(count, 1, squeeze=False, sharex=True).ravel()
    for k, panel in enumerate(panels):
        panel.bar(range(len(names)), np.exp(components.loadings[k]) - 1.0, bottom=1.0, color=_BLUE, width=0.6)
        panel.axhline(1.0, color=_GREY, lw=1)
        panel.set(ylabel=f"component {k + 1}", xticks=range(len(names)), xticklabels=names)
        panel.tick_params(labelsize=8)
        panel.spines[["top", "right"]].set_visible(False)
    return drawing


def paired_ears(cohort: CohortLaws) -> list[tuple[str, int, int]]:
    """Return the persons with a left and a right ear, and the rows of these in the table of logarithms."""
    table = cohort.table
    if table is None:
        return []
    known = {ear.folder: ear for ear in cohort.ears}
    sides: dict[int, dict[str, int]] = {}
    for row, (folder, subject) in enumerate(zip(table.ears, table.subject, strict=True)):
        ear = known[folder]
        sides.setdefault(int(subject), {})[str(stated(ear).get("side", ""))] = row
    return [
        (str(known[table.ears[rows["left"]]].about.get("subject", "")), rows["left"], rows["right"])
        for rows in sides.values()
        if {"left", "right"} <= set(rows)
    ]


def pairs_figure(cohort: CohortLaws, pairs: Sequence[tuple[str, int, int]]) -> Figure:
    """Draw left against right ears of the same persons, one panel for each diagonal entry of K and D."""
    table = cohort.logarithms
    drawing, panels = _panels(len(table.entries), 2.9)
    left, right = np.array([pair[1] for pair in pairs]), np.array([pair[2] for pair in pairs])
    for panel, name in zip(panels, table.entries, strict=True):
        column = table.column(name)
        unit = response_unit(name, cohort.ears)
        sides = [
            (unit.of(np.exp(table.values[k, column])), table.own[k, column, column]) for k in (left, right)
        ]
        bars = [2.0 * values * np.sqrt(variance) for values, variance in sides]
        panel.errorbar(
            sides[0][0], sides[1][0], bars[1], bars[0], fmt="o", ms=4, color=_BLUE, ecolor=_GREY, lw=0.8
        )
        ends = [min(np.nanmin(side[0]) for side in sides), max(np.nanmax(side[0]) for side in sides)]
        panel.plot(ends, ends, color=_GREY, lw=1)
        panel.set(xlabel=f"{name} left ({unit.symbol})", ylabel=f"{name} right ({unit.symbol})")
    return drawing
