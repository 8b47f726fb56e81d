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
from ct_inertia.voxels.masks import EVERYWHERE, Mask, Slices, boxes_around, used_box, widened
from stapeskit.arrays import Array

_ROUNDS = 16  # most rounds: errors of a level shrink to a third in each
_BLUR_ROUNDS = (0, *range(1, _ROUNDS, 2), 2)  # after which the blur is fitted
_LEAST_ROUNDS = 5  # that are always made; from the last one on the blur may be uneven
_MEDIA_ROUNDS = (2, 5, 8)
_SETTLED = 2.5e-4  # relative change of the contrast below which a scene is settled: more rounds follow noise
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
_LEVELS = (-0.35, 0.35)  # of a local level less one half: beyond, a body would vanish into its blur


@dataclass
class SceneFit:
    """A scene while it is fitted; arrays [z, y, x] on the part of the box that `Start` chose.

    All is followed in boxes around what is near the stapes, a third of that part.

    Attributes
    ----------
    data : ndarray of float32
        Grey values above air, what storing did to their mean undone.
    spread_mm2 : ndarray, (3, 3)
        Covariance of the blur along z, y, x, voxel included.
    uneven : bool
        The blur differs by direction.
    calm : ndarray of float32
        The data as calm as noise asks: the surface shall not follow it voxel by voxel.
    residual : ndarray of float32
        Of the data, less the model.
    shares, bodies, levels : dict of str to ndarray of float32
        Blurred share and sharp share of each body, and its local level less one half.
    near, boxes : list of tuple of 3 slice, dict of such lists
        Boxes around what is near the stapes, and around what the blur of each body reaches.
    places : dict of str to ndarray of int, (n,)
        Flat indices of the voxels near the stapes that belong to each body, off the faces of the arrays.
    slopes : list of float
        Data over model inside the stapes, round by round: 1 where the contrast is settled.
    """

    start: Start
    data: Grey
    spread_mm2: Array
    contrasts: dict[str, float]
    media: Media
    storing: Storing | None = None
    uneven: bool = False
    calm: Grey = field(init=False)
    residual: Grey = field(init=False)
    shares: dict[str, Grey] = field(default_factory=dict)
    bodies: dict[str, Grey] = field(default_factory=dict)
    levels: dict[str, Grey] = field(default_factory=dict)
    near: list[Slices] = field(default_factory=list)
    boxes: dict[str, list[Slices]] = field(default_factory=dict)
    places: dict[str, NDArray[np.intp]] = field(default_factory=dict)
    slopes: list[float] = field(default_factory=list)

    @classmethod
    def of(
        cls, start: Start, media: Media, storing: Storing | None, spread_mm2: Array, uneven: bool
    ) -> SceneFit:
        """Begin with the bodies of the masks."""
        data = start.grey - np.float32(start.air)
        fit = cls(start, data, spread_mm2, dict(start.contrasts), media, storing, uneven)
        fit.near, fit.residual = boxes_around(start.near), np.zeros(data.shape, dtype=np.float32)
        for name, mask in start.masks.items():
            reached = start.distances[name] < np.float32(start.reach_mm)
            window = widened(used_box(start.near & reached), 1)
            there, inner = np.zeros_like(reached), np.zeros_like(reached)
            there[window] = reached[window]
            inner[1:-1, 1:-1, 1:-1] = True  # all have neighbours
            fit.boxes[name] = boxes_around(there)
            fit.places[name] = np.flatnonzero(start.near & fit.side(name) & inner)
            fit.bodies[name], fit.levels[name] = mask.astype(np.float32), np.zeros(mask.shape, np.float32)
            fit.shares[name] = blur(fit.bodies[name], spread_mm2, start.spacing, fit.boxes[name])
        return fit

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
        start = self.start
        width = float(min(_SMOOTHING * start.noise / abs(start.contrasts["stapes"]), _MOST_SMOOTHING))
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
    def dry(self) -> Mask:
        """Voxels without a soft medium."""
        if self.media.soft is None:
            return np.ones(self.data.shape, dtype=bool)
        return np.asarray(np.abs(self.media.soft) < np.float32(_CLEAR_AIR * self.contrasts["stapes"]))

    @property
    def names(self) -> list[str]:
        """Names of the bodies, the stapes first."""
        return list(self.start.masks)

    def side(self, name: str, box: Slices = EVERYWHERE) -> Mask:
        """Return the voxels that belong to a body, in a box."""
        return np.asarray(self.start.basin[box] == 1 + self.names.index(name))

    def bones(self, but: str = "", box: Slices = EVERYWHERE) -> Grey:
        """Return the grey values of all bodies but one, in a box."""
        total = np.zeros_like(self.data[box])
        for name, share in self.shares.items():
            if name != but:
                total += np.float32(self.contrasts[name]) * share[box]
        return total

    def rest(self, places: NDArray[np.intp]) -> Grey:
        """Return what the bodies leave of the data at flat indices (n,)."""
        rest = self.data.ravel()[places]
        for name, share in self.shares.items():
            rest -= np.float32(self.contrasts[name]) * share.ravel()[places]
        return rest

    def above(self, name: str, box: Slices) -> Grey:
        """Return by how much the own grey values of a body pass its local level, over its contrast."""
        above = self.calm[box] - self.bones(name, box)
        above -= self.media.image[box]
        above *= np.float32(1.0 / self.contrasts[name])
        above -= np.float32(0.5) + self.levels[name][box]
        return above


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
    fit, sharp = SceneFit.of(start, media, storing, spread_mm2, uneven), False
    fit.calm = _calm(fit)
    for turn in range(_ROUNDS):
        for name in fit.names:
            _place_surface(fit, name)
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


