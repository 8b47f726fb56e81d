"""One model of the grey values around the stapes: bodies of two values, one blur, media, one noise.

    grey = air + sum_k contrast_k (G_sigma * body_k) + media + noise,   k = stapes, other bone, plate

The surface of a body is where grey values, less everything else, pass a local level; the level follows what
the model leaves at the rim. Contrast and blur follow from the same residual, so that thin bones, which have
no voxel of their full level, are measured as well as thick ones.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ct_inertia.calibrated import calibrated
from ct_inertia.grey.media import Media
from ct_inertia.grey.moments import COLUMNS, ROWS, symmetric
from ct_inertia.grey.plate_plane import beside_stapes
from ct_inertia.grey.start import Start
from ct_inertia.grey.storing import Storing
from ct_inertia.voxels.fields import Grey, blur, local_ratio, share_above, smooth
from ct_inertia.voxels.masks import Mask, used_box, widened
from stapeskit.arrays import Array

_ROUNDS = 16  # most rounds: errors of a level shrink to a third in each
_BLUR_ROUNDS = range(1, _ROUNDS, 2)  # after which the blur is fitted
_LEAST_ROUNDS = 5  # that are always made; from the last one on the blur may be uneven
_MEDIA_ROUNDS = (2, 5, 8)
_SETTLED = 1e-4  # relative change of the contrast below which the scene is settled
_BLUR_SETTLED = 0.02  # the same of the covariance of the blur
_DAMPING = (0.7, 0.5)  # of the local level, at first and later: where the blur is uneven it swings by itself
_GAIN = 1.2  # of the contrast: the surface answers to a contrast and takes a part of the residual
_RIM = (0.05, 0.95)  # shares of the blurred body between which its edge is
_LEVEL_SIGMAS = 0.7  # widths of the blur over which the residual at the rim is averaged: 1.5 err at ridges
_INNER = calibrated("scene.inner_share")
_SMOOTHING = calibrated("scene.smoothing_per_noise")
_MOST_SMOOTHING = calibrated("scene.most_smoothing_voxels")
_LEAST_SMOOTHING = 0.25  # voxels: less changes nothing
_LEAST_INNER, _LEAST_PLASTIC = 50, 400  # voxels from which a contrast follows
_LEAST_FREE = 0.1  # share of the stapes' voxels that face air, from which they alone show the blur
_BLURRED = (0.01, 0.99)  # shares of voxels that show the blur
_BLUR_GAIN = 1.3  # of an uneven blur: the surface answers to it and takes a part of the residual
_BLUR_STEP = 0.6  # most change of the blur's covariance in one round, as a share of its mean variance
_LEAST_SPREAD = 0.3  # voxels^2: the blur of a voxel and of its interpolation
_UNEVEN = 0.08  # of the variance of the blur: less is covered by the uncertainty of the blur
_CLEAR_AIR = 0.02  # of the contrast: a medium beyond it is no air
_LEVELS = (0.15, 0.85)  # of a local level: beyond, a body would vanish into its blur

Window = tuple[slice, ...]
EVERYWHERE: Window = (slice(None),) * 3


@dataclass
class SceneFit:
    """A scene while it is fitted; arrays [z, y, x] on the part of the box that `Start` chose.

    Attributes
    ----------
    start : Start
    data : ndarray of float32
        Grey values above air, what storing did to their mean undone.
    spread_mm2 : ndarray, (3, 3)
        Covariance of the blur along z, y, x, voxel included.
    contrasts : dict of str to float
    shares, bodies : dict of str to ndarray of float32
        Blurred share and sharp share of each body.
    levels, fields : dict of str to ndarray of float32
        Local level of each body, and by how much its grey values pass it, in its window.
    media : Media
    storing : Storing or None
    residual : ndarray of float32
        Of the data, less the model.
    uneven : bool
        The blur differs by direction.
    slopes : list of float
        Data over model inside the stapes, round by round: 1 where the contrast is settled.
    windows : dict of str to tuple of 3 slice
        Where each body is modelled.
    """

    start: Start
    data: Grey
    spread_mm2: Array
    contrasts: dict[str, float]
    media: Media
    storing: Storing | None = None
    shares: dict[str, Grey] = field(default_factory=dict)
    bodies: dict[str, Grey] = field(default_factory=dict)
    levels: dict[str, Grey] = field(default_factory=dict)
    fields: dict[str, Grey] = field(default_factory=dict)
    residual: Grey = field(init=False)
    slopes: list[float] = field(default_factory=list)
    uneven: bool = False
    windows: dict[str, Window] = field(default_factory=dict)

    @property
    def sigma_mm(self) -> float:
        """Width of the blur, root mean square of its three directions."""
        return float(np.sqrt(np.trace(self.spread_mm2) / 3.0))

    @property
    def spread_in_scan_mm2(self) -> Array:
        """Covariance of the blur in scan axes, (3, 3)."""
        axes = self.start.grid.scan_from_index[:3, :3] / self.start.grid.spacing_mm
        return np.asarray(axes @ self.spread_mm2[::-1, ::-1] @ axes.T)

    @property
    def smoothing(self) -> float:
        """Width, voxels, over which noise asks to average what the surface follows."""
        width = float(min(_SMOOTHING * self.start.noise / abs(self.contrasts["stapes"]), _MOST_SMOOTHING))
        return width if width > _LEAST_SMOOTHING else 0.0

    @property
    def widths_mm(self) -> Array:
        """Widths of the blur along z, y, x, (3,)."""
        return np.asarray(np.sqrt(np.diag(self.spread_mm2)))

    @property
    def own(self) -> Mask:
        """Voxels whose grey values count as the stapes' own."""
        return self.side("stapes") & self.start.within_reach

    @property
    def names(self) -> list[str]:
        """Names of the bodies, the stapes first."""
        return list(self.start.masks)

    def side(self, name: str) -> Mask:
        """Return the voxels that belong to a body."""
        return np.asarray(self.start.basin == 1 + self.names.index(name))

    def bones(self, but: str = "", window: Window = EVERYWHERE) -> Grey:
        """Return the grey values of all bodies but one, in a window."""
        total = np.zeros_like(self.data[window])
        for name, share in self.shares.items():
            if name != but:
                total += np.float32(self.contrasts[name]) * share[window]
        return total


