"""Repeats of one excitation: pool them to one run with the noise that they show, and name one that is off.

Shapes: n repeats, c channels of all bodies, L lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kinematics.fit.noise import largest_amplitude
from kinematics.measurement import BodyChannels, Measurement
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import list_some
from stapeskit.warnings import Notice

_UNLIKELY = 1e-3  # probability below which a repeat is off, or scatter exceeds the stated noise
_POOLED_DOF = 60  # of the scatter at a line and its neighbours: the noise is known to 9 %
_LARGE_GAIN, _MANY_SD = 0.1, 6.0  # the level of a shaker that is set again differs by some percent
_FEWEST = 4  # repeats of which one can be told from the others


@dataclass(frozen=True)
class RepeatedRun:
    """What the repeats of one run show.

    Attributes
    ----------
    repeats : tuple of str, (n,)
        In the order of the files.
    gains : ndarray, (n,), complex
        Factor of all values of a repeat against the mean of all.
    scatter : float
        Root mean square of the differences over their stated noise, without the gains; NaN where none is
        stated.
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
    compared = [_compare(measurement, run, own) for run, own in zip(runs, places, strict=True)]
    stated = _stated(measurement)
    bodies = []
    for body in measurement.bodies:
        parts = [_pooled(body, own, found) for own, found in zip(places, compared, strict=True)]
        sd = np.stack([part[1] for part in parts])
        known = stated or all(len(own) > 1 for own in places)
        value = np.stack([part[0] for part in parts])
        bodies.append(
            replace(body, value=value, sd=sd if known else None, relative=body.relative and not known)
        )
    compared = [found for found in compared if len(found.repeats) > 1]
    notices = [notice for found in compared for notice in found.notices]
    if compared and not stated:
        text = "no noise is stated: it was estimated from the scatter between repeats."
        notices.append(Notice("noise_estimated", text))
    pooled = replace(
        measurement,
        runs=runs,
        repeats=(),
        bodies=tuple(bodies),
        notices=(*measurement.notices, *notices),
    )
    return pooled, tuple(compared)


def _stated(measurement: Measurement) -> bool:
    """Return whether the noise of all bodies is stated, and not only relative."""
    return all(body.is_noise_stated for body in measurement.bodies)


def _weights(body: BodyChannels, own: Sequence[int]) -> Array:
    """Return 1 / sd^2, (n, c, L), zero where nothing was measured; equal where no noise is stated."""
    value = body.value[list(own)]
    sd = np.full(value.shape, largest_amplitude(value[0]) or 1.0) if body.sd is None else body.sd[list(own)]
    used = np.isfinite(value) & np.isfinite(sd) & (sd > 0.0)
    return np.where(used, 1.0 / np.where(used, sd, 1.0) ** 2, 0.0)


def _mean(value: ComplexArray, weight: Array) -> ComplexArray:
    """Return the weighted mean over repeats, (c, L); NaN where there is none."""
    total = weight.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.sum(weight * np.nan_to_num(value), axis=0) / total
    return np.asarray(np.where(total > 0.0, mean, np.nan))


