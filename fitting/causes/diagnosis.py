"""Which cause the data speak for: scores make a shortlist, full refits name one, look-alikes are named with
it.

A cause is searched for where one of the scores is improbable (Bonferroni over all of them) or the fit is a
misfit. The refit with the largest fall of chi2 is named when the fall exceeds ln(equations) an unknown, the
criterion of Schwarz (1978), doi:10.1214/aos/1176344136, and what a size beyond the usual one costs; causes
whose refits are nearly as good are its look-alikes. A cause that can have one size only is no unknown: chi2
must fall by twice the logarithm of how rare it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fitting.calibrated import calibrated
from fitting.causes.catalogue import CAUSES, Setting, term_of
from fitting.causes.model_error import off_by_cause, off_unexplained
from fitting.causes.scores import Scores, scores
from fitting.estimators.problem import Problem
from fitting.ligament.equations import Term
from fitting.ligament.inplane_stiffness import inverse_of
from fitting.ligament.joint_fit import JointFit
from fitting.ligament.ligament import FEW_ROUNDS, MOST_ROUNDS, extended_fit
from fitting.ligament.ligament_fit import LigamentFit
from fitting.model.symmetric import pairs
from stapeskit.arrays import Array

# Probability of a score below which a cause that may be far from first order is refitted to be sure: one
# needless refit in twenty, which the evidence then judges. Chosen by judgement.
_DOUBTFUL = 0.05
# Standard deviations between a threshold and the mean of what passes it in 80 %: a quantile of the normal.
_POWER_80 = 0.8416
# Steps of a refit, and of one beside a cause that explains the data.
_MOST, _FEW = 60, 20


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
    unknowns : float
        By how many the unknowns of the model grow; nuisance parameters count by what the data say of them.
    strange : float
        Squared size over the usual one: what a normal distribution of sizes adds to chi2.
    off : ndarray, (24, k)
        Columns E: E E^T is the mean square by which K and D are off, about the footplate centre and, in the
        second half, about the plane of the ligament, where this cause is there; SI.
    """

    name: str
    size: float
    sd: float
    fall: float
    effect: Array
    p_value: float
    unknowns: float = 1.0
    strange: float = 0.0
    off: Array = field(default_factory=lambda: np.zeros((24, 0)), repr=False)


@dataclass(frozen=True)
class Diagnosis:
    """Scores of every cause, refits of a few, and the causes that no data can show.

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
    search_z : float
        Score, over its standard deviation, from which a cause is searched for.
    """

    tested: tuple[str, ...]
    scores: Scores
    refits: tuple[Refit, ...]
    threshold: float
    sensitivities: dict[str, Array]
    searched: bool = False
    corrected: dict[str, tuple[float, float]] = field(default_factory=dict)
    search_z: float = np.inf

    @property
    def seen_from(self) -> dict[str, float]:
        """Size of each scored cause that is found in four of five measurements like this one, in its unit.

        Notes
        -----
        The minimal detectable bias of Baarda (1968), A testing procedure for use in geodetic networks.
        """
        seen = (self.search_z + _POWER_80) * self.scores.sd
        return {
            name: float(size) for name, size in zip(self.tested, seen, strict=True) if CAUSES[name].scored
        }

    def evidence(self, refit: Refit) -> float:
        """Return the decrease of chi2, minus the penalties for the unknowns and for the size of the cause."""
        return refit.fall - self.threshold * refit.unknowns - refit.strange

    @property
    def named(self) -> Refit | None:
        """The cause that the data speak for, or None."""
        return self.refits[0] if self.refits and self.evidence(self.refits[0]) > 0.0 else None

    @property
    def off(self) -> Array:
        """Columns E (24, k): E E^T is the mean square by which a wrong model puts K and D off.

        Notes
        -----
        The fit stays without the causes. Their effect is averaged over the fit as it is and the refits with
        weights exp(evidence / 2) (Hoeting et al. 1999, Bayesian model averaging, doi:10.1214/ss/1009212519).
        """
        evidence = np.array([0.0, *(self.evidence(refit) for refit in self.refits)])
        shares = np.exp(0.5 * (evidence - evidence.max()))
        roots = np.sqrt(shares / shares.sum())[1:]
        columns = [root * refit.off for root, refit in zip(roots, self.refits, strict=True)]
        return np.concatenate([np.zeros((24, 0)), *columns], axis=1)

    @property
    def look_alikes(self) -> tuple[str, ...]:
        """Causes that explain nearly as much as the one that is named."""
        named = self.named
        if named is None:
            return ()
        close = max(self.evidence(named) - calibrated("causes.look_alike_chi2"), 0.0)
        return tuple(other.name for other in self.refits[1:] if self.evidence(other) > close)