def fit_scene(start: Start, media: Media, storing: Storing | None = None) -> SceneFit:
    """Fit bodies, contrasts, blur and media to the grey values of a start, whatever storing did to them.

    Notes
    -----
    The blur is even at first, for a thin bone's contrast would be taken for an uneven one. Where what it
    leaves asks for another width in some direction, all is fitted anew from there: surfaces that have
    followed a wrong blur keep half of its error in each round.
    """
    fit = _fitted(start, media, storing, start.sigma_mm**2 * np.eye(3), uneven=False)
    return _fitted(start, media, storing, fit.spread_mm2, uneven=True) if fit.uneven else fit


def _fitted(start: Start, media: Media, storing: Storing | None, spread_mm2: Array, uneven: bool) -> SceneFit:
    data = start.grey - np.float32(start.air)
    fit = SceneFit(start, data, spread_mm2, dict(start.contrasts), media, storing, uneven=uneven)
    for name, mask in start.masks.items():
        fit.windows[name] = _window(start, name)
        fit.shares[name], fit.bodies[name] = (np.zeros(mask.shape, dtype=np.float32) for _ in range(2))
        body = mask[fit.windows[name]].astype(np.float32)
        fit.levels[name] = np.full(body.shape, np.float32(0.5))
        fit.shares[name][fit.windows[name]] = blur(body, fit.spread_mm2, start.spacing)
    sharp = False
    for turn in range(_ROUNDS):
        calm = _calm(fit)
        for name in fit.names:
            _place_surface(fit, name, calm)
        fit.media.follow(fit, turn in _MEDIA_ROUNDS)
        _compare(fit)
        rests = turn > 0 and fit.media.refine(fit)
        settled = _adjust_contrasts(fit) and rests
        if turn in _BLUR_ROUNDS:
            sharp = _adjust_blur(fit, turn >= _LEAST_ROUNDS)
            if fit.uneven and not uneven:
                break
        elif settled and sharp and turn > _LEAST_ROUNDS:
            break
        if turn < _ROUNDS - 1:
            damping = _DAMPING[0] if turn < _LEAST_ROUNDS else _DAMPING[1]
            for name in fit.names:
                _adjust_level(fit, name, damping)
    return fit


