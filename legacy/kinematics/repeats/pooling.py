"""Pool repeats and levels of every excitation into one run, after comparing them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.measurement import BodyChannels, Measurement, Take
from legacy.kinematics.repeats.comparison import ALARM, RunRepeats, compare
from legacy.kinematics.repeats.noise_degrees_of_freedom import inverse_moments, stated_freedom
from legacy.kinematics.repeats.repeat_shapes import Shapes, Stack, shapes_of
from legacy.kinematics.repeats.repeat_shift import frequency_shifts
from legacy.kinematics.repeats.scatter_noise import scatter_noise
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.records.motion import RigidMotion, SharedErrors
from legacy.stapeskit.warnings import Notice

_COHERENT_SHARE: float = calibrated("repeats.coherent_share")
_WIDENED_SCATTER: float = calibrated("repeats.widened_scatter")


@dataclass(frozen=True)
class Pooled:
    """A measurement with its repeats pooled, and the comparison of the repeats.

    Attributes
    ----------
    measurement : Measurement
        One entry for each excitation; ``takes`` is empty.
    repeats : tuple of RunRepeats
        One for each run that was measured more than once.
    """

    measurement: Measurement
    repeats: tuple[RunRepeats, ...] = ()


def pool_repeats(measurement: Measurement, alarm: float = ALARM) -> Pooled:
    """Compare the takes of every run and pool them.

    Parameters
    ----------
    alarm : float
        Probability of any alarm in a measurement without fault.

    Notes
    -----
    Every take is brought to the mean gain of its run (with levels: to the highest level) line by line, by
    the gain that all channels of all bodies show together: excitations that differ a little in amplitude
    cost nothing, and ratios between bodies keep their noise only. Takes are weighted by their amplitude
    over their noise. Where no standard deviation is stated, the scatter between takes gives it, pooled
    over neighbouring lines of each channel to f degrees of freedom and widened by f / (f - 2), the mean of
    1 / chi2, so that chi2 of later fits keeps its mean; f is smaller where neighbouring lines scatter as one.
    Stated standard deviations that scatter from take to take as estimates of few averages do are raised to
    what they mean on the average; where takes differ by more than stated, the larger of both counts.
    """
    if not measurement.takes:
        return Pooled(measurement)
    runs = tuple(dict.fromkeys(take.run for take in measurement.takes))
    parts, reports = [], []
    notices = list(measurement.notices)
    for run in runs:
        places, takes, take_notices = _takes_of(measurement, run)
        notices += take_notices
        if len(places) == 1:
            parts.append(_take_single_run(measurement, places[0]))
            continue
        shapes = _shapes(measurement, places)
        report = _compare(measurement, run, takes, shapes, _probability_of_one(alarm, runs))
        part, from_scatter = _pool(shapes, takes, report.sd_factor)
        reports.append(replace(report, noise_from_repeats=from_scatter))
        parts.append(part)
        notices += report.notices(len(runs) > 1)
    if any(report.noise_from_repeats for report in reports):
        text = "no noise is stated: it was estimated from the scatter between repeats."
        notices.append(Notice("noise_from_repeats", text))
    bodies = _split(measurement, parts, len(reports) == len(runs))
    merged = replace(measurement, runs=runs, bodies=bodies, takes=(), notices=tuple(notices))
    return Pooled(merged, tuple(reports))


def separate_repeats(measurement: Measurement, alarm: float = ALARM) -> Pooled:
    """Compare the takes of every run and keep each as a separate run."""
    runs = tuple(dict.fromkeys(take.run for take in measurement.takes))
    reports = []
    notices = list(measurement.notices)
    for run in runs:
        places, takes, take_notices = _takes_of(measurement, run)
        notices += take_notices
        if len(places) > 1:
            shapes = _shapes(measurement, places)
            report = _compare(measurement, run, takes, shapes, _probability_of_one(alarm, runs))
            reports.append(replace(report, were_pooled=False))
            notices += report.notices(len(runs) > 1)
    return Pooled(replace(measurement, takes=(), notices=tuple(notices)), tuple(reports))


def _compare(
    measurement: Measurement, run: str, takes: Sequence[Take], shapes: Shapes, alarm: float
) -> RunRepeats:
    report = compare(run, takes, shapes, shapes.stack.known, alarm)
    sizes = [len(body.points) for body in measurement.bodies]
    shift, share = frequency_shifts(shapes, measurement.freq_hz, np.repeat(np.arange(len(sizes)), sizes))
    return replace(report, shift=shift, shift_share=share)


def _probability_of_one(alarm: float, runs: Sequence[str]) -> float:
    """Return the probability of an alarm in one of several runs."""
    return 1.0 - (1.0 - alarm) ** (1.0 / len(runs))


def _takes_of(measurement: Measurement, run: str) -> tuple[list[int], list[Take], list[Notice]]:
    """Return the takes of a run that hold anything, and a warning on those that do not."""
    takes = measurement.takes
    places = [number for number, take in enumerate(takes) if take.run == run]
    live = [
        place
        for place in places
        if any(np.nansum(np.abs(body.displacement[place])) > 0.0 for body in measurement.bodies)
    ]
    measured = live or places
    dead = [takes[place].name for place in places if place not in measured]
    text = f"{', '.join(dead)}: zeros or empty cells throughout; not compared or pooled."
    notices = [Notice("repeat_empty", text)] if dead else []
    return measured, [takes[place] for place in measured], notices


def _shapes(measurement: Measurement, places: Sequence[int]) -> Shapes:
    """Return the shapes of the takes of a run; their scatter gives the noise where none is stated."""
    rate = (2.0 * np.pi * measurement.freq_hz) ** measurement.order
    stack = _with_believed_noise(Stack(measurement.bodies, tuple(places), rate))
    shapes = shapes_of(stack)
    if not stack.known and (noise := scatter_noise(shapes)) is not None:
        del shapes
        shapes = shapes_of(replace(stack, noise=noise))
    return shapes


def _with_believed_noise(stack: Stack) -> Stack:
    """Return the takes with the noise that stated sd mean on the average, when they are estimates."""
    takes = len(stack.places)
    if not stack.known or takes < 2:
        return stack

    def logs() -> Iterator[Array]:
        for part in stack.blocks():
            sd = stack.sd(part)
            with np.errstate(invalid="ignore", divide="ignore"):
                yield np.where(sd > 0.0, 2.0 * np.log(sd), np.nan)

    mean, doubt = inverse_moments(stated_freedom(logs()), takes)
    if mean <= 1.0:
        return stack
    noise = np.broadcast_to(np.sqrt(mean), (stack.channels, len(stack.rate)))
    return replace(stack, noise=noise, doubt=doubt)


def _take_single_run(measurement: Measurement, place: int) -> tuple[ComplexArray, Array | None]:
    value = np.concatenate([body.displacement[place] for body in measurement.bodies])
    if any(body.sd is None for body in measurement.bodies):
        return value, None
    return value, np.concatenate([body.sd[place] for body in measurement.bodies if body.sd is not None])


def _pool(
    shapes: Shapes, takes: Sequence[Take], factor: float
) -> tuple[tuple[ComplexArray, Array | None], bool]:
    """Return the pooled values and standard deviations (channel, freq), and whether the scatter gave them."""
    stack, mean = shapes.stack, _mean_gain(shapes, takes)
    common = np.empty(shapes.noise_scale.shape, dtype=complex)
    spread = np.empty(common.shape)
    for part in stack.blocks():
        value = stack.value(part)
        used = np.isfinite(value.real) & np.isfinite(stack.sd(part))
        gain = shapes.gain[part].T[:, None, :]
        total = np.sum(np.where(used, np.abs(gain) ** 2, 0.0), axis=0)
        white = np.where(used, value, 0.0) / shapes.take_scale[part].T[:, None, :]
        with np.errstate(invalid="ignore", divide="ignore"):
            common[:, part] = np.sum(gain.conj() * white, axis=0) / total * mean[part]
            spread[:, part] = shapes.noise_scale[:, part] * np.abs(mean[part]) / np.sqrt(total)
        common[:, part][total <= 0.0] = np.nan
        spread[:, part][total <= 0.0] = np.nan
    noise = scatter_noise(shapes) if not stack.known or factor > _WIDENED_SCATTER else None
    if stack.known:
        spread *= 1.0 if noise is None else np.maximum(noise, 1.0)
        spread *= factor if noise is None and factor > _WIDENED_SCATTER else 1.0
        return (common, spread), False
    if noise is None:
        return (common, None), False
    spread *= noise
    return (common, spread), True


def _mean_gain(shapes: Shapes, takes: Sequence[Take]) -> ComplexArray:
    """Return the gain (freq,) to which the takes are scaled."""
    own = shapes.gain * shapes.take_scale
    size = np.abs(own)
    level = np.array([take.level for take in takes])
    with np.errstate(divide="ignore"):
        if np.all(np.isfinite(level)) and np.ptp(level) > 0.0:
            per_level = np.log(np.maximum(size, 1e-300)) - np.log(level)
            amplitude = np.exp(np.mean(per_level, axis=1)) * np.max(level)
        else:
            amplitude = np.mean(size, axis=1)
    turn = np.sum(own, axis=1)
    apart = np.abs(turn) < _COHERENT_SHARE * np.sum(size, axis=1)
    return np.asarray(amplitude * np.exp(1j * np.angle(np.where(apart, own[:, 0], turn))))


def _split(
    measurement: Measurement, parts: Sequence[tuple[ComplexArray, Array | None]], scattered: bool
) -> tuple[BodyChannels, ...]:
    value = np.stack([part[0] for part in parts])
    known = [part[1] for part in parts if part[1] is not None]
    pieces, start = [], 0
    for body in measurement.bodies:
        mine = slice(start, start + len(body.points))
        start = mine.stop
        if len(known) < len(parts):
            pieces.append(replace(body, displacement=value[:, mine], sd=None, relative=True))
            continue
        sd = np.stack(known)[:, mine]
        pieces.append(
            replace(body, displacement=value[:, mine], sd=sd, relative=body.relative and not scattered)
        )
    return tuple(pieces)


def with_gain_errors(motion: RigidMotion, repeats: Sequence[RunRepeats]) -> RigidMotion:
    """Add the error of the pooled gain of every run to the errors that all lines share.

    Parameters
    ----------
    motion : RigidMotion
        Absolute, with the runs that were pooled.

    Notes
    -----
    All bodies and lines move with the gain, so responses per reference do not contain it: d q / d ln(gain)
    is q, d q / d phase is i q.
    """
    names: list[str] = []
    variances: list[float] = []
    derivatives = []
    for report in repeats:
        run = motion.runs.index(report.run)
        parts = (("gain", report.gain_sd, 1.0 + 0.0j), ("phase", report.phase_sd, 1.0j))
        for name, sd, factor in parts:
            if not np.isfinite(sd) or sd <= 0.0:
                continue
            names.append(f"repeats.{report.run}.{name}")
            variances.append(sd**2)
            moved = np.zeros_like(motion.q)
            moved[run] = factor * motion.q[run]
            derivatives.append(moved)
    if not names:
        return motion
    added = SharedErrors(tuple(names), np.diag(variances), np.stack(derivatives))
    return replace(motion, shared=added if motion.shared is None else _join(motion.shared, added))


def _join(first: SharedErrors, second: SharedErrors) -> SharedErrors:
    count = len(first.names)
    covariance = np.zeros((count + len(second.names),) * 2)
    covariance[:count, :count] = first.covariance
    covariance[count:, count:] = second.covariance
    derivatives = np.concatenate([first.derivatives, second.derivatives])
    return SharedErrors((*first.names, *second.names), covariance, derivatives)
