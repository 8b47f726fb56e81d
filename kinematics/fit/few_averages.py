"""The noise that coherence of few averages states, from neighbouring lines together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kinematics.measurement import BodyChannels
from kinematics.signals.frf import STEADY_AVERAGES, lines_to_pool
from stapeskit.arrays import Array

_UNLIKELY = 1e-4  # probability from which on a line is louder than its neighbours, as at mains


def with_steady_noise(body: BodyChannels) -> BodyChannels:
    """Return a body whose noise from coherence of few averages is pooled over neighbouring lines.

    Notes
    -----
    n averages leave a residual energy of chi2 with 2 (n - 1) degrees of freedom over 2 n at each line (Bendat
    and Piersol 2010, Random Data, 9.2), from which the sd follows: it is low by (n - 1) / n, weights that
    scatter so make motions less certain, and chi2 of a rigid motion larger than its degrees of freedom, which
    looks like bending. The mean logarithm of neighbours, which one loud line hardly moves, is corrected by
    digamma(n - 1) - log n. Where noise follows the amplitude, as far as a straight line through both
    logarithms tells, that of neighbours does so too: a resonance is louder than they are. A line that is
    louder still, by more than chance, keeps its own noise.
    """
    few = np.unique(body.averages[(body.averages > 1.0) & (body.averages < STEADY_AVERAGES)])
    if body.sd is None or not few.size:
        return body
    sd = np.array(body.sd)
    for averages in few.tolist():
        own = body.averages == averages
        sd[:, own] = _over_lines(sd[:, own], np.abs(body.value[:, own]), averages)
    return replace(body, sd=sd)


def _over_lines(sd: Array, amplitude: Array, averages: float) -> Array:
    """Return sd (r, c, L) of so many averages, each from its neighbours."""
    from scipy.ndimage import uniform_filter1d
    from scipy.special import chdtri, digamma

    known = (sd > 0.0) & (amplitude > 0.0)
    width = min(lines_to_pool(averages), sd.shape[2])
    count = np.maximum(uniform_filter1d(known.astype(float), width, axis=2), 1e-9)

    def around(size: Array) -> tuple[Array, Array]:
        logs = 2.0 * np.log(np.where(known, size, 1.0))
        mean = uniform_filter1d(logs, width, axis=2) / count
        return mean, np.where(known, logs - mean, 0.0)

    (mean, noise), (_, size) = around(sd), around(amplitude)
    slope = np.sum(noise * size, axis=2) / np.maximum(np.sum(size**2, axis=2), 1e-9)
    mean = mean + np.clip(slope, 0.0, 1.0)[:, :, None] * size
    variance = np.exp(mean - digamma(averages - 1.0) + np.log(averages))
    freedom = 2.0 * (averages - 1.0)
    loud = sd**2 * averages / (averages - 1.0) > variance * chdtri(freedom, _UNLIKELY) / freedom
    return np.where(known & ~loud, np.sqrt(variance), sd)
