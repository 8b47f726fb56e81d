"""Repeats of one excitation: compare them, and pool them to one run with the noise that they show.

Shapes: n repeats, c channels of all bodies, L lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.fit.noise import largest_amplitude
from kinematics.measurement import BodyChannels, Measurement
from stapeskit.arrays import Array, ComplexArray
from stapeskit.warnings import Notice

_UNLIKELY = 1e-3  # probability below which a test is reported
_POOLED_DOF = 60  # of the scatter at a line and its neighbours: the noise is known to 9 %
_LEAST_GAIN = 1e-3  # smaller drifts and outliers matter nowhere: lasers are calibrated to 1e-2


@dataclass(frozen=True)
class RepeatedRun:
    """What the repeats of one run show.

    Attributes
    ----------
    run : str
    repeats : tuple of str, (n,)
        In the order of the files.
    gains : ndarray, (n,), complex
        Factor of all values of a repeat against the mean of all.
    scatter : float
        Root mean square of the differences over their stated noise, without the gains; NaN where none is
        stated.
    notices : tuple of Notice
    """

    run: str
    repeats: tuple[str, ...]
    gains: ComplexArray
    scatter: float
    notices: tuple[Notice, ...] = ()


def pool_repeats(measurement: Measurement) -> tuple[Measurement, tuple[RepeatedRun, ...]]:
    """Return the measurement with the repeats of every run pooled, and what their comparison gave.

    Each repeat is divided by its own gain, then the weighted mean is taken. Where no noise is stated it is
    that of the scatter; where the scatter exceeds the stated noise, that is widened.
    """
    if not measurement.repeats:
        return measurement, ()
    runs = tuple(dict.fromkeys(repeat.run for repeat in measurement.repeats))
    places = [[k for k, repeat in enumerate(measurement.repeats) if repeat.run == run] for run in runs]
    compared = []
    parts: list[list[tuple[ComplexArray, Array | None]]] = []
    for run, own in zip(runs, places, strict=True):
        names = tuple(measurement.repeats[k].repeat for k in own)
        if len(own) == 1:
            parts.append([(body.value[own[0]], _sd_of(body, own[0])) for body in measurement.bodies])
            continue
        found = _compare(measurement, run, own, names)
        compared.append(found)
        widened = max(found.scatter, 1.0) if np.isfinite(found.scatter) else 1.0
        parts.append([_pooled(body, own, found.gains, widened) for body in measurement.bodies])
    bodies = tuple(
        _joined(body, [run_parts[number] for run_parts in parts])
        for number, body in enumerate(measurement.bodies)
    )
    notices = [notice for found in compared for notice in found.notices]
    if compared and any(body.sd is None or body.relative for body in measurement.bodies):
        text = "no noise is stated: it was estimated from the scatter between repeats."
        notices.append(Notice("noise_estimated", text))
    common = measurement.common_sd
    if common is not None:
        common = np.stack([np.sqrt(np.mean(common[own] ** 2, axis=0) / len(own)) for own in places])
    pooled = replace(
        measurement,
        runs=runs,
        repeats=(),
        bodies=bodies,
        common_sd=common,
        notices=(*measurement.notices, *notices),
    )
    return pooled, tuple(compared)


def _sd_of(body: BodyChannels, place: int) -> Array | None:
    return None if body.sd is None else body.sd[place]


def _weights(body: BodyChannels, own: Sequence[int]) -> Array:
    """Return 1 / sd^2, (n, c, L), zero where nothing was measured; equal where no noise is stated."""
    value = body.value[list(own)]
    sd = np.full(value.shape, largest_amplitude(value[0]) or 1.0) if body.sd is None else body.sd[list(own)]
    used = np.isfinite(value) & np.isfinite(sd) & (sd > 0.0)
    return np.where(used, 1.0 / np.where(used, sd, 1.0) ** 2, 0.0)


def _mean(value: ComplexArray | NDArray[Any], weight: Array) -> ComplexArray:
    """Return the weighted mean over repeats, (c, L); NaN where there is none."""
    total = weight.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(
            np.where(total > 0.0, np.sum(weight * np.nan_to_num(value), axis=0) / total, np.nan)
        )


def _compare(measurement: Measurement, run: str, own: Sequence[int], names: tuple[str, ...]) -> RepeatedRun:
    """Test the repeats of a run: gain against order, one repeat off, shapes that scatter."""
    values = np.concatenate([body.value[list(own)] for body in measurement.bodies], axis=1)
    weights = np.concatenate([_weights(body, own) for body in measurement.bodies], axis=1)
    gains = np.ones(len(own), dtype=complex)
    for _ in range(3):
        mean = np.nan_to_num(_mean(values / gains[:, None, None], weights))
        power = np.sum(weights * np.abs(mean) ** 2, axis=(1, 2))
        gains = np.sum(weights * np.nan_to_num(values) * mean.conj(), axis=(1, 2)) / np.maximum(power, 1e-300)
        gains = gains / np.exp(np.mean(np.log(np.where(gains == 0.0, 1.0, gains))))
    mean = np.nan_to_num(_mean(values / gains[:, None, None], weights))
    left = np.abs(np.nan_to_num(values) / gains[:, None, None] - mean) ** 2 * weights
    several = np.count_nonzero(weights, axis=0) > 1
    freedom = 2.0 * float(np.sum(np.count_nonzero(weights, axis=0)[several] - 1))
    chi2 = float(np.sum(left[:, several]))
    stated = all(body.sd is not None and not body.relative for body in measurement.bodies)
    level = chi2 / max(freedom, 1.0)
    sd = np.sqrt(level / np.maximum(power, 1e-300))  # of the real part of each gain
    notices = [*_drift(run, gains, sd), *_outlier(run, names, gains, sd, left, several)]
    if stated and freedom:
        notices += _scatter(run, level, freedom)
    return RepeatedRun(run, names, gains, float(np.sqrt(level)) if stated else float("nan"), tuple(notices))


def _drift(run: str, gains: ComplexArray, sd: Array) -> list[Notice]:
    """Report a gain or phase that grows with the order of the repeats."""
    from scipy.stats import linregress

    if len(gains) < 4:
        return []
    for what, course, unit in (("gain", np.abs(gains), 100.0), ("phase", np.angle(gains), 180.0 / np.pi)):
        trend = linregress(np.arange(len(gains)), course)
        whole = float(trend.slope) * (len(gains) - 1)
        if trend.pvalue < _UNLIKELY and abs(whole) > max(_LEAST_GAIN, 3.0 * float(np.median(sd))):
            shown = f"{unit * whole:+.2g} {'%' if what == 'gain' else 'degrees'}"
            text = (
                f"run {run}: the {what} of all channels drifts by {shown} from the first repeat to the last "
                f"(p {trend.pvalue:.1g}). Responses per reference (--reference) do not contain it."
            )
            return [Notice("repeats_differ", text)]
    return []


def _outlier(
    run: str, names: tuple[str, ...], gains: ComplexArray, sd: Array, left: Array, several: NDArray[np.bool_]
) -> list[Notice]:
    """Report one repeat whose gain or shape is unlike that of the others."""
    from scipy.special import fdtrc
    from scipy.stats import t

    count = len(gains)
    if count < 4:
        return []
    for place, name in enumerate(names):
        others = np.delete(gains, place)
        scatter = float(np.sqrt(np.sum(np.abs(others - others.mean()) ** 2) / (2.0 * (count - 2))))
        scatter = float(np.hypot(scatter, np.median(sd)))
        away = abs(gains[place] - others.mean())
        chance = (
            2.0
            * count
            * float(t.sf(away / max(scatter * np.sqrt(1.0 + 1.0 / (count - 1)), 1e-300), count - 2))
        )
        own = float(np.sum(left[place][several]))
        rest = float(np.sum(left[:, several])) - own
        number = float(np.count_nonzero(left[place][several]))
        shape = fdtrc(2.0 * number, 2.0 * number * (count - 1), own * (count - 1) / max(rest, 1e-300))
        if (chance < _UNLIKELY and away > _LEAST_GAIN) or count * shape < _UNLIKELY:
            what = f"by {100.0 * away:.2g} % in gain" if chance < _UNLIKELY else "in shape"
            text = (
                f"run {run}: repeat {name} differs from the others {what}. Look at it, and leave it out if "
                "there is a reason."
            )
            return [Notice("repeats_differ", text)]
    return []


def _scatter(run: str, level: float, freedom: float) -> list[Notice]:
    """Report repeats that scatter more than their stated noise."""
    from scipy.special import chdtrc

    if level < 1.0 or float(chdtrc(freedom, level * freedom)) > _UNLIKELY:
        return []
    text = (
        f"run {run}: the repeats scatter {np.sqrt(level):.2g} times as much as their stated noise, gains "
        "apart; the pooled standard deviations were widened accordingly."
    )
    return [Notice("repeats_differ", text)]


def _pooled(
    body: BodyChannels, own: Sequence[int], gains: ComplexArray, widened: float
) -> tuple[ComplexArray, Array]:
    """Return the mean of the repeats of a body and its standard deviation, (c, L) each."""
    value, weight = body.value[list(own)] / gains[:, None, None], _weights(body, own)
    mean, total = _mean(value, weight), weight.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        if body.sd is not None and not body.relative:
            return mean, np.where(total > 0.0, widened / np.sqrt(total), np.nan)
        square = np.sum(weight * np.abs(np.nan_to_num(value - mean)) ** 2, axis=0)
        freedom = 2.0 * np.maximum(np.count_nonzero(weight, axis=0) - 1, 0)
        width = int(np.ceil(_POOLED_DOF / max(2.0 * (len(own) - 1), 1.0)))
        level = _running(square, width) / np.maximum(_running(freedom, width), 1e-9)
        return mean, np.where((total > 0.0) & (level > 0.0), np.sqrt(level / total), np.nan)


def _running(values: Array, width: int) -> Array:
    """Return sums (c, L) over each line and its neighbours."""
    lines = values.shape[1]
    width = min(width, lines)
    start = np.clip(np.arange(lines) - width // 2, 0, lines - width)
    sums = np.concatenate([np.zeros((len(values), 1)), np.cumsum(values, axis=1)], axis=1)
    return np.asarray(sums[:, start + width] - sums[:, start])


def _joined(body: BodyChannels, parts: Sequence[tuple[ComplexArray, Array | None]]) -> BodyChannels:
    """Return the body with pooled runs; without a noise from repeats, the residuals give it later."""
    sds = [sd for _, sd in parts]
    known = all(sd is not None for sd in sds)
    sd = np.stack([part for part in sds if part is not None]) if known else None
    return replace(
        body, value=np.stack([value for value, _ in parts]), sd=sd, relative=body.relative and not known
    )