def _calm(fit: SceneFit) -> Grey:
    return smooth(fit.data, np.full(3, fit.smoothing)) if fit.smoothing else fit.data


def _place_surface(fit: SceneFit, name: str) -> None:
    """Put the surface of a body where its own grey values pass the local level."""
    bodies = fit.bodies[name]
    for box in fit.boxes[name]:
        wide = widened(box, 1)  # slopes are taken to the neighbours
        above = fit.above(name, wide)
        if name == "plate":
            body = fit.media.plastic(fit, above, wide)
        else:
            body = share_above(above, fit.side(name, wide))
        bodies[box] = body[
            tuple(slice(a.start - w.start, a.stop - w.start) for a, w in zip(box, wide, strict=True))
        ]
    fit.shares[name] = blur(bodies, fit.spread_mm2, fit.start.spacing, fit.boxes[name])


def _compare(fit: SceneFit) -> None:
    for box in fit.near:
        model = fit.bones(box=box)
        model += fit.media.image[box]
        if fit.storing is not None:
            fit.data[box] = fit.start.grey[box] - np.float32(fit.start.air)
            fit.data[box] -= fit.storing.change(model + np.float32(fit.start.air))
        fit.residual[box] = fit.data[box] - model
    if fit.storing is not None:
        fit.calm = _calm(fit)


def _adjust_contrasts(fit: SceneFit) -> bool:
    """Scale contrasts by data over model deep inside; return whether the stapes' is settled."""
    for name in fit.names:
        places, share = fit.places[name], fit.shares[name].ravel()
        if name == "plate" and fit.media.plane is not None:
            places = np.flatnonzero(beside_stapes(fit.start))  # its body follows the plane, not noise
        places = places[share[places] > np.float32(_INNER)]
        if len(places) < (_LEAST_PLASTIC if name == "plate" else _LEAST_INNER):
            continue
        data = fit.data.ravel()[places].astype(float)
        model = data - fit.residual.ravel()[places]
        slope = float(data @ model / (model @ model))
        if name == "stapes":
            fit.slopes.append(slope)
        elif name == "other" and fit.start.contrasts["other"] == fit.start.contrasts["stapes"]:
            fit.contrasts[name] = fit.contrasts["stapes"]
            continue
        fit.contrasts[name] *= 1.0 + _GAIN * (slope - 1.0)
    return bool(fit.slopes) and abs(fit.slopes[-1] - 1.0) < _SETTLED


def free_edges(fit: SceneFit, ends: tuple[float, float]) -> NDArray[np.intp]:
    """Return the places (n,) between two blurred shares of the stapes; those that face air, if enough do."""
    places = fit.places["stapes"]
    free = np.ones(len(places), dtype=bool)
    for name in fit.names[1:]:
        free &= fit.start.distances[name].ravel()[places] > np.float32(fit.start.reach_mm)
    free &= fit.dry.ravel()[places]
    places = places[free] if np.count_nonzero(free) > _LEAST_FREE * len(places) else places
    shown = fit.shares["stapes"].ravel()[places]
    return places[(shown > ends[0]) & (shown < ends[1])]


def _adjust_blur(fit: SceneFit, late: bool) -> bool:
    """Take the blur one step of Gauss and Newton nearer to the least misfit at edges that face air.

    Parameters
    ----------
    late : bool
        An even blur has settled: if what it leaves asks for another in some direction, the blur is uneven.

    Returns
    -------
    bool
        It hardly changed.
    """
    share, places = fit.shares["stapes"], free_edges(fit, _BLURRED)
    changes = _by_spread(share, places, fit.start.spacing)
    residual = fit.residual.ravel()[places] * np.float32(1.0 / fit.contrasts["stapes"])
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
    places, share = fit.places[name], fit.shares[name].ravel()
    places = places[(share[places] > _RIM[0]) & (share[places] < _RIM[1])]
    if name == "stapes" and fit.media.voids is not None:
        places = places[~fit.media.voids.ravel()[places]]  # the level would take what fills a hollow
    left, weight = (np.zeros(fit.data.shape, dtype=np.float32) for _ in range(2))
    left.ravel()[places] = fit.residual.ravel()[places] * np.float32(1.0 / fit.contrasts[name])
    weight.ravel()[places] = 1.0
    width = np.hypot(_LEVEL_SIGMAS * fit.widths_mm / fit.start.spacing, fit.smoothing)
    moved = local_ratio(left, weight, width, 1e-3, fit.boxes[name])
    levels = fit.levels[name]
    for box in fit.boxes[name]:
        levels[box] = np.clip(levels[box] - np.float32(damping) * moved[box], *_LEVELS)
