"""The one way from scaled data to a fit: the model, the law, the causes, what the data leave weak."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from fitting import entries
from fitting.bands import band_factors
from fitting.data import Data
from fitting.evidence import Search, law_alternative, search
from fitting.laws import LAWS
from fitting.likelihood import LOAD, PLAIN, Model
from fitting.mass import Inertia
from fitting.options import COMPARE, IGNORE, LOADED, KDOptions
from fitting.plane import applies, in_plane, plane_model
from fitting.result import KDFit
from fitting.solve import Fit, bic, fit, with_covariance
from fitting.textbook import estimate
from fitting.uncertainty import alike_lines
from fitting.unknowns import UNKNOWNS
from fitting.weak import weak_spread
from stapeskit.faults import StapeskitError

_LAW_ALIKE = 6.0  # difference of BIC within which another law is as likely: odds e^3


def fit_kd(data: Data, inertia: Inertia, options: KDOptions, causes: bool = True) -> KDFit:
    """Fit stiffness and damping to scaled data, and search for further unknowns where asked to.

    Raises
    ------
    StapeskitError
        A load is asked for that motion or mass do not hold.
    numpy.linalg.LinAlgError
        The data do not determine the unknowns in numbers.
    """
    model, compared = model_of(data, options), options.damping == COMPARE
    if options.estimator != "ml":
        return _by_textbook(data, model, inertia, options)
    robust = options.robust != "none"

    def fitted(data: Data) -> tuple[Fit, tuple[str, ...], Mapping[str, Fit]]:
        laws = _compare_laws(model, lambda own: fit(data, own, robust=robust)) if compared else {}
        return *(_likeliest(laws) if compared else (fit(data, model, robust=robust), ())), laws

    found, alike, laws = fitted(data)
    wider = alike_lines(found)
    if wider > 1.0:
        found, alike, laws = fitted(replace(data, covariance=wider * data.covariance, widened=wider))
    looked = Search()
    left_out = options.inplane == IGNORE and data.loads_known
    # a load that is left out on purpose would be found under another name
    if causes and not robust and not left_out:
        looked = search(found, laws=not compared)
        if options.evidence and _adopts(looked):
            assert looked.best is not None  # noqa: S101
            found = looked.best.found
            looked = search(found, laws=not compared)
    found = with_covariance(found)
    others = [law_alternative(found, laws[name]) for name in alike]
    return KDFit(
        options,
        inertia,
        found,
        replace(looked, alternatives=(*looked.alternatives, *others)),
        laws,
        alike,
        _at_the_limit(found),
        in_plane(found) if found.likelihood.model.coupling is not None else None,
        weak_spread(found),
        band_factors(found),
    )


def _by_textbook(data: Data, model: Model, inertia: Inertia, options: KDOptions) -> KDFit:
    """Fit by least squares, with or without constraints; of compared laws the likeliest."""
    constrained, bounds = options.estimator == "constrained", (options.lower or {}, options.upper or {})

    def estimated(own: Model) -> Fit:
        return estimate(data, own, constrained, *bounds)[0]

    laws = _compare_laws(model, estimated) if options.damping == COMPARE else {}
    best, alike = _likeliest(laws) if laws else (None, ())
    model = model if best is None else best.likelihood.model
    found, bias, active = estimate(data, model, constrained, *bounds)
    if (wider := alike_lines(found)) > 1.0:  # the bias is that of the noise of single lines
        widened = replace(data, covariance=wider * data.covariance, widened=wider)
        found, _, active = estimate(widened, model, constrained, *bounds)
    causes = Search(alternatives=tuple(law_alternative(found, laws[name]) for name in alike))
    return KDFit(
        options, inertia, found, search=causes, laws=laws, laws_alike=alike, active=active, bias=bias
    )


def model_of(data: Data, options: KDOptions) -> Model:
    """Return the model that the options ask for, where data and mass can hold it.

    Raises
    ------
    StapeskitError
        A load is asked for but motion or mass lack the other degrees of freedom.
    """
    law = "viscous" if options.damping == COMPARE else options.damping
    fixed = (UNKNOWNS[name].fixed(value) for name, value in options.fixed.items())
    unknowns = (*fixed, *(UNKNOWNS[name] for name in dict.fromkeys(options.freed)))
    if options.inplane == LOADED and not data.loads_known:
        wanted = "given with motion outside --dof and a mass matrix of all six degrees of freedom"
        step = "Run points2dof with all degrees of freedom and give mass.json, or use --inplane ignore"
        raise StapeskitError.of("--inplane load", wanted, "less", "", step)
    if options.inplane == IGNORE or not data.loads_known:
        return Model(law, PLAIN, unknowns=unknowns)
    if options.inplane == LOADED or options.estimator != "ml" or not applies(data):
        return Model(law, LOAD, unknowns=unknowns)
    return plane_model(data, law, unknowns=unknowns)


def _compare_laws(model: Model, fitted: Callable[[Model], Fit]) -> dict[str, Fit]:
    """Fit under every damping law; those that do not settle are left out.

    Raises
    ------
    numpy.linalg.LinAlgError
        None of them settles at an exponent or a time that a ligament can have.
    """
    fits = {}
    for name in LAWS:
        try:
            fits[name] = fitted(replace(model, law=name))
        except np.linalg.LinAlgError:
            continue
    if not any(one.law.physical for one in fits.values()):
        raise np.linalg.LinAlgError
    return fits


def _likeliest(laws: Mapping[str, Fit]) -> tuple[Fit, tuple[str, ...]]:
    """Return the fit of the best law and the laws that the data cannot distinguish from it.

    A law that contains the best one does not count: the simpler law is kept until the data contradict it.
    """
    physical = {name: one for name, one in laws.items() if one.law.physical}
    level = max(1.0, min(one.level for one in physical.values()))
    values = {name: bic(one, level) for name, one in physical.items()}
    best = min(values, key=lambda name: values[name])
    alike = [
        name
        for name in values
        if name != best and values[name] - values[best] < _LAW_ALIKE and best not in LAWS[name].includes
    ]
    return laws[best], tuple(alike)


def _adopts(looked: Search) -> bool:
    """Return whether the data call for an unknown that some ears really have, such as fluid.

    Not where a damping law explains the data as well: the two are distinguished by nothing then.
    """
    best = looked.best
    if best is None or best.unknown is None or not best.unknown.adopt or best.value < 2.0 * best.sd:
        return False
    return all(other.unknown is not None for other in looked.look_alikes)


def _at_the_limit(found: Fit) -> tuple[str, ...]:
    """Return which of K and D is held at the limit of positive semidefinite matrices."""
    parts = entries.split(found.theta[found.at["entries"]], found.likelihood.n)
    active = []
    for word, part in zip(("stiffness_psd", "damping_psd"), parts, strict=True):
        root = np.sqrt(np.maximum(np.diag(part), 1e-300))
        if np.linalg.eigvalsh(part / np.outer(root, root))[0] < 1e-6:
            active.append(word)
    return tuple(active)
