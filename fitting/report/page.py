"""kd.html: verdict, K and D, responses, modes, axes, causes, budget; other reports take sections over."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fitting import entries
from fitting.model import NORMALISATION
from fitting.plane import usual_ratio
from fitting.report.figures import (
    MOST_RUNS,
    amplitude_figure,
    footplate_figure,
    residual_figure,
    response_figure,
)
from fitting.report.kd_json import equation
from fitting.report.summary import model_rows
from fitting.ring import rim_of, ring_of
from stapeskit.arrays import Array
from stapeskit.report import page
from stapeskit.report.quantities import (
    HERTZ,
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

    from fitting.result import KDFit
    from stapeskit.report.page import Page

_LARGEST = 5  # sources of uncertainty that are listed one by one
_MOST_BESIDE = 3  # degrees of freedom of matrices that stand beside each other
_ABOUT = "about the footplate centre in footplate axes"
_YES = {True: "yes", False: "no"}


def kd_page(fit: KDFit) -> Page:
    """Return the page of a fit."""
    lead = (
        f"{', '.join(fit.dof)} {_ABOUT}; estimator {fit.options.estimator}, {fit.law.name} damping "
        f"({fit.law.formula}), {fit.found.data.count} lines."
    )
    made = page.Page("Stiffness and damping of the annular ligament", lead)
    made.add(*first_screen(fit))
    made.section(*responses_section(fit))
    add_sections(fit, made)
    made.section("Warnings", page.notices(fit.notices))
    made.appendix_section("Inputs", page.inputs(fit.provenance))
    return made


def first_screen(fit: KDFit, *others: Markup) -> list[Markup]:
    """Return verdict, K, D, other matrices, modes, the footplate and what is known of the model."""
    about = f"{page.PLUS_MINUS} {'K, D and M' if others else 'K and D'} are {_ABOUT}."
    cells = [*matrices(fit), *others, *_first_modes(fit), *footplate_blocks(fit)]
    alt = "Amplitudes of the structure, measured and fitted, and of the base."
    cells.append(page.figure(amplitude_figure(fit), "", alt, file="amplitudes", title="Measured and fitted"))
    if len(fit.dof) > _MOST_BESIDE:
        return [verdict_block(fit), page.note(about), *cells]
    return [verdict_block(fit), page.note(about), page.beside(*cells)]


def responses_section(fit: KDFit) -> tuple[str, *tuple[Markup, ...]]:
    """Return heading and blocks on measured and fitted responses."""
    caption = (
        "Motion of the footplate centre, and the response of the fitted model to the measured motion of the "
        "base at the same point and to the load of other measured motion (paper, Eq. 8, Figs. 4 and 5); the "
        "band is 95 % of K and D with this M, ripples of the line are noise of the base."
    )
    runs = fit.found.data.runs[:MOST_RUNS]
    figures = []
    for run, name in enumerate(runs):
        words = (f"Run {name}. " if len(runs) > 1 else "") + caption
        drawn = response_figure(fit, run)
        figures.append(
            page.figure(drawn, words, "measured and fitted responses", file=f"responses_run_{run + 1}")
        )
    return "Measured and fitted responses", *figures


def add_sections(fit: KDFit, into: Page) -> None:
    """Add the sections of a fit below its responses to a page, also that of a study, and its appendix."""
    into.section("Modes", *_modes(fit))
    into.section("Uncertainty of K and D", *budget_blocks(fit))
    axes = [*_axes(fit), *_plane(fit)]
    if axes:
        into.appendix_section("Principal axes and plane of the ligament", *axes)
    into.appendix_section("Is the model right?", *_causes(fit))


def footplate_blocks(fit: KDFit) -> list[Markup]:
    """Return the footplate with principal axes and the stiffness along its rim, where these are known."""
    drawn, rim = footplate_figure(fit), rim_of(fit)
    if drawn is None:
        return []
    title, caption = "Principal axes of K", "Red: principal axes of K (paper, Fig. 6)."
    if rim is not None:
        title = "Stiffness along the rim"
        caption = (
            f"{rim.sentence()} From K11, K12, K13, for springs normal to the footplate that vary linearly "
            f"over it. {caption}"
        )
    alt = "The footplate, its principal axes and the stiffness along its rim."
    return [page.figure(drawn, caption, alt, file="footplate", title=title)]


def verdict_block(fit: KDFit) -> Markup:
    """Return the verdict with its reasons."""
    verdict = fit.verdict
    reasons = [Notice(reason.code, reason.text) for reason in verdict.reasons]
    return page.verdict(verdict.level, verdict.sentence.partition(": ")[2], reasons)


def matrices(fit: KDFit) -> list[Markup]:
    """Return K and D with their intervals."""
    titles, values = ("Stiffness K", f"Damping D ({fit.law.formula})"), (fit.stiffness, fit.damping)
    blocks = []
    for letter, title, value, sd in zip("KD", titles, values, fit.standard_deviation, strict=True):
        units = matrix_units(letter, fit.dof, fit.law.time_power)
        blocks.append(page.matrix(numbered(fit.dof), value, sd, units, title=title))
    return blocks


def numbered(dof: Sequence[str]) -> list[str]:
    """Return degrees of freedom with the number that names entries: K11 is that of the first."""
    return [f"{name} ({number})" for number, name in enumerate(dof, 1)]


def _first_modes(fit: KDFit) -> list[Markup]:
    """Return frequency and damping of the modes with their intervals."""
    derived, pairs = fit.derived, fit.modes.pairs
    if not pairs:
        return []
    cells = [
        (
            Quantity(mode.frequency_hz, float(derived.frequency_sd_hz[place]), HERTZ, positive=True),
            Quantity(mode.damping_ratio, float(derived.ratio_sd[place]), positive=True),
        )
        for place, mode in enumerate(pairs)
    ]
    names = [f"mode {number}" for number in range(1, len(pairs) + 1)]
    return [page.entries(names, ("frequency", "damping ratio"), cells, title="Modes")]


def _modes(fit: KDFit) -> list[Markup]:
    if not fit.modes.pairs:
        return [page.text("No mode oscillates: all eigenvalues are real.")]
    derived, rows = fit.derived, []
    for place, mode in enumerate(fit.modes.pairs):
        shape = zip(np.abs(mode.shape), derived.shape_sd[place], strict=True)
        numbers = (
            Quantity(mode.frequency_hz, float(derived.frequency_sd_hz[place]), positive=True),
            Quantity(mode.undamped_frequency_hz, float(derived.undamped_sd_hz[place]), positive=True),
            Quantity(mode.damping_ratio, float(derived.ratio_sd[place]), positive=True),
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


def _axes(fit: KDFit) -> list[Markup]:
    values, sds = fit.derived.axes, fit.derived.axes_sd
    if values is None or sds is None:
        return []
    numbers = zip(_AXES, values.tolist(), sds.tolist(), strict=True)
    rows = [(name, Quantity(value, sd, unit)) for (name, unit), value, sd in numbers]
    caption = "The point and the turn about y that uncouple piston and rocking (paper, Fig. 6); not eig(K)."
    blocks = [page.table(("", "principal axes of K"), rows, caption)]
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
    source = "from the in-plane motion" if plane.determined else f"{usual_ratio()} times the piston's assumed"
    values, sds = (entries.split(part, 3)[0] for part in (plane.entries, np.sqrt(np.diag(plane.covariance))))
    along_x, along_z = (plus_minus(values[place, place], sds[place, place]) for place in (0, 1))
    text = (
        f"The ligament's plane is {plus_minus(height, sd)} mm above the footplate centre. In this plane the "
        f"stiffness is {along_x} N/m along x and {along_z} N/m along z ({source}). K and D about that plane "
        f"are in kd.json. Equations of motion: {equation(fit)}."
    )
    return [page.text(text)]


def _causes(fit: KDFit) -> list[Markup]:
    found, search, bands = fit.found, fit.search, fit.bands
    text = f"chi2 = {found.chi2:.1f} for {found.n_dof} degrees of freedom (p = {found.p_value:.2g}). "
    if search.best is not None:
        text += f"The best explanation is {search.best.title}. "
    elif search.scores:
        none = "No further unknown is called for. "
        text += none if found.explained else "Nothing that was tried explains it. "
    if bands is not None:
        text += f"One K and one D over the whole band: p = {bands.p_value:.2g}; {bands.words()}."
    blocks = [page.table(("", ""), model_rows(fit), words=True), page.text(text)]
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
    caption = "No pattern, and one of twenty beyond the dotted lines (95 %), mean that the model holds."
    blocks.append(page.figure(residual_figure(fit), caption, "residuals", file="residuals"))
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
