"""What the search for faults found in one body and run."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.findings import Finding
from legacy.kinematics.faults.flexible_body import Structure
from legacy.stapeskit.arrays import Array


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
    structure : Structure
        Of the residuals that remain.
    lines : ndarray, (channel,)
        Number of complex values behind each energy.
    offsets_m : ndarray, (channel, 3)
        Most probable errors of the positions, of those with a stated sd.
    kept : float
        Share of the misfit beyond noise that the first finding leaves by itself, 0 to 1; 1 without a finding,
        when that concerns all beams, and when the body is not rigid; 0 for two faults that hid each other.
    course : ndarray, (freq,), or None
        Of noise that is not stated, where it has one; see ``noise_course``.
    """

    findings: tuple[Finding, ...]
    energy: Array
    level: float
    structure: Structure
    lines: NDArray[np.int64]
    offsets_m: Array = field(default_factory=lambda: np.zeros((0, 3)))
    kept: float = 1.0
    course: Array | None = None

    @property
    def bends(self) -> bool:
        """Whether the body moves by more than rigid motions and noise, and nothing else explains it."""
        return any(finding.kind == "flexible" for finding in self.findings)

    @property
    def level_matters(self) -> bool:
        """Whether the level is known well enough to differ from 1."""
        return float(np.sum(self.lines)) * (self.level - 1.0) ** 2 > 16.0
