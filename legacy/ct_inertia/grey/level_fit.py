"""Two-valued bodies and their blur, fitted to grey values: the bone level, and the tails of neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.native import checked, compiled, shape_of
from legacy.ct_inertia.volume.grid_operations import dilated, gaussian
from legacy.stapeskit.arrays import Array

Value = TypeVar("Value", bound=np.generic)

# The range of grey values (share of the contrast) over which a sample, of two along each axis of a voxel,
# changes from outside to inside: about what changes across its own width.
# A sample spans half a voxel; with a blur of one voxel the grey value changes by about a quarter over it.
_SOFT = 0.25
# Rounds of the fit, with and without the contrast, and the change of the contrast below which it ends before:
# the least standard deviation that is stated for it.
_ROUNDS, _SHAPE_ROUNDS = 14, 6
_SETTLED = 1e-4
_INNER = calibrated("level_fit.inner")
# Part of what differs near the surface that a round moves it by: damped while the contrast moves, too.
_SHAPE_STEP, _LONE_STEP = 0.7, 1.0
_LOW = calibrated("level_fit.lowest_level")
_HIGH = calibrated("level_fit.highest_level")
# Voxels of padding: one for the neighbours of the rim, the others for the blur to fall off.
_PAD = 4
# Voxels a piece: 27 values each, 3 MB.
_PIECE = 30_000
_CALM_PER_NOISE = calibrated("level_fit.smoothing_per_noise")
_MOST_CALM = calibrated("level_fit.most_smoothing")
_NOISE_FACTOR = calibrated("level_fit.noise_factor")
_MISFIT = calibrated("level_fit.misfit")
_THIN_SD, _THIN_SHARE = calibrated("level_fit.thin")
_UNSETTLED = calibrated("level_fit.unsettled")


@dataclass(frozen=True)
class BodyFit:
    """What the fit found.

    Attributes
    ----------
    contrast : float
        Bone minus air.
    relative_sd : float
        Standard uncertainty of the contrast, relative.
    sigma_mm : float
        Standard deviation of the point spread, voxel included.
    body : ndarray of float32, [z, y, x]
        Share of each voxel that lies in a body, before blur.
    """

    contrast: float
    relative_sd: float
    sigma_mm: float
    body: NDArray[np.float32]


def fit_bodies(
    excess: NDArray[np.float32],
    own: NDArray[np.bool_],
    spacing_mm: Array,
    contrast: float,
    sigma_mm: float,
    noise: float,
    fit_contrast: bool = True,
    side: NDArray[np.bool_] | None = None,
    most_smoothing: float = _MOST_CALM,
    beside: NDArray[np.bool_] | None = None,
) -> BodyFit:
    """Fit two-valued bodies and their blur to grey values above air.

    Parameters
    ----------
    excess : ndarray of float32, [z, y, x]
        Grey values minus the air level.
    own : ndarray of bool, [z, y, x]
        Voxels that are modelled: the bodies and their blur.
    spacing_mm : ndarray, (3,)
    contrast, sigma_mm : float
        Where to start.
    noise : float
        Standard deviation of a voxel.
    fit_contrast : bool
        Otherwise only the shapes are fitted.
    side : ndarray of bool, [z, y, x], optional
        Where two bodies face each other across a narrow gap, the voxels on one's side: the surfaces on
        the two sides move each by itself.
    most_smoothing : float
        Largest width, voxels, of the smoothing of the grey values that the surface is taken from.
    beside : ndarray of bool, [z, y, x], optional
        Voxels that bodies reach into and that are not compared, for something else lies there, too.

    Notes
    -----
    A body is where the grey values, interpolated to half a voxel, exceed a level that varies slowly over
    the surface. Its blurred image is compared with the data: what differs near the surface moves the
    surface (the local level); what differs inside, regressed on the image, scales the contrast; the blur is
    that which leaves least. A wall of thickness t looks like contrast * erf(t / (2 sqrt(2) s)) at its middle
    and has the area contrast * t, so that level and thickness part as long as t is not far below the blur s.

    A rough surface drawn by noise would blur its image a second time and be paid for with a narrower blur
    and a lower contrast (0.7 % at 15 % noise): the surface is taken from grey values smoothed the more the
    louder they are, by 1.2 voxels at most, and only the comparison is made with those measured.
    """
    spacing = np.asarray(spacing_mm)[::-1]
    own = np.pad(own, _PAD)
    filled = own if beside is None else own | np.pad(beside, _PAD)
    # What follows is computed in the filled voxels alone, (n,); the others of the grid hold air.
    voxels = _Voxels(filled)
    grey = np.where(filled, np.pad(excess, _PAD), np.float32(0.0)).astype(np.float32)
    data = voxels.of(grey)
    calm = voxels.of(_smooth_in_step(grey, noise / contrast, most_smoothing))
    compared = voxels.of(own)
    one_side = None if side is None else voxels.of(np.pad(side, _PAD))
    level = np.full(data.shape, 0.5, dtype=np.float32)
    history: list[float] = []
    rounds, step = (_ROUNDS, _SHAPE_STEP) if fit_contrast else (_SHAPE_ROUNDS, _LONE_STEP)
    for k in range(rounds):
        share = data / np.float32(contrast)
        body = _positive_share(voxels.grid(calm / np.float32(contrast) - level, -1.0))
        if not fit_contrast and k == rounds - 1:
            break
        model = voxels.of(blurred(body, sigma_mm, spacing))
        width = 1.5 * sigma_mm / spacing
        if fit_contrast:
            inner = compared & (model > _INNER)
            if np.count_nonzero(inner) < 50:
                break
            slope = float((share[inner] @ model[inner]) / (model[inner] @ model[inner]))
            history.append(slope)
            contrast *= 1.0 + 1.2 * (slope - 1.0)
            if k in (4, 8):
                sigma_mm = _best_blur(data / np.float32(contrast), body, voxels, compared, sigma_mm, spacing)
            if k == rounds - 1 or (k > 9 and abs(slope - 1.0) < _SETTLED):
                break
        rest = np.where(compared, share - model, np.float32(0.0))
        near = (model > 0.05) & (model < 0.95) & compared
        shift = _smooth(rest, near, voxels, width, one_side)
        level = np.clip(level - np.float32(step) * shift, _LOW, _HIGH).astype(np.float32)
    core = tuple(slice(_PAD, -_PAD) for _ in range(3))
    if not fit_contrast:
        return BodyFit(contrast, 0.0, sigma_mm, body[core])
    model = model[compared]
    rest = data[compared] / np.float32(contrast) - model
    residual = float(np.sqrt(np.mean(rest.astype(float) ** 2)))
    sd = _uncertainty(model, noise / contrast, residual, history)
    return BodyFit(contrast, sd, sigma_mm, body[core])


class _Voxels:
    """Some voxels of a grid, in the order in which they lie in memory."""

    def __init__(self, chosen: NDArray[np.bool_]) -> None:
        self._shape = chosen.shape
        self._index = np.flatnonzero(chosen)

    def of(self, grid: NDArray[Value]) -> NDArray[Value]:
        """Return the values (n,) of a grid [z, y, x]."""
        return grid.ravel()[self._index]

    def grid(self, values: NDArray[np.generic], elsewhere: float = 0.0) -> NDArray[np.float32]:
        """Return a grid [z, y, x] with values (n,), and one value in all other voxels."""
        grid = np.full(self._shape, elsewhere, dtype=np.float32)
        grid.ravel()[self._index] = values
        return grid


def _smooth(
    rest: NDArray[np.float32],
    near: NDArray[np.bool_],
    voxels: _Voxels,
    width: Array,
    side: NDArray[np.bool_] | None,
) -> NDArray[np.float32]:
    """Return the weighted mean (n,) of what is left near the surfaces, of each side by itself."""

    def mean(of: NDArray[np.bool_]) -> NDArray[np.float32]:
        weight, total = (
            voxels.of(gaussian(voxels.grid(values), width, truncate=3.0))
            for values in (of, np.where(of, rest, np.float32(0.0)))
        )
        return np.asarray(total / np.maximum(weight, np.float32(1e-3)))

    return mean(near) if side is None else np.where(side, mean(near & side), mean(near & ~side))


def _smooth_in_step(data: NDArray[np.float32], noise: float, most: float) -> NDArray[np.float32]:
    """Smooth the grey values that the surface is taken from, in step with their noise."""
    width = min(_CALM_PER_NOISE * noise, most)
    return gaussian(data, width, truncate=3.0) if width > 0.2 else data


def body_share(
    share: NDArray[np.float32], level: NDArray[np.float32], own: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return the part of each voxel where the interpolated share exceeds the local level.

    Only voxels that the surface passes near are sampled, at eight places by linear interpolation.
    """
    return _positive_share(np.where(own, share - level, np.float32(-1.0)))


