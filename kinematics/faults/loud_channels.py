"""Channels with more noise than stated, after the faults that a fit explains."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kinematics.faults.estimated_weights import NOISY
from kinematics.faults.findings import Finding
from kinematics.faults.noise_size import channel_noise_energy

if TYPE_CHECKING:
    from kinematics.faults.search import Search

# Share of the alarm probability that the tests of noise have.
NOISE_SHARE = 0.05
# Leverage above which the residual of a channel shows nothing.
UNSEEN = 0.98
# How many times the stated sd noise must be to be reported; less is a matter of chi2.
_NOISY_KNOWN = 1.5
# Ratio of variances by which channels of unknown noise may differ without a fault.
_ALIKE = 1.2**2
# How many of the loudest channels are looked at, and from which ratio of variances on.
_LOUDEST, _QUIET = 5, 1.3


def loud_channels(search: Search, scale: float = 0.0) -> list[tuple[float, Finding]]:
    """Return loud channels and their log evidence.

    ``scale`` is the noise variance of the evidence, where it is not that of the tests.

    Notes
    -----
    The energy of N complex values is chi-squared with 2 N degrees of freedom, an F where the variance is
    estimated; the evidence is the likelihood less a penalty (Schwarz 1978, doi:10.1214/aos/1176344136).
    """
    from scipy.special import chdtrc, fdtrc

    loud = []
    energy, h = search.energy, 1.0 - search.kept
    limit, margin = (_NOISY_KNOWN, 1.0) if search.known else (NOISY, _ALIKE)
    for channel in sorted(search.live, key=lambda c: -energy[c])[:_LOUDEST]:
        if energy[channel] < _QUIET * search.scale or h[channel] > UNSEEN:
            continue
        value, count = channel_noise_energy(search.state, channel)
        ratio, left = value / search.scale, 1.0 - float(h[channel])
        if ratio < _QUIET or ratio - h[channel] < limit**2 * left:
            continue
        twice, size = 2.0 * count, ratio / margin
        chance = chdtrc(twice, twice * size) if search.known else fdtrc(twice, search.sure, size)
        p = min(1.0, float(chance) * len(search.live) / NOISE_SHARE)
        if p > search.alarm:
            continue
        over = value / (scale or search.scale)
        score = count * (over - 1.0 - np.log(over)) - np.log(len(search.live)) - 0.5 * np.log(count)
        louder = float(np.sqrt((ratio - h[channel]) / left))
        loud.append((float(score), Finding("noise", [channel], p, None, louder)))
    return loud
