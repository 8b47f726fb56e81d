"""Find which channel, point or body does not fit a rigid motion, and what is wrong with it.

The tests are score tests on residuals corrected for leverage, pooled over lines and corrected for their
number. A suspect is fitted as each kind of fault; the kind whose likelihood pays best for its parameters is
the verdict. The suspect is then left out and the search repeated, so that one culprit is not blamed on its
neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinematics.beams import BeamSet
from kinematics.fault_model import (
    Fault,
    FaultFit,
    LineData,
    axes_fault,
    direction_fault,
    drift_fault,
    fit_fault,
    gain_fault,
    position_fault,
    score_statistic,
    solve,
    swap_fault,
)
from kinematics.position_prior import settled
from kinematics.structure import Structure, structure_of

Array = NDArray[np.float64]
FALSE_ALARM = 0.005
_NOISY = 1.5


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong: the fitted fault, its kind, and its significance after correction."""

    kind: str
    channels: list[int]
    p_value: float
    fit: FaultFit | None = None
    size: float = 0.0


@dataclass(frozen=True)
class Diagnosis:
    """What was found in one body and run.

    Attributes
    ----------
    findings : tuple of Finding
        One per culprit; empty when the body moves rigidly within its noise.
    energy : ndarray, (channel,)
        Leverage-corrected mean residual energy of each channel in units of its stated noise, with the
        culprits left out for the other channels.
    level : float
        Median of the energies that remain: 1 when the stated noise is right.
    level_p : float
        Probability of so large a total residual of the remaining channels under the stated noise.
    structure : Structure
        Of the residuals that remain.
    offsets_m : ndarray, (channel, 3)
        Position errors, within their stated sd, that were allowed for.
    lines : ndarray, (channel,)
        Number of lines used of each channel.
    """

    findings: tuple[Finding, ...]
    energy: Array
    level: float
    level_p: float
    structure: Structure
    lines: NDArray[np.int64]
    offsets_m: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def level_matters(self) -> bool:
        """Whether the level is known well enough to differ from 1."""
        return float(np.sum(self.lines)) * (self.level - 1.0) ** 2 > 16.0


