"""The grey level of the stapes and its uncertainty: from voxels deep inside, or from the fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ct_inertia.bodies import Grey
from ct_inertia.calibrated import calibrated
from ct_inertia.grey.cells import mean_by_cells
from ct_inertia.grey.scene import SceneFit

_DEEP = 0.999  # blurred share from which a voxel is bone alone: three widths of the blur below the surface
_LEAST_DEEP = 200  # such voxels: cells of them have a scatter that can be used
_CELL_VOXELS = 6
_RIM = (0.05, 0.95)
_RIM_WIDTHS = 3.29  # widths of the blur between these shares of a plane edge
_BLUR_LEFT = 0.25  # of the rest of air deep inside: its standard deviation as a share of itself
_NOISE_FACTOR = calibrated("bone.noise_factor")
_MISFIT = calibrated("bone.misfit")
_THIN, _THIN_RATIO = calibrated("bone.thin")
_LEAST_SD = 1e-4  # of the contrast: what no term of the fit covers


@dataclass(frozen=True)
class BoneLevel:
    """The stapes' level above air.

    Attributes
    ----------
    contrast, sd : float
        Level above air, and its standard uncertainty, that of the air level left out.
    noise : float
        Standard deviation of a voxel inside bone.
    source : str
        ``interior`` or ``fit``.
    """

    contrast: float
    sd: float
    noise: float
    source: str


def bone_level(fit: SceneFit, excess: Grey) -> BoneLevel:
    """Return the grey level of bone by the way that has the lower standard deviation.

    Parameters
    ----------
    excess : ndarray of float32, [z, y, x]
        Grey values less air and everything that is not the stapes, in units of the fitted contrast.

    Notes
    -----
    The fit's uncertainty adds noise, misfit, and what thin bone leaves: the ratio of the volume of the rim to
    that of the body tells how much of the level hangs on the blur.
    """
    fitted = fit.contrasts["stapes"]
    share = fit.shares["stapes"]
    own = fit.start.near & fit.side("stapes")
    noise = fit.start.noise / fitted
    inner = own & (share > np.float32(0.8))
    rim = own & (share > _RIM[0]) & (share < _RIM[1])
    inside = share[inner].astype(float)
    random = _NOISE_FACTOR * noise * np.sqrt(fit.start.correlation / max(float(inside @ inside), 1.0))
    misfit = float(np.std(fit.residual[inner | rim])) / fitted
    extra = _MISFIT * np.sqrt(max(misfit**2 - noise**2, 0.0))
    ratio = np.count_nonzero(rim) / _RIM_WIDTHS / max(float(share[own].sum()), 1.0)
    thin = _THIN * (ratio / _THIN_RATIO) ** 4
    unsettled = abs(fit.slopes[-1] - 1.0) if fit.slopes else 0.05
    by_fit = float(np.sqrt(random**2 + extra**2 + thin**2 + unsettled**2 + _LEAST_SD**2))
    deep = own & (share > np.float32(_DEEP))
    if np.count_nonzero(deep) > _LEAST_DEEP:
        values = excess[deep] / share[deep]
        mean, scatter = mean_by_cells(values, deep, _CELL_VOXELS)
        # noise that neighbours share reaches beyond a cell
        scatter = max(scatter, noise * float(np.sqrt(fit.start.correlation / np.count_nonzero(deep))))
        by_interior = float(np.hypot(scatter, _BLUR_LEFT * (1.0 - float(share[deep].mean()))))
        if by_interior < by_fit:
            return BoneLevel(mean * fitted, by_interior * fitted, float(values.std()) * fitted, "interior")
    return BoneLevel(fitted, by_fit * fitted, fit.start.noise, "fit")
