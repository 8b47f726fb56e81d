"""One round of the search: the fit under accepted faults, its noise, all tests, and what they would find.

Shapes: c channels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np

from kinematics.faults.fault_kinds import KINDS, SHARE, Place, places
from kinematics.faults.scores import Noise, Test, informations, score_tests
from kinematics.faults.unstated_noise import unknown_noise
from kinematics.joint.estimate import Estimate, State, joint
from kinematics.joint.expected import Layout
from kinematics.joint.noise_levels import LEAST_FREEDOM, ChannelLevels, channel_levels, pooled_levels
from kinematics.joint.pack import Packed, Readings, pack
from kinematics.joint.tangents import Parameters
from stapeskit.arrays import Array

ALARM = 0.01
"""Probability that a file without faults is given one (contract of the verdicts)."""
ALARM_SHARES = (0.6, 0.25, 0.1)
"""Shares of it of the tests of kinds, of the noise of channels, and of the sum of all squares. Tests of kinds
that contain each other are weighted as if each were alone and the owners independent (`SHARE`), which makes
1.1 times as many alarms (2 000 simulated files); the sum is 1.0."""
POWER = 0.9
"""Probability with which a fault of the reported size is found: the usual power of a planned test."""
_LEVEL_ROUNDS = 2  # of the noise of channels: wrong weights put noise into the columns that hold the motion
_STATED = 1e-4  # sd of a logarithm that is as good as none
_BELIEVED = 6.0  # standard deviations of an expected error: beyond, 2e-9 by chance, it is what a fault makes


@dataclass(frozen=True)
class Round:
    """The readings under the faults accepted so far, and the tests for further faults."""

    readings: Readings
    layout: Layout
    packed: Packed
    expected: Parameters
    estimate: Estimate
    noise: Noise
    tests: tuple[Test, ...]
    levels: ChannelLevels

    @property
    def state(self) -> State:
        """The motion with the expected errors."""
        return self.estimate.state

    @cached_property
    def believed(self) -> tuple[Array, State]:
        """Expected errors (p,) that faults are fitted from, and the motion with them.

        A dead channel drives the expected errors of its laser so far off that no fit returns: faults are then
        fitted from zero.
        """
        if np.all(np.abs(self.estimate.values) <= _BELIEVED * self.expected.sd):
            return self.estimate.values, self.state
        return np.zeros(len(self.expected)), State(self.packed)

    @property
    def live(self) -> list[int]:
        """Channels in use."""
        return self.packed.live.tolist()

    @cached_property
    def tails(self) -> Array:
        """Logarithm of the p-value of each test alone, (tests,), by the noise that its channels show."""
        statistic = np.array([test.statistic for test in self.tests])
        freedom = np.array([test.freedom for test in self.tests])
        if not self.levels.spread.any():
            return self.noise.log_tail(statistic, freedom)
        own = self.state.own_noise[1] + 0.5 / np.maximum(self.levels.spread, _STATED) ** 2
        known = {test.place: own[list(test.place.channels)].sum() for test in self.tests}
        return self.noise.log_tail(statistic, freedom, np.array([known[test.place] for test in self.tests]))

    @cached_property
    def log_p(self) -> Array:
        """Logarithm of the p-value of each test, weighted so that all together are one test (tests,)."""
        owners = [test.place.owner for test in self.tests]
        number = {owner: owners.count(owner) / share for owner, share in SHARE.items()}
        return np.asarray(self.tails + np.log([number[owner] for owner in owners]))

    @cached_property
    def loudness(self) -> Array:
        """Variance of each channel's noise over the stated or usual one, (c,); 1 where unknown."""
        energy, freedom = self.state.channel_energy
        ratio = energy * self.levels.apart**2 / np.maximum(freedom, 1.0) / self.noise.level
        return np.where(freedom > LEAST_FREEDOM, ratio, 1.0)

    @cached_property
    def channel_noise(self) -> Array:
        """Logarithm of the probability that a channel is as loud as it is by chance, (c,); 0 if unknown."""
        from scipy.special import log_ndtr

        _, freedom = self.state.channel_energy
        freedom = np.maximum(freedom, 1.0)
        if not self.levels.spread.any():
            tail = self.noise.log_tail(self.loudness * self.noise.level * freedom, freedom)
        else:
            width = np.sqrt(self.levels.spread**2 + 0.5 / freedom)
            tail = log_ndtr(-0.5 * np.log(np.maximum(self.loudness, 1e-300)) / width)
        return np.where(freedom > LEAST_FREEDOM, tail, 0.0)

    def channel_log_p(self) -> Array:
        """Return the log of each channel's smallest p-value, corrected for the number of its tests."""
        out = np.minimum(self.channel_noise, 0.0)
        count = np.ones(len(out))
        for test, tail in zip(self.tests, self.tails, strict=True):
            if test.place.owner == "channel":
                (channel,) = test.place.channels
                out[channel] = min(out[channel], tail)
                count[channel] += 1.0
        return np.minimum(out + np.log(count), 0.0)

    @property
    def _whole(self) -> tuple[float, float]:
        """Sum of all squares, and its degrees of freedom."""
        energy, freedom = (float(part.sum()) for part in self.state.noise_energy)
        return self.estimate.chi2 + energy, self.state.freedom + freedom

    @cached_property
    def log_whole(self) -> float:
        """Logarithm of the probability of the sum of all squares; 0 where no noise is known apart from it."""
        if self.readings.known is not None:
            return float(self.noise.log_tail(*self._whole))
        if not self.packed.turned:
            return 0.0
        return float(self.noise.log_tail(self.estimate.chi2, self.state.freedom))

    def evidence(self, fall: float, count: int) -> float:
        """Return the log likelihood gained by a fall of chi2, less what so many parameters cost.

        Notes
        -----
        Schwarz 1978, doi:10.1214/aos/1176344136. What a fault leaves beyond the noise, other faults for
        instance, counts as noise of a size that is not known: it must not be explained by more parameters.
        """
        whole, freedom = self._whole

        def log_likelihood(chi2: float) -> float:
            level = max(chi2 / freedom, self.noise.level)
            return -0.5 * float(freedom * np.log(level) + chi2 / level)

        gained = log_likelihood(max(whole - fall, 0.0)) - log_likelihood(whole)
        return gained - 0.5 * count * float(np.log(self.packed.values))

    def clean(self) -> bool:
        """Return whether nothing is wrong, at the level of alarms of `ALARM`."""
        loudest = np.min(self.channel_noise) + np.log(max(len(self.live), 1))
        smallest = np.array([np.min(self.log_p, initial=0.0), loudest, self.log_whole])
        return bool(np.all(smallest > np.log(ALARM * np.array(ALARM_SHARES))))


