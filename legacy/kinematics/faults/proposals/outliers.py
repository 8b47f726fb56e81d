"""Sparse outliers: single values far off the motion that all others show."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.proposals.misfitting_body import Cause, MisfittingBody, Remedy
from legacy.kinematics.fit.line_noise import LineNoise
from legacy.kinematics.fit.noise_spectrum import noise_course
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.stapeskit.arrays import Array

# Probability by which noise alone passes for an outlier: a few values of thousands, which cost nothing.
_CHANCE = 1e-3
# Outliers are sparse up to these shares: of all values, of the values of a line that has any, of a channel.
_OF_ALL, _OF_LINE, _OF_CHANNEL = 0.2, 0.5, 0.6
_LEAST = 3
# Probability of values that are surely outliers, and of their number by chance.
_SURELY, _NUMBER = 1e-5, 1e-4
# Outliers are single: so many at most have another one at a neighbouring line of their channel.
_WITH_NEIGHBOUR = 0.5
# Log likelihood (natural) that outliers must gain beyond what their places cost. Chosen by judgement, well
# above chance (e^-10 is 5e-5); measured: at 5 and at 20 no verdict changes in 26 simulated scenes (10
# points of a stapes, 5 of a footplate): clean, with spikes, drop-outs or multiples as in
# tests/kinematics/faults/test_causes.py, and with a third of the faults of benchmarks/fault_scenes.py.
_GAIN = 10.0
# Rounds in which outliers and the course of the noise without them are found.
_ROUNDS = 4
# Lines on each side whose level counts: single loud lines, such as those of mains hum, do not move a median.
_AROUND = 4
# Values that are looked at to see whether there may be any.
_SAMPLE = 200_000
# Share of its noise that a residual holds at least, and what keeps lines solvable that do not determine
# the motion.
_LEAST_LEFT, _RIDGE = 0.02, 1e-12
# Values below this share of what the motion makes there have dropped out.
_DROPPED, _MOSTLY = 0.95, 0.8


def outliers(suspect: MisfittingBody) -> Iterator[Cause]:
    """Yield sparse outliers.

    Notes
    -----
    |residual / sd|^2 / 2 of complex noise is exponential with mean 1; its scale is that of the median, which
    outliers hardly move.
    """
    fit, far, size = suspect.robust, suspect.far, suspect.size
    used = np.isfinite(size)
    number, most = int(np.sum(far)), max(int(np.sum(used)), 1)
    lines = np.any(far, axis=0)
    if number < _LEAST or number > _OF_ALL * most or _in_runs(far):
        return
    if float(np.sum(far)) > _OF_LINE * float(np.sum(used[:, lines])):
        return
    if np.any(np.sum(far, axis=1) > _OF_CHANNEL * np.sum(used, axis=1)):
        return
    if _evidence(size[far], most) < _GAIN:
        return
    channels = np.flatnonzero(np.sum(far, axis=1) > _CHANCE * 10.0 * np.sum(used, axis=1) + 1.0).tolist()
    channels = channels or np.flatnonzero(np.any(far, axis=1)).tolist()
    dropped = _dropped(fit, far) > _MOSTLY
    words = {
        "number": number,
        "share": 100.0 * number / most,
        "what": "pulled towards zero (drop-outs)" if dropped else "far off the motion of the others",
        "channel": suspect.body.channel_name(int(np.argmax(np.sum(far, axis=1)))),
    }
    remedied = suspect.with_value(np.where(far, np.nan, suspect.value))
    yield Remedy(channels, remedied, number / most), words


def _evidence(size: Array, count: int) -> float:
    """Return the rise of the log likelihood if some values are outliers, less the cost of choosing them.

    Notes
    -----
    A complex value whose squared residual is x times that of noise raises the log likelihood by x - 1 - log x
    when it gets a variance of its own. The choice of k out of n values costs about k (1 + log(n / k)), the
    logarithm of the number of possible choices. The largest residuals of any misfit lie far off, too, but
    they raise the log likelihood by less than this cost.
    """
    return float(np.sum(size - 1.0 - np.log(size)) - len(size) * (1.0 + np.log(count / len(size))))


def likely_outliers(fit: LineFit, course: Array | None) -> bool:
    """Test, by a plain fit and part of its lines, whether single values deviate more than noise does.

    ``course`` (freq,) is that of noise which is not stated; see ``noise_course``.
    """
    from scipy.special import pdtrc

    channels, lines = fit.value.shape
    if lines < _LEAST:
        return False
    step = max(1, channels * lines // _SAMPLE)
    size = _sizes(fit, np.arange(0, lines, step), course)
    number = int(np.sum(size > -np.log(_SURELY)))
    expected = _SURELY * float(np.sum(np.isfinite(size)))
    return number >= _LEAST and float(pdtrc(number - 1, expected)) < _NUMBER


def _in_runs(far: NDArray[np.bool_]) -> bool:
    """Return whether outliers follow each other along the lines, as faults that scale with the motion do."""
    beside = np.zeros_like(far)
    beside[:, 1:] |= far[:, :-1]
    beside[:, :-1] |= far[:, 1:]
    return float(np.sum(far & beside)) > _WITH_NEIGHBOUR * float(np.sum(far))


def with_far_values(suspect: MisfittingBody) -> MisfittingBody:
    """Return a suspect with its most probable positions and the values that lie far off the motion.

    Positions with a stated sd and the course of noise that is not stated are found without these values, and
    these by them.
    """
    every = np.arange(suspect.value.shape[1])
    exact = not np.any(suspect.position_sd_m > 0.0)
    course: Array | None = None
    far, size = np.zeros(suspect.value.shape, dtype=bool), suspect.size
    for _ in range(1 if suspect.known and exact else _ROUNDS):
        unsure = None if exact else suspect.position_variance(suspect.robust, every)
        size = _sizes(suspect.robust, every, course, unsure)
        with np.errstate(invalid="ignore"):
            before, far = far, size > -np.log(_CHANCE)
        if np.array_equal(far, before):
            break
        if not exact:
            suspect = suspect.settled(far)
        if not suspect.known:
            course = noise_course(suspect.without(far), suspect.freq_hz)
    return replace(suspect, far=far, size=size)


def _sizes(fit: LineFit, lines: NDArray[np.intp], course: Array | None, unsure: Array | None = None) -> Array:
    """Return |residual / sd|^2 / 2 over its mean for most values of the channel, NaN where missing.

    ``unsure`` (channel, line), m^2, is the variance of complex residuals besides noise.
    """
    residual, sd, _weights = fit.at(lines)
    if course is not None:
        measured = np.isfinite(sd)
        sd = np.where(measured, LineNoise(fit.noise.stated, course).at(lines), sd)
    if unsure is not None:
        sd = np.sqrt(sd**2 + 0.5 * unsure)
    # A line with too few channels has no motion, and no residual of one.
    size = np.where(np.isfinite(sd) & fit.solution.good[lines], 0.5 * np.abs(residual / sd) ** 2, np.nan)
    if not np.all(np.isfinite(sd)):
        leverage, spread = _by_line(fit, sd)
        usual, _ = _over_usual(size / np.maximum(1.0 - leverage, _LEAST_LEFT))
        # With gaps the residuals of loud channels spread over different ones from line to line.
        size = size / np.maximum(spread(usual) / usual[:, None], _LEAST_LEFT)
    size = _over_usual(size)[1]
    return size if course is None else size / _louder_lines(size)


def _louder_lines(size: Array) -> Array:
    """Return how much louder than most the lines around each are (line,), at least 1.

    Noise that is not stated may step where no smooth course follows: at a change of range or of averages.
    """
    from scipy.ndimage import median_filter

    used = np.any(np.isfinite(size), axis=0)
    level = np.ones(size.shape[1])
    if np.sum(used) > 2 * _AROUND:
        typical = np.nanmedian(size[:, used], axis=0) / np.log(2.0)
        level[used] = np.maximum(median_filter(typical, size=2 * _AROUND + 1, mode="nearest"), 1.0)
    return level


def _over_usual(size: Array) -> tuple[Array, Array]:
    """Return the usual value of each channel (channel,), at least that of most, and values over it."""
    used = np.any(np.isfinite(size), axis=1)
    channel = np.full(len(size), np.nan)
    channel[used] = np.nanmedian(size[used], axis=1) / np.log(2.0)
    level = float(np.median(channel[used])) if np.any(used) else 1.0
    return np.where(used, channel, level), np.asarray(
        size / np.maximum(np.maximum(np.where(used, channel, level), level), 1e-300)[:, None]
    )


def _by_line(fit: LineFit, sd: Array) -> tuple[Array, Callable[[Array], Array]]:
    """Return leverages (channel, n), and a function from variances to those of the residuals.

    The function takes variances (channel,) over those of ``sd`` and returns residuals' (channel, n).
    """
    root = 1.0 / sd.T
    rows = root[:, :, None] * fit.beams.basis
    gram = rows.swapaxes(1, 2) @ rows
    size = np.maximum(np.trace(gram, axis1=1, axis2=2), 1e-300)
    gram = gram / size[:, None, None] + _RIDGE * np.eye(gram.shape[-1])
    solved = np.linalg.solve(gram, rows.swapaxes(1, 2)).swapaxes(1, 2) / size[:, None, None]
    leverage = np.sum(rows * solved, axis=2).T

    def spread(variance: Array) -> Array:
        middle = rows.swapaxes(1, 2) @ (variance[:, None] * rows)
        explained = np.sum((solved @ middle) * solved, axis=2).T
        return np.asarray(variance[:, None] * (1.0 - 2.0 * leverage) + explained)

    return leverage, spread


def _dropped(fit: LineFit, far: NDArray[np.bool_]) -> float:
    """Return the share of the outliers that lie between zero and what the motion makes."""
    moved = fit.beams.basis @ fit.solution.z
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = (fit.value / moved)[far]
        near = (ratio.real < _DROPPED) & (ratio.real > -0.1) & (np.abs(ratio.imag) < 0.3)
    return float(np.mean(near)) if len(ratio) else 0.0
