"""One round of the search for faults: all tests on the channels that are left, and the best suspect."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinematics.faults import fault_kinds as kinds
from kinematics.faults.evidence import log_evidence
from kinematics.faults.fault_kinds import Fault
from kinematics.faults.fault_model import FaultFit, State, fit_fault, objective, solve, static
from kinematics.faults.findings import Finding, differ
from kinematics.faults.noise.channel_noise import LEAST_SAMPLES, ChannelNoise
from kinematics.faults.noise.few_lines import level_of_all
from kinematics.faults.noise.noisy import ALARM_SHARE, noisy
from kinematics.faults.packed.compact import Compact
from kinematics.faults.packed.mixing import Mixing, axes_of, block_covariance, scaled
from kinematics.faults.refit import Places
from kinematics.faults.score_tests import ScoreTests, Tested, any_batches, axes_batch, batches
from kinematics.faults.structure import Structure, structure_of

Array = NDArray[np.float64]
FALSE_ALARM = 0.01
_BLAMED = {"channel": 3, "point": 3, "laser": 3}
_TESTED = {"channel": 2, "point": 1, "laser": 1}
_VARIED = {"channel": 3, "point": 2, "laser": 1}
_SUSPECTS, _EXCHANGES = 10, 5
_NEAR = 3.0
_TURN, _FAR = 0.6, 3.0
# Shares of the alarm probability. They sum to more than 1: kinds tested at one place share residuals, and
# Bonferroni is too strict. Measured with noise and structure: 1.0 +- 0.2 % of clean files (points_faults.py).
_ALARM_SHARE = {"channel": 0.9, "point": 0.25, "laser": 0.2, "body": 0.3}
_SORT = {"points": "point", "beams": "channel", "lasers": "laser"}
_VARYING = ("delay", "drift")


class Search:
    """The fit with the channels that are left, and everything that is tested on it.

    Attributes
    ----------
    raw, data : Compact
        As given, and with the points moved within their stated position errors.
    """

    def __init__(
        self,
        data: Compact,
        prior_m: Array,
        noise_known: bool,
        alarm: float = FALSE_ALARM,
        doubt: Array | None = None,
    ) -> None:
        self.raw, self.known, self.alarm = data, noise_known, alarm
        self.places = Places.of(data, prior_m)
        self.flat = static(data)
        shift = np.zeros((0, 3))
        if self.places.owners:
            shift = fit_fault(self.flat, self.places, None)[1]
        self.shift = shift
        self.data = self.places.moved(data, shift)
        self.state = solve(self.data)
        self.before = float(np.sum(np.abs(self.state.e) ** 2)) + self.places.penalty(shift)
        self.given = solve(data) if self.places.owners else self.state
        self.live = data.live
        self.h = self.state.h
        self.rest = self.state.rest()
        self.samples = self.rest.shape[1]
        self.noise = ChannelNoise.of(self.state, self.rest)
        self.of_all = not noise_known and self.noise.number < LEAST_SAMPLES
        if self.of_all:
            level, sure = level_of_all(self.given, self.given.rest(), self.places)
            self.noise = replace(self.noise, level=level, sure=sure)
        self.level = self.noise.level
        self.scale = max(1.0, self.level) if noise_known else self.level
        if data.mixing is not None and self.samples >= 8 and self.live:
            free = max(len(self.live) - self.state.span.shape[1], 1)
            self.scale = max(self.scale, float(np.sum(np.abs(self.rest) ** 2)) / free / self.samples)
        self.unsure = self._unsure(doubt)
        groups: dict[str, list[int]] = {}
        for channel in self.live:
            groups.setdefault(data.points[channel], []).append(channel)
        self.by_point = groups
        self.structure = self._structure()
        self.tested: list[Tested] = []

    def _unsure(self, doubt: Array | None) -> Array:
        """Return the relative variance (channel,) of the noise that each channel's residuals should have.

        Notes
        -----
        A residual holds the noise of all channels by the squares of its row of the projector (Satterthwaite
        1946, doi:10.2307/3002019); the doubt of the common level is added.
        """
        common = np.full(len(self.h), 2.0 / self.noise.sure)
        if self.known or doubt is None or not np.any(doubt > 0.0):
            return common
        share = np.square(self.state.project())
        share = share / np.maximum(np.sum(share, axis=1, keepdims=True), 1e-300)
        return np.asarray(common + share**2 @ doubt)

    def _structure(self) -> Structure:
        """Look for patterns that several points share; noise within a point is none, however correlated."""
        structure = structure_of(self.state, self.rest, self.scale)
        both = self.state.plain(np.hstack([self.state.e, self.rest]))
        within = None
        if self.data.mixing is not None and structure.p_value < 1.0:
            within = block_covariance(both, self.state.project(), self.data.points, self.live)
        if within is None:
            return structure
        shared, sd = scaled(within)
        even = replace(self.data, a=self.data.a / sd, mixing=Mixing.of(shared, self.live))
        state = solve(even)
        strict = structure_of(state, state.rest(), 1.0)
        if strict.p_value <= structure.p_value:
            return structure
        return replace(structure, ratio=strict.ratio, p_value=strict.p_value)

    def energy(self) -> Array:
        """Return the leverage-corrected mean residual energy of each channel, (channel,); 1 for noise."""
        plain = self.state.plain
        both = np.sum(np.abs(plain(self.state.e)) ** 2, axis=1) + np.sum(
            np.abs(plain(self.rest)) ** 2, axis=1
        )
        left = np.where(self.h < 0.999, 1.0 - self.h, np.inf)
        return np.asarray(both / left / (self.state.e.shape[1] + self.samples))

    def excess(self) -> float:
        """Return the residual energy of the packed lines beyond that of noise, at least none."""
        left = (len(self.live) - self.state.span.shape[1]) * self.state.e.shape[1]
        return max(float(np.sum(np.abs(self.given.e) ** 2)) - self.scale * left, 0.0)

    def level_p(self) -> float:
        """Return the probability of so large a total residual by chance."""
        from scipy.special import chdtrc

        columns = self.state.e.shape[1] + self.samples
        freedom = 2.0 * columns * (len(self.live) - self.state.span.shape[1])
        total = 2.0 * float(np.sum(np.abs(self.state.e) ** 2) + np.sum(np.abs(self.rest) ** 2))
        return float(chdtrc(freedom, total)) if freedom > 0.0 else 1.0

    def _freedom(self, channels: NDArray[np.int64]) -> Array:
        """Return the degrees of freedom (B,) that the estimated noise of sets of channels (B, n) rests on."""
        made = 2.0 / np.mean(self.unsure[channels], axis=1)
        if self.data.mixing is not None:
            made = np.minimum(made, 2.0 * max(self.samples, self.noise.number))
        return np.asarray(np.maximum(made, 1.0))

    def chance(self, statistic: Array, size: Array, channels: NDArray[np.int64]) -> Array:
        """Return the probability (B,) of statistics by chance.

        Chi-squared, or F when the noise is estimated; ``channels`` (B, n) are those that they rest on.
        """
        from scipy.special import chdtrc, fdtrc

        value = np.maximum(statistic, 0.0) / self.scale
        if self.known and self.data.mixing is None:
            return np.asarray(chdtrc(size, value))
        freedom = self._freedom(channels)
        if self.of_all:
            # The level holds the energy of the fault itself.
            left = np.maximum(freedom - value, 1e-9) / np.maximum(freedom - size, 1.0)
            return np.asarray(fdtrc(size, np.maximum(freedom - size, 1.0), value / size / left))
        return np.asarray(fdtrc(size, freedom, value / size))

    def best(self) -> Finding | None:
        """Return the suspect that explains most, or None when nothing is significant."""
        if len(self.live) <= self.state.span.shape[1] or not self.scale > 0.0:
            return None
        self._test()
        noisy = self._noisy()
        lowest = min(
            (float(np.min(self._p(found))) * self._number(found.batch.owner) for found in self.tested),
            default=1.0,
        )
        unsure = self.structure.p_value > ALARM_SHARE * self.alarm
        if lowest > self.alarm and unsure and not noisy:
            return None
        scored = list(noisy)
        strange = False
        for fit in self._suspects():
            finding = self._finding(fit)
            if finding.p_value < self.alarm and not self._credible(fit):
                strange = True
            elif finding.p_value < self.alarm:
                scored.append((log_evidence(fit, self.scale, self._alike(fit.fault)), finding))
        if not unsure and not self.structure.concentrated:
            scored.append((self.structure.gain / self.scale, self.flexible()))
        if not scored and strange:
            return replace(self.flexible(), p_value=min(lowest, self.structure.p_value))
        if not scored:
            scored = self._noisy(whole=True)
        if not scored:
            return None
        scored.sort(key=lambda entry: -entry[0])
        top, finding = scored[0]
        near = 0.5 * top if finding.kind == "flexible" else top - _NEAR
        rivals = tuple(other for value, other in scored[1:] if value > near and differ(finding, other))
        return Finding(finding.kind, finding.channels, finding.p_value, finding.fit, finding.size, rivals[:2])

    def _credible(self, fit: FaultFit) -> bool:
        """Tell whether a fault is of a size that happens, or else leaves nothing but noise."""
        if fit.fault.kind not in ("axes", "direction", "position"):
            return True
        size = float(np.linalg.norm(fit.parameters))
        largest = _FAR * self.data.beams.lever_m if fit.fault.kind == "position" else _TURN
        left = (len(self.live) - self.state.span.shape[1]) * self.state.e.shape[1]
        return size < largest or self.before - fit.drop < 2.0 * self.scale * left

    def flexible(self) -> Finding:
        """Return the finding that the body is not rigid, with its share of the motion (rms)."""
        moved = self.data.white(self.data.beams.basis @ self.state.z)
        left = len(self.live) - self.state.span.shape[1]
        excess = float(np.sum(np.abs(self.state.e) ** 2)) - self.scale * left * self.state.e.shape[1]
        share = float(np.sqrt(max(excess, 0.0) / max(float(np.sum(np.abs(moved) ** 2)), 1e-300)))
        return Finding("flexible", list(self.live), self.structure.p_value, None, share)

    def _number(self, owner: str) -> float:
        """Return what p-values of one sort of culprit are multiplied with: Bonferroni, unequal shares."""
        count = sum(len(found.statistic) for found in self.tested if found.batch.owner == owner)
        return max(count, 1) / _ALARM_SHARE[owner]

    def _p(self, found: Tested) -> Array:
        return self.chance(found.statistic, np.maximum(found.freedom, 1), found.batch.channels)

    def _test(self) -> None:
        tests = ScoreTests(self.state, self.places)
        free = [c for c in self.live if self.given.h[c] < 0.98]
        points = [
            own for own in self.by_point.values() if len(self.live) - len(own) >= self.state.span.shape[1]
        ]
        made = batches(tests, free, points, self._lasers())
        if len(self.live) == np.count_nonzero(self.data.source.channel):
            made.append(axes_batch(tests))
        self.tested = [tests.run(batch) for batch in made]

    def _lasers(self) -> list[list[int]]:
        """Return the channels of beams that are nearly parallel at several points, when there are others.

        A single beam off the others by a few degrees stays with them: that its laser is at fault everywhere
        else is no explanation.
        """
        groups = axes_of(self.data.directions, self.live)
        many = [own for own in groups if len({self.data.points[c] for c in own}) > 2]
        return many if len(groups) > 1 and len(many) <= 8 else []

    def _suspects(self) -> list[FaultFit]:
        """Fit every kind of fault where it is most significant, and where leaving out helps most."""
        faults = []
        given = self.given
        freely = self._freely() if self.places.owners else {}
        for owner, groups in self._owners().items():
            tested = [found for found in self.tested if found.batch.owner == owner]
            blame = _blamed(given, groups)
            orders = [sorted(groups, key=lambda own: -blame[own])]
            if freely:
                orders.append(sorted(groups, key=lambda own: -freely.get(own, 0.0)))
            chosen = dict.fromkeys(
                own
                for first in zip(*(order[: _BLAMED[owner]] for order in orders), strict=True)
                for own in first
            )
            for found in tested:
                best = np.argsort(-found.statistic, kind="stable")[: _TESTED[owner]]
                chosen |= dict.fromkeys(tuple(int(c) for c in found.batch.channels[k]) for k in best)
            known = [(found.batch.kind, set(_sets(found))) for found in tested]
            for number, own in enumerate(chosen):
                some = number < _VARIED[owner]
                names = dict.fromkeys(kind for kind, sets in known if own in sets)
                faults += [
                    self._fault(kind, owner, list(own)) for kind in names if some or kind not in _VARYING
                ]
        if any(found.batch.kind == "axes" for found in self.tested):
            faults.append(kinds.axes(self.raw))
        return self._likely([*faults, *self._swaps()])

    def _likely(self, faults: list[Fault]) -> list[FaultFit]:
        """Fit faults, without those that cannot come near the best: none takes more than leaving out does."""
        bends = self.structure.p_value <= ALARM_SHARE * self.alarm and not self.structure.concentrated
        if self.places.owners or bends:
            return [self.fitted(fault) for fault in faults]
        sets = dict.fromkeys(tuple(fault.channels) for fault in faults)
        most = {own: fall / self.scale for own, fall in _blamed(self.given, sets).items()}
        made, best = [], 0.0
        for fault in sorted(faults, key=lambda fault: -most[tuple(fault.channels)]):
            if most[tuple(fault.channels)] < best - _NEAR:
                continue
            fit = self.fitted(fault)
            made.append(fit)
            if self._credible(fit) and self._finding(fit).p_value < self.alarm:
                best = max(best, log_evidence(fit, self.scale, self._alike(fault)))
        return made

    def _freely(self) -> dict[tuple[int, ...], float]:
        """Return, per channel and point, what any change of its rows would explain beside the positions."""
        tests = ScoreTests(self.given, self.places, settled=False)
        free = [c for c in self.live if self.given.h[c] < 0.98]
        size = self.state.span.shape[1]
        points = [own for own in self.by_point.values() if len(self.live) - len(own) >= size]
        made: dict[tuple[int, ...], float] = {}
        for batch in any_batches(tests, free, points):
            found = tests.run(batch)
            made |= dict(zip(_sets(found), found.statistic.tolist(), strict=True))
        return made

    def _owners(self) -> dict[str, list[tuple[int, ...]]]:
        """Return the sets of channels that were tested, by what they are."""
        made: dict[str, dict[tuple[int, ...], None]] = {}
        for found in self.tested:
            if found.batch.owner != "body":
                made.setdefault(found.batch.owner, {}).update(dict.fromkeys(_sets(found)))
        return {owner: list(groups) for owner, groups in made.items()}

    def _fault(self, kind: str, owner: str, channels: list[int]) -> Fault:
        if kind == "gain":
            return kinds.gain(channels, owner)
        if kind == "phase":
            return kinds.phase(channels, owner)
        if kind == "delay":
            return kinds.delay(self.raw, channels, owner)
        if kind == "drift":
            return kinds.drift(channels, owner)
        if kind == "direction":
            return kinds.direction(self.raw, channels, owner)
        return kinds.position(self.raw, channels)

    def fitted(self, fault: Fault) -> FaultFit:
        """Fit a fault, jointly with the positions where these are uncertain."""
        if fault.kind in _VARYING:
            return fit_fault(self.raw, self.places, fault, self.before)[0]
        fit, shift = fit_fault(self.flat, self.places, fault)
        return replace(fit, drop=self.before - objective(self.raw, self.places, fit, shift))

    def _alike(self, fault: Fault) -> int:
        points = len(self.by_point)
        if fault.kind == "label_swap":
            return {"points": points * (points - 1) // 2, "beams": len(self.live)}.get(fault.owner, 3)
        return {"channel": len(self.live), "point": points, "laser": 3}.get(fault.owner, 1)

    def _swaps(self) -> list[Fault]:
        """Return the exchanges of names that are most likely at first sight."""
        stand = dict.fromkeys(self.by_point, 0.0)
        for found in self.tested:
            if found.batch.kind in ("position", "gain", "direction"):
                for own, value in zip(found.batch.channels, found.statistic, strict=True):
                    if found.batch.owner in ("channel", "point"):
                        name = self.data.points[own[0]]
                        stand[name] = max(stand[name], float(value))
        order = sorted(stand, key=lambda name: -stand[name])[:_SUSPECTS]
        made = [
            kinds.swap(self.raw, self.by_point[one], self.by_point[two], "points")
            for one, two in combinations(order, 2)
        ]
        for name in order[:4]:
            own = self.by_point[name]
            made += [kinds.swap(self.raw, [one], [two], "beams") for one, two in combinations(own, 2)]
        for one, two in combinations(self._lasers(), 2):
            same = {self.data.points[c]: c for c in two}
            both = [(c, same[self.data.points[c]]) for c in one if self.data.points[c] in same]
            if len(both) > 2:
                made.append(kinds.swap(self.raw, [c for c, _ in both], [d for _, d in both], "lasers"))
        chosen: dict[int, Fault] = {}
        shifts = [self.shift, np.zeros_like(self.shift)] if self.places.owners else [self.shift]
        for shift in shifts:
            left = [self._at_sight(fault, shift) for fault in made]
            chosen |= {k: made[k] for k in sorted(range(len(made)), key=lambda k: left[k])[:_EXCHANGES]}
        return list(chosen.values())

    def _at_sight(self, fault: Fault, shift: Array) -> float:
        """Return the objective after an exchange of names, the positions as they are."""
        fit = FaultFit(fault, np.zeros(0), np.zeros((0, 0)), 0.0)
        return objective(self.flat, self.places, fit, shift)

    def _finding(self, fit: FaultFit) -> Finding:
        size = max(fit.fault.size, 1)
        owner = {"points": "point", "beams": "channel", "lasers": "laser"}.get(
            fit.fault.owner, fit.fault.owner
        )
        channels = np.array(fit.fault.channels)[None]
        chance = self.chance(np.array([2.0 * fit.drop]), np.array([size]), channels)
        p = min(1.0, float(chance[0]) * self._number(owner))
        return Finding(fit.fault.kind, list(fit.fault.channels), p, fit)

    def _noisy(self, whole: bool = False) -> list[tuple[float, Finding]]:
        """Return channels whose noise is larger than stated, with their log evidence; see ``noisy``."""
        sure = None if self.known else self.noise.sure
        return noisy(self.state, self.rest, self.energy(), self.scale, sure, self.alarm, whole)


def _blamed(state: State, groups: Collection[tuple[int, ...]]) -> dict[tuple[int, ...], float]:
    """Return by how much the residual energy falls when sets of channels are left out."""
    made: dict[tuple[int, ...], float] = {}
    for size in {len(own) for own in groups}:
        same = [own for own in groups if len(own) == size]
        at = np.array(same)
        span, e = state.own_span[at], state.own_e[at]
        norm = np.eye(size) if state.norm is None else state.norm[at[:, :, None], at[:, None, :]]
        values, vectors = np.linalg.eigh(norm - span @ span.swapaxes(1, 2))
        seen = np.sum(np.abs(vectors.swapaxes(1, 2) @ e) ** 2, axis=2)
        fall = np.where(values > 1e-6, seen / np.where(values > 1e-6, values, 1.0), 0.0)
        made |= dict(zip(same, np.sum(fall, axis=1).tolist(), strict=True))
    return made


def _sets(found: Tested) -> list[tuple[int, ...]]:
    return [tuple(own) for own in found.batch.channels.tolist()]