def _positive_share(field: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the part of each voxel where a field [z, y, x] is positive."""
    kernels = compiled()
    if kernels is not None:
        field = np.ascontiguousarray(field)
        result = np.empty_like(field)
        checked(kernels.sampled_shares(field.ctypes.data, shape_of(field), _SOFT, result.ctypes.data))
        return result
    inside = field > 0.0
    rim = grow_mask(inside) & grow_mask(~inside)
    rim[[0, -1]] = rim[:, [0, -1]] = rim[:, :, [0, -1]] = False
    result = inside.astype(np.float32)
    index = np.flatnonzero(rim)
    rows, columns = field.shape[1] * field.shape[2], field.shape[2]
    steps = np.arange(-1, 2)
    around = (steps[:, None, None] * rows + steps[:, None] * columns + steps).ravel()
    flat = field.ravel()
    for start in range(0, len(index), _PIECE):
        part = index[start : start + _PIECE]
        near = flat[part[:, None] + around].reshape(-1, 3, 3, 3)
        total = np.zeros(len(part), dtype=np.float32)
        for z, y, x in product((0, 2), repeat=3):
            at_z = _quarter(near[:, 1], near[:, z])
            at_y = _quarter(at_z[:, 1], at_z[:, y])
            sample = _quarter(at_y[:, 1], at_y[:, x])
            # Softened over the sample's own width: shares near 0 and 1 come out in between.
            total += np.clip(sample * np.float32(1.0 / _SOFT) + np.float32(0.5), 0.0, 1.0)
        result.ravel()[part] = total * np.float32(0.125)
    return result


def _quarter(middle: NDArray[np.float32], other: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return values a quarter of a voxel from the middle, towards the other."""
    return np.float32(0.75) * middle + np.float32(0.25) * other


def grow_mask(mask: NDArray[np.bool_], corners: bool = True) -> NDArray[np.bool_]:
    """Return a mask grown by a voxel in all 26 directions, or in the 6 across faces only."""
    if not corners:
        return dilated(mask)
    kernels = compiled()
    if kernels is not None:
        mask = np.ascontiguousarray(mask)
        out = np.empty(mask.shape, dtype=bool)
        checked(kernels.spread(mask.ctypes.data, shape_of(mask), out.ctypes.data))
        return out
    grown = mask.copy()
    for axis in range(3):
        before = grown.copy()
        ahead: list[slice] = [slice(None)] * 3
        back: list[slice] = [slice(None)] * 3
        ahead[axis], back[axis] = slice(1, None), slice(None, -1)
        grown[tuple(ahead)] |= before[tuple(back)]
        grown[tuple(back)] |= before[tuple(ahead)]
    return grown


def blurred(body: NDArray[np.float32], sigma_mm: float, spacing: Array) -> NDArray[np.float32]:
    """Blur shares of voxels, which hold the voxel's own width already."""
    rest = np.sqrt(np.maximum((sigma_mm / spacing) ** 2 - 1.0 / 12.0, 0.0))
    return gaussian(body, rest, truncate=4.5)


def _best_blur(
    share: NDArray[np.float32],
    body: NDArray[np.float32],
    voxels: _Voxels,
    compared: NDArray[np.bool_],
    sigma_mm: float,
    spacing: Array,
) -> float:
    """Return the blur that leaves least: the vertex of a parabola through three trials."""
    steps = np.array([0.92, 1.0, 1.08])
    models = (voxels.of(blurred(body, sigma_mm * s, spacing)) for s in steps)
    left = [float(np.sum((share - model)[compared].astype(float) ** 2)) for model in models]
    second, first, _ = np.polyfit(steps, left, 2)
    if second <= 0.0:
        return sigma_mm
    return sigma_mm * float(np.clip(-first / (2.0 * second), steps[0], steps[-1]))


def _uncertainty(model: NDArray[np.float32], noise: float, residual: float, history: list[float]) -> float:
    """Return the relative standard uncertainty of the contrast: noise, misfit, thin walls, settling.

    The share of thin walls is the blur times the surface over the volume: voxels with 5 to 95 % of bone span
    3.29 widths of the blur.
    """
    values = model.astype(float)
    inner = values[values > _INNER]
    random = _NOISE_FACTOR * noise / np.sqrt(max(float(inner @ inner), 1.0))
    misfit = _MISFIT * np.sqrt(max(residual**2 - noise**2, 0.0))
    edge = np.count_nonzero((values > 0.05) & (values < 0.95)) / 3.29
    thin = _THIN_SD * (edge / max(float(values.sum()), 1.0) / _THIN_SHARE) ** 4
    settling = abs(history[-1] - 1.0) if history else _UNSETTLED
    return float(np.sqrt(random**2 + misfit**2 + thin**2 + settling**2 + _SETTLED**2))
