"""Many lines packed into few that hold all there is to know about static faults, and a sample of the rest.

A fault that is the same at all lines changes the observation rows B of y = B z + noise. Within a segment of
lines any unitary mixture of them leaves that model as it is; the mixture that gathers the motion z into as
many lines as it has degrees of freedom leaves nothing but noise on the others. These lines and their motion
are kept; of the others, which tell the size of the noise and motion that is not rigid, up to some hundred.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.packed.fill import Filled, FilledLines, Gaps
from kinematics.faults.packed.gathering import Measured, gathering, motion_of
from kinematics.faults.packed.mixing import Mixing
from kinematics.faults.packed.whole_lines import measured
from kinematics.fit.beams import BeamSet
from kinematics.fit.line_noise import LineNoise, blocks
from kinematics.fit.noise_spectrum import noise_course
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels
from stapeskit.spatial import dof_indices, point_rows

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
# Segments of lines that are packed each for itself: so finely a drift is seen.
_SEGMENTS = 12
# Lines without motion that are kept in all, and numbers of them.
_REST = 512
_HELD = 60_000


@dataclass(frozen=True)
class Source:
    """The lines that were packed: a fit, the form a_c b_f of its weights, and what fills missing values."""

    fit: LineFit
    freq_hz: Array
    channel: Array
    line: Array
    even: bool
    gaps: Gaps | None = None
    filled: Filled | None = None

    @classmethod
    def of(cls, fit: LineFit, freq_hz: Array, noise_known: bool = True) -> Source:
        """Find the weights of a fit; of noise that is not known its proportions and course over frequency."""
        noise = fit.noise if noise_known else LineNoise(fit.noise.stated, noise_course(fit, freq_hz))
        common = noise.common()
        if common is not None and np.all(fit.solution.used == fit.value.shape[1]):
            share, line = common
            size = float(np.mean(line))
            return cls(fit, freq_hz, 1.0 / (np.sqrt(2.0) * share * size), size / line, True)
        if common is not None:
            held, own, line = measured(fit.value, fit.solution, common)
            return cls(fit, freq_hz, 1.0 / np.sqrt(2.0 * own), line, False)._with_gaps(held, own)
        channels, lines = fit.value.shape
        held = np.empty((channels, lines), dtype=bool)
        own, used = np.zeros(channels), np.zeros(channels)
        for part in blocks(channels, lines):
            variance, held[:, part] = _variance(fit, noise, part)
            own += np.sum(variance, axis=1)
            used += np.sum(held[:, part], axis=1)
        own = np.where(used > 0.0, own / np.maximum(used, 1.0), np.inf)
        line = np.zeros(lines)
        for part in blocks(channels, lines):
            mean = np.sum(_variance(fit, noise, part)[0] / own[:, None], axis=0)
            number = np.sum(held[:, part], axis=0)
            line[part] = np.sqrt(number / np.where(mean > 0.0, mean, np.inf))
        return cls(fit, freq_hz, 1.0 / np.sqrt(2.0 * own), line, False)._with_gaps(held, own)

    def _with_gaps(self, held: NDArray[np.bool_], own: Array) -> Source:
        """Fill what is missing at lines that are packed; ``own`` is the noise variance of each channel."""
        good = self.fit.solution.good
        if np.all(held if np.all(good) else held[:, good]):
            return self
        gaps = _gaps(self, held, np.sqrt(1.0 / own))
        return replace(self, gaps=gaps, filled=gaps.filled())


def _gaps(source: Source, held: NDArray[np.bool_], weight: Array) -> Gaps:
    """Return the readings of a fit, with one over the noise of each channel, as they were measured."""
    fit, edges = source.fit, _segments(source)
    good = np.flatnonzero(fit.solution.good)
    tau, segment = np.zeros(len(source.line)), np.zeros(len(source.line), dtype=np.intp)
    tau[good] = np.linspace(-1.0, 1.0, len(good)) if len(good) > 1 else 0.0
    segment[good] = np.repeat(np.arange(len(edges) - 1), np.diff(edges))
    divisor = np.ones((len(held), len(edges) - 1), dtype=complex)
    return Gaps(fit.value, held, good, source.line, tau, fit.beams.basis, weight, divisor, segment)


def _refilled(source: Source, data: Compact) -> tuple[Source, Array, Array]:
    """Fill the gaps anew for the present rows, factors and weights; return source, weights and lift."""
    if source.gaps is None or source.filled is None:
        return source, data.a, data.lift
    old, live = source.filled, data.a > 0.0
    weight = np.sqrt(2.0) * data.a / np.sqrt(old.share)
    held = source.gaps.held & live[:, None]
    gaps = replace(
        source.gaps, held=held, line=source.line, basis=data.beams.basis, a=weight, divisor=data.divisor
    )
    new = gaps.filled()
    lift = data.lift * new.lift / old.lift
    return (
        replace(source, gaps=replace(gaps, held=source.gaps.held), filled=new),
        (data.a * np.sqrt(new.share / old.share)),
        lift,
    )


def _variance(
    fit: LineFit, noise: LineNoise, part: slice | NDArray[np.intp]
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the variance (channel, n) of some lines, zero where missing, and where it is not."""
    sd = noise.at(part)
    held = np.isfinite(fit.value[:, part]) & np.isfinite(sd)
    return np.where(held, sd, 0.0) ** 2, held


