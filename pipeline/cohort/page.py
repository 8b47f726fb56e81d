"""cohort.html, cohort.csv and cohort.json: the ears side by side, their laws, what they share."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.cohort.cohort import Cohort, CohortLaw
from pipeline.cohort.covariates import described
from pipeline.cohort.ears import Ear, common_damping_exponent, ear_frame, quantities, unique_names
from pipeline.cohort.ears import Quantity as EarQuantity
from stapeskit.report import page
from stapeskit.report.figures import panels, plain, style
from stapeskit.report.quantities import (
    AREA,
    INERTIA,
    LENGTH,
    MASS,
    ROTATION_STIFFNESS,
    Quantity,
    ShownUnit,
    diagonal_unit,
    matrix_units,
)

if TYPE_CHECKING:
    from markupsafe import Markup
    from matplotlib.figure import Figure

FILES = ("cohort.csv", "cohort.json", "cohort.html")
_PREDICTORS = {
    "mass_kg": ("mass", MASS),
    "J1_kg_m2": ("J1", INERTIA),
    "J2_kg_m2": ("J2", INERTIA),
    "J3_kg_m2": ("J3", INERTIA),
    "footplate_area_m2": ("footplate area", AREA),
    "footplate_length_m": ("footplate length", LENGTH),
    "footplate_width_m": ("footplate width", LENGTH),
    "height_m": ("height", LENGTH),
    "gap_m": ("gap", LENGTH),
}
_BLUE, _GREY, _BAND = "#0b6e99", "#9aa5b1", "#d7e8f0"
_COLUMNS = 3


def write_cohort(
    folder: Path,
    cohort: Cohort,
    parameters: Mapping[str, Any],
    inputs: Mapping[str, Path] | None = None,
    failed: Mapping[str, str] | None = None,
) -> None:
    """Write cohort.csv, cohort.json and cohort.html into an empty folder.

    Parameters
    ----------
    parameters, inputs : mapping
        For the provenance.
    failed : mapping of str to str, optional
        Studies without a result, by name, and why.
    """
    from stapeskit.provenance import record

    content = cohort.as_json(record(inputs or {}, parameters))
    ear_frame(cohort.ears, failed).to_csv(folder / FILES[0], index=False, lineterminator="\n")
    (folder / FILES[1]).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    cohort_page(cohort, failed or {}).write(folder / FILES[2])


def cohort_page(cohort: Cohort, failed: Mapping[str, str]) -> page.Page:
    """Return the page of a cohort; ears that are in no law are marked with the reason."""
    ears = cohort.ears
    count = f"{len(ears)} ear{'s' if len(ears) != 1 else ''}; cohort.csv has SI units."
    report = page.Page("Cohort", f"{count} {len(failed)} more failed." if failed else count)
    if cohort.notices:
        report.add(page.notices(cohort.notices))
    if cohort.primary:
        report.add(page.table(_LAW_HEAD, [_law_row(law) for law in cohort.primary], file="planned_laws"))
        caption = (
            "Planned laws. Points: ears, with ellipses of one standard deviation of their own "
            "errors; line: law; "
            "band: 95 % of further ears."
        )
        report.add(page.figure(laws_figure(cohort, cohort.primary), caption, "responses over predictors"))
    report.section("Ears", *_ear_blocks(cohort, failed))
    report.section("Do the ears differ?", *_difference_blocks(ears))
    if cohort.components is not None:
        report.section("Independent parameters", *_component_blocks(cohort))
    if ranges := cohort.normal_ranges():
        rows = [(name, _range_text(cohort, name, ends)) for name, ends in ranges.items()]
        words = "95 % of further ears of this population lie within these, whatever their size."
        report.section("Normal ranges", page.text(words), page.table(("response", "95 %"), rows))
    if cohort.table is not None and cohort.laws:
        report.appendix_section("All laws", *_exploratory_blocks(cohort))
    return report


_LAW_HEAD = ("law", "exponent", "95 %", "p", "q", "scatter (ln)", "95 %", "prediction error (ln)", "ears")


def _law_row(entry: CohortLaw) -> tuple[object, ...]:
    law = entry.law
    low, high = law.sigma_interval
    ends = " to ".join(f"{end:.2f}" if np.isfinite(end) else "open" for end in law.interval)
    return (
        _law_name(entry),
        f"{law.exponent:.2f}",
        ends,
        f"{law.p_value:.2g}",
        f"{entry.q_value:.2g}",
        f"{law.sigma:.3f}",
        f"{low:.3f} to {high:.3f}",
        f"{entry.prediction_error:.3f}" if np.isfinite(entry.prediction_error) else "–",
        str(law.n),
    )


def _law_name(law: CohortLaw) -> str:
    return f"{law.response} ~ {_PREDICTORS[law.predictor][0]}"


def _response_unit(response: str, ears: Sequence[Ear]) -> ShownUnit:
    """Return the unit in which a response of laws, such as ``K11``, is shown."""
    if response.startswith("K_principal"):
        return ROTATION_STIFFNESS
    dof = max((tuple(ear.kd["dof"]) for ear in ears), key=len)
    return diagonal_unit(response[0], dof[int(response[1]) - 1], common_damping_exponent(ears))


def _range_text(cohort: Cohort, response: str, ends: tuple[float, float]) -> str:
    unit = _response_unit(response, cohort.ears)
    low, high = (float(unit.of(end)) for end in ends)
    return f"{low:.4g} to {high:.4g} {unit.symbol}"


def laws_figure(cohort: Cohort, laws: Sequence[CohortLaw]) -> Figure:
    """Draw one panel for each law: ears with their own errors, the law, and the band of further ears."""
    with style():
        drawing, grid = panels(-(-max(len(laws), 1) // _COLUMNS), _COLUMNS, height=3.0)
        for panel, law in zip(grid.ravel(), laws, strict=False):
            _draw_law(panel, cohort, law)
        for panel in grid.ravel()[len(laws) :]:
            panel.set_axis_off()
    return drawing


def _draw_law(panel: Any, cohort: Cohort, law: CohortLaw) -> None:
    words, predictor_unit = _PREDICTORS[law.predictor]
    pairs, predictor, unit = (
        cohort.pairs(law),
        cohort.predictor(law),
        _response_unit(law.response, cohort.ears),
    )
    across, up = predictor_unit.per_si, unit.per_si
    angle = np.linspace(0.0, 2.0 * np.pi, 41)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    for x, y, covariance in zip(pairs.x, pairs.y, pairs.own, strict=True):
        sizes, axes = np.linalg.eigh(covariance)
        ellipse = np.array([[x], [y]]) + axes * np.sqrt(np.maximum(sizes, 0.0)) @ circle
        panel.plot(np.exp(ellipse[0]) * across, np.exp(ellipse[1]) * up, color=_GREY, lw=0.7)
    margin = 0.1 * float(np.ptp(pairs.x))
    shown = np.linspace(pairs.x.min() - margin, pairs.x.max() + margin, 25)
    band = np.exp([predictor.predict(float(at)).interval for at in shown]) * up
    panel.fill_between(np.exp(shown) * across, band[:, 0], band[:, 1], color=_BAND, lw=0)
    panel.plot(np.exp(shown) * across, np.exp(law.law.intercept + law.law.exponent * shown) * up, color=_BLUE)
    panel.plot(np.exp(pairs.x) * across, np.exp(pairs.y) * up, "o", color=_BLUE, ms=4)
    panel.set(xlabel=f"{words} ({predictor_unit.symbol})", ylabel=f"{law.response} ({unit.symbol})")


def _exploratory_blocks(cohort: Cohort) -> list[Markup]:
    logs = cohort.table
    others = sorted((law for law in cohort.laws if law.family != "primary"), key=lambda law: law.law.p_value)
    words = (
        "Laws ln y = a + b ln x with errors of measurement in both and scatter of the ears about "
        "the law (restricted "
        "maximum likelihood; 95 % intervals by the profile). Laws that were not planned are "
        "exploratory: their q is "
        "the share of false findings among those with a q as small."
    )
    blocks = [page.text(words)]
    if logs is not None and logs.covariates.names:
        blocks.append(page.text(f"Adjusted for {', '.join(logs.covariates.names)}."))
    return [*blocks, page.table(_LAW_HEAD, [_law_row(law) for law in others], file="exploratory_laws")]


def _ear_blocks(cohort: Cohort, failed: Mapping[str, str]) -> list[Markup]:
    """Return the ears with their verdicts, a picture, and a table of their numbers."""
    ears = cohort.ears
    names, reasons = unique_names(ears), dict(cohort.excluded)
    head = ("ear", "side", "verdict", "in the laws", "warnings")
    rows: list[tuple[object, ...]] = [
        (
            name,
            ear.side or "not given",
            ear.verdict or "not stated",
            reasons.get(name, "yes"),
            str(ear.warnings),
        )
        for name, ear in zip(names, ears, strict=True)
    ]
    rows += [(name, "", "failed", why, "") for name, why in failed.items()]
    blocks = [page.table(head, rows, words=True, file="ears")]
    if not ears:
        return blocks
    found = quantities(ears)
    diagonal = [row for row in found if _is_diagonal(row)]
    caption = "Each ear with two of its standard deviations; line: mean of the ears."
    blocks.append(page.figure(_ears_figure(ears, diagonal), caption, "values of all ears with error bars"))
    exponent = common_damping_exponent(ears)
    for title, starts in (("Mass and modes", ("mass", "mode")), ("K", ("K_",)), ("D", ("D_",))):
        part = [row for row in found if row.name.startswith(starts)]
        cells = [(name, *(_shown(row, place, exponent) for row in part)) for place, name in enumerate(names)]
        table = page.table(("ear", *map(_title, part)), cells, file=title.split()[0])
        blocks.append(page.folded(f"{title} of every ear", table))
    return blocks


def _unit(row: EarQuantity, exponent: float | None) -> ShownUnit:
    letter, *dof = row.name.split("_")
    if letter in ("K", "D"):
        return matrix_units(letter, dof, exponent)[0][1]
    return MASS if letter == "mass" else ShownUnit(row.unit, 1.0)


def _shown(row: EarQuantity, place: int, exponent: float | None) -> object:
    value, sd = float(row.values[place]), float(row.sd[place])
    if not np.isfinite(value):
        return "–"
    return Quantity(value, sd if np.isfinite(sd) else None, _unit(row, exponent))


def _title(row: EarQuantity) -> str:
    letter, *dof = row.name.split("_")
    if letter in ("K", "D"):
        return f"{letter}({', '.join(dict.fromkeys(dof))})"
    return row.name.replace("_", " ").replace("mode", "mode ")


def _is_diagonal(row: EarQuantity) -> bool:
    letter, *dof = row.name.split("_")
    return (letter in ("K", "D") and dof[0] == dof[1]) or row.name.endswith("frequency")


def _ears_figure(ears: Sequence[Ear], rows: Sequence[EarQuantity]) -> Figure:
    """Draw one panel per quantity."""
    exponent = common_damping_exponent(ears)
    with style():
        drawing, grid = panels(-(-len(rows) // _COLUMNS), _COLUMNS, height=2.2)
        for panel, row in zip(grid.ravel(), rows, strict=False):
            unit, places = _unit(row, exponent), np.arange(len(ears))
            values, bars = unit.of(row.values), 2.0 * unit.of(np.nan_to_num(row.sd))
            panel.errorbar(places, values, bars, fmt="o", ms=4, color=_BLUE, capsize=2)
            panel.axhline(np.nanmean(values), color=_GREY, lw=1, zorder=0)
            panel.set_title(f"{_title(row)} ({unit.symbol})", fontsize=9)
            step = -(-len(ears) // 12)
            names = [plain(name)[:9] for name in unique_names(ears)]
            panel.set_xticks(places[::step], names[::step], fontsize=7)
        for panel in grid.ravel()[len(rows) :]:
            panel.set_axis_off()
    return drawing


def _difference_blocks(ears: Sequence[Ear]) -> list[Markup]:
    """Compare the scatter between the ears with what their own uncertainty would make of equal ears."""
    if len(ears) < 2:
        return [page.text("One ear alone cannot be compared.")]
    exponent = common_damping_exponent(ears)
    rows = []
    for row in quantities(ears):
        q, count, p = row.homogeneity()
        if not count or (row.name.startswith("D_") and exponent is None):
            continue
        unit = _unit(row, exponent)
        own = float(np.sqrt(np.nanmean(row.own_sd**2)))
        numbers = (unit.of(float(v)) for v in (np.nanmean(row.values), np.nanstd(row.values, ddof=1), own))
        name = f"{_title(row)} ({unit.symbol})" if unit.symbol else _title(row)
        rows.append((name, *(f"{v:.4g}" for v in numbers), f"{q:.3g} ({count})", f"{p:.2g}"))
    head = ("quantity", "mean", "sd between ears", "own sd of one ear (rms)", "Q (n − 1)", "p")
    sides = {str(described(ear).get("side", "")) for ear in ears}
    words = (
        "Q tests whether the ears could be equal within their own standard deviations (Cochran "
        "1954), without errors "
        "that all ears share. No correction is made for the number of rows."
    )
    if len(sides) > 1:
        words += " Right ears enter as their mirror images on the left."
    if exponent is None:
        words += " D is not compared: the power of time in its unit differs between the ears."
    return [page.text(words), page.table(head, rows, file="differences")]


def _component_blocks(cohort: Cohort) -> list[Markup]:
    """Return what is known of the number of independent parameters."""
    components, table = cohort.components, cohort.table
    if components is None or table is None:
        return []
    low, high = components.interval
    plural = "" if components.estimate == 1 else "s"
    words = (
        f"The ears vary in {components.estimate} independent way{plural} by more than 5 % beyond "
        "their errors (95 %: "
        f"{low} to {high}). Rows: what one standard deviation of each changes in the logarithms. "
        "Quantities that "
        "change together could be one parameter of a model."
    )
    rows = [
        (str(k + 1), f"{size:.3f}", *(f"{value:+.3f}" for value in components.loadings[k]))
        for k, size in enumerate(components.sd[: max(high, 1)])
    ]
    return [page.text(words), page.table(("", "sd (ln)", *table.entries), rows, file="components")]
