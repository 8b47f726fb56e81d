"""Estimators of textbooks, as the paper has them: pinv (Eq. 5) and least squares with constraints.

Both minimise the equation error |A p - b|, p the entries of K and D: the noise of the regressor pulls them
towards zero however many lines there are. What that does is estimated and reported; maximum likelihood has
none of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from scipy.special import chdtrc

from fitting.data import Data
from fitting.entries import diagonals, names, split
from fitting.laws import LAWS
from fitting.likelihood import Likelihood, Model
from fitting.model import state_matrix
from fitting.solve import MISFIT_P, Fit, degrees, entry_scale, from_roots, roots_of
from stapeskit.arrays import Array, ComplexArray

_MARGIN = 5e-7  # of the stability constraint, scaled
_LAW_VALUES = 24  # of an exponent or a time that are tried before the search


def estimate(
    data: Data, model: Model, constrained: bool, lower: Mapping[str, float], upper: Mapping[str, float]
) -> tuple[Fit, Array, tuple[str, ...]]:
    """Estimate K and D by least squares: rows in SI (pinv), or balanced by mass (constrained).

    Parameters
    ----------
    constrained : bool
        Keep signs, ranges (lower, upper, SI) and stability: of the eigenvalues (paper), of laws that are not
        viscous by positive semidefinite K and D, which is sufficient for it.

    Returns
    -------
    fit, bias, active
        With the covariance by noise and by the shared errors, which are not estimated; what noise of the
        regressor does to K and D, scaled, (p,); and what holds the estimate back.
    """
    likelihood = Likelihood(data, model)
    entries, law, theta = likelihood.at["entries"], likelihood.at["law"], likelihood.mean.copy()
    weights = np.ones(likelihood.n)
    if not constrained:  # rows in SI, as the paper has them
        weights = likelihood.row_units @ data.root_mass
        weights = weights / weights.max()
    if law.start < law.stop:
        theta[law] = _law_value(likelihood, weights)
    matrix, wanted = _regression(likelihood, theta, weights)
    free, _ = _least_squares(matrix, wanted)
    active: tuple[str, ...] = ()
    if constrained:
        free, active = _constrained(matrix, wanted, free, likelihood, lower, upper)
    theta[entries] = free
    return *_spread(likelihood, theta, weights), active


def _regression(likelihood: Likelihood, theta: Array, weights: Array) -> tuple[Array, Array]:
    """Return A and b of the equation error |A p - b| of K and D, with the law at theta."""
    y, rest = likelihood.data.y[:, :, None], theta.copy()
    rest[likelihood.at["entries"]] = 0.0
    columns = (weights[:, None] * likelihood.entry_slopes(theta, y))[..., 0]
    constant = -(weights[:, None] * likelihood.act(rest, y))[..., 0]
    return _real_rows(columns), _real_rows(constant[None])[:, 0]


def _real_rows(columns: ComplexArray) -> Array:
    """Return columns of the equations (k, lines, n) as real rows (2 lines n, k): real parts first."""
    flat = columns.reshape(len(columns), -1).T
    return np.concatenate([flat.real, flat.imag])


def _least_squares(matrix: Array, wanted: Array) -> tuple[Array, float]:
    """Return the solution and the sum of squares that it leaves."""
    size = np.linalg.norm(matrix, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    solution = np.linalg.lstsq(matrix / size, wanted, rcond=1e-13)[0] / size
    return solution, float(np.sum((matrix @ solution - wanted) ** 2))


def _law_value(likelihood: Likelihood, weights: Array) -> float:
    """Return the unknown of the damping law with the least equation error, K and D free at each value.

    The equations are linear in all others (variable projection, Golub and Pereyra 1973,
    doi:10.1137/0710036). With constraints too it is that of free K and D.
    """
    from scipy.optimize import minimize_scalar

    kind, theta = LAWS[likelihood.model.law], likelihood.mean.copy()

    def left(value: float) -> float:
        theta[likelihood.at["law"]] = value
        return _least_squares(*_regression(likelihood, theta, weights))[1]

    grid = np.linspace(0.0, kind.usual + 2.0 * kind.usual_sd, _LAW_VALUES + 1)[1:]
    best = min(range(len(grid)), key=lambda place: left(float(grid[place])))
    ends = grid[best - 1] if best else 0.0, grid[min(best + 1, len(grid) - 1)]
    return float(minimize_scalar(left, bounds=ends, method="bounded", options={"xatol": 1e-6}).x)


def _spread(likelihood: Likelihood, theta: Array, weights: Array) -> tuple[Fit, Array]:
    """Return the estimate with its covariance and the bias by noise in the regressor.

    Residuals have the covariance B C B^H; with an inverse A+ of A the estimate moves by -A+ times theirs.
    Where chi2 contradicts the stated noise, each line's own residuals are used instead of it, since a few
    loud lines dominate an unweighted estimate (jackknife, doi:10.1016/0304-4076(85)90158-7).
    """
    data, known = likelihood.data, slice(0, likelihood.at["law"].stop)
    slopes = _real_rows((weights[:, None] * likelihood.slopes(theta, data.y[:, :, None]))[..., 0])
    matrix = slopes[:, known]
    inverse = np.linalg.pinv(matrix, rcond=1e-12)
    half = inverse.shape[1] // 2
    whole = (inverse[:, :half] - 1j * inverse[:, half:]).reshape(len(inverse), data.count, -1)
    operator = weights[:, None] * likelihood.act(theta, np.eye(data.y.shape[1], dtype=complex)[None])
    noise = operator @ data.covariance @ operator.conj().swapaxes(1, 2)
    own = 0.5 * np.einsum("pli,lij,qlj->pq", whole, noise, whole.conj()).real
    chi2 = 2.0 * float(np.sum(np.abs(likelihood.look(theta)[0]) ** 2))
    n_dof = degrees(likelihood)
    if n_dof > 0 and chdtrc(n_dof, chi2) < MISFIT_P:
        residuals = (operator @ data.y[:, :, None])[..., 0]
        own = _left_out_one_by_one(matrix, np.asarray(inverse), np.stack([residuals.real, residuals.imag]))
    shared = likelihood.at["shared"]
    gain = -inverse @ slopes[:, shared]
    covariance = np.zeros((likelihood.count, likelihood.count))
    covariance[known, known] = own + gain @ gain.T
    covariance[known, shared], covariance[shared, known] = gain, gain.T
    covariance[shared, shared] = np.eye(len(data.sources))
    found = Fit(likelihood, theta, chi2, n_dof, 1, True, covariance, own)
    return found, _bias(likelihood, theta, matrix, weights)


def _left_out_one_by_one(matrix: Array, inverse: Array, residuals: Array) -> Array:
    """Return the covariance of A+ b by what each line's absence changes (MacKinnon and White 1985).

    Parameters
    ----------
    residuals : ndarray, (2, lines, n)
        Real and imaginary parts.
    """
    _, lines, n = residuals.shape
    rows = matrix.reshape(2, lines, n, -1).transpose(1, 0, 2, 3).reshape(lines, 2 * n, -1)
    back = inverse.reshape(-1, 2, lines, n).transpose(2, 0, 1, 3).reshape(lines, -1, 2 * n)
    own = residuals.transpose(1, 0, 2).reshape(lines, 2 * n, 1)
    changes = (back @ np.linalg.solve(np.eye(2 * n) - rows @ back, own))[..., 0]
    return np.asarray(changes.T @ changes)


def _bias(likelihood: Likelihood, theta: Array, matrix: Array, weights: Array, rounds: int = 6) -> Array:
    """Return what noise of the regressor does to K and D: -(A^T A)^-1 sum of Re tr(B C dB_k^H).

    It is taken at the estimate without its bias, found in a few rounds; the law is taken along.
    """
    data, known = likelihood.data, matrix.shape[1]
    bare = Likelihood(data.without_errors(), likelihood.model)
    every = np.eye(data.y.shape[1], dtype=complex)[None].repeat(data.count, 0)
    information = matrix.T @ matrix
    bias = np.zeros(known)
    for _ in range(rounds):
        point = theta[:known] - bias
        operator = weights[:, None] * bare.act(point, every)
        slopes = weights[:, None] * bare.slopes(point, every)
        pull = np.einsum("lij,ljk,plik->p", operator, data.covariance, slopes.conj(), optimize=True).real
        bias = -np.linalg.lstsq(information, pull, rcond=1e-13)[0]
    return np.asarray(bias[likelihood.at["entries"]])


def _constrained(
    matrix: Array,
    wanted: Array,
    free: Array,
    likelihood: Likelihood,
    lower: Mapping[str, float],
    upper: Mapping[str, float],
) -> tuple[Array, tuple[str, ...]]:
    """Return the estimate within signs, ranges and stability, and what holds it back."""
    n, labels = likelihood.n, names(likelihood.n)
    scale = entry_scale(Fit(likelihood, likelihood.mean, 0.0, 1, 0, True))
    low, high = np.full(len(free), -np.inf), np.full(len(free), np.inf)
    low[diagonals(n)] = 0.0
    for limits, bounds in ((low, lower), (high, upper)):
        for name, value in bounds.items():
            limits[labels.index(name)] = value / scale[labels.index(name)]
    viscous = likelihood.model.law == "viscous"
    stability = partial(_stability, likelihood.row_units @ likelihood.data.mass @ likelihood.row_units.T)
    semidefinite = all(np.linalg.eigvalsh(part)[0] >= -1e-12 for part in split(free, n))
    if np.all((free >= low) & (free <= high)) and (stability(free) >= 0.0 if viscous else semidefinite):
        return free, ()
    nearest, guess = _semidefinite(matrix, wanted, free, n, low, high), np.zeros(len(free))
    guess[diagonals(n)] = np.repeat([1.0, 0.3], n)
    best = _stable(matrix, wanted, (nearest, guess, free), stability, low, high) if viscous else None
    held = nearest if best is None else best
    at_bound = (held <= low + 1e-9) | (held >= high - 1e-9)
    active = [f"{labels[place]} at its bound" for place in np.flatnonzero(at_bound)]
    if best is not None:
        return best, (*active, *(["stability"] if stability(best) < 1e-6 else []))
    if viscous:
        active.append("positive semidefinite K and D (no stable minimum was found from three starts)")
    for word, part in zip(("stiffness_psd", "damping_psd"), split(held, n), strict=True):
        values = np.linalg.eigvalsh(part)
        active += [word] if values[0] < 1e-6 * values[-1] else []
    return held, tuple(active)


def _stability(mass: Array, p: Array) -> float:
    """Return how far the eigenvalues are from growing motion, scaled: positive where none grows."""
    return float(-np.linalg.eigvals(state_matrix(mass, *split(p, len(mass)))).real.max()) - _MARGIN


def _stable(
    matrix: Array,
    wanted: Array,
    starts: Sequence[Array],
    stability: Callable[[Array], float],
    low: Array,
    high: Array,
) -> Array | None:
    """Return the least equation error of a stable model within bounds, from some starts; None without one."""
    from scipy.optimize import minimize

    whole = max(float(wanted @ wanted), 1e-300)
    found = []
    for start in starts:
        end = minimize(
            lambda p: float(np.sum((matrix @ p - wanted) ** 2)) / whole,
            np.clip(start, low, high),
            jac=lambda p: 2.0 * matrix.T @ (matrix @ p - wanted) / whole,
            bounds=list(zip(low, high, strict=True)),
            constraints={"type": "ineq", "fun": stability},
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 500},
        ).x
        inside = np.all((end >= low - 1e-9) & (end <= high + 1e-9))
        found += [end] if inside and stability(end) > -1e-8 else []
    return min(found, key=lambda p: float(np.sum((matrix @ p - wanted) ** 2))) if found else None


def _semidefinite(matrix: Array, wanted: Array, free: Array, n: int, low: Array, high: Array) -> Array:
    """Return the minimum with positive semidefinite K, D (Cholesky), from two starts; bounds by a penalty."""
    from scipy.optimize import least_squares

    weight = 1e3 * np.linalg.norm(wanted)

    def residual(roots: Array) -> Array:
        entries = from_roots(roots, n)[0]
        over = np.clip(entries, low, high) - entries
        return np.concatenate([matrix @ entries - wanted, weight * np.where(np.isfinite(over), over, 0.0)])

    found = [
        least_squares(residual, roots_of(free, n, floor), x_scale="jac", ftol=1e-12, xtol=1e-12, gtol=1e-12)
        for floor in (1e-2, 0.3)
    ]
    return from_roots(min(found, key=lambda one: one.cost).x, n)[0]
