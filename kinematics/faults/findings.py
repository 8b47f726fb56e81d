"""What a search finds wrong, and whether two findings are the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kinematics.faults.catalogue import KINDS, OF_MANY
from kinematics.faults.packed_readings import Packed
from kinematics.faults.refit import FaultFit
from stapeskit.arrays import ComplexArray


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Attributes
    ----------
    kind : str
        Of the catalogue, or ``noise``, ``flexible``, or the verdict of a cause that many channels share.
    channels : list of int
    p_value : float
        Corrected for the number of tests.
    fit : FaultFit or None
    size : float
        Of a noise or flexible finding: factor of the noise, share of the motion.
    rivals : tuple of Finding
        Other explanations that the data hardly separate from this one.
    text : str
        The estimate in words, where it is not made from ``fit`` or ``size``.
    code, step : str
        Code of the warning and what to do, of a cause that many channels share; empty otherwise.
    remedied : ndarray, (channel, freq), complex, optional
        The readings without a cause that has no size to be estimated.
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
    remedied: ComplexArray | None = None

    @property
    def owner(self) -> str:
        """What is at fault, as of a Fault."""
        if self.fit is not None:
            return self.fit.fault.owner
        return "body" if self.kind == "flexible" else "channel"


def is_redundant(data: Packed, channels: list[int]) -> bool:
    """Return whether the other channels still determine the motion with some redundancy."""
    rest = [c for c in data.live if c not in set(channels)]
    basis = data.rows(data.assumed.arms_m, data.assumed.directions)[rest]
    if len(basis) <= basis.shape[1] + 1:
        return False
    values = np.linalg.svd(basis, compute_uv=False)
    return bool(values[-1] > 1e-3 * values[0])


def apply_finding(data: Packed, finding: Finding) -> Packed:
    """Return the data without a finding: its channels left out, weakened, or corrected."""
    if finding.kind == "noise":
        return data.under(data.assumed.louder(finding.channels, finding.size))
    if finding.fit is None:
        return data
    if finding.owner in OF_MANY or not is_redundant(data, finding.channels):
        return data.under(finding.fit.fault.undone(data.assumed, finding.fit.parameters))
    return data.under(data.assumed.without(finding.channels))


def correct_findings(data: Packed, findings: list[Finding]) -> Packed:
    """Return the data with every finding undone by its estimate, all channels kept."""
    assumed = data.assumed
    for finding in findings:
        if finding.kind == "noise":
            assumed = assumed.louder(finding.channels, finding.size)
        elif finding.fit is not None:
            assumed = finding.fit.fault.undone(assumed, finding.fit.parameters)
    return data.under(assumed)


def differ(one: Finding, two: Finding) -> bool:
    """Return whether two findings are different statements: a phase includes a gain."""
    return (_statement(one.kind), sorted(one.channels)) != (_statement(two.kind), sorted(two.channels))


def _statement(kind: str) -> str:
    return (KINDS[kind].like if kind in KINDS else "") or kind
