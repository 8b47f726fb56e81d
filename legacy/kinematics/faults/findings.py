"""What a search finds wrong: its words, what undoes it, and whether two findings are the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import reduce

import numpy as np

from legacy.kinematics.faults.catalogue import KINDS, OF_MANY, Fault
from legacy.kinematics.faults.packed_readings import Assumed, Packed, Source
from legacy.kinematics.measurement import BodyChannels
from legacy.stapeskit.arrays import Array, ComplexArray

# Steps of the numerical derivatives, in units of the prior size.
STEP = 1e-5
# Cosine above which directions count as parallel: 2.6 degrees, what a positioned head holds.
_ALONG = 0.999


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
    fault : Fault, optional
        Of the catalogue, with its fit:
    parameters, covariance : ndarray, (p,) and (p, p)
    drop : float
        Fall of the objective: residual energy and half the squares of the nuisance parameters over their sd.
    strain : float
        The largest nuisance parameter next to it, over its sd.
    source : Source, optional
        Of the readings.
    size : float
        Of a noise or flexible finding: factor of the noise, share of the motion.
    rivals : tuple of Finding
        Other explanations that the data hardly separate from this one.
    text : str
        The estimate in words, where it is not made from ``parameters`` or ``size``.
    code, step : str
        Code of the warning and what to do, of a cause that many channels share; empty otherwise.
    remedied : BodyChannels, optional
        The body with the readings, and their sd, without a cause that has no size to be estimated.
    """

    kind: str
    channels: list[int]
    p_value: float = 1.0
    fault: Fault | None = None
    size: float = 0.0
    parameters: Array = field(default_factory=lambda: np.zeros(0))
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    drop: float = 0.0
    strain: float = 0.0
    source: Source | None = None
    rivals: tuple[Finding, ...] = ()
    text: str = ""
    code: str = ""
    step: str = ""
    remedied: BodyChannels | None = None

    @property
    def owner(self) -> str:
        """What is at fault, as of a Fault."""
        if self.fault is not None:
            return self.fault.owner
        return "body" if self.kind == "flexible" else "channel"

    @property
    def places(self) -> int:
        """At how many places the fault could be."""
        return 1 if self.fault is None else max(self.fault.places, 1)

    def undone(self, assumed: Assumed) -> Assumed:
        """Return assumptions that hold this finding: its channels weakened, or corrected by its estimate."""
        if self.kind == "noise":
            return assumed.louder(self.channels, self.size)
        return assumed if self.fault is None else self.fault.undone(assumed, self.parameters)

    def factor_at(self, freq_hz: Array) -> ComplexArray:
        """Return the factor of the readings, and its relative derivatives, (p + 1, freq).

        Without rows for faults of the geometry.
        """
        factor = None if self.fault is None else self.fault.entry.factor
        if self.fault is None or factor is None or self.source is None:
            return np.zeros((0, len(freq_hz)), dtype=complex)
        place = np.interp(np.arange(len(freq_hz)), self.source.lines, self.source.tau)
        ratio = freq_hz / self.source.middle_hz
        value = np.broadcast_to(factor(self.parameters, place, ratio), freq_hz.shape)
        factors = [value]
        for step in np.diag(STEP * self.fault.scale(1.0)):
            more = factor(self.parameters + step, place, ratio)
            factors.append((more - value) / np.sum(step) / value)
        return np.stack(factors)


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
    corrected = finding.fault is None or finding.owner in OF_MANY or not is_redundant(data, finding.channels)
    assumed = finding.undone(data.assumed) if corrected else data.assumed.without(finding.channels)
    return data if assumed is data.assumed else data.under(assumed)


def correct_findings(data: Packed, findings: Sequence[Finding]) -> Packed:
    """Return the data with every finding undone by its estimate, all channels kept."""
    return data.under(reduce(lambda assumed, finding: finding.undone(assumed), findings, data.assumed))


def differ(one: Finding, two: Finding) -> bool:
    """Return whether two findings are different statements: a phase includes a gain."""
    return (_statement(one.kind), sorted(one.channels)) != (_statement(two.kind), sorted(two.channels))


def _statement(kind: str) -> str:
    return (KINDS[kind].like if kind in KINDS else "") or kind


def describe(finding: Finding, body: BodyChannels) -> tuple[str, str]:
    """Return the verdict of a finding and its estimate in words, with what the data hardly tell from it."""
    verdict, estimate = _describe(finding, body)
    others = []
    for rival in finding.rivals if verdict != "flexible" else ():
        name, size = _describe(rival, body)
        where = (
            ""
            if sorted(rival.channels) == sorted(finding.channels)
            else f" of {channel_list(rival.channels, body)}"
        )
        others.append(f"{name}{where} ({size})")
    if verdict in ("position", "drift") and len(finding.channels) == 1 and _parallel(body):
        others.append("a beam off its direction, which reads motion that parallel beams do not see")
    return verdict, "; not told apart from ".join([estimate, " or ".join(others)]) if others else estimate


def channel_list(channels: Sequence[int], body: BodyChannels) -> str:
    """Name channels: one by its point and beam, several by their points."""
    if len(channels) == 1:
        return f"channel {body.channel_name(channels[0])}"
    points = list(dict.fromkeys(body.points[c] for c in channels))
    return f"point{'s' if len(points) > 1 else ''} {' and '.join(points)} of body {body.body}"


def _parallel(body: BodyChannels) -> bool:
    """Return whether all beams of a body are parallel."""
    return bool(np.all(np.abs(body.directions @ body.directions[0]) > _ALONG))


def _describe(finding: Finding, body: BodyChannels) -> tuple[str, str]:
    """Return verdict and estimate of a finding without its rivals."""
    if finding.text:
        return finding.kind, finding.text
    if finding.kind == "noise":
        return "noise", f"noise {finding.size:.3g} times that of its sd"
    if finding.kind == "flexible" or finding.fault is None:
        if not finding.size > 0.0:
            return "flexible", "non-rigid motion of a size that these data do not determine"
        return "flexible", f"non-rigid motion {100.0 * finding.size:.2g} % of the motion"
    return finding.fault.entry.sentence(finding, body)
