"""Decide by evidence whether a mass of fluid on the piston deflection is part of the model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from legacy.fitting.calibrated import calibrated
from legacy.fitting.causes.catalogue import title_of
from legacy.fitting.causes.diagnosis import Diagnosis, diagnose, with_corrected, with_refits
from legacy.fitting.causes.model_error import law_error
from legacy.fitting.causes.refits import Refit
from legacy.fitting.errors import FittingError
from legacy.fitting.law_fits import (
    LawFit,
    best_of_each,
    fits_of_laws,
    rescale_bic,
    start_of_law,
    with_ligament,
)
from legacy.fitting.ligament.joint_lines import JointLines
from legacy.fitting.ligament.ligament import NotWithin
from legacy.fitting.ligament.misfit import is_explained
from legacy.fitting.model.laws import LAWS
from legacy.fitting.model.parameter_vector import join
from legacy.fitting.options import COMPARE, KDOptions
from legacy.stapeskit.option_names import named
from legacy.stapeskit.page.quantities import MASS, MILLIGRAM
from legacy.stapeskit.warnings import Notice

FLUID, LAW = "fluid", "law_"
# Sizes below this many of their standard deviations are no mass.
_SIGNIFICANT = 2.0


@dataclass(frozen=True)
class FluidChoice:
    """What was decided about a mass of fluid, and why.

    Attributes
    ----------
    option, cochlea : str
        As given.
    mass_kg, mass_sd_kg : float or None
        Of the fluid where it is part of the model.
    reason : str
        One sentence.
    """

    option: str
    cochlea: str
    used: bool
    mass_kg: float | None
    mass_sd_kg: float | None
    reason: str
    notices: tuple[Notice, ...] = ()


def choose_fluid(
    best: LawFit,
    plain: Sequence[LawFit],
    measured: JointLines,
    options: KDOptions,
    compared: tuple[LawFit, ...],
) -> tuple[LawFit, Diagnosis, FluidChoice, tuple[LawFit, ...]]:
    """Diagnose a joint fit and take a mass of fluid into it where the data call for one.

    Parameters
    ----------
    best : LawFit
        With the plane of the ligament.
    plain : sequence of LawFit
        The same, and those under other laws, without it: from them they are extended.
    measured : JointLines
        Motion of both bodies without units.
    compared : tuple of LawFit
        Fits under all laws, where they were compared: their K and D differ by what the law is not known.

    Returns
    -------
    fit, diagnosis, choice, compared
        With the mass of fluid where it is part of the model.
    """
    first = best.ligament
    assert first is not None  # noqa: S101
    if FLUID in first.terms:
        asked = FLUID in options.causes
        reason = (
            "asked for"
            if asked
            else "without it K or D is held at the limit of what is positive semidefinite"
        )
        if options.damping == COMPARE and not asked:
            size = MILLIGRAM.of(first.terms[FLUID][0])
            best, compared = _join(compared, _with_fluid(best, plain, measured, options, size))
        diagnosis = _diagnose(best, plain, measured, options, compared)
        return best, diagnosis, _use_fluid(best, options, reason, asked), compared
    with_fluid: tuple[LawFit, ...] = ()
    if options.fluid == "auto" and not is_explained(first.joint):  # a refit may end beside the mass
        with_fluid = _with_fluid(best, plain, measured, options)
    known = [_refit_with_fluid(best, fit) for fit in with_fluid]
    diagnosis = _diagnose(best, plain, measured, options, compared, known)
    refit, reason, notices = decide_on_fluid(diagnosis, options)
    if reason or refit is None:
        return best, diagnosis, _leave_out_fluid(options, reason, notices), compared
    with_fluid = with_fluid or _with_fluid(best, plain, measured, options, refit.size)
    if not with_fluid:
        return best, diagnosis, _leave_out_fluid(options, "the fit with it did not settle"), compared
    chosen, compared = _join(compared, with_fluid)
    others = [title_of(name) for name in diagnosis.look_alikes if name != FLUID]
    also = f" The data hardly tell it from {' or '.join(others)}." if others else ""
    reason = f"chi2 falls by {refit.fall:.0f}, over {diagnosis.threshold:.1f}"
    again = _diagnose(chosen, plain, measured, options, compared)
    return chosen, again, _use_fluid(chosen, options, reason, False, also), compared


def decide_on_fluid(diagnosis: Diagnosis, options: KDOptions) -> tuple[Refit | None, str, tuple[Notice, ...]]:
    """Return the fit with fluid if it is to be part of the model, else why not, and warnings.

    A relaxation that the law of the fit does not follow looks like a mass: where another law, without fluid,
    explains the data nearly as well, only a closed cochlea makes a mass of fluid the likelier of the two.
    """
    cause = diagnosis.named
    candidates = () if cause is None else (cause.name, *diagnosis.look_alikes)
    if FLUID not in candidates or options.fluid == "none":
        reason = "left out as asked for" if options.fluid == "none" else "the data do not call for it"
        return None, reason, ()
    refit = next(tried for tried in diagnosis.refits if tried.name == FLUID)
    expected = options.cochlea == "closed"
    if refit.size < _SIGNIFICANT * refit.sd or not (candidates[0] == FLUID or expected):
        return None, f"{title_of(candidates[0])} explains the data better", ()
    laws = [title_of(name) for name in candidates if name.startswith(LAW)]
    if laws and not expected:
        return None, f"{' or '.join(laws)} explains the data nearly as well", ()
    if options.cochlea in ("open", "drained"):
        found = MASS.with_sd(MILLIGRAM.si(refit.size), MILLIGRAM.si(refit.sd))
        text = (
            f"A mass of fluid of {found} on the piston deflection "
            f"would lower chi2 by {refit.fall:.0f}, but the cochlea is {options.cochlea}; it was left out. "
            f"Check that the window is dry, or use {named('fluid')} y."
        )
        return None, f"the cochlea is {options.cochlea}", (Notice("fluid_contradicts", text),)
    return refit, "", ()


def _with_fluid(
    best: LawFit,
    plain: Sequence[LawFit],
    measured: JointLines,
    options: KDOptions,
    size: float | None = None,
) -> tuple[LawFit, ...]:
    """Return the fits with a mass of fluid, under the law of the best one and those that come near it.

    Without a size they are fits under any law that explain the data.
    """
    from scipy.special import chdtri

    names, sizes = (*options.causes, FLUID), {} if size is None else {FLUID: size}
    limit = None if size is not None else float(chdtri(best.n_dof, calibrated("causes.misfit_p")))
    fits: list[LawFit] = []
    laws = (best.law.name, *(fit.law.name for fit in best_of_each(plain) if fit.law.name != best.law.name))
    for start in _starts(plain[0], laws, options, True):
        try:
            fit = with_ligament(start, measured, names, sizes=sizes, within=limit)
        except NotWithin:
            continue
        if fit.ligament is not None and (fit.law.physical or size is not None):
            fits.append(fit)
            near = calibrated("causes.look_alike_chi2") + float(np.log(2 * fit.problem.n * measured.count))
            limit = min(other.chi2 for other in fits) + near
    return best_of_each(rescale_bic(fits)) if fits else ()


def _join(compared: tuple[LawFit, ...], with_fluid: tuple[LawFit, ...]) -> tuple[LawFit, tuple[LawFit, ...]]:
    """Return the best fit with fluid, and the fits under all laws, with fluid where there is such a fit."""
    best = min(with_fluid, key=lambda fit: (not fit.law.physical, fit.bic))
    by_name = {fit.law.name: fit for fit in with_fluid}
    compared = rescale_bic(by_name.get(fit.law.name, fit) for fit in compared)
    return next((fit for fit in compared if fit.law == best.law), best), compared


def _starts(plain: LawFit, names: Sequence[str], options: KDOptions, fluid: bool) -> tuple[LawFit, ...]:
    """Return where joint fits under some laws start."""
    start = partial(start_of_law, fluid=fluid)
    return fits_of_laws(plain.problem, names, options.lower, options.upper, start)[0]


def _diagnose(
    best: LawFit,
    plain: Sequence[LawFit],
    measured: JointLines,
    options: KDOptions,
    compared: tuple[LawFit, ...],
    known: Sequence[Refit] = (),
) -> Diagnosis:
    """Search for causes; other damping laws are among them, or those that were compared.

    ``known`` are fits with a mass of fluid under any law: the best of them is the refit of that cause.
    """
    assert best.ligament is not None  # noqa: S101
    laws = None
    if options.damping != COMPARE:
        laws = partial(_other_laws, best, plain[0], measured, options)
    diagnosis = with_corrected(diagnose(best.problem, best.ligament, laws, known), best.ligament)
    if options.damping == COMPARE:
        diagnosis = with_refits(diagnosis, _compare(best, compared))
    return diagnosis


def _other_laws(
    best: LawFit, plain: LawFit, measured: JointLines, options: KDOptions, within: float
) -> list[Refit]:
    """Refit under the damping laws that were not asked for; their exponents count as an unknown.

    Laws whose chi2 does not come below ``within`` are left out.
    """
    assert best.ligament is not None  # noqa: S101
    terms = tuple(best.ligament.terms)
    fits: list[LawFit] = []
    for name in LAWS:
        if name == best.law.name:
            continue
        try:
            starts = _starts(plain, (name,), options, FLUID in terms)
        except (FittingError, np.linalg.LinAlgError):
            continue
        for start in starts:
            try:
                fits.append(with_ligament(start, measured, terms, within=within))
            except (NotWithin, np.linalg.LinAlgError):
                continue
    settled = [fit for fit in fits if fit.ligament is not None and fit.law.physical]
    return [_refit_of(best, other, 1.0) for other in best_of_each(settled)]


def _compare(best: LawFit, laws: Iterable[LawFit]) -> list[Refit]:
    """Return the fits under the other laws of a comparison; the law of the best one was not named before."""
    others = (law for law in laws if law.law.name != best.law.name)
    return [
        _refit_of(best, other, 0.0) for other in others if other.ligament is not None and other.law.physical
    ]


def _refit_of(best: LawFit, other: LawFit, unknowns: float) -> Refit:
    """Return a fit under another law as a refit whose law counts as ``unknowns`` beside its exponent."""
    assert best.ligament is not None  # noqa: S101
    assert other.ligament is not None  # noqa: S101
    level = max(1.0, other.ligament.chi2 / other.ligament.n_dof)
    omega = best.ligament.lines.omega * best.problem.scale.omega
    change = join(
        other.ligament.plane_stiffness - best.ligament.plane_stiffness,
        np.full_like(best.ligament.plane_damping, np.nan),
    )
    return Refit(
        f"{LAW}{other.law.name}",
        other.law.exponent,
        other.exponent_sd or 0.0,
        (best.ligament.chi2 - other.ligament.chi2) / level,
        change,
        other.ligament.p_value,
        unknowns + len(other.law.unknowns) - len(best.law.unknowns),
        off=law_error(best.ligament, other.ligament, omega),
        chi2=other.ligament.chi2,
        known=other.law.known - best.law.known,
    )


def _refit_with_fluid(best: LawFit, other: LawFit) -> Refit:
    """Return a fit with a mass of fluid, under any law, as a refit of that cause."""
    assert other.ligament is not None  # noqa: S101
    size, sd = (MILLIGRAM.of(value) for value in other.ligament.terms[FLUID])
    refit = _refit_of(best, other, 1.0)
    return replace(refit, name=FLUID, size=size, sd=sd)


def _use_fluid(fit: LawFit, options: KDOptions, reason: str, asked: bool, also: str = "") -> FluidChoice:
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


def _leave_out_fluid(options: KDOptions, reason: str, notices: tuple[Notice, ...] = ()) -> FluidChoice:
    if options.cochlea == "closed" and options.fluid == "auto":
        notices += (_missing(),)
    return FluidChoice(options.fluid, options.cochlea, False, None, None, reason, notices)


def _missing() -> Notice:
    text = "The cochlea is closed, but the data show no mass of fluid that moves with the stapes."
    return Notice("fluid_contradicts", text)