def diagnose(data: LineData, position_sd_m: Array, noise_known: bool = True) -> Diagnosis:
    """Search one body in one run for faults.

    Parameters
    ----------
    data : LineData
    position_sd_m : ndarray, (channel,)
        Stated standard deviation of the point positions, m; NaN or zero when not stated.
    noise_known : bool
        The sd are absolute; otherwise only their ratios mean something.
    """
    points = list(dict.fromkeys(data.points))
    most = max(1, len(points) // 4)
    findings: list[Finding] = []
    current = data
    first: _Search | None = None
    while True:
        search = _Search(current, position_sd_m, noise_known)
        first = first or search
        found = search.best()
        if found is None:
            break
        if found.kind in ("flexible", "axes"):
            return _body_fault(first, found if not findings else first.flexible(), search)
        if len(findings) >= most or not _can_lose(current, found.channels):
            return _body_fault(first, first.flexible(), search)
        findings.append(found)
        current = current.without(found.channels)
    energy = first.state.energy()
    last = search.state.energy()
    kept = np.any(current.s > 0.0, axis=1)
    energy[kept] = last[kept]
    return Diagnosis(
        tuple(findings),
        energy,
        search.level,
        search.level_p,
        search.structure,
        first.lines,
        search.data.arms_m - data.arms_m,
    )


def _body_fault(first: _Search, found: Finding, search: _Search) -> Diagnosis:
    offsets = first.data.arms_m - first.raw.arms_m
    return Diagnosis(
        (found,), first.state.energy(), search.level, search.level_p, first.structure, first.lines, offsets
    )


def _can_lose(data: LineData, channels: list[int]) -> bool:
    """Tell whether the other channels still determine the motion with some redundancy."""
    left = np.any(data.without(channels).s > 0.0, axis=1)
    basis = data.beams.basis[left]
    if len(basis) <= basis.shape[1] + 1:
        return False
    values = np.linalg.svd(basis, compute_uv=False)
    return bool(values[-1] > 1e-3 * values[0])


class _Search:
    """One round: the fit with the channels that are left, all tests on it, and the best suspect."""

    def __init__(self, data: LineData, position_sd_m: Array, noise_known: bool) -> None:
        self.raw = data
        self.prior = np.where(np.isfinite(position_sd_m), position_sd_m, 0.0)
        self.noise_known = noise_known
        self.data, self.penalty = settled(data, self.prior)
        self.state = solve(self.data)
        self.live = [c for c in range(len(data.points)) if np.any(data.s[c] > 0.0)]
        self.lines = np.sum(data.s > 0.0, axis=1)
        self.by_point = {
            name: [c for c in self.live if data.points[c] == name] for name in dict.fromkeys(data.points)
        }
        self.by_point = {name: channels for name, channels in self.by_point.items() if channels}
        self.structure = structure_of(self.data, self.state)
        self.energies = self.state.energy()
        self.level, self.level_p = self._level()
        self.count = int(np.sum(self.lines))

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
        alarms = [p for p, _ in tests]
        limit = FALSE_ALARM / max(len(tests), 1)
        if (not alarms or min(alarms) > limit) and not self.structure.significant:
            return None
        reference = self._reference_level()
        ranked = self._suspects(tests)
        scored = [(self._score(fit, reference), self._finding(fit, reference, len(tests))) for fit in ranked]
        scored += self._noisy(reference, len(tests))
        scored = [(score, finding) for score, finding in scored if finding.p_value < FALSE_ALARM]
        if self.structure.significant and not self.structure.concentrated:
            scored.append((self.structure.gain / reference, self.flexible()))
        if not scored:
            return None
        return max(scored, key=lambda entry: entry[0])[1]

    def flexible(self) -> Finding:
        """Return the finding that the body is not rigid."""
        return Finding("flexible", list(self.live), self.structure.p_value, None, self._flexible_share())

    def _flexible_share(self) -> float:
        """Return the residual motion beyond noise relative to the motion, rms."""
        moved = np.abs(self.data.beams.basis @ self.state.z.T) * self.data.s
        excess = max(float(np.sum(np.abs(self.state.e) ** 2)) - self.count + self.state.z.size, 0.0)
        return float(np.sqrt(excess / max(float(np.sum(moved**2)), 1e-300)))

    def _tests(self) -> list[tuple[float, Fault | int]]:
        """Return (p-value, what) of every test: faults by score, channels by energy."""
        from scipy.special import chdtrc

        scale = max(1.0, self.level)
        made: list[tuple[float, Fault | int]] = []
        for fault in self._faults():
            value = score_statistic(self.data, self.state, fault) / scale
            made.append((float(chdtrc(fault.size, value)), fault))
        for channel in self.live:
            number = 2.0 * self.lines[channel]
            excess = self.energies[channel] / scale / self._noise_margin() ** 2
            made.append((float(chdtrc(number, number * excess)), channel))
        return made

    def _noise_margin(self) -> float:
        return 1.0 if self.noise_known else 1.2

    def _faults(self) -> list[Fault]:
        free = [c for c in self.live if np.median(self.state.h[c]) < 0.98]
        faults = [gain_fault(self.data, [c]) for c in free]
        faults += [drift_fault(self.data, [c]) for c in free]
        faults += [direction_fault(self.data, c) for c in free]
        for channels in self.by_point.values():
            if len(self.live) - len(channels) < self.state.z.shape[1]:
                continue
            faults.append(position_fault(self.data, channels))
            if len(channels) > 1:
                faults += [gain_fault(self.data, channels), drift_fault(self.data, channels)]
        return [*faults, axes_fault(self.data)] if len(self.live) == len(self.data.points) else faults

    def _reference_level(self) -> float:
        """Return the residual level without the worst point: what the noise is when one point is at fault."""
        worst = max(self.by_point.values(), key=lambda cs: max(self.energies[cs]))
        rest = self.data.without(worst)
        if not _can_lose(self.data, worst):
            return max(1.0, self.level)
        energies = solve(rest).energy()
        left = [c for c in self.live if c not in worst]
        return max(1.0, float(np.median(energies[left])))

    def _suspects(self, tests: list[tuple[float, Fault | int]]) -> list[FaultFit]:
        """Fit the most significant faults of every kind, each with the positions settled without it."""
        chosen: list[Fault] = []
        quota = {("gain", 1): 4, ("drift", 1): 3, ("direction", 1): 4, ("position", 3): 3, ("axes", 3): 1}
        used: dict[tuple[str, int], int] = {}
        ranked = sorted((entry for entry in tests if isinstance(entry[1], Fault)), key=lambda entry: entry[0])
        for _, fault in self._by_energy(ranked):
            key = (fault.kind, 1 if len(fault.channels) == 1 else 3)
            if used.get(key, 0) < quota.get(key, 3):
                used[key] = used.get(key, 0) + 1
                chosen.append(fault)
        chosen += self._swaps()
        return [self._fitted(fault) for fault in chosen]

    def _by_energy(self, ranked: list[tuple[float, Fault]]) -> list[tuple[float, Fault]]:
        """Put faults of equal (vanishing) p-value in the order of their channels' energies."""
        return sorted(
            ranked,
            key=lambda entry: (
                entry[0] if entry[0] > 1e-250 else 0.0,
                -max(self.energies[entry[1].channels]),
            ),
        )

    def _swaps(self) -> list[Fault]:
        order = sorted(self.by_point, key=lambda name: -float(np.sum(self.energies[self.by_point[name]])))
        faults = []
        for one, two in combinations(order[:4], 2):
            faults.append(swap_fault(self.data, self.by_point[one], self.by_point[two], "points"))
        for name in order[:3]:
            for one, two in combinations(self.by_point[name], 2):
                faults.append(swap_fault(self.data, [one], [two], "beams"))
        return faults

    def _fitted(self, fault: Fault) -> FaultFit:
        if not np.any(self.prior > 0.0):
            return fit_fault(self.data, self.state, fault)
        before = float(np.sum(np.abs(self.state.e) ** 2)) + self.penalty
        apart = len(fault.channels) < len(self.live)
        base, penalty = (
            settled(self.raw.without(fault.channels), self.prior) if apart else (self.data, self.penalty)
        )
        arms = base.arms_m.copy()
        if fault.kind in ("position", "label_swap"):
            arms[fault.channels] = self.raw.arms_m[fault.channels]
        data = replace(self.raw, arms_m=arms, beams=base.beams)
        again = self._rebuilt(fault, data)
        state = solve(data)
        fit = fit_fault(data, state, again)
        after = float(np.sum(np.abs(state.e) ** 2)) - fit.drop + penalty
        return replace(fit, drop=before - after)

    def _rebuilt(self, fault: Fault, data: LineData) -> Fault:
        """Return the same fault on data with other positions."""
        if fault.kind == "gain":
            return gain_fault(data, fault.channels)
        if fault.kind == "drift":
            return drift_fault(data, fault.channels)
        if fault.kind == "direction":
            return direction_fault(data, fault.channels[0])
        if fault.kind == "position":
            return position_fault(data, fault.channels)
        if fault.kind == "axes":
            return axes_fault(data)
        half = len({data.points[c] for c in fault.channels})
        if half == 1:
            return swap_fault(data, fault.channels[:1], fault.channels[1:], "beams")
        one = [c for c in fault.channels if data.points[c] == data.points[fault.channels[0]]]
        two = [c for c in fault.channels if c not in one]
        return swap_fault(data, one, two, "points")

    def _score(self, fit: FaultFit, reference: float) -> float:
        return fit.drop / reference - 0.5 * fit.fault.size * float(np.log(2.0 * self.count))

    def _finding(self, fit: FaultFit, reference: float, tests: int) -> Finding:
        from scipy.special import chdtrc

        value = 2.0 * max(fit.drop, 0.0) / reference
        p = min(1.0, float(chdtrc(max(fit.fault.size, 1), value)) * tests)
        return Finding(fit.fault.kind, list(fit.fault.channels), p, fit)

    def _noisy(self, reference: float, tests: int) -> list[tuple[float, Finding]]:
        """Return the three channels of largest energy as noisy ones, with their likelihood."""
        from scipy.special import chdtrc

        made = []
        limit = _NOISY if self.noise_known else 2.0
        for channel in sorted(self.live, key=lambda c: -self.energies[c])[:3]:
            ratio = self.energies[channel] / reference
            if ratio < limit**2:
                continue
            number = float(self.lines[channel])
            p = min(1.0, float(chdtrc(2.0 * number, 2.0 * number * ratio)) * tests)
            score = number * (ratio - 1.0 - float(np.log(ratio))) - 0.5 * float(np.log(2.0 * self.count))
            made.append((score, Finding("noise", [channel], p, None, float(np.sqrt(ratio)))))
        return made


def nothing_found(data: LineData) -> Diagnosis:
    """Return the diagnosis of data that are too few to search."""
    count = len(data.points)
    return Diagnosis(
        (),
        np.ones(count),
        1.0,
        1.0,
        Structure(0.0, 1.0, True, 0.0, np.zeros(count)),
        np.sum(data.s > 0.0, axis=1),
        np.zeros((count, 3)),
    )


def line_data(
    beams: BeamSet, arms_m: Array, directions: Array, points: tuple[str, ...], y: Array, sd: Array
) -> LineData:
    """Prepare the lines for the diagnosis: thinned evenly when there are very many."""
    lines = y.shape[1]
    most = int(np.clip(3_000_000 // max(len(points) ** 2, 1), 48, 1500))
    pick = np.unique(np.linspace(0, lines - 1, min(lines, most)).round().astype(int))
    used = np.isfinite(y[:, pick].real) & np.isfinite(sd[:, pick])
    s = np.where(used, 1.0 / (np.sqrt(2.0) * np.where(used, sd[:, pick], 1.0)), 0.0)
    enough = np.sum(used, axis=0) > beams.basis.shape[1]
    s[:, ~enough] = 0.0
    tau = np.linspace(-1.0, 1.0, lines)[pick] if lines > 1 else np.zeros(1)
    keep = enough
    return LineData(
        beams,
        arms_m,
        directions,
        points,
        np.where(used, y[:, pick], 0.0)[:, keep],
        s[:, keep],
        tau[keep],
    )