def setting_of(problem: Problem, ligament: LigamentFit) -> Setting:
    """Return the setting of a fit for the causes."""
    return Setting(ligament.lines, ligament.lines.omega * problem.scale.omega, problem.inertia.matrix)


def diagnose(
    problem: Problem, ligament: LigamentFit, laws: Callable[[], Sequence[Refit]] | None = None
) -> Diagnosis:
    """Score every cause at a fit, and refit with the likeliest where a score or the misfit is improbable.

    Causes that may be far from first order are also refitted where their score is doubtful; a large fall of
    chi2 calls for the search, too.

    Parameters
    ----------
    problem : Problem
    ligament : LigamentFit
    laws : callable, optional
        Refits under other damping laws, for a search. They come first: where one explains the data, most
        causes are looked at briefly.
    """
    from scipy.special import chdtri

    setting = setting_of(problem, ligament)
    present = {term.name for term in ligament.equations.terms}
    names = tuple(name for name in CAUSES if name not in present)
    terms = tuple(term_of(name, setting) for name in names)
    tested = scores(ligament.lines, ligament.equations, ligament.joint, terms)
    scored = [place for place, name in enumerate(names) if CAUSES[name].scored]
    p_values = tested.p_values[scored]
    least = float(chdtri(1, calibrated("causes.false_alarm") / len(scored)))
    alarm = p_values.min() * len(scored) < calibrated("causes.false_alarm")
    units = problem.with_law(ligament.law).units
    entries = len(units)
    sensitivities = {
        name: CAUSES[name].example * tested.response[:entries, place] * units
        for place, name in enumerate(names)
    }
    ranked = [scored[place] for place in np.argsort(p_values, kind="stable")]
    leading = _first_of_families(ranked, names)
    likely = [place for place in leading if CAUSES[names[place]].refitted]
    whole = any(_fall_of_whole(name, tested, place) > _rarity() for place, name in enumerate(names))
    searched = bool(alarm or whole or ligament.p_value < calibrated("causes.misfit_p"))
    if not searched and ligament.estimate.active:  # a refit would be credited with leaving the limit
        likely = []
    elif not searched:
        likely = [place for place in likely if _large(names[place]) and tested.p_values[place] < _DOUBTFUL]
    under_laws = list(laws()) if searched and laws is not None else []
    refits: list[Refit] = []
    for number, place in enumerate(likely[: int(calibrated("causes.shortlist"))]):
        known = [*refits, *under_laws] if number else []
        explained = any(candidate.p_value > calibrated("causes.misfit_p") for candidate in known)
        refit = _refit(ligament, names[place], terms[place], tested, place, units, explained)
        refits += [] if refit is None else [refit]
    if not searched:
        searched = any(candidate.fall > least for candidate in refits)
        refits = refits if searched else []
        under_laws = list(laws()) if searched and laws is not None else []
    equations = 2 * ligament.equations.n * ligament.lines.count
    shown = sorted(leading)
    kept = Scores(
        tested.z[shown],
        tested.estimate[shown],
        tested.sd[shown],
        tested.correlation[np.ix_(shown, shown)],
        tested.response[:, shown],
    )
    diagnosis = Diagnosis(
        tuple(names[place] for place in shown),
        kept,
        (),
        float(np.log(equations)),
        sensitivities,
        searched,
        search_z=float(np.sqrt(least)),
    )
    return with_refits(diagnosis, [*refits, *under_laws])


def _first_of_families(ranked: list[int], names: tuple[str, ...]) -> list[int]:
    """Return the causes in their order, the first of each family only."""
    first: dict[str, int] = {}
    for place in ranked:
        first.setdefault(CAUSES[names[place]].family or names[place], place)
    return list(first.values())


def _rarity() -> float:
    """Return what an error that is there wholly or not at all must lower chi2 by to be likely."""
    return -2.0 * float(np.log(calibrated("causes.whole_error")))


def _fall_of_whole(name: str, tested: Scores, place: int) -> float:
    """Return to first order by how much chi2 falls with a cause of its only size."""
    only = CAUSES[name].only
    if only is None:
        return -np.inf
    return float((tested.estimate[place] ** 2 - (tested.estimate[place] - only) ** 2) / tested.sd[place] ** 2)


