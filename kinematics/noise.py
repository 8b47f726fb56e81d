"""The noise of a body: as stated, in stated proportions, or from what the rigid fit leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinematics.beams import BeamSet
from kinematics.measurement import BodyChannels, Measurement
from kinematics.notices import Notice
from kinematics.rigid_fit import LineFit, fit_lines, pooled_scale
from kinematics.screening import with_floor

Array = NDArray[np.float64]
_ROUNDS = 3


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
    freq, order = measurement.freq_hz, measurement.order
    if body.sd is not None and not body.relative:
        sd = with_floor(body.sd[run], value, freq, order)
        return fit_lines(beams, value, sd, robust), True, []
    rate = (2.0 * np.pi * freq) ** order
    relative = np.ones(value.shape) / rate if body.sd is None else body.sd[run]
    relative = with_floor(relative * _size(value, relative), value, freq, order)
    fit = fit_lines(beams, value, relative)
    if not np.any(fit.n_dof > 0):
        where = f" in run {measurement.runs[run]}" if len(measurement.runs) > 1 else ""
        text = (
            f"body {body.body}{where} has no sd and as many channels as degrees of freedom: its noise "
            "is unknown and stands as NaN. Give sd columns or more channels."
        )
        unknown = replace(fit, covariance=np.full_like(fit.covariance, np.nan), chi2=np.zeros_like(fit.chi2))
        return unknown, False, [Notice("noise_unknown", text)]
    fit = _scaled(beams, value, relative, fit, freq, order, robust)
    what = "relative noise only" if body.sd is not None else "no noise"
    text = (
        f"{what} is stated for body {body.body}: its size was estimated from the residuals of the "
        "rigid fit, so chi2 cannot test rigidity there."
    )
    return fit, False, [Notice("noise_estimated", text)]


def _size(value: NDArray[np.complex128], relative: Array) -> float:
    """Return a factor that brings relative sd to the size of the data, for well-scaled numbers."""
    good = np.isfinite(value.real) & np.isfinite(relative)
    if not np.any(good):
        return 1.0
    return float(np.max(np.abs(value[good]) / relative[good])) or 1.0


def _scaled(
    beams: BeamSet,
    value: NDArray[np.complex128],
    relative: Array,
    fit: LineFit,
    freq: Array,
    order: int,
    robust: str,
) -> LineFit:
    ones = np.ones(len(freq))
    if robust == "none":
        factor = pooled_scale(fit.chi2, fit.n_dof, ones)
        sd = with_floor(relative * factor, value, freq, order)
        return fit_lines(beams, value, sd)
    for _ in range(_ROUNDS):
        factor = _median_scale(fit, relative)
        fit = fit_lines(beams, value, with_floor(relative * factor, value, freq, order), robust)
    return fit


def _median_scale(fit: LineFit, relative: Array, block: int = 400) -> Array:
    """Return a noise factor per line (freq,) from medians of |residual|^2, which outliers hardly move.

    Notes
    -----
    |e|^2 of complex noise with unit sd of each part has median 2 ln 2; fitting shrinks it by the share of
    the degrees of freedom that the motion takes.
    """
    used = np.isfinite(fit.sd)
    size = np.abs(fit.residual) / np.where(used, relative, 1.0)
    channels, lines = size.shape
    width = max(1, min(lines, block // max(channels, 1) + 1))
    centres, values = [], []
    for start in range(0, lines, width):
        part = used[:, start : start + width]
        if not np.any(part):
            continue
        left = 1.0 - fit.beams.basis.shape[1] * part.shape[1] / max(int(np.sum(part)), 1)
        median = float(np.median(size[:, start : start + width][part] ** 2))
        centres.append(start + 0.5 * width)
        values.append(np.sqrt(median / (2.0 * np.log(2.0) * max(left, 0.05))))
    return np.asarray(np.interp(np.arange(lines), centres, values))
