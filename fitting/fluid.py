"""Whether a mass of fluid on the piston deflection is part of the model: never silently, and only by
evidence."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from fitting.causes.catalogue import title_of
from fitting.causes.diagnosis import Diagnosis, Refit, diagnose, with_corrected, with_refits
from fitting.causes.model_error import off_by_law
from fitting.errors import FittingError
from fitting.laws import LawFit, start_of_law, with_ligament
from fitting.model.laws import LAWS
from fitting.model.observation import Observation
from fitting.model.symmetric import join
from fitting.options import COMPARE, KDOptions
from stapeskit.page.numbers import plus_minus
from stapeskit.page.quantities import MASS
from stapeskit.vocabulary import named
from stapeskit.warnings import Notice

FLUID = "fluid"
# Sizes below this many of their standard deviations are no mass.
_SIGNIFICANT = 2.0


@dataclass(frozen=True)
class FluidChoice:
    """What was decided about a mass of fluid, and why.

    Attributes
    ----------
    option, cochlea : str
        As given.
    used : bool
    mass_kg, mass_sd_kg : float or None
        Of the fluid where it is part of the model.
    reason : str
        One sentence.
    notices : tuple of Notice
    """

    option: str
    cochlea: str
    used: bool
    mass_kg: float | None
    mass_sd_kg: float | None
    reason: str
    notices: tuple[Notice, ...] = ()


def choose_fluid(
    best: LawFit, plain: LawFit, both: Observation, options: KDOptions, compared: Iterable[LawFit] = ()
) -> tuple[LawFit, Diagnosis, FluidChoice]:
    """Diagnose a joint fit and take a mass of fluid into it where the data call for one.

    Parameters
    ----------
    best : LawFit
        With the plane of the ligament.
    plain : LawFit
        The same without it, from which it was extended.
    both : Observation
    options : KDOptions
    compared : iterable of LawFit
        Fits under all laws, where they were compared: their K and D differ by what the law is not known.

    Returns
    -------
    fit, diagnosis, choice
    """
    assert best.ligament is not None  # noqa: S101
    laws = None if options.damping == COMPARE else lambda: _other_laws(best, plain, both, options)
    diagnosis = with_corrected(diagnose(best.problem, best.ligament, laws), best.ligament)
    if options.damping == COMPARE:
        diagnosis = with_refits(diagnosis, _compared(best, compared, both))
    if FLUID in best.ligament.terms:
        asked = FLUID in options.causes
        reason = (
            "asked for"
            if asked
            else "without it K or D is held at the limit of what is positive semidefinite"
        )
        return best, diagnosis, _used(best, options, reason, asked)
    cause = diagnosis.named
    candidates = () if cause is None else (cause.name, *diagnosis.look_alikes)
    if FLUID not in candidates or options.fluid == "none":
        reason = "left out as asked for" if options.fluid == "none" else "the data do not call for it"
        return best, diagnosis, _unused(options, reason)
    refit = next(tried for tried in diagnosis.refits if tried.name == FLUID)
    expected = options.cochlea == "closed"
    if refit.size < _SIGNIFICANT * refit.sd or not (candidates[0] == FLUID or expected):
        return best, diagnosis, _unused(options, f"{title_of(candidates[0])} explains the data better")
    if options.cochlea in ("open", "drained"):
        text = (
            f"A mass of fluid of {plus_minus(refit.size, refit.sd)} {MASS.symbol} on the piston deflection "
            f"would lower chi2 by {refit.fall:.0f}, but the cochlea is {options.cochlea}; it was left out. "
            f"Check that the window is dry, or use {named('fluid')} y."
        )
        choice = _unused(options, f"the cochlea is {options.cochlea}", (Notice("fluid_contradicts", text),))
        return best, diagnosis, choice
    law_fit = with_ligament(plain, both, (*options.causes, FLUID), sizes={FLUID: refit.size})
    if law_fit.ligament is None:
        return best, diagnosis, _unused(options, "the fit with it did not settle")
    again = with_corrected(diagnose(law_fit.problem, law_fit.ligament), law_fit.ligament)
    others = [title_of(name) for name in candidates if name != FLUID]
    also = f" The data hardly tell it from {' or '.join(others)}." if others else ""
    reason = f"chi2 falls by {refit.fall:.0f}, over {diagnosis.threshold:.1f}"
    return law_fit, again, _used(law_fit, options, reason, False, also)


def _other_laws(best: LawFit, plain: LawFit, both: Observation, options: KDOptions) -> list[Refit]:
    """Refit under the damping laws that were not asked for; their exponents count as an unknown.

    A misfit under another law is left as it is: the law that the data speak for has none.
    """
    assert best.ligament is not None  # noqa: S101
    names = tuple(best.ligament.terms)
    refits = []
    for name in LAWS:
        if name == best.law.name:
            continue
        try:
            law_fit = start_of_law(plain.problem, name, options.lower, options.upper)
            other = with_ligament(law_fit, both, names, briefly=True)
        except (FittingError, np.linalg.LinAlgError):
            continue
        if other.ligament is None or not other.law.physical:
            continue
        refits.append(_refit_of(best, other, both, 1.0))
    return refits


def _compared(best: LawFit, laws: Iterable[LawFit], both: Observation) -> list[Refit]:
    """Return the fits under the other laws of a comparison; the law of the best one was not named before."""
    others = (law for law in laws if law.law.name != best.law.name)
    return [
        _refit_of(best, other, both, 0.0)
        for other in others
        if other.ligament is not None and other.law.physical
    ]


def _counted(fit: LawFit) -> int:
    return fit.law.unknowns + fit.law.law.fixed


def _refit_of(best: LawFit, other: LawFit, both: Observation, unknowns: float) -> Refit:
    """Return a fit under another law as a refit whose law counts as ``unknowns`` beside its exponent."""
    assert best.ligament is not None  # noqa: S101
    assert other.ligament is not None  # noqa: S101
    level = max(1.0, other.ligament.chi2 / other.ligament.n_dof)
    change = join(
        other.ligament.plane_stiffness - best.ligament.plane_stiffness,
        np.full_like(best.ligament.plane_damping, np.nan),
    )
    return Refit(
        f"law_{other.law.name}",
        other.law.exponent,
        other.exponent_sd or 0.0,
        (best.ligament.chi2 - other.ligament.chi2) / level,
        change,
        other.ligament.p_value,
        unknowns + _counted(other) - _counted(best),
        off=off_by_law(best.ligament, other.ligament, 2.0 * np.pi * both.freq_hz),
    )


def _used(fit: LawFit, options: KDOptions, reason: str, asked: bool, also: str = "") -> FluidChoice:
    assert fit.ligament is not None  # noqa: S101
    value, sd = fit.ligament.terms[FLUID]
    notices: tuple[Notice, ...] = ()
    if not asked:
        text = (
            f"A mass of fluid of {MASS.with_sd(value, sd)} moves with the piston deflection and "
            f"is part of the model ({reason}).{also} K and D are those without it; its resistance is part of "
            f"D11. {named('fluid')} none leaves it out."
        )
        notices = (Notice("fluid_found", text),)
    if options.cochlea == "closed" and value < _SIGNIFICANT * sd:
        notices += (_missing(),)
    if options.cochlea in ("open", "drained") and not asked:
        text = f"The cochlea is {options.cochlea}, but only a mass of fluid explains the data."
        notices += (Notice("fluid_contradicts", text),)
    return FluidChoice(options.fluid, options.cochlea, True, value, sd, reason, notices)


def _unused(options: KDOptions, reason: str, notices: tuple[Notice, ...] = ()) -> FluidChoice:
    if options.cochlea == "closed" and options.fluid == "auto":
        notices += (_missing(),)
    return FluidChoice(options.fluid, options.cochlea, False, None, None, reason, notices)


def _missing() -> Notice:
    text = "The cochlea is closed, but the data show no mass of fluid that moves with the stapes."
    return Notice("fluid_contradicts", text)
