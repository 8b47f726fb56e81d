"""kd.html: verdict, K and D, responses, modes, axes, causes, budget; other reports take sections over."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fitting import entries
from fitting.laws import causal_rise
from fitting.model import NORMALISATION
from fitting.plan import Plan, Way, plan_rows
from fitting.report.figures import all_figures
from fitting.report.kd_json import equation, found_from, ring_of, shown_sources
from fitting.report.summary import determined, summary_rows
from fitting.rim import rim_figure, rim_stiffness
from stapeskit.arrays import Array
from stapeskit.report import page
from stapeskit.report.quantities import (
    PERCENT,
    ROTATION_STIFFNESS,
    STIFFNESS,
    Quantity,
    ShownUnit,
    matrix_units,
    plus_minus,
)
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from markupsafe import Markup
    from matplotlib.figure import Figure

    from fitting.result import KDFit
    from stapeskit.report.page import Page, Section

_LARGEST = 5  # sources of uncertainty that are listed one by one
_ABOUT = "about the footplate centre in footplate axes"


def kd_page(fit: KDFit) -> Page:
    """Return the page of a fit."""
    data = fit.found.data
    lead = (
        f"{', '.join(fit.dof)} {_ABOUT}; estimator {fit.options.estimator}, {fit.law.name} damping "
        f"({fit.law.formula}), {data.count} lines."
    )
    made = page.Page("Stiffness and damping of the annular ligament", lead)
    rim = rim_blocks(fit, "")
    summary = page.table(("", ""), without_matrices(summary_rows(fit)), words=True)
    made.add(verdict_block(fit), page.beside(summary, *rim), page.beside(*matrices(fit)))
    for name, blocks in sections(fit, all_figures(fit)).items():
        made.section(name, *blocks)
    made.section("Warnings", page.notices(fit.notices))
    made.appendix_section("Inputs", page.inputs(fit.provenance))
    return made


def without_matrices(rows: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the rows of a summary without those that the matrices show."""
    return [row for row in rows if not row[0].startswith(("K(", "D("))]


def rim_blocks(fit: KDFit, side: str) -> list[Markup]:
    """Return the stiffness along the rim of the footplate, where it is known; ``side``: left, right or ""."""
    rim = rim_stiffness(fit, side)
    if rim is None:
        return []
    caption = (
        f"{rim.sentence()} Width and colour: stiffness over its mean. From K11, K12 and K13: springs normal "
        "to the footplate along its rim whose stiffness varies linearly over the footplate."
    )
    return [page.figure(rim_figure(rim), caption, "stiffness along the rim of the footplate", file="rim")]


def verdict_block(fit: KDFit) -> Markup:
    """Return the verdict with its reasons."""
    verdict = fit.verdict
    reasons = [Notice(reason.code, reason.text) for reason in verdict.reasons]
    return page.verdict(verdict.level, verdict.sentence.partition(": ")[2], reasons)


def matrices(fit: KDFit) -> list[Markup]:
    """Return K and D with their intervals."""
    n, law = len(fit.dof), fit.law
    limits = [entries.split(side, n) for side in fit.intervals.T]
    blocks = []
    for place, (letter, values, sds) in enumerate(
        zip("KD", (fit.stiffness, fit.damping), fit.standard_deviation, strict=True)
    ):
        blocks.append(
            page.matrix(
                fit.dof,
                values,
                sds,
                matrix_units(letter, fit.dof, law.time_power),
                f"{letter} {_ABOUT}; ± one standard deviation and, below it, the 95 % interval, all sources.",
                title="Stiffness K" if letter == "K" else f"Damping D ({law.formula})",
                interval_95_si=np.stack([side[place] for side in limits], axis=-1),
            )
        )
    return blocks


def sections(fit: KDFit, figures: Mapping[str, Figure]) -> dict[str, list[Markup]]:
    """Return the blocks of every section by its heading, in their order; empty ones are left out."""
    made = {
        "Measured and simulated responses": _responses(figures),
        "Modes": _modes(fit),
        "Principal axes and plane of the ligament": [*_axes(fit, figures), *_plane(fit)],
        "Is the model right?": _causes(fit, figures),
        "Where the uncertainty comes from": _budget(fit),
        "What the data determine": _identifiability(fit),
    }
    return {name: blocks for name, blocks in made.items() if blocks}


def _drawn(figures: Mapping[str, Figure], name: str, caption: str, alt: str) -> list[Markup]:
    return [page.figure(figures[name], caption, alt, file=name)] if name in figures else []


def _responses(figures: Mapping[str, Figure]) -> list[Markup]:
    text = (
        "The structure's motion at the footplate centre (dots) against the response of the fitted model "
        "(line) to the measured base motion at the same point and to the load of other measured motion: "
        "paper Eq. 8, Figs. 4 and 5. The band is what the uncertainty of K and D leaves open (95 %); "
        "ripples of the line are noise of the base."
    )
    blocks = [page.text(text)]
    for name in figures:
        if name.startswith("responses"):
            caption = f"Run {name.rpartition('_')[2]}." if "responses_run_2" in figures else ""
            blocks += _drawn(figures, name, caption, "measured and simulated responses")
    return blocks