def _compare(measurement: Measurement, run: str, own: Sequence[int]) -> RepeatedRun:
    """Find the gain of every repeat, the scatter without the gains, and one repeat that is off."""
    from scipy.special import chdtrc, fdtrc

    names, count = tuple(measurement.repeats[k].repeat for k in own), len(own)
    values = np.nan_to_num(np.concatenate([body.value[list(own)] for body in measurement.bodies], axis=1))
    weights = np.concatenate([_weights(body, own) for body in measurement.bodies], axis=1)
    gains = np.ones(count, dtype=complex)
    for _ in range(3):
        mean = np.nan_to_num(_mean(values / gains[:, None, None], weights))
        power = np.sum(weights * np.abs(mean) ** 2, axis=(1, 2))
        gains = np.sum(weights * values * mean.conj(), axis=(1, 2)) / np.maximum(power, 1e-300)
        gains = gains / _common(gains)
    mean = np.nan_to_num(_mean(values / gains[:, None, None], weights))
    several = np.count_nonzero(weights, axis=0) > 1
    left = np.where(several, np.abs(values - gains[:, None, None] * mean) ** 2 * weights, 0.0)
    freedom = 2.0 * float(np.sum(np.maximum(np.count_nonzero(weights, axis=0) - 1, 0)))
    energy = np.sum(left, axis=(1, 2))
    number = 2.0 * np.count_nonzero(weights * several, axis=(1, 2))
    level = float(energy.sum()) / max(freedom, 1.0)
    sd = float(np.sqrt(np.median(level / np.maximum(power, 1e-300))))
    notices = _gain_notices(run, names, gains, sd)
    worst = int(np.argmax(energy / np.maximum(number, 1.0)))
    ratio = energy[worst] * (count - 1) / max(float(energy.sum() - energy[worst]), 1e-300)
    chance = float(fdtrc(max(number[worst], 1.0), max(number[worst] * (count - 1), 1.0), ratio))
    if count >= _FEWEST and count * chance < _UNLIKELY and not notices:
        text = (
            f"run {run}: repeat {names[worst]} differs from the others (p {count * chance:.1g}). Look at it, "
            "and leave it out if there is a reason."
        )
        notices.append(Notice("repeats_differ", text))
    if not (_stated(measurement) and freedom):
        return RepeatedRun(run, names, gains, float("nan"), tuple(notices))
    if level > 1.0 and float(chdtrc(freedom, level * freedom)) < _UNLIKELY:
        text = (
            f"run {run}: the repeats scatter {np.sqrt(level):.2g} times as much as their stated noise, gains "
            "apart; the pooled standard deviations were widened accordingly."
        )
        notices.append(Notice("repeats_differ", text))
    return RepeatedRun(run, names, gains, float(np.sqrt(level)), tuple(notices))


def _common(gains: ComplexArray) -> complex:
    """Return the geometric mean of the sizes of gains (n,), with the phase of most of them."""
    size = np.where(gains == 0.0, 1.0, np.abs(gains))
    phases = gains / size
    whole = complex(np.sum(phases))
    if abs(whole) < 0.5:  # half of them have the other sign
        whole = complex(phases[0]) or 1.0
    return complex(np.exp(np.mean(np.log(size))) * whole / abs(whole))


def _gain_notices(run: str, names: Sequence[str], gains: ComplexArray, sd: float) -> list[Notice]:
    """Report gains that differ by more than the level of a shaker does; ``sd`` is that of one by noise."""
    off = np.flatnonzero(np.abs(gains - 1.0) > _LARGE_GAIN + _MANY_SD * sd)
    if not off.size:
        return []
    factors = list_some(f"repeat {names[k]} ({gains[k].real:.3g}{gains[k].imag:+.2g}i)" for k in off.tolist())
    text = (
        f"run {run}: of {len(gains)} repeats these differ from the mean by a factor, which moves the pooled "
        f"values: {factors}. Leave the wrong ones out; responses per reference (--reference) are free of it."
    )
    return [Notice("repeats_differ", text)]


def _pooled(body: BodyChannels, own: Sequence[int], found: RepeatedRun) -> tuple[ComplexArray, Array]:
    """Return the mean of the repeats of a body and its standard deviation, (c, L) each."""
    from scipy.ndimage import uniform_filter1d

    value, weight = body.value[list(own)] / found.gains[:, None, None], _weights(body, own)
    mean, total = _mean(value, weight), weight.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        if body.is_noise_stated:
            widened = max(found.scatter, 1.0) if np.isfinite(found.scatter) else 1.0
            return mean, np.where(total > 0.0, widened / np.sqrt(total), np.nan)
        square = np.sum(weight * np.abs(np.nan_to_num(value - mean)) ** 2, axis=0)
        freedom = 2.0 * np.maximum(np.count_nonzero(weight, axis=0) - 1, 0)
        width = int(np.ceil(_POOLED_DOF / max(2.0 * (len(own) - 1), 1.0)))
        near = [uniform_filter1d(part, min(width, part.shape[1]), axis=1) for part in (square, freedom)]
        level = near[0] / np.maximum(near[1], 1e-9)
        return mean, np.where((total > 0.0) & (level > 0.0), np.sqrt(level / total), np.nan)
