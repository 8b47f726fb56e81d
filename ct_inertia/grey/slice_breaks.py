"""Slices that do not continue their neighbours: missing, doubled, exchanged, or the sample has moved."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import Grey, Moments
from ct_inertia.grey.moments import COLUMNS, ROWS, effect
from ct_inertia.grey.scene import SceneFit
from stapeskit.arrays import Array
from stapeskit.faults import list_some
from stapeskit.warnings import Notice

_MIN_Z = 6.0  # standard deviations of a step: none of a million whole scans by chance
_LEAST_SHARE = 1.0 / 3.0  # of the step that one missing slice leaves; the blur hides up to half of it
_LEAST_NOISE = 0.02  # of the contrast: what sampling leaves of a sharp picture without noise
_ALIKE = (
    1.0 / 3.0
)  # of a break: least that growing and shrinking sections must each show, unless noise hides it
_LEAST_SLOPE = 0.1  # of T by n: where the blur hides nearly all of a break, its size is not known better
_LEAST_MM2 = 0.02  # of a section: least cross-section of a crus
_NEIGHBOURS = 2  # slices on either side of a break that the scene bends towards it


@dataclass(frozen=True)
class SliceBreak:
    """A break behind the slice ``before`` of the scene, and how many slices are missing there.

    The number is a fraction where slices were averaged, negative where there are too many; of another break
    it is the number of missing slices that would move the picture by as much.
    """

    before: int
    missing: float


def slice_breaks(fit: SceneFit) -> Iterator[SliceBreak]:
    """Yield the breaks of a fitted scene.

    Notes
    -----
    Where n slices are missing, the data step from one slice to the next by 1 + n slices. The scene puts its
    sharp surface through both sides and blurs it by s slices, so that it steps by 1 + n e, e = erf(1 /
    (2 sqrt(2) s)). The regression of the step of the residual on that of the model over the voxels of two
    slices therefore is T = (1 + n) / (1 + n e) - 1; 0 in a whole scan, whatever the shape, with the standard
    deviation that noise gives it and the scatter of the other slices.
    """
    from scipy.special import erf

    near = fit.own & fit.start.near & fit.dry
    pairs = near[1:] & near[:-1]
    contrast = np.float32(fit.contrasts["stapes"])
    steps = np.where(pairs, contrast * np.diff(fit.shares["stapes"], axis=0), np.float32(0.0))
    left = np.where(pairs, np.diff(fit.residual, axis=0), np.float32(0.0))
    share = float(erf(fit.start.spacing[0] / (2.0 * np.sqrt(2.0) * fit.widths_mm[0])))
    single = (2.0 / (1.0 + share) - 1.0) / float(fit.start.grid.block[2])  # what one missing slice leaves
    noise = max(fit.start.noise, _LEAST_NOISE * float(contrast))
    noise *= float(np.sqrt(2.0 * max(fit.start.correlation, 1.0)))
    slopes, error = _slopes(steps, left, noise)
    seen = error < _LEAST_SHARE * single / _MIN_Z
    if not seen.any():
        return
    usual = float(np.median(slopes[seen]))
    scatter = 1.4826 * float(np.median(np.abs(slopes[seen] - usual)))
    away = slopes - usual
    away[np.abs(away) < np.maximum(_MIN_Z * np.hypot(error, scatter), _LEAST_SHARE * single)] = 0.0
    away[~_amid_stapes(fit)] = 0.0
    for part in (np.maximum(steps, np.float32(0.0)), np.minimum(steps, np.float32(0.0))):
        slope, sd = _slopes(part, left, noise)
        shown = sd < _ALIKE * np.abs(away)
        away[shown & ((slope - usual) * np.sign(away) < _ALIKE * np.abs(away))] = 0.0
    while away.any():
        k = int(np.argmax(np.abs(away)))
        most = max(1.0 - share * (1.0 + away[k]), _LEAST_SLOPE)
        yield SliceBreak(k, float(away[k] / most))
        away[max(0, k - _NEIGHBOURS) : k + _NEIGHBOURS + 1] = 0.0


def _amid_stapes(fit: SceneFit) -> NDArray[np.bool_]:
    """Return between which slices (n,) the stapes goes on beyond the neighbours: at its tips fringes step."""
    pixel = fit.start.grid.voxel_mm3 / float(fit.start.spacing[0])
    wide = np.sum(fit.shares["stapes"], axis=(1, 2)) * pixel > _LEAST_MM2
    before, behind = np.zeros_like(wide), np.zeros_like(wide)
    before[_NEIGHBOURS:], behind[:-_NEIGHBOURS] = wide[:-_NEIGHBOURS], wide[_NEIGHBOURS:]
    return np.asarray(before[:-1] & behind[1:])


def _slopes(steps: Grey, left: Grey, noise: float) -> tuple[Array, Array]:
    """Return the slopes (n,) of what is left over steps [n, y, x], slice by slice, and their errors (n,)."""
    square = np.maximum(np.einsum("zyx,zyx->z", steps, steps, dtype=float), 1e-12)
    return np.einsum("zyx,zyx->z", steps, left, dtype=float) / square, noise / np.sqrt(square)


def with_breaks(
    fit: SceneFit, moments: Moments, repeated: tuple[int, ...] = ()
) -> tuple[Moments, list[Notice]]:
    """Add the source ``slices`` for what breaks change, and say where they are.

    ``repeated``: slices of the scan that are copies of those before them, and may have been added.
    """
    breaks, grid = list(slice_breaks(fit)), fit.start.grid
    for number in repeated:
        k = int((number - grid.first[2]) // grid.block[2]) - 1
        if 0 <= k < grid.shape[0] - 1 and all(abs(k - one.before) > _NEIGHBOURS for one in breaks):
            breaks.append(SliceBreak(k, -1.0 / float(grid.block[2])))
    if not breaks:
        return moments, []
    for one in breaks:
        step = _change(fit, one, moments)
        moments = moments.with_source("slices", np.outer(step, step))
    numbers = sorted(int(grid.first[2] + (one.before + 1) * grid.block[2]) for one in breaks)
    text = (
        f"The scan breaks off before slice {list_some(map(str, numbers), 6)}, counted from 0: slices are "
        "missing, doubled or exchanged there, or the sample has moved. What that changes of volume and "
        "moments is in the budget (slices), what it changes of the frames is not. Look at them, and "
        "reconstruct or scan again."
    )
    return moments, [Notice("slices_out_of_place", text)]


def _change(fit: SceneFit, one: SliceBreak, moments: Moments) -> Array:
    """Return the change of (V, c, S), (10,), by the slices that are missing at a break.

    They hold the section of the stapes there, and all beyond them is farther away.
    """
    grid, share, next_ = fit.start.grid, fit.shares["stapes"], one.before + 1
    transform = grid.scan_from_index.copy()
    transform[:3, 3] += transform[:3, 2] * one.before
    section = effect(0.5 * share[one.before : next_ + 1], transform, moments)
    transform[:3, 3] += transform[:3, 2]
    beyond = effect(share[next_:], transform, moments)
    along = grid.scan_from_index[:3, 2]
    turn = np.outer(beyond[1:4] * moments.volume_mm3, along)
    moved = np.zeros(10)
    moved[1:4] = beyond[0] / moments.volume_mm3 * along
    moved[4:] = (turn + turn.T)[ROWS, COLUMNS]
    return np.asarray(one.missing * (section + moved))
