"""One round of the search for faults: all tests on the channels that are left, and the best suspect."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinematics.fault_kinds import (
    axes_fault,
    corrected,
    direction_fault,
    drift_fault,
    gain_fault,
    position_fault,
    rebuilt,
    swap_fault,
)
from kinematics.fault_model import Fault, FaultFit, LineData, fit_fault, score_statistic, solve
from kinematics.position_prior import Settled, settled
from kinematics.structure import structure_of

Array = NDArray[np.float64]
FALSE_ALARM = 0.005
_NOISY_KNOWN, _NOISY_UNKNOWN = 1.5, 2.0
_QUOTA = {("gain", 1): 4, ("drift", 1): 3, ("direction", 1): 4, ("position", 3): 3, ("axes", 3): 1}
_FREE_M = 1.0


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Attributes
    ----------
    kind : str
        ``gain``, ``drift``, ``direction``, ``position``, ``label_swap``, ``noise``, ``axes``, ``flexible``.
    channels : list of int
    p_value : float
        Corrected for the number of tests.
    fit : FaultFit or None
    size : float
        Of a noise or flexible finding: factor of the noise, share of the motion.
    """

    kind: str
    channels: list[int]
    p_value: float
    fit: FaultFit | None = None
    size: float = 0.0


def can_lose(data: LineData, channels: list[int]) -> bool:
    """Tell whether the other channels still determine the motion with some redundancy."""
    left = np.any(data.without(channels).s > 0.0, axis=1)
    basis = data.beams.basis[left]
    if len(basis) <= basis.shape[1] + 1:
        return False
    values = np.linalg.svd(basis, compute_uv=False)
    return bool(values[-1] > 1e-3 * values[0])