def _window(start: Start, name: str) -> Window:
    """Return the box of the voxels that a body's blur reaches near the stapes."""
    return widened(used_box(start.near & (start.distances[name] < np.float32(start.reach_mm))), 1)


def _calm(fit: SceneFit) -> Grey:
    """Return the grey values as calm as noise asks: the surface shall not follow it voxel by voxel."""
    return smooth(fit.data, np.full(3, fit.smoothing)) if fit.smoothing else fit.data


def _place_surface(fit: SceneFit, name: str, calm: Grey) -> None:
    """Put the surface of a body where its own grey values pass the local level."""
    window = fit.windows[name]
    above = calm[window] - fit.bones(name, window)
    above -= fit.media.image[window]
    above *= np.float32(1.0 / fit.contrasts[name])
    above -= fit.levels[name]
    if name == "plate":
        body = fit.media.plastic(fit, above, window)
    else:
        body = share_above(above, fit.side(name)[window])
    fit.bodies[name][window], fit.fields[name] = body, above
    fit.shares[name][window] = blur(body, fit.spread_mm2, fit.start.spacing)


def _compare(fit: SceneFit) -> None:
    model = fit.bones()
    model += fit.media.image
    if fit.storing is not None:
        fit.data = fit.start.grey - np.float32(fit.start.air)
        fit.data -= fit.storing.change(model + np.float32(fit.start.air))
    fit.residual = np.subtract(fit.data, model, out=model)


def _adjust_contrasts(fit: SceneFit) -> bool:
    """Scale contrasts by data over model deep inside; return whether the stapes' is settled."""
    for name in fit.names:
        window = fit.windows[name]
        inner = (fit.start.near & fit.side(name))[window]
        if name == "plate" and fit.media.plane is not None:
            inner = beside_stapes(fit.start, window)  # where its body follows the plane, not the noise
        inner &= fit.shares[name][window] > np.float32(_INNER)
        if np.count_nonzero(inner) < (_LEAST_PLASTIC if name == "plate" else _LEAST_INNER):
            continue
        data = fit.data[window][inner]
        model = data - fit.residual[window][inner]
        slope = float(np.dot(data, model) / np.dot(model, model))
        if name == "stapes":
            fit.slopes.append(slope)
        elif name == "other" and fit.start.contrasts["other"] == fit.start.contrasts["stapes"]:
            fit.contrasts[name] = fit.contrasts["stapes"]
            continue
        fit.contrasts[name] *= 1.0 + _GAIN * (slope - 1.0)
    return bool(fit.slopes) and abs(fit.slopes[-1] - 1.0) < _SETTLED


