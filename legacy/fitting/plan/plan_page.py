"""The page of a plan: the expected uncertainty of every entry, as planned and after each single change."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.fitting.model.parameter_vector import entry_names
from legacy.fitting.plan.plan import Expectation, Option, summary_rows
from legacy.fitting.report.sections import source_words
from legacy.stapeskit.page import page
from legacy.stapeskit.page.page import Page, Section, new_figure
from legacy.stapeskit.page.quantities import matrix_units

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PLANNED = "#0b6e99"
# One more than these takes the first colour again, as a square.
_OTHERS = ("#c2571a", "#5d6b7a", "#3f8f5f", "#8a5aa8", "#b08a1e")
# Dashed line of the figure: a relative sd of 10 %, from which on an entry counts as weak (WEAK_ENTRY).
_LIMIT = 0.1


def plan_page(expectation: Expectation, provenance: Mapping[str, Any]) -> Page:
    """Return plan.html: expectation, warnings, matrices with expected sd, and every change side by side."""
    plan, planned = expectation.plan, expectation.planned
    fit = planned.fit
    report = Page(
        "What the planned measurement can reach",
        f"{', '.join(plan.dof)} about the footplate centre in footplate axes; {plan.lines} lines from "
        f"{plan.low_hz:g} to {plan.high_hz:g} Hz, shaker along {', '.join(plan.directions)}.",
    )
    report.section(
        "At a glance",
        page.table(("", ""), summary_rows(expectation)[: -len(expectation.options)], words=True),
        page.notices(expectation.notices),
        page.text(
            "The planned experiment is simulated without noise and fitted. The standard deviations hold its "
            "noise, as the best unbiased estimator meets it, and the stated errors of points, registration, "
            "lasers and mass. Not in them: a body that bends, an ear that changes while it is measured, and "
            "the plane of the ligament, which is estimated with K and D where motion along x and z is "
            "measured and makes the rotational entries less certain."
        ),
    )
    report.sections.append(_limits(planned))
    report.sections.append(_entries(expectation))
    report.sections.append(_options(expectation))
    stiffness_sd, damping_sd = planned.standard_deviation
    caption = "{}, assumed, ± expected sd of all sources."
    report.section(
        "Matrices",
        page.quantity_matrix(
            fit.stiffness, matrix_units("K", fit.dof), fit.dof, caption.format("K"), stiffness_sd
        ),
        page.quantity_matrix(
            fit.damping,
            matrix_units("D", fit.dof, fit.law.time_power),
            fit.dof,
            caption.format("D"),
            damping_sd,
        ),
    )
    report.section("Inputs", page.inputs_table(dict(provenance)))
    return report


def _limits(planned: Option) -> Section:
    """List the share of every source for each diagonal entry, largest first."""
    fit = planned.fit
    names = entry_names(len(fit.dof))
    shown = [name for name in names if name[1] == name[2]]
    places = [names.index(name) for name in shown]
    values = np.concatenate([np.diag(fit.stiffness), np.diag(fit.damping)])
    rows = []
    for source, covariance in planned.sources.items():
        parts = np.sqrt(np.maximum(np.diag(covariance)[places], 0.0)) / values
        rows.append((float(parts.max()), (source_words(source), *map(_percent, parts))))
    rows.sort(key=lambda row: -row[0])
    every = np.sqrt(np.diag(planned.covariance)[places]) / values
    numbered = ", ".join(f"{place} {name}" for place, name in enumerate(fit.dof, 1))
    return Section("What limits the entries").add(
        page.table(
            ("expected sd from", *shown),
            [*(row for _, row in rows), ("all sources", *map(_percent, every))],
        ),
        page.text(f"In percent of the entry. Improve the first line first. Rows of K and D: {numbered}."),
    )


def _entries(expectation: Expectation) -> Section:
    return Section("Every entry, as planned and with one change").add(
        page.figure(
            _figure(expectation.options),
            "Expected standard deviation of every entry, all sources, relative to sqrt(Xii Xjj) for "
            "entry (i, j) of X = K or D; hollow: channel noise alone, as planned. Left of the dashed line "
            "(10 %) an entry is known well; entries far "
            "to the right are not measured by this plan.",
            "expected relative standard deviation of every entry for the plan and its changes",
        )
    )


def _options(expectation: Expectation) -> Section:
    rows = []
    for option in expectation.options:
        known, relative = option.fit.identifiability, option.relative_of_all
        largest = int(np.argmax(relative))
        rows.append(
            (
                option.name,
                f"{known.names[largest]} {_percent(float(relative[largest]))}",
                f"{known.describe(0)}: {known.percent(0)}",
                ", ".join(option.weak_entries) or "none",
                f"{known.condition:.3g}",
            )
        )
    header = ("", "worst entry", "worst combination, noise alone", "entries over 10 %", "condition")
    return Section("What a change would bring").add(page.table(header, rows, words=True))


def _percent(value: float) -> str:
    """Return a share as text."""
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
            values = np.minimum(option.relative_of_all[start : start + half], 10.0)
            height = np.arange(half) + (place - (len(options) - 1) / 2) * spread
            colour = _PLANNED if place == 0 else _OTHERS[(place - 1) % len(_OTHERS)]
            marker = "D" if place == 0 else "os"[(place - 1) // len(_OTHERS) % 2]
            axis.plot(
                np.maximum(values, 1e-5),
                height,
                marker,
                ms=5 if place == 0 else 3.5,
                color=colour,
                label=option.name,
            )
        noise = options[0].relative[start : start + half]
        axis.plot(
            np.clip(noise, 1e-5, 10.0),
            np.arange(half),
            "D",
            ms=5,
            mfc="none",
            color=_PLANNED,
            label="as planned, noise alone",
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
