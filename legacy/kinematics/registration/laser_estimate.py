"""Estimate gain, phase and delay of each laser from the redundancy of its beams, all lines together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from legacy.kinematics.faults.detectable import POWER
from legacy.kinematics.faults.nuisance import MOST_SDS
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import BodyChannels
from legacy.kinematics.registration.laser_moments import (
    COHERENT_SD,
    Index,
    LaserMoments,
    LaserParameters,
    channel_patterns,
    laser_moments,
    sweep_information,
)
from legacy.kinematics.registration.prior_errors import LEAST_GAINED, compare_with_priors
from legacy.stapeskit.arrays import Array

_LEAST_LINES = 2
# Probability below which an estimate contradicts what was stated.
UNLIKELY = 1e-3
# A scatter of the lasers that fewer correct measurements show than the search raises alarms is a fault.
_ALARM_LEVEL = 0.01
# Lasers are tried as the cause of what is found when the sum of squares falls by this.
WORTH_CORRECTING = 9.0


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
        """Probability of an estimate so far from 0 by the stated sd, both against the mean of all lasers."""
        return compare_with_priors(self.values, self.covariance, self.prior_sd, self._mean_free_projection)[2]

    @property
    def _mean_free_projection(self) -> Array:
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

        variance = np.diag(self._mean_free_projection) * self.prior_sd**2 - self.sd**2
        observed = variance > LEAST_GAINED * self.prior_sd**2
        if not np.any(observed):
            return 1.0
        largest = float(np.max(np.abs(self.values[observed]) / np.sqrt(variance[observed])))
        return min(1.0, 2.0 * float(np.sum(observed)) * float(ndtr(-largest)))

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

        whole = np.diag(self._mean_free_projection)
        gained = 1.0 - (self.sd / self.prior_sd) ** 2 / whole
        observed = gained * whole > LEAST_GAINED
        if not np.any(observed):
            return np.full(len(whole), np.inf)
        needed = float(ndtri(POWER) - ndtri(0.5 * _ALARM_LEVEL / float(np.sum(observed))))
        return np.where(
            observed, needed * self.prior_sd / np.sqrt(whole * np.where(observed, gained, 1.0)), np.inf
        )

    @property
    def beyond_belief(self) -> bool:
        """Whether an error is so many times its stated sd that it is a fault, which a small error is not."""
        return bool(np.max(np.abs(self.values) / self.prior_sd) > MOST_SDS)

    @property
    def explains_misfit(self) -> bool:
        """Whether errors of lasers and positions as small as stated may explain the misfit."""
        excess = self.energy - self.fall - self.freedom
        enough = excess < COHERENT_SD * np.sqrt(self.freedom)
        return bool(enough and self.fall > WORTH_CORRECTING and self.is_as_stated())

    def is_as_stated(self, share: float = 1.0) -> bool:
        """Return whether the errors of the lasers are as small as stated, at a share of the alarm level."""
        return min(self.p_value, self.largest_p_value) > share * _ALARM_LEVEL


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
    parameters = LaserParameters(prior_sd, count)
    size = parameters.size
    sweeps: list[list[LaserMoments]] = []
    for (run, number), fit in fits.items():
        if (run, number) not in left_out:
            continue
        body = bodies[number]
        own = [
            laser_moments(fit, body, number, lasers[number], freq_hz, pattern, parameters)
            for pattern in channel_patterns(fit, body, left_out[run, number])
        ]
        moments = [block for block in own if block is not None]
        if sum(block.lines for block in moments) >= _LEAST_LINES:
            sweeps.append(moments)
    spread = parameters.sd
    values, covariance = np.zeros(len(spread)), np.diag(spread**2)
    start = np.zeros(len(spread))
    start[:size] = 0.0 if applied is None else applied
    parts = [sweep_information(own, len(spread)) for own in sweeps]
    levels = np.ones(len(parts))
    for _ in range(2 if parts else 0):
        information = sum(part.information / level for part, level in zip(parts, levels, strict=True))
        covariance = _with_priors(np.asarray(information), spread)
        total = sum(part.score / level for part, level in zip(parts, levels, strict=True))
        values = covariance @ (total - start / spread**2)
        levels = np.array([part.level(values) for part in parts])
    relative = np.kron(np.eye(len(parameters.kinds)), np.eye(count) - 1.0 / count)
    across = {
        key: np.asarray(relative @ covariance[:size, place : place + 3])
        for key, place in parameters.positions.items()
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


def _with_priors(information: Array, sd: Array) -> Array:
    """Return the covariance (p, p) of parameters with independent priors, from the information of the data.

    By the eigenvalues in units of the priors: data without noise would round the priors away.
    """
    values, vectors = np.linalg.eigh(information * np.outer(sd, sd))
    return np.outer(sd, sd) * ((vectors / (1.0 + np.maximum(values, 0.0))) @ vectors.T)
