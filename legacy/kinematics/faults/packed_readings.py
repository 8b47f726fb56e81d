"""Readings over their noise in few columns, under the present assumptions about the channels.

A fault that is the same at all lines changes the observation rows B of y = B z + noise. Within a segment of
lines any unitary mixture of them leaves that model as it is: the one that gathers the motion z into as many
columns as it has degrees of freedom leaves noise alone in all others, of which a sample is kept. Lines with
missing values, or noise whose ratios change from line to line, are kept as they are: a missing value has the
weight zero.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.fit.beams import BeamSet
from legacy.kinematics.fit.line_noise import LineNoise
from legacy.kinematics.fit.noise_spectrum import noise_course
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import BodyChannels
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.spatial import cross, point_rows

# A factor of readings by place in the measurement (-1 to 1) and frequency over its mean.
Factor = Callable[[Array, Array], ComplexArray]
# Segments that show a change over the lines: a mean, a slope, and two to judge them by. Fewer lines than give
# so many are kept as they are.
LEAST_SEGMENTS = 4
# Segments of lines that are packed each by itself: a drift is seen so finely.
_SEGMENTS = 12
# Values up to which all lines are kept for faults that change from line to line, and segments of more.
_FINE_VALUES, _FINE_SEGMENTS = 100_000, 64
# Columns of noise that are kept in all, and values of them.
_REST, _HELD = 512, 60_000
# Values of lines with gaps that are looked at; more are thinned evenly.
_MOST_VALUES = 60_000
# Share of the motion outside the picked lines below which these hold all of it, but for rounding.
_ALL_IN_PICKED = 1e-6
# A ridge that keeps lines solvable whose channels do not determine the motion.
RIDGE = 1e-12
# Errors of positions, and noise that is not stated, are estimated with matrices of channel x channel, 128 MB
# each at this number of channels.
MOST_CHANNELS = 4000
# Least eigenvalue of a correlation of noise.
_SINGULAR = 0.05


@dataclass(frozen=True)
class Source:
    """The determined lines of one body in one run, as measured.

    Attributes
    ----------
    beams : BeamSet
        For all degrees of freedom that the beams observe.
    points : tuple of str, (channel,)
    value : ndarray, (channel, line), complex
        Readings, m; NaN where missing.
    lines : ndarray, (n,), int
        The lines of ``value`` that are used.
    share, line : ndarray, (channel,) and (n,)
        Their product is the sd of readings without gaps; ``share`` is zero of channels without readings.
    sd : ndarray, (channel, n), or None
        Of readings with gaps, or whose noise is no such product; infinite where missing.
    tau, ratio : ndarray, (n,)
        Place in the measurement, -1 to 1, and frequency over its mean.
    spread : float
        By what factor noise that neighbouring lines have in common widens slowly varying mixtures.
    middle_hz : float
        Mean frequency.
    course : ndarray, (freq,), or None
        Of noise that is not stated, where it has one; see ``noise_course``.
    """

    beams: BeamSet
    points: tuple[str, ...]
    value: ComplexArray
    lines: NDArray[np.intp]
    share: Array
    line: Array
    sd: Array | None
    tau: Array
    ratio: Array
    spread: float = 1.0
    middle_hz: float = 1.0
    course: Array | None = None

    @classmethod
    def of(cls, fit: LineFit, body: BodyChannels, freq_hz: Array, known: bool, spread: float = 1.0) -> Source:
        """Collect the readings of a fit; unknown noise enters by proportions and course over frequency."""
        course = None if known else noise_course(fit, freq_hz)
        noise = fit.noise if known else LineNoise(fit.noise.stated, course)
        lines, used = np.flatnonzero(fit.solution.good), fit.solution.used
        common = noise.common() if np.all(used == fit.value.shape[1]) else None
        if common is not None:
            share, line, sd = common[0], common[1][lines], None
        else:
            most = max(_MOST_VALUES // max(len(used), 1), 32)
            if len(lines) > most:
                lines = lines[np.unique(np.linspace(0, len(lines) - 1, most).round().astype(int))]
            share, line, sd = np.where(used > 0, 1.0, 0.0), np.ones(len(lines)), np.array(noise.at(lines))
            sd[~(np.isfinite(sd) & np.isfinite(fit.value[:, lines].real))] = np.inf
        tau = np.linspace(-1.0, 1.0, len(lines)) if len(lines) > 1 else np.zeros(len(lines))
        middle = float(np.mean(freq_hz[lines]))
        ratio = freq_hz[lines] / middle
        return cls(
            fit.beams, body.points, fit.value, lines, share, line, sd, tau, ratio, spread, middle, course
        )


@dataclass(frozen=True)
class Assumed:
    """What is held true of the channels: where they are, how loud, and by what they are multiplied.

    Attributes
    ----------
    arms_m, directions : ndarray, (channel, 3)
    loud : ndarray, (channel,)
        Noise over that of the source; infinite for channels that are left out.
    factors : tuple of (list of int, Factor)
        By what readings of channels are divided.
    level : ndarray, (parts,)
        Noise over that of the source in equal parts of the lines.
    correlation : ndarray, (channel, channel), or None
        Of the noise of channels of one point; None without.
    lasers : tuple of (list of int, Factor)
        By what readings of the channels of each laser are divided, too.
    laser_errors : ndarray, (V,)
        The errors of lasers that make these factors, see ``Nuisance``.
    """

    arms_m: Array
    directions: Array
    loud: Array
    factors: tuple[tuple[list[int], Factor], ...] = ()
    level: Array = field(default_factory=lambda: np.ones(1))
    correlation: Array | None = None
    lasers: tuple[tuple[list[int], Factor], ...] = ()
    laser_errors: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def live(self) -> list[int]:
        """Channels in use."""
        return np.flatnonzero(np.isfinite(self.loud)).tolist()

    def without(self, channels: list[int]) -> Assumed:
        """Leave channels out."""
        return self.louder(channels, np.inf)

    def louder(self, channels: list[int], factor: float) -> Assumed:
        """Raise the noise of channels by a factor."""
        loud = self.loud.copy()
        loud[channels] *= factor
        return replace(self, loud=loud)


@dataclass(frozen=True)
class Packed:
    """One body in one run in columns, in units of its noise: complex noise has unit variance.

    Attributes
    ----------
    source : Source
    assumed : Assumed
    y : ndarray, (group, channel, column), complex
        Columns that hold the motion; groups share weights, time and frequency.
    rest : ndarray, (group, channel, sample), complex
        Columns without motion.
    weight : ndarray, (group, channel)
        One over the noise of a complex reading, 1 / m; zero where not used.
    tau, ratio : ndarray, (group,)
    whiten : ndarray, (channel, channel), or None
        Takes the correlation out of the noise of channels of one point.
    """

    source: Source
    assumed: Assumed
    y: ComplexArray
    rest: ComplexArray
    weight: Array
    tau: Array
    ratio: Array
    whiten: Array | None = None

    @property
    def live(self) -> list[int]:
        """Channels in use."""
        return self.assumed.live

    @property
    def points(self) -> tuple[str, ...]:
        """Point of each channel."""
        return self.source.points

    @property
    def few(self) -> bool:
        """Whether complete lines are too few to be gathered into segments that show a drift."""
        return self.source.sd is None and len(self.source.lines) < 2 * LEAST_SEGMENTS * self.size

    @property
    def by_point(self) -> dict[str, list[int]]:
        """Channels in use of each point."""
        channels: dict[str, list[int]] = {}
        for channel in self.live:
            channels.setdefault(self.points[channel], []).append(channel)
        return channels

    @property
    def size(self) -> int:
        """Number of degrees of freedom."""
        return len(self.source.beams.dof)

    def rows(self, arms_m: Array, directions: Array) -> Array:
        """Return rows (..., m) in the orthonormal basis for positions and directions (..., 3)."""
        about = cross(arms_m, directions)
        columns = np.empty((*about.shape[:-1], 6))
        columns[..., :3], columns[..., 3:] = directions, about
        return np.asarray(columns @ self.source.beams.to_six)

    def under(self, assumed: Assumed) -> Packed:
        """Return the source packed anew under other assumptions."""
        return packed(self.source, assumed)

    def louder(self, factor: float) -> Packed:
        """Return the columns with the noise of all channels raised by one factor.

        One factor of each channel would gather other columns: those gathered under wrong weights depend on
        the residuals, where the beams see little motion.
        """
        return replace(
            self,
            assumed=replace(self.assumed, loud=self.assumed.loud * factor),
            y=self.y / factor,
            rest=self.rest / factor,
            weight=self.weight / factor,
        )

    def blanked(self, channels: Sequence[int]) -> Packed:
        """Return the columns without the readings of some channels."""
        y, weight = self.y.copy(), self.weight.copy()
        y[:, channels] = weight[:, channels] = 0.0
        return replace(self, y=y, weight=weight)

    def merged(self, z: ComplexArray) -> Packed:
        """Return all groups merged into one, for faults that are the same at all lines.

        ``z`` (group, m, column) is the motion. Only data whose groups share their weights can be merged.
        """
        if len(self.y) == 1 or np.ptp(self.weight, axis=0).max(initial=0.0) > 1e-9 * self.weight.max():
            return self
        motion = z.transpose(1, 0, 2).reshape(z.shape[1], -1)
        vectors = np.linalg.svd(motion, full_matrices=False)[2]
        y = self.y.transpose(1, 0, 2).reshape(self.y.shape[1], -1) @ vectors.conj().T
        return replace(
            self,
            y=y[None],
            rest=self.rest[:1, :, :0],
            weight=self.weight[:1],
            tau=np.zeros(1),
            ratio=np.ones(1),
        )


def initial(source: Source, body: BodyChannels) -> Packed:
    """Pack a source as the file describes it."""
    loud = np.where(source.share > 0.0, 1.0, np.inf)
    return packed(source, Assumed(body.positions_mm * 1e-3, body.directions, loud))


def packed(source: Source, assumed: Assumed, fine: bool = False) -> Packed:
    """Pack a source under assumptions; ``fine``: for faults that change from line to line."""
    place = np.linspace(0.0, 1.0, 2 * len(assumed.level) + 1)[1::2]
    course = np.interp(np.linspace(0.0, 1.0, len(source.lines)), place, assumed.level)
    live = np.isfinite(assumed.loud)
    loud = np.sqrt(2.0 * source.spread) * np.where(live, assumed.loud, 1.0)
    whiten = None if assumed.correlation is None else whitening(assumed.correlation, live)
    # Noise that neighbouring lines have in common shows only where lines are gathered.
    few = source.spread == 1.0 and len(source.lines) < 2 * LEAST_SEGMENTS * len(source.beams.dof)
    if source.sd is None and not few and not (fine and len(source.value) * len(source.lines) < _FINE_VALUES):
        return _gather(source, assumed, live / (source.share * loud), course, whiten, fine)
    sd = source.share[:, None] if source.sd is None else source.sd
    # The course of the noise over the lines is in the motion.
    course = course * source.line if source.sd is None else course
    weight = np.where(live[:, None] & np.isfinite(sd), 1.0 / (sd * loud[:, None]), 0.0)
    weight = np.repeat(weight, len(course) // weight.shape[1], axis=1)
    value = np.where(weight > 0.0, source.value[:, source.lines] / course, 0.0)
    divide(value, weight, assumed, source.tau, source.ratio)
    y = whitened((weight * value).T[:, :, None], whiten)
    return Packed(source, assumed, y, y[:, :, :0], weight.T, source.tau, source.ratio, whiten)


def divide(value: ComplexArray, weight: Array, assumed: Assumed, tau: Array, ratio: Array) -> None:
    """Divide readings (channel, n) by the assumed factors, in place, and raise their weights so.

    What is zero times the motion shows nothing of it and keeps no weight.
    """
    for channels, factor in (*assumed.factors, *assumed.lasers):
        by = np.broadcast_to(factor(tau, ratio), tau.shape)
        value[channels] /= np.where(by == 0.0, 1.0, by)
        weight[channels] *= np.abs(by)


def whitened(y: NDArray[Any], whiten: Array | None) -> NDArray[Any]:
    """Apply a whitening (channel, channel) to values (group, channel, n)."""
    return y if whiten is None else np.asarray(whiten @ y)


def _gather(
    source: Source, assumed: Assumed, scale: Array, course: Array, whiten: Array | None, fine: bool
) -> Packed:
    """Gather the motion of each segment of lines; ``scale`` (channel,) is one over the noise."""
    size, number = len(source.beams.dof), len(source.lines)
    parts = min(number // (2 * size), _FINE_SEGMENTS if fine else _SEGMENTS)
    edges = np.linspace(0, number, max(parts, min(LEAST_SEGMENTS, number)) + 1).round().astype(int)
    parts, shortest = len(edges) - 1, int(np.min(np.diff(edges)))
    size = min(size, shortest)
    samples = min(_REST // parts, _HELD // len(scale) // parts, shortest - size)
    basis = point_rows(assumed.arms_m, assumed.directions) @ source.beams.to_six
    whole = number == source.value.shape[1]
    made: list[tuple[ComplexArray, ComplexArray, Array, float, float]] = []
    for part in map(slice, edges[:-1].tolist(), edges[1:].tolist()):
        value, mean = source.value[:, part if whole else source.lines[part]], scale
        if assumed.factors or assumed.lasers:
            value, weight = np.array(value), np.repeat(mean[:, None], part.stop - part.start, axis=1)
            divide(value, weight, assumed, source.tau[part], source.ratio[part])
            mean = np.sqrt(np.mean(weight**2, axis=1))
        line = 1.0 / (source.line[part] * course[part])
        rows = whitened(mean[:, None] * basis, whiten)
        gram = rows.T @ rows
        solve = np.linalg.solve(gram + RIDGE * max(np.trace(gram), 1e-300) * np.eye(len(gram)), rows.T)
        z = ((solve if whiten is None else solve @ whiten) * mean @ real_parts(value)).view(complex) * line
        turn = np.linalg.qr(z.conj().T)[0][:, :size]
        # The beams may see no motion: its directions are noise then, and as good as any others.
        y = value @ (line[:, None] * turn)
        rest = _sample(value, line, turn, y, samples)
        # The course of the noise over the lines is in the motion of the columns.
        power = np.mean(np.abs(z) ** 2, axis=0)
        share = power / max(float(np.sum(power)), 1e-300)
        at = float(share @ source.tau[part]), float(share @ source.ratio[part])
        # Noise that neighbouring lines have in common widens what is gathered, not single lines.
        rest = np.sqrt(source.spread) * mean[:, None] * rest
        made.append((mean[:, None] * y, rest, mean, *at))
    y, rest, weight, tau, ratio = (np.array(parts) for parts in zip(*made, strict=True))
    return Packed(source, assumed, whitened(y, whiten), whitened(rest, whiten), weight, tau, ratio, whiten)


def real_parts(value: ComplexArray) -> Array:
    """Return real and imaginary parts (..., 2 n) of complex values (..., n), side by side for each."""
    return np.ascontiguousarray(value).view(float)


def _sample(
    value: ComplexArray, line: Array, turn: ComplexArray, y: ComplexArray, samples: int
) -> ComplexArray:
    """Return evenly spread columns of ``value * line`` square to those of ``turn`` (line, column).

    ``y`` are the columns along ``turn``.
    """
    lines = value.shape[1]
    if not samples:
        return value[:, :0]
    pick = np.linspace(0, lines - 1, samples).round().astype(int)
    # Of the unit vectors of the picked lines, made square to the columns of ``turn``, all products are
    # 1 - t t^H: the inverse root of that makes them orthonormal.
    vectors, size, _ = np.linalg.svd(turn[pick], full_matrices=False)
    left = 1.0 - size**2
    if np.min(left) < _ALL_IN_PICKED:
        chosen = np.zeros((lines, samples), dtype=complex)
        chosen[pick, np.arange(samples)] = 1.0
        chosen = np.linalg.qr(chosen - turn @ turn[pick].conj().T)[0]
        return np.asarray(value @ (line[:, None] * chosen))
    squared = value[:, pick] * line[pick] - y @ turn[pick].conj().T
    return np.asarray(squared + (squared @ vectors * (left**-0.5 - 1.0)) @ vectors.conj().T)


def whitening(correlation: Array, live: NDArray[np.bool_]) -> Array:
    """Return the inverse square root of the correlation of the channels in use; 1 for the others."""
    held = np.where(np.outer(live, live), correlation, 0.0)
    np.fill_diagonal(held, 1.0)
    whitener, seen = np.eye(len(held)), np.zeros(len(held), dtype=bool)
    for channel in np.flatnonzero(np.sum(held != 0.0, axis=1) > 1):
        if not seen[channel]:
            own = np.flatnonzero(held[channel])
            seen[own] = True
            values, vectors = np.linalg.eigh(held[np.ix_(own, own)])
            whitener[np.ix_(own, own)] = (vectors / np.sqrt(np.maximum(values, _SINGULAR))) @ vectors.T
    return whitener
