"""Warnings of a fit: what its numbers, its causes and its inputs deserve; the verdict that they lead to."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtr, chdtrc, chdtri

from fitting import entries
from fitting.bands import SIGNIFICANT_P
from fitting.causes import UNKNOWNS
from fitting.options import IGNORE
from fitting.solve import MISFIT_P
from fitting.verdict import Verdict, judge, unused_codes
from stapeskit.arrays import Array
from stapeskit.faults import list_some
from stapeskit.report.quantities import MASS, plus_minus
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from fitting.result import KDFit

PISTON_RANGE = (120.0, 3200.0)
"""Published stiffness of the human annular ligament in piston direction, N/m (paper.md, 6, with a margin)."""

_HUMAN_KG = (2e-6, 4.5e-6)  # masses of human stapedes
_MASS_RANGE_KG = (0.5e-6, 10e-6)  # outside it a mass is in another unit, or of something else
_GYRATION_RANGE_MM = (0.2, 4.0)  # radii of gyration about x, z: half width to height of a stapes
_IMPRECISE, _UNDETERMINED = 0.3, 1.0  # relative sd of a diagonal entry: known to no better; of K: unknown
_FALSE_OUTLIERS = 0.01  # fits in which noise alone gives an outlying line
_BIASED = 0.02  # of sqrt(Xii Xjj): bias of an estimator of textbooks that is reported


def verdict_of(fit: KDFit) -> Verdict:
    """Return the verdict on a fit: its warnings, and what its K and D leave undetermined."""
    unused = unused_codes(fit.provenance.get("motion_provenance", {}))
    return judge([*fit.notices, *uncertain(fit)], fit.confirmed, unused)


def uncertain(fit: KDFit) -> list[Notice]:
    """Return warnings about diagonal entries that are undetermined or known to no better than 30 %."""
    relative = {}
    for letter, values, sds in zip("KD", (fit.stiffness, fit.damping), fit.standard_deviation, strict=True):
        for place, name in enumerate(fit.dof):
            value = abs(float(values[place, place]))
            relative[f"{letter}({name})"] = float(sds[place, place]) / value if value > 0.0 else np.inf
    lost = [name for name, share in relative.items() if not share <= _UNDETERMINED]
    weak = [name for name, share in relative.items() if share > _IMPRECISE and name not in lost]
    notices = []
    if lost:
        text = f"Undetermined, with a standard deviation above the value: {', '.join(lost)}."
        stiff = any(name.startswith("K") for name in lost)
        notices.append(Notice("undetermined" if stiff else "imprecise", text))
    if weak:
        notices.append(Notice("imprecise", f"Known to no better than 30 percent: {', '.join(weak)}."))
    return notices


def result_notices(fit: KDFit) -> list[Notice]:
    """Return every warning that a result deserves."""
    found = [*_physics(fit), *_quality(fit), *_causes(fit), *_laws(fit), *_inputs(fit), *_weak(fit)]
    return [*found, *_plausibility(fit)]


def _physics(fit: KDFit) -> list[Notice]:
    notices = []
    if not fit.modes.stable:
        text = (
            f"The model is unstable: an eigenvalue has the real part {fit.modes.max_real_1_s:+.3g} 1/s. No "
            "passive ligament does this; use --estimator ml."
        )
        notices.append(Notice("unstable", text))
    wrong = [name for name, good in zip("KD", fit.passive, strict=True) if not good]
    if wrong:
        text = (
            f"{' and '.join(wrong)} not positive semidefinite: the model can give off energy that it never "
            f"took in."
        )
        notices.append(Notice("not_passive", text))
    active = active_constraints(fit)
    if active:
        text = (
            f"The estimate is held back by {', '.join(active)}; the data alone would lead elsewhere, and "
            "intervals near the constraint are approximate."
        )
        notices.append(Notice("constraint_active", text))
    book = fit.solution.textbook
    if book is not None:
        bias = book.bias / entries.sizes(
            *entries.split(fit.found.theta[fit.found.at["entries"]], len(fit.dof))
        )
        worst = int(np.argmax(np.abs(bias)))
        if abs(bias[worst]) > _BIASED:
            text = (
                f"{fit.options.estimator} is biased by the noise of its regressor however many lines there "
                f"are: {fit.parameters[worst]} by about {100.0 * bias[worst]:+.2g} % of sqrt(Xii Xjj). "
                "--estimator ml is not."
            )
            notices.append(Notice("attenuation_bias", text))
        notices += [Notice("constraint_active", f"{note}.") for note in book.notes]
    return notices


def active_constraints(fit: KDFit) -> tuple[str, ...]:
    """Return what holds the estimate back: constraints, or the limit of positive semidefinite K and D."""
    if fit.solution.textbook is not None:
        return fit.solution.textbook.active
    n = len(fit.dof)
    words = ("stiffness_psd", "damping_psd")
    parts = entries.split(fit.found.theta[fit.found.at["entries"]], n)
    active = []
    for word, part in zip(words, parts, strict=True):
        root = np.sqrt(np.maximum(np.diag(part), 1e-300))
        if np.linalg.eigvalsh(part / np.outer(root, root))[0] < 1e-6:
            active.append(word)
    return tuple(active)


def _quality(fit: KDFit) -> list[Notice]:
    found, notices = fit.found, list[Notice]()
    if not found.converged and not fit.solution.weak.shape[1]:
        notices.append(Notice("not_converged", "The fit stopped before it settled; do not trust the result."))
    if found.data.floored:
        text = (
            "The motion has no noise: it was taken as known to 8 digits, and K and D as well as that allows."
        )
        notices.append(Notice("noise_free", text))
    if found.n_dof > 0 and found.weights is None:
        if chdtrc(found.n_dof, found.chi2) < MISFIT_P:
            widened = np.sqrt(max(found.level, 1.0))
            text = (
                f"Residuals exceed noise and shared errors: chi2 per degree of freedom is {found.level:.3g}. "
                "Noise may be understated, or the model (damping law, neglected motion, mass matrix) is "
                f"wrong; channel noise was widened by {widened:.3g}, which does not cover a wrong model."
            )
            notices.append(Notice("misfit", text))
        elif not found.data.floored and chdtr(found.n_dof, found.chi2) < MISFIT_P:
            text = (
                f"Residuals are smaller than their stated noise: chi2 per degree of freedom is "
                f"{found.level:.3g}."
            )
            notices.append(Notice("noise_overstated", text))
    far = outlying_hz(fit) if not found.data.floored else np.empty(0)
    if len(far):
        listed = list_some((f"{hz:.6g}" for hz in far), 5)
        text = (
            f"{len(far)} of {found.data.count} lines lie farther off than noise brings them (at {listed} "
            "Hz); they were given little weight."
        )
        notices.append(Notice("outliers", text))
    bands = fit.solution.bands
    if bands is not None and bands.p_value < SIGNIFICANT_P:
        text = (
            f"One K and one D do not hold over the whole band (p = {bands.p_value:.1g}): {bands.words()}. A "
            "viscoelastic ligament does this, and so does a wrong mass matrix or damping law; try --damping "
            "compare, or fit parts with --band."
        )
        notices.append(Notice("frequency_dependent", text))
    return notices


def outlying_hz(fit: KDFit) -> Array:
    """Return the frequencies of lines that noise as that of most lines makes in 1 % of robust fits.

    Weights are (nu + d) / (nu + distance); over its median, the distance is judged by chi2 of d.
    """
    weights = fit.found.weights
    if weights is None:
        return np.empty(0)
    degrees = 2 * len(fit.dof)
    distance = (4.0 + degrees) / weights - 4.0
    usual = float(np.median(distance)) / float(chdtri(degrees, 0.5))
    return fit.found.data.freq_hz[distance > usual * float(chdtri(degrees, _FALSE_OUTLIERS / len(weights)))]


def _causes(fit: KDFit) -> list[Notice]:
    search, notices = fit.solution.search, list[Notice]()
    place = fit.found.at["extra"].start
    for unknown in fit.found.likelihood.model.unknowns:
        if unknown.adopt and unknown.name not in (*fit.options.freed, *fit.options.fixed):
            value = float(fit.found.theta[place])
            sd = float(np.sqrt(fit.found.covariance[place, place]))
            text = (
                f"{unknown.title[0].upper()}{unknown.title[1:]} of {plus_minus(value, sd)} {unknown.unit} is "
                "part of the model, since the data call for it. K and D exclude it; damping by fluid cannot "
                "be separated and is included in D11. --unknowns none leaves it out."
            )
            notices.append(Notice(f"{unknown.name}_found", text))
        place += 1 + len(unknown.companions)
    best = search.best
    if best is None or best.name.removeprefix("law_") in fit.solution.laws_alike:
        return notices
    size = f" of {plus_minus(best.value, best.sd)} {best.unit}".rstrip() if best.sd > 0.0 else ""
    change = fit.effect(best)[:, 0] / entries.sizes(fit.stiffness, fit.damping)
    worst = int(np.argmax(np.abs(change)))
    text = (
        f"The best explanation is {best.title} ({best.name}){size}; its odds against none are "
        f"e^{best.log_odds:.0f}. "
        f"With it {fit.parameters[worst]} changes by {100.0 * change[worst]:+.2g} % of sqrt(Xii Xjj)."
    )
    alike = [other.title for other in search.look_alikes]
    if alike:
        text += f" It cannot be distinguished from {' or '.join(alike)}."
    text += " K and D are without it, but their intervals include that change."
    if best.name in UNKNOWNS:
        text += f" --unknowns {best.name} estimates and removes it."
    elif best.unknown is None:
        text += f" Use --damping {best.name.removeprefix('law_')}, or compare."
    text += "" if best.found.explained else " It does not explain the whole misfit."
    if any(notice.code == "motion_without_h5" for notice in fit.notices):
        text += (
            " The motion was read without the correlations of its noise: fit with its .h5 file before you "
            "believe it."
        )
    return [*notices, Notice("cause_found", text)]


def _laws(fit: KDFit) -> list[Notice]:
    notices = []
    if fit.solution.laws_alike:
        text = (
            f"The damping law is undetermined: {fit.law.name} damping cannot be distinguished from "
            f"{' or '.join(fit.solution.laws_alike)} damping. K and D are those under {fit.law.name}; their "
            "intervals include what the others would change."
        )
        notices.append(Notice("law_ambiguous", text))
    if fit.solution.undetermined:
        names = ", ".join(fit.solution.undetermined)
        notices.append(
            Notice(
                "law_undetermined", f"These damping laws could not be fitted and are not compared: {names}."
            )
        )
    return notices


def _inputs(fit: KDFit) -> list[Notice]:
    data, notices = fit.found.data, list[Notice]()
    if data.dropped:
        text = f"{data.dropped} lines were left out: a value is missing there."
        notices.append(Notice("lines_dropped", text))
    if not fit.solution.inertia.contributions:
        text = "The mass matrix came without an uncertainty; the intervals of K and D do not include it."
        notices.append(Notice("mass_uncertainty_not_given", text))
    others = ", ".join(data.measured[place] for place in data.columns)
    if data.columns and not data.loads_known and fit.options.inplane != IGNORE:
        text = (
            f"The measured motion {others} loads the structure too, but the mass matrix lacks these degrees "
            "of freedom: K and D err by what the load comes to. Give mass.json, which has all six, or say "
            "by --inplane ignore that the load is small."
        )
        notices.append(Notice("inplane_mass_not_given", text))
    if fit.solution.neglected is not None:
        place, change = fit.solution.neglected
        text = (
            f"The measured motion {others} is significant but left out; it moves {fit.parameters[place]} by "
            f"{100.0 * change:.2g} % of sqrt(Xii Xjj). Use --inplane load, or auto."
        )
        notices.append(Notice("inplane_neglected", text))
    plane = fit.solution.plane
    if plane is not None and not plane.determined:
        share = np.diag(fit.budget["inplane_stiffness"]) / np.maximum(np.diag(fit.covariance), 1e-300)
        text = (
            "The in-plane motion does not determine the stiffness in the plane of the ligament; 2.2 ± 1.5 "
            f"times the piston stiffness was assumed, which is up to {100.0 * share.max():.0f} % of a "
            "variance of K and D."
        )
        notices.append(Notice("inplane_assumed", text))
    return notices


def _weak(fit: KDFit) -> list[Notice]:
    worst, parts = fit.combinations[0]
    if worst <= _IMPRECISE:
        return []
    named = ", ".join(f"{weight:+.2f} {name}" for name, weight in parts.items())
    text = (
        "The data determine some entries weakly, relative to sqrt(Xii Xjj): the worst combination of them, "
        f"{named}, has the standard deviation {100.0 * worst:.3g} %."
    )
    return [Notice("weak_identifiability", text)]


def _plausibility(fit: KDFit) -> list[Notice]:
    """Compare mass, piston stiffness and radii of gyration with those of human stapedes."""
    notices = []
    moving = [place for place, name in enumerate(fit.dof) if name in "xyz"]
    if moving and "stapes" in fit.options.structure.lower():
        mass_kg = float(fit.mass[moving[0], moving[0]])
        if not _MASS_RANGE_KG[0] <= mass_kg <= _MASS_RANGE_KG[1]:
            text = (
                f"The mass matrix gives the {fit.options.structure} {MASS.text(mass_kg, '.3g')}; human ones "
                f"weigh {MASS.of(_HUMAN_KG[0]):g} to {MASS.text(_HUMAN_KG[1])}. K and D grow in proportion "
                "to it: check that M is in SI units (kg, kg m, kg m2), or name the body by --structure if "
                "it is no stapes."
            )
            notices.append(Notice("implausible_mass", text))
    if "y" not in fit.dof:
        return notices
    place = fit.dof.index("y")
    value = float(fit.stiffness[place, place])
    if not PISTON_RANGE[0] <= value <= PISTON_RANGE[1]:
        text = (
            f"The piston stiffness {value:.4g} N/m lies outside the published {PISTON_RANGE[0]:g} to "
            f"{PISTON_RANGE[1]:g} N/m of human annular ligaments."
        )
        notices.append(Notice("implausible_stiffness", text))
    for name in ("alpha", "gamma"):
        if name in fit.dof:
            other = fit.dof.index(name)
            radius = 1e3 * float(np.sqrt(fit.mass[other, other] / fit.mass[place, place]))
            if not _GYRATION_RANGE_MM[0] <= radius <= _GYRATION_RANGE_MM[1]:
                text = (
                    f"The radius of gyration of {name}, {radius:.3g} mm, does not fit a human stapes; check "
                    "the units of M."
                )
                notices.append(Notice("implausible_inertia", text))
    return notices
