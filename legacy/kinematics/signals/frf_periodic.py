"""Frequency responses to periodic excitation: whole periods, no window, noise between the periods."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.signals.frf import Records, checked_records
from legacy.kinematics.signals.frf_noise import Frf, common_notice, smoothed, split_noise, steady_common
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.warnings import Notice

# Samples by which a block may miss a whole number of periods.
_WHOLE = 1e-3
# Tried periods a block: more would need a clock better than 1e-3 of a sample.
_MOST_PERIODS_A_BLOCK = 50
# Degrees of freedom that neighbouring lines are gathered for: sd known to 9 %.
_STEADY_DOF = 60


@dataclass(frozen=True)
class Periodic:
    """How records of periodic excitation are averaged.

    Attributes
    ----------
    period_s : float
        Period of the excitation, s.
    skip : int
        Periods at the start of every record left out while the response settles.
    threshold : float
        Lines count as excited when the reference reaches this share of its largest amplitude and stands
        clearly out of its noise.

    Raises
    ------
    KinematicsError
        A value out of its range.
    """

    period_s: float
    skip: int = 1
    threshold: float = 1e-3

    def __post_init__(self) -> None:
        faults = []
        if not (np.isfinite(self.period_s) and self.period_s > 0.0):
            faults.append(Fault("the period", "positive, in s", self.period_s))
        if self.skip < 0:
            faults.append(Fault("the skipped periods", "0 or more", self.skip))
        if not 0.0 <= self.threshold < 1.0:
            faults.append(Fault("the threshold of excited lines", "from 0 to below 1", self.threshold))
        raise_all(KinematicsError, faults)

    def block(self, sample_rate_hz: float, where: str = "") -> tuple[int, int]:
        """Return samples and periods of the shortest block of whole periods and whole samples.

        Raises
        ------
        KinematicsError
            No such block of up to 50 periods.
        """
        samples = self.period_s * sample_rate_hz
        for periods in range(1, _MOST_PERIODS_A_BLOCK + 1):
            whole = round(periods * samples)
            if whole >= 2 and abs(periods * samples - whole) < _WHOLE:
                return whole, periods
        step = "Give the exact period, or sample in step with the generator"
        raise KinematicsError.of(
            "the period", "whole samples", f"{samples:.6g} samples of the record", where, step
        )


def periodic_frf(records: Records, sample_rate_hz: float, how: Periodic, where: str = "") -> Frf:
    """Estimate frequency responses to periodic excitation at the lines that are excited.

    Parameters
    ----------
    records : sequence of (ndarray (sample,), ndarray (channel, sample))
        Reference and responses of every record. Records may hold different realisations of the signal.
    where : str
        Place for messages.

    Raises
    ------
    KinematicsError
        Fewer than two periods are left, the period is no whole number of samples, or no line is excited.

    Notes
    -----
    With X_p, Y_p the discrete Fourier transforms of the periods: H = sum X* Y / sum |X|^2 over the means of
    the records, and E|dH|^2 = mean |V|^2 / sum |X|^2 with V_p = (Y_p - Ym) - H (X_p - Xm): noise in
    both signals and its correlation are in it (Pintelon and Schoukens 2012, sec. 2.5). With few periods V^2
    is averaged over neighbouring lines. Where records differ by more than their noise (nonlinear
    distortion, drift), the standard deviation is widened to what they differ by, with a warning.
    """
    checked = checked_records(records, sample_rate_hz, where)
    samples, per_block = how.block(sample_rate_hz, where)
    skip = -(-how.skip // per_block) * samples
    stacks = [(_blocks(x[skip:], samples), _blocks(y[:, skip:], samples)) for x, y in checked]
    counts = np.array([x.shape[0] for x, _ in stacks])
    if np.any(counts < 2):
        got = f"{int(np.min(counts))} blocks of {samples} samples after {how.skip} skipped periods"
        step = "Record more periods, or skip fewer"
        raise KinematicsError.of("a record", "at least two blocks of periods long", got, where, step)
    means = [(x.mean(axis=0), y.mean(axis=0)) for x, y in stacks]
    lines = _find_excited(stacks, means, how.threshold, where)
    freq = (lines + 1) * sample_rate_hz / samples
    power = sum(n * np.abs(x[lines]) ** 2 for n, (x, _) in zip(counts, means, strict=True))
    cross = sum(n * x[lines].conj() * y[:, lines] for n, (x, y) in zip(counts, means, strict=True))
    value = np.asarray(cross / power)
    residuals = [
        (y[p] - ym)[:, lines] - value * (x[p] - xm)[lines]
        for (x, y), (xm, ym) in zip(stacks, means, strict=True)
        for p in range(len(x))
    ]
    dof = float(np.sum(counts - 1))
    raw = np.sum([np.abs(block) ** 2 for block in residuals], axis=0) / dof
    own, common = split_noise(lambda: residuals, raw, value, dof)
    width = 1 if dof >= _STEADY_DOF else int(np.ceil(_STEADY_DOF / dof))
    own, raw = smoothed(own, width, dof), smoothed(raw, width)
    common = steady_common(common, width)
    notices: list[Notice] = []
    if len(stacks) > 1:
        between = sum(
            n * np.abs(y[:, lines] - value * x[lines]) ** 2 for n, (x, y) in zip(counts, means, strict=True)
        ) / (len(stacks) - 1)
        own, notices = _widen(own, raw, np.asarray(between), len(stacks))
    if dof < 5:
        text = f"only {int(np.sum(counts))} periods were averaged: the stated noise is rough."
        notices.append(Notice("few_averages", text))
    common_sd = np.sqrt(common / (2.0 * power))
    return Frf(
        freq,
        value,
        np.sqrt(own / (2.0 * power)),
        _coherence(stacks, lines),
        float(np.sum(counts)),
        common_sd,
        np.sqrt(power / np.sum(counts)) * 2.0 / samples,
        (*common_notice(common_sd), *notices),
    )


def _blocks(signal: Array, samples: int) -> ComplexArray:
    """Return the lines above 0 Hz of every block, (block, ..., line)."""
    count = signal.shape[-1] // samples
    cut = signal[..., : count * samples].reshape(*signal.shape[:-1], count, samples)
    lines = np.fft.rfft(np.moveaxis(cut, -2, 0), axis=-1)
    return np.asarray(lines[..., 1 : (samples + 1) // 2])


def _find_excited(
    stacks: list[tuple[ComplexArray, ComplexArray]],
    means: list[tuple[ComplexArray, ComplexArray]],
    threshold: float,
    where: str,
) -> NDArray[np.intp]:
    good = np.ones(stacks[0][0].shape[1], dtype=bool)
    for (x, _), (mean, _) in zip(stacks, means, strict=True):
        spread = np.sum(np.abs(x - mean) ** 2, axis=0) / (len(x) - 1) / len(x)
        noise = np.maximum(smoothed(spread[None], 41)[0], spread)
        size = np.abs(mean)
        good &= (size > threshold * np.max(size, initial=0.0)) & (size**2 > 25.0 * noise) & (size > 0.0)
    lines = np.flatnonzero(good)
    if not len(lines):
        step = "Check the period and the reference; random excitation has no period"
        raise KinematicsError.of("the reference", "periodic, with lines above its noise", "none", where, step)
    return lines


def _coherence(stacks: list[tuple[ComplexArray, ComplexArray]], lines: NDArray[np.intp]) -> Array:
    tiny = np.finfo(float).tiny
    xx = sum(np.sum(np.abs(x[:, lines]) ** 2, axis=0) for x, _ in stacks)
    yy = sum(np.sum(np.abs(y[:, :, lines]) ** 2, axis=0) for _, y in stacks)
    xy = sum(np.sum(x[:, None, lines].conj() * y[:, :, lines], axis=0) for x, y in stacks)
    return np.clip(np.abs(np.asarray(xy)) ** 2 / np.maximum(np.asarray(xx * yy), tiny), 0.0, 1.0)


def _widen(own: Array, raw: Array, between: Array, records: int) -> tuple[Array, list[Notice]]:
    """Widen the noise of channels whose records differ by more than the noise within them."""
    ratio = np.mean(between, axis=1) / np.maximum(np.mean(raw, axis=1), np.finfo(float).tiny)
    limit = 1.0 + 5.0 / np.sqrt((records - 1) * own.shape[1])
    wide = ratio > max(limit, 1.5)
    if not np.any(wide):
        return own, []
    text = (
        f"{int(np.sum(wide))} of {len(wide)} channels differ between records by up to "
        f"{float(np.sqrt(np.max(ratio))):.3g} times their noise within a record (nonlinear distortion or "
        "drift): their standard deviation was widened by it."
    )
    return own * np.where(wide, ratio, 1.0)[:, None], [Notice("records_differ", text)]
