"""Every warning that a fit deserves, and the verdict on it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri

from fitting import entries
from fitting.bands import SIGNIFICANT_P
from fitting.evidence import most_moved_by_load
from fitting.options import IGNORE
from fitting.plane import usual_ratio
from fitting.uncertainty import effect_of
from fitting.unknowns import UNKNOWNS
from fitting.verdict import OF_MODEL, WEAK, Verdict, judge, unused_codes
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
_IMPRECISE = 0.3  # relative standard deviation of entries that are reported as weakly determined
_FALSE_OUTLIERS = 0.01  # fits in which noise alone gives an outlying line
_BIASED = 0.02  # of sqrt(Xii Xjj): bias of an estimator of textbooks that is reported


def verdict_of(fit: KDFit) -> Verdict:
    """Return the verdict on a fit: its warnings, and what its K and D leave undetermined.

    A K without its damping can still be used, which the verdict "check" asks to be looked at.
    """
    relative = _relative_sds(fit)
    lost = [name for name, sd in relative.items() if not sd <= 1.0]
    text = f"Undetermined, with a standard deviation above the value: {', '.join(lost)}."
    stiff = any(name.startswith("K") for name in lost)
    notice = Notice("undetermined", text) if stiff else Notice("weak_identifiability", text)
    unused = unused_codes(fit.provenance.get("motion_provenance", {}))
    worst = entries.diagonals(len(fit.dof))[int(np.argmax(list(relative.values())))]
    by_itself = np.sum(fit.model_error[worst] ** 2) < 0.5 * fit.covariance[worst, worst]
    given = [*fit.notices, *([notice] if lost else [])]
    best = fit.search.best
    unexplained = best is not None and not best.found.explained
    apart = (*(WEAK if by_itself else ()), *(OF_MODEL if unexplained else ()))
    return judge(given, fit.confirmed, unused, apart)


def result_notices(fit: KDFit) -> list[Notice]:
    """Return every warning that a result deserves."""
    checks = (_model, _physics, _noise, _inputs, _plane, _weak, _plausibility)
    return [notice for check in checks for notice in check(fit)]


def _relative_sds(fit: KDFit) -> dict[str, float]:
    """Return the standard deviations of the diagonal entries over their values, by K(y) and the like."""
    places = entries.diagonals(len(fit.dof))
    names = [f"{letter}({name})" for letter in "KD" for name in fit.dof]
    return {
        name: float(sd / value) if value > 0.0 else np.inf
        for name, value, sd in zip(names, np.abs(fit.values[places]), fit.sd[places], strict=True)
    }


def _physics(fit: KDFit) -> Iterator[Notice]:
    if not fit.modes.stable:
        text = f"The model is unstable: an eigenvalue has the real part {fit.modes.max_real_1_s:+.3g} 1/s."
        yield Notice("unstable", f"{text} No passive ligament does this; use --estimator ml.")
    wrong = [name for name, good in zip("KD", fit.passive, strict=True) if not good]
    if wrong:
        text = "not positive semidefinite: the model can give off energy that it never took in."
        yield Notice("not_passive", f"{' and '.join(wrong)} {text}")
    if fit.active:
        text = "the data alone would lead elsewhere, and intervals near the constraint are approximate."
        yield Notice("estimator_biased", f"The estimate is held back by {', '.join(fit.active)}; {text}")
    if fit.bias is None:
        return
    found = entries.split(fit.found.theta[fit.found.at["entries"]], len(fit.dof))
    bias = 100.0 * fit.bias / entries.sizes(*found)
    worst = int(np.argmax(np.abs(bias)))
    if abs(bias[worst]) > 100.0 * _BIASED:
        text = (
            f"{fit.options.estimator} is biased by the noise of its regressor however many lines there are: "
            f"{fit.parameters[worst]} by about {bias[worst]:+.2g} % of sqrt(Xii Xjj). --estimator ml is not."
        )
        yield Notice("estimator_biased", text)


def _noise(fit: KDFit) -> Iterator[Notice]:
    """Report what the residuals say of noise and model."""
    found = fit.found
    weak = fit.weak is not None and fit.weak.shape[1]
    if not found.converged and not weak:
        yield Notice("not_converged", "The fit stopped before it settled; do not trust the result.")
    if found.data.floored:
        text = "The motion has no noise: it was taken as known to 8 digits, and K and D as that allows."
        yield Notice("noise_level", text)
    level = f"chi2 per degree of freedom is {found.level:.3g}"
    if not found.explained:
        text = (
            f"Residuals exceed noise and shared errors: {level}. Noise may be understated, or the model "
            "(damping law, neglected motion, mass matrix) is wrong; channel noise was widened by "
            f"{np.sqrt(max(found.level, 1.0)):.3g}, which does not cover a wrong model."
        )
        yield Notice("misfit", text)
    wider = found.data.widened
    if wider > 1.0:
        text = (
            "The noise of neighbouring lines is alike, as with a window wider than a line or after smoothing:"
        )
        yield Notice(
            "noise_alike", f"{text} its standard deviation was widened by a factor of {np.sqrt(wider):.2g}."
        )
    if found.quiet and found.weights is None and not found.data.floored and wider == 1.0:
        yield Notice("noise_level", f"Residuals are smaller than their stated noise: {level}.")
    far = outlying_hz(fit)
    if len(far):
        listed = list_some((f"{hz:.6g}" for hz in far), 5)
        text = f"{len(far)} of {found.data.count} lines are outliers with respect to the noise of the others"
        yield Notice("outliers", f"{text} (at {listed} Hz); they were given little weight.")
    if fit.bands is not None and fit.bands.p_value < SIGNIFICANT_P:
        text = (
            f"One K and one D do not hold over the whole band (p = {fit.bands.p_value:.1g}): "
            f"{fit.bands.words()}. A viscoelastic ligament does this, and so does a wrong mass matrix or "
            "damping law; try --damping compare, or fit parts with --band."
        )
        yield Notice("frequency_dependent", text)


def outlying_hz(fit: KDFit) -> Array:
    """Return the frequencies of lines that noise as that of most lines makes in 1 % of robust fits.

    Their distance over the level of most lines is judged by chi2.
    """
    found = fit.found
    if found.weights is None or found.data.floored:
        return np.empty(0)
    farthest = float(chdtri(2 * len(fit.dof), _FALSE_OUTLIERS / found.data.count))
    return found.data.freq_hz[found.distances > found.usual_level * farthest]


def _model(fit: KDFit) -> Iterator[Notice]:
    """Report unknowns that the data brought into the model, the best explanation, and laws that are alike."""
    asked = (*fit.options.freed, *fit.options.fixed)
    for unknown, value, sd in fit.unknowns:
        if unknown.adopt and unknown.name not in asked:
            text = (
                f"{unknown.title[0].upper()}{unknown.title[1:]} of {plus_minus(value, sd)} {unknown.unit} is "
                "part of the model, since the data call for it. K and D exclude it; damping by fluid cannot "
                "be separated and is included in D11. --unknowns none leaves it out."
            )
            yield Notice(f"{unknown.name}_found", text)
    best = fit.search.best
    if best is not None and best.name.removeprefix("law_") not in fit.laws_alike:
        yield Notice("cause_found", _cause(fit))
    if fit.laws_alike:
        text = (
            f"The damping law is undetermined: {fit.law.name} damping cannot be distinguished from "
            f"{' or '.join(fit.laws_alike)} damping. K and D are those under {fit.law.name}; their intervals "
            "include what the others would change."
        )
        yield Notice("law_ambiguous", text)


def _cause(fit: KDFit) -> str:
    """Return the best explanation, its effect on K and D, and the explanations that are as likely."""
    best = fit.search.best
    assert best is not None  # noqa: S101
    size = f" of {plus_minus(best.value, best.sd)} {best.unit}".rstrip() if best.sd > 0.0 else ""
    change = 100.0 * effect_of(fit, best)[:, 0] / entries.sizes(fit.stiffness, fit.damping)
    worst = int(np.argmax(np.abs(change)))
    alike = " or ".join(other.title for other in fit.search.look_alikes)
    sentences = [
        f"its odds against none are e^{best.log_odds:.0f}.",
        f"With it {fit.parameters[worst]} changes by {change[worst]:+.2g} % of sqrt(Xii Xjj).",
        f"It cannot be distinguished from {alike}." if alike else "",
        "K and D are without it, but their intervals include that change.",
        f"--unknowns {best.name} estimates and removes it." if best.name in UNKNOWNS else "",
        f"Use --damping {best.found.law.name}, or compare." if best.unknown is None else "",
        "" if best.found.explained else "It does not explain the whole misfit.",
    ]
    if any(notice.code == "motion_without_h5" for notice in fit.notices):
        sentences.append("The motion was read without the correlations of its noise: fit with its .h5 file.")
    return f"The best explanation is {best.title} ({best.name}){size}; {' '.join(filter(None, sentences))}"


def _inputs(fit: KDFit) -> Iterator[Notice]:
    if fit.found.data.dropped:
        yield Notice(
            "file_read", f"{fit.found.data.dropped} lines were left out: a value is missing, or zero, there."
        )
    if not fit.inertia.contributions:
        text = "The mass matrix came without an uncertainty; the intervals of K and D do not include it."
        yield Notice("mass_uncertainty_not_given", text)


def _plane(fit: KDFit) -> Iterator[Notice]:
    """Report measured motion outside --dof that is left out, and a stiffness in the plane that is assumed."""
    data = fit.found.data
    others = ", ".join(data.measured[place] for place in data.columns)
    if others and not data.loads_known and fit.options.inplane != IGNORE:
        text = (
            f"The measured motion {others} loads the structure too, but the mass matrix lacks these degrees "
            "of freedom: K and D err by what the load comes to. Give mass.json, which has all six, or say "
            "by --inplane ignore that the load is small."
        )
        yield Notice("inplane_neglected", text)
    if others and data.loads_known and fit.options.inplane == IGNORE and fit.options.estimator == "ml":
        place, change = most_moved_by_load(fit.found)
        if change:
            text = (
                f"The measured motion {others} is significant but left out; it moves {fit.parameters[place]} "
                f"by {100.0 * change:.2g} % of sqrt(Xii Xjj). Use --inplane load, or auto."
            )
            yield Notice("inplane_neglected", text)
    if fit.plane is not None and not fit.plane.determined:
        share = np.diag(fit.budget["inplane_stiffness"]) / np.maximum(np.diag(fit.covariance), 1e-300)
        text = (
            "The in-plane motion does not determine all of the stiffness in the plane of the ligament; for "
            f"the rest {usual_ratio()} times the piston stiffness was assumed. This stiffness is up to "
            f"{100.0 * share.max():.0f} % of a variance of K and D."
        )
        yield Notice("inplane_assumed", text)


def _weak(fit: KDFit) -> Iterator[Notice]:
    worst, parts = fit.combinations[0]
    if worst > _IMPRECISE:
        named = ", ".join(f"{weight:+.2f} {name}" for name, weight in parts.items())
        weak = [name for name, share in _relative_sds(fit).items() if share > _IMPRECISE]
        text = f" Known to no better than 30 percent: {', '.join(weak)}." if weak else ""
        text = (
            "The data determine some entries weakly, relative to sqrt(Xii Xjj): the worst combination of "
            f"them, {named}, has the standard deviation {100.0 * worst:.3g} %.{text}"
        )
        yield Notice("weak_identifiability", text)


def _plausibility(fit: KDFit) -> Iterator[Notice]:
    """Compare mass, piston stiffness and radii of gyration with those of human stapedes."""
    translations = [place for place, name in enumerate(fit.dof) if name in "xyz"]
    if not translations:
        return
    mass_kg = float(fit.mass[translations[0], translations[0]])
    if "stapes" in fit.options.structure.lower() and not _within(mass_kg, _MASS_RANGE_KG):
        text = (
            f"The mass matrix gives the {fit.options.structure} {MASS.text(mass_kg, '.3g')}; human ones "
            f"weigh {MASS.of(_HUMAN_KG[0]):g} to {MASS.text(_HUMAN_KG[1])}. K and D grow in proportion to "
            "it: check that M is in SI units (kg, kg m, kg m2), or name the body by --structure if it is no "
            "stapes."
        )
        yield Notice("implausible_mass", text)
    if "y" not in fit.dof:
        return
    piston = fit.dof.index("y")
    value = float(fit.stiffness[piston, piston])
    if not _within(value, PISTON_RANGE):
        text = (
            f"The piston stiffness {value:.4g} N/m lies outside the published {PISTON_RANGE[0]:g} to "
            f"{PISTON_RANGE[1]:g} N/m of human annular ligaments."
        )
        in_hertz = value / (2.0 * np.pi) ** 2
        if _within(in_hertz, PISTON_RANGE) and value > 3 * PISTON_RANGE[1]:
            text += f" It would be {in_hertz:.4g} N/m if freq_hz held rad/s: check that."
        yield Notice("implausible_stiffness", text)
    for name in (name for name in ("alpha", "gamma") if name in fit.dof):
        other = fit.dof.index(name)
        radius = 1e3 * float(np.sqrt(fit.mass[other, other] / fit.mass[piston, piston]))
        if not _within(radius, _GYRATION_RANGE_MM):
            text = f"The radius of gyration of {name}, {radius:.3g} mm, does not fit a human stapes"
            yield Notice("implausible_mass", f"{text}; check the units of M.")


def _within(value: float, ends: tuple[float, float]) -> bool:
    return ends[0] <= value <= ends[1]
