"""What a search finds wrong, and whether two findings say the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kinematics.faults.fault_model import FaultFit
from kinematics.faults.packed.compact import Compact


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Attributes
    ----------
    kind : str
        ``gain``, ``phase``, ``delay``, ``drift``, ``direction``, ``position``, ``label_swap``, ``noise``,
        ``axes``, ``flexible``.
    channels : list of int
    p_value : float
        Corrected for the number of tests.
    fit : FaultFit or None
    size : float
        Of a noise or flexible finding: factor of the noise, share of the motion.
    rivals : tuple of Finding
        Other explanations that the data hardly tell from this one.
    text : str
        The estimate in words, where it is not made from ``fit`` or ``size``.
    code, step : str
        Code of the warning and what to do, of a cause that many channels share; empty otherwise.
    """

    kind: str
    channels: list[int]
    p_value: float
    fit: FaultFit | None = None
    size: float = 0.0
    rivals: tuple[Finding, ...] = ()
    text: str = ""
    code: str = ""
    step: str = ""

    @property
    def owner(self) -> str:
        """What is at fault, as of a Fault."""
        if self.fit is not None:
            return self.fit.fault.owner
        return "body" if self.kind == "flexible" else "channel"


def can_lose(data: Compact, channels: list[int]) -> bool:
    """Tell whether the other channels still determine the motion with some redundancy."""
    basis = data.beams.basis[data.without(channels).live]
    if len(basis) <= basis.shape[1] + 1:
        return False
    values = np.linalg.svd(basis, compute_uv=False)
    return bool(values[-1] > 1e-3 * values[0])


def differ(one: Finding, two: Finding) -> bool:
    """Tell whether two findings are different statements: a phase includes a gain."""
    same = {"phase": "gain", "delay": "gain"}
    return (same.get(one.kind, one.kind), sorted(one.channels)) != (
        same.get(two.kind, two.kind),
        sorted(two.channels),
    )
