"""Weighted least squares of a rigid motion at every line, with covariance, residuals and leverage."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.fit import symmetric_batches
from legacy.kinematics.fit.beams import BeamSet
from legacy.kinematics.fit.line_noise import LineNoise, Lines, blocks, part_of
from legacy.kinematics.fit.line_solver import solve
from legacy.kinematics.fit.line_sums import Solution
from legacy.kinematics.fit.robust_fit import robust_solve, robust_weight
from legacy.stapeskit.arrays import Array, ComplexArray

Channels = slice | NDArray[np.bool_]
_WHOLE = slice(None)
# Values up to which whole arrays are kept instead of blocks: 16 MB.
_SMALL = 1_000_000
# Degrees of freedom pooled at each line: the factor is known to 1 / sqrt(2 * 400), 3.5 %.
_POOLED_DOF = 400


@dataclass(frozen=True)
class LineFit:
    """The fit of one body in one run.

    Residuals, standard deviations and weights of all channels and lines are as large as the data: they are
    made when asked for. ``blocks`` and ``at`` give them piece by piece.

    Attributes
    ----------
    beams : BeamSet
    q : ndarray, (freq, m), complex
        NaN at lines whose channels do not determine it.
    covariance : ndarray, (freq, m, m)
        Complex covariance E[dq dq^H], which is real here; channel noise only.
    chi2 : ndarray, (freq,)
        Sum of |residual / sd|^2; NaN where q is.
    n_dof : ndarray, (freq,), int
        2 (channels - m).
    value : ndarray, (channel, freq), complex
        The data that were fitted, m; not a copy.
    noise : LineNoise
    solution : Solution
        Coefficients and sums per channel.
    robust : str
    iterations : int
        Most iterations that a line took; 0 without a robust estimate.
    unsettled : int
        Lines at which the robust fit had not settled.
    """

    beams: BeamSet
    q: ComplexArray
    covariance: Array
    chi2: Array
    n_dof: NDArray[np.int64]
    value: ComplexArray
    noise: LineNoise
    solution: Solution
    robust: str = "none"
    iterations: int = 0
    unsettled: int = 0

    @property
    def complete(self) -> bool:
        """Whether every channel was used at every line."""
        return bool(np.all(self.solution.count == len(self.beams.rows)))

    @property
    def common(self) -> tuple[Array, Array] | None:
        """Noise per channel, at most 1, and per line, m, whose products are all sd; None if no such."""
        return self.noise.common()

    def at(self, lines: Lines, channels: Channels = _WHOLE) -> tuple[ComplexArray, Array, Array]:
        """Return residual, sd and weights, each (channel, n), of some lines and channels.

        ``residual`` is zero and ``sd`` infinite where missing; the weights are 1 / (2 sd^2), times the
        robust weight.
        """
        value, sd = part_of(self.value, lines, channels), self.noise.at(lines, channels)
        used = np.isfinite(value) & np.isfinite(sd)
        residual = np.where(used, value - self.beams.basis[channels] @ self.solution.z[:, lines], 0.0)
        sd = np.where(used, sd, np.inf)
        weights = 0.5 / sd**2
        if self.robust != "none":
            weights = weights * robust_weight(np.abs(residual) / sd, self.robust)[0]
        return residual, sd, weights

    def blocks(self, channels: Channels = _WHOLE) -> Iterator[tuple[slice, ComplexArray, Array, Array]]:
        """Yield lines, residual, sd and weights of ``at``, piece by piece."""
        for part in blocks(*self.value.shape):
            yield part, *self.at(part, channels)

    @property
    def residual(self) -> ComplexArray:
        """Measured minus fitted, (channel, freq), m; zero where missing."""
        return self._kept_arrays[0] if self.value.size <= _SMALL else self.at(_WHOLE)[0]

    @cached_property
    def _kept_arrays(self) -> tuple[ComplexArray, Array, Array]:
        return self.at(_WHOLE)

    @property
    def sd(self) -> Array:
        """Standard deviation of the real part used, (channel, freq), m; infinite where missing."""
        if self.value.size <= _SMALL:
            return self._kept_arrays[1]
        sd = np.array(self.noise.at(_WHOLE))
        sd[~(np.isfinite(self.value) & np.isfinite(sd))] = np.inf
        return sd

    @property
    def weights(self) -> Array:
        """1 / (2 sd^2), times the robust weight, (channel, freq)."""
        return self._kept_arrays[2] if self.value.size <= _SMALL else self.at(_WHOLE)[2]

    @property
    def inverse(self) -> Array:
        """Inverse Gram matrix of the weighted fit in the orthonormal basis, (freq, m, m)."""
        return symmetric_batches.unpack(self.solution.inverse, len(self.beams.dof))

    @property
    def channel_rms(self) -> Array:
        """Root mean square of |residual| over the lines, (channel,), m; NaN where no line was used."""
        used = self.solution.used
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.where(used > 0, np.sqrt(self.solution.energy / used), np.nan))

    @property
    def channel_weight(self) -> Array:
        """Mean weight of each channel relative to the strongest of each line, (channel,)."""
        lines = max(int(np.sum(self.solution.good)), 1)
        return np.asarray(self.solution.weight / lines)

    @property
    def channel_energy(self) -> Array:
        """Residual energy of each channel over that of its stated noise, corrected for leverage, (channel,).

        Notes
        -----
        Under the stated noise the residual of channel c has the variance sd^2 (1 - h_c) in each part, with
        h the diagonal of the weighted hat matrix, so that the mean of this ratio is 1. NaN where a channel
        has no redundancy.
        """
        out = self.solution
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.where(out.freedom > 1e-9, out.scaled / out.freedom, np.nan))

    def leverage(self, lines: Lines = _WHOLE) -> Array:
        """Return the diagonal of the weighted hat matrix, (channel, n), at some lines."""
        basis, inverse = self.beams.basis, self.solution.inverse
        rows = symmetric_batches.products(basis) * symmetric_batches.doubled(basis.shape[1])
        return np.asarray(self.at(lines)[2] * (rows @ inverse[:, lines]))

    def is_rounding(self, share: float = 1e-8) -> bool:
        """Return whether the residuals are rounding errors only, so that they are no measure of noise."""
        left = float(np.sum(self.solution.misfit))
        return left <= share**2 * (left + float(np.sum(self.solution.explained)))

    def rescaled(self, factor: Array, floor: Array | None) -> LineFit:
        """Return the fit for noise that is ``factor`` (freq,) times as large at all channels of a line.

        ``floor`` (freq,) is the least sd in m; it may bind only where all channels of a line are alike.
        """
        before = self.noise.at(_WHOLE, slice(0, 1))[0]
        stated = LineNoise(self.noise.stated, self.noise_factor(factor), floor)
        with np.errstate(invalid="ignore", divide="ignore"):
            change = (stated.at(_WHOLE, slice(0, 1))[0] / before) ** 2
        change = np.where(np.isfinite(change), change, 1.0)
        return replace(
            self,
            covariance=self.covariance * change[:, None, None],
            chi2=self.chi2 / change,
            noise=stated,
            solution=self.solution.rescaled(change),
        )

    def noise_factor(self, factor: Array) -> Array:
        """Return the factor per line of the stated noise, times another."""
        return factor if self.noise.factor is None else self.noise.factor * factor


def fit_lines(
    beams: BeamSet,
    value: ComplexArray,
    sd: Array,
    robust: str = "none",
    *,
    factor: Array | None = None,
    floor: Array | None = None,
) -> LineFit:
    """Fit the motion of one body at all lines.

    Parameters
    ----------
    beams : BeamSet
    value : ndarray, (channel, freq), complex
        Displacement along the beams, m; NaN where missing.
    sd : ndarray, broadcastable to (channel, freq)
        Standard deviation of its real part, m; positive, NaN or infinite where the value is not to be used.
    robust : str
        ``none``, ``huber`` or ``t4``: each complex residual is weighted by its normalised size; iterated
        until no line moves by more than 1e-6 of its standard deviation.
    factor : ndarray, (freq,), optional
        Multiplies ``sd``.
    floor : ndarray, (freq,), optional
        Least standard deviation, m.

    Notes
    -----
    The columns were made dimensionless and orthonormal beforehand (BeamSet). Lines whose channels keep the
    ratios of their noise share one orthogonal factorisation; the others have Gram matrices of the orthonormal
    columns, refined once where their condition asks for it, and an orthogonal factorisation of their own
    where it passes 1e7. The covariance of a robust fit is that of least squares times the factor of
    robust_fit.loss, pooled over lines.
    """
    stated = np.broadcast_to(np.asarray(sd, dtype=float), value.shape)
    return fit_noise(beams, value, LineNoise(stated, factor, floor), robust)


def fit_noise(beams: BeamSet, value: ComplexArray, noise: LineNoise, robust: str = "none") -> LineFit:
    """Fit the motion of one body at all lines with a given noise; see fit_lines."""
    if robust == "none":
        solution, inverse, loss, turns, unsettled = solve(beams.basis, value, noise), None, 1.0, 0, 0
    else:
        solution, inverse, loss, turns, unsettled = robust_solve(beams.basis, value, noise, robust)
    size = len(beams.dof)
    good = solution.good
    q = np.ascontiguousarray((beams.to_dof @ solution.z.view(float)).view(complex).T)
    q[~good] = np.nan
    base = solution.inverse if inverse is None else inverse
    covariance = symmetric_batches.transformed(np.sqrt(loss) * beams.to_dof, base)
    covariance[~good] = np.nan
    chi2 = np.where(good, solution.misfit, np.nan)
    n_dof = np.where(good, 2 * (solution.count - size), 0)
    return LineFit(beams, q, covariance, chi2, n_dof, value, noise, solution, robust, turns, unsettled)


def refit(beams: BeamSet, fit: LineFit) -> LineFit:
    """Fit the same data with other degrees of freedom and the same noise, by least squares."""
    return fit_noise(beams, fit.value, fit.noise)


def pooled_scale(chi2: Array, n_dof: NDArray[np.int64], level: Array) -> Array:
    """Return the noise factor (freq,) that neighbouring lines show together.

    Parameters
    ----------
    chi2, n_dof : ndarray, (freq,)
        With relative sd; lines that are not determined count nothing.
    level : ndarray, (freq,)
        How the noise is expected to run over frequency; the ratio to it is pooled.
    """
    good = np.isfinite(chi2) & (n_dof > 0)
    total = int(np.sum(n_dof[good]))
    if total == 0:
        return np.full(len(chi2), np.nan)
    lines = len(chi2)
    width = min(lines, max(1, int(np.ceil(_POOLED_DOF / (total / lines)))))
    sums = np.concatenate([[0.0], np.cumsum(np.where(good, chi2 / level**2, 0.0))])
    counts = np.concatenate([[0], np.cumsum(np.where(good, n_dof, 0))])
    start = np.clip(np.arange(lines) - width // 2, 0, lines - width)
    number = np.maximum(counts[start + width] - counts[start], 1)
    factor = np.sqrt((sums[start + width] - sums[start]) / number)
    return np.asarray(factor * level)
