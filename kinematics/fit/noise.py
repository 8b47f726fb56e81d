"""The noise of a body: as stated, in stated proportions, or from the residuals of the rigid fit."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from kinematics.fit.beams import BeamSet
from kinematics.fit.lsq import HUBER_TUNING, blocks, solve
from kinematics.fit.rigid_fit import LineFit, fit_lines
from kinematics.joint.estimate import State
from kinematics.joint.expected import laser_numbers
from kinematics.joint.noise_levels import ChannelLevels, channel_levels, pooled_levels
from kinematics.joint.pack import Readings, pack
from kinematics.measurement import BodyChannels, Measurement
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

FLOOR = 1e-12
"""Least sd over the largest amplitude (contract): exact data have no noise, weights need some."""

# Noise alone exceeds it with the probability exp(-14) = 8e-7 (chi2 of two degrees of freedom over its mean).
FAR = 14.0
"""Square of a residual over the mean square above which a value counts as far off."""

_LEAST_LEVEL_DOF = 4.0  # of a level of noise: the mean of 1 over fewer grows beyond 2, for 2 without end
_LEVEL_ROUNDS = 6  # of channels: with wrong weights, residuals of quiet ones hold the noise of loud ones
_LEVEL_LINES = 2000  # that show the level of a channel, to 1.6 %
_SETTLED = 0.004  # change of levels that ends the rounds: a quarter of how well they are known
_ROBUST_ROUNDS = 3  # of level and motion in turn; the second changes the level by less than its own sd
_START_ROUNDS = 20  # from the largest amplitude down to the noise next to drop-outs: each takes off most


def fit_with_noise(
    measurement: Measurement, run: int, body: BodyChannels, beams: BeamSet, robust: str = "none"
) -> tuple[LineFit, list[Notice]]:
    """Fit one body in one run with its noise; a notice says so where that is estimated or unknown.

    Raises
    ------
    StapeskitError
        A robust fit without stated noise has one spare channel: its residuals do not show their scale.
    """
    value, rate = body.value[run], measurement.per_displacement
    sd = assumed_sd(body, run)
    if body.is_noise_stated:
        return fit_lines(beams, value, sd, rate, robust), []
    spare = int(np.count_nonzero(np.isfinite(value).any(axis=1))) - len(beams.dof)
    if robust != "none" and spare == 1:
        want = "at least two more than degrees of freedom for a robust fit without stated noise"
        step = "State the noise (sd), or leave --robust out: one spare channel shows no value far off"
        raise StapeskitError.of(f"the channels of body {body.body}", want, "one more", "", step)
    levels, start = _levels(measurement, body, beams, run, sd, robust)
    if body.sd is None:
        sd = np.broadcast_to(levels.level[:, None] * sd[:, :1], sd.shape)
    fit = fit_lines(beams, value, sd, rate, robust, np.full(len(rate), start))
    where = f" in run {measurement.runs[run]}" if len(measurement.runs) > 1 else ""
    if not np.any(fit.n_dof > 0):
        text = (
            f"body {body.body}{where} has no sd and as many channels as degrees of freedom: its noise "
            "is unknown and written as NaN. Give sd columns or more channels."
        )
        unknown = replace(fit, covariance=np.full_like(fit.covariance, np.nan), chi2=np.zeros_like(fit.chi2))
        return unknown, [Notice("noise_unknown", text)]
    for _ in range(1 if robust == "none" else _ROBUST_ROUNDS):
        level = pooled_levels(_line_energy(fit, robust), fit.n_dof.astype(float))
        factor = np.maximum(np.asarray(fit.factor * level), FLOOR)
        if robust == "none":
            fit = fit.with_line_noise(factor)
        else:
            fit = fit_lines(beams, value, fit.sd, rate, robust, factor)
    fit = replace(fit, covariance=fit.covariance * _unsure_noise(fit, levels.unsure))
    what = "relative noise only" if body.sd is not None else "no noise"
    text = (
        f"{what} is stated for body {body.body}: its size was estimated from the residuals of the "
        "rigid fit, so chi2 cannot test rigidity there."
    )
    return fit, [Notice("noise_estimated", text)]


def _unsure_noise(fit: LineFit, unsure: Array) -> float:
    """Return by what factor the variance of a motion is larger because its noise was estimated.

    ``unsure`` (c,) is the variance of the logarithm of each channel's estimated noise.

    Notes
    -----
    Weights that err make the motion less certain, and the covariance that is computed with them too small by
    as much again (Kenward and Roger 1997, doi:10.2307/2533558): with the leverage h of a channel and the
    variance v of its logarithmic weight, both add v (1 - h) to its contribution, a share h. The common level
    has n degrees of freedom: 1 over it is n / (n - 2) in the mean.
    """
    leverage = 1.0 - fit.solution.freedom / np.maximum(2.0 * fit.solution.used, 1.0)
    added = 2.0 * (2.0**2 * unsure) * (1.0 - leverage)
    freedom = max(float(np.sum(fit.n_dof)), _LEAST_LEVEL_DOF)
    weights = float(leverage @ added / max(float(np.sum(leverage)), 1e-9))
    return (1.0 + weights) * freedom / (freedom - 2.0)


def _levels(
    measurement: Measurement, body: BodyChannels, beams: BeamSet, run: int, sd: Array, robust: str
) -> tuple[ChannelLevels, float]:
    """Return the noise of channels over the middle one from lines of the body all over the band.

    For a robust fit, values far off are left out, and the noise over ``sd`` next to them is returned too.
    """
    measured = np.flatnonzero(np.isfinite(body.value[run]).any(axis=0))
    some = measured[:: max(1, len(measured) // _LEVEL_LINES)]
    value, rate = body.value[run][:, some], measurement.per_displacement[some]
    sd, levels, start = sd[:, some], ChannelLevels.as_assumed(len(value)), 1.0
    if robust != "none":
        found = robust_residuals(beams.basis, value, sd)
        value, start = np.where(found.squares > FAR, np.nan, value), found.level
    if body.sd is not None or fit_lines(beams, value, sd, rate).solution.is_rounding():
        return levels, start
    readings = Readings.of(value[None], sd[None], measurement.freq_hz[some], body.arms_m, body.directions)
    lasers = laser_numbers(body.directions)
    for _ in range(_LEVEL_ROUNDS):  # packed anew: columns without motion depend on the weights
        state, before = State(pack(replace(readings, noise_factor=levels.level))), levels.level
        levels = channel_levels(state, lasers, before)
        if np.all(np.abs(levels.level - before) < _SETTLED * before):
            break
    return levels, start


class Residuals(NamedTuple):
    """What a rigid motion leaves of values (c, L) at every line, hardly moved by values far off.

    Attributes
    ----------
    z : ndarray, (m, L), complex
        The motion in the columns of the rows.
    left, fitted : ndarray, (c, L), complex
        Residuals and fitted values over their sd; NaN where missing.
    squares : ndarray, (c, L)
        Squares of residuals over the usual one of their channel, at least that of all; NaN where missing.
    level : float
        The usual residual over its sd.
    """

    z: ComplexArray
    left: ComplexArray
    fitted: ComplexArray
    squares: Array
    level: float


def robust_residuals(rows: Array, value: ComplexArray, sd: Array) -> Residuals:
    """Fit every line by Huber's function, whose scale follows from the middle residual.

    Notes
    -----
    The median of |residual|^2 is ln 2 of its mean (chi2 of two degrees of freedom), of which the motion takes
    the share of its columns.
    """
    level, live = 1.0, max(int(np.count_nonzero(np.isfinite(value).any(axis=1))), 1)
    kept = max(live - rows.shape[1], 1) / live
    for _ in range(_START_ROUNDS):
        z = solve(rows, value, level * sd, "huber").z
        left = (value - rows @ z) / sd
        square = 0.5 * np.abs(left) ** 2 / np.log(2.0)
        known = np.isfinite(square)
        middle = float(np.median(square[known])) if known.any() else 1.0
        before, level = level, max(float(np.sqrt(middle / kept)), FLOOR)
        if abs(level - before) < _SETTLED * before:
            break
    own = [
        float(np.median(one[some])) if some.any() else 0.0 for one, some in zip(square, known, strict=True)
    ]
    usual = np.maximum(own, kept * level**2)[:, None]
    return Residuals(z, left, rows @ z / sd, np.log(2.0) * square / usual, level)


def assumed_sd(body: BodyChannels, run: int) -> Array:
    """Return the sd (c, L) that is stated, else as large as the largest amplitude, in stated proportions."""
    value = body.value[run]
    if body.sd is not None and not body.relative:
        return above_floor(body.sd[run], value)
    largest = largest_amplitude(value) or 1.0
    if body.sd is None:
        return np.broadcast_to(largest, value.shape)
    return np.asarray(body.sd[run] * (largest / float(np.nanmax(body.sd[run]))))


def largest_amplitude(value: ComplexArray) -> float:
    """Return the largest real or imaginary part of values (c, L); 0 without a finite value."""
    largest = 0.0
    for part in blocks(*value.shape):
        block = np.ascontiguousarray(value[:, part]).view(float)
        most = max(float(np.fmax.reduce(block, axis=None)), -float(np.fmin.reduce(block, axis=None)))
        largest = max(largest, most) if np.isfinite(most) else largest
    return largest


def above_floor(sd: Array, value: ComplexArray) -> Array:
    """Return sd (c, L) raised to 1e-12 of the largest amplitude, a view where it is nowhere below."""
    floor = max(FLOOR * largest_amplitude(value), 1e-100)
    view = sd[:, :1] if sd.strides[1] == 0 else sd[:1] if sd.strides[0] == 0 else sd
    return sd if float(np.fmin.reduce(view, axis=None)) >= floor else np.maximum(sd, floor)


def _line_energy(fit: LineFit, robust: str) -> Array:
    """Return the sum of squares over noise of every line, (L,); for a robust fit none counts fully.

    Notes
    -----
    Squares are cut off where Huber's weight falls, at k^2 of what the median shows, and divided by the mean
    of what this leaves of Gaussian noise, 1 - exp(-k^2 / 2) (Huber and Ronchetti 2009, Robust Statistics,
    5.2).
    """
    if robust == "none":
        return fit.chi2
    energy = np.full(fit.value.shape[1], np.nan)
    for part in blocks(*fit.value.shape):
        left = fit.value[:, part] - fit.beams.basis @ fit.solution.z[:, part]
        square = np.abs(left / (fit.sd[:, part] * fit.factor[part])) ** 2
        known = square[np.isfinite(square)]
        most = HUBER_TUNING**2 * float(np.median(known)) / (2.0 * np.log(2.0)) if known.size else 0.0
        energy[part] = np.nansum(np.minimum(square, most), axis=0) / -np.expm1(-0.5 * HUBER_TUNING**2)
    return energy
