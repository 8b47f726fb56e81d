"""The noise of a body: as stated, in stated proportions, or from the residuals of the rigid fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legacy.kinematics.fit.beams import BeamSet
from legacy.kinematics.fit.laser_groups import group_lasers, noise_shares
from legacy.kinematics.fit.line_noise import LineNoise, blocks
from legacy.kinematics.fit.rigid_fit import LineFit, fit_noise, pooled_scale
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.warnings import Notice

# Rounds of the restricted likelihood.
_ROUNDS = 3
# Lines for each factor that faults could have, lines looked at, and the least share of its own noise that the
# residual of a channel must hold.
_LINES_PER_FACTOR, _MOST_LINES, _LEAST_OWN = 4, 2048, 1e-9
# Readings whose median gives one noise factor: known to about 5 %.
_MEDIAN_VALUES = 400
# Least variance, as a share of the largest or absolutely: exact data have none.
_FLOOR = 1e-12
_LEAST = 1e-100


def fit_with_noise(
    measurement: Measurement, run: int, body: BodyChannels, beams: BeamSet, robust: str
) -> tuple[LineFit, bool, list[Notice]]:
    """Fit one body in one run with its noise.

    Returns
    -------
    LineFit
    bool
        Whether the noise was stated in absolute size.
    list of Notice
        ``noise_estimated`` or ``noise_unknown`` when it was not.
    """
    value = body.displacement[run]
    rate = (2.0 * np.pi * measurement.freq_hz) ** measurement.order
    if body.sd is not None and not body.relative:
        fit = _fit_known_noise(beams, value, LineNoise(body.sd[run]), rate, robust)
        return fit, True, _convergence_notices(fit, measurement, run, body)
    if body.sd is None:
        relative = np.broadcast_to(1.0 / rate, value.shape)
        size, floor = np.ones(len(rate)), None
    else:
        relative = body.sd[run]
        largest = largest_rate(value, rate)
        size, floor = np.full(len(rate), _size(largest, rate, relative)), least_sd(largest, rate)
    fit = fit_noise(beams, value, LineNoise(relative, size, floor))
    if not np.any(fit.n_dof > 0):
        where = f" in run {measurement.runs[run]}" if len(measurement.runs) > 1 else ""
        text = (
            f"body {body.body}{where} has no sd and as many channels as degrees of freedom: its noise "
            "is unknown and written as NaN. Give sd columns or more channels."
        )
        unknown = replace(fit, covariance=np.full_like(fit.covariance, np.nan), chi2=np.zeros_like(fit.chi2))
        return unknown, False, [Notice("noise_unknown", text)]
    if body.sd is None:
        fit = _by_laser(fit, body.directions)
    fit = _scale(fit, rate, robust)
    what = "relative noise only" if body.sd is not None else "no noise"
    text = (
        f"{what} is stated for body {body.body}: its size was estimated from the residuals of the "
        "rigid fit, so chi2 cannot test rigidity there."
    )
    return fit, False, [Notice("noise_estimated", text), *_convergence_notices(fit, measurement, run, body)]


def largest_rate(value: ComplexArray, rate: Array) -> float:
    """Return the largest |value| times ``rate`` (freq,), within a factor of sqrt 2; 0 without a finite value.

    It is the larger of real and imaginary part: one pass over the data without a copy.
    """
    largest = 0.0
    for part in blocks(*value.shape):
        block = value[:, part]
        if block.strides[-1] == block.itemsize:
            flat = block.view(float)
            most = np.maximum(np.max(flat, axis=0), -np.min(flat, axis=0)).reshape(-1, 2).max(axis=1)
        else:
            most = np.max(np.maximum(np.abs(block.real), np.abs(block.imag)), axis=0)
        if not np.all(np.isfinite(most)):
            size = np.maximum(np.abs(block.real), np.abs(block.imag))
            most = np.max(np.where(np.isfinite(size), size, 0.0), axis=0)
        largest = max(largest, float(np.max(most * rate[part])))
    return largest


def _size(largest: float, rate: Array, relative: Array) -> float:
    """Return a factor that brings relative sd to the size of the data, for well-scaled numbers."""
    typical = [np.nanmax(relative[:, part] * rate[part], initial=0.0) for part in blocks(*relative.shape)]
    top = float(np.max(typical, initial=0.0))
    return (largest / top if np.isfinite(top) and top > 0.0 else largest) or 1.0


def _convergence_notices(
    fit: LineFit, measurement: Measurement, run: int, body: BodyChannels
) -> list[Notice]:
    if fit.unsettled == 0:
        return []
    where = f" in run {measurement.runs[run]}" if len(measurement.runs) > 1 else ""
    text = (
        f"body {body.body}{where}: the robust fit had not settled at {fit.unsettled} lines after "
        f"{fit.iterations} iterations; look for two groups of channels that contradict each other."
    )
    return [Notice("robust_unsettled", text)]


def _fit_known_noise(
    beams: BeamSet, value: ComplexArray, noise: LineNoise, rate: Array, robust: str
) -> LineFit:
    """Fit with a stated noise and the floor that keeps it positive."""
    if robust == "none" and noise.common() is not None:
        fit = fit_noise(beams, value, noise)
        if not _floor_binds(fit, rate):
            return fit
    floor = least_sd(largest_rate(value, rate), rate)
    return fit_noise(beams, value, replace(noise, floor=floor), robust)


def _floor_binds(fit: LineFit, rate: Array) -> bool:
    """Return whether a floor on the noise may matter, without reading the data again.

    The sum of |value / sd|^2 of a line, known from the fit, bounds its largest value.
    """
    if fit.common is None or not np.all(fit.solution.good):
        return True
    share, line = fit.common
    bound = line * np.sqrt(2.0 * (fit.solution.misfit + fit.solution.explained)) * rate
    return bool(np.any(np.min(share) * line < least_sd(float(np.max(bound)), rate)))


def least_sd(largest: float, rate: Array) -> Array:
    """Return the least sd (freq,), m: 1e-12 of the largest measured amplitude, in the measured quantity."""
    return np.asarray((_FLOOR * largest or _LEAST) / rate)


def _by_laser(fit: LineFit, directions: Array) -> LineFit:
    """Return the fit with the noise of each laser in the proportions that the residuals show.

    Variance components in turn with the motion (Foerstner 1979, Zeitschrift fuer Vermessungswesen 104:446).
    """
    (laser,), _ = group_lasers([directions])
    before, shares = fit, np.ones(len(laser))
    for _ in range(_ROUNDS):
        energy = _unexplained_energy(fit)
        next_shares = None if energy is None else noise_shares(laser, shares**2 * energy)
        if next_shares is None:
            return fit
        shares = next_shares
        noise = replace(before.noise, stated=shares[:, None] * before.noise.stated)
        fit = fit_noise(before.beams, before.value, noise)
    return fit


def _unexplained_energy(fit: LineFit) -> Array | None:
    """Return the energy (channel,) that no constant or drifting fault explains, over that of the noise.

    Such a fault leaves the motion times a factor in the residuals, however large it is. None where lines are
    too few to tell, values are missing, or residuals are rounding errors.
    """

    good = np.flatnonzero(fit.solution.good)
    if not fit.complete or len(good) < _LINES_PER_FACTOR * len(fit.solution.z) or fit.is_rounding():
        return None
    lines = good[np.unique(np.linspace(0, len(good) - 1, min(len(good), _MOST_LINES)).astype(int))]
    sd = fit.noise.at(lines)
    motion = fit.solution.z[:, lines] * np.sqrt(np.mean(sd**-2.0, axis=0))
    if len(lines) >= 2 * _LINES_PER_FACTOR * len(motion):
        motion = np.vstack([motion, motion * np.linspace(-1.0, 1.0, len(lines))])
    vectors = np.linalg.svd(motion, full_matrices=False)[2]
    white = fit.value[:, lines] / sd
    rest = white - (white @ vectors.conj().T) @ vectors
    own = 1.0 - np.mean(fit.leverage(lines), axis=1)
    with np.errstate(divide="ignore"):
        energy = 0.5 * np.sum(np.abs(rest) ** 2, axis=1) / ((len(lines) - len(motion)) * own)
    return np.asarray(np.where(own > _LEAST_OWN, energy, np.nan))


def _scale(fit: LineFit, rate: Array, robust: str) -> LineFit:
    """Find the size of the noise from the residuals, and fit with it where that changes the motion."""
    beams, value, noise = fit.beams, fit.value, fit.noise
    if robust == "none":
        factor = pooled_scale(fit.chi2, fit.n_dof, np.ones(len(rate)))
        if noise.floor is None:
            scaled = fit.rescaled(factor, None)
            if not _floor_binds(scaled, rate):
                return scaled
            return fit.rescaled(factor, least_sd(largest_rate(value, rate), rate))
        return fit_noise(beams, value, LineNoise(noise.stated, fit.noise_factor(factor), noise.floor))
    floor = noise.floor if noise.floor is not None else least_sd(largest_rate(value, rate), rate)
    for _ in range(_ROUNDS):
        factor = _median_scale(fit, noise.stated)
        fit = fit_noise(beams, value, LineNoise(noise.stated, factor, floor), robust)
    return fit


def _median_scale(fit: LineFit, relative: Array) -> Array:
    """Return a noise factor per line (freq,) from medians of |residual|^2, which outliers hardly move.

    Notes
    -----
    |e|^2 of complex noise with unit sd of each part has median 2 ln 2; fitting shrinks it by the share of
    the degrees of freedom that the motion takes.
    """
    channels, lines = fit.value.shape
    width = max(1, min(lines, _MEDIAN_VALUES // max(channels, 1) + 1))
    centres, values = [], []
    for start in range(0, lines, width):
        near = slice(start, min(start + width, lines))
        residual, sd, _weights = fit.at(near)
        part = np.isfinite(sd)
        if not np.any(part):
            continue
        left = 1.0 - fit.beams.basis.shape[1] * part.shape[1] / max(int(np.sum(part)), 1)
        median = float(np.median((np.abs(residual[part]) / relative[:, near][part]) ** 2))
        centres.append(start + 0.5 * width)
        values.append(np.sqrt(median / (2.0 * np.log(2.0) * max(left, 0.05))))
    return np.asarray(np.interp(np.arange(lines), centres, values))
