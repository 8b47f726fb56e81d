"""Find which channel, point or body does not fit a rigid motion, and what is wrong with it.

The tests are score tests on residuals corrected for leverage, pooled over lines and corrected for their
number. A suspect is fitted as each kind of fault; the kind whose likelihood pays best for its parameters is
the verdict. The suspect is then left out and the search repeated, so that one culprit is not blamed on its
neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinematics.beams import BeamSet
from kinematics.fault_model import LineData
from kinematics.search import Finding, Search, can_lose
from kinematics.structure import Structure

Array = NDArray[np.float64]


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
    first: Search | None = None
    while True:
        search = Search(current, position_sd_m, noise_known)
        first = first or search
        found = search.best()
        if found is None:
            break
        if found.kind in ("flexible", "axes"):
            return _body_fault(first, found if not findings else first.flexible(), search)
        if len(findings) >= most or not can_lose(current, found.channels):
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
        search.data.arms_m - current.arms_m,
    )


def _body_fault(first: Search, found: Finding, search: Search) -> Diagnosis:
    offsets = first.data.arms_m - first.raw.arms_m
    return Diagnosis(
        (found,), first.state.energy(), search.level, search.level_p, first.structure, first.lines, offsets
    )


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