class Search:
    """The fit with the channels that are left, and everything that is tested on it.

    Attributes
    ----------
    raw, data : LineData
        As given, and with the points moved within their stated position errors.
    """

    def __init__(self, data: LineData, position_sd_m: Array, noise_known: bool) -> None:
        self.raw = data
        self.prior = np.where(np.isfinite(position_sd_m), position_sd_m, 0.0)
        self.noise_known = noise_known
        self.settled = settled(data, self.prior)
        self.data = self.settled.data
        self.state = solve(self.data)
        self.live = [c for c in range(len(data.points)) if np.any(data.s[c] > 0.0)]
        self.lines = np.sum(data.s > 0.0, axis=1)
        groups = {
            name: [c for c in self.live if data.points[c] == name] for name in dict.fromkeys(data.points)
        }
        self.by_point = {name: channels for name, channels in groups.items() if channels}
        self.structure = structure_of(self.data, self.state)
        self.energies = self.state.energy()
        self.blame = self.energies
        self.count = int(np.sum(self.lines))
        self.level, self.level_p = self._level()

    def _level(self) -> tuple[float, float]:
        from scipy.special import chdtrc

        energies = self.energies[self.live]
        level = float(np.median(energies)) if len(energies) else 1.0
        residual = 2.0 * float(np.sum(np.abs(self.state.e) ** 2))
        freedom = 2.0 * (float(np.sum(self.lines)) - self.state.z.size)
        return level, float(chdtrc(max(freedom, 1.0), residual)) if freedom > 0.0 else 1.0

    def best(self) -> Finding | None:
        """Return the suspect that explains most, or None when nothing is significant."""
        if len(self.live) <= self.state.z.shape[1]:
            return None
        tests = self._tests()
        if not any(p < FALSE_ALARM / len(tests) for p, _ in tests) and not self.structure.significant:
            return None
        if np.any(self.prior > 0.0):
            self.blame = self._blame()
        reference = self._reference_level()
        scored = []
        for fit in self._suspects(tests):
            scored.append((self._score(fit, reference), self._finding(fit, reference, len(tests))))
        scored += self._noisy(reference, len(tests))
        scored = [(score, finding) for score, finding in scored if finding.p_value < FALSE_ALARM]
        if self.structure.significant and not self.structure.concentrated:
            scored.append((self.structure.gain / reference, self.flexible()))
        if not scored:
            return None
        return max(scored, key=lambda entry: entry[0])[1]

    def flexible(self) -> Finding:
        """Return the finding that the body is not rigid, with its share of the motion (rms)."""
        moved = np.abs(self.data.beams.basis @ self.state.z.T) * self.data.s
        excess = max(float(np.sum(np.abs(self.state.e) ** 2)) - self.count + self.state.z.size, 0.0)
        share = float(np.sqrt(excess / max(float(np.sum(moved**2)), 1e-300)))
        return Finding("flexible", list(self.live), self.structure.p_value, None, share)

    def _tests(self) -> list[tuple[float, Fault | None]]:
        """Return (p-value, fault) of every test; None stands for the energy of a channel."""
        from scipy.special import chdtrc

        scale = max(1.0, self.level)
        made: list[tuple[float, Fault | None]] = []
        for fault in self._faults():
            own = self.data.points[fault.channels[0]]
            if fault.kind == "position" and own in self.settled.evidence:
                value = self.settled.evidence[own]
            else:
                value = score_statistic(self.data, self.state, fault) / scale
            made.append((float(chdtrc(fault.size, value)), fault))
        margin = 1.0 if self.noise_known else 1.2**2
        for channel in self.live:
            number = 2.0 * self.lines[channel]
            excess = self.energies[channel] / scale / margin
            made.append((float(chdtrc(number, number * excess)), None))
        return made

    def _faults(self) -> list[Fault]:
        """Return every fault of one channel, one point or all beams that the others can judge."""
        free = [c for c in self.live if np.median(self.state.h[c]) < 0.98]
        faults = [make(self.data, [c]) for make in (gain_fault, drift_fault) for c in free]
        faults += [direction_fault(self.data, c) for c in free]
        for channels in self.by_point.values():
            if len(self.live) - len(channels) < self.state.z.shape[1]:
                continue
            faults.append(position_fault(self.data, channels))
            if len(channels) > 1:
                faults += [gain_fault(self.data, channels), drift_fault(self.data, channels)]
        return [*faults, axes_fault(self.data)] if len(self.live) == len(self.data.points) else faults

    def _blame(self) -> Array:
        """Return, per channel, how much the objective falls without it, positions settled anew each time."""
        before = self.settled.objective()
        drops = {
            name: before - settled(self.raw.without(channels), self.prior).objective()
            for name, channels in self.by_point.items()
        }
        blame = np.zeros(len(self.data.points))
        for name in sorted(drops, key=lambda key: -drops[key])[:4]:
            for channel in self.by_point[name]:
                alone = before - settled(self.raw.without([channel]), self.prior).objective()
                blame[channel] = max(alone, 1e-3 * drops[name]) / max(int(self.lines[channel]), 1)
        return blame

    def _reference_level(self) -> float:
        """Return the residual level without the worst point: what the noise is when one point is at fault."""
        worst = max(self.by_point.values(), key=lambda cs: max(self.blame[cs]))
        if not can_lose(self.data, worst):
            return max(1.0, self.level)
        energies = solve(settled(self.raw.without(worst), self.prior).data).energy()
        left = [c for c in self.live if c not in worst]
        return max(1.0, float(np.median(energies[left])))

    def _suspects(self, tests: list[tuple[float, Fault | None]]) -> list[FaultFit]:
        """Fit the most significant faults of every kind and, with uncertain positions, the most blamed."""
        faults = [(p, fault) for p, fault in tests if fault is not None]
        orders = [sorted(faults, key=lambda entry: (max(entry[0], 1e-250), -self._blamed(entry[1])))]
        if np.any(self.prior > 0.0):
            orders.append(sorted(faults, key=lambda entry: -self._blamed(entry[1])))
        chosen: dict[int, Fault] = {}
        for order in orders:
            used: dict[tuple[str, int], int] = {}
            for _, fault in order:
                key = (fault.kind, 1 if len(fault.channels) == 1 else 3)
                if used.get(key, 0) < _QUOTA.get(key, 3):
                    used[key] = used.get(key, 0) + 1
                    chosen[id(fault)] = fault
        return [self._fitted(fault) for fault in [*chosen.values(), *self._swaps()]]

    def _blamed(self, fault: Fault) -> float:
        return float(np.max(self.blame[fault.channels]))

    def _swaps(self) -> list[Fault]:
        order = sorted(self.by_point, key=lambda name: -float(np.sum(self.blame[self.by_point[name]])))
        faults = []
        for one, two in combinations(order[:4], 2):
            faults.append(swap_fault(self.data, self.by_point[one], self.by_point[two], "points"))
        for name in order[:3]:
            for first, second in combinations(self.by_point[name], 2):
                faults.append(swap_fault(self.data, [first], [second], "beams"))
        return faults

    def _fitted(self, fault: Fault) -> FaultFit:
        """Fit a fault, jointly with the positions where these are uncertain."""
        if not np.any(self.prior > 0.0):
            return fit_fault(self.data, self.state, fault)
        before = self.settled.objective()
        if fault.kind == "position":
            return self._free_position(fault, before)
        found = (
            settled(self.raw.without(fault.channels), self.prior) if fault.kind != "axes" else self.settled
        )
        arms = found.data.arms_m
        for _ in range(2):
            moved = self.raw.moved(arms_m=arms)
            if fault.kind == "label_swap":
                fit = FaultFit(fault, np.zeros(0), np.zeros((0, 0)), 0.0)
            else:
                fit = fit_fault(moved, solve(moved), rebuilt(moved, fault))
            found = settled(corrected(self.raw, fit), self.prior)
            arms = found.data.arms_m
            if fault.kind == "label_swap":
                break
        return replace(fit, drop=before - found.objective())

    def _free_position(self, fault: Fault, before: float) -> FaultFit:
        prior = self.prior.copy()
        prior[fault.channels] = _FREE_M
        found: Settled = settled(self.raw, prior)
        name = self.data.points[fault.channels[0]]
        return FaultFit(fault, found.shifts_m[name], found.covariances[name], before - found.objective())

    def _score(self, fit: FaultFit, reference: float) -> float:
        """Return the likelihood less its price: a gain without phase counts as one parameter."""
        size = fit.fault.size
        if fit.fault.kind == "gain" and abs(fit.parameters[1]) < 3.0 * float(np.sqrt(fit.covariance[1, 1])):
            size = 1
        return fit.drop / reference - 0.5 * size * float(np.log(2.0 * self.count))

    def _finding(self, fit: FaultFit, reference: float, tests: int) -> Finding:
        from scipy.special import chdtrc

        value = 2.0 * max(fit.drop, 0.0) / reference
        p = min(1.0, float(chdtrc(max(fit.fault.size, 1), value)) * tests)
        return Finding(fit.fault.kind, list(fit.fault.channels), p, fit)

    def _noisy(self, reference: float, tests: int) -> list[tuple[float, Finding]]:
        """Return the three worst channels as noisy ones, with their likelihood."""
        from scipy.special import chdtrc

        made = []
        limit = _NOISY_KNOWN if self.noise_known else _NOISY_UNKNOWN
        for channel in sorted(self.live, key=lambda c: -self.blame[c])[:3]:
            ratio = max(self.blame[channel], self.energies[channel]) / reference
            if ratio < limit**2:
                continue
            number = float(self.lines[channel])
            p = min(1.0, float(chdtrc(2.0 * number, 2.0 * number * ratio)) * tests)
            score = number * (ratio - 1.0 - float(np.log(ratio))) - 0.5 * float(np.log(2.0 * self.count))
            made.append((score, Finding("noise", [channel], p, None, float(np.sqrt(ratio)))))
        return made