def null_fit(readings: Readings, layout: Layout) -> Round:
    """Fit motion and expected errors, find the level of the noise, and test everything."""
    stated = readings.known is not None
    packed = pack(readings)
    live = packed.live.tolist()
    expected = layout.expected(live)
    estimate = joint(packed, expected)
    levels = ChannelLevels.as_assumed(len(layout.points))
    for _ in range(_LEVEL_ROUNDS if readings.known is None or readings.known.any() else 0):
        levels = channel_levels(estimate.state, layout.laser, levels.level, readings.known)
        packed = pack(replace(readings, noise_factor=readings.noise_factor * levels.level))
        estimate = joint(packed, expected, estimate.values)
    if not stated and packed.turned:
        energy, freedom = (part.sum(axis=1) for part in estimate.state.noise_energy)
        packed = packed.scaled(np.maximum(pooled_levels(energy, freedom), 1e-150))
        estimate = joint(packed, expected, estimate.values)
    tests = tuple(score_tests(estimate.state, expected, places(layout, live)))
    noise = Noise() if stated else unknown_noise(estimate, tests, levels.unsure)
    return Round(readings, layout, packed, expected, estimate, noise, tests, levels)


class Detectable(NamedTuple):
    """The smallest fault that is found with a probability of 90 %.

    Its size is in 1, rad, s or m, along the least visible direction of the kind; infinite where one never
    shows.
    """

    place: Place
    kind: str
    size: float


def detectable(now: Round) -> list[Detectable]:
    """Return the smallest fault of every kind at every place that would be found.

    Notes
    -----
    The score test has the non-centrality x^T N x for a fault x with information N (motion and expected errors
    free). It is found where that is as large as the alarm level and the power ask for; the level of noise
    that is not stated counts with its own degrees of freedom.
    """
    owners = [test.place.owner for test in now.tests]
    found = []
    looked_at = places(now.layout, now.live)
    every, _, all_information = informations(now.state, now.expected, looked_at)
    for place, kinds, information in zip(looked_at, every, all_information, strict=True):
        chance = ALARM * SHARE[place.owner] / max(owners.count(place.owner), 1)
        for kind in kinds:
            tangents = list(KINDS[kind].tangents)
            need = noncentrality(len(tangents), chance, now.noise) * now.noise.level
            value = np.linalg.eigvalsh(information[np.ix_(tangents, tangents)])
            seen = value[0] > 1e-9 * max(value[-1], 1e-300)
            found.append(Detectable(place, kind, float(np.sqrt(need / value[0])) if seen else float("inf")))
    return found


@cache
def noncentrality(freedom: int, chance: float, noise: Noise) -> float:
    """Return the non-centrality at which a test of level ``chance`` has the power `POWER`."""
    from scipy.special import chdtri, chndtrinc, fdtri

    level = chdtri(freedom, chance)
    if np.isfinite(noise.freedom):
        level = freedom * fdtri(freedom, noise.freedom, 1.0 - chance)
    return float(chndtrinc(level, freedom, 1.0 - POWER))
