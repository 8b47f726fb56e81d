"""The one call from motion and mass to a solution: fit, choose the law, look for causes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fitting.bands import BandFactors, band_factors
from fitting.causes import UNKNOWNS, chosen
from fitting.data import Data, data_of
from fitting.entries import sizes, split
from fitting.evidence import Search, law_alternative, search
from fitting.laws import LAWS
from fitting.likelihood import LOAD, PLAIN, Model
from fitting.mass import Inertia, inertia_of
from fitting.options import COMPARE, IGNORE, LOADED, KDOptions
from fitting.plane import InPlane, applies, in_plane, plane_model
from fitting.solve import Fit, bic, compare_laws, fit, with_covariance
from fitting.textbook import Textbook, estimate
from fitting.weak import weak_spread
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

if TYPE_CHECKING:
    from stapeskit.records.mass_matrix import MassMatrix
    from stapeskit.records.motion import RigidMotion

_LAW_ALIKE = 6.0  # difference of BIC within which another law is as likely: odds e^3


@dataclass(frozen=True)
class Solution:
    """What was found, in scaled units; `fitting.result.KDFit` says it in SI.

    Attributes
    ----------
    found : Fit
    plane : InPlane or None
        Stiffness in the plane of the ligament, where the plane was estimated.
    laws : mapping of str to Fit
        Damping laws that were compared.
    laws_alike : tuple of str
        Those that the data cannot distinguish from the chosen one.
    search : Search
        Further unknowns that the data call for.
    textbook : Textbook or None
        Another estimator than maximum likelihood.
    weak : ndarray, (p, k)
        Columns of the error of weak entries.
    bands : BandFactors or None
    inertia : Inertia
    undetermined : tuple of str
        Compared laws that could not be fitted.
    neglected : (int, float) or None
        Entry that measured motion outside the model moves most, and by which share, where that is
        significant.
    """

    found: Fit
    plane: InPlane | None
    laws: Mapping[str, Fit]
    laws_alike: tuple[str, ...]
    search: Search
    textbook: Textbook | None
    weak: Array = field(repr=False)
    bands: BandFactors | None
    inertia: Inertia
    undetermined: tuple[str, ...] = ()
    neglected: tuple[int, float] | None = None


def solve(motion: RigidMotion, mass: MassMatrix | ArrayLike, options: KDOptions) -> Solution:
    """Fit stiffness and damping.

    Parameters
    ----------
    motion : RigidMotion
        Of structure and base about the footplate centre, in footplate axes.
    mass : MassMatrix or array_like
        About the same point in the same axes; an array is (n, n) in the order of the degrees of freedom, or
        (6, 6).

    Raises
    ------
    StapeskitError
        Motion, mass and options do not fit together, or the data cannot determine the unknowns at all.
    """
    inertia = inertia_of(mass, options.dof)
    bodies = options.structure, options.base
    data = data_of(motion, inertia, options.dof, *bodies, options.band_hz, options.exclude_hz)
    with finite_solution():
        return solve_data(data, inertia, options)


@contextmanager
def finite_solution() -> Iterator[None]:
    """Refuse data whose equations, or the covariance of their solution, cannot be solved in numbers."""
    try:
        yield
    except np.linalg.LinAlgError:
        raise StapeskitError.of(
            "motion and mass",
            "of sizes from which stiffness and damping follow",
            "equations without a finite solution",
            "",
            "Look for columns or bodies in each other's place, wrong units, and lines far beyond the others",
        ) from None


def model_of(data: Data, options: KDOptions) -> Model:
    """Return the model that the options ask for, where data and mass can hold it.

    Raises
    ------
    StapeskitError
        A load is asked for but motion or mass lack the other degrees of freedom.
    """
    law = "viscous" if options.damping == COMPARE else options.damping
    unknowns = (
        *(UNKNOWNS[name].fixed(value) for name, value in options.fixed.items()),
        *chosen(options.freed),
    )
    if options.inplane == LOADED and not data.loads_known:
        wanted = "given with motion outside --dof and a mass matrix of all six degrees of freedom"
        step = "Run points2dof with all degrees of freedom and give mass.json, or use --inplane ignore"
        raise StapeskitError.of("--inplane load", wanted, "less", "", step)
    if options.inplane == IGNORE or not data.loads_known:
        return Model(law, PLAIN, unknowns=unknowns)
    if options.inplane == LOADED or options.estimator != "ml" or not applies(data):
        return Model(law, LOAD, unknowns=unknowns)
    return plane_model(data, law, unknowns=unknowns)


def solve_data(data: Data, inertia: Inertia, options: KDOptions) -> Solution:
    """Fit scaled data; arguments and errors are those of `solve`."""
    model = model_of(data, options)
    if options.estimator != "ml":
        return _solve_by_textbook(data, inertia, model, options)
    robust, compared = options.robust != "none", options.damping == COMPARE
    laws = compare_laws(data, model, tuple(LAWS), robust) if compared else {}
    physical = {name: one for name, one in laws.items() if one.law.physical}
    if compared and not physical:
        raise np.linalg.LinAlgError
    alike: tuple[str, ...] = ()
    if compared:
        found, alike = _likeliest(physical)
    else:
        found = fit(data, model, robust=robust)
    causes = Search()
    left_out = options.inplane == IGNORE and data.loads_known
    if not robust and not left_out:  # a load that is left out on purpose would be found under another name
        causes = search(found, laws=not compared)
        if options.evidence:
            found, causes = _adopted(found, causes, compared)
    found = with_covariance(found)
    others = [law_alternative(found, laws[name]) for name in alike]
    causes = replace(causes, alternatives=(*causes.alternatives, *others))
    plane = in_plane(found) if found.likelihood.model.coupling is not None else None
    missing = tuple(name for name in LAWS if compared and name not in laws)
    return Solution(
        found, plane, laws, alike, causes, None, weak_spread(found), band_factors(found), inertia, missing,
        _neglected(found) if left_out else None,
    )  # fmt: skip


def _neglected(found: Fit) -> tuple[int, float] | None:
    """Return the entry that moves most when other measured motion is a load, where that is significant."""
    from scipy.special import chdtri

    other = fit(found.data, replace(found.likelihood.model, motion=LOAD), found.theta, found.noise)
    count = found.at["entries"].stop
    change = other.theta[:count] - found.theta[:count]
    statistic = change @ np.linalg.solve(other.covariance[:count, :count], change)
    if statistic < max(float(chdtri(count, 1e-3)), 2.0 * count):
        return None
    relative = change / sizes(*split(found.theta[:count], found.likelihood.n))
    place = int(np.argmax(np.abs(relative)))
    return place, float(relative[place])


def _likeliest(laws: Mapping[str, Fit]) -> tuple[Fit, tuple[str, ...]]:
    """Return the fit of the best law and the laws that the data cannot distinguish from it.

    A law that contains the best one does not count: the simpler law is kept until the data contradict it.
    """
    level = max(1.0, min(one.level for one in laws.values()))
    values = {name: bic(one, level) for name, one in laws.items()}
    best = min(values, key=lambda name: values[name])
    alike = [
        name
        for name in laws
        if name != best and values[name] - values[best] < _LAW_ALIKE and best not in LAWS[name].includes
    ]
    return laws[best], tuple(alike)


def _adopted(found: Fit, causes: Search, compared: bool) -> tuple[Fit, Search]:
    """Add an unknown that some ears really have, such as fluid, to the model where the data call for it.

    Not where a damping law explains the data as well: the two are distinguished by nothing then.
    """
    best = causes.best
    if best is None or best.unknown is None or not best.unknown.adopt or best.value < 2.0 * best.sd:
        return found, causes
    if any(other.unknown is None for other in causes.look_alikes):
        return found, causes
    return best.found, search(best.found, laws=not compared)


def _solve_by_textbook(data: Data, inertia: Inertia, model: Model, options: KDOptions) -> Solution:
    """Fit by pinv or with constraints, under the law that was asked for or the best of all."""
    names = tuple(LAWS) if options.damping == COMPARE else (model.law,)
    tried = {name: _textbook_fit(data, replace(model, law=name), options) for name in names}
    physical = {name: book for name, book in tried.items() if book.found.law.physical}
    best = min(physical or tried, key=lambda name: bic(tried[name].found, 1.0))
    laws = {name: book.found for name, book in tried.items()} if options.damping == COMPARE else {}
    weak = np.zeros((len(tried[best].found.theta), 0))
    return Solution(tried[best].found, None, laws, (), Search(), tried[best], weak, None, inertia)


def _textbook_fit(data: Data, model: Model, options: KDOptions) -> Textbook:
    """Estimate under one law; what it leaves open is found by a search for the least chi2."""
    from scipy.optimize import minimize_scalar

    def at(value: float | None) -> Textbook:
        tried = replace(model, law_value=value)
        bounds = options.lower or {}, options.upper or {}
        return estimate(data, tried, options.estimator == "constrained", *bounds)

    if not LAWS[model.law].usual_sd:
        return at(None)
    least = minimize_scalar(lambda value: at(float(value)).found.chi2, bounds=(0.02, 1.8), method="bounded")
    return at(float(least.x))
