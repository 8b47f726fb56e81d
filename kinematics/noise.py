"""The noise of a body: as stated, in stated proportions, or from what the rigid fit leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinematics.beams import BeamSet
from kinematics.line_noise import blocks
from kinematics.measurement import BodyChannels, Measurement
from kinematics.notices import Notice
from kinematics.rigid_fit import LineFit, fit_lines, pooled_scale

Array = NDArray[np.float64]
_ROUNDS = 3
_FLOOR = 1e-12
_LEAST = 1e-100


def with_noise(
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
    largest = largest_rate(value, rate)
    floor = (_FLOOR * largest or _LEAST) / rate
    if body.sd is not None and not body.relative:
        fit = fit_lines(beams, value, body.sd[run], robust, floor=floor)
        return fit, True, _unsettled(fit, measurement, run, body)
    relative = 1.0 / rate[None] if body.sd is None else body.sd[run]
    size = np.full(len(rate), (largest or 1.0) if body.sd is None else _size(largest, rate, relative))
    fit = fit_lines(beams, value, relative, factor=size, floor=floor)
    if not np.any(fit.n_dof > 0):
        where = f" in run {measurement.runs[run]}" if len(measurement.runs) > 1 else ""
        text = (
            f"body {body.body}{where} has no sd and as many channels as degrees of freedom: its noise "
            "is unknown and stands as NaN. Give sd columns or more channels."
        )
        unknown = replace(fit, covariance=np.full_like(fit.covariance, np.nan), chi2=np.zeros_like(fit.chi2))
        return unknown, False, [Notice("noise_unknown", text)]
    fit = _scaled(beams, value, relative, fit, size, floor, robust)
    what = "relative noise only" if body.sd is not None else "no noise"
    text = (
        f"{what} is stated for body {body.body}: its size was estimated from the residuals of the "
        "rigid fit, so chi2 cannot test rigidity there."
    )
    return fit, False, [Notice("noise_estimated", text), *_unsettled(fit, measurement, run, body)]


def largest_rate(value: NDArray[np.complex128], rate: Array) -> float:
    """Return the largest |value| times ``rate`` (freq,), to a factor of sqrt 2; 0 without a finite value.

    It is the larger of real and imaginary part: one pass over the data without a copy.
    """
    found = 0.0
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
        found = max(found, float(np.max(most * rate[part])))
    return found


def _size(largest: float, rate: Array, relative: Array) -> float:
    """Return a factor that brings relative sd to the size of the data, for well-scaled numbers."""
    typical = [np.nanmax(relative[:, part] * rate[part], initial=0.0) for part in blocks(*relative.shape)]
    top = float(np.max(typical, initial=0.0))
    return (largest / top if np.isfinite(top) and top > 0.0 else largest) or 1.0


def _unsettled(fit: LineFit, measurement: Measurement, run: int, body: BodyChannels) -> list[Notice]:
    if fit.unsettled == 0:
        return []
    where = f" in run {measurement.runs[run]}" if len(measurement.runs) > 1 else ""
    text = (
        f"body {body.body}{where}: the robust fit had not settled at {fit.unsettled} lines after "
        f"{fit.iterations} reweightings; look for two groups of channels that contradict each other."
    )
    return [Notice("robust_unsettled", text)]


def _scaled(
    beams: BeamSet,
    value: NDArray[np.complex128],
    relative: Array,
    fit: LineFit,
    size: Array,
    floor: Array,
    robust: str,
) -> LineFit:
    """Find the size of the noise from the residuals, and fit with it where that changes the motion."""
    if robust == "none":
        factor = pooled_scale(fit.chi2, fit.n_dof, np.ones(len(size)))
        if relative.shape[0] == 1:
            return fit.rescaled(factor, floor)
        return fit_lines(beams, value, relative, factor=size * factor, floor=floor)
    for _ in range(_ROUNDS):
        factor = _median_scale(fit, relative)
        fit = fit_lines(beams, value, relative, robust, factor=factor, floor=floor)
    return fit


def _median_scale(fit: LineFit, relative: Array, block: int = 400) -> Array:
    """Return a noise factor per line (freq,) from medians of |residual|^2, which outliers hardly move.

    Notes
    -----
    |e|^2 of complex noise with unit sd of each part has median 2 ln 2; fitting shrinks it by the share of
    the degrees of freedom that the motion takes.
    """
    channels, lines = fit.value.shape
    stated = np.broadcast_to(relative, fit.value.shape)
    width = max(1, min(lines, block // max(channels, 1) + 1))
    centres, values = [], []
    for start in range(0, lines, width):
        near = slice(start, min(start + width, lines))
        residual, sd, _weights = fit.at(near)
        part = np.isfinite(sd)
        if not np.any(part):
            continue
        left = 1.0 - fit.beams.basis.shape[1] * part.shape[1] / max(int(np.sum(part)), 1)
        median = float(np.median((np.abs(residual[part]) / stated[:, near][part]) ** 2))
        centres.append(start + 0.5 * width)
        values.append(np.sqrt(median / (2.0 * np.log(2.0) * max(left, 0.05))))
    return np.asarray(np.interp(np.arange(lines), centres, values))
