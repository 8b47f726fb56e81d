"""Find the minimum of the likelihood: starts, the noise level, robust weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from fitting.data import Data
from fitting.entries import basis, split, symmetric, vector
from fitting.laws import DampingLaw
from fitting.likelihood import Likelihood, Model
from stapeskit.arrays import Array

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

MISFIT_P = 1e-4
"""Probability of chi2 below which noise and shared errors do not explain the data."""

_STUDENT = 4.0  # degrees of freedom of the robust weights (Lange, Little and Taylor 1989)


@dataclass(frozen=True)
class Fit:
    """A minimum with its covariance."""

    likelihood: Likelihood  # with the noise level at which it was found
    theta: Array  # (p,)
    chi2: float  # with the noise as stated, priors and shared errors included
    n_dof: int  # 2 n lines less the unknowns without a prior
    evaluations: int
    converged: bool
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)  # (p, p)
    # (p, p): inverse of what the data and priors know of theta
    inverse: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)

    @property
    def noise(self) -> float:
        """Variance of the noise over that stated."""
        return self.likelihood.noise

    @property
    def data(self) -> Data:
        """What was fitted."""
        return self.likelihood.data

    @property
    def at(self) -> dict[str, slice]:
        """Places of the parameters by their kind."""
        return self.likelihood.at

    @property
    def weights(self) -> Array | None:
        """Robust weights of the lines."""
        return self.likelihood.weights

    @property
    def level(self) -> float:
        """Chi2 per degree of freedom."""
        return self.chi2 / max(self.n_dof, 1)

    @property
    def p_value(self) -> float:
        """Probability of such a chi2, or a larger one, when model, noise and shared errors are as stated."""
        from scipy.special import chdtrc

        return float(chdtrc(self.n_dof, self.chi2)) if self.n_dof > 0 else 1.0

    @property
    def explained(self) -> bool:
        """Whether noise, shared errors and priors explain the data."""
        return self.weights is not None or self.p_value > MISFIT_P

    @property
    def quiet(self) -> bool:
        """Whether residuals are smaller than their stated noise."""
        from scipy.special import chdtr

        return self.n_dof > 0 and float(chdtr(self.n_dof, self.chi2)) < MISFIT_P

    @property
    def distances(self) -> Array:
        """Squared distances (lines,) of the lines from the model; of a robust fit those of its weights."""
        if self.weights is None:
            return np.asarray(2.0 * np.sum(np.abs(self.likelihood.look(self.theta)[0]) ** 2, axis=1))
        return (_STUDENT + 2 * self.likelihood.n) / self.weights - _STUDENT

    @property
    def usual_level(self) -> float:
        """Chi2 per degree of freedom; of a robust fit that of most lines, by the median of chi2."""
        from scipy.special import chdtri

        if self.weights is None:
            return self.level
        return float(np.median(self.distances)) / float(chdtri(2 * self.likelihood.n, 0.5))

    @property
    def law(self) -> DampingLaw:
        """The damping law, SI."""
        values = self.theta[self.at["law"]]
        law = DampingLaw(self.likelihood.model.law, float(values[0]) if len(values) else 0.0)
        return law.scaled(1.0 / self.data.reference)


def start_of(likelihood: Likelihood, theta: Array | None = None, rounds: int = 3) -> Array:
    """Return theta with K and D from weighted linear least squares: the equations are linear in them."""
    n = likelihood.n
    entries = likelihood.at["entries"]
    if theta is None:
        theta = likelihood.mean.copy()
        theta[entries] = np.tile(vector(np.eye(n)), 2)
    y = likelihood.data.y[:, :, None]
    for _ in range(rounds):
        half = theta.copy()
        half[entries] = 0.0
        rows = likelihood.white(theta, likelihood.entry_slopes(theta, y))
        wanted = -likelihood.white(theta, likelihood.act(half, y)[None])[:, 0]
        size = np.linalg.norm(rows, axis=0)
        size = np.where(size > 0.0, size, 1.0)
        theta = theta.copy()
        theta[entries] = np.linalg.lstsq(rows / size, wanted, rcond=1e-12)[0] / size
    return theta


def roots_of(entries: Array, n: int, floor: float = 1e-3) -> Array:
    """Return the Cholesky factors (entries) of the nearest positive definite K and D."""
    factors = []
    for part in split(entries, n):
        values, vectors = np.linalg.eigh(part)
        near = (vectors * np.maximum(values, floor * max(values[-1], 1e-9))) @ vectors.T
        factors.append(vector(np.linalg.cholesky(near).T))
    return np.concatenate(factors)


def from_roots(roots: Array, n: int) -> tuple[Array, Array]:
    """Return K = L L^T and D likewise, which are positive semidefinite, and their derivative by the roots."""
    half = len(roots) // 2
    lower = np.tril(np.ones((n, n)))
    entries, slopes = [], []
    for part in (roots[:half], roots[half:]):
        factor = symmetric(part, n) * lower
        entries.append(vector(factor @ factor.T))
        steps = basis(n) * lower
        slopes.append(vector(steps @ factor.T + factor @ steps.swapaxes(1, 2)).T)
    return np.concatenate(entries), block_diag(*slopes)


def _curvature(gradient: Array, n: int) -> Array:
    """Return rows of the Jacobian for the curvature that the factors bring in, (2 n^2, n (n + 1)).

    With G the gradient by K, K = L L^T adds tr(G dL dL^T), which first derivatives of the residuals miss.
    Where the data pull K or D to the limit of semidefinite matrices it is all the curvature that there is:
    without it steps are far too long, and the descent creeps. Positive parts of G are taken.
    """
    steps = basis(n) * np.tril(np.ones((n, n)))
    rows = []
    for part in split(gradient, n):
        slopes = 0.5 * (part + np.diag(np.diag(part)))  # an entry off the diagonal is in two places
        values, vectors = np.linalg.eigh(slopes)
        root = np.sqrt(2.0 * np.maximum(values, 0.0))[:, None] * vectors.T
        rows.append((root @ steps).reshape(len(steps), -1).T)
    return block_diag(*rows)


def minimise(
    likelihood: Likelihood, theta: Array, tolerance: float = 1e-8, most: int = 60
) -> tuple[Array, float, int, bool]:
    """Return the minimum from a start, with its value (chi2), evaluations and whether it settled.

    K and D are kept positive semidefinite by their Cholesky factors. The problem is handed over in its QR
    form, of which value, gradient and Gauss-Newton matrix are those of the whole one.
    """
    from scipy.optimize import least_squares

    n, count = likelihood.n, likelihood.at["entries"].stop
    phi = theta.copy()
    phi[:count] = roots_of(theta[:count], n)
    kept: dict[bytes, tuple[Array, Array]] = {}

    def reduced(phi: Array) -> tuple[Array, Array]:
        key = phi.tobytes()
        if key not in kept:
            kept.clear()
            point = phi.copy()
            point[:count], slopes = from_roots(phi[:count], n)
            try:
                residual, jacobian = likelihood.reduced(point)
            except np.linalg.LinAlgError:
                residual, jacobian = np.full(len(phi) + 1, 1e8), np.zeros((len(phi) + 1, len(phi)))
            curved = np.zeros((2 * n * n, len(phi)))
            curved[:, :count] = _curvature(jacobian[:, :count].T @ residual, n)
            jacobian = np.vstack([jacobian, curved])
            jacobian[: len(residual), :count] = jacobian[: len(residual), :count] @ slopes
            kept[key] = np.append(residual, np.zeros(len(curved))), jacobian
        return kept[key]

    def descend(phi: Array) -> OptimizeResult:
        ends = {"ftol": tolerance, "xtol": 1e-10, "gtol": 1e-10, "max_nfev": most}
        return least_squares(lambda at: reduced(at)[0], phi, lambda at: reduced(at)[1], x_scale="jac", **ends)

    try:
        found = descend(phi)
    except np.linalg.LinAlgError:  # LAPACK's singular values by divide and conquer fail on rare matrices
        found = descend(phi * (1.0 + 1e-7))
    point = found.x.copy()
    point[:count], _ = from_roots(found.x[:count], n)
    return point, 2.0 * float(found.cost), int(found.nfev), found.status > 0


def degrees(likelihood: Likelihood) -> int:
    """Return 2 n lines less the unknowns of K, D and law."""
    free = likelihood.at["law"].stop if likelihood.model.law_value is None else likelihood.at["entries"].stop
    return 2 * likelihood.n * likelihood.data.count - (free if likelihood.model.entries is None else 0)


def fit(
    data: Data,
    model: Model,
    start: Array | None = None,
    noise: float | None = None,
    robust: bool = False,
    rough: bool = False,
) -> Fit:
    """Fit; where the data are not explained, with as much noise as there is.

    ``noise`` is where its level begins, that of a fit with fewer unknowns; ``robust`` weighs lines by
    Student's t with four degrees of freedom; a ``rough`` fit, for a comparison, has no covariance.

    Notes
    -----
    From zero and linear K, D a valley may lead away from the minimum of a model with unknowns: where the data
    are not explained, the fit without them is another start, and the smaller chi2 counts.
    """
    if robust:
        theta, _ = _begin(data, model, start, noise)
        found, spread = _robust(data, model, theta)
        return found if rough else with_covariance(found, spread)
    found = _settled(data, model, start, noise)
    if start is None and model.unknowns and not (found.converged and found.noise == 1.0):
        simpler = _settled(data, replace(model, unknowns=()))
        place = simpler.at["extra"].start
        theta = np.insert(simpler.theta, place, np.zeros(len(model.extras)))
        other = _settled(data, model, theta, simpler.noise)
        found = other if (other.converged, -other.chi2) > (found.converged, -found.chi2) else found
    return found if rough else with_covariance(found)


def _begin(data: Data, model: Model, start: Array | None, noise: float | None) -> tuple[Array, float]:
    """Return where a fit begins: theta, and the noise level of a fit without shared errors."""
    likelihood = Likelihood(data, model)
    theta = start if start is not None else best_start(likelihood)
    if noise is None:
        quick = Likelihood(data.without_errors(), model)
        bare, value, _, _ = minimise(quick, theta[: quick.count], 1e-4)
        theta = np.concatenate([bare, theta[quick.count :]])
        noise = max(1.0, value / max(degrees(likelihood), 1))
        noise = noise if noise > 1.5 else 1.0
    return theta, noise


def _settled(data: Data, model: Model, start: Array | None = None, noise: float | None = None) -> Fit:
    """Return the minimum that a start leads to, without its covariance.

    Notes
    -----
    The equations have a trivial solution, K, D and load zero, which a large misfit makes cheap. The noise
    comes down from that of a fit without shared errors until chi2 agrees with it (discrepancy principle,
    Morozov 1966).
    """
    theta, noise = _begin(data, model, start, noise)
    n_dof = degrees(Likelihood(data, model))
    evaluations = 0
    for _ in range(6):
        likelihood = Likelihood(data, model, noise)
        theta, _, used, converged = minimise(likelihood, theta, 1e-10 if noise == 1.0 else 1e-6)
        evaluations += used
        chi2 = float(np.sum(Likelihood(data, model).residuals(theta) ** 2))
        level = max(1.0, chi2 / max(n_dof, 1))
        if noise == 1.0 or 0.9 * noise < level > 1.05:
            break
        noise = level if level > 1.05 else 1.0
    return Fit(likelihood, theta, chi2, n_dof, evaluations, converged)


def _robust(data: Data, model: Model, theta: Array) -> tuple[Fit, float]:
    """Return the fit with weights (nu + d) / (nu + squared distance), and the noise of its covariance."""
    weights, used = np.ones(data.count), 0
    n_dof = degrees(Likelihood(data, model))
    for _ in range(12):
        likelihood = Likelihood(data, model, 1.0, weights)
        theta, chi2, count, converged = minimise(likelihood, theta, 1e-7)
        used += count
        white = likelihood.look(theta)[0]
        distance = 2.0 * np.sum(np.abs(white) ** 2, axis=1) / weights
        new = (_STUDENT + 2 * likelihood.n) / (_STUDENT + distance)
        settled = np.max(np.abs(new - weights)) < 1e-3
        weights = new
        if settled:
            break
    likelihood = Likelihood(data, model, 1.0, weights)
    chi2 = float(np.sum(Likelihood(data, model).residuals(theta) ** 2))
    return Fit(likelihood, theta, chi2, n_dof, used, converged), _noise_by_weights(likelihood, theta)


def _noise_by_weights(likelihood: Likelihood, theta: Array) -> float:
    """Return the noise over that stated with which the weighted information is that of the robust estimate.

    Of an estimate by psi = w r the variance is E[w^2 d] / n over E[w + 2 w' d / n]^2 times that of least
    squares with the noise as stated, d the squared distance of n residuals (Huber and Ronchetti 2009, Robust
    Statistics, ch. 8); the weighted information holds the mean weight too much.
    """
    weights, n = likelihood.weights, 2 * likelihood.n
    assert weights is not None  # noqa: S101
    square = 2.0 * weights * np.sum(np.abs(likelihood.look(theta)[0]) ** 2, axis=1)  # w^2 d
    slope = np.mean(weights - 2.0 * square / (n * (_STUDENT + n)))
    return float(max(np.mean(square) / n / slope**2, 1.0) * np.mean(weights))


def with_covariance(found: Fit, noise: float | None = None) -> Fit:
    """Add the covariance where it was left out, with the noise that the misfit shows, or another one."""
    if found.covariance.size:
        return found
    own = found.likelihood
    if noise is not None:  # the priors stay as they are
        own = Likelihood(own.data, own.model, noise, own.weights)
    factor = max(1.0, found.level) / found.noise if noise is None else 1.0
    covariance, inverse = own.covariance(found.theta, found.level)
    return replace(found, covariance=factor * covariance, inverse=factor * inverse)


def best_start(likelihood: Likelihood) -> Array:
    """Return the best of a few starts for K and D: linear least squares, and guesses for many unknowns."""
    linear = start_of(likelihood)
    if likelihood.n <= 3:
        return linear
    flat = likelihood.mean.copy()
    flat[likelihood.at["entries"]] = np.concatenate(
        [vector(np.eye(likelihood.n)), 0.1 * vector(np.eye(likelihood.n))]
    )
    values = []
    for theta in (linear, start_of(likelihood, flat, 1), flat):
        try:
            values.append(minimise(likelihood, theta, 1e-3, 15)[:2])
        except np.linalg.LinAlgError:
            continue
    return min(values, key=lambda found: found[1])[0] if values else linear


def entry_scale(found: Fit, places: Sequence[int] | None = None) -> Array:
    """Return SI over scaled of the entries of K and D of the rows of a fit, or of other measured motion."""
    data = found.data
    root = data.root_mass[data.rows if places is None else places]
    product = vector(np.outer(root, root))
    powers = (2.0, 2.0 - found.law.time_power)
    return np.concatenate([product * data.reference**power for power in powers])


def bend(found: Fit) -> Array:
    """Return S (k, p, t): changes d of theta, with errors z in it, bend K and D by -sum z_k S_k d.

    The equations are linear in K and D and bilinear in them and the shared errors: what d leaves of them in
    second order, K and D make good. A shift e of the reference point moves K44 by e K34 and by e^2 K33: where
    data are precise, the cloud of likely K is curved by more than it is thick.
    """
    likelihood, theta, at = found.likelihood, found.theta, found.at
    fitted = likelihood.look(theta)[3][:, :, None]
    here = likelihood.slopes(theta, fitted)
    inverse = np.linalg.pinv(likelihood.white(theta, here[at["entries"]]), rcond=1e-12)
    bent = [
        inverse @ likelihood.white(theta, likelihood.slopes(theta + unit, fitted) - here)
        for unit in np.eye(len(theta))[at["shared"]]
    ]
    twice = np.ones(len(theta))
    twice[at["shared"]] = 0.5  # a pair of errors is met in both orders
    return np.reshape(bent, (-1, *inverse.shape[:1], len(theta))) * twice


def bic(found: Fit, level: float) -> float:
    """Return chi2 over a level + unknowns ln(equations) (Schwarz 1978, doi:10.1214/aos/1176344136)."""
    equations = 2 * found.likelihood.n * found.data.count
    unknowns = found.likelihood.at["law"].stop + len(found.likelihood.model.unknowns)
    return float(found.chi2 / level + unknowns * np.log(equations))
