"""The residual grey values of the fitted scene, by place: a source of the budget, and a warning.

Fringes, a bent grey scale, rings, motion, cupping and whatever else makes grey values differ from those of
two sharp materials end here: named with their place and size, not corrected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ct_inertia.bodies import Grey, Mask, Moments
from ct_inertia.calibrated import calibrated
from ct_inertia.grey.cells import by_cells, mean_by_cells
from ct_inertia.grey.scene import SceneFit
from stapeskit.warnings import Notice

_CELL_VOXELS = 8
_LEAST_VOXELS, _LEAST_CELL = 100, 12
_LEAST_SHARE = calibrated("misfit.least_share")
_MIN_Z, _MIN_CHI2 = 7.0, 35.0
PLACES = {
    "void": "in the closed hollows of the stapes",
    "collar": "next to the stapes, outside of its edge",
    "edge": "across the edge of the stapes",
    "inside": "inside the bone",
}
"""Places of a residual and their words."""


@dataclass(frozen=True)
class PlaceMisfit:
    """The residual of one place.

    Attributes
    ----------
    place : str
        A key of `PLACES`.
    share : float
        Its sum as a share of the stapes' volume.
    z : float
        Its mean over its standard error.
    chi2 : float
        Mean square of the means over cells, in units of what noise leaves them.
    least : float
        Share from which it is named: what the rough surface of a body in noise leaves, or a fixed one.
    """

    place: str
    share: float
    z: float
    chi2: float
    least: float

    @property
    def stands_out(self) -> bool:
        """Whether it is more than noise, and large enough to be named."""
        return abs(self.share) > self.least and (self.z > _MIN_Z or self.chi2 > _MIN_CHI2)

    def __str__(self) -> str:
        return f"{PLACES[self.place]}: {100.0 * self.share:+.2f} % of the volume"


def misfits(fit: SceneFit, residual: Grey, voxel_mm3: float, moments: Moments) -> list[PlaceMisfit]:
    """Return the residual of a scene by place.

    Parameters
    ----------
    fit : SceneFit
    residual : ndarray of float32, [z, y, x]
        In units of the stapes' contrast.
    voxel_mm3 : float
    moments : Moments
    """
    found = []
    noise = fit.start.noise / fit.contrasts["stapes"]
    # A body whose surface follows noise is larger than it is seen by about the square of the noise.
    least = max(_LEAST_SHARE, 2.0 * noise**2 * min(0.1 * fit.start.correlation, 1.0))
    for place, where in _places(fit).items():
        count = int(np.count_nonzero(where))
        if count < _LEAST_VOXELS:
            continue
        values, index = residual[where], np.argwhere(where)
        mean, error = mean_by_cells(values, index, _CELL_VOXELS)
        error = max(error, noise * float(np.sqrt(fit.start.correlation / count)), 1e-9)
        size, total = by_cells(values, index, _CELL_VOXELS)
        full = size >= _LEAST_CELL
        means = total[full] / size[full]
        expected = noise * np.sqrt(fit.start.correlation / size[full])
        chi2 = float(np.mean((means / np.maximum(expected, 1e-9)) ** 2)) if full.any() else 0.0
        share = float(values.sum(dtype=float)) * voxel_mm3 / moments.volume_mm3
        found.append(PlaceMisfit(place, share, abs(mean) / error, chi2, least))
    return found


def misfit_notice(found: list[PlaceMisfit], coat: float = 0.0, bend: float = 0.0) -> list[Notice]:
    """Return one warning for all significant residuals.

    ``coat``: what a soft coat that nobody stated would take off, as a share of the volume, where it fits;
    ``bend``: of the grey scale, by its noise.
    """
    standing = [str(one) for one in found if one.stands_out]
    if bend:
        standing.append(f"a noise in air that is {(1.0 + bend) / (1.0 - bend):.2f} times that in bone")
    if not standing:
        return []
    text = (
        "The grey values around the stapes are not those of two sharp materials: the model leaves "
        f"{'; '.join(standing)}. Phase fringes, a bent grey scale (gamma), rings, motion, cupping or soft "
        "tissue do that. It is not corrected; the budget holds its size (misfit, grey_scale). Look at the "
        "slices of the report."
    )
    if coat:
        text += (
            f" A mucosa fits them better and would take {100.0 * coat:.1f} % off the volume, which the "
            "budget holds (coat): state it with --coat, or remove it and scan again."
        )
    return [Notice("grey_values_misfit", text)]


def _places(fit: SceneFit) -> dict[str, Mask]:
    share, own = fit.shares["stapes"], fit.own & fit.start.near
    void = own & fit.media.voids if fit.media.voids is not None else np.zeros_like(own)
    return {
        "void": void,
        "collar": own & ~void & (share < 0.12),
        "edge": own & (share > 0.12) & (share < 0.88),
        "inside": own & (share > 0.95),
    }
