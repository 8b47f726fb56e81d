"""How far a fault can lower the objective: what cannot come near the best explanation is not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from kinematics.faults.catalogue import Fault
from kinematics.faults.refit import Refit
from kinematics.faults.score_tests import Tested

# How many times what its score test expects a fault lowers the objective at most: what is linear in its size
# does as expected; this is a margin for large turns, and for motion that a large fault has spoiled.
_NOT_LINEAR = 10.0


@dataclass(frozen=True)
class Bounds:
    """Bounds of faults.

    Attributes
    ----------
    refit : Refit
    tested : sequence of Tested
    left_out : dict of tuple of int to float
        By how much the residual energy falls when channels are left out, nuisance parameters as they are.
    """

    refit: Refit
    tested: Sequence[Tested]
    left_out: dict[tuple[int, ...], float]
    _freed: dict[tuple[int, ...], float] = field(default_factory=dict)

    def ordered(self, faults: Sequence[Fault]) -> list[Fault]:
        """Return faults, those first that may explain most."""
        return sorted(
            faults, key=lambda fault: -min(self.left_out[tuple(fault.channels)], self._scored(fault))
        )

    def reach(self, fault: Fault, needed: float) -> bool:
        """Return whether a fault may lower the objective by so much.

        None lowers it by more than leaving its channels out does, nor, where it was tested, by many times
        what the test expects.
        """
        if needed <= 0.0:
            return True
        if self._scored(fault) < needed:
            return False
        channels = tuple(fault.channels)
        if len(self.refit.start) and channels not in self._freed:
            self._freed[channels] = self.refit.most(channels)
        return self._freed.get(channels, self.left_out[channels]) >= needed

    def _scored(self, fault: Fault) -> float:
        """Return the bound by the score tests; infinite without one."""
        statistics = [
            float(test.statistic[place])
            for test in self.tested
            if (test.kind, test.owner) == (fault.kind, fault.owner)
            and test.groups.shape[1] == len(fault.channels)
            for place in np.flatnonzero(np.all(test.groups == fault.channels, axis=1))
        ]
        return 0.5 * _NOT_LINEAR * max(statistics) if statistics else np.inf
