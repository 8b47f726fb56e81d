"""The smallest fault that would have been found: what a clean verdict excludes."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from kinematics.faults.kinds import KINDS, SHARE, Place, places
from kinematics.faults.rounds import ALARM, Round
from kinematics.faults.scores import Noise, informations

POWER = 0.9
"""Probability with which a fault of the reported size is found."""


class Detectable(NamedTuple):
    """The smallest fault that is found with a probability of 90 %.

    Its size is in 1, rad, s or m, along the least visible direction of the kind; infinite where one never
    shows.
    """

    place: Place
    kind: str
    size: float


def detectable(now: Round) -> list[Detectable]:
    """Return the smallest fault of every kind at every place that would be found.

    Notes
    -----
    The score test has the non-centrality x^T N x for a fault x with information N (motion and expected errors
    free). It is found where that is as large as the alarm level and the power ask for; the level of noise
    that is not stated counts with its own degrees of freedom.
    """
    owners = [test.place.owner for test in now.tests]
    found = []
    looked_at = places(now.layout, now.live)
    every, _, all_information = informations(now.state, now.expected, looked_at)
    for place, kinds, information in zip(looked_at, every, all_information, strict=True):
        chance = ALARM * SHARE[place.owner] / max(owners.count(place.owner), 1)
        for kind in kinds:
            tangents = list(KINDS[kind].tangents)
            need = noncentrality(len(tangents), chance, now.noise) * now.noise.level
            value = np.linalg.eigvalsh(information[np.ix_(tangents, tangents)])
            seen = value[0] > 1e-9 * max(value[-1], 1e-300)
            found.append(Detectable(place, kind, float(np.sqrt(need / value[0])) if seen else float("inf")))
    return found


@cache
def noncentrality(freedom: int, chance: float, noise: Noise) -> float:
    """Return the non-centrality at which a test of level ``chance`` has the power `POWER`."""
    from scipy.special import chdtri, chndtrinc, fdtri

    level = chdtri(freedom, chance)
    if np.isfinite(noise.freedom):
        level = freedom * fdtri(freedom, noise.freedom, 1.0 - chance)
    return float(chndtrinc(level, freedom, 1.0 - POWER))
