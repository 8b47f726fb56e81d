"""The noise that coherence of few averages states, from neighbouring lines together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kinematics.measurement import BodyChannels
from stapeskit.arrays import Array

_STEADY = 100  # averages whose noise variance is known to 10 %
_WIDER = 1.5  # lines are correlated by windows: those of 150 averages are taken for 100
_UNLIKELY = 1e-4  # probability from which on a line is louder than its neighbours, as at mains


def with_steady_noise(body: BodyChannels) -> BodyChannels:
    """Return a body whose noise from coherence of few averages is pooled over neighbouring lines.

    Notes
    -----
    n averages leave a residual energy of chi2 with 2 (n - 1) degrees of freedom over 2 n at each line (Bendat
    and Piersol 2010, Random Data, 9.2), from which the sd follows: it is low by (n - 1) / n, weights that
    scatter so make motions less certain, and chi2 of a rigid motion larger than its degrees of freedom, which
    looks like bending. The mean logarithm of neighbours, which one loud line hardly moves, is corrected by
    digamma(n - 1) - log n; a line that is louder than they are by more than chance keeps its own noise.
    """
    few = np.unique(body.averages[(body.averages > 1.0) & (body.averages < _STEADY)])
    if body.sd is None or not few.size:
        return body
    sd = np.array(body.sd)
    for averages in few.tolist():
        own = body.averages == averages
        sd[:, own] = _over_lines(sd[:, own], averages)
    return replace(body, sd=sd)


def _over_lines(sd: Array, averages: float) -> Array:
    """Return sd (r, c, L) of so many averages, each from its neighbours."""
    from scipy.ndimage import uniform_filter1d
    from scipy.special import chdtri, digamma

    known = sd > 0.0
    logs = 2.0 * np.log(np.where(known, sd, 1.0))
    width = min(int(np.ceil(_WIDER * _STEADY / averages)), sd.shape[2])
    count = uniform_filter1d(known.astype(float), width, axis=2)
    mean = uniform_filter1d(logs, width, axis=2) / np.maximum(count, 1e-9)
    variance = np.exp(mean - digamma(averages - 1.0) + np.log(averages))
    freedom = 2.0 * (averages - 1.0)
    loud = sd**2 * averages / (averages - 1.0) > variance * chdtri(freedom, _UNLIKELY) / freedom
    return np.where(known & ~loud, np.sqrt(variance), sd)
