"""Estimate gain, phase and delay of each laser from the redundancy of its beams, all lines together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.detectable import POWER
from kinematics.fit.neglected_motion import extended_beams
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels
from stapeskit.arrays import Array
from stapeskit.spatial import dof_indices, shifted_point_rows

Index = NDArray[np.intp]
KINDS = ("laser_gain", "laser_phase", "laser_delay")
# Points and lines of a body that are looked at: more of them say hardly more of a few lasers.
_MOST_POINTS, _MOST_LINES = 60, 2000
_LEAST_LINES = 2
# Sets of channels with values at the same lines that are looked at, the most frequent ones: they cost time.
_MOST_PATTERNS = 200
# A misfit beyond noise is coherent over the lines when it is this many standard deviations of its own.
_COHERENT_SD = 3.0
# Directions in which the data gain less than this share of the prior variance say nothing.
_LEAST_GAINED = 0.05
# Probability below which an estimate contradicts what was stated.
UNLIKELY = 1e-3
# A scatter of the lasers that fewer correct measurements show than the search raises alarms is a fault.
_ALARM_LEVEL = 0.01
# Lasers are tried as the cause of what is found when the sum of squares falls by this.
_WORTH_CORRECTING = 9.0
# An exchanged sign or a wrong range is no error of a few percent: beyond so many sd nothing is corrected.
_MOST_SDS = 6.0


@dataclass(frozen=True)
class LaserEstimate:
    """Estimated errors of the lasers.

    Attributes
    ----------
    values : ndarray, (p,)
        Most probable errors, in the order of the parameters, each against the mean of all lasers.
    remaining : ndarray, (p,)
        The part of it that the readings were not freed of before.
    covariance : ndarray, (p, p)
        After the data; motion and stated position errors left free.
    across : mapping of (body, point) to ndarray, (p, 3)
        Covariance of what the estimate leaves with the position errors of a point, m.
    prior_sd : ndarray, (p,)
    energy, fall : float
        Sum of squared residuals over noise, and by how much the estimate lowers it.
    freedom : int
        What noise makes of ``energy`` in the mean.
    count : int
        Lasers; each kind of error has one parameter for each of them.
    """

    values: Array
    remaining: Array
    covariance: Array
    across: Mapping[tuple[int, str], Array]
    prior_sd: Array
    energy: float = 0.0
    fall: float = 0.0
    freedom: int = 0
    count: int = 1

    @property
    def sd(self) -> Array:
        """Standard deviation (p,) after the data."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def p_value(self) -> float:
        """Probability of an estimate so far from 0 by the stated sd.

        Notes
        -----
        If the priors hold, the estimate has the covariance prior - posterior, both against the mean of all
        lasers.
        """
        from scipy.special import chdtrc

        gained, vectors = np.linalg.eigh(
            self._against_mean - self.covariance / np.outer(self.prior_sd, self.prior_sd)
        )
        seen = gained > _LEAST_GAINED
        along = vectors.T @ (self.values / self.prior_sd)
        chi2 = float(np.sum(along[seen] ** 2 / gained[seen]))
        return float(chdtrc(int(np.sum(seen)), chi2)) if np.any(seen) else 1.0

    @property
    def _against_mean(self) -> Array:
        """Projection (p, p) of errors to what they are against the mean of all lasers, for each kind."""
        kinds = len(self.values) // self.count
        return np.asarray(np.kron(np.eye(kinds), np.eye(self.count) - 1.0 / self.count), dtype=float)

    @property
    def largest_p_value(self) -> float:
        """Probability that the largest of the errors is so many times its stated sd.

        Notes
        -----
        Bonferroni's bound over the errors; where the priors hold, an estimate has the variance
        prior - posterior. A single laser that is off does not drown in the number of errors.
        """
        from scipy.special import ndtr

        variance = np.diag(self._against_mean) * self.prior_sd**2 - self.sd**2
        seen = variance > _LEAST_GAINED * self.prior_sd**2
        if not np.any(seen):
            return 1.0
        largest = float(np.max(np.abs(self.values[seen]) / np.sqrt(variance[seen])))
        return min(1.0, 2.0 * float(np.sum(seen)) * float(ndtr(-largest)))

    @property
    def detectable(self) -> Array:
        """Smallest errors (p,) of one laser, next to the scatter of all, that are found at POWER.

        Infinite for errors of which the data say nothing.

        Notes
        -----
        An error b of one of n lasers moves its estimate against the mean of all by b (1 - 1/n) gained, with
        gained the share of the prior variance that the data take away; ``largest_p_value`` compares that with
        the standard deviation of an estimate whose prior holds, sd sqrt((1 - 1/n) gained).
        """
        from scipy.special import ndtri

        whole = np.diag(self._against_mean)
        gained = 1.0 - (self.sd / self.prior_sd) ** 2 / whole
        seen = gained * whole > _LEAST_GAINED
        if not np.any(seen):
            return np.full(len(whole), np.inf)
        needed = float(ndtri(POWER) - ndtri(0.5 * _ALARM_LEVEL / float(np.sum(seen))))
        return np.where(seen, needed * self.prior_sd / np.sqrt(whole * np.where(seen, gained, 1.0)), np.inf)

    @property
    def beyond_belief(self) -> bool:
        """Whether an error is so many times its stated sd that it is a fault, which a small error is not."""
        return bool(np.max(np.abs(self.values) / self.prior_sd) > _MOST_SDS)

    @property
    def explains_misfit(self) -> bool:
        """Whether errors of lasers and positions as small as stated may explain the misfit."""
        left = self.energy - self.fall - self.freedom
        enough = left < _COHERENT_SD * np.sqrt(self.freedom)
        return bool(enough and self.fall > _WORTH_CORRECTING and self.as_stated)

    @property
    def as_stated(self) -> bool:
        """Whether the errors of the lasers are as small as stated."""
        return min(self.p_value, self.largest_p_value) > _ALARM_LEVEL