def _modes(fit: KDFit) -> list[Markup]:
    if not fit.modes.pairs:
        return [page.text("No mode oscillates: all eigenvalues are real.")]
    derived, rows = fit.derived, []
    for place, mode in enumerate(fit.modes.pairs):
        values = (
            (mode.frequency_hz, derived.frequency_sd_hz[place]),
            (mode.undamped_frequency_hz, derived.undamped_sd_hz[place]),
            (mode.damping_ratio, derived.ratio_sd[place]),
        )
        shape = zip(np.abs(mode.shape), derived.shape_sd[place], strict=True)
        numbers = (Quantity(float(value), float(sd)) for value, sd in values)
        rows.append((f"mode {place + 1}", *numbers, *(f"{size:.3g} ± {sd:.1g}" for size, sd in shape)))
    head = ("", "damped (Hz)", "undamped (Hz)", "damping ratio", *(f"|{name}|" for name in fit.dof))
    roots = ", ".join(f"{root:.4g}" for root in fit.modes.overdamped_roots_1_s)
    caption = f"Shapes: {NORMALISATION}." + (f" Overdamped roots: {roots} 1/s." if roots else "")
    return [page.table(head, rows, caption)]


_MILLIMETRE, _DEGREE = ShownUnit("mm", 1e3), ShownUnit("°", 180.0 / np.pi)
_AXES = (
    ("origin x", _MILLIMETRE),
    ("origin z", _MILLIMETRE),
    ("angle about +y", _DEGREE),
    ("along y", STIFFNESS),
    ("about the axis near x", ROTATION_STIFFNESS),
    ("about the axis near z", ROTATION_STIFFNESS),
)
"""Principal axes as people see them (`fitting.axes.NAMES`)."""


def _axes(fit: KDFit, figures: Mapping[str, Figure]) -> list[Markup]:
    values, sds = fit.derived.axes, fit.derived.axes_sd
    if values is None or sds is None:
        return []
    rows = [
        (name, Quantity(float(value), float(sd), unit))
        for (name, unit), value, sd in zip(_AXES, values, sds, strict=True)
    ]
    caption = "The point and the turn about y that uncouple piston and rocking (paper, Fig. 6); not eig(K)."
    blocks = [page.table(("", "principal axes of K"), rows, caption)]
    blocks += _drawn(figures, "principal_axes", "Origin and axes on the footplate.", "principal axes")
    ring = ring_of(fit)
    if ring is not None:
        shear, loss = (plus_minus(part.value, part.sd) for part in (ring.shear_pa, ring.loss_factor))
        text = (
            "A uniform ring of the same piston stiffness around this footplate would be {:.2f} (near x) "
            "and {:.2f} (near z) times less stiff against rocking than measured: 1 is an even ligament. Its "
            f"shear modulus times thickness over width is {shear} Pa, its loss factor {loss} in the middle "
            "of the band."
        ).format(*ring.rocking_ratio)
        freq = fit.found.data.freq_hz
        rise = causal_rise(fit.law, ring.loss_factor.value, (float(freq.min()), float(freq.max())))
        if rise is not None:
            text += (
                f" {fit.law.name.capitalize()} damping with a constant K is not causal: with this loss "
                f"factor K of a real ligament rises by {100.0 * rise:.0f} % over the band (Kramers and "
                "Kronig)."
            )
        blocks.append(page.text(text))
    return blocks


def _plane(fit: KDFit) -> list[Markup]:
    plane = fit.plane
    if plane is None or fit.height is None:
        return []
    height, sd = (1e3 * value for value in fit.height)
    source = "from the in-plane motion" if plane.determined else "assumed: 2.2 ± 1.5 times the piston's"
    values, sds = (entries.split(part, 3)[0] for part in (plane.entries, np.sqrt(np.diag(plane.covariance))))
    along_x, along_z = (plus_minus(values[place, place], sds[place, place]) for place in (0, 1))
    text = (
        f"The ligament's plane is {plus_minus(height, sd)} mm above the footplate centre. In this plane the "
        f"stiffness is {along_x} N/m along x and {along_z} N/m along z ({source}). K and D about that plane "
        f"are in kd.json. Equations of motion: {equation(fit)}."
    )
    return [page.text(text)]


