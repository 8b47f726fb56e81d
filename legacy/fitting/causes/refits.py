"""A full fit with one cause more, or under another damping law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from legacy.fitting.calibrated import calibrated
from legacy.fitting.causes.catalogue import CAUSES, places_of
from legacy.fitting.causes.chi2_differences import difference_sd, measured_operator
from legacy.fitting.causes.model_error import cause_error
from legacy.fitting.causes.score_tests import Scores
from legacy.fitting.ligament.equations import Term
from legacy.fitting.ligament.inplane_stiffness import inverse_of
from legacy.fitting.ligament.joint_fit import JointFit
from legacy.fitting.ligament.ligament import FEW_ROUNDS, MOST_ROUNDS, extended_fit
from legacy.fitting.ligament.ligament_fit import LigamentFit
from legacy.fitting.ligament.misfit import explained_limit
from legacy.stapeskit.arrays import Array

# Steps of a refit, and of one beside a cause that explains the data.
_MOST, _FEW = 60, 20


@dataclass(frozen=True)
class Refit:
    """A full fit with one cause in it.

    Attributes
    ----------
    size : float
        In the unit of the cause.
    sd : float
        The same unit.
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
    chi2 : float
        With the noise as stated.
    fall_sd : float
        Standard deviation of the fall where noise alone makes it (fitting.causes.chi2_differences).
    known : float
        Of the unknowns those that have a prior: they count for a name, not for a weight.
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
    chi2: float = np.inf
    fall_sd: float = 0.0
    known: float = 0.0


def useful_chi2(ligament: LigamentFit, known: Sequence[Refit]) -> float:
    """Return the chi2 that another model must reach to be named, or to be listed beside the one that is.

    Its fall of chi2, in units of the misfit that it leaves, has to come near that of the best one. Where none
    is known, half of the misfit has to be explained, in the logarithm of chi2 per degree of freedom.
    """
    chi2, n_dof, equations = ligament.chi2, ligament.n_dof, ligament.equations
    slack = calibrated("causes.look_alike_chi2") + float(np.log(2 * equations.n * ligament.lines.count))
    fall = max((candidate.fall for candidate in known), default=0.0) - slack
    if fall <= 0.0:
        return float(max(np.sqrt(chi2 * n_dof), explained_limit(equations, ligament.lines.count)))
    return float(chi2 - fall if chi2 - fall < n_dof else chi2 * n_dof / (fall + n_dof))


def rarity_penalty() -> float:
    """Return what an error that is there wholly or not at all must lower chi2 by to be likely."""
    return -2.0 * float(np.log(calibrated("causes.whole_error")))


def refit_with(
    ligament: LigamentFit,
    name: str,
    term: Term,
    start_scores: Scores,
    place: int,
    units: Array,
    within: float,
    explained: bool,
) -> Refit | None:
    """Fit with one cause from the estimate of its score and from its other starts; the best one, or None.

    Only a chi2 below ``within`` is of use. Where another cause explains the data already, few steps suffice
    for causes that are small; one as large as the body itself is followed to its end.
    """
    from scipy.special import chdtrc

    best = None
    near, far = float(start_scores.estimate[place]), CAUSES[name].starts[1:]
    for begin in (near, *([] if explained else [0.0]), *far):
        if begin == 0.0 and best is not None and best[2].chi2 < ligament.joint.chi2:
            continue
        shifted = ligament.joint.parameters - begin * start_scores.response[:, place]
        start = replace(ligament.joint, parameters=shifted)
        rounds = FEW_ROUNDS if best is not None or begin in far else MOST_ROUNDS
        brief = explained and begin not in far
        fitted = extended_fit(
            ligament.lines,
            ligament.equations,
            start,
            (term,),
            np.array([begin]),
            _FEW if brief else _MOST,
            0 if brief else rounds,
            within,
        )
        if fitted is not None and (best is None or fitted[2].chi2 < best[2].chi2 - 1e-6):
            best = fitted
        if (
            not far
            and best is not None
            and chdtrc(best[2].n_dof, best[2].chi2) > calibrated("causes.misfit_p")
        ):
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
    p_value = float(chdtrc(fit.n_dof, fit.chi2))
    more = lines.errors - ligament.lines.errors
    chosen = _prior_cost(fit, more) + 2.0 * np.log(places_of(name))
    unknowns = 1.0 + chosen / np.log(2 * equations.n * lines.count)
    strange, only = (size / CAUSES[name].usual) ** 2, CAUSES[name].only
    spread = level * inverse_of(fit.at.hessian)[equations.term, equations.term][-1, -1]
    if only is not None:
        unknowns, strange = unknowns - 1.0, (size - only) ** 2 / spread + rarity_penalty()
    sd = float(np.sqrt(spread))
    factor = equations.applied(lines, fit.parameters)[1].factor
    off = cause_error(ligament, change, sd / max(abs(size), 1e-300), factor)
    operators = [
        measured_operator(measured, unknown, joint.parameters)
        for measured, unknown, joint in ((ligament.lines, ligament.equations, ligament.joint), best)
    ]
    fall_sd = difference_sd(operators[0], operators[1], ligament.lines.covariance)
    return Refit(name, size, sd, fall, effect, p_value, unknowns, strange, off, fit.chi2, fall_sd)


def _prior_cost(fit: JointFit, count: int) -> float:
    """Return what the prior of the last unknowns costs in chi2: the ratio of its volume to the posterior's.

    Notes
    -----
    Laplace's approximation of the evidence (MacKay 1992, doi:10.1162/neco.1992.4.3.415).
    """
    if not count:
        return 0.0
    posterior = inverse_of(fit.at.hessian)[-count:, -count:]
    return max(0.0, -float(np.linalg.slogdet(posterior)[1]))
