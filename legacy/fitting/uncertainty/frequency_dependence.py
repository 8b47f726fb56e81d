"""Do one K and one D hold over the whole band? Local factors of both, band by band, with their uncertainty.

In band b the dynamic stiffness is (1 + a_b) K + (1 + d_b) s D. A step of Newton's method in K, D and the
factors about the estimate gives them to first order, with their covariance as that of an estimate
(`fitting.estimators.regressor_noise`).
A common factor of all bands is K (or D) itself: factors are relative to their
mean, weighted by the information of each band, so that a noisy band does not move the others. Common errors
of motion and mass move the residual and are carried through the same map; a wrong mass matrix looks like a
stiffness that changes with w^2, so that its uncertainty belongs here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.fitting.estimators import ml
from legacy.fitting.estimators.base import Estimate, gram, transposed_times
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.estimators.regressor_noise import information, noise_products
from legacy.fitting.model.parameter_vector import basis, split
from legacy.fitting.model.scaled_lines import Lines, backward, evaluate, forward, motion_rows, real_rows
from legacy.fitting.options import USUAL_BANDS
from legacy.fitting.uncertainty.covariance import (
    chi2,
    degrees,
    invert,
    joined_mass_sources,
    motion_moves_mass,
)
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

# Lines a band: 8 give 48 equations for 12 unknowns.
_FEWEST_LINES = 8
# Level of the test that one K and D hold over the band: 1 of 1000 right fits is called frequency dependent.
_SIGNIFICANT = 1e-3
# Below this p-value the result does not state that one pair of matrices holds.
_DOUBTFUL = 0.05


@dataclass(frozen=True)
class FrequencyDependence:
    """Local stiffness and damping over those of the whole band.

    Attributes
    ----------
    low_hz, high_hz : ndarray, (bands,)
        First and last line of each band, Hz.
    lines : ndarray, (bands,), int
    stiffness, damping : ndarray, (bands,)
        Factors of K and of D; their means, weighted by information, are 1.
    stiffness_sd, damping_sd : ndarray, (bands,)
        From all sources.
    chi2 : float
        Of all factors being 1.
    n_dof : int
        2 bands - 2.
    """

    low_hz: Array
    high_hz: Array
    lines: NDArray[np.intp]
    stiffness: Array
    damping: Array
    stiffness_sd: Array
    damping_sd: Array
    chi2: float
    n_dof: int
    p_value: float

    def notices(self) -> list[Notice]:
        """Return the warning that K and D change over the band, when they do significantly."""
        if not self.p_value < _SIGNIFICANT:
            return []
        text = (
            f"One K and one D do not hold over the whole band (p = {self.p_value:.1g}): {self.words()}. A "
            "viscoelastic ligament does this, and so does a wrong mass matrix or damping law; try "
            f"{named('damping')} "
            f"compare, or fit parts with {named('band')}."
        )
        return [Notice("frequency_dependent", text)]

    @property
    def verdict(self) -> str:
        """Whether one pair of matrices holds over the band, in words."""
        if self.p_value < _SIGNIFICANT:
            return "does NOT hold"
        return "may not hold" if self.p_value < _DOUBTFUL else "holds"

    def words(self) -> str:
        """Describe between which factors K and D vary."""
        parts = []
        for name, factor, sd in (
            ("K", self.stiffness, self.stiffness_sd),
            ("D", self.damping, self.damping_sd),
        ):
            least, most = int(np.argmin(factor)), int(np.argmax(factor))
            ends = [
                f"{factor[at]:.3f} ± {sd[at]:.1g} ({self.low_hz[at]:.0f} to {self.high_hz[at]:.0f} Hz)"
                for at in (least, most)
            ]
            parts.append(f"{name} by factors of {ends[0]} to {ends[1]}")
        return ", ".join(parts)


def fewer_bands(lines: int, bands: int) -> list[Notice]:
    """Return the warning that the lines do not suffice for the parts of the band that were asked for.

    Parameters
    ----------
    lines : int
        Lines that are fitted, of all runs.
    bands : int
        Number that the user asked for; the default number gives no notice.
    """
    possible = lines // _FEWEST_LINES
    if bands in (0, USUAL_BANDS) or possible >= bands:
        return []
    now = f"in {possible} parts of the band" if possible > 1 else "in no parts of the band"
    text = (
        f"K and D are compared {now}, not in the {bands} that were asked for: a part holds at least "
        f"{_FEWEST_LINES} of the {lines} lines. Leave {named('bands')} at {USUAL_BANDS}, or measure more "
        "lines."
    )
    return [Notice("fewer_bands", text)]


def frequency_dependence(
    problem: Problem, lines: Lines, estimate: Estimate, widened: float = 1.0, bands: int = USUAL_BANDS
) -> FrequencyDependence | None:
    """Return local factors of K and D in bands of equally many lines; None when two bands are too many.

    Parameters
    ----------
    lines : Lines
        Its scaled equations.
    widened : float
        Factor on the noise covariance because chi2 exceeds its degrees of freedom.
    bands : int
        At most; fewer when a band would hold less than 8 lines.
    """
    bands = min(bands, lines.count // _FEWEST_LINES)
    if bands < 2:
        return None
    order = np.argsort(lines.omega, kind="stable")
    band = np.empty(lines.count, dtype=np.intp)
    for place, members in enumerate(np.array_split(order, bands)):
        band[members] = place
    now = ml.whiten(estimate.parameters, lines)
    weights = np.ones(lines.count) if estimate.weights is None else estimate.weights
    root = np.sqrt(weights)
    rows = np.column_stack(
        [
            real_rows(now.corrected(lines) * root[:, None]),
            real_rows(_local_columns(estimate.parameters, lines, now, band, bands) * root[:, None]),
        ]
    )
    p = lines.parameters
    turned = _without_common_factor(p, bands)
    weights_of_bands = np.einsum("rp,rp->p", rows[:, p:], rows[:, p:]).reshape(2, bands)
    rows = rows @ turned
    residual = real_rows(now.residual * root)
    noise = turned.T @ _noise(estimate.parameters, lines, now, band, bands, weights) @ turned
    level = chi2(estimate.parameters, lines) / max(degrees(lines), 1)
    known, spread = information(gram(rows), noise, level)
    inverse = invert(known)
    factors = -inverse @ transposed_times(rows, residual)
    if estimate.weights is None:
        covariance = 0.5 * widened * inverse @ spread @ inverse
    else:
        scores = (rows * residual[:, None]).reshape(2 * lines.n, lines.count, -1).sum(axis=0)
        covariance = inverse @ (scores.T @ scores) @ inverse
    for changes, part in common_errors(problem, lines, estimate.parameters):
        moved = real_rows(forward(now.factor, changes) * root[:, None])
        effect = inverse @ (rows.T @ moved)
        covariance = covariance + effect @ part @ effect.T
    return _result(problem, band, turned[p:, p:], factors[p:], covariance[p:, p:], weights_of_bands)


def _without_common_factor(parameters: int, bands: int) -> Array:
    """Return the unknowns (p + 2 bands, p + 2 bands - 2) that leave out a factor common to all bands."""
    contrasts = np.linalg.qr(np.column_stack([np.ones(bands), np.eye(bands)[:, 1:]]))[0][:, 1:]
    turned = np.zeros((parameters + 2 * bands, parameters + 2 * bands - 2))
    turned[:parameters, :parameters] = np.eye(parameters)
    middle = parameters + bands - 1
    turned[parameters : parameters + bands, parameters:middle] = contrasts
    turned[parameters + bands :, middle:] = contrasts
    return turned


def _noise(
    parameters: Array,
    lines: Lines,
    now: ml.Whitened,
    band: NDArray[np.intp],
    bands: int,
    weights: Array,
) -> Array:
    """Return what noise adds to the Hessian of parameters and factors, (p + 2 bands, p + 2 bands)."""
    stiffness, damping = split(parameters, lines.n)
    units = basis(lines.n)
    half, p = len(units), len(parameters)
    filled = np.zeros((p + 2 * bands, p + 2 * bands))
    for place in range(bands):
        inside = np.flatnonzero(band == place)
        part = now.select(inside)
        columns = np.r_[:half, p + place, half:p, p + bands + place]
        products = noise_products(
            part,
            lines.select(inside),
            np.concatenate([units, stiffness[None]]),
            np.concatenate([units, damping[None]]),
            weights[inside],
        )
        filled[np.ix_(columns, columns)] += products
    return filled


def _result(
    problem: Problem,
    band: NDArray[np.intp],
    contrasts: Array,
    factors: Array,
    covariance: Array,
    weights: Array,
) -> FrequencyDependence:
    from scipy.special import chdtrc

    rank, bands = len(factors), len(contrasts) // 2
    statistic = float(factors @ invert(covariance) @ factors)
    contrasts = _about_weighted_mean(weights) @ contrasts
    local = contrasts @ factors
    sd = np.sqrt(np.maximum(np.diag(contrasts @ covariance @ contrasts.T), 0.0))
    freq = problem.observation.freq_hz
    places = [freq[band == place] for place in range(bands)]
    return FrequencyDependence(
        np.array([part.min() for part in places]),
        np.array([part.max() for part in places]),
        np.array([len(part) for part in places]),
        1.0 + local[:bands],
        1.0 + local[bands:],
        sd[:bands],
        sd[bands:],
        statistic,
        rank,
        float(chdtrc(rank, statistic)),
    )


def _about_weighted_mean(weights: Array) -> Array:
    """Return the map (2 bands, 2 bands) that subtracts the weighted means of K's and of D's factors."""
    bands = weights.shape[1]
    turned = np.eye(2 * bands)
    for part, own in enumerate(weights):
        place = slice(part * bands, (part + 1) * bands)
        turned[place, place] -= own / max(float(own.sum()), 1e-300)
    return turned


def _local_columns(
    parameters: Array, lines: Lines, now: ml.Whitened, band: NDArray[np.intp], bands: int
) -> ComplexArray:
    """Return the derivative of the whitened residual by the factors, (n, lines, 2 bands)."""
    stiffness, damping = split(parameters, lines.n)
    multiplier = backward(now.factor, now.residual)
    fitted = lines.dq - np.einsum("ijl,jl->il", now.state.gain, multiplier)
    columns = np.zeros((lines.n, lines.count, 2 * bands), dtype=complex)
    places = np.arange(lines.count)
    columns[:, places, band] = stiffness @ fitted
    columns[:, places, bands + band] = lines.factor * (damping @ fitted)
    return forward(now.factor, columns)


def common_errors(problem: Problem, lines: Lines, parameters: Array) -> list[tuple[ComplexArray, Array]]:
    """Return changes of the residual (n, lines, k) by common errors, and their covariance (k, k)."""
    by_error = []
    by_mass = None
    if problem.inertia.parameters is not None:
        by_mass = _by_mass(problem, lines, parameters)
        total = sum(joined_mass_sources(problem).values(), np.zeros((10, 10)))
        if np.any(total):
            by_error.append((by_mass, total))
    observation = problem.observation
    if observation.shared_derivatives is None or observation.shared_covariance is None:
        return by_error
    difference, inertia = motion_rows(
        observation,
        problem.mass_rows(),
        problem.scale,
        problem.mass_on_base,
    )
    changes = observation.shared_derivatives
    stiffness, damping = split(parameters, lines.n)
    moved = np.moveaxis(changes @ difference.T, (2, 0), (0, 2))
    residual = np.einsum("ij,jlk->ilk", stiffness, moved)
    residual = residual + lines.factor[:, None] * np.einsum("ij,jlk->ilk", damping, moved)
    force = np.moveaxis(changes @ inertia.T, (2, 0), (0, 2))
    residual = residual - (lines.omega**2)[:, None] * force
    along = motion_moves_mass(problem)
    if np.any(along):
        by_mass = _by_mass(problem, lines, parameters) if by_mass is None else by_mass
        residual = residual + by_mass @ along
    by_error.append((residual, observation.shared_covariance))
    return by_error


def _by_mass(problem: Problem, lines: Lines, parameters: Array) -> ComplexArray:
    """Return the derivative of the residual by the inertial parameters, (n, lines, 10)."""
    here = evaluate(parameters, lines).residual
    size = float(np.abs(problem.inertia.matrix).max())
    columns = []
    for place in range(10):
        change = np.zeros(10)
        change[place] = size
        moved = evaluate(parameters, problem.lines(None, change)).residual
        columns.append((moved - here) / size)
    return np.stack(columns, axis=2)
