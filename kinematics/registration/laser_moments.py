"""Moments of the redundant readings of one body in one run: what they say of errors of its lasers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinematics.fit.neglected_motion import extended_beams
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels
from stapeskit.arrays import Array
from stapeskit.spatial import dof_indices, shifted_point_rows

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


def channel_patterns(
    fit: LineFit, body: BodyChannels, left_out: Sequence[int]
) -> list[tuple[NDArray[np.bool_], Array, Index]]:
    """Return sets of channels and the lines at which just these have values, the most frequent first.

    Returns
    -------
    list of (ndarray of bool, (channel,), ndarray, (n, line), ndarray of int, (line,))
        The channels, their weights, and the lines.
    """
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
        patterns.append((used, weights[np.ix_(sets[number], own)], lines[own]))
    return patterns


def laser_moments(
    fit: LineFit, body: BodyChannels, number: int, lasers: Index, freq_hz: Array, kinds: Sequence[str],
    count: int, used: NDArray[np.bool_], weights: Array, lines: Index, places: dict[tuple[int, str], int],
    prior: list[float], size: int,
) -> LaserMoments | None:  # fmt: skip
    """Return the moments of some channels of one body in one run at some lines; None for too few channels."""
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
    slopes = _slopes(body, number, used, lasers, beams.to_dof, dof_indices(beams.dof), by_channel, basis,
                     kinds, count, places, prior, size)  # fmt: skip
    return LaserMoments(
        span,
        slopes,
        half,
        np.real(residual @ features.conj().T),
        float(np.sum(np.abs(residual) ** 2)),
        (len(basis) - basis.shape[1]) * len(lines),
        len(lines),
    )


def _slopes(
    body: BodyChannels, number: int, used: NDArray[np.bool_], lasers: Index, to_dof: Array, dof: list[int],
    by_channel: Array, basis: Array, kinds: Sequence[str], count: int,
    places: dict[tuple[int, str], int], prior: list[float], size: int,
) -> list[tuple[int, int, Array]]:  # fmt: skip
    """Return what each parameter does to the weighted readings; new positions are listed."""
    slopes: list[tuple[int, int, Array]] = []
    mine = lasers[used]
    for place, kind in enumerate(kinds):
        for laser in np.unique(mine).tolist():
            rows = np.where((mine == laser)[:, None], by_channel[:, None] * basis, 0.0)
            slopes.append((place * count + laser, KINDS.index(kind), rows))
    channels = np.flatnonzero(used)
    for point in dict.fromkeys(body.points[channel] for channel in channels):
        own = np.array([body.points[channel] == point for channel in channels])
        sd = float(body.position_sd_mm[channels[own][0]])
        if not (np.isfinite(sd) and sd > 0.0):
            continue
        if (number, point) not in places:
            places[number, point] = size + 3 * len(places)
            prior.extend([sd * 1e-3] * 3)
        for axis in range(3):
            rows = np.zeros_like(basis)
            moved = shifted_point_rows(body.directions[channels[own]], np.eye(3)[axis])
            rows[own] = by_channel[own, None] * (moved[:, dof] @ to_dof)
            slopes.append((places[number, point] + axis, 0, rows))
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
