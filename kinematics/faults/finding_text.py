"""Describe a finding: its verdict, its size, and the entry of the user's file that would be right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kinematics.faults.findings import Finding
from kinematics.measurement import BodyChannels

# Cosine above which directions count as parallel: 2.6 degrees, what a positioned head holds.
_ALONG = 0.999


def describe(finding: Finding, body: BodyChannels) -> tuple[str, str]:
    """Return the verdict of a finding and its estimate in words, with what the data hardly tell from it."""
    verdict, estimate = _described(finding, body)
    others = []
    for rival in finding.rivals if verdict != "flexible" else ():
        name, size = _described(rival, body)
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


def _described(finding: Finding, body: BodyChannels) -> tuple[str, str]:
    """Return verdict and estimate of a finding without its rivals."""
    if finding.text:
        return finding.kind, finding.text
    if finding.kind == "noise":
        return "noise", f"noise {finding.size:.3g} times that of its sd"
    if finding.kind == "flexible" or finding.fit is None:
        if not finding.size > 0.0:
            return "flexible", "non-rigid motion of a size that these data do not determine"
        return "flexible", f"non-rigid motion {100.0 * finding.size:.2g} % of the motion"
    return finding.fit.fault.entry.sentence(finding.fit, body)
