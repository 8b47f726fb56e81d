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
_FREQUENT_SHARE = 0.6  # of lines in frequent patterns of missing channels: one projection a pattern pays
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
    residual, sd, _ = fit.at(lines)
    used = np.isfinite(sd)
    factor = np.ones(len(lines)) if fit.noise.factor is None else fit.noise.factor[lines]
    with np.errstate(divide="ignore"):
        weight = np.where(used, factor / sd, 0.0)
    line = np.sqrt(np.sum(weight**2, axis=0) / np.maximum(np.sum(used, axis=0), 1))
    white, z = residual * weight, fit.solution.z[:, lines] * line
    if len(lines) >= _DRIFTING * len(z):
        z = np.vstack([z, z * np.linspace(-1.0, 1.0, len(lines))])
    logs = np.log(freq_hz)
    place = 2.0 * (logs - logs[0]) / max(float(logs[-1] - logs[0]), 1e-9) - 1.0
    base = np.polynomial.legendre.legvander(place, 2)
    course, sure = np.zeros(len(freq_hz)), False
    whole = np.sum(np.abs(white) ** 2, axis=0)
    if not np.max(whole) > 0.0:
        return None
    loud = 0.5 * np.log(np.maximum(whole, 1e-12 * np.max(whole)) / np.mean(whole))
    for _ in range(_PASSES):
        flat = np.exp(-course[lines] - loud)
        energy, left = _unexplained(white * flat, z * flat, used)
        some = (left > _LEAST_RESIDUAL_SHARE) & (energy > 0.0)
        if np.sum(some) < _LEAST_LINES // 2:
            return None
        half = fit.n_dof[lines][some] / 2.0
        energy = energy[some] / left[some] / flat[some] ** 2
        before = course
        course, loud[some], sure = _parabola(base, lines[some], energy, half, left[some])
        if float(np.max(np.abs(course - before))) < _SETTLED:
            break
    return np.asarray(np.exp(course)) if sure else None


def _unexplained(white: ComplexArray, motion: ComplexArray, used: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the energy (line,) that no factors of the motion explain, and the share of noise in it.

    Parameters
    ----------
    white : ndarray, (channel, line), complex
        Residuals over their noise; zero where missing.
    motion : ndarray, (k, line), complex
    used : ndarray, (channel, line)

    Notes
    -----
    Where channels are missing a fault leaves other factors of the motion in the residuals of the others.
    Lines that lack the same channels are taken together.
    """
    if np.all(used):
        return _projected(white, motion)
    of = np.unique(used, axis=1, return_inverse=True)[1].ravel()
    many = np.flatnonzero(np.bincount(of) >= 2 * len(motion))
    if np.mean(np.isin(of, many)) > _FREQUENT_SHARE:
        energy, left = np.zeros(len(of)), np.zeros(len(of))
        for pattern in many:
            own = of == pattern
            energy[own], left[own] = _projected(white[:, own], motion[:, own])
        return energy, left
    vectors = np.linalg.svd(motion, full_matrices=False)[2]
    gram = np.einsum("cl,kl,jl->ckj", used, vectors.conj(), vectors, optimize=True)
    inverse = np.linalg.pinv(gram, rcond=1e-6, hermitian=True)
    factors = np.einsum("ck,ckj->cj", white @ vectors.conj().T, inverse)
    rest = np.where(used, white - factors @ vectors, 0.0)
    taken = np.einsum("kl,ckj,jl->cl", vectors, inverse, vectors.conj(), optimize=True).real
    number = np.maximum(np.sum(used, axis=0), 1)
    return np.sum(np.abs(rest) ** 2, axis=0), 1.0 - np.sum(np.where(used, taken, 0.0), axis=0) / number


def _projected(white: ComplexArray, motion: ComplexArray) -> tuple[Array, Array]:
    """Return what ``_unexplained`` does where no value, or all of a channel, is missing."""
    vectors = np.linalg.svd(motion, full_matrices=False)[2]
    rest = white - (white @ vectors.conj().T) @ vectors
    return np.sum(np.abs(rest) ** 2, axis=0), 1.0 - np.sum(np.abs(vectors) ** 2, axis=0)


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
