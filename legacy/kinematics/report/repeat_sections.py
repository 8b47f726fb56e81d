"""Report: whether repeats and levels of one excitation agree."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from legacy.stapeskit.page import page
from legacy.stapeskit.page.drawings import COLOURS, FAULT, GRID, INK, plain, shorten_name
from legacy.stapeskit.page.page import Section

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from legacy.kinematics.points2dof import Points2Dof
    from legacy.kinematics.repeats.comparison import RunRepeats

# Rows of a page.
_MOST_ROWS = 60
_TESTS = {
    "gain_trend": "amplitude of all channels, drift over the repeats",
    "phase_trend": "phase of all channels, drift over the repeats",
    "gain_outlier": "amplitude of one repeat against the others",
    "gain_level": "amplitude against level, beyond proportional",
    "shape_trend": "responses relative to each other, drift over the repeats",
    "shape_level": "responses relative to each other, change with level",
    "shape_outlier": "shape of one repeat against the others",
    "shape_scatter": "scatter of the repeats against the stated noise",
}


def repeats_section(result: Points2Dof) -> Section:
    """Return what the comparison of repeats and levels gave before they were pooled."""
    section = Section("Repeats and levels", key="repeats")
    for repeat in result.repeats:
        several = len(result.repeats) > 1
        where = f"Run {repeat.run}: " if several else ""
        section.add(page.text(f"{where}{_sentence(repeat.summary)}"))
        section.add(
            page.figure(
                repeats_figure(repeat),
                "Amplitude (per unit of level where levels are stated) and phase of every repeat relative to "
                f"their mean, all channels together; {repeat.lines} lines, {repeat.channels} channels.",
                f"Relative amplitude and phase of {len(repeat.takes)} repeats",
            )
        )
        rows = [
            (
                _TESTS.get(test.name, test.name.replace("_", " ")),
                _size(test.name, test.size),
                f"{test.p_value:.2g}".replace("-", "−"),
                "found" if test in repeat.found else "",
            )
            for test in repeat.tests
        ]
        if rows:
            section.add(page.table(("what was compared", "size", "p-value", ""), rows, words=True))
        table = page.table(*_tabulate_repeats(repeat))
        section.add(page.folded("All repeats", table))
    return section


def _tabulate_repeats(repeats: RunRepeats) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return header and rows of the table of all repeats."""
    header: tuple[str, ...] = ("repeat", "relative amplitude", "relative phase (°)")
    rows: list[tuple[str, ...]] = [
        (take.name, f"{gain:.5g}", f"{turn:.3g}")
        for take, gain, turn in zip(repeats.takes, repeats.gain, repeats.phase_deg, strict=True)
    ]
    if len(repeats.shift) == len(rows):
        header = (*header, "shift of frequencies (%)")
        moved = ["-" if np.isnan(value) else f"{100.0 * value:+.2g}" for value in repeats.shift]
        rows = [(*row, value) for row, value in zip(rows, moved, strict=True)]
    return header, rows[:_MOST_ROWS]


def _sentence(words: str) -> str:
    return words[:1].upper() + words[1:] + ("" if words.endswith(".") else ".")


def _size(name: str, size: float) -> str:
    if name == "phase_trend":
        return f"{np.degrees(size):+.2g}°"
    if name == "gain_level":
        return f"level to the power {1.0 + size:.3g}"
    if name == "shape_scatter":
        return f"{size:.2g} times"
    return f"{100.0 * size:+.2g} %"


def repeats_figure(repeats: RunRepeats) -> Figure:
    """Draw relative amplitude and phase of every repeat in the order of the file; outliers found are red."""
    figure = page.new_figure(11.0, 2.5)
    amplitude, phase = figure.subplots(1, 2)
    place = np.arange(len(repeats.takes))
    odd = {test.take for test in repeats.found if test.take >= 0}
    tints = [FAULT if k in odd else COLOURS[0] for k in place]
    for view, value, middle, label in (
        (amplitude, 100.0 * (repeats.gain - 1.0), 0.0, "amplitude − mean (%)"),
        (phase, repeats.phase_deg, 0.0, "phase − mean (°)"),
    ):
        view.axhline(middle, color=INK, lw=0.8)
        view.vlines(place, middle, value, color=tints, lw=1.2)
        view.scatter(place, value, s=22, color=tints, zorder=3)
        step = max(1, len(place) // 10)
        names = [shorten_name(plain(repeats.takes[k].name), 14) for k in place[::step]]
        view.set_xticks(place[::step], names, fontsize=7.5, rotation=20 if len(names) > 5 else 0)
        view.set_ylabel(label, fontsize=9)
        view.grid(True, axis="y", color=GRID, lw=0.6)
        view.tick_params(labelsize=8)
    return figure
