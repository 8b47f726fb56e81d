"""Estimate noise of unknown size over frequency from the residuals of motion and constant faults."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinematics.calibrated import calibrated
from kinematics.fit.rigid_fit import LineFit

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
# Fewer lines show no course over frequency.
_LEAST_LINES = 12
# Lines and values looked at, for speed.
_MOST_LINES, _MOST_VALUES = 2048, 400_000
# Lines a motion, from which on the course of the noise is not absorbed by the motions.
_DRIFTING = 8
_LEAST_RESIDUAL_SHARE: float = calibrated("noise_spectrum.least_residual_share")
# Most rounds of factors and motions where values are missing, with so many lines a motion; they end earlier
# once the energy falls by less than 2 %.
_TURNS, _FREE = 12, 2
# Share of the trace, or size, that keeps channels and lines solvable that do not determine their factors.
_RIDGE, _LEAST = 1e-12, 1e-100
_LEAST_EVIDENCE: float = calibrated("noise_spectrum.least_evidence")
# Rounds of clipping and of reweighting; they end earlier once the course changes by less than 2 %.
_ROUNDS = 5
_PASSES = 6
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
    A fault that is the same at all lines leaves residuals that are the motion times a factor of each channel,
    however large it is; one that drifts, the motion times a line over frequency. Both are subtracted first by
    least squares over the lines. The logarithm of the level that is left is fitted by a parabola over the
    logarithm of the frequency: white noise of velocities that were written as displacements or accelerations
    falls or rises by a power of the frequency. Levels are means of n squares, whose logarithm has the
    variance trigamma(n / 2); lines that stand out by more than three standard deviations are bounded, so that
    motion that is not rigid at some lines is not taken for noise.
    """
    good = np.flatnonzero(fit.solution.good & (fit.n_dof > 0))
    if len(good) < _LEAST_LINES:
        return None
    most = int(np.clip(_MOST_VALUES // max(len(fit.value), 1), 8 * len(fit.solution.z), _MOST_LINES))
    lines = good[np.unique(np.linspace(0, len(good) - 1, min(most, len(good))).round().astype(int))]
    white, z, own, whole = _whitened(fit, lines)
    number = fit.n_dof[lines] / 2.0
    drifting = np.mean(white != 0.0) * len(lines) >= _DRIFTING * len(z)
    turn = np.linspace(-1.0, 1.0, len(lines)) if drifting else None
    logs = np.log(freq_hz)
    place = 2.0 * (logs - logs[0]) / max(float(logs[-1] - logs[0]), 1e-9) - 1.0
    base = np.polynomial.legendre.legvander(place, 2)
    course, sure = np.zeros(len(freq_hz)), False
    if not np.max(whole) > 0.0:
        return None
    loud = 0.5 * np.log(np.maximum(whole, 1e-12 * np.max(whole)) / np.mean(whole))
    for _ in range(_PASSES):
        flat = np.exp(-course[lines] - loud)
        energy, taken, z = _unexplained(white * flat, z * flat, own, turn)
        z = z / flat
        left = 1.0 - taken / number
        some = (left > _LEAST_RESIDUAL_SHARE) & (energy > 0.0)
        if np.sum(some) < _LEAST_LINES // 2:
            return None
        energy = energy[some] / left[some] / flat[some] ** 2
        before = course
        course, loud[some], sure = _parabola(base, lines[some], energy, number[some], left[some])
        if float(np.max(np.abs(course - before))) < _SETTLED:
            break
    return np.asarray(np.exp(course)) if sure else None


def _whitened(fit: LineFit, lines: NDArray[np.intp]) -> tuple[ComplexArray, ComplexArray, Array, Array]:
    """Return readings over stated noise, and the motion, share of noise and energy that a fit leaves.

    Readings (channel, line) are zero where missing; the motion (m, line) is in their unit; the share of its
    noise that each residual holds is (channel, line), the energy of the residuals (line,).
    """
    residual, sd, _ = fit.at(lines)
    used = np.isfinite(sd)
    factor = np.ones(len(lines)) if fit.noise.factor is None else fit.noise.factor[lines]
    with np.errstate(divide="ignore"):
        weight = np.where(used, factor / sd, 0.0)
    line = np.sqrt(np.sum(weight**2, axis=0) / np.maximum(np.sum(used, axis=0), 1))
    white = np.where(used, fit.value[:, lines], 0.0) * weight
    # All lines of complete data leave the same share in the mean over the channels.
    share = 1.0 - len(fit.solution.z) / len(used)
    own = share * used if np.all(used) else np.where(used, 1.0 - fit.leverage(lines), 0.0)
    return white, fit.solution.z[:, lines] * line, own, np.sum(np.abs(residual * weight) ** 2, axis=0)


def _unexplained(
    white: ComplexArray, motion: ComplexArray, own: Array, turn: Array | None
) -> tuple[Array, Array, ComplexArray]:
    """Return the energy (line,) that no factors of the motion explain, and the variance that they take.

    The third value is the motion without what faults of lines with gaps do to it.

    Parameters
    ----------
    white : ndarray, (channel, line), complex
        Readings over their noise; zero where missing.
    motion : ndarray, (m, line), complex
    own : ndarray, (channel, line)
        Share of the noise that a rigid fit leaves; zero where missing.
    turn : ndarray, (line,), or None
        Place of the lines from -1 to 1; None for factors that are the same at all lines.

    Notes
    -----
    Readings with constant faults have the rank of the motion. What a fault does to the motion fitted to it
    differs between lines that lack different channels: factors of the channels and motions of the lines are
    found in turn, each by least squares (Gabriel and Zamir 1979, doi:10.1080/00401706.1979.10489819).
    """
    used = white != 0.0
    complete = bool(np.all(used))
    free = np.mean(used) * white.shape[1] >= _FREE * len(motion)
    energy = np.inf
    for _ in range(_TURNS if free and not complete else 0):
        factors = _solved(_gram(motion, used), white, motion)
        rest = np.where(used, white - factors @ motion, 0.0)
        motion = motion + _solved(_gram(factors.T, used.T), rest.T, factors.T).T
        before, energy = energy, float(np.sum(np.abs(rest) ** 2))
        if not energy < (1.0 - _SETTLED) * before:
            break
    rows = motion if turn is None else np.vstack([motion, motion * turn])
    if complete:
        vectors = np.linalg.svd(rows, full_matrices=False)[2]
        rest = white - (white @ vectors.conj().T) @ vectors
        taken = np.sum(own, axis=0) * np.sum(np.abs(vectors) ** 2, axis=0)
        return np.sum(np.abs(rest) ** 2, axis=0), taken, motion
    gram = _gram(rows, used)
    rest = np.where(used, white - _solved(gram, white, rows) @ rows, 0.0)
    inverse = np.linalg.inv(gram).reshape(len(white), -1)
    taken = np.real(inverse @ (rows[:, None] * rows.conj()[None]).reshape(inverse.shape[1], -1))
    return np.sum(np.abs(rest) ** 2, axis=0), np.sum(own * taken, axis=0), motion


def _gram(rows: ComplexArray, used: NDArray[np.bool_]) -> ComplexArray:
    """Return the Gram matrices (n, k, k) of rows (k, line) at the lines that each of n owners has."""
    size = len(rows)
    products = (rows.conj()[:, None] * rows[None]).reshape(size * size, -1)
    gram = (products @ used.T.astype(float)).T.reshape(-1, size, size)
    ridge = _RIDGE * np.trace(gram, axis1=1, axis2=2).real
    return np.asarray(gram + np.maximum(ridge, _LEAST)[:, None, None] * np.eye(size))


def _solved(gram: ComplexArray, value: ComplexArray, rows: ComplexArray) -> ComplexArray:
    """Return the factors (n, k) of rows (k, line) that are nearest to values (n, line)."""
    return np.asarray(np.linalg.solve(gram, (value @ rows.conj().T)[:, :, None])[:, :, 0])


def _parabola(
    base: Array, lines: NDArray[np.intp], energy: Array, half: Array, left: Array
) -> tuple[Array, Array, bool]:
    """Return the logarithm (freq,) of a smooth factor of the noise, and whether it is more than chance.

    Between them stands by how much lines (line,) that stand out are above it; zero elsewhere.
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
