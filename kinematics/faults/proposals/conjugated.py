"""The beams of one laser that hold the conjugates of what they should read."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kinematics.faults.proposals.misfitting_body import Cause, MisfittingBody, Remedy
from kinematics.fit.laser_groups import laser_channels
from kinematics.fit.rigid_fit import fit_noise

# Share of the misfit that must go.
_MOST = 0.5


def conjugated(suspect: MisfittingBody) -> Iterator[Cause]:
    """Yield the laser whose conjugate fits the others best.

    Notes
    -----
    The file holds the conjugate: of velocities, i w times displacements, that turns the sign of
    the displacements too.
    """
    value, fit = suspect.value, suspect.plain
    sign = (-1.0) ** suspect.placed.order
    groups = laser_channels(suspect.body.directions, list(range(len(value))))
    if not 1 < len(groups) <= 8:
        return
    tried = []
    for own in groups:
        turned = value.copy()
        turned[own] = sign * turned[own].conj()
        tried.append((float(np.nansum(fit_noise(fit.beams, turned, fit.noise).chi2)), own, turned))
    misfit, own, turned = min(tried, key=lambda entry: (entry[0], len(entry[1])))
    if misfit > _MOST * float(np.nansum(fit.chi2)):
        return
    name = suspect.body.channel_name(own[0]).split(" ", 1)[1]
    yield Remedy(own, suspect.with_value(turned), 1.0), {"number": len(own), "beam": name}
