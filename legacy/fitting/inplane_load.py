"""Whether the measured motion outside the model enters as a known inertial load.

Leaving the load w^2 M_rc q_c out moves the estimate by d; taking it in adds the noise of q_c, which spreads
the estimate by a covariance V. The load is taken when d is significant against V: d^T V^-1 d over its 99.9 %
quantile under mere noise, and over 2 p, where removing the bias outweighs the added variance. It is taken as
well when the fit without it is a misfit and chi2 falls by more than that with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.fitting.errors import FittingError
from legacy.fitting.estimators import ml
from legacy.fitting.estimators.base import EstimatorOptions, gram, transposed_times
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.model.parameter_vector import entry_names
from legacy.fitting.model.scaled_lines import forward, real_rows
from legacy.fitting.uncertainty.identifiability import relative_sizes
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

AUTO, LOAD = "auto", "load"
# Level of the test of a load by motion outside the model: 1 of 1000 fits without a load takes it.
_LEVEL = 0.999
# Probability of a chi2 below which a fit without the load is a misfit.
_IMPROBABLE = 1e-4


@dataclass(frozen=True)
class InplaneChoice:
    """What was decided about the motion outside the model, and why.

    Attributes
    ----------
    used : bool
        Whether it enters as a load.
    dof : tuple of str
        Measured degrees of freedom outside the model.
    reason : str
        One sentence.
    statistic, threshold : float or None
        Significance of its effect on the parameters, and what it must exceed.
    largest_effect : float or None
        Largest change of an entry, relative to sqrt(Xii Xjj).
    entry : str
        That entry.
    chi2_without, chi2_with : float or None
        Of the maximum likelihood fit without and with the load.
    mass_known : bool
        Whether the mass matrix has the other degrees of freedom, so that the load can be computed.
    beyond_shared : float or None
        The same significance against noise and the errors that lines share: what lasers and frames that are a
        little off make of the other motion is no motion.
    """

    used: bool
    dof: tuple[str, ...]
    reason: str
    statistic: float | None = None
    threshold: float | None = None
    largest_effect: float | None = None
    entry: str = ""
    chi2_without: float | None = None
    chi2_with: float | None = None
    mass_known: bool = True
    beyond_shared: float | None = None

    def notices(self) -> list[Notice]:
        """Return a warning when significant motion is left out, or motion whose load is not known."""
        if not self.mass_known:
            text = (
                f"The measured motion {', '.join(self.dof)} loads the structure too, but the mass matrix "
                "lacks these degrees of freedom: K and D err by what the load comes to. Give mass.json, "
                f"which has all six, or say by {named('inplane')} ignore that the load is small."
            )
            return [Notice("inplane_mass_not_given", text)]
        if self.used or self.threshold is None or (self.beyond_shared or 0.0) <= self.threshold:
            return []
        return [
            Notice(
                "neglected_motion",
                f"The measured motion {', '.join(self.dof)} is significant but left out; it moves "
                f"{self.entry} by {100.0 * (self.largest_effect or 0.0):.2g} % of "
                f"sqrt(Xii Xjj). Use {named('inplane')} load.",
            )
        ]


def choose_inplane_load(problem: Problem, choice: str) -> tuple[Problem, InplaneChoice]:
    """Decide about the load and return the problem with or without it.

    Raises
    ------
    FittingError
        A load is asked for but the mass matrix or the motion lacks the other degrees of freedom.
    """
    others = problem.observation.load_dof
    without = replace(problem, observation=problem.observation.without_load())
    if not others:
        if choice == LOAD:
            raise FittingError.of(
                "{inplane} load",
                "given with measured motion outside {dof}",
                "none",
                next_step="Run points2dof with {dof} all, or use {inplane} ignore",
            )
        return without, InplaneChoice(False, (), "no motion outside the model was measured")
    if not problem.inertia.complete:
        if choice == LOAD:
            raise FittingError.of(
                "{inplane} load",
                "given with the mass matrix of all six degrees of freedom",
                "one of the chosen ones only",
                next_step="Give {mass} mass.json, or use {inplane} ignore",
            )
        reason = "the mass matrix of the other degrees of freedom is not given"
        return without, InplaneChoice(False, others, reason, mass_known=choice != AUTO)
    found = significance(problem, without)
    threshold = found.threshold
    significant = found.statistic > threshold
    chi2_without, chi2_with = _chi2(without), _chi2(problem)
    needed = _misfit(without, chi2_without) and chi2_without - chi2_with > threshold
    used = choice == LOAD or (choice == AUTO and (significant or needed))
    words = "significant" if significant else "not significant"
    reason = f"its effect on K and D is {words} against its noise"
    if needed and not significant:
        reason += ", but the fit needs it"
    if choice != AUTO:
        reason = f"asked for with {named('inplane')} {choice}; {reason}"
    decision = InplaneChoice(
        used,
        others,
        reason,
        found.statistic,
        threshold,
        found.effect,
        found.entry,
        chi2_without,
        chi2_with,
        beyond_shared=found.beyond_shared,
    )
    return (problem if used else without), decision


def _chi2(problem: Problem) -> float:
    """Return chi2 of the maximum likelihood fit."""
    return 2.0 * ml.estimate(problem.lines(), EstimatorOptions(passive=False)).objective


def _misfit(problem: Problem, chi2: float) -> bool:
    """Return whether a chi2 is improbably large."""
    from scipy.special import chdtrc

    lines = problem.lines()
    return bool(chdtrc(max(2 * lines.n * lines.count - lines.parameters, 1), chi2) < _IMPROBABLE)


@dataclass(frozen=True)
class Significance:
    """The effect of a load on the parameters against what it is known by.

    Attributes
    ----------
    statistic, beyond_shared, threshold : float
        Against noise, against noise and shared errors, and what they must exceed.
    effect : float
        Largest relative change of an entry.
    entry : str
        That entry.
    """

    statistic: float
    beyond_shared: float
    threshold: float
    effect: float
    entry: str


def significance(problem: Problem, without: Problem) -> Significance:
    """Compare the effect of the load on the parameters with its noise, and with errors that lines share."""
    from scipy.special import chdtri

    lines = without.lines()
    parameters = ml.estimate(lines, EstimatorOptions(passive=False)).parameters
    now = ml.whiten(parameters, lines)
    rows = now.corrected(lines)
    loaded = problem.lines()
    load = forward(now.factor, loaded.force - lines.force)
    flat = real_rows(rows)
    inverse = np.linalg.pinv(gram(flat), rcond=1e-13)
    shift = inverse @ transposed_times(flat, real_rows(load))
    spread = np.zeros_like(inverse)
    root = _load_root(problem)
    for column in range(root.shape[1]):
        part = forward(now.factor, np.ascontiguousarray(root[:, column]))
        terms = np.einsum("ilp,il->lp", rows.conj(), part)
        spread += 0.5 * (terms.conj().T @ terms).real
    variance = inverse @ spread @ inverse
    both = variance
    if problem.observation.shared_covariance is not None:
        by_errors = np.array(
            [
                inverse @ transposed_times(flat, real_rows(forward(now.factor, np.ascontiguousarray(change))))
                for change in _shared_loads(problem)
            ]
        )
        both = variance + by_errors.T @ problem.observation.shared_covariance @ by_errors
    statistic, beyond = (
        float(shift @ np.linalg.pinv(part, rcond=1e-12) @ shift) for part in (variance, both)
    )
    relative = np.abs(shift) / relative_sizes(parameters, lines.n)
    worst = int(np.argmax(relative))
    threshold = max(float(chdtri(len(shift), 1.0 - _LEVEL)), 2.0 * len(shift))
    return Significance(statistic, beyond, threshold, float(relative[worst]), entry_names(lines.n)[worst])


def _load_root(problem: Problem) -> NDArray[np.complex128]:
    """Return F_c times a root of the covariance of q_c, scaled, (n, c, lines)."""
    n, c = problem.n, len(problem.observation.load_dof)
    covariance = problem.observation.covariance[:, n : n + c, n : n + c]
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return np.moveaxis(_forces(problem) @ root, 0, 2)


def _shared_loads(problem: Problem) -> NDArray[np.complex128]:
    """Return F_c times the derivatives of q_c by shared errors, scaled, (p, n, lines)."""
    n, c, derivatives = problem.n, len(problem.observation.load_dof), problem.observation.shared_derivatives
    assert derivatives is not None  # noqa: S101
    changes = derivatives[:, :, n : n + c, None]
    return np.asarray(np.moveaxis((_forces(problem) @ changes)[..., 0], 2, 1))


def _forces(problem: Problem) -> Array:
    """Return F_c, the forces of the load per motion outside the model, scaled, (lines, n, c)."""
    observation, scale = problem.observation, problem.scale
    coupling = problem.inertia.rows(observation.dof, observation.load_dof)[:, problem.n :]
    coupling = coupling / scale.root_mass[:, None] / scale.amplitude
    square = (2.0 * np.pi * observation.freq_hz / scale.omega) ** 2
    return np.asarray(square[:, None, None] * coupling)
