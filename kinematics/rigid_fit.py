"""Weighted least squares of a rigid motion at every line, with covariance, residuals and leverage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinematics.beams import BeamSet

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
HUBER_TUNING = 2.0
T_FREEDOM = 4.0
_SINGULAR = 1e-9
_ITERATIONS = 60


@dataclass(frozen=True)
class LineFit:
    """The fit of one body in one run.

    Attributes
    ----------
    beams : BeamSet
    q : ndarray, (freq, m), complex
        NaN at lines whose channels do not determine it.
    covariance : ndarray, (freq, m, m)
        Complex covariance E[dq dq^H], which is real here; channel noise only.
    residual : ndarray, (channel, freq), complex
        Measured minus fitted, m; zero where missing.
    sd : ndarray, (channel, freq)
        Standard deviation of the real part used, m; infinite where missing.
    weights : ndarray, (channel, freq)
        1 / (2 sd^2), times the robust weight.
    inverse : ndarray, (freq, m, m)
        Inverse Gram matrix of the weighted fit in the orthonormal basis.
    chi2 : ndarray, (freq,)
        Sum of |residual / sd|^2; NaN where q is.
    n_dof : ndarray, (freq,), int
        2 (channels - m).
    robust_loss : float
        Factor by which a robust estimate widened the covariance; 1 without.
    """

    beams: BeamSet
    q: ComplexArray
    covariance: Array
    residual: ComplexArray
    sd: Array
    weights: Array
    inverse: Array
    chi2: Array
    n_dof: NDArray[np.int64]
    robust_loss: float = 1.0

    def leverage(self) -> Array:
        """Return the diagonal of the weighted hat matrix, (channel, freq)."""
        basis = self.beams.basis
        return np.asarray(
            self.weights * np.einsum("ca,fab,cb->cf", basis, self.inverse, basis, optimize=True)
        )


def fit_lines(beams: BeamSet, value: ComplexArray, sd: Array, robust: str = "none") -> LineFit:
    """Fit the motion of one body at all lines.

    Parameters
    ----------
    beams : BeamSet
    value : ndarray, (channel, freq), complex
        Displacement along the beams, m; NaN where missing.
    sd : ndarray, (channel, freq)
        Standard deviation of its real part, m; positive, NaN or infinite where the value is not to be used.
    robust : str
        ``none``, ``huber`` or ``t4``: iteratively reweighted by the normalised size of each complex
        residual.

    Notes
    -----
    The columns were made dimensionless and orthonormal beforehand (BeamSet), so the Gram matrices of single
    lines are as well conditioned as their weights allow, and one step of refinement restores the accuracy
    of an orthogonal factorisation. The covariance of a robust fit is that of least squares
    times the factor of _loss, pooled over lines.
    """
    used = np.isfinite(value.real) & np.isfinite(value.imag) & np.isfinite(sd)
    y = np.where(used, value, 0.0)
    spread = np.where(used, sd, np.inf)
    base = np.where(used, 0.5 / np.where(used, sd, 1.0) ** 2, 0.0)
    z, inverse, good = _solve(beams.basis, y, base)
    weights, loss = base, 1.0
    if robust != "none":
        weights, z, inverse, good, loss = _reweighted(beams.basis, y, base, spread, z, robust)
        base_inverse = _solve(beams.basis, y, base)[1]
    else:
        base_inverse = inverse
    residual = np.where(used, y - beams.basis @ z, 0.0)
    q = (beams.to_dof @ z).T
    q[~good] = np.nan
    covariance = beams.to_dof @ base_inverse @ beams.to_dof.T * loss
    covariance[~good] = np.nan
    with np.errstate(invalid="ignore"):
        chi2 = np.sum(np.abs(residual / spread) ** 2, axis=0)
    chi2[~good] = np.nan
    n_dof = np.where(good, 2 * (used.sum(axis=0) - beams.basis.shape[1]), 0)
    return LineFit(beams, q, covariance, residual, spread, weights, inverse, chi2, n_dof, loss)


def _solve(basis: Array, y: ComplexArray, weights: Array) -> tuple[ComplexArray, Array, NDArray[np.bool_]]:
    """Return coefficients (m, freq), inverse Gram matrices (freq, m, m), and which lines are determined."""
    size = basis.shape[1]
    scale = np.max(weights, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    relative = weights / scale
    if _same_everywhere(relative):
        gram = (basis.T * relative[:, 0]) @ basis
        good = np.full(y.shape[1], _determined(gram[None])[0])
        small = np.linalg.inv(gram) if good[0] else np.eye(size)
        z = small @ (basis.T * relative[:, 0]) @ y
        z += small @ (basis.T * relative[:, 0]) @ (y - basis @ z)
        return z, small / scale[:, None, None], good
    pairs = np.triu_indices(size)
    packed = (basis[:, pairs[0]] * basis[:, pairs[1]]).T @ relative
    grams = np.empty((y.shape[1], size, size))
    grams[:, pairs[0], pairs[1]] = packed.T
    grams[:, pairs[1], pairs[0]] = packed.T
    good = _determined(grams)
    grams[~good] = np.eye(size)
    inverse = np.linalg.inv(grams)
    z = np.einsum("fab,bf->af", inverse, basis.T @ (relative * y), optimize=True)
    z += np.einsum("fab,bf->af", inverse, basis.T @ (relative * (y - basis @ z)), optimize=True)
    return z, inverse / scale[:, None, None], good


def _same_everywhere(relative: Array) -> bool:
    return bool(np.all(relative == relative[:, :1]))


def _determined(grams: Array) -> NDArray[np.bool_]:
    values = np.linalg.eigvalsh(grams)
    return np.asarray(values[:, 0] > _SINGULAR * np.maximum(values[:, -1], 1e-300))


def robust_weight(size: Array, kind: str) -> tuple[Array, Array]:
    """Return u(|e|) and d(|e| u)/d|e| for two-dimensional residuals e in units of sd.

    ``huber``: u = min(1, k / |e|), k = 2. ``t4``: Student's t with 4 degrees of freedom,
    u = 6 / (4 + |e|^2) (Lange, Little and Taylor 1989, doi:10.1080/01621459.1989.10478852).
    """
    if kind == "huber":
        with np.errstate(divide="ignore"):
            u = np.minimum(1.0, HUBER_TUNING / size)
        return u, np.where(size <= HUBER_TUNING, 1.0, 0.0)
    u = (T_FREEDOM + 2.0) / (T_FREEDOM + size**2)
    return u, u * (T_FREEDOM - size**2) / (T_FREEDOM + size**2)


def _reweighted(
    basis: Array, y: ComplexArray, base: Array, sd: Array, z: ComplexArray, kind: str
) -> tuple[Array, ComplexArray, Array, NDArray[np.bool_], float]:
    used = base > 0.0
    weights, inverse, good = base, np.empty(0), np.empty(0, dtype=bool)
    for _ in range(_ITERATIONS):
        size = np.abs(y - basis @ z) / sd
        u, _along = robust_weight(size, kind)
        weights = base * u
        new, inverse, good = _solve(basis, y, weights)
        step = np.sqrt(np.max(np.abs((new - z) * np.sqrt(1.0 / np.maximum(inverse[:, 0, 0], 1e-300)))))
        z = new
        if step < 1e-4:
            break
    used &= good
    size = np.abs(y - basis @ z)[used] / sd[used]
    share = basis.shape[1] * int(np.sum(good)) / max(size.size, 1)
    return weights, z, inverse, good, _loss(size, share, kind) if 0.0 < share < 0.95 else 1.0


def _loss(size: Array, share: float, kind: str) -> float:
    """Return the variance of a robust estimate over that of weighted least squares without outliers.

    Parameters
    ----------
    size : ndarray, (n,)
        |residual| / sd of the robust fit.
    share : float
        Coefficients per complex value.

    Notes
    -----
    El Karoui et al. 2013, doi:10.1073/pnas.1307842110: with many coefficients per value the residuals are
    proximal images of the errors; c is the size of that contraction, found from mean(c psi' / (1 + c psi'))
    = share. Here for residuals in the plane, whose psi' differs along and across the residual.
    """
    u, along = robust_weight(size, kind)
    low, high = 0.0, 1e3
    for _ in range(80):
        c = 0.5 * (low + high)
        taken = 0.5 * np.mean(c * along / (1.0 + c * along) + c * u / (1.0 + c * u))
        low, high = (c, high) if taken < share else (low, c)
    return float(c**2 * np.mean((u * size) ** 2) / 2.0 * (1.0 - share) / share**2)


def pooled_scale(chi2: Array, n_dof: NDArray[np.int64], level: Array, want: int = 400) -> Array:
    """Return the noise factor (freq,) that neighbouring lines show together.

    Parameters
    ----------
    chi2, n_dof : ndarray, (freq,)
        With relative sd; lines that are not determined count nothing.
    level : ndarray, (freq,)
        How the noise is expected to run over frequency; the ratio to it is pooled.
    want : int
        Degrees of freedom to pool at each line, so that the factor is known to about 1 / sqrt(2 want).
    """
    good = np.isfinite(chi2) & (n_dof > 0)
    total = int(np.sum(n_dof[good]))
    if total == 0:
        return np.full(len(chi2), np.nan)
    lines = len(chi2)
    width = min(lines, max(1, int(np.ceil(want / (total / lines)))))
    sums = np.concatenate([[0.0], np.cumsum(np.where(good, chi2 / level**2, 0.0))])
    counts = np.concatenate([[0], np.cumsum(np.where(good, n_dof, 0))])
    start = np.clip(np.arange(lines) - width // 2, 0, lines - width)
    number = np.maximum(counts[start + width] - counts[start], 1)
    factor = np.sqrt((sums[start + width] - sums[start]) / number)
    return np.asarray(factor * level)
