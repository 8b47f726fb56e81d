"""How far a fault can lower the objective: what cannot come near the best explanation is not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from kinematics.faults.catalogue import Fault
from kinematics.faults.refit import Refit


@dataclass(frozen=True)
class Bounds:
    """Bounds of faults.

    Attributes
    ----------
    refit : Refit
    left_out : dict of tuple of int to float
        By how much the residual energy falls when channels are left out, nuisance parameters as they are.
    """

    refit: Refit
    left_out: dict[tuple[int, ...], float]
    _freed: dict[tuple[int, ...], float] = field(default_factory=dict)

    def ordered(self, faults: Sequence[Fault]) -> list[Fault]:
        """Return faults, those first that may explain most."""
        return sorted(faults, key=lambda fault: -self.left_out[tuple(fault.channels)])

    def reach(self, fault: Fault, needed: float) -> bool:
        """Return whether a fault may lower the objective by so much.

        None lowers it by more than leaving its channels out does: without the squares of their residuals the
        least sum of squares is no larger, whatever the fault makes of them.
        """
        if needed <= 0.0:
            return True
        channels = tuple(fault.channels)
        if len(self.refit.start) and channels not in self._freed:
            self._freed[channels] = self.refit.most(channels)
        return self._freed.get(channels, self.left_out[channels]) >= needed
