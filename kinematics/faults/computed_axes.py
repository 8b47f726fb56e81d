"""Values along x, y and z that a program computed from three beams: their noise is correlated within a
point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kinematics.faults.search import Diagnosis
from kinematics.measurement import BodyChannels

LEAST_LOG_P = -25.0
"""Logarithm of a probability above which a finding may come from the correlation of the noise: that of three
beams 20 degrees off their axis, each with a noise of its own, made -14 in simulated exports."""


def has_computed_axes(body: BodyChannels) -> bool:
    """Return whether every point was measured along three beams that are normal to each other.

    No three heads see one point so: the values were computed from beams that lie closer together.
    """
    for point in dict.fromkeys(body.points):
        beams = body.directions[body.channels_of(point)]
        if len(beams) != 3 or np.max(np.abs(beams @ beams.T - np.eye(3))) > 1e-3:
            return False
    return True


def without_doubtful(found: Diagnosis) -> Diagnosis:
    """Return a diagnosis without findings that correlated noise may make, where no noise is stated."""
    if any(finding.log_p < LEAST_LOG_P for finding in found.findings):
        return found
    return replace(found, findings=(), last=found.first, causes=())