@dataclass(frozen=True)
class Compact:
    """One body in one run, packed.

    Attributes
    ----------
    beams : BeamSet
        For all degrees of freedom that the beams observe.
    arms_m, directions : ndarray, (channel, 3)
    points : tuple of str, (channel,)
    y : ndarray, (channel, line), complex
        Packed readings, m.
    a : ndarray, (channel,)
        1 / (sd sqrt 2) of the packed readings, so that a times noise has unit complex variance; zero where
        not used.
    part : ndarray, (line,), int
        Segment of each packed line.
    tau, freq_hz : ndarray, (line,)
        Mean place in the measurement, -1 to 1, and mean frequency of what each line was mixed from.
    rest : ndarray, (channel, sample), complex
        Residuals at lines that hold no motion, m.
    rest_part : ndarray, (sample,), int
        Segment of each of them.
    divisor : ndarray, (channel, segment), complex
        What the readings were divided by since they were measured.
    lift : ndarray, (channel,)
        One over the share of each channel's values that was measured: raises the noise of ``rest``.
    source : Source
    mixing : Mixing or None
        Correlation of the noise of each point's channels; None when it has none.
    """

    beams: BeamSet
    arms_m: Array
    directions: Array
    points: tuple[str, ...]
    y: ComplexArray
    a: Array
    part: NDArray[np.int64]
    tau: Array
    freq_hz: Array
    rest: ComplexArray
    rest_part: NDArray[np.int64]
    divisor: ComplexArray
    lift: Array
    source: Source = field(repr=False)
    mixing: Mixing | None = field(default=None, repr=False)

    def white(self, held: NDArray[Any]) -> NDArray[Any]:
        """Return values (channel, n) over their noise, of which none is in common."""
        made = self.a[:, None] * held
        return made if self.mixing is None else np.asarray(self.mixing.whiten @ made)

    def white_transposed(self, held: NDArray[Any]) -> NDArray[Any]:
        """Apply the transpose of `white` to values (channel, n)."""
        made = held if self.mixing is None else np.asarray(self.mixing.whiten.T @ held)
        return self.a[:, None] * made

    @property
    def live(self) -> list[int]:
        """Channels in use."""
        return np.flatnonzero(self.a > 0.0).tolist()

    def row(self, arms_m: Array, directions: Array) -> Array:
        """Return rows (n, m) in the orthonormal basis for other positions or directions."""
        places = dof_indices(self.beams.dof)
        return np.asarray(point_rows(arms_m, directions)[:, places] @ self.beams.to_dof)

    def moved(self, arms_m: Array | None = None, directions: Array | None = None) -> Compact:
        """Return the data with other positions (m) or directions, and the rows that belong to them."""
        arms = self.arms_m if arms_m is None else arms_m
        beams = self.directions if directions is None else directions
        basis = replace(self.beams, basis=self.row(arms, beams))
        return replace(self, beams=basis, arms_m=arms, directions=beams)

    def without(self, channels: list[int]) -> Compact:
        """Return the data with some channels left out."""
        a = self.a.copy()
        a[channels] = 0.0
        if self.mixing is None:
            return replace(self, a=a)
        return replace(self, a=a, mixing=self.mixing.left(np.flatnonzero(a > 0.0).tolist()))

    def weighted(self, channels: list[int], factor: float) -> Compact:
        """Return the data with the noise of some channels larger by a factor."""
        a = self.a.copy()
        a[channels] /= factor
        return replace(self, a=a)

    def scaled(self, channels: list[int], factor: ComplexArray) -> Compact:
        """Return the data with the readings of some channels divided by a factor (line,)."""
        y, rest, a, divisor = self.y.copy(), self.rest.copy(), self.a.copy(), self.divisor.copy()
        y[channels] /= factor
        number = divisor.shape[1]
        mean = np.array([np.mean(factor[self.part == k]) for k in range(number)])
        rest[channels] /= mean[self.rest_part]
        a[channels] *= abs(complex(np.mean(mean)))
        divisor[channels] *= mean
        return replace(self, y=y, rest=rest, a=a, divisor=divisor)

    def levelled(self, variance: Array) -> Compact:
        """Return the data packed anew with noise whose variance differs from segment to segment."""
        good = np.flatnonzero(self.source.fit.solution.good)
        place = np.interp(
            np.arange(len(good)), np.linspace(0, len(good) - 1, 2 * len(variance) + 1)[1::2], variance
        )
        line = self.source.line.copy()
        line[good] /= np.sqrt(place)
        return replace(self, source=replace(self.source, line=line)).repacked()

    def repacked(self) -> Compact:
        """Return the same data packed anew for their present rows and weights.

        The noise of the motion is packed with the motion. Once rows or weights are others, what was noise of
        the motion
        is residual, and would stand in the few packed lines alone.
        """
        return _packed(self.source, self)


