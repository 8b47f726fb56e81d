"""One round of the search for faults: all tests on the channels that are left, and the best suspect."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.faults.alternatives import proposed
from legacy.kinematics.faults.catalogue import KINDS, Fault
from legacy.kinematics.faults.estimated_weights import NOISY
from legacy.kinematics.faults.findings import Finding, differ
from legacy.kinematics.faults.flexible_body import structure_of
from legacy.kinematics.faults.laser_scatter import LaserScatter
from legacy.kinematics.faults.noise_size import (
    LEAST_SAMPLES,
    channel_noise,
    channel_noise_energy,
    common_level,
)
from legacy.kinematics.faults.nuisance import MOST_SDS, Marginal, Nuisance, estimate_nuisance
from legacy.kinematics.faults.packed_readings import Packed
from legacy.kinematics.faults.proposals.exchanges import Layout
from legacy.kinematics.faults.refit import Refit, log_evidence
from legacy.kinematics.faults.score_information import State
from legacy.kinematics.faults.score_tests import (
    UNSEEN,
    Tested,
    lasers_of,
    of_one_size,
    places_of,
    score_tests,
)
from legacy.stapeskit.arrays import Array

# Share of clean files that may raise an alarm.
FALSE_ALARM = 0.01
# At how many places each kind is fitted: where it is most significant, and where leaving out helps most.
_TESTED = {"channel": 2, "point": 1, "laser": 1, "body": 1}
_BLAMED = {"channel": 3, "point": 3, "laser": 3, "body": 1}
_VARIED = {"channel": 3, "point": 2, "laser": 1, "body": 0}
# Share of the alarm probability below which a score test needs no fit to be believed.
_PLAINLY = 1e-3
# Energy over that of noise below which nothing but noise is left.
NOISE_ALONE = 2.0
# Exchanges that are fitted, the likeliest at first sight. Computation.
_EXCHANGED = 5
# Difference of log evidence that the data hardly show.
_NEAR = 3.0
# Share of the evidence for a body that bends from which a fault at one place is tried in its stead: it has
# fewer parameters, and is believed where it leaves nothing to be found.
_HALF = 0.5
# Shares of the alarm probability. They sum to more than 1: kinds tested at one place share residuals, and
# Bonferroni is too strict.
_SHARES: tuple[float, ...] = calibrated("faults.alarm_share")
_ALARM_SHARE = dict(zip(("channel", "point", "laser", "body"), _SHARES, strict=True))
_SORT = {"points": "point", "beams": "channel", "lasers": "laser"}
# Standard deviations by which the level of all channels exceeds the stated noise before that is doubted.
_SURELY_LOUDER = 3.0
# Share of the level that an explanation leaves, below which the level was mostly the fault: more than half.
_INFLATED = 0.5

# Share of the alarm probability that the tests of noise have.
_NOISE_SHARE = 0.05
# How many times the stated sd noise must be to be reported; less is a matter of chi2.
_NOISY_KNOWN = 1.5
# Ratio of variances by which channels of unknown noise may differ without a fault.
_ALIKE = 1.2**2
# How many of the loudest channels are looked at, and from which ratio of variances on.
_LOUDEST, _QUIET = 5, 1.3


class Search:
    """The fit with the channels that are left, and everything that is tested on it."""

    def __init__(
        self,
        data: Packed,
        prior_m: Array,
        layout: tuple[Array, Array],
        known: bool,
        alarm: float = FALSE_ALARM,
        lasers: LaserScatter | None = None,
    ) -> None:
        self.data, self.known, self.alarm, self.reported = data, known, alarm, layout
        self.given, nuisance = State.of(data), Nuisance.of(data, prior_m, lasers)
        merged = data.merged(self.given.z)
        self.exact = not len(nuisance.sd)
        self.near = Marginal(self.given, nuisance)
        if not self.exact:
            flat = data if nuisance.varies else merged
            self.near = Marginal.at(data, nuisance, estimate_nuisance(flat, nuisance).x)
        self.state = self.near.state
        self.live = data.live
        self.refit = Refit(self.near, merged)
        noise = self.noise = channel_noise(self.state)
        self.least = noise.least
        self.of_all = not known and noise.least < LEAST_SAMPLES
        self.level, self.sure = noise.level, noise.sure
        if self.of_all:
            self.level, self.sure = common_level(data, nuisance)
        self.noise_variance = self.level
        if known and self.level < 1.0 + _SURELY_LOUDER * np.sqrt(2.0 / self.sure):
            self.noise_variance = 1.0
        used = np.sum(data.weight > 0.0, axis=0)
        kept = np.sum(np.where(data.weight > 0.0, 1.0 - self.state.leverage, 0.0), axis=0)
        self.kept = kept / np.maximum(used, 1)
        self.columns = used * float(self.state.both.shape[2])
        self.freedom = float(np.sum(self.state.free()))
        self.points = data.by_point
        if data.whiten is not None and data.rest.shape[2] >= LEAST_SAMPLES and self.freedom > 0.5:
            rest = float(np.sum(np.abs(self.state.rest) ** 2)) / self.freedom / data.rest.shape[2]
            self.noise_variance = max(self.noise_variance, rest)
        self.structure = structure_of(self.state, self.noise_variance)

    @property
    def offsets_m(self) -> Array:
        """Most probable errors of the positions (channel, 3), of those with a stated sd."""
        return np.asarray(self.state.model.arms_m - self.data.assumed.arms_m)

    @property
    def energy(self) -> Array:
        """Leverage-corrected mean residual energy of each channel, (channel,); 1 for noise."""
        left = np.where(self.kept > 1e-3, self.kept, np.inf) * np.maximum(self.columns, 1.0)
        return np.asarray(np.sum(np.abs(self.state.plain(self.state.both)) ** 2, axis=(0, 2)) / left)

    @property
    def noise_energy(self) -> float:
        """Residual energy that noise has in the columns with motion."""
        return self.noise_variance * self.freedom * float(self.state.z.shape[2])

    def excess(self) -> float:
        """Return the residual energy of the columns with motion beyond that of noise, at least none."""
        return max(self.given.energy - self.noise_energy, 0.0)

    def chance(self, statistic: Array, size: NDArray[np.intp]) -> Array:
        """Return the probability (B,) of statistics by chance: chi-squared, or F with estimated noise."""
        from scipy.special import chdtrc, fdtrc

        value = np.maximum(statistic, 0.0) / self.noise_variance
        size = np.maximum(size, 1)
        if self.known and self.data.whiten is None:
            return np.asarray(chdtrc(size, value))
        freedom = self.sure
        if self.data.whiten is not None:
            freedom = min(freedom, 2.0 * max(self.data.rest[:, 0].size, self.least))
        if self.of_all:
            # The level holds the energy of the fault itself.
            left = np.maximum(freedom - value, 1e-9) / np.maximum(freedom - size, 1.0)
            return np.asarray(fdtrc(size, np.maximum(freedom - size, 1.0), value / size / left))
        return np.asarray(fdtrc(size, freedom, value / size))

    def _lowest(self) -> float:
        """Return the least corrected probability of all tests."""
        return min(
            (
                float(np.min(self.chance(test.statistic, test.freedom))) * self._number(test.owner)
                for test in self.tested
            ),
            default=1.0,
        )

    def loud_channels(self, scale: float = 0.0) -> list[tuple[float, Finding]]:
        """Return loud channels and their log evidence.

        ``scale`` is the noise variance of the evidence, where it is not that of the tests.

        Notes
        -----
        The energy of N complex values is chi-squared with 2 N degrees of freedom, an F where the variance is
        estimated; the evidence is the likelihood less a penalty (Schwarz 1978, doi:10.1214/aos/1176344136).
        """
        from scipy.special import chdtrc, fdtrc

        loud = []
        energy, h = self.energy, 1.0 - self.kept
        limit, margin = (_NOISY_KNOWN, 1.0) if self.known else (NOISY, _ALIKE)
        for channel in sorted(self.live, key=lambda c: -energy[c])[:_LOUDEST]:
            if energy[channel] < _QUIET * self.noise_variance or h[channel] > UNSEEN:
                continue
            value, count = channel_noise_energy(self.state, channel)
            ratio, left = value / self.noise_variance, 1.0 - float(h[channel])
            if ratio < _QUIET or ratio - h[channel] < limit**2 * left:
                continue
            twice, size = 2.0 * count, ratio / margin
            chance = chdtrc(twice, twice * size) if self.known else fdtrc(twice, self.sure, size)
            p = min(1.0, float(chance) * len(self.live) / _NOISE_SHARE)
            if p > self.alarm:
                continue
            over = value / (scale or self.noise_variance)
            score = count * (over - 1.0 - np.log(over)) - np.log(len(self.live)) - 0.5 * np.log(count)
            louder = float(np.sqrt((ratio - h[channel]) / left))
            loud.append((float(score), Finding("noise", [channel], p, size=louder)))
        return loud

    @property
    def bends(self) -> bool:
        """Whether many channels share a pattern that noise has not."""
        return self.structure.p_value <= _NOISE_SHARE * self.alarm

    @property
    def bending(self) -> float:
        """Log evidence that the body bends; zero where it does not, or faults at two points could do that."""
        return (
            self.structure.gain / self.noise_variance
            if self.bends and not self.structure.concentrated
            else 0.0
        )

    @property
    def empty(self) -> bool:
        """Whether nothing can be tested: no redundancy, or no noise."""
        return self.freedom < 0.5 or not self.noise_variance > 0.0

    def more_than(self, most: int) -> bool:
        """Return whether it is plain without fits that there are more faults than none or one.

        Notes
        -----
        Without the channels of a place the objective is no higher than with a fault there; what a turn of all
        beams takes is known to first order only, and twice of that is granted.
        """
        if self.empty:
            return False
        if not most:
            return self.bends or self._lowest() < _PLAINLY * self.alarm
        if not self.bends:
            return False
        sets = {own for test in self.tested if test.owner != "body" for own in test.sets}
        if any(2 * len(own) >= len(self.live) for own in sets):
            return False
        falls = [np.max(self.near.state.left_out(same)) for same in of_one_size(sorted(sets))]
        falls += [np.max(test.statistic) for test in self.tested if test.owner == "body"]
        return self.near.value - max(falls, default=0.0) > NOISE_ALONE * self.noise_energy

    def clean(self) -> bool:
        """Return whether nothing is significant, without fits of suspects."""
        return self.empty or not (self.bends or self._lowest() <= self.alarm or self.loud_channels())

    def best(self) -> Finding | None:
        """Return the suspect that explains most, or None when nothing is significant."""
        if self.empty:
            return None
        lowest, loud = self._lowest(), self.loud_channels()
        if lowest > self.alarm and not self.bends and not loud:
            return None
        fits = self._suspects()
        scale, strange = self._variance_without([fit.drop for fit in fits]), False
        scored = self.loud_channels(scale) if scale < self.noise_variance else list(loud)
        for fit in fits:
            p_value = self._p_value(fit)
            if p_value < self.alarm and not self._credible(fit):
                strange = True
            elif p_value < self.alarm:
                scored.append((self._evidence(fit, scale), self._with_covariance(fit, p_value)))
        if self.bending:
            scored.append((self.structure.gain / scale, self.flexible()))
        if not scored and strange:
            return replace(self.flexible(), p_value=min(lowest, self.structure.p_value))
        if not scored:
            return None
        scored.sort(key=lambda entry: -entry[0])
        top, finding = scored[0]
        least = _HALF * top if finding.kind == "flexible" else top - _NEAR
        near = [other for value, other in scored[1:] if value > least and differ(finding, other)]
        finding = replace(finding, rivals=tuple(near[:2]))
        fit = self.refit.refined(finding)
        return finding if fit is finding else self._with_covariance(fit, finding.p_value)

    def _variance_without(self, drops: list[float]) -> float:
        """Return the noise variance by which explanations are compared.

        A large fault is in the level of few lines, and of lines with gaps: what the best explanation leaves
        is nearer to the noise.
        """
        number = self.freedom * self.state.z.shape[2]
        if not drops or number < LEAST_SAMPLES:
            return self.noise_variance
        left = max((self.near.value - max(drops)) / number, 1.0 if self.known else 0.0)
        return left if 0.0 < left < _INFLATED * self.noise_variance else self.noise_variance

    def _evidence(self, fit: Finding, scale: float) -> float:
        return log_evidence(fit, scale, self.data.source.beams.lever_m)

    def _credible(self, fit: Finding) -> bool:
        """Return whether a fault is of a size that happens, or else leaves nothing but noise.

        Errors of positions or lasers beyond belief would explain the misfit in its stead.
        """
        kind = KINDS.get(fit.kind)
        if fit.strain > max(MOST_SDS, self.near.strain):
            return False
        if kind is None:
            return True
        small = float(np.linalg.norm(fit.parameters)) < kind.largest * kind.unit(
            self.data.source.beams.lever_m
        )
        return small or self.near.value - fit.drop < NOISE_ALONE * self.noise_energy

    def flexible(self) -> Finding:
        """Return the finding that the body is not rigid, with its share of the motion (rms)."""
        # Where the noise is not stated its level may hold the misfit: the patterns stand out from it.
        excess = max(self.state.energy - self.noise_energy, self.structure.gain)
        moved = float(np.sum(np.abs(self.data.y - self.state.e) ** 2))
        share = float(np.sqrt(excess / max(moved, 1e-300)))
        return Finding("flexible", list(self.live), self.structure.p_value, size=share)

    def _number(self, owner: str) -> float:
        """Return what p-values of one sort of culprit are multiplied with: Bonferroni, unequal shares."""
        count = sum(len(test.statistic) for test in self.tested if test.owner == owner)
        return max(count, 1) / _ALARM_SHARE[owner]

    @cached_property
    def tested(self) -> list[Tested]:
        """Tests of all kinds at all places."""
        return score_tests(self.near, places_of(self.given))

    def _suspects(self) -> list[Finding]:
        """Fit every kind of fault where it is most significant, and where leaving out helps most."""
        faults = []
        for owner in _TESTED:
            tested = [test for test in self.tested if test.owner == owner]
            blame = self._blame(own for test in tested for own in test.sets)
            chosen = dict.fromkeys(sorted(blame, key=blame.__getitem__)[: _BLAMED[owner]])
            strongest = dict[str, tuple[float, tuple[int, ...]]]()
            for test in tested:
                best = np.argsort(-test.statistic, kind="stable")[: _TESTED[owner]]
                chosen |= dict.fromkeys(test.sets[k] for k in best)
                first = (float(test.statistic[best[0]]), test.sets[best[0]])
                strongest[test.kind] = max(strongest.get(test.kind, first), first)
            places = {"channel": len(self.live), "point": len(self.points), "laser": 3}.get(owner, 1)
            for number, own in enumerate(chosen):
                for name in (test.kind for test in tested if own in set(test.sets)):
                    if number < _VARIED[owner] or not KINDS[name].varies or own == strongest[name][1]:
                        faults.append(Fault(name, owner, list(own), places=places))
        return self._likely([*faults, *self._exchanges()])

    def _blame(self, sets: Iterable[tuple[int, ...]]) -> dict[tuple[int, ...], float]:
        """Return minus what leaving out each set of channels takes of the residual energy."""
        # Faults of many channels are judged by all lines.
        blame = dict.fromkeys(sets, -float(np.sum(np.abs(self.given.both) ** 2)))
        for same in of_one_size([own for own in blame if 2 * len(own) < len(self.live)]):
            fall = -self.given.left_out(same)
            blame |= dict(zip(map(tuple, same.tolist()), fall.tolist(), strict=True))
        return blame

    def _likely(self, faults: list[Fault]) -> list[Finding]:
        """Fit faults, without those that cannot come near the best, the most promising first.

        No fault lowers the objective by more than leaving its channels out does: without the squares of their
        residuals the least sum of squares is no larger, whatever the fault makes of them. Nor by more than
        one of which it is a special case, as a gain is of any complex factor.
        """
        fall = self._blame(tuple(fault.channels) for fault in faults)
        # What explains less than half of what bending does is no rival of it.
        fits: list[Finding] = []
        best = _HALF * self.bending + _NEAR if self.bending else 0.0
        freed = dict[tuple[int, ...], float]()
        for fault in sorted(faults, key=lambda fault: (fall[tuple(fault.channels)], *_widest_first(fault))):
            own, needed = tuple(fault.channels), (best - _NEAR) * self.noise_variance
            if needed > 0.0:
                if own not in freed:
                    freed[own] = -fall[own] if self.exact else self.refit.most(own)
                wider = [fit.drop for fit in fits if fit.fault is not None and fault.is_within(fit.fault)]
                if min([freed[own], *wider]) < needed:
                    continue
            fit = self.refit.fit(fault)
            fits.append(fit)
            if self._credible(fit) and self._p_value(fit) < self.alarm:
                best = max(best, self._evidence(fit, self.noise_variance))
        return fits

    def _exchanges(self) -> list[Fault]:
        """Return the exchanges of names and coordinates that are most likely at first sight."""
        stand = dict.fromkeys(self.points, 0.0)
        for test in self.tested:
            if test.owner in ("channel", "point"):
                for own, value in zip(test.groups[:, 0], test.statistic, strict=True):
                    name = self.data.points[own]
                    stand[name] = max(stand[name], float(value))
        order = sorted(stand, key=lambda name: -stand[name])
        layout = Layout(self.data, self.points, lasers_of(self.data), *self.reported, order)
        exchanges = list(proposed("exchange", layout))
        if not exchanges:
            return []
        sights = self.refit.sights([found.value for found in exchanges])
        best = [exchanges[k] for k in np.argsort(sights, kind="stable")[:_EXCHANGED]]
        return [replace(found.value, text=found.text) for found in best]

    def _p_value(self, fit: Finding) -> float:
        """Return the probability of a fit by chance, corrected for the number of tests."""
        number = max(self._number(_SORT.get(fit.owner, fit.owner)), float(fit.places))
        chance = self.chance(np.array([2.0 * fit.drop]), np.array([len(fit.parameters)]))
        return min(1.0, float(chance[0]) * number)

    def _with_covariance(self, fit: Finding, p_value: float) -> Finding:
        """Return a fit with its probability and its covariance at the noise found."""
        return replace(fit, p_value=p_value, covariance=fit.covariance * self.noise_variance)


def _widest_first(fault: Fault) -> tuple[bool, int]:
    """Sort faults of the same channels: the same at all lines first, those with most parameters first."""
    return fault.entry.varies, -fault.size