@dataclass(frozen=True)
class _Sweep:
    """What one body in one run says of all parameters.

    Attributes
    ----------
    information : ndarray, (p, p)
    score : ndarray, (p,)
    energy : float
        Sum of squared residuals over noise.
    freedom, lines : int
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
        if ratio - 1.0 < _COHERENT_SD / np.sqrt(self.freedom):
            return 1.0
        return ratio + (ratio - 1.0) * self.lines


@dataclass(frozen=True)
class _Block:
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
    freedom, lines : int
    """

    span: Array
    slopes: list[tuple[int, int, Array]]
    half: Array
    moment: Array
    energy: float
    freedom: int
    lines: int


def laser_estimate(
    fits: Mapping[tuple[int, int], LineFit],
    bodies: Sequence[BodyChannels],
    lasers: Sequence[Index],
    freq_hz: Array,
    prior_sd: Mapping[str, float],
    left_out: Mapping[tuple[int, int], Sequence[int]] | None = None,
    applied: Array | None = None,
) -> LaserEstimate:
    """Estimate errors of the lasers from the redundancy of the beams.

    Parameters
    ----------
    fits : mapping of (run, body) to LineFit
    bodies : sequence of BodyChannels
        In the footplate frame, as fitted.
    lasers : sequence of ndarray, by body
        The laser (from 0) of each channel.
    freq_hz : ndarray, (freq,)
    prior_sd : mapping of str to float
        By kind (KINDS): standard deviation of each laser, 1, rad and s; positive.
    left_out : mapping of (run, body) to sequence of int, optional
        Faulty channels, which are not used. A body without an entry is not used at all.
    applied : ndarray, (p,), optional
        Errors that the readings were corrected for.

    Notes
    -----
    Linear Bayesian estimate, the motion at every line projected out (variable projection: Golub and Pereyra
    1973, doi:10.1137/0710036), stated position errors as further unknowns with their priors. Weights are
    products of one factor per channel and one per line. A misfit that noise does not explain is taken for
    one that all lines share, so that it cannot pass for knowledge of the lasers. What all lasers have in
    common changes all motions alike: it cancels in K and D and is left out.
    """
    left_out = dict.fromkeys(fits, ()) if left_out is None else left_out
    count = 1 + max(int(np.max(body)) for body in lasers)
    kinds = [kind for kind in KINDS if kind in prior_sd]
    size = len(kinds) * count
    prior = list(np.repeat([prior_sd[kind] for kind in kinds], count))
    places: dict[tuple[int, str], int] = {}
    sweeps: list[list[_Block]] = []
    for (run, number), fit in fits.items():
        if (run, number) not in left_out:
            continue
        body = bodies[number]
        own = [
            _block(fit, body, number, lasers[number], freq_hz, kinds, count, used, weights, lines, places,
                   prior, size)
            for used, weights, lines in _patterns(fit, body, left_out[run, number])
        ]  # fmt: skip
        held = [block for block in own if block is not None]
        if sum(block.lines for block in held) >= _LEAST_LINES:
            sweeps.append(held)
    spread = np.array(prior)
    values, covariance = np.zeros(len(spread)), np.diag(spread**2)
    start = np.zeros(len(spread))
    start[:size] = 0.0 if applied is None else applied
    parts = [_sweep(own, len(spread)) for own in sweeps]
    levels = np.ones(len(parts))
    for _ in range(2 if parts else 0):
        information = np.diag(1.0 / spread**2) + sum(
            part.information / level for part, level in zip(parts, levels, strict=True)
        )
        scale = np.outer(spread, spread)
        covariance = scale * np.linalg.inv(information * scale)
        total = sum(part.score / level for part, level in zip(parts, levels, strict=True))
        values = covariance @ (total - start / spread**2)
        levels = np.array([part.level(values) for part in parts])
    relative = np.kron(np.eye(len(kinds)), np.eye(count) - 1.0 / count)
    across = {
        key: np.asarray(relative @ covariance[:size, place : place + 3]) for key, place in places.items()
    }
    remaining = relative @ values[:size]
    return LaserEstimate(
        start[:size] + remaining,
        remaining,
        relative @ covariance[:size, :size] @ relative,
        across,
        spread[:size],
        sum(part.energy for part in parts),
        sum(part.fall(values) for part in parts),
        sum(part.freedom for part in parts),
        count,
    )