def compact(
    fit: LineFit, body: BodyChannels, freq_hz: Array, noise_known: bool = True, line_spread: float = 1.0
) -> Compact:
    """Pack the fit of a body in one run.

    Parameters
    ----------
    fit : LineFit
        Of all degrees of freedom that the beams observe.
    body : BodyChannels
    freq_hz : ndarray, (freq,)
    noise_known : bool
        The sd are absolute.
    line_spread : float
        By what factor noise that neighbouring lines have in common widens the packed lines, which are slowly
        varying mixtures.

    Notes
    -----
    The weights of the packed lines are those of a noise of the form 1 / (a_c b_f). Where the stated sd differ
    from that, or values are missing, a channel's reading in a mixture keeps the share of its motion that was
    measured, filled up by what these lines show, and has the noise that its own values have in the mixture.
    """
    source = Source.of(fit, freq_hz, noise_known)
    count = len(body.points)
    parts = len(_segments(source)) - 1
    nothing, none = np.zeros((count, 0), dtype=complex), np.zeros(0, dtype=np.int64)
    empty = Compact(
        fit.beams,
        body.positions_mm * 1e-3,
        body.directions,
        body.points,
        nothing,
        source.channel / np.sqrt(line_spread),
        none,
        np.zeros(0),
        np.zeros(0),
        nothing,
        none,
        np.ones((count, parts), dtype=complex),
        np.full(count, np.sqrt(line_spread)),
        source,
    )
    return _packed(source, empty, first=True)