def _adjust_blur(fit: SceneFit, late: bool) -> bool:
    """Take the blur one step of Gauss and Newton nearer to the least misfit at edges that face air.

    Parameters
    ----------
    fit : SceneFit
    late : bool
        An even blur has settled: if what it leaves asks for another in some direction, the blur is uneven.

    Returns
    -------
    bool
        It hardly changed.
    """
    window = fit.windows["stapes"]
    own = (fit.start.near & fit.side("stapes"))[window]
    free = own.copy()
    for name in fit.names[1:]:
        free &= (fit.start.distances[name] > np.float32(fit.start.reach_mm))[window]
    if fit.media.soft is not None:
        free &= np.abs(fit.media.soft[window]) < np.float32(_CLEAR_AIR * fit.contrasts["stapes"])
    own = free if np.count_nonzero(free) > _LEAST_FREE * np.count_nonzero(own) else own
    share = fit.shares["stapes"][window]
    shown = np.zeros_like(own)
    inner = (slice(1, -1),) * 3
    shown[inner] = own[inner] & (share[inner] > _BLURRED[0]) & (share[inner] < _BLURRED[1])
    place = np.flatnonzero(shown)
    changes = _by_spread(share, place, fit.start.spacing)
    residual = fit.residual[window].ravel()[place] * np.float32(1.0 / fit.contrasts["stapes"])
    squares = (changes @ changes.T).astype(float)
    step = symmetric(np.linalg.lstsq(squares, (changes @ residual).astype(float), rcond=1e-6)[0])
    even, square = np.eye(3) * np.trace(step) / 3.0, fit.sigma_mm**2
    fit.uneven |= late and bool(np.abs(step - even).max() > _UNEVEN * square)
    if not fit.uneven:
        wider = changes[:3].sum(axis=0)
        step = np.eye(3) * float(wider @ residual) / max(float(wider @ wider), 1e-30)
    step *= (_BLUR_GAIN if fit.uneven else 1.0) * min(
        1.0, _BLUR_STEP * square / max(float(np.abs(step).max()), 1e-30)
    )
    spread = fit.spread_mm2 + step
    np.fill_diagonal(spread, np.maximum(np.diag(spread), _LEAST_SPREAD * fit.start.spacing**2))
    fit.spread_mm2 = spread
    return bool(np.abs(step).max() < _BLUR_SETTLED * square)


def _by_spread(share: Grey, place: NDArray[np.intp], spacing: Array) -> Grey:
    """Return the change (6, n) of a blurred share at n places by the variances and covariances of the blur.

    Notes
    -----
    A Gaussian spread C is exp(1/2 sum C_ab d_a d_b): second differences of the image, half of them along one
    axis. Per mm2; zz, yy, xx, zy, yx, zx.
    """
    flat, steps = share.ravel(), (share.shape[1] * share.shape[2], share.shape[2], 1)
    along = [0.5 * (flat[place + step] + flat[place - step]) - flat[place] for step in steps]
    across = []
    for a, b in ((0, 1), (1, 2), (0, 2)):
        both, apart = steps[a] + steps[b], steps[a] - steps[b]
        corners = flat[place + both] + flat[place - both] - flat[place + apart] - flat[place - apart]
        across.append(np.float32(0.25) * corners)
    unit = np.outer(spacing, spacing)[ROWS, COLUMNS]
    return np.asarray(np.stack([*along, *across]) / unit[:, None], dtype=np.float32)


def _adjust_level(fit: SceneFit, name: str, damping: float) -> None:
    """Move the local level by what the model leaves at the rim, averaged over a width of the blur."""
    window = fit.windows[name]
    share = fit.shares[name][window]
    rim = (share > _RIM[0]) & (share < _RIM[1]) & fit.side(name)[window] & fit.start.near[window]
    if name == "stapes" and fit.media.voids is not None:
        rim &= ~fit.media.voids[window]  # the level would take what fills a hollow
    weight = rim.astype(np.float32)
    left = fit.residual[window] * np.float32(1.0 / fit.contrasts[name]) * weight
    width = np.hypot(_LEVEL_SIGMAS * fit.widths_mm / fit.start.spacing, fit.smoothing)
    moved = fit.levels[name] - np.float32(damping) * local_ratio(left, weight, width, 1e-3)
    fit.levels[name] = np.clip(moved, *_LEVELS)
