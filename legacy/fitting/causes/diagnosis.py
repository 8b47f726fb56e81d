"""Find the cause of a misfit: scores make a shortlist, full refits choose one and list those alike.

A cause is searched for where one of the scores is improbable (Bonferroni over all of them) or the fit is a
misfit. The refit with the largest fall of chi2 is named when the fall exceeds ln(equations) an unknown, the
criterion of Schwarz (1978), doi:10.1214/aos/1176344136, what noise alone makes where the cause changes the
equations much (fitting.causes.chi2_differences), and what a size beyond the usual one costs; causes
whose refits are nearly as good are its look-alikes. A cause that can have one size only is no unknown: chi2
must fall by twice the logarithm of how rare it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from legacy.fitting.calibrated import calibrated
from legacy.fitting.causes.catalogue import CAUSES, places_of, term_of
from legacy.fitting.causes.detectable import detectable_size
from legacy.fitting.causes.model_error import unexplained_error
from legacy.fitting.causes.refits import Refit, rarity_penalty, refit_with, useful_chi2
from legacy.fitting.causes.score_tests import Scores, scores
from legacy.fitting.causes.setting import Setting
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.ligament.equations import Term
from legacy.fitting.ligament.ligament_fit import LigamentFit
from legacy.fitting.model.parameter_vector import pairs
from legacy.stapeskit.arrays import Array

# Probability of a score below which a cause that may be far from first order is refitted to be sure: one
# needless refit in twenty, which the evidence then judges. Chosen by judgement.
_DOUBTFUL = 0.05
# Steps by which the place of a cause is sought between those of its family, in their distance.
_CLOSER = (1.0, 0.5, 0.25, 0.125)


@dataclass(frozen=True)
class Diagnosis:
    """Scores of every cause, refits of a few, and the causes that no data can show.

    Attributes
    ----------
    scores : Scores
        Of ``tested``.
    refits : tuple of Refit
        Best first; where nothing calls for a search those that explain more than chance does.
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
    hiding : mapping of str to ndarray, (1 + k, 1 + k)
        Information of a cause together with its nuisances, which can hide it.
    """

    tested: tuple[str, ...]
    scores: Scores
    refits: tuple[Refit, ...]
    threshold: float
    sensitivities: dict[str, Array]
    searched: bool = False
    corrected: dict[str, tuple[float, float]] = field(default_factory=dict)
    search_z: float = np.inf
    hiding: dict[str, Array] = field(default_factory=dict)

    @property
    def seen_from(self) -> dict[str, float]:
        """Size from which each scored cause is found in four of five such measurements, in its unit."""
        return {
            name: detectable_size(float(sd), self.search_z, self.hiding.get(name))
            for name, sd in zip(self.tested, self.scores.sd, strict=True)
            if CAUSES[name].scored
        }

    def evidence(self, refit: Refit) -> float:
        """Return the decrease of chi2, minus what noise makes and the penalties for unknowns and size."""
        from scipy.special import ndtri

        chance = float(ndtri(1.0 - calibrated("causes.false_alarm"))) * refit.fall_sd
        return refit.fall - chance - self.threshold * refit.unknowns - refit.strange

    @property
    def named(self) -> Refit | None:
        """The cause that the data support, or None; a cause of undetermined size is not named."""
        if not self.searched:
            return None
        known = (refit for refit in self.refits if refit.sd < abs(refit.size) or not refit.sd)
        best = next(known, None)
        return best if best is not None and self.evidence(best) > 0.0 else None

    @property
    def off(self) -> Array:
        """Columns E (24, k): E E^T is the mean square by which a wrong model puts K and D off.

        Notes
        -----
        The fit stays without the causes. Their effect is averaged over the fit as it is and the refits with
        weights exp(evidence / 2) (Hoeting et al. 1999, Bayesian model averaging, doi:10.1214/ss/1009212519).
        """
        evidence = np.array(
            [0.0, *(self.evidence(refit) + self.threshold * refit.known for refit in self.refits)]
        )
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
        return tuple(
            other.name for other in self.refits if other is not named and self.evidence(other) > close
        )


def setting_of(problem: Problem, ligament: LigamentFit) -> Setting:
    """Return the setting of a fit for the causes."""
    return Setting(ligament.lines, ligament.lines.omega * problem.scale.omega, problem.inertia.matrix)


def diagnose(
    problem: Problem,
    ligament: LigamentFit,
    laws: Callable[[float], Sequence[Refit]] | None = None,
    known: Sequence[Refit] = (),
) -> Diagnosis:
    """Score every cause at a fit, and refit with the likeliest where a score or the misfit is improbable.

    Causes that may be far from first order are also refitted where their score is doubtful; a large fall of
    chi2 calls for the search, too.

    Parameters
    ----------
    laws : callable, optional
        Refits under other damping laws whose chi2 is below its argument, for a search. What the scores speak
        for comes first, laws or the likeliest cause: where it explains the data, the others are given up
        where they cannot come near it.
    known : sequence of Refit
        Of one cause, which explain the data: the best of them takes the place of a refit of it.
    """
    from scipy.special import chdtri

    setting = setting_of(problem, ligament)
    equations = 2 * ligament.equations.n * ligament.lines.count
    present = {term.name for term in ligament.equations.terms}
    names = tuple(name for name in CAUSES if name not in present)
    terms = tuple(term_of(name, setting) for name in names)
    beside = {name: _moves_of(name, setting) for name in names if CAUSES[name].moves is not None}
    moving = tuple(term for moved in beside.values() for term in moved)
    tested = scores(ligament.lines, ligament.equations, ligament.joint, (*terms, *moving))
    scored = [place for place, name in enumerate(names) if CAUSES[name].scored]
    families = len({CAUSES[names[place]].family or names[place] for place in scored})
    p_values = tested.p_values[scored] * [places_of(names[place]) for place in scored]
    level = calibrated("causes.false_alarm") / families
    least = float(chdtri(1, level))
    alarm = p_values.min() < level
    units = problem.with_law(ligament.law).units
    entries = len(units)
    sensitivities = {
        name: CAUSES[name].example * tested.response[:entries, place] * units
        for place, name in enumerate(names)
    }
    ranked = [scored[place] for place in np.argsort(p_values, kind="stable")]
    leading = _first_of_families(ranked, names)
    likely = [place for place in leading if CAUSES[names[place]].refitted]
    whole = any(_fall_of_whole(name, tested, place) > rarity_penalty() for place, name in enumerate(names))
    searched = bool(alarm or whole or ligament.p_value < calibrated("causes.misfit_p"))
    if not searched and ligament.estimate.active:  # a refit would be credited with leaving the limit
        likely = []
    elif not searched:
        likely = [  # a cause that may be too large for its score, a linear test
            place
            for place in likely
            if (_may_be_large(names[place]) or np.isfinite(CAUSES[names[place]].usual))
            and tested.p_values[place] < _DOUBTFUL
        ]
    most = int(calibrated("causes.shortlist"))
    shortlist = likely[:most]
    if searched:  # the score, a linear test, says nothing of a cause that is as large as the body itself
        shortlist += [place for place in likely[most:] if _may_be_large(names[place])]
    laws_at = 0 if not CAUSES[names[ranked[0]]].refitted else 1
    under_laws: Sequence[Refit] = ()
    refits: list[Refit] = []
    for number, place in enumerate(shortlist):
        if number == laws_at and searched and laws is not None:
            under_laws = laws(useful_chi2(ligament, [*known, *refits]))
        if any(names[place] == refit.name for refit in known):
            refits.append(max(known, key=lambda refit: refit.fall))
            continue
        others = [*refits, *under_laws] if number else []
        explained = any(candidate.p_value > calibrated("causes.misfit_p") for candidate in others)
        within = useful_chi2(ligament, others) if number else np.inf
        fitted = partial(
            refit_with,
            ligament,
            names[place],
            start_scores=tested,
            place=place,
            units=units,
            explained=explained,
        )
        refit = fitted(terms[place], within=within)
        if refit is not None and not explained:
            refit = _move_to_best_place(refit, setting, fitted)
        refits += [] if refit is None else [refit]
    if not searched:
        searched = any(candidate.fall > least for candidate in refits)
        refits = [refit for refit in refits if searched or refit.fall > np.log(equations) * refit.unknowns]
        laws_at = len(shortlist)
    if len(shortlist) <= laws_at and searched and laws is not None:
        under_laws = laws(useful_chi2(ligament, refits))
    shown = sorted(leading)
    shown_scores = Scores(
        tested.z[shown],
        tested.estimate[shown],
        tested.sd[shown],
        tested.correlation[np.ix_(shown, shown)],
        tested.response[:, shown],
        tested.information[np.ix_(shown, shown)],
    )
    diagnosis = Diagnosis(
        tuple(names[place] for place in shown),
        shown_scores,
        (),
        float(np.log(equations)),
        sensitivities,
        searched,
        search_z=float(np.sqrt(least)),
        hiding=_join_nuisances(names, beside, tested.information),
    )
    best = [max(known, key=diagnosis.evidence)] if known else []
    others = [refit for refit in refits if all(refit.name != other.name for other in known)]
    return with_refits(diagnosis, [*best, *others, *under_laws])


def _moves_of(name: str, setting: Setting) -> tuple[Term, ...]:
    """Return the terms of the nuisances of a cause."""
    moves = CAUSES[name].moves
    return () if moves is None else tuple(Term(name, apply, 1.0) for apply in moves(setting))


def _join_nuisances(
    names: tuple[str, ...], beside: Mapping[str, tuple[Term, ...]], information: Array
) -> dict[str, Array]:
    """Return the information of each cause together with its nuisances, which stand after all causes."""
    informations, start = {}, len(names)
    for name, moved in beside.items():
        places = [names.index(name), *range(start, start + len(moved))]
        informations[name], start = information[np.ix_(places, places)], start + len(moved)
    return informations


def _move_to_best_place(refit: Refit, setting: Setting, fit: Callable[..., Refit | None]) -> Refit:
    """Return the refit with its cause at the place, between those of its family, where chi2 is least."""
    moved, off = CAUSES[refit.name].moved, 0.0
    if moved is None:
        return refit
    for step in _CLOSER:
        for way in (-step, step):
            while True:
                name, apply = moved(off + way)
                other = fit(replace(term_of(name, setting), apply=apply(setting)), within=refit.chi2)
                if other is None or other.chi2 >= refit.chi2:
                    break
                refit, off = replace(other, name=name), off + way
    return refit


def _first_of_families(ranked: list[int], names: tuple[str, ...]) -> list[int]:
    """Return the causes in their order, the first of each family only."""
    first: dict[str, int] = {}
    for place in ranked:
        first.setdefault(CAUSES[names[place]].family or names[place], place)
    return list(first.values())


def _fall_of_whole(name: str, tested: Scores, place: int) -> float:
    """Return to first order by how much chi2 falls with a cause of its only size."""
    only = CAUSES[name].only
    if only is None:
        return -np.inf
    return float((tested.estimate[place] ** 2 - (tested.estimate[place] - only) ** 2) / tested.sd[place] ** 2)


def _may_be_large(name: str) -> bool:
    """Return whether a cause may be as large as the body itself."""
    return len(CAUSES[name].starts) > 1


def model_error(diagnosis: Diagnosis, ligament: LigamentFit) -> Array:
    """Return columns E (24, k): E E^T is the mean square by which a wrong model puts K and D off.

    See `Diagnosis.off`; where no cause explains the misfit, what it may move K and D by is added.
    """
    named = diagnosis.named
    p_value = ligament.p_value if named is None else named.p_value
    if p_value > calibrated("causes.misfit_p"):
        return diagnosis.off
    return np.concatenate([diagnosis.off, unexplained_error(ligament)], axis=1)


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
