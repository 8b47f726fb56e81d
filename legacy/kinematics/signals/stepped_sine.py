"""Stepped sine: one lock-in per step, put together to frequency responses with their noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.signals.frf_noise import Frf, check_signals, common_notice, split_noise
from legacy.kinematics.signals.lock_in import OFFSETS, SineFit, SteppedSine, fit_sine
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.faults import Fault, collect_faults, raise_all
from legacy.stapeskit.warnings import Notice

_LEAST_SINE_SHARE: float = calibrated("lock_in.least_sine_share")
# N sum w^4 / (sum w^2)^2 of a Hann window: how many lines of its spectra count as one.
_CORRELATED = 35.0 / 18.0


@dataclass(frozen=True)
class Step:
    """One frequency of a stepped sine.

    Attributes
    ----------
    reference : ndarray, (sample,)
    responses : ndarray, (channel, sample)
        The record of this step; what settles at its start is still in it.
    """

    freq_hz: float
    reference: Array
    responses: Array


def stepped_frf(
    steps: Sequence[Step], sample_rate_hz: float, how: SteppedSine | None = None, where: str = ""
) -> Frf:
    """Estimate frequency responses from a stepped sine.

    Parameters
    ----------
    steps : sequence of Step
        In any order; steps at one frequency are averaged by their noise.
    how : SteppedSine, optional
    where : str
        Place for messages.

    Returns
    -------
    Frf
        ``value`` is response over reference, both as fitted; ``reference`` its peak amplitude.

    Raises
    ------
    KinematicsError
        No step, a step too short or above half the sampling rate, or without signal in the reference; the
        faults of all steps are listed.
    """
    how = how or SteppedSine()
    fits: list[_Fitted] = []
    faults: list[Fault] = []
    for step, place in _name_steps(steps, where):
        with collect_faults(faults):
            cut = int(how.settle * len(step.reference))
            check_signals(step.reference, step.responses, sample_rate_hz, place)
            signals = np.vstack([step.reference[cut:], step.responses[:, cut:]])
            fit = fit_sine(signals, sample_rate_hz, step.freq_hz, how, place)
            _check_lead(fit, 0, place)
            ratio = fit.amplitude[1:] / fit.amplitude[0]
            error = (fit.residual[1:] - ratio[:, None] * fit.residual[0]) / fit.amplitude[0]
            fits.append(_Fitted(step.freq_hz, fit, ratio, error, abs(fit.amplitude[0])))
    raise_all(KinematicsError, faults)
    return _spectrum(fits, how)


def stepped_amplitudes(
    steps: Sequence[Step], sample_rate_hz: float, how: SteppedSine | None = None, where: str = ""
) -> Frf:
    """Return the amplitudes of channels recorded together when there is no reference.

    Parameters
    ----------
    steps, sample_rate_hz, how, where
        As in stepped_frf; ``reference`` of a step is not used, the strongest channel leads.

    Returns
    -------
    Frf
        ``value`` is the peak amplitude, its phase that of the leading channel's record: one free phase a
        line, the same for all channels. ``reference`` is 1.
    """
    how = how or SteppedSine()
    fits: list[_Fitted] = []
    faults: list[Fault] = []
    for step, place in _name_steps(steps, where):
        with collect_faults(faults):
            signals = step.responses[:, int(how.settle * step.responses.shape[1]) :]
            lead = int(np.argmax(np.std(signals, axis=1)))
            check_signals(signals[lead], signals, sample_rate_hz, place)
            fit = fit_sine(signals, sample_rate_hz, step.freq_hz, how, place)
            _check_lead(fit, lead, place)
            turn = abs(fit.amplitude[lead]) / fit.amplitude[lead]
            fits.append(_Fitted(step.freq_hz, fit, fit.amplitude * turn, fit.residual * turn, 1.0))
    raise_all(KinematicsError, faults)
    return _spectrum(fits, how)


@dataclass(frozen=True)
class _Fitted:
    """What one step gives: the value (channel,) and samples of its error (channel, offset)."""

    nominal: float
    fit: SineFit
    value: ComplexArray
    error: ComplexArray
    reference: float


def _name_steps(steps: Sequence[Step], where: str) -> list[tuple[Step, str]]:
    if not steps:
        step = "Give the steps as a column freq_hz or a table"
        raise KinematicsError.of("a stepped sine", "of at least one step", "none", where, step)
    start = f"{where}, " if where else ""
    return [(step, f"{start}step {k} at {step.freq_hz:g} Hz") for k, step in enumerate(steps, start=1)]


def _check_lead(fit: SineFit, lead: int, place: str) -> None:
    if not (abs(fit.amplitude[lead]) > 5.0 * fit.sd[lead] and fit.share[lead] > _LEAST_SINE_SHARE):
        step = "Check the table of steps and that the reference was connected"
        raise KinematicsError.of("the reference", "a sine well above its noise", "noise", place, step)


def _spectrum(fits: list[_Fitted], how: SteppedSine) -> Frf:
    """Join the steps, averaging those at one frequency."""
    groups: dict[float, list[_Fitted]] = {}
    for fit in fits:
        groups.setdefault(fit.nominal, []).append(fit)
    groups = dict(sorted(groups.items()))
    pairs = [(fit.nominal, fit.fit) for fit in fits]
    clock, clock_notices = _clock(pairs, how)
    freq = np.array(list(groups)) * clock
    parts = [_line(group) for group in groups.values()]
    value = np.stack([part[0] for part in parts], axis=1)
    blocks = np.stack([part[1] for part in parts], axis=2)
    raw = np.mean(np.abs(blocks) ** 2, axis=0)
    own, common = split_noise(lambda: blocks, raw, value, float(len(blocks)))
    own = own * np.array([_small_sample_factor(group) for group in groups.values()])
    common_sd = np.sqrt(0.5 * common)
    size = np.array([np.mean([fit.reference for fit in group]) for group in groups.values()])
    notices = (*common_notice(common_sd), *clock_notices, *_step_notices(pairs))
    return Frf(freq, value, np.sqrt(0.5 * own), None, float("nan"), common_sd, size, notices)


def _small_sample_factor(group: list[_Fitted]) -> float:
    """Return m / (m - 1) for m independent samples of the noise of a line."""
    samples = sum(fit.error.shape[1] for fit in group) / _CORRELATED
    return samples / max(samples - 1.0, 0.5 * samples)


def steps_of(column: Array, reference: Array, responses: Array, where: str = "") -> list[Step]:
    """Cut a record into steps where a column with the set frequency changes.

    Parameters
    ----------
    column : ndarray, (sample,)
        Hz; 0 or NaN between the steps.
    reference : ndarray, (sample,)
    responses : ndarray, (channel, sample)
    """
    set_to = np.where(np.isfinite(column), column, 0.0)
    edges = np.flatnonzero(np.diff(set_to)) + 1
    bounds = np.concatenate([[0], edges, [len(set_to)]])
    steps = [
        Step(float(set_to[a]), reference[a:b], responses[:, a:b])
        for a, b in pairwise(bounds)
        if set_to[a] > 0.0
    ]
    if not steps:
        step = "Write the set frequency of every sample into it"
        raise KinematicsError.of("the column freq_hz", "positive in some samples", "0", where, step)
    return steps


def _line(group: list[_Fitted]) -> tuple[ComplexArray, ComplexArray]:
    """Return the value at one line, (channel,), and samples of its error, (offset, channel)."""
    used = 2 * OFFSETS
    errors = [fit.error[:, np.arange(used) % fit.error.shape[1]] for fit in group]
    power = np.array([np.mean(np.abs(error) ** 2, axis=1) for error in errors])
    weight = 1.0 / np.maximum(power, np.finfo(float).tiny)
    share = weight / np.sum(weight, axis=0)
    value = np.sum(share * np.array([fit.value for fit in group]), axis=0)
    joined = np.sum([part[:, None] * error for part, error in zip(share, errors, strict=True)], axis=0)
    return value, np.asarray(joined.T)


def _clock(fits: list[tuple[float, SineFit]], how: SteppedSine) -> tuple[float, list[Notice]]:
    """Return the factor from nominal to true frequencies; 1 when none is seen."""
    apart = np.array([fit.freq_hz / nominal - 1.0 for nominal, fit in fits])
    middle = float(np.median(apart))
    scatter = 1.5 * float(np.median(np.abs(apart - middle))) / np.sqrt(len(apart))
    if not how.refine or abs(middle) <= max(1e-6, 5.0 * scatter):
        return 1.0, []
    text = (
        f"the sines lie {1e6 * middle:+.3g} ppm (median of the steps) from their nominal frequencies: the "
        "clocks of generator and sampler differ; the frequencies are corrected by it."
    )
    return 1.0 + middle, [Notice("clock_differs", text)]


def _step_notices(fits: list[tuple[float, SineFit]]) -> list[Notice]:
    notices = []
    unsteady = [nominal for nominal, fit in fits if fit.unsteady > 6.0]
    if unsteady:
        text = (
            f"{len(unsteady)} of {len(fits)} steps are not steady, the first at {unsteady[0]:g} Hz: the "
            "amplitude changes between the halves of the step by more than six times its noise. Let more "
            "of each step settle."
        )
        notices.append(Notice("not_steady", text))
    running = [(abs(fit.run_hz) / nominal, nominal) for nominal, fit in fits if fit.run_hz]
    if running:
        most, place = max(running)
        text = (
            f"the frequency runs within {len(running)} of {len(fits)} steps, by up to {1e6 * most:.4g} ppm "
            f"at {place:g} Hz: it was followed, and responses are those at its mean."
        )
        notices.append(Notice("frequency_runs", text))
    loud = [(float(np.max(_real_distortion(fit))), nominal) for nominal, fit in fits]
    worst, place = max(loud)
    if worst > 0.05:
        text = (
            f"harmonics reach {100.0 * worst:.3g} % of the line at {place:g} Hz: excitation or response is "
            "distorted; the line itself was fitted beside them."
        )
        notices.append(Notice("distortion", text))
    return notices


def _real_distortion(fit: SineFit) -> Array:
    """Return the distortion of the channels less what noise makes of it, (channel,)."""
    size = np.maximum(np.abs(fit.amplitude), np.finfo(float).tiny)
    power = np.sum(np.abs(fit.harmonics) ** 2, axis=1) - 4.0 * fit.harmonics.shape[1] * fit.sd**2
    return np.sqrt(np.maximum(power, 0.0)) / size
