"""The page of a plan: the expected uncertainty of every entry, as planned and after each single change."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting.model.symmetric import entry_units
from fitting.plan.plan import Expectation, Option, summary_rows
from stapeskit.page import page
from stapeskit.page.page import Page, Section, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PLANNED = "#0b6e99"
_OTHERS = ("#c2571a", "#5d6b7a", "#3f8f5f", "#8a5aa8", "#b08a1e", "#a83f55", "#2f7f8f", "#6b6b2f")
# Dashed line of the figure: a relative sd of 10 %, from which on an entry counts as weak (WEAK_ENTRY).
_LIMIT = 0.1


def plan_page(expectation: Expectation, provenance: Mapping[str, Any]) -> Page:
    """Return plan.html: expectation, warnings, matrices with expected sd, and every change side by side."""
    plan, fit = expectation.plan, expectation.planned
    report = Page(
        "What the planned measurement can reach",
        f"{', '.join(plan.dof)} about the footplate centre in footplate axes; {plan.lines} lines from "
        f"{plan.low_hz:g} to {plan.high_hz:g} Hz, shaker along {', '.join(plan.directions)}.",
    )
    report.section(
        "At a glance",
        page.table(("", ""), summary_rows(expectation)[:3], words=True),
        page.notices(expectation.notices),
        page.text(
            "The planned experiment is simulated without noise and fitted; standard deviations are what its "
            "noise and the mass matrix's uncertainty would leave to the best unbiased estimator."
        ),
    )
    report.sections.append(_entries(expectation))
    report.sections.append(_options(expectation))
    units = entry_units(fit.dof)
    stiffness_sd, damping_sd = fit.standard_deviation
    report.section(
        "Matrices",
        page.matrix(fit.stiffness, fit.dof, "K, assumed, ± expected sd of all sources.", stiffness_sd, units),
        page.matrix(
            fit.damping,
            fit.dof,
            "D, assumed, ± expected sd of all sources.",
            damping_sd,
            [[fit.law.unit(unit) for unit in row] for row in units],
        ),
    )
    report.section("Inputs", page.inputs_table(dict(provenance)))
    return report


def _entries(expectation: Expectation) -> Section:
    return Section("Every entry, as planned and with one change").add(
        page.figure(
            _figure(expectation.options),
            "Expected standard deviation of every entry, channel noise alone, relative to sqrt(Xii Xjj) for "
            "entry (i, j) of X = K or D. Left of the dashed line (10 %) an entry is known well; entries far "
            "to the right are not measured by this plan.",
            "expected relative standard deviation of every entry for the plan and its changes",
        )
    )


def _options(expectation: Expectation) -> Section:
    rows = []
    for option in expectation.options:
        known = option.fit.identifiability
        largest = int(np.argmax(known.relative))
        rows.append(
            (
                option.name,
                f"{known.names[largest]} {_percent(float(known.relative[largest]))}",
                f"{known.describe(0)}: {known.percent(0)}",
                ", ".join(option.weak_entries) or "none",
                f"{known.condition:.3g}",
            )
        )
    header = ("", "worst entry", "worst combination", "entries over 10 %", "condition")
    return Section("What a change would bring").add(page.table(header, rows, words=True))


def _percent(value: float) -> str:
    return f"{100.0 * value:.2g} %" if value < 1.0 else "over 100 %"


def _figure(options: tuple[Option, ...]) -> Figure:
    """Draw the expected relative sd of every entry, one colour an option."""
    names = options[0].fit.identifiability.names
    half = len(names) // 2
    figure = new_figure(9.4, 1.4 + 0.34 * half + 0.2 * len(options))
    panels = figure.subplots(1, 2, sharex=True)
    spread = 0.6 / max(len(options) - 1, 1)
    for axis, letter, start in zip(panels, "KD", (0, half), strict=True):
        for place, option in enumerate(options):
            values = np.minimum(option.relative[start : start + half], 10.0)
            height = np.arange(half) + (place - (len(options) - 1) / 2) * spread
            colour = _PLANNED if place == 0 else _OTHERS[(place - 1) % len(_OTHERS)]
            axis.plot(
                np.maximum(values, 1e-5),
                height,
                "D" if place == 0 else "o",
                ms=5 if place == 0 else 3.5,
                color=colour,
                label=option.name,
            )
        axis.axvline(_LIMIT, color="#5d6b7a", lw=0.8, ls="--")
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter(lambda share, _place: f"{100.0 * share:g} %")
        axis.set_yticks(np.arange(half), names[start : start + half])
        axis.set_ylim(half - 0.5, -0.5)
        for line in range(half - 1):
            axis.axhline(line + 0.5, color="#e3e7eb", lw=0.7, zorder=0)
        axis.set_xlabel(f"expected sd of {letter}, relative")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=8.5)
    return figure