def _causes(fit: KDFit, figures: Mapping[str, Figure]) -> list[Markup]:
    found, search, bands = fit.found, fit.solution.search, fit.solution.bands
    text = f"chi2 = {found.chi2:.1f} for {found.n_dof} degrees of freedom (p = {found.p_value:.2g}). "
    if search.best is not None:
        text += f"The best explanation is {search.best.title}. "
    elif search.scores:
        none = "No further unknown is called for. "
        text += none if found.explained else "Nothing that was tried explains it. "
    if bands is not None:
        text += f"One K and one D over the whole band: p = {bands.p_value:.2g}; {bands.words()}."
    blocks = [page.text(text)]
    if search.alternatives:
        rows = [
            (
                other.title,
                f"{plus_minus(other.value, other.sd)} {other.unit}".strip()
                if other.sd
                else f"{other.value:g}",
                f"e^{other.log_odds:.0f}",
                _YES[other.found.explained],
                Quantity(float(weight), None, PERCENT),
            )
            for other, weight in zip(search.alternatives, search.weights, strict=True)
        ]
        head = ("explanation", "size", "odds against none", "explains the data", "weight")
        caption = "Intervals of K and D are averaged over these explanations with their weights."
        blocks.append(page.table(head, rows, caption))
    least = [
        (one.title, Quantity(found_from(score.sd, one.sd, one.chance)), one.unit)
        for score in search.scores
        if not (one := score.unknown).family and one.only is None
    ]
    if least:
        table = page.table(("error that these data can reveal", "from", ""), least)
        blocks.append(page.folded("From which size errors are found", table))
    caption = "No pattern (left) and a straight line (right) mean that the model holds."
    blocks += _drawn(figures, "residuals", caption, "residuals")
    if fit.solution.laws:
        compared = [
            (name, one.law.formula, float(one.chi2), _YES[one.explained])
            for name, one in fit.solution.laws.items()
        ]
        columns = ("damping law", "dynamic stiffness", "chi2", "explains the data")
        blocks.append(page.table(columns, compared, words=True))
    return blocks


_YES = {True: "yes", False: "no"}


def _size(value: float, sd: float, unit: str) -> str:
    return f"{plus_minus(value, sd)} {unit}".strip() if sd else f"{value:g}"


def _budget(fit: KDFit) -> list[Markup]:
    places = entries.diagonals(len(fit.dof))
    words = shown_sources(fit.budget)
    variances = {words[source]: np.diag(part)[places] for source, part in fit.budget.items()}
    size = entries.sizes(fit.stiffness, fit.damping)[places]

    def row(source: str, variance: Array) -> tuple[str, ...]:
        sd = np.sqrt(np.maximum(variance, 0.0))
        return (source, *(share_of(own, whole) for own, whole in zip(sd, size, strict=True)))

    by_size = sorted(variances, key=lambda source: -float(np.max(variances[source] / size**2)))
    largest, rest = by_size[:_LARGEST], by_size[_LARGEST:]
    rows = [row(source, variances[source]) for source in largest]
    if rest:
        rows.append(row(f"{len(rest)} others together", np.sum([variances[one] for one in rest], axis=0)))
    rows.append(row("all sources", np.diag(fit.covariance)[places]))
    names = [f"{fit.parameters[place]}, {letter}({name})" for place, (letter, name) in
             zip(places, [(letter, name) for letter in "KD" for name in fit.dof], strict=True)]  # fmt: skip
    caption = "Standard deviation that goes away where a source is known exactly, in percent of the entry."
    table = page.table(("source", *names), rows, caption)
    blocks = [table]
    if rest:
        whole = page.table(("source", *names), [row(one, variances[one]) for one in by_size])
        blocks.append(page.folded("All sources", whole))
    return blocks


def share_of(part: float, size: float) -> str:
    """Return a share in percent; a diagonal entry at its bound zero has none."""
    return f"{100.0 * part / size:.2g} %" if 0.0 < size < np.inf else "at its bound"


def _identifiability(fit: KDFit) -> list[Markup]:
    relative = entries.sizes(fit.stiffness, fit.damping)
    rows = [
        (name, determined(value, sd, share_of(sd, size)), share_of(bound, size))
        for name, value, sd, bound, size in zip(
            fit.parameters, fit.values, np.sqrt(np.diag(fit.covariance)), fit.bound, relative, strict=True
        )
    ]
    caption = (
        "Relative to sqrt(Xii Xjj). Bound: smallest sd of any unbiased estimator of this model (Cramer-Rao)."
    )
    return [page.table(("entry", "standard deviation", "bound"), rows, caption)]


def plan_page(plan: Plan, ways: tuple[Way, ...], provenance: Mapping[str, Any]) -> Page:
    """Return plan.html: what a plan reaches, what limits it, and what a change would bring."""
    fit = ways[0].fit
    lead = (
        f"{plan.lines} lines of {plan.band_hz[0]:g} to {plan.band_hz[1]:g} Hz, driven along "
        f"{', '.join(plan.directions)}."
    )
    made = page.Page("What a planned measurement can reach", lead)
    made.add(page.table(("", ""), plan_rows(ways), words=True), *matrices(fit))
    rows = [
        (way.name, *(f"{100.0 * value:.2g} %" for value in way.relative), ", ".join(way.weak) or "none")
        for way in ways
    ]
    head = ("", *fit.parameters, "over 10 %")
    made.section(
        "What a change would bring",
        page.table(head, rows, "Expected sd relative to sqrt(Xii Xjj)."),
    )
    made.section("What limits the entries", *_budget(fit))
    made.appendix_section("Inputs", page.inputs(dict(provenance)))
    return made


def report_sections(fit: KDFit, into: Page) -> list[Section]:
    """Add the sections of a fit to the page of a study; return them."""
    return [into.section(name, *blocks) for name, blocks in sections(fit, all_figures(fit)).items()]
