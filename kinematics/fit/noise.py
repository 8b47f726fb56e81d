"""The noise of a body: as stated, in stated proportions, or from the residuals of the rigid fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinematics.fit.beams import BeamSet
from kinematics.fit.lasers import laser_numbers
from kinematics.fit.lsq import blocks
from kinematics.fit.rigid_fit import LineFit, fit_lines
from kinematics.joint.estimate import State
from kinematics.joint.pack import Readings, pack
from kinematics.measurement import BodyChannels, Measurement
from stapeskit.arrays import Array, ComplexArray
from stapeskit.warnings import Notice

FLOOR = 1e-12
"""Least sd over the largest amplitude (contract): exact data have no noise, weights need some."""

_POOLED_DOF = 400  # residuals pooled at each line: the level is known to 1 / sqrt(2 * 400), 3.5 %
_ROUNDS = 3  # of level and motion in turn; the second changes the level by less than its own sd
_CHANCE = 1e-3  # probability that lasers of equal noise are given different levels


def fit_with_noise(
    measurement: Measurement, run: int, body: BodyChannels, beams: BeamSet, robust: str = "none"
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
    value, rate = body.value[run], measurement.per_displacement
    if body.sd is not None and not body.relative:
        return fit_lines(beams, value, above_floor(body.sd[run], value), rate, robust), True, []
    largest = largest_amplitude(value) or 1.0
    if body.sd is None:
        sd = np.broadcast_to(largest, value.shape)
    else:
        sd = body.sd[run] * (largest / float(np.nanmax(body.sd[run])))
    fit = fit_lines(beams, value, sd, rate)
    where = f" in run {measurement.runs[run]}" if len(measurement.runs) > 1 else ""
    if not np.any(fit.n_dof > 0):
        text = (
            f"body {body.body}{where} has no sd and as many channels as degrees of freedom: its noise "
            "is unknown and written as NaN. Give sd columns or more channels."
        )
        unknown = replace(fit, covariance=np.full_like(fit.covariance, np.nan), chi2=np.zeros_like(fit.chi2))
        return unknown, False, [Notice("noise_unknown", text)]
    if body.sd is None:
        levels = laser_levels(fit, body, measurement.freq_hz)
        fit = fit if levels is None else fit_lines(beams, value, levels[:, None] * sd, rate)
    for _ in range(1 if robust == "none" else _ROUNDS):
        level = _pooled_level(fit) if robust == "none" else _median_level(fit)
        factor = np.maximum(level, FLOOR)
        fit = fit_lines(beams, value, fit.sd, rate, robust, factor)
    what = "relative noise only" if body.sd is not None else "no noise"
    text = (
        f"{what} is stated for body {body.body}: its size was estimated from the residuals of the "
        "rigid fit, so chi2 cannot test rigidity there."
    )
    return fit, False, [Notice("noise_estimated", text)]


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


def laser_levels(fit: LineFit, body: BodyChannels, freq_hz: Array) -> Array | None:
    """Return the noise of each channel's laser over the mean of lasers, (c,); None when lasers look alike.

    Notes
    -----
    Channels of one laser differ too: the logarithms of their levels are compared between lasers by Fisher's
    analysis of variance. A vibrometer that reports x, y, z instead of its beams is the case in mind: its
    beams lie within some 20 degrees of z, so that x and y are several times as noisy as z.
    """
    from scipy.special import fdtrc

    names, group = np.unique(laser_numbers(body.directions), return_inverse=True)
    if len(names) < 2 or fit.solution.is_rounding():
        return None
    sd = (fit.sd * fit.factor)[None]
    readings = Readings.of(fit.value[None], sd, freq_hz, body.arms_m, body.directions)
    energy, freedom = State(pack(readings)).own_noise
    known = (energy > 0.0) & (freedom > 0.0)
    number = np.bincount(group[known], minlength=len(names))
    within = int(np.sum(number)) - len(names)
    if np.any(number == 0) or within < 1:
        return None
    logs = np.log(np.where(known, energy, 1.0) / np.where(known, freedom, 1.0))
    middle = np.array([np.median(logs[known & (group == k)]) for k in range(len(names))])
    whole = float(np.average(middle, weights=number))
    mean = np.bincount(group[known], logs[known], minlength=len(names)) / number
    scatter = float(np.sum((logs[known] - mean[group[known]]) ** 2)) / within
    between = float(np.sum(number * (middle - whole) ** 2)) / (len(names) - 1)
    ratio = between / max(scatter, np.finfo(float).tiny)
    if fdtrc(len(names) - 1, within, ratio) > _CHANCE:
        return None
    return np.asarray(np.exp(0.5 * (middle - whole))[group])


def _pooled_level(fit: LineFit) -> Array:
    """Return the noise over the assumed one that neighbouring lines show together, (L,)."""
    chi2, good = fit.chi2, np.isfinite(fit.chi2) & (fit.n_dof > 0)
    lines, total = len(chi2), int(np.sum(fit.n_dof[good]))
    width = min(lines, max(1, int(np.ceil(_POOLED_DOF / (total / lines)))))
    sums = np.concatenate([[0.0], np.cumsum(np.where(good, chi2, 0.0))])
    counts = np.concatenate([[0], np.cumsum(np.where(good, fit.n_dof, 0))])
    start = np.clip(np.arange(lines) - width // 2, 0, lines - width)
    number = np.maximum(counts[start + width] - counts[start], 1)
    return np.asarray(np.sqrt(np.maximum(sums[start + width] - sums[start], 0.0) / number))


def _median_level(fit: LineFit) -> Array:
    """Return the noise over the assumed one, (L,), from medians of residuals, which outliers hardly move.

    Notes
    -----
    |e|^2 of complex noise with unit sd of each part has the median 2 ln 2; fitting shrinks it by the share of
    the degrees of freedom that the motion takes.
    """
    channels, lines = fit.value.shape
    width = max(1, min(lines, _POOLED_DOF // max(channels, 1) + 1))
    centres, levels = [], []
    for start in range(0, lines, width):
        near = np.arange(start, min(start + width, lines))
        left = fit.value[:, near] - fit.beams.basis @ fit.solution.z[:, near]
        size = (np.abs(left) / fit.sd[:, near]) ** 2
        known: NDArray[np.float64] = size[np.isfinite(size)]
        if known.size:
            share = max(1.0 - len(fit.beams.dof) * len(near) / known.size, 0.05)
            centres.append(start + 0.5 * width)
            levels.append(np.sqrt(np.median(known) / (2.0 * np.log(2.0) * share)))
    return np.asarray(np.interp(np.arange(lines), centres, levels))
