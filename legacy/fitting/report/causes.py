"""Possible errors, the mass of fluid, and errors that no data can show: for kd.json and the page."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.fitting.causes.catalogue import CAUSES, shown_unit, title_of, unit_of
from legacy.fitting.causes.diagnosis import Diagnosis, largest_effect, relative_effect
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.parameter_vector import join
from legacy.stapeskit.arrays import Array, finite_or_none
from legacy.stapeskit.page import page
from legacy.stapeskit.page.page import Section

if TYPE_CHECKING:
    from markupsafe import Markup

# Relative error of the frequency axis whose effect is given.
_FREQUENCY = 1e-3
# Errors that are listed as those that may go unseen.
_SHOWN = 4


def causes_json(fit: KDFit) -> dict[str, Any]:
    """Return the keys ``causes`` to ``fluid`` of kd.json; null without the joint fit."""
    diagnosis, fluid = fit.diagnosis, fit.fluid
    if diagnosis is None or fluid is None:
        return {"causes": None, "sensitivities": None, "unseen": None, "fluid": None}
    named = diagnosis.named
    scored = zip(
        diagnosis.tested,
        diagnosis.scores.z,
        diagnosis.scores.p_values,
        diagnosis.scores.estimate,
        diagnosis.scores.sd,
        strict=True,
    )
    return {
        "causes": {
            "searched": diagnosis.searched,
            "named": None if named is None else named.name,
            "look_alikes": list(diagnosis.look_alikes),
            "least_fall_of_chi2": diagnosis.threshold,
            "scores": [
                {
                    "name": name,
                    "z": float(z),
                    "p_value": float(p),
                    "estimate": float(size),
                    "sd": float(sd),
                    "seen_from": finite_or_none(diagnosis.seen_from.get(name)),
                    "unit": unit_of(name),
                }
                for name, z, p, size, sd in scored
            ],
            "refits": [
                {
                    "name": refit.name,
                    "title": title_of(refit.name),
                    "size": refit.size,
                    "sd": refit.sd,
                    "unit": unit_of(refit.name),
                    "fall_of_chi2": refit.fall,
                    "p_value": refit.p_value,
                    "change_si": _by_entry(fit, refit.effect),
                }
                for refit in diagnosis.refits
            ],
            "corrected": {
                name: {"size": size, "sd": sd, "unit": unit_of(name)}
                for name, (size, sd) in diagnosis.corrected.items()
            },
        },
        "sensitivities": [
            {"name": name, "title": title, "size": size, "unit": unit, "change_si": _by_entry(fit, change)}
            for name, title, size, unit, change in sensitivities(fit, diagnosis)
        ],
        "unseen": [
            {
                "name": name,
                "size": size,
                "unit": unit_of(name),
                "change_relative": dict(zip(fit.parameters, map(float, change), strict=True)),
            }
            for name, size, change in unseen(fit, diagnosis)
        ],
        "fluid": {
            "option": fluid.option,
            "cochlea": fluid.cochlea,
            "used": fluid.used,
            "mass_kg": fluid.mass_kg,
            "mass_sd_kg": fluid.mass_sd_kg,
            "reason": fluid.reason,
        },
    }


def sensitivities(fit: KDFit, diagnosis: Diagnosis) -> list[tuple[str, str, float, str, Array]]:
    """Return name, title, size, unit and change of K and D, SI, of errors that are there and left out."""
    rows = [
        (name, cause.title, cause.example, cause.unit, diagnosis.sensitivities[name])
        for name, cause in CAUSES.items()
        if cause.refitted and not name.startswith("holder") and name in diagnosis.sensitivities
    ]
    axis = join(2.0 * fit.stiffness, (2.0 - fit.law.time_power) * fit.damping) * _FREQUENCY
    rows.append(("frequency_axis", "frequencies that are too high", 100.0 * _FREQUENCY, "%", axis))
    return rows


def unseen(fit: KDFit, diagnosis: Diagnosis) -> list[tuple[str, float, Array]]:
    """Return causes that may go unseen, the worst first, with size and changes over sqrt(Xii Xjj).

    The size is the one from which a cause is found in four of five measurements, or twice its usual size
    where that is smaller or the data do not show the cause.
    """
    rows = []
    for name in diagnosis.sensitivities:
        if not CAUSES[name].refitted or CAUSES[name].family:
            continue
        detectable = diagnosis.seen_from.get(name, np.inf)
        size = min(detectable, 2.0 * CAUSES[name].usual, CAUSES[name].only or np.inf)
        change = diagnosis.sensitivities[name] * size / CAUSES[name].example
        rows.append((name, size, relative_effect(change, fit.stiffness, fit.damping)))
    return sorted(rows, key=lambda row: -float(np.nanmax(np.abs(row[2]))))


def _by_entry(fit: KDFit, change: Array) -> dict[str, float | None]:
    return {name: finite_or_none(value) for name, value in zip(fit.parameters, change, strict=True)}


def causes_section(fit: KDFit, diagnosis: Diagnosis) -> Section:
    """Return whether to believe the fit: the named cause, what was refitted, scores and sensitivities."""
    section = Section("Is the model right?", key="causes")
    named = diagnosis.named
    if named is None and not diagnosis.searched:
        words = (
            "No error of the catalogue is called for: none of the directed scores is improbable, and the "
            "residuals are those of noise and shared errors. The z of a step and of a resonance is the "
            "largest of many places: it must be larger than others to count."
        )
        if diagnosis.refits:
            words += " Those under Refits are possible; their effect is in the intervals by its evidence."
    elif named is None:
        words = (
            "Something is wrong, but no cause of the catalogue explains it: K and D are not to be trusted."
        )
    else:
        words = f"The data speak for {title_of(named.name)}; see the warnings."
    section.add(page.text(words))
    if diagnosis.corrected:
        rows = [
            (title_of(name), shown_unit(unit_of(name)).with_sd(size, sd))
            for name, (size, sd) in diagnosis.corrected.items()
        ]
        section.add(page.subheading("Estimated with K and D"), page.table(("", "size"), rows))
    if diagnosis.refits:
        ranked = (
            "Best first: by the fall of chi2 less what as many unknowns explain by chance, and less (size / "
            "usual size)^2 for a mass matrix of another stapes."
        )
        section.add(page.subheading("Refits"), page.text(ranked), _refit_table(fit, diagnosis))
    section.add(page.subheading("Scores"), _score_table(diagnosis))
    section.add(page.subheading("What may be wrong without a word"), page.text(_unseen_words(fit, diagnosis)))
    section.add(
        page.subheading("What an error that is left out does"),
        page.text(
            "Changes of the entries over sqrt(Xii Xjj), to first order, in %. An error is found in four of "
            "five measurements like this one from the size under 'seen from' on; another mass and the "
            "frequency axis are never seen."
        ),
        _sensitivity_table(fit, diagnosis),
    )
    return section


def _unseen_words(fit: KDFit, diagnosis: Diagnosis) -> str:
    parts = []
    for name, size, change in unseen(fit, diagnosis)[:_SHOWN]:
        place = int(np.nanargmax(np.abs(change)))
        parts.append(
            f"{title_of(name)}, {shown_unit(unit_of(name)).text(size, '.2g')}".rstrip()
            + f" ({fit.parameters[place]} {_percent(100.0 * change[place])} %)"
        )
    return (
        f"Smaller errors than these may go unseen, and are in no interval unless they are stated with the "
        f"mass matrix or the motion: {'; '.join(parts)}. A mass matrix that is wrong as a whole by a factor "
        "puts K and D off by the same factor and is never seen."
    )


def _refit_table(fit: KDFit, diagnosis: Diagnosis) -> Markup:
    rows = []
    for refit in diagnosis.refits:
        place, change = largest_effect(refit.effect, fit.stiffness, fit.damping)
        unit = shown_unit(unit_of(refit.name))
        size = unit.with_sd(refit.size, refit.sd) if refit.sd > 0.0 else unit.text(refit.size, ".3g")
        rows.append(
            (
                title_of(refit.name),
                size,
                f"{refit.fall:.1f}",
                f"{refit.p_value:.2g}",
                f"{fit.parameters[place]} {100.0 * change:+.2g} %",
            )
        )
    return page.table(("cause", "size", "fall of chi2", "p of the rest", "largest change"), rows)


def _score_table(diagnosis: Diagnosis) -> Markup:
    scores = diagnosis.scores
    rows = []
    for name, z, size, sd in zip(diagnosis.tested, scores.z, scores.estimate, scores.sd, strict=True):
        unit = shown_unit(unit_of(name))
        rows.append((title_of(name), f"{z:+.1f}", f"{unit.of(size):.2g} ± {unit.text(sd, '.1g')}"))
    return page.table(("cause", "z", "size to first order"), rows)


def _sensitivity_table(fit: KDFit, diagnosis: Diagnosis) -> Markup:
    rows = []
    for name, title, size, given, change in sensitivities(fit, diagnosis):
        unit = shown_unit(given)
        if name in CAUSES and CAUSES[name].family and name not in diagnosis.tested:
            continue  # of causes that differ by their place the likeliest alone has a score
        relative = 100.0 * relative_effect(change, fit.stiffness, fit.damping)
        detectable = finite_or_none(diagnosis.seen_from.get(name))
        least = "never" if detectable is None else unit.text(detectable, ".2g")
        rows.append((f"{title}: {unit.text(size)}", least, *map(_percent, relative)))
    return page.table(("error", "seen from", *fit.parameters), rows)


def _percent(value: float) -> str:
    return f"{value:+.0f}" if abs(value) >= 100.0 else f"{value:+.2g}"