def _large(name: str) -> bool:
    """Return whether a cause may be too large for its score, a linear test."""
    return len(CAUSES[name].starts) > 1


def _refit(
    ligament: LigamentFit,
    name: str,
    term: Term,
    start_scores: Scores,
    place: int,
    units: Array,
    explained: bool,
) -> Refit | None:
    """Fit with one cause from the estimate of its score and from its other starts; the best one, or None.

    Where another cause explains the data already, only what settles as well at once can look like it.
    """
    from scipy.special import chdtrc

    best = None
    starts = (float(start_scores.estimate[place]), *CAUSES[name].starts)
    for begin in starts[: 1 if explained else None]:
        if begin == 0.0 and best is not None and best[2].chi2 < ligament.joint.chi2:
            continue
        shifted = ligament.joint.parameters - begin * start_scores.response[:, place]
        start = replace(ligament.joint, parameters=shifted)
        fitted = extended_fit(
            ligament.lines,
            ligament.equations,
            start,
            (term,),
            np.array([begin]),
            _FEW if explained else _MOST,
            FEW_ROUNDS if explained or best is not None or begin in CAUSES[name].starts[1:] else MOST_ROUNDS,
        )
        if fitted is not None and (best is None or fitted[2].chi2 < best[2].chi2 - 1e-6):
            best = fitted
        if best is not None and chdtrc(best[2].n_dof, best[2].chi2) > calibrated("causes.misfit_p"):
            break
    if best is None:
        return None
    lines, equations, fit = best
    level = max(1.0, fit.level)
    before = ligament.equations.unknowns
    change = fit.parameters[:before] - ligament.joint.parameters[:before]
    effect = change[: len(units)] * units
    fall = (ligament.joint.chi2 - fit.chi2) / level
    size = float(fit.parameters[equations.term][-1])
    if CAUSES[name].positive and size < 0.0:
        return None
    left = float(chdtrc(fit.n_dof, fit.chi2))
    more = lines.errors - ligament.lines.errors
    unknowns = 1.0 + _informed(fit, more) / np.log(2 * equations.n * lines.count)
    strange, only = (size / CAUSES[name].usual) ** 2, CAUSES[name].only
    if only is not None:
        variance = level * inverse_of(fit.at.hessian)[equations.term, equations.term][-1, -1]
        unknowns, strange = unknowns - 1.0, (size - only) ** 2 / variance + _rarity()
    sd = float(start_scores.sd[place])
    factor = equations.applied(lines, fit.parameters)[1].factor
    off = off_by_cause(ligament, change, sd / max(abs(size), 1e-300), factor)
    return Refit(name, size, sd, fall, effect, left, unknowns, strange, off)


def _informed(fit: JointFit, count: int) -> float:
    """Return what the prior of the last unknowns costs in chi2: the ratio of its volume to the posterior's.

    Notes
    -----
    Laplace's approximation of the evidence (MacKay 1992, doi:10.1162/neco.1992.4.3.415).
    """
    if not count:
        return 0.0
    left = inverse_of(fit.at.hessian)[-count:, -count:]
    return max(0.0, -float(np.linalg.slogdet(left)[1]))


def model_error(diagnosis: Diagnosis, ligament: LigamentFit) -> Array:
    """Return columns E (24, k): E E^T is the mean square by which a wrong model puts K and D off.

    See `Diagnosis.off`; where no cause explains the misfit, what it may move K and D by is added.
    """
    named = diagnosis.named
    left = ligament.p_value if named is None else named.p_value
    if left > calibrated("causes.misfit_p"):
        return diagnosis.off
    return np.concatenate([diagnosis.off, off_unexplained(ligament)], axis=1)


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
    refits = sorted((*diagnosis.refits, *more), key=lambda refit: -diagnosis.evidence(refit))
    return replace(diagnosis, refits=tuple(refits))


def with_corrected(diagnosis: Diagnosis, ligament: LigamentFit) -> Diagnosis:
    """Return a diagnosis that lists the causes which are part of the model."""
    sizes = {
        name: (value / CAUSES[name].per_unit, sd / CAUSES[name].per_unit)
        for name, (value, sd) in ligament.terms.items()
    }
    return replace(diagnosis, corrected=sizes)
