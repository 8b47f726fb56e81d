"""cohort.html: the ears side by side and their laws; writes the three files of a cohort."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.cohort.cohort import Cohort
from pipeline.cohort.ears import Ear, Quantity, common_damping_exponent, ear_table, quantities, unique_names
from pipeline.cohort.law import PowerLaw
from stapeskit.report import page
from stapeskit.report.figures import panels, plain, style
from stapeskit.report.quantities import (
    AREA,
    INERTIA,
    LENGTH,
    MASS,
    ROTATION_STIFFNESS,
    ShownUnit,
    diagonal_unit,
)

if TYPE_CHECKING:
    from markupsafe import Markup
    from matplotlib.figure import Figure

FILES = ("cohort.csv", "cohort.json", "cohort.html")
_PREDICTORS = {
    "mass_kg": ("mass", MASS),
    **{f"J{k}_kg_m2": (f"J{k}", INERTIA) for k in (1, 2, 3)},
    "footplate_area_m2": ("footplate area", AREA),
    **{f"{name}_m": (name.replace("_", " "), LENGTH)
       for name in ("footplate_length", "footplate_width", "height", "gap")},
}  # fmt: skip
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
    ear_table(cohort.ears, failed).to_csv(folder / FILES[0], index=False, lineterminator="\n")
    (folder / FILES[1]).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    cohort_page(cohort, failed or {}).write(folder / FILES[2])


def cohort_page(cohort: Cohort, failed: Mapping[str, str]) -> page.Page:
    """Return the page of a cohort; ears that are in no law are marked with the reason."""
    count = f"{len(cohort.ears)} ear{'s' if len(cohort.ears) != 1 else ''}; cohort.csv has SI units."
    report = page.Page("Cohort", f"{count} {len(failed)} more failed." if failed else count)
    if cohort.notices:
        report.add(page.notices(cohort.notices))
    if cohort.primary:
        caption = (
            "Planned laws. Points: ears, with ellipses of one standard deviation of their own errors; line: "
            "law; band: 95 % of further ears."
        )
        report.add(
            page.table(_LAW_HEAD, [_law_row(law) for law in cohort.primary]),
            page.figure(laws_figure(cohort, cohort.primary), caption, "responses over predictors"),
        )
    report.section("Ears", *_ear_blocks(cohort, failed))
    if cohort.components is not None:
        low, high = cohort.components.interval
        words = (
            "Independent ways in which K and D vary between the ears by more than 5 % beyond their errors: "
            f"{cohort.components.estimate} (95 %: {low} to {high})."
        )
        report.section("Independent parameters", page.text(words))
    if cohort.laws:
        report.appendix_section("All laws", *_exploratory_blocks(cohort))
    return report


_LAW_HEAD = ("law", "exponent", "95 %", "p", "q", "scatter (ln)", "95 %", "prediction error (ln)", "ears")


def _law_row(law: PowerLaw) -> tuple[object, ...]:
    return (
        f"{law.response} ~ {_PREDICTORS[law.predictor][0]}",
        f"{law.exponent:.2f}",
        " to ".join(f"{end:.2f}" if np.isfinite(end) else "open" for end in law.interval),
        f"{law.p_value:.2g}",
        f"{law.q_value:.2g}",
        f"{law.sigma:.3f}",
        "{:.3f} to {:.3f}".format(*law.sigma_interval),
        f"{law.prediction_error:.3f}" if np.isfinite(law.prediction_error) else "–",
        str(law.n),
    )


def _response_unit(response: str, ears: Sequence[Ear]) -> ShownUnit:
    """Return the unit in which a response of laws, such as ``K11``, is shown."""
    if response.startswith("K_principal"):
        return ROTATION_STIFFNESS
    dof = max((tuple(ear.kd["dof"]) for ear in ears), key=len)
    return diagonal_unit(response[0], dof[int(response[1]) - 1], common_damping_exponent(ears))


def laws_figure(cohort: Cohort, laws: Sequence[PowerLaw]) -> Figure:
    """Draw one panel for each law: ears with their own errors, the law, and the band of further ears."""
    with style():
        drawing, grid = panels(-(-max(len(laws), 1) // _COLUMNS), _COLUMNS, height=3.0)
        for panel, law in zip(grid.ravel(), laws, strict=False):
            _draw_law(panel, cohort, law)
        for panel in grid.ravel()[len(laws) :]:
            panel.set_axis_off()
    return drawing


def _draw_law(panel: Any, cohort: Cohort, law: PowerLaw) -> None:
    words, predictor_unit = _PREDICTORS[law.predictor]
    pairs, predictor = law.pairs, cohort.predictor(law)
    unit = _response_unit(law.response, cohort.ears)
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
    panel.plot(np.exp(shown) * across, np.exp(law.intercept + law.exponent * shown) * up, color=_BLUE)
    panel.plot(np.exp(pairs.x) * across, np.exp(pairs.y) * up, "o", color=_BLUE, ms=4)
    panel.set(xlabel=f"{words} ({predictor_unit.symbol})", ylabel=f"{law.response} ({unit.symbol})")


def _exploratory_blocks(cohort: Cohort) -> list[Markup]:
    others = sorted((law for law in cohort.laws if law.family != "primary"), key=lambda law: law.p_value)
    words = (
        "Laws ln y = a + b ln x with errors of measurement in both and scatter of the ears about the law "
        "(restricted maximum likelihood; 95 % intervals by the profile). Laws that were not planned are "
        "exploratory: their q is the share of false findings among those with a q as small."
    )
    return [page.text(words), page.table(_LAW_HEAD, [_law_row(law) for law in others])]


def _ear_blocks(cohort: Cohort, failed: Mapping[str, str]) -> list[Markup]:
    """Return the ears with their verdicts, and a picture of their numbers."""
    ears, reasons = cohort.ears, dict(cohort.excluded)
    names = unique_names(ears)
    rows = [
        (name, ear.side or "not given", ear.verdict or "not stated", reasons.get(name, "yes"), ear.warnings)
        for name, ear in zip(names, ears, strict=True)
    ]
    shown = [*rows, *((name, "", "failed", why, "") for name, why in failed.items())]
    blocks = [page.table(("ear", "side", "verdict", "in the laws", "warnings"), shown, words=True)]
    if not ears:
        return blocks
    found = quantities(ears)
    caption = "Each ear with two of its standard deviations; line: mean of the ears."
    blocks.append(page.figure(_ears_figure(names, found), caption, "values of all ears with error bars"))
    return blocks


def _ears_figure(names: Sequence[str], found: Sequence[Quantity]) -> Figure:
    """Draw a panel for each diagonal entry and each frequency."""
    rows = [
        row
        for row in found
        if row.name.endswith("frequency") or (row.name[0] in "KD" and "," not in row.title)
    ]
    places, step = np.arange(len(names)), -(-len(names) // 12)
    with style():
        drawing, grid = panels(-(-len(rows) // _COLUMNS), _COLUMNS, height=2.2)
        for panel, row in zip(grid.ravel(), rows, strict=False):
            values, bars = row.shown.of(row.values), 2.0 * row.shown.of(np.nan_to_num(row.sd))
            panel.errorbar(places, values, bars, fmt="o", ms=4, color=_BLUE, capsize=2)
            panel.axhline(np.nanmean(values), color=_GREY, lw=1, zorder=0)
            panel.set_title(row.title_with_unit, fontsize=9)
            panel.set_xticks(places[::step], [plain(name)[:9] for name in names][::step], fontsize=7)
        for panel in grid.ravel()[len(rows) :]:
            panel.set_axis_off()
    return drawing
