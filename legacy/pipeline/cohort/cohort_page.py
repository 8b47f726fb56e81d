"""The page of several ears: side by side, and a plain comparison."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.pipeline.cohort.cohort_laws import CohortLaws
from legacy.pipeline.cohort.compare_ears import Ear, Quantity, damping_exponent, labels, quantities
from legacy.pipeline.cohort.covariates import stated
from legacy.pipeline.cohort.law_page import MOST_AS_PATHS, law_sections
from legacy.stapeskit.page import page
from legacy.stapeskit.page.drawings import plain
from legacy.stapeskit.page.numbers import plus_minus
from legacy.stapeskit.page.page import Page

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Up to so many ears tables have a column for each; up to so many they are not folded.
_FEW, _SOME = 5, 20


def write_cohort_page(
    path: Path, ears: Sequence[Ear], faults: Mapping[str, str], cohort: CohortLaws | None = None
) -> None:
    """Write cohort.html: the ears side by side, and a plain comparison."""
    entries = [quantity.shown(damping_exponent(ears)) for quantity in quantities(ears)]
    count = f"{len(ears)} ear{'s' if len(ears) != 1 else ''} side by side; cohort.csv has SI units."
    failed = f" {len(faults)} more failed." if faults else ""
    report = Page("Cohort", count + failed)
    if faults:
        report.section("Studies that failed", page.table(("study", "why"), list(faults.items()), words=True))
    rows = [
        (
            ear.name,
            ear.folder,
            ear.side or "not given",
            ", ".join(ear.kd["dof"]),
            ear.kd["estimator"],
            ear.warnings,
        )
        for ear in ears
    ]
    header = ("study", "folder", "side", "degrees of freedom", "estimator", "warnings")
    table = page.table(header, rows, words=True)
    report.section("Studies", table if len(ears) <= _SOME else page.folded(f"All {len(ears)} studies", table))
    report.sections.extend([] if cohort is None else law_sections(cohort))
    report.section("Side by side", *_side_by_side(ears, entries))
    report.section("Do the ears differ?", *_comparison(ears, entries))
    report.write(path)


def _side_by_side(ears: Sequence[Ear], rows: Sequence[Quantity]) -> list[Any]:
    """Return a picture and tables: a column per ear when there are few, else a row per ear."""
    blocks = [
        page.figure(
            _figure(ears, [quantity for quantity in rows if _on_diagonal(quantity)]),
            "Each ear with two of its standard deviations; line: plain mean.",
            "values of all ears with error bars",
            vector=len(ears) <= MOST_AS_PATHS,
        )
    ]
    for heading, part in _groups(rows):
        if len(ears) <= _FEW:
            cells = [(_heading(row), *(_cell(row, k) for k in range(len(ears)))) for row in part]
            table = page.table(("", *labels(ears)), cells)
        else:
            cells = [(name, *(_cell(row, k) for row in part)) for k, name in enumerate(labels(ears))]
            table = page.table(("study", *map(_heading, part)), cells)
        blocks += [page.subheading(heading), table] if len(ears) <= _SOME else [page.folded(heading, table)]
    return blocks


def _on_diagonal(quantity: Quantity) -> bool:
    letter, *dof = quantity.name.split("_")
    return (letter in "KD" and dof[0] == dof[1]) or quantity.name.endswith("frequency")


def _figure(ears: Sequence[Ear], shown: Sequence[Quantity]) -> Figure:
    """Draw one panel per quantity."""
    columns, named, one_unit = 3, labels(ears), damping_exponent(ears) is not None
    lines = -(-len(shown) // columns)
    drawing = page.new_figure(10.5, 1.9 * lines + 0.3)
    panels = drawing.subplots(lines, columns, squeeze=False).ravel()
    for panel, quantity in zip(panels, shown, strict=False):
        places = np.arange(len(ears))
        panel.errorbar(
            places,
            quantity.values,
            2.0 * np.nan_to_num(quantity.deviations),
            fmt="o",
            ms=4 if len(ears) <= MOST_AS_PATHS else 2,
            color="#0b6e99",
            capsize=3 if len(ears) <= MOST_AS_PATHS else 0,
        )
        if one_unit or not quantity.name.startswith("D_"):
            panel.axhline(quantity.mean, color="#9aa5b1", lw=1, zorder=0)
        panel.set_title(_heading(quantity), fontsize=9, loc="right")
        step = -(-len(ears) // _SOME)
        panel.set(xlim=(-0.6, len(ears) - 0.4), xticks=places[::step])
        few = len(ears) <= _FEW
        ticks = [textwrap.fill(plain(ear), 14) if few else str(k + 1) for k, ear in enumerate(named)]
        panel.set_xticklabels(ticks[::step], fontsize=8)
        panel.tick_params(axis="y", labelsize=8)
        panel.grid(True, axis="y", color="#eef1f4")
        panel.spines[["top", "right"]].set_visible(False)
    for panel in panels[len(shown) :]:
        panel.set_axis_off()
    return drawing


def _groups(rows: Sequence[Quantity]) -> list[tuple[str, list[Quantity]]]:
    titles = (("Mass and modes", ("mass", "mode")), ("Stiffness K", ("K_",)), ("Damping D", ("D_",)))
    return [
        (title, [quantity for quantity in rows if quantity.name.startswith(starts)])
        for title, starts in titles
    ]


def _title(quantity: Quantity) -> str:
    letter, *dof = quantity.name.split("_")
    if letter in "KD":
        return f"{letter}({', '.join(dict.fromkeys(dof))})"
    return quantity.name.replace("_", " ").replace("mode", "mode ")


def _heading(quantity: Quantity) -> str:
    """Return the name of a quantity with its unit."""
    return f"{_title(quantity)} ({quantity.unit})" if quantity.unit else _title(quantity)


def _cell(quantity: Quantity, place: int) -> str:
    value, sd = quantity.values[place], quantity.deviations[place]
    if not np.isfinite(value):
        return "–"
    return plus_minus(float(value), float(sd)) if np.isfinite(sd) else f"{value:.4g}"


def _comparison(ears: Sequence[Ear], tests: Sequence[Quantity]) -> list[Any]:
    """Compare the scatter between the ears with what their own uncertainty would make of equal ears."""
    if len(ears) < 2:
        return [page.text("One ear alone cannot be compared.")]
    sides = [str(stated(ear).get("side", "")) for ear in ears]
    known = set(sides) <= {"left", "right"}
    right = np.array([side == "right" for side in sides])
    mixed = damping_exponent(ears) is None
    rows = []
    for compared in (quantity.mirrored(right) for quantity in tests):
        if (compared.turns and not known) or (compared.name.startswith("D_") and mixed):
            continue
        q, count, p = compared.homogeneity()
        sd = compared.deviations if compared.own is None else compared.own
        own = float(np.sqrt(np.nanmean(sd**2))) if np.any(np.isfinite(sd)) else np.nan
        test = f"{q:.3g} ({count}), p = {p:.2g}" if count else "–"
        numbers = (
            f"{value:.4g}" if np.isfinite(value) else "–" for value in (compared.mean, compared.spread, own)
        )
        rows.append((_heading(compared), *numbers, test))
    header = ("quantity", "mean", "sd between ears", "own sd of one ear (rms)", "Q (n − 1)")
    blocks = [
        page.table(header, rows),
        page.text(
            "Q tests whether the ears could be equal within their own standard deviations (Cochran 1954), "
            "without errors that all ears share, such as one density from the literature. No correction is "
            "made for the number of rows. The mean is unweighted. Modes are compared in the order of their "
            "frequencies."
        ),
    ]
    if mixed:
        blocks.append(
            page.text(
                "D is not compared: the power of time in its unit differs between the ears (damping_exponent "
                "in cohort.csv)."
            )
        )
    if not known or len(set(sides)) > 1:
        turned = (
            "right ears enter as their mirror images on the left"
            if known
            else "the side of some ears is not known, and these entries are not compared"
        )
        blocks.append(
            page.text(
                "z is superior in a left ear and inferior in a right one, so that some entries change their "
                f"sign between mirror images: {turned}."
            )
        )
    return blocks