def _segments(source: Source) -> NDArray[np.int64]:
    """Return the places among the determined lines at which segments begin and end."""
    lines = int(np.sum(source.fit.solution.good))
    parts = int(np.clip(lines // (2 * len(source.fit.beams.dof)), 1, _SEGMENTS))
    return np.asarray(np.linspace(0, lines, parts + 1).round().astype(int))


def _packed(source: Source, data: Compact, first: bool = False) -> Compact:
    fit, basis = source.fit, data.beams.basis
    channel, lift = data.a, data.lift
    if not first:
        source, channel, lift = _refilled(source, data)
    gaps, filled = source.gaps, source.filled
    good = np.flatnonzero(fit.solution.good)
    whole = len(good) == fit.value.shape[1]
    count = len(basis)
    edges = _segments(source)
    share = max(1, min(_REST, _HELD // max(count, 1)) // (len(edges) - 1))
    span, upper = np.linalg.qr(data.white(basis))
    back = np.linalg.pinv(upper, rcond=1e-9) @ data.white_transposed(span).T
    packed, rest, mixed = [], [], []
    seen, variance = np.zeros(count), np.zeros(count)
    common = fit.noise.common()
    for number, (start, stop) in enumerate(pairwise(edges)):
        lines = slice(start, stop) if whole else good[start:stop]
        b, divisor = source.line[lines], data.divisor[:, number][:, None]
        read: Measured | FilledLines
        if gaps is not None and filled is not None:
            read = FilledLines(gaps, filled, good[start:stop])
        else:
            held = fit.value[:, lines]
            z = fit.solution.z[:, lines] if first else motion_of(back, divisor[:, 0], held)
            read = Measured(held, divisor, basis, z)
        moving = read.z * b
        vectors, into = gathering(moving)
        error = read.mixed(b[:, None] * into)
        packed.append((moving @ into, error))
        mixed.append(np.abs(into) ** 2)
        rest.append(_rest(read, (b, vectors, into, error), share))
        if first and not source.even:
            mix = np.sum(np.abs(into) ** 2, axis=1)
            if common is not None and gaps is not None:
                there, sizes = gaps.held[:, lines], np.stack([mix, mix * (b * common[1][lines]) ** 2], axis=1)
                some, own = (there @ sizes).T
                seen, variance = seen + some, variance + 2.0 * common[0] ** 2 * own
                continue
            own, used = _variance(fit, fit.noise, lines)
            seen += used @ mix
            variance += 2.0 * own @ (mix * b**2)
    number_of = [motion.shape[1] for motion, _ in packed]
    if first and not source.even:
        with np.errstate(divide="ignore", invalid="ignore"):
            channel = np.where(seen > 0.0, np.sqrt(seen / variance) / lift, 0.0)
        if filled is not None:
            channel, lift = channel * np.sqrt(filled.share), lift * filled.lift
    middle = [slice(start, stop) for start, stop in pairwise(edges)]
    tau = np.linspace(-1.0, 1.0, len(good)) if len(good) > 1 else np.zeros(1)
    freq = source.freq_hz[good]
    place = np.concatenate([tau[pick] @ mix for pick, mix in zip(middle, mixed, strict=True)])
    moved, error = np.hstack([motion for motion, _ in packed]), np.hstack([left for _, left in packed])
    return replace(
        data,
        y=basis @ moved + (error if filled is None else filled.evened(error, moved, place)),
        a=channel,
        lift=lift,
        source=source,
        part=np.repeat(np.arange(len(packed)), number_of),
        tau=place,
        freq_hz=np.concatenate([freq[pick] @ mix for pick, mix in zip(middle, mixed, strict=True)]),
        rest=np.hstack(rest) * lift[:, None],
        rest_part=np.repeat(np.arange(len(rest)), [part.shape[1] for part in rest]),
    )


def _rest(
    read: Measured | FilledLines, mixing: tuple[Array, ComplexArray, ComplexArray, ComplexArray], share: int
) -> ComplexArray:
    """Return mixtures (channel, n) of equal noise of the residuals that the packed lines leave.

    Parameters
    ----------
    read : Measured or FilledLines
        Gives residuals.
    mixing : tuple
        Weights of the lines, all mixing vectors, those of the packed lines, and the packed residuals.
    share : int
        How many to return at most.
    """
    b, vectors, into, error = mixing
    lines, rank = into.shape
    if lines == rank:
        return np.zeros((len(error), 0), dtype=complex)
    if len(vectors) == lines:
        return read.mixed((b[:, None] * vectors[rank:].conj().T)[:, :share])
    pick = np.unique(np.linspace(0, lines - 1, min(share, lines)).round().astype(int))
    left = 1.0 - np.sum(np.abs(into[pick]) ** 2, axis=1)
    pick, left = pick[left > 0.1], left[left > 0.1]
    return np.asarray((read.at(pick) * b[pick] - error @ into[pick].conj().T) / np.sqrt(left))
