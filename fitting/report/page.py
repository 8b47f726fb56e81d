"""kd.html: verdict, K and D, responses, modes, axes, causes, budget; other reports take sections over."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fitting import entries
from fitting.model import NORMALISATION
from fitting.report.figures import all_figures, rim_figure
from fitting.report.kd_json import equation
from fitting.report.summary import determined, summary_rows
from fitting.ring import rim_of, ring_of
from stapeskit.arrays import Array
from stapeskit.report import page
from stapeskit.report.quantities import (
    LENGTH,
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

    from markupsafe import Markup
    from matplotlib.figure import Figure

    from fitting.result import KDFit
    from stapeskit.report.page import Page, Section

_LARGEST = 5  # sources of uncertainty that are listed one by one
_ABOUT = "about the footplate centre in footplate axes"
_YES = {True: "yes", False: "no"}


def kd_page(fit: KDFit) -> Page:
    """Return the page of a fit."""
    lead = (
        f"{', '.join(fit.dof)} {_ABOUT}; estimator {fit.options.estimator}, {fit.law.name} damping "
        f"({fit.law.formula}), {fit.found.data.count} lines."
    )
    made = page.Page("Stiffness and damping of the annular ligament", lead)
    made.add(verdict_block(fit), page.beside(summary_table(summary_rows(fit)), *rim_blocks(fit)))
    made.add(page.beside(*matrices(fit)))
    add_sections(fit, made)
    made.section("Warnings", page.notices(fit.notices))
    made.appendix_section("Inputs", page.inputs(fit.provenance))
    return made


def add_sections(fit: KDFit, into: Page) -> list[Section]:
    """Add the sections of a fit to a page, also that of a study; return them."""
    figures = all_figures(fit)
    made = {
        "Measured and simulated responses": _responses(fit, figures),
        "Modes": _modes(fit),
        "Principal axes and plane of the ligament": [*_axes(fit, figures), *_plane(fit)],
        "Is the model right?": _causes(fit, figures),
        "Where the uncertainty comes from": budget_blocks(fit),
        "What the data determine": _identifiability(fit),
    }
    return [into.section(name, *blocks) for name, blocks in made.items() if blocks]


def summary_table(rows: Sequence[tuple[str, str]]) -> Markup:
    """Return a summary without the rows that the matrices show."""
    return page.table(("", ""), [row for row in rows if not row[0].startswith(("K(", "D("))], words=True)


def rim_blocks(fit: KDFit) -> list[Markup]:
    """Return the stiffness along the rim of the footplate, where it is known."""
    rim = rim_of(fit)
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
    caption = f"{_ABOUT}; ± one standard deviation and, below it, the 95 % interval, all sources."
    blocks = []
    for letter, title, value, sd in zip(
        "KD",
        ("Stiffness K", f"Damping D ({fit.law.formula})"),
        (fit.stiffness, fit.damping),
        fit.standard_deviation,
        strict=True,
    ):
        units = matrix_units(letter, fit.dof, fit.law.time_power)
        blocks.append(page.matrix(fit.dof, value, sd, units, f"{letter} {caption}", title=title))
    return blocks


def _responses(fit: KDFit, figures: Mapping[str, Figure]) -> list[Markup]:
    text = (
        "The structure's motion at the footplate centre (dots) against the response of the fitted model "
        "(line) to the measured base motion at the same point and to the load of other measured motion: "
        "paper Eq. 8, Figs. 4 and 5. The band is what the uncertainty of K and D leaves open (95 %); "
        "ripples of the line are noise of the base."
    )
    blocks, runs = [page.text(text)], [name for name in figures if name.startswith("responses")]
    for name, run in zip(runs, fit.found.data.runs, strict=False):
        caption = f"Run {run}." if len(runs) > 1 else ""
        blocks.append(page.figure(figures[name], caption, "measured and simulated responses", file=name))
    return blocks


def _modes(fit: KDFit) -> list[Markup]:
    if not fit.modes.pairs:
        return [page.text("No mode oscillates: all eigenvalues are real.")]
    derived, rows = fit.derived, []
    for place, mode in enumerate(fit.modes.pairs):
        shape = zip(np.abs(mode.shape), derived.shape_sd[place], strict=True)
        numbers = (
            Quantity(mode.frequency_hz, float(derived.frequency_sd_hz[place])),
            Quantity(mode.undamped_frequency_hz, float(derived.undamped_sd_hz[place])),
            Quantity(mode.damping_ratio, float(derived.ratio_sd[place])),
        )
        rows.append((f"mode {place + 1}", *numbers, *(f"{size:.3g} ± {sd:.1g}" for size, sd in shape)))
    head = ("", "damped (Hz)", "undamped (Hz)", "damping ratio", *(f"|{name}|" for name in fit.dof))
    roots = ", ".join(f"{root:.4g}" for root in fit.modes.overdamped_roots_1_s)
    caption = f"Shapes: {NORMALISATION}." + (f" Overdamped roots: {roots} 1/s." if roots else "")
    return [page.table(head, rows, caption)]


_AXES = (
    ("origin x", LENGTH),
    ("origin z", LENGTH),
    ("angle about +y", ShownUnit("°", 180.0 / np.pi)),
    ("along y", STIFFNESS),
    ("about the axis near x", ROTATION_STIFFNESS),
    ("about the axis near z", ROTATION_STIFFNESS),
)
"""Principal axes as people see them (`fitting.model.principal_axes`)."""


def _axes(fit: KDFit, figures: Mapping[str, Figure]) -> list[Markup]:
    values, sds = fit.derived.axes, fit.derived.axes_sd
    if values is None or sds is None:
        return []
    numbers = zip(_AXES, values.tolist(), sds.tolist(), strict=True)
    rows = [(name, Quantity(value, sd, unit)) for (name, unit), value, sd in numbers]
    caption = "The point and the turn about y that uncouple piston and rocking (paper, Fig. 6); not eig(K)."
    blocks = [
        page.table(("", "principal axes of K"), rows, caption),
        page.figure(figures["principal_axes"], "Origin and axes on the footplate.", "principal axes"),
    ]
    ring = ring_of(fit)
    if ring is not None:
        near_x, near_z = ring.rocking_ratio
        text = (
            f"A uniform ring of the same piston stiffness around this footplate would be {near_x:.2f} (near "
            f"x) and {near_z:.2f} (near z) times less stiff against rocking than measured: 1 is an even "
            f"ligament. Its shear modulus times thickness over width is {plus_minus(*ring.shear_pa)} Pa, its "
            f"loss factor {plus_minus(*ring.loss_factor)} in the middle of the band."
        )
        blocks.append(page.text(text))
    return blocks


def _plane(fit: KDFit) -> list[Markup]:
    plane = fit.plane
    if plane is None or fit.height is None:
        return []
    height, sd = (1e3 * value for value in fit.height)
    source = "from the in-plane motion" if plane.determined else "2.2 ± 1.5 times the piston's is assumed"
    values, sds = (entries.split(part, 3)[0] for part in (plane.entries, np.sqrt(np.diag(plane.covariance))))
    along_x, along_z = (plus_minus(values[place, place], sds[place, place]) for place in (0, 1))
    text = (
        f"The ligament's plane is {plus_minus(height, sd)} mm above the footplate centre. In this plane the "
        f"stiffness is {along_x} N/m along x and {along_z} N/m along z ({source}). K and D about that plane "
        f"are in kd.json. Equations of motion: {equation(fit)}."
    )
    return [page.text(text)]


def _causes(fit: KDFit, figures: Mapping[str, Figure]) -> list[Markup]:
    found, search, bands = fit.found, fit.search, fit.bands
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
                f"{plus_minus(other.value, other.sd)} {other.unit}" if other.sd else f"{other.value:g}",
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
        (score.unknown.title, Quantity(score.found_from), score.unknown.unit)
        for score in search.scores
        if not score.unknown.family and score.unknown.only is None
    ]
    if least:
        table = page.table(("error that these data can reveal", "from", ""), least)
        blocks.append(page.folded("From which size errors are found", table))
    caption = "No pattern (left) and a straight line (right) mean that the model holds."
    blocks.append(page.figure(figures["residuals"], caption, "residuals", file="residuals"))
    if fit.laws:
        compared = [
            (name, one.law.formula, float(one.chi2), _YES[one.explained]) for name, one in fit.laws.items()
        ]
        columns = ("damping law", "dynamic stiffness", "chi2", "explains the data")
        blocks.append(page.table(columns, compared, words=True))
    return blocks


_SOURCES = {
    "channel_noise": "channel noise",
    "registration": "registration of the vibrometer",
    "plate_frame": "plate frame in the scan",
    "footplate_frame": "footplate frame (motion and mass together)",
    "position": "point positions",
    "laser_gain": "gain of the lasers",
    "laser_phase": "phase of the lasers",
    "laser_delay": "delay of the lasers",
    "inplane_stiffness": "stiffness in the plane of the ligament",
    "ligament_plane": "height and tilt of the ligament's plane (second order)",
    "model_error": "what the model may lack, and weak data",
}
"""Sources of a budget as people call them."""


def _shown_source(source: str) -> str:
    from stapeskit.records.mass_matrix import source_words

    if source.startswith("mass."):
        return source_words(source.removeprefix("mass."))
    return _SOURCES.get(source, source.replace("_", " "))


def budget_blocks(fit: KDFit) -> list[Markup]:
    """Return the largest sources of uncertainty of the diagonal entries; all of them folded."""
    places = entries.diagonals(len(fit.dof))
    size = entries.sizes(fit.stiffness, fit.damping)[places]
    variances = {_shown_source(source): np.diag(part)[places] for source, part in fit.budget.items()}
    by_size = sorted(variances, key=lambda source: -float(np.max(variances[source] / size**2)))
    largest, rest = by_size[:_LARGEST], by_size[_LARGEST:]
    shown = {source: variances[source] for source in largest}
    if rest:
        shown[f"{len(rest)} others together"] = np.sum([variances[source] for source in rest], axis=0)
    shown["all sources"] = np.diag(fit.covariance)[places]
    names = zip(places, [f"{letter}({name})" for letter in "KD" for name in fit.dof], strict=True)
    head = ("source", *(f"{fit.parameters[place]}, {name}" for place, name in names))

    def rows(parts: Mapping[str, Array]) -> list[tuple[str, ...]]:
        sds = {source: np.sqrt(np.maximum(part, 0.0)) for source, part in parts.items()}
        return [(source, *map(share_of, sd.tolist(), size.tolist())) for source, sd in sds.items()]

    caption = "Standard deviation that goes away where a source is known exactly, in percent of the entry."
    blocks = [page.table(head, rows(shown), caption)]
    if rest:
        every = {source: variances[source] for source in by_size}
        blocks.append(page.folded("All sources", page.table(head, rows(every))))
    return blocks


def share_of(part: float, size: float) -> str:
    """Return a share in percent; a diagonal entry at its bound zero has none."""
    return f"{100.0 * part / size:.2g} %" if 0.0 < size < np.inf else "at its bound"


def _identifiability(fit: KDFit) -> list[Markup]:
    numbers = zip(fit.values, fit.sd, fit.bound, entries.sizes(fit.stiffness, fit.damping), strict=True)
    rows = [
        (name, determined(value, sd, share_of(sd, size)), share_of(bound, size))
        for name, (value, sd, bound, size) in zip(fit.parameters, numbers, strict=True)
    ]
    caption = (
        "Relative to sqrt(Xii Xjj). Bound: smallest sd of any unbiased estimator of this model (Cramer-Rao)."
    )
    return [page.table(("entry", "standard deviation", "bound"), rows, caption)]
