"""Which cause the data speak for: scores make a shortlist, full refits name one, look-alikes are named with
it.

A cause is searched for where one of the scores is improbable (Bonferroni over all of them) or the fit is a
misfit. The refit with the largest fall of chi2 is named when the fall exceeds ln(equations), the criterion
of Schwarz (1978), doi:10.1214/aos/1176344136; causes whose refits are nearly as good are its look-alikes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fitting.calibrated import calibrated
from fitting.causes.catalogue import CAUSES, Setting, term_of
from fitting.causes.scores import Scores, scores
from fitting.estimators.problem import Problem
from fitting.ligament.equations import Term
from fitting.ligament.ligament import extended_fit
from fitting.ligament.ligament_fit import LigamentFit
from fitting.model.symmetric import pairs

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Refit:
    """A full fit with one cause in it.

    Attributes
    ----------
    name : str
    size : float
        In the unit of the cause.
    sd : float
        From the scores' information; the same unit.
    fall : float
        Of chi2.
    effect : ndarray, (p,)
        K and D about the plane of the ligament with the cause, less those without, SI; NaN where D has
        another unit.
    p_value : float
        Probability of the chi2 that is left, or a larger one.
    """

    name: str
    size: float
    sd: float
    fall: float
    effect: Array
    p_value: float


@dataclass(frozen=True)
class Diagnosis:
    """What the scores say of every cause, what refits say of a few, and what no data can show.

    Attributes
    ----------
    tested : tuple of str
    scores : Scores
        Of ``tested``.
    refits : tuple of Refit
        Best first; empty where nothing calls for a search.
    threshold : float
        Fall of chi2 that names a cause.
    sensitivities : mapping of str to ndarray, (p,)
        What K and D, SI, change by when a cause of its example size is there and left out.
    searched : bool
        Whether a score or the misfit called for a search.
    corrected : mapping of str to (float, float)
        Causes in the model: size and sd, in their unit.
    """

    tested: tuple[str, ...]
    scores: Scores
    refits: tuple[Refit, ...]
    threshold: float
    sensitivities: dict[str, Array]
    searched: bool = False
    corrected: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def named(self) -> Refit | None:
        """The cause that the data speak for, or None."""
        return self.refits[0] if self.refits and self.refits[0].fall > self.threshold else None

    @property
    def look_alikes(self) -> tuple[str, ...]:
        """Causes that explain nearly as much as the one that is named."""
        named = self.named
        if named is None:
            return ()
        close = named.fall - calibrated("causes.look_alike_chi2")
        return tuple(one.name for one in self.refits[1:] if one.fall > max(close, self.threshold))


def setting_of(problem: Problem, ligament: LigamentFit) -> Setting:
    """Return the setting of a fit for the causes."""
    return Setting(ligament.lines, ligament.lines.omega * problem.scale.omega, problem.inertia.matrix)


def diagnose(problem: Problem, ligament: LigamentFit) -> Diagnosis:
    """Score every cause at a fit, and refit with the likeliest where a score or the misfit is improbable."""
    setting = setting_of(problem, ligament)
    present = {term.name for term in ligament.equations.terms}
    names = tuple(name for name in CAUSES if name not in present)
    terms = tuple(term_of(name, setting) for name in names)
    tested = scores(ligament.lines, ligament.equations, ligament.joint, terms)
    scored = [place for place, name in enumerate(names) if CAUSES[name].scored]
    p_values = tested.p_values[scored]
    alarm = p_values.min() * len(scored) < calibrated("causes.false_alarm")
    units = problem.with_law(ligament.law).units
    entries = len(units)
    sensitivities = {
        name: CAUSES[name].example * tested.response[:entries, place] * units
        for place, name in enumerate(names)
    }
    order = [scored[place] for place in np.argsort(p_values, kind="stable")]
    order = [place for place in order if CAUSES[names[place]].refitted]
    refits = []
    searched = bool(alarm or ligament.p_value < calibrated("causes.misfit_p"))
    if searched:
        for place in order[: int(calibrated("causes.shortlist"))]:
            one = _refit(ligament, names[place], terms[place], tested, place, units)
            if one is not None:
                refits.append(one)
    refits.sort(key=lambda one: -one.fall)
    equations = 2 * ligament.equations.n * ligament.lines.count
    kept = Scores(
        tested.z[scored],
        tested.estimate[scored],
        tested.sd[scored],
        tested.correlation[np.ix_(scored, scored)],
        tested.response[:, scored],
    )
    return Diagnosis(
        tuple(names[place] for place in scored),
        kept,
        tuple(refits),
        float(np.log(equations)),
        sensitivities,
        searched,
    )


def _refit(
    ligament: LigamentFit, name: str, term: Term, start_scores: Scores, place: int, units: Array
) -> Refit | None:
    """Fit with one cause from the estimate of its score and from its other starts; the best one, or None."""
    from scipy.special import chdtrc

    best = None
    for begin in (float(start_scores.estimate[place]), *CAUSES[name].starts):
        shifted = ligament.joint.parameters - begin * start_scores.response[:, place]
        start = replace(ligament.joint, parameters=shifted)
        fitted = extended_fit(ligament.lines, ligament.equations, start, (term,), np.array([begin]))
        if fitted is not None and (best is None or fitted[1].chi2 < best[1].chi2 - 1e-6):
            best = fitted
    if best is None:
        return None
    equations, fit = best
    level = max(1.0, fit.level)
    change = (fit.parameters[: len(units)] - ligament.joint.parameters[: len(units)]) * units
    fall = (ligament.joint.chi2 - fit.chi2) / level
    size = float(fit.parameters[equations.term][-1])
    if CAUSES[name].positive and size < 0.0:
        return None
    left = float(chdtrc(fit.n_dof, fit.chi2))
    return Refit(name, size, float(start_scores.sd[place]), fall, change, left)


def relative_effect(change: Array, stiffness: Array, damping: Array) -> Array:
    """Return changes of the entries over sqrt(Xii Xjj), (p,)."""
    n = len(stiffness)
    sizes = []
    for part in (stiffness, damping):
        root = np.sqrt(np.maximum(np.abs(np.diag(part)), 1e-300))
        sizes += [root[row] * root[column] for row, column in pairs(n)]
    return np.asarray(change / np.array(sizes))


def largest_effect(change: Array, stiffness: Array, damping: Array) -> tuple[int, float]:
    """Return the entry that changes most, relative to sqrt(Xii Xjj), and by how much."""
    relative = relative_effect(change, stiffness, damping)
    place = int(np.nanargmax(np.abs(relative)))
    return place, float(relative[place])


def with_refits(diagnosis: Diagnosis, more: Sequence[Refit]) -> Diagnosis:
    """Return a diagnosis with further refits, e.g. under other damping laws."""
    return replace(diagnosis, refits=tuple(sorted((*diagnosis.refits, *more), key=lambda one: -one.fall)))


def with_corrected(diagnosis: Diagnosis, ligament: LigamentFit) -> Diagnosis:
    """Return a diagnosis that lists the causes which are part of the model."""
    sizes = {
        name: (value / CAUSES[name].per_unit, sd / CAUSES[name].per_unit)
        for name, (value, sd) in ligament.terms.items()
    }
    return replace(diagnosis, corrected=sizes)
