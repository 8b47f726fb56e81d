"""Moments of the redundant readings of one body in one run: what they say of errors of its lasers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.fit.beams import BeamSet
from legacy.kinematics.fit.neglected_motion import extended_beams
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import BodyChannels
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.spatial import dof_indices, shifted_point_rows

Index = NDArray[np.intp]
KINDS = ("laser_gain", "laser_phase", "laser_delay")
# Points and lines of a body that are looked at: more of them say hardly more of a few lasers.
_MOST_POINTS, _MOST_LINES = 60, 2000
# Sets of channels with values at the same lines that are looked at: the most frequent ones, until they hold
# this share of the lines (the rest would lower standard deviations by a twentieth), and this many, for time.
_HELD, _MOST_PATTERNS = 0.9, 200
# A misfit beyond noise is coherent over the lines when it is this many standard deviations of its own.
COHERENT_SD = 3.0


@dataclass(frozen=True)
class SweepInformation:
    """What one body in one run says of all parameters.

    Attributes
    ----------
    information : ndarray, (p, p)
    score : ndarray, (p,)
    energy : float
        Sum of squared residuals over noise.
    """

    information: Array
    score: Array
    energy: float
    freedom: int
    lines: int

    def fall(self, values: Array) -> float:
        """Return by how much some values lower the sum of squared residuals over noise."""
        return float(values @ self.score) - 0.5 * float(values @ self.information @ values)

    def level(self, values: Array) -> float:
        """Return the factor on the variance of sums over lines that the misfit left by some values makes."""
        ratio = (self.energy - self.fall(values)) / self.freedom
        if ratio - 1.0 < COHERENT_SD / np.sqrt(self.freedom):
            return 1.0
        return ratio + (ratio - 1.0) * self.lines


@dataclass(frozen=True)
class LaserMoments:
    """Whitened readings of channels with values at the same lines, reduced to moments.

    Attributes
    ----------
    span : ndarray, (channel, m)
        Orthonormal columns of the motion.
    slopes : list of (parameter, kind, ndarray (channel, m))
        What a parameter does to the readings per coefficient of the motion, and the place of its factor.
    half : ndarray, (3 m, 3 m)
        Root of the second moment of the coefficients times 1, i and -i w, their noise subtracted.
    moment : ndarray, (channel, 3 m)
        Real moment of the residuals with the same.
    energy : float
        Sum of squared residuals over noise.
    """

    span: Array
    slopes: list[tuple[int, int, Array]]
    half: Array
    moment: Array
    energy: float
    freedom: int
    lines: int


@dataclass(frozen=True)
class ChannelPattern:
    """Channels that have values at the same lines.

    Attributes
    ----------
    used : ndarray of bool, (channel,)
    weights : ndarray, (n, line)
        Of the n channels that are used.
    lines : ndarray of int, (line,)
    """

    used: NDArray[np.bool_]
    weights: Array
    lines: Index


class LaserParameters:
    """What is estimated, in order: errors of lasers by kind, then positions of the points met so far.

    Parameters
    ----------
    prior_sd : mapping of str to float
        By kind (KINDS): standard deviation of each laser, 1, rad and s.
    count : int
        Number of lasers.
    """

    def __init__(self, prior_sd: Mapping[str, float], count: int) -> None:
        self.kinds = tuple(kind for kind in KINDS if kind in prior_sd)
        self.count = count
        self.size = len(self.kinds) * count
        self.positions: dict[tuple[int, str], int] = {}
        self._sd = [prior_sd[kind] for kind in self.kinds for _ in range(count)]

    @property
    def sd(self) -> Array:
        """Prior standard deviations (p,); positions in metres."""
        return np.array(self._sd)

    def place_of_laser(self, kind: str, laser: int) -> int:
        """Return the place of an error of a laser."""
        return self.kinds.index(kind) * self.count + laser

    def place_of_position(self, body: int, point: str, sd_mm: float) -> int:
        """Return the place of the first coordinate of a point, which is added when it is new."""
        if (body, point) not in self.positions:
            self.positions[body, point] = len(self._sd)
            self._sd += [sd_mm * 1e-3] * 3
        return self.positions[body, point]


def sweep_information(blocks: Sequence[LaserMoments], size: int) -> SweepInformation:
    """Return what the blocks of one body in one run say together."""
    both = [_information(block, size) for block in blocks]
    return SweepInformation(
        np.sum([information for information, _ in both], axis=0),
        np.sum([score for _, score in both], axis=0),
        sum(block.energy for block in blocks),
        sum(block.freedom for block in blocks),
        sum(block.lines for block in blocks),
    )


def channel_patterns(fit: LineFit, body: BodyChannels, left_out: Sequence[int]) -> list[ChannelPattern]:
    """Return sets of channels and the lines at which just these have values, the most frequent first."""
    if not float(np.sum(fit.solution.explained)) > 0.0:
        return []
    names = list(dict.fromkeys(body.points))
    chosen = set(names[:: -(-len(names) // _MOST_POINTS)])
    wanted = (fit.solution.used > 0) & np.array([point in chosen for point in body.points])
    wanted[list(left_out)] = False
    lines = np.arange(fit.value.shape[1])
    whole = np.flatnonzero(fit.solution.count == np.sum(fit.solution.used > 0))
    lines = whole if len(whole) >= _MOST_LINES else lines
    lines = lines[:: max(1, len(lines) // _MOST_LINES)]
    weights = fit.at(lines, wanted)[2]
    sets, of_line, count = np.unique(weights.T > 0.0, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(-count, kind="stable")
    enough = 1 + int(np.searchsorted(np.cumsum(count[order]), _HELD * len(lines)))
    patterns = []
    for number in order[: min(enough, _MOST_PATTERNS)]:
        used, own = wanted.copy(), of_line == number
        used[wanted] = sets[number]
        patterns.append(ChannelPattern(used, weights[np.ix_(sets[number], own)], lines[own]))
    return patterns


def laser_moments(
    fit: LineFit,
    body: BodyChannels,
    number: int,
    lasers: Index,
    freq_hz: Array,
    pattern: ChannelPattern,
    parameters: LaserParameters,
) -> LaserMoments | None:
    """Return the moments of some channels of one body in one run at some lines; None for too few channels.

    Parameters
    ----------
    number : int
        Of the body.
    lasers : ndarray of int, (channel,)
    freq_hz : ndarray, (freq,)
    parameters : LaserParameters
        Positions of new points are added.
    """
    used, weights, lines = pattern.used, pattern.weights, pattern.lines
    beams = fit.beams if len(fit.beams.dof) == 6 else extended_beams(body, fit.beams.dof)
    basis = beams.basis[used]
    if len(basis) <= basis.shape[1]:
        return None
    root = np.sqrt(weights)
    by_channel = np.sqrt(np.mean(weights / np.mean(weights, axis=0), axis=1))
    by_line = np.mean(root / by_channel[:, None], axis=0)
    readings = by_channel[:, None] * fit.value[used][:, lines] * by_line
    span, upper = np.linalg.qr(by_channel[:, None] * basis)
    if np.min(np.abs(np.diag(upper))) < 1e-6 * np.max(np.abs(upper)):
        return None
    projected = span.T @ readings
    residual = readings - span @ projected
    coefficients = np.linalg.solve(upper, projected)
    factors = np.stack([np.ones(len(lines)), np.full(len(lines), 1j), -2j * np.pi * freq_hz[lines]])
    features = (factors[:, None, :] * coefficients).reshape(-1, len(lines))
    inverse = np.linalg.inv(upper)
    noise = np.kron(np.real(factors.conj() @ factors.T), inverse @ inverse.T)
    scale = np.sqrt(np.maximum(np.mean(np.abs(features) ** 2, axis=1), 1e-300))
    moment = np.real(features @ features.conj().T) - noise
    values, vectors = np.linalg.eigh(moment / np.outer(scale, scale))
    half = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    slopes = _laser_slopes(by_channel[:, None] * basis, lasers[used], parameters)
    slopes += _position_slopes(body, number, np.flatnonzero(used), beams, by_channel, parameters)
    return LaserMoments(
        span,
        slopes,
        half,
        np.real(residual @ features.conj().T),
        float(np.sum(np.abs(residual) ** 2)),
        (len(basis) - basis.shape[1]) * len(lines),
        len(lines),
    )


def _laser_slopes(rows: Array, lasers: Index, parameters: LaserParameters) -> list[tuple[int, int, Array]]:
    """Return what each error of a laser does to the weighted readings, whose rows of the motion are given."""
    return [
        (
            parameters.place_of_laser(kind, laser),
            KINDS.index(kind),
            np.where((lasers == laser)[:, None], rows, 0.0),
        )
        for kind in parameters.kinds
        for laser in np.unique(lasers).tolist()
    ]


def _position_slopes(
    body: BodyChannels,
    number: int,
    channels: Index,
    beams: BeamSet,
    by_channel: Array,
    parameters: LaserParameters,
) -> list[tuple[int, int, Array]]:
    """Return what each coordinate of a point does to the weighted readings of the channels."""
    slopes: list[tuple[int, int, Array]] = []
    dof = dof_indices(beams.dof)
    for point in dict.fromkeys(body.points[channel] for channel in channels):
        own = np.array([body.points[channel] == point for channel in channels])
        sd_mm = float(body.position_sd_mm[channels[own][0]])
        if not (np.isfinite(sd_mm) and sd_mm > 0.0):
            continue
        place = parameters.place_of_position(number, point, sd_mm)
        for axis in range(3):
            rows = np.zeros((len(channels), beams.basis.shape[1]))
            moved = shifted_point_rows(body.directions[channels[own]], np.eye(3)[axis])
            rows[own] = by_channel[own, None] * (moved[:, dof] @ beams.to_dof)
            slopes.append((place + axis, 0, rows))
    return slopes


def _information(block: LaserMoments, size: int) -> tuple[Array, Array]:
    """Return information (p, p) and score (p,) of all parameters from one block."""
    count = block.span.shape[1]
    parameters = np.array([parameter for parameter, _, _ in block.slopes], dtype=int)
    columns = np.empty((len(parameters), len(block.span), block.half.shape[1]))
    pull = np.empty(len(parameters))
    for place, (_, kind, rows) in enumerate(block.slopes):
        mine = slice(kind * count, (kind + 1) * count)
        columns[place] = rows @ block.half[mine]
        rows = rows - block.span @ (block.span.T @ rows)
        pull[place] = 2.0 * float(np.sum(rows * block.moment[:, mine]))
    columns -= block.span @ (block.span.T @ columns)
    flat = columns.reshape(len(parameters), -1)
    information, score = np.zeros((size, size)), np.zeros(size)
    information[np.ix_(parameters, parameters)] = 2.0 * flat @ flat.T
    score[parameters] = pull
    return information, score
