"""Estimate noise of unknown size over frequency from the residuals of motion and constant faults."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.stapeskit.arrays import Array, ComplexArray

# Numbers called measured were halved and doubled on 42 simulated scenes: clean ones and one of each fault
# of benchmarks/fault_scenes.py, on 10 points of a stapes and 5 of a footplate, 120 lines, a third of them
# with 5 % of the values missing, noise by frequency to the power 1, 0, -1 or -2. The course is off by 0.9 %
# (median of the rms over frequency), by 3.0 % in one scene of ten.
#
# Lines. Definition: a parabola over the logarithm of the frequency has three coefficients.
_LEAST_LINES = 3
# Lines and values looked at, for speed.
_MOST_LINES, _MOST_VALUES = 2048, 400_000
# Lines a motion, from which on the course of the noise is not absorbed by rows that drift.
_DRIFTING = 8
_LEAST_RESIDUAL_SHARE: float = calibrated("noise_spectrum.least_residual_share")
# Relative errors of the rows of a channel that are tried: from far below noise to a wrong sign, by factors
# of 1.6.
_SIZES = np.concatenate([[0.0], np.geomspace(1e-4, 3.0, 24)])
# Log odds (natural) against an error of a channel: one in twenty. Convention; measured: at half of it the
# course is off by 0.9 % as well, at its double by 1.0 %.
_ODDS = 3.0
# Most rounds of rows and motions; they end earlier once the energy falls by less than a thousandth.
_TURNS, _SLOW = 100, 1e-3
# Standard deviation of a channel's noise over that of most channels, from which on it counts less. Chosen by
# judgement, so that the scatter of estimates is left alone; measured: no change at double, 1.0 % at half.
_LOUD = 2.0
# Share of the trace, or size, that keeps channels and lines solvable that do not determine their rows.
_RIDGE, _LEAST = 1e-12, 1e-100
_LEAST_EVIDENCE: float = calibrated("noise_spectrum.least_evidence")
# Limits of the rounds of clipping, and of the passes of reweighting, which end once the course changes by
# less than 2 %. Computation; measured: five passes at most, three in the median.
_ROUNDS = 5
_PASSES = 8
_SETTLED = 0.02
_CLIP_SD: float = calibrated("noise_spectrum.clip_sd")


def noise_course(fit: LineFit, freq_hz: Array) -> Array | None:
    """Return a smooth factor (freq,) of the noise as stated; None when residuals show no course.

    Parameters
    ----------
    fit : LineFit
    freq_hz : ndarray, (freq,)

    Notes
    -----
    Faults that are the same at all lines, or drift, change the rows of their channels (``_Model``); what else
    is wrong with a channel makes it louder than most, and it counts so much less. The logarithm of the level
    that is left is fitted by a parabola over the logarithm of the frequency: white noise of velocities that
    were written as displacements or accelerations falls or rises by a power of the frequency. Levels are
    means of n squares, whose logarithm has the variance trigamma(n / 2); lines that stand out by more than
    three standard deviations are bounded, so that motion that is not rigid at some lines is not taken for
    noise.
    """
    good = np.flatnonzero(fit.solution.good & (fit.n_dof > 0))
    if len(good) < _LEAST_LINES:
        return None
    most = int(np.clip(_MOST_VALUES // max(len(fit.value), 1), 8 * len(fit.solution.z), _MOST_LINES))
    lines = good[np.unique(np.linspace(0, len(good) - 1, min(most, len(good))).round().astype(int))]
    model, weight = _Model.of(fit, lines)
    number = fit.n_dof[lines] / 2.0
    logs = np.log(freq_hz)
    place = 2.0 * (logs - logs[0]) / max(float(logs[-1] - logs[0]), 1e-9) - 1.0
    base = np.polynomial.legendre.legvander(place, 2)
    course, outlying = np.zeros(len(freq_hz)), np.zeros(len(lines))
    loud = np.ones((len(weight), 1))
    for _ in range(_PASSES):
        flat = np.exp(-course[lines] - outlying)
        model = model.improved(weight * flat / loud)
        energy, free = model.left(weight * flat)
        loud = _loudness(energy, free)
        whole, share = np.sum(energy / loud**2, axis=0), np.sum(free, axis=0) / number
        some = (share > _LEAST_RESIDUAL_SHARE) & (whole > 0.0)
        if np.sum(some) < _LEAST_LINES:
            return None
        before = course
        levels = whole[some] / share[some] / flat[some] ** 2
        course, outlying[some], sure = _parabola(base, lines[some], levels, number[some], share[some])
        if not sure:
            # Weights by a course that is none make lines quiet that channels at fault fit best.
            return None
        if float(np.max(np.abs(course - before))) < _SETTLED:
            break
    return np.asarray(np.exp(course))


def _loudness(energy: Array, free: Array) -> Array:
    """Return the noise (channel, 1) over that of most channels; 1 unless it is clearly more."""
    number = np.sum(free, axis=1, keepdims=True)
    own = np.sum(energy, axis=1, keepdims=True) / np.maximum(number, _RIDGE)
    usual = max(float(np.median(own[number > 0.0])), _LEAST) if np.any(number > 0.0) else 1.0
    return np.sqrt(np.where(own > _LOUD**2 * usual, own / usual, 1.0))


@dataclass(frozen=True)
class _Model:
    """Readings as rows of the channels times the motions of the lines.

    Rows are taken for draws around those of the geometry, each channel with a scatter of its own, the
    likeliest one (empirical Bayes: MacKay 1992, doi:10.1162/neco.1992.4.3.415). That of a channel at fault is
    large, that of the others none: these hold the motions where values are missing, so that rows and motions
    found in turn settle within a few rounds.

    Attributes
    ----------
    value : ndarray, (channel, line), complex
        Zero where missing.
    given : ndarray, (channel, m)
        Rows of the geometry.
    place : ndarray, (line,), or None
        Of the lines from -1 to 1, with which rows may drift; None where there are too few lines for that.
    motion : ndarray, (m, line), complex
    change : ndarray, (channel, m) or (channel, 2 m), complex
        Of the rows: constant, and by the place.
    taken, leverage : ndarray, (channel, line)
        Share of the noise of a reading that changed rows and the motion take.
    """

    value: ComplexArray
    given: Array
    place: Array | None
    motion: ComplexArray
    change: ComplexArray
    taken: Array
    leverage: Array

    @classmethod
    def of(cls, fit: LineFit, lines: NDArray[np.intp]) -> tuple[_Model, Array]:
        """Return the model of a fit at some lines, and the weights (channel, line) by stated noise."""
        sd = fit.at(lines)[1]
        used = np.isfinite(sd)
        factor = np.ones(len(lines)) if fit.noise.factor is None else fit.noise.factor[lines]
        with np.errstate(divide="ignore"):
            weight = np.where(used, factor / sd, 0.0)
        weight /= np.sqrt(np.sum(weight**2) / max(np.count_nonzero(used), 1))
        value, given = np.where(used, fit.value[:, lines], 0.0), fit.beams.basis
        drifting = np.mean(used) * len(lines) >= _DRIFTING * given.shape[1]
        place = np.linspace(-1.0, 1.0, len(lines)) if drifting else None
        change = np.zeros((len(given), given.shape[1] * (1 + drifting)), dtype=complex)
        nothing = np.zeros(value.shape)
        return cls(value, given, place, fit.solution.z[:, lines], change, nothing, nothing), weight

    @property
    def moved(self) -> ComplexArray:
        """What rows are changed by (m or 2 m, line): the motion, and if rows may drift that times place."""
        return self.motion if self.place is None else np.vstack([self.motion, self.motion * self.place])

    def left(self, weight: Array) -> tuple[Array, Array]:
        """Return energy and share of the noise of the weighted residuals, each (channel, line)."""
        residual = self.value - self.given @ self.motion
        own = np.any(self.change, axis=1)
        residual[own] -= self.change[own] @ self.moved
        free = np.maximum(1.0 - self.taken, 0.0) * np.maximum(1.0 - self.leverage, 0.0)
        return np.asarray(np.abs(weight * residual) ** 2), (weight > 0.0) * free

    def improved(self, weight: Array) -> _Model:
        """Return the model with rows and motions found in turn until the energy settles."""
        model, before = self._with_motion(weight), np.inf
        for _ in range(_TURNS):
            model = model._with_rows(weight)._with_motion(weight)
            energy = float(np.sum(model.left(weight)[0]))
            if not energy < (1.0 - _SLOW) * before:
                break
            before = energy
        return model

    def _with_rows(self, weight: Array) -> _Model:
        """Return the model with rows by the likeliest scatter of each channel."""
        energy, free = self.left(weight)
        square = weight**2 / max(float(np.sum(energy)) / max(float(np.sum(free)), 1.0), _LEAST)
        moved = self.moved
        alike = bool(np.all(square == square[:1]))
        values, vectors = np.linalg.eigh(_gram(moved, square[:1] if alike else square))
        values = np.maximum(values, 0.0)
        score = (square * (self.value - self.given @ self.motion)) @ moved.conj().T
        along = (score[:, None] @ vectors.conj())[:, 0]
        variance = (_SIZES**2 * np.sum(self.given**2) / self.given.size)[:, None, None]
        known = np.log1p(variance * values)
        gain = np.sum(np.abs(along) ** 2 * variance / (1.0 + variance * values) - known, axis=2)
        best = np.where(np.max(gain, axis=0) > _ODDS, variance[np.argmax(gain, axis=0), 0, 0], 0.0)
        shrunk = best[:, None] / (1.0 + best[:, None] * values)
        change = (vectors @ (shrunk * along)[:, :, None])[:, :, 0]
        taken = np.zeros(weight.shape)
        for channel in np.flatnonzero(best):
            own = moved.T @ vectors[0 if alike else channel]
            taken[channel] = square[channel] * (np.abs(own) ** 2 @ shrunk[channel])
        return replace(self, change=change, taken=taken)

    def _with_motion(self, weight: Array) -> _Model:
        """Return the model with the motion by its rows."""
        size = self.given.shape[1]
        rows: NDArray[Any] = self.given
        if np.any(self.change):
            rows = rows + self.change[:, :size]
        if self.place is None or not np.any(self.change[:, size:]):
            every: NDArray[Any] = np.broadcast_to(rows, (weight.shape[1], *rows.shape))
        else:
            every = rows + self.place[:, None, None] * self.change[:, size:]
        square = weight.T**2
        turned = (square[:, :, None] * every).conj().swapaxes(1, 2)
        gram = turned @ every
        trace = np.maximum(_RIDGE * np.trace(gram, axis1=1, axis2=2).real, _LEAST)
        inverse = np.linalg.inv(gram + trace[:, None, None] * np.eye(size))
        motion = (inverse @ (turned @ self.value.T[:, :, None]))[:, :, 0].T
        leverage = square * np.real(np.sum((every @ inverse) * every.conj(), axis=2))
        return replace(self, motion=motion.astype(complex), leverage=leverage.T)


def _gram(rows: ComplexArray, square: Array) -> ComplexArray:
    """Return the Gram matrices (n, k, k) of rows (k, line) under squared weights (n, line) of n owners."""
    size = len(rows)
    products = (rows.conj()[:, None] * rows[None]).reshape(size * size, -1)
    gram = (products @ square.T.astype(complex)).T.reshape(-1, size, size)
    return np.asarray(gram)


def _parabola(
    base: Array, lines: NDArray[np.intp], energy: Array, half: Array, left: Array
) -> tuple[Array, Array, bool]:
    """Return the logarithm (freq,) of a smooth factor of the noise, and whether it is more than chance.

    The second value is the excess of outlying lines (line,) over it; zero elsewhere.
    """
    from scipy.special import digamma, polygamma

    levels = np.log(energy / 2.0) - digamma(half)
    sd = np.sqrt(polygamma(1, half) / left)
    rows = base[lines]
    weight = sd**-2.0
    spread = sd
    curve = np.full(len(levels), float(np.median(levels)))
    for _ in range(_ROUNDS):
        clipped = curve + np.clip(levels - curve, -_CLIP_SD * spread, _CLIP_SD * spread)
        coefficients = np.linalg.solve(rows.T @ (weight[:, None] * rows), rows.T @ (weight * clipped))
        curve = rows @ coefficients
        wide = float(np.median(np.abs(levels - curve) / sd)) / 0.6745
        spread = sd * max(1.0, wide)
    flat = np.full(len(levels), float(np.average(curve, weights=weight)))
    sure = float(np.sum(((curve - flat) / spread) ** 2)) >= _LEAST_EVIDENCE
    loud = np.where(levels - curve > _CLIP_SD * spread, 0.5 * (levels - curve), 0.0)
    return np.asarray(0.5 * (base @ coefficients - coefficients[0])), loud, sure
