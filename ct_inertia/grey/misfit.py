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
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

_CELL_VOXELS = 8
_LEAST_VOXELS, _LEAST_CELL = 100, 12
_LEAST_SHARE = calibrated("misfit.least_share")
_LOUD = 5e-3  # share of the volume that noise leaves uncertain: twice that of white noise of 20 %
_MIN_Z, _MIN_CHI2 = 7.0, 35.0
_SUSPECT_Z = 2.0  # a second fit then decides: 1 in 40 bare bones costs one by chance
_QUIET = 0.05  # noise, share of the contrast, beyond which surfaces follow it and fits differ by that
_DEEP = 0.9  # share of bone from which a voxel shows its level
_TERMS = 10  # of a polynomial of second order in space
_LEAST_GAIN = 5e-3  # of the level of bone: less moves volume and frame by less than noise does
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
    soft_from : float
        Mean over its standard error from which it may be soft tissue.
    """

    place: str
    share: float
    z: float
    chi2: float
    least: float
    soft_from: float

    @property
    def stands_out(self) -> bool:
        """Whether it is more than noise, and large enough to be named."""
        return abs(self.share) > self.least and (self.z > _MIN_Z or self.chi2 > _MIN_CHI2)

    @property
    def may_be_soft(self) -> bool:
        """Whether it is bright enough that another model is worth a fit."""
        return self.share > 0.0 and self.z > self.soft_from

    def __str__(self) -> str:
        return f"{PLACES[self.place]}: {100.0 * self.share:+.2f} % of the volume"


def misfits(fit: SceneFit, residual: Grey, voxel_mm3: float, moments: Moments) -> list[PlaceMisfit]:
    """Return the residual of a scene by place.

    Parameters
    ----------
    residual : ndarray of float32, [z, y, x]
        In units of the stapes' contrast.
    """
    found = []
    noise = fit.start.noise / fit.contrasts["stapes"]
    # A body whose surface follows noise is larger than it is seen by about the square of the noise.
    least = max(_LEAST_SHARE, 2.0 * noise**2 * min(0.1 * fit.start.correlation, 1.0))
    # Voxels sample a Gaussian edge of width s voxels with aliases of 2 exp(-2 pi^2 s^2) on either side of it.
    least += 4.0 * float(np.exp(-2.0 * np.pi**2 * np.min(fit.widths_mm / fit.start.spacing) ** 2))
    for place, where in _places(fit).items():
        count = int(np.count_nonzero(where))
        if count < _LEAST_VOXELS:
            continue
        values = residual[where]
        mean, error = mean_by_cells(values, where, _CELL_VOXELS)
        error = max(error, noise * float(np.sqrt(fit.start.correlation / count)), 1e-9)
        size, total = by_cells(values, where, _CELL_VOXELS)
        full = size >= _LEAST_CELL
        means = total[full] / size[full]
        expected = noise * np.sqrt(fit.start.correlation / size[full])
        chi2 = float(np.mean((means / np.maximum(expected, 1e-9)) ** 2)) if full.any() else 0.0
        share = float(values.sum(dtype=float)) * voxel_mm3 / moments.volume_mm3
        soft_from = _SUSPECT_Z * max(1.0, noise / _QUIET)
        found.append(PlaceMisfit(place, share, abs(mean) / error, chi2, least, soft_from))
    return found


def gain_over_body(fit: SceneFit, residual: Grey, contrast: float) -> Grey | None:
    """Return how the level of bone departs from the one used, place by place; None where it is even.

    Parameters
    ----------
    residual : ndarray of float32, [z, y, x]
        In units of the stapes' contrast.
    contrast : float
        Level of bone that is used.

    Returns
    -------
    ndarray of float32, [z, y, x], or None
        Share of bone on the stapes' side, no larger than where bone shows it.

    Notes
    -----
    Least squares of a polynomial of second order, as cupping leaves one, to the means over cells deep inside.
    It counts where it explains more than noise and the scatter about it would, and more than 0.5 %.
    """
    deep = fit.own & fit.start.near & (fit.shares["stapes"] > np.float32(_DEEP))
    index = np.argwhere(deep)
    if len(index) < _LEAST_VOXELS:
        return None
    places = index.T * fit.start.spacing[:, None]
    size, total = by_cells(residual[deep], deep, _CELL_VOXELS)
    centres = np.stack([by_cells(place, deep, _CELL_VOXELS)[1] for place in places])
    full = size >= _LEAST_CELL
    size, means, centres = size[full], total[full] / size[full], centres[:, full] / size[full]
    if len(size) < 3 * _TERMS:
        return None
    middle = np.average(centres, axis=1, weights=size)[:, None]
    rows = _quadratic(centres - middle)
    weight = np.sqrt(size)
    factors = np.linalg.lstsq((rows * weight).T, means * weight, rcond=1e-6)[0]
    fitted = factors @ rows
    departs = size @ (fitted - float(np.average(means, weights=size))) ** 2
    noise = (fit.start.noise / fit.contrasts["stapes"]) ** 2 * fit.start.correlation
    scatter = float(size @ (means - fitted) ** 2) / (len(size) - _TERMS)
    if departs < (_TERMS + _MIN_Z**2) * max(noise, scatter, 1e-12) or departs < _LEAST_GAIN**2 * size.sum():
        return None
    own = fit.own
    at = np.argwhere(own).T * fit.start.spacing[:, None] - middle
    gain = np.zeros_like(residual)
    gain[own] = np.clip(factors @ _quadratic(at), fitted.min(), fitted.max())
    gain[own] += np.float32(fit.contrasts["stapes"] / contrast - 1.0)
    return gain


def _quadratic(points: Array) -> Array:
    """Return the terms (10, n) of a polynomial of second order at points (3, n)."""
    z, y, x = points
    return np.stack([np.ones_like(z), z, y, x, z * z, y * y, x * x, z * y, y * x, z * x])


def misfit_notice(
    found: list[PlaceMisfit],
    coat: float = 0.0,
    bend: float = 0.0,
    gain: Grey | None = None,
    uneven: float = 0.0,
    noise: float = 0.0,
) -> list[Notice]:
    """Return one warning for all significant residuals.

    ``coat``: what a soft coat that nobody stated would take off, as a share of the volume, where it fits;
    ``bend``: of the grey scale; ``gain``: departure of the level of bone, place by place;
    ``uneven``, ``noise``: standard deviations that the unevenness of air, and noise, leave, as shares of the
    volume.
    """
    standing = [str(one) for one in found if one.stands_out or (coat and one.may_be_soft)]
    if bend:
        standing.append(f"grey values half way up edges that are {25.0 * bend:+.1f} % of the contrast off")
    if gain is not None:
        width = 100.0 * float(gain.max() - gain.min())
        standing.append(
            f"a level of bone that differs by {width:.1f} % from place to place (cupping or denser bone: "
            "the moments are weighted by grey values, which is right for the latter)"
        )
    if uneven > _LEAST_SHARE:
        standing.append(
            f"a level of air that differs from place to place: {100.0 * uneven:.2f} % of the volume"
        )
    if noise > _LOUD:
        standing.append(f"noise that many neighbours share: {100.0 * noise:.2f} % of the volume")
    if not standing:
        return []
    text = (
        "The grey values around the stapes are not those of two sharp materials: the model leaves "
        f"{'; '.join(standing)}. Phase fringes, a bent grey scale (gamma), rings, streaks of metal, motion, "
        "cupping or soft tissue do that. It is not corrected; the budget holds its size (misfit, levels, "
        "grey_scale). Look at the "
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
