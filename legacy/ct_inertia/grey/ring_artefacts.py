"""Rings: a pattern that the air of all layers repeats. Named only."""

from __future__ import annotations

import numpy as np

from legacy.ct_inertia.bodies import Levels
from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.grey.level_fit import grow_mask
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

# Rings are named from this size on (share of the contrast of bone and air), and when they stand out of noise
# so many times.
_LEAST_RING = calibrated("artefacts.least_ring")
_STANDS_OUT = calibrated("artefacts.stands_out")
_LEAST_COLUMNS, _LEAST_IN_COLUMN = 400, 6
# In widths of the blur: a Gaussian edge has 0.3 % of its height left here, Phi(-2.75).
_TAIL = 2.75


def ring_notices(cut: Cut, levels: Levels, sigma_mm: float, spacing_mm: Array) -> list[Notice]:
    """Find what repeats from layer to layer in the air: the covariance of two halves, free of noise.

    Parameters
    ----------
    cut : Cut
        With the grey values as they were read.
    levels : Levels
    sigma_mm : float
        Standard deviation of the point spread.
    spacing_mm : ndarray, (3,)

    Notes
    -----
    Rings are constant along the axis of rotation, z. Differences of neighbours along x take out slow
    changes; noise of the two halves of a column is independent.
    """
    near = cut.stapes | cut.others | cut.plate
    for k in range(2 * max(1, round(_TAIL * sigma_mm / float(spacing_mm.mean())))):
        near = grow_mask(near, corners=k % 2 == 0)
    free = ~near
    middle = cut.grey.shape[0] // 2
    halves = []
    for part in (slice(0, middle - 1), slice(middle + 1, None)):
        count = np.count_nonzero(free[part], axis=0)
        total = np.where(free[part], cut.grey[part], np.float32(0.0)).sum(axis=0, dtype=np.float64)
        halves.append((count, total / np.maximum(count, 1)))
    good = np.minimum(halves[0][0], halves[1][0]) >= _LEAST_IN_COLUMN
    pairs = good[:, 1:] & good[:, :-1]
    if np.count_nonzero(pairs) < _LEAST_COLUMNS:
        return []
    first, second = (np.diff(mean, axis=1)[pairs] for _, mean in halves)
    products = (first - np.median(first)) * (second - np.median(second))
    covariance = float(products.mean())
    # Neighbouring differences share a column.
    sd = float(products.std()) * np.sqrt(2.0 / len(products))
    height = np.sqrt(0.5 * max(covariance, 0.0)) / levels.contrast
    if covariance < _STANDS_OUT * sd or height < _LEAST_RING:
        return []
    text = (
        f"Rings: air repeats the same pattern in all layers along z, of {100.0 * height:.1f} % of the "
        f"contrast of bone and air (standard deviation). They do not average out as noise does, and "
        f"the budget holds them as noise only. Scan with a moving detector, or "
        f"correct rings in the reconstruction."
    )
    return [Notice("ring_artefacts", text)]
