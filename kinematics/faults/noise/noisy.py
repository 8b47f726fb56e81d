"""Which channels have more noise than they should."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.fault_model import State
from kinematics.faults.findings import Finding
from kinematics.faults.noise.channel_noise import own_noise
from kinematics.faults.noise.unknown_noise import NOISY

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
# Of the probability of a false alarm, what the tests of noise may use; see _ALARM_SHARE of search.py.
ALARM_SHARE = 0.05
# How many times the stated sd noise must be to be told; less is a matter of chi2.
_NOISY_KNOWN = 1.5
# Ratio of variances by which channels of unknown noise may differ without a fault.
_ALIKE = 1.2**2
# How many of the loudest channels are looked at, and from which ratio of variances on.
_LOUDEST, _QUIET = 5, 1.3
# Leverage above which the residual of a channel says nothing of its noise.
_UNSEEN = 0.98


def noisy(
    state: State,
    rest: ComplexArray,
    energy: Array,
    scale: float,
    sure: float | None,
    alarm: float,
    whole: bool,
) -> list[tuple[float, Finding]]:
    """Return channels whose noise is larger than stated, with their log evidence.

    Parameters
    ----------
    state : State
    rest : ndarray, (channel, sample), complex
        Whitened residuals of the lines without motion.
    energy : ndarray, (channel,)
        Leverage-corrected mean energy at all lines.
    scale : float
        Variance that noise has.
    sure : float or None
        Degrees of freedom that ``scale`` rests on; None when it is known. Then channels may differ by 1.2.
    alarm : float
        Probability of a false alarm.
    whole : bool
        Judge the energy as it is; otherwise without what a fault of the channel's row explains.

    Notes
    -----
    The energy of N complex values is chi-squared with 2 N degrees of freedom, an F where the variance is an
    estimate. The evidence is the likelihood of a larger variance, less Bayes' penalty for its size
    (Schwarz 1978, doi:10.1214/aos/1176344136).
    """
    from scipy.special import chdtrc, fdtrc

    made = []
    live, h = state.data.live, state.h
    limit, margin = (_NOISY_KNOWN, 1.0) if sure is None else (NOISY, _ALIKE)
    lines = state.e.shape[1] + rest.shape[1]
    for channel in sorted(live, key=lambda c: -energy[c])[:_LOUDEST]:
        value, count = float(energy[channel]), lines
        if value < _QUIET * scale or h[channel] > _UNSEEN:
            continue
        if not whole:
            value, count = own_noise(state, rest, channel)
        ratio, left = value / scale, 1.0 - float(h[channel])
        if ratio < _QUIET or ratio - h[channel] < limit**2 * left:
            continue
        twice, size = 2.0 * count, ratio / margin
        chance = chdtrc(twice, twice * size) if sure is None else fdtrc(twice, sure, size)
        p = min(1.0, float(chance) * len(live) / ALARM_SHARE)
        if p > alarm:
            continue
        score = count * (ratio - 1.0 - np.log(ratio)) - np.log(len(live)) - 0.5 * np.log(count)
        louder = float(np.sqrt((ratio - h[channel]) / left))
        made.append((float(score), Finding("noise", [channel], p, None, louder)))
    return made
