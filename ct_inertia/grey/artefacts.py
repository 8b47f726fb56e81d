"""Artefacts of a scan that grey values around the stapes show: rings, phase contrast, motion. Named only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Levels
from ct_inertia.calibrated import calibrated
from ct_inertia.grey.level_fit import spread
from ct_inertia.grey.psf import edge_widths
from ct_inertia.segment.cutting import Cut
from stapeskit.warnings import Notice

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# An artefact is reported from these sizes on (shares of the contrast of bone and air) ...
_LEAST_RING = calibrated("artefacts.least_ring")
_LEAST_DIP = calibrated("artefacts.least_dip")
# ... and from so many standard deviations of independent noise on.
_STANDS_OUT = calibrated("artefacts.stands_out")
# Blur of equal voxels that differs by this between two axes.
_UNEVEN = calibrated("artefacts.uneven_blur")
_LEAST_COLUMNS, _LEAST_IN_COLUMN, _LAYERS = 400, 6, 5
# In widths of the blur: a Gaussian edge has 0.3 % of its height left here, Phi(-2.75).
_TAIL = 2.75


def artefact_notices(cut: Cut, levels: Levels, sigma_mm: float, spacing_mm: Array) -> list[Notice]:
    """Name the artefacts that are seen next to the stapes.

    Parameters
    ----------
    cut : Cut
        With the grey values as they were read.
    levels : Levels
    sigma_mm : float
        Standard deviation of the point spread.
    spacing_mm : ndarray, (3,)
    """
    bodies = cut.stapes | cut.others | cut.plate
    layers = max(1, round(_TAIL * sigma_mm / float(spacing_mm.mean())))
    near = _grown(bodies, layers)
    found = [
        _phase_notice(cut, bodies, levels),
        _ring_notice(cut, _grown(near, layers), levels),
        _motion_notice(cut, levels, spacing_mm),
    ]
    return [notice for notice in found if notice is not None]


def _grown(mask: Mask, layers: int) -> Mask:
    for k in range(layers):
        mask = spread(mask, corners=k % 2 == 0)
    return mask


def _phase_notice(cut: Cut, bodies: Mask, levels: Levels) -> Notice | None:
    """Compare layers of air at bone with the layer behind: absorption and blur never make them darker."""
    mask, means, counts = spread(bodies), [], []
    for k in range(_LAYERS):
        wider = spread(mask, corners=k % 2 == 0)
        layer = cut.grey[wider & ~mask]
        if layer.size < _LEAST_COLUMNS:
            return None
        means.append(float(layer.mean(dtype=np.float64)))
        counts.append(layer.size)
        mask = wider
    dip = (means[-1] - min(means[:-1])) / levels.contrast
    noise = levels.noise / levels.contrast * np.sqrt(2.0 / min(counts))
    if dip < max(_LEAST_DIP, _STANDS_OUT * noise):
        return None
    text = (
        f"Air right at the bone is darker than air further off, by {100.0 * dip:.1f} % of the contrast of "
        f"bone and air: phase contrast (fringes at edges), or a sharpening filter of the reconstruction. "
        f"Levels and blur near the surface, and what looks like cupping of bone, may come from it. "
        f"Reconstruct with phase retrieval or without sharpening."
    )
    return Notice("phase_fringes", text)


def _ring_notice(cut: Cut, away: Mask, levels: Levels) -> Notice | None:
    """Find what repeats from layer to layer in the air: the covariance of two halves, free of noise.

    Notes
    -----
    Rings are constant along the axis of rotation, z. Differences of neighbours along x take out slow
    changes; noise of the two halves of a column is independent.
    """
    free = ~away
    middle = cut.grey.shape[0] // 2
    halves = []
    for part in (slice(0, middle - 1), slice(middle + 1, None)):
        count = np.count_nonzero(free[part], axis=0)
        total = np.where(free[part], cut.grey[part], np.float32(0.0)).sum(axis=0, dtype=np.float64)
        halves.append((count, total / np.maximum(count, 1)))
    good = np.minimum(halves[0][0], halves[1][0]) >= _LEAST_IN_COLUMN
    pairs = good[:, 1:] & good[:, :-1]
    if np.count_nonzero(pairs) < _LEAST_COLUMNS:
        return None
    first, second = (np.diff(mean, axis=1)[pairs] for _, mean in halves)
    products = (first - np.median(first)) * (second - np.median(second))
    covariance = float(products.mean())
    # Neighbouring differences share a column.
    sd = float(products.std()) * np.sqrt(2.0 / len(products))
    height = np.sqrt(0.5 * max(covariance, 0.0)) / levels.contrast
    if covariance < _STANDS_OUT * sd or height < _LEAST_RING:
        return None
    text = (
        f"Rings: air repeats the same pattern in all layers along z, of {100.0 * height:.1f} % of the "
        f"contrast of bone and air (standard deviation). They do not average out as noise does, and "
        f"the budget holds them as noise only. Scan with a moving detector, or "
        f"correct rings in the reconstruction."
    )
    return Notice("ring_artefacts", text)


def _motion_notice(cut: Cut, levels: Levels, spacing_mm: Array) -> Notice | None:
    """Compare the blur along the axes, where voxels are cubes."""
    if spacing_mm.max() > 1.01 * spacing_mm.min():
        return None
    rim = spread(spread(cut.stapes))
    widths = edge_widths(cut.grey, rim, levels.air, levels.bone, spacing_mm)
    if widths is None or widths.max() < _UNEVEN * widths.min():
        return None
    along = "xyz"[int(np.argmax(widths))]
    listed = ", ".join(f"{1e3 * width:.0f}" for width in widths)
    text = (
        f"The scan is blurred unevenly: {listed} um along x, y, z, most along {along}. The sample moved or "
        f"settled during the scan, or the reconstruction (centre of rotation, interpolation) smears that "
        f"axis. Check the reconstruction; fix the sample."
    )
    return Notice("blur_uneven", text)