def _sweep(blocks: Sequence[_Block], size: int) -> _Sweep:
    """Return what the blocks of one body in one run say together."""
    both = [_information(block, size) for block in blocks]
    return _Sweep(
        np.sum([information for information, _ in both], axis=0),
        np.sum([score for _, score in both], axis=0),
        sum(block.energy for block in blocks),
        sum(block.freedom for block in blocks),
        sum(block.lines for block in blocks),
    )


def _patterns(
    fit: LineFit, body: BodyChannels, left_out: Sequence[int]
) -> list[tuple[NDArray[np.bool_], Array, Index]]:
    """Return sets of channels, their weights and the lines at which just these have values.

    Each as a mask (channel,), weights (n, line) and places of lines (line,).

    The most frequent first.
    """
    if not float(np.sum(fit.solution.explained)) > 0.0:
        return []
    names = list(dict.fromkeys(body.points))
    chosen = set(names[:: -(-len(names) // _MOST_POINTS)])
    wanted = (fit.solution.used > 0) & np.array([point in chosen for point in body.points])
    wanted[list(left_out)] = False
    lines = np.arange(fit.value.shape[1])[:: max(1, fit.value.shape[1] // _MOST_LINES)]
    weights = fit.at(lines, wanted)[2]
    sets, of_line, count = np.unique(weights.T > 0.0, axis=0, return_inverse=True, return_counts=True)
    patterns = []
    for number in np.argsort(-count, kind="stable")[:_MOST_PATTERNS]:
        used, own = wanted.copy(), of_line == number
        used[wanted] = sets[number]
        patterns.append((used, weights[np.ix_(sets[number], own)], lines[own]))
    return patterns


def _block(
    fit: LineFit, body: BodyChannels, number: int, lasers: Index, freq_hz: Array, kinds: Sequence[str],
    count: int, used: NDArray[np.bool_], weights: Array, lines: Index, places: dict[tuple[int, str], int],
    prior: list[float], size: int,
) -> _Block | None:  # fmt: skip
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
    seen = span.T @ readings
    residual = readings - span @ seen
    coefficients = np.linalg.solve(upper, seen)
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
    return _Block(
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


def _information(block: _Block, size: int) -> tuple[Array, Array]:
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
