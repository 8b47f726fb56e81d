"""Sections of cohort.html on laws: figures, tables, influence of single ears, components, left and right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legacy.pipeline.cohort.cohort_laws import CohortLaw, CohortLaws
from legacy.pipeline.cohort.compare_ears import labels
from legacy.pipeline.cohort.law_figures import (
    components_figure,
    exponents_figure,
    laws_figure,
    paired_ears,
    pairs_figure,
    residuals_figure,
)
from legacy.pipeline.cohort.law_labels import law_name, response_unit
from legacy.stapeskit.page import page
from legacy.stapeskit.page.numbers import plus_minus
from legacy.stapeskit.page.page import Section

# From so many ears on pictures are pixels: drawn as paths they would be larger than the rest of the page.
MOST_AS_PATHS = 60
_MOST_NAMED = 10


def law_sections(cohort: CohortLaws) -> list[Section]:
    """Return the sections on laws; a cohort without laws gives the reason."""
    notices = [page.notices(cohort.notices)] if cohort.notices else []
    if not cohort.laws or cohort.table is None:
        return [Section("Laws", notices, "laws")] if notices else []
    primary = cohort.primary
    others = sorted(
        (law for law in cohort.laws if law.family == "exploratory"), key=lambda law: law.law.p_value
    )
    as_paths = len(cohort.ears) <= MOST_AS_PATHS
    adjusted = ", ".join(cohort.table.covariates.names)
    dof = max((tuple(ear.kd["dof"]) for ear in cohort.ears), key=len)
    numbered = ", ".join(f"{place} {name}" for place, name in enumerate(dof, 1))
    words = (
        "Laws ln y = a + b ln x with errors of measurement in both and scatter of the ears about the law "
        "(restricted maximum likelihood; 95 % intervals by the profile). Planned laws come first; the "
        "others are exploratory: their q is the share of false findings among those with a q as small. "
        f"Entries are numbered, {numbered}: K11 is K({dof[0]})."
    )
    blocks = [page.text(words), *notices]
    if adjusted:
        blocks.append(page.text(f"Adjusted for {adjusted}."))
    if primary:
        blocks += [
            page.figure(
                laws_figure(cohort),
                "Planned laws. Points: ears, with ellipses of one standard deviation of their own errors; "
                "line: law; band: 95 % of further ears.",
                "responses over predictors, with laws and bands",
                vector=as_paths,
            ),
            page.table(_HEADER, [_row(law) for law in primary]),
            page.subheading("Exponents of the planned laws"),
            page.figure(
                exponents_figure(primary),
                "Exponents with 95 % intervals; arrows: not bounded by the data.",
                "forest plot",
            ),
        ]
    blocks.append(page.folded("Exploratory laws", page.table(_HEADER, [_row(law) for law in others])))
    return [
        Section("Laws", blocks, "laws"),
        *_influence_section(cohort, primary, as_paths),
        *_normal_section(cohort),
        *_component_section(cohort),
        *_pairs_section(cohort),
    ]


_HEADER = ("law", "exponent", "95 %", "p", "q", "scatter (ln)", "95 %", "prediction error (ln)", "ears")


def _row(entry: CohortLaw) -> tuple[str, ...]:
    law = entry.law
    low, high = law.sigma_interval
    return (
        law_name(entry),
        f"{law.exponent:.2f}",
        " to ".join(f"{end:.2f}" if np.isfinite(end) else "open" for end in law.interval),
        f"{law.p_value:.2g}",
        f"{entry.q_value:.2g}",
        f"{law.sigma:.3f}",
        f"{low:.3f} to {high:.3f}",
        f"{entry.left_out.rms:.3f}",
        str(law.n),
    )


def _influence_section(cohort: CohortLaws, primary: Sequence[CohortLaw], as_paths: bool) -> list[Section]:
    """Return residuals of ears left out, and how much each ear moves an exponent."""
    if not primary:
        return []
    named, rows = dict(zip((ear.folder for ear in cohort.ears), labels(cohort.ears), strict=True)), []
    for cohort_law in primary:
        _, keep = cohort.logarithms.pairs(cohort_law.response, cohort_law.predictor)
        ears = [folder for folder, used in zip(cohort.logarithms.ears, keep, strict=True) if used]
        change = cohort_law.left_out.exponents - cohort_law.law.exponent
        for k in np.argsort(-np.abs(np.nan_to_num(change)))[:2]:
            if np.isfinite(change[k]):
                error = cohort_law.left_out.errors[k]
                rows.append((law_name(cohort_law), named[ears[k]], f"{change[k]:+.2f}", f"{error:+.2f}"))
    blocks = [
        page.text(
            "Each ear against what the ears of all other persons predict from its predictor. An ear far from "
            "zero does not follow the law; an ear that moves the exponent by as much as the half width of "
            "its interval carries the law alone."
        ),
        page.figure(
            residuals_figure(cohort, primary),
            "ln of the response less its prediction, over the predictor; band: two standard deviations of "
            "the scatter.",
            "residuals of ears left out",
            vector=as_paths,
        ),
    ]
    if rows:
        blocks.append(
            page.table(("law", "ear", "change of exponent without it", "residual (ln)"), rows, named_by=2)
        )
    return [Section("Residuals and influence", blocks, "influence")]


def _normal_section(cohort: CohortLaws) -> list[Section]:
    """Return the range of each response over ears of this population."""
    rows = []
    for name, ends in cohort.normal_ranges().items():
        unit = response_unit(name, cohort.ears)
        low, high = (unit.of(end) for end in ends)
        rows.append((f"{name} ({unit.symbol})", f"{low:.4g} to {high:.4g}"))
    if not rows:
        return []
    text = "95 % of further ears of this population lie within these, whatever their size."
    return [Section("Normal ranges", [page.text(text), page.table(("", "95 %"), rows)], "normal_ranges")]


def _component_section(cohort: CohortLaws) -> list[Section]:
    """Return what is known of the number of independent parameters."""
    components, names = cohort.components, cohort.logarithms.entries
    if components is None:
        return []
    low, high = components.interval
    shown = max(high, 1)
    rows = [
        (str(k + 1), f"{size:.3f}", *(f"{value:+.3f}" for value in components.loadings[k]))
        for k, size in enumerate(components.sd[:shown])
    ]
    plural = "" if components.estimate == 1 else "s"
    words = (
        f"The ears vary in {components.estimate} independent way{plural} by more than 5 % beyond their "
        f"errors (95 %: {low} to {high}). Rows: what one standard deviation of each changes in the "
        "logarithms. Quantities that change together could be one parameter of a model."
    )
    figure = page.figure(
        components_figure(names, components, max(low, 1)),
        "What one standard deviation of each component changes, as a factor.",
        "loadings of the components",
    )
    blocks = [page.text(words), figure, page.table(("", "sd (ln)", *names), rows)]
    return [Section("Independent parameters", blocks, "components")]


def _pairs_section(cohort: CohortLaws) -> list[Section]:
    """Return left against right ears of the same persons."""
    pairs = paired_ears(cohort)
    if len(pairs) < 2:
        return []
    rhos = [law.law.rho for law in cohort.primary]
    words = f"{len(pairs)} persons have both ears in the cohort."
    if rhos:
        words += f" Estimated correlation of the two ears in the planned laws: {_span(rhos)}."
    rows = [(subject, *_ratios(cohort, left, right)) for subject, left, right in pairs[:_MOST_NAMED]]
    header = ("person", *(f"{name} left / right" for name in cohort.logarithms.entries))
    figure = page.figure(
        pairs_figure(cohort, pairs),
        "Left against right ears of the same persons; line: equal.",
        "left against right",
    )
    return [Section("Left and right", [page.text(words), figure, page.table(header, rows)], "pairs")]


def _span(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:.2f}" if high - low < 0.005 else f"{low:.2f} to {high:.2f}"


def _ratios(cohort: CohortLaws, left: int, right: int) -> list[str]:
    """Return the ratio of each response of two ears, with its standard deviation."""
    table, cells = cohort.logarithms, []
    for name in table.entries:
        column = table.column(name)
        ratio = float(np.exp(table.values[left, column] - table.values[right, column]))
        variance = table.own[left, column, column] + table.own[right, column, column]
        cells.append(plus_minus(ratio, ratio * float(np.sqrt(variance))) if np.isfinite(ratio) else "–")
    return cells
