"""Lines at multiples of the mains frequency that hold more than the motion."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.proposals.misfitting_body import Cause, MisfittingBody, Remedy

# Public grids: 50 Hz in most countries, 60 Hz in the Americas and parts of Asia (IEC 60038).
_MAINS_HZ = (50.0, 60.0)
# How far from a multiple a line may lie: windows and the drift of the mains widen it.
_WIDTHS_HZ = (0.6, 1.5, 3.0, 6.0)
# Probability of a loud line by chance, and of so many of them near multiples.
_LOUD, _CHANCE = 1e-3, 1e-4
# Of the loud lines so many lie near multiples; the lines near multiples are at most this share of all.
_NEAR, _OF_ALL = 0.7, 0.6
_LEAST = 2
_LISTED = 8


def mains(suspect: MisfittingBody) -> Iterator[Cause]:
    """Yield lines near multiples of 50 or 60 Hz, when loud lines are mostly these.

    Notes
    -----
    The residuals of a line over those that most have, as chi2 of its degrees of freedom over the median of
    all lines, and the number of loud lines near multiples by the hypergeometric distribution.
    """
    from scipy.special import chdtrc
    from scipy.stats import hypergeom

    freedom, freq = suspect.robust.n_dof, suspect.freq_hz
    free = (freedom > 0) & np.any(np.isfinite(suspect.size), axis=0)
    if np.sum(free) < 5:
        return
    mean = np.nanmean(suspect.size[:, free], axis=0)
    loud = np.zeros(len(freq), dtype=bool)
    loud[free] = chdtrc(freedom[free], freedom[free] * mean / max(float(np.median(mean)), 1e-300)) < _LOUD
    best: tuple[float, float, NDArray[np.bool_]] | None = None
    for base in _MAINS_HZ:
        for width in _WIDTHS_HZ:
            multiple = np.round(freq / base)
            near = (np.abs(freq - base * multiple) <= width) & (multiple >= 1.0)
            both = int(np.sum(near & loud))
            if both < _LEAST or both < _NEAR * np.sum(loud) or np.mean(near) > _OF_ALL:
                continue
            p = float(hypergeom.sf(both - 1, len(freq), int(np.sum(loud)), int(np.sum(near))))
            if p < _CHANCE and (best is None or p < best[0]):
                best = p, base, near
    if best is None:
        return
    _p, base, near = best
    mains_hz = freq[near & loud]
    names = ", ".join(f"{value:.6g}" for value in mains_hz[:_LISTED])
    names += f" and {len(mains_hz) - _LISTED} more" if len(mains_hz) > _LISTED else ""
    ranges = " ".join(f"{value - 1.0:.6g}-{value + 1.0:.6g}" for value in mains_hz[:_LISTED])
    remedied = suspect.with_value(np.where(near[None], np.nan, suspect.value))
    remedy = Remedy(list(range(len(suspect.body.points))), remedied, float(np.mean(near & loud)))
    yield remedy, {"base": base, "lines": names, "ranges": ranges}
