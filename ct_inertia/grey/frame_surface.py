"""The surface of a fitted body as a field, and how well it is known."""

from __future__ import annotations

import numpy as np

from ct_inertia.bodies import BodySurface, Grey
from ct_inertia.calibrated import calibrated
from ct_inertia.grey.bone import BoneLevel
from ct_inertia.grey.scene import SceneFit
from ct_inertia.voxels.fields import local_ratio
from ct_inertia.voxels.masks import boxes_around, grown, hull, widened

_RIM = (0.05, 0.95)
_RIM_WIDTHS = 3.29  # widths of the blur between these shares of a plane edge
_INTERPOLATION = 1.0 / 6.0  # voxels^2: variance of the triangle between two voxels
_MISFIT_SIGMAS = 4.0  # widths of the blur over which a misfit is taken as common
_MISFIT_HEIGHT = calibrated("surface.misfit_height")
_BLUR_LEFT = calibrated("surface.blur_left")


def body_surface(
    fit: SceneFit, name: str, level: BoneLevel, doubt: Grey | None = None, misfit_mm3: float = 0.0
) -> BodySurface:
    """Return the surface of the stapes, or of other bone near it.

    ``doubt``: one standard deviation of what was subtracted, as a share of bone, [z, y, x]; ``misfit_mm3``:
    what the residual by place leaves of the volume, a shift of all of the surface.

    Notes
    -----
    The level makes the mean residual of the rim zero, L = 3.29 widths of the blur thick, where a plane edge
    rises by 0.9: noise n, correlation k and voxels v leave the height the density n^2 k v L / 0.9^2 at long
    waves. A level that errs by e moves a plane edge by e sqrt(2 pi) s, s the width of the blur. What edges
    are seen through is the blur, the smoothing that noise asks for, and the linear interpolation between
    voxels (variance h^2 / 6).
    """
    begin = fit.start
    contrast = fit.contrasts[name]
    noise = begin.noise / contrast
    cell = begin.grid.scan_from_index[:3, :3]
    window = widened(hull(fit.boxes[name]), 1)
    where = fit.side(name, window)
    shown = np.where(where, fit.above(name, window), np.float32(-1.0))
    share = fit.shares[name][window]
    spread = fit.spread_in_scan_mm2 + (_INTERPOLATION + fit.smoothing**2) * cell @ cell.T
    edge = (share > _RIM[0]) & (share < _RIM[1]) & where & begin.near[window]
    rim = edge.astype(np.float32)
    square = np.where(edge, fit.residual[window], np.float32(0.0))
    square *= square
    width = _MISFIT_SIGMAS * fit.sigma_mm / begin.spacing
    local = local_ratio(square, rim, width, 1e-3, boxes_around(grown(edge)))
    extra = np.sqrt(np.maximum(local / np.float32(contrast**2) - np.float32(noise**2), 0.0))
    slope = float(np.sqrt(2.0 * np.pi)) * fit.sigma_mm
    area = float(rim.sum(dtype=float)) * begin.grid.voxel_mm3 / (_RIM_WIDTHS * fit.sigma_mm)
    relative = float(np.hypot(level.sd, begin.air_sd)) / level.contrast
    return BodySurface(
        field=shown,
        scan_from_index=begin.grid.part(window).scan_from_index,
        blur_mm=_BLUR_LEFT * float(np.sqrt(np.trace(spread) / 3.0)),
        spread_mm2=spread,
        noise_mm4=noise**2 * begin.correlation * begin.grid.voxel_mm3 * _RIM_WIDTHS * fit.sigma_mm / 0.9**2,
        misfit_sd_mm=(extra * np.float32(_MISFIT_HEIGHT * slope)).astype(np.float32),
        misfit_mm=_MISFIT_SIGMAS * fit.sigma_mm,
        level_sd_mm=float(np.hypot(0.5 * relative * slope, misfit_mm3 / max(area, 1e-9))),
        one_sd=None if doubt is None else np.where(where, shown + doubt[window], np.float32(-1.0)),
    )
