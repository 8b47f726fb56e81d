"""Plane faces fitted to the grey values themselves: edges along voxel columns, far below voxel size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.frames.plane_faces import PlaneFace, fitted_plane
from legacy.ct_inertia.volume.normal_distribution import normal_cdf
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array

# Heights over the face in standard deviations of the blur: half the length of a column; where a material is
# pure (beyond 3 the blur leaves 0.1 % of the other); the least distance of a column from another face; and
# the distance from which the blur of another face is left out (0.02 %).
_WINDOW = 5.5
_PURE = 3.0
_CLEAR = 1.0
_NEAR = 3.5
# Share of the material that the blur of other faces must leave in voxels that give its level; the mean of
# what it leaves is divided out.
_WHOLE = 0.995
# Cells of the visible face, mm: wider than the triangles of its surface, so that no cell between is empty.
_CELL_MM = 0.1
# Most columns and most values of a level: thinned evenly above, for their noise is then no longer the largest
# error, and time grows with them.
_MOST_COLUMNS = 16000
_LEVEL_VALUES = 8000
_LEAST_COLUMNS = calibrated("plane_fit.least_columns")
# Shift of the face, in standard deviations of the blur, above which the step is repeated once, for it is
# linear in the shift.
_FAR = 0.2
_MOST_MOVE_MM = calibrated("plane_fit.most_move_mm")
_DIRT = calibrated("plane_fit.dirt")
# Rounds of the clipped mean of the darkest squares: a fixed count, for squares at its limits can alternate.
_SETTLING = 5
_SQUARE_MM = calibrated("plane_fit.square_mm")
_BESIDE_NOISE = calibrated("plane_fit.beside_noise")
_LEVELS_MM = calibrated("plane_fit.levels_mm")
_FOOT = calibrated("plane_fit.foot")
_STEEP, _OUTSIDE_MM, _INSIDE = calibrated("plane_fit.bounding")
_CORRELATED = calibrated("plane_fit.correlated")


def fit_to_grey_values(
    faces: Sequence[PlaneFace], known: Sequence[PlaneFace], volume: Volume, sigma_mm: float
) -> list[PlaneFace]:
    """Return faces fitted to grey values; one that cannot be stays as it is.

    Parameters
    ----------
    faces : sequence of PlaneFace
        Found on a surface; those at the border of the scan stay as they are.
    known : sequence of PlaneFace
        All plane faces of the body, for where they end each other.
    volume : Volume
    sigma_mm : float
        Standard deviation of the blur.

    Notes
    -----
    In every voxel column that crosses the face, the shift of a blurred step that fits best (least squares,
    linear about the last plane). Near an edge the step is lower, by what the blur takes across the other
    face. The levels on both sides come from the ends of all columns together; columns with something else
    at an end (bone, glue, a hole) do not count.
    """
    result = list(faces)
    rest = [other for other in known if all(other is not face for face in faces)]
    for place, face in enumerate(faces):
        others = [*result[:place], *result[place + 1 :], *rest]
        fitted = None if face.at_border else _fit(face, others, volume, sigma_mm)
        if fitted is not None and abs(face.distance(fitted.point_mm[None])[0]) > _FAR * sigma_mm:
            fitted = _fit(fitted, others, volume, sigma_mm)
        result[place] = face if fitted is None else fitted
    return result


def _fit(face: PlaneFace, others: Sequence[PlaneFace], volume: Volume, sigma_mm: float) -> PlaneFace | None:
    columns = _columns(face, others, volume, sigma_mm)
    if columns is None:
        return None
    points, grey, away, beside = columns
    inner, outer = (away < -_PURE * sigma_mm) & (beside > _WHOLE), away > _PURE * sigma_mm
    if np.count_nonzero(inner.any(axis=1)) < _LEAST_COLUMNS:
        return None
    expected = beside * _blurred_step(away / sigma_mm)
    outside, inside = _means(grey, outer), _means(grey, inner)
    spread = min(_spread(outside), _spread(inside))
    squares = _squares(points @ face.basis)
    low, seen = _darkest(squares, outside, spread), _level(grey, inner)
    if not seen > low:
        return None
    clean = _find_pure_columns(outside, low, spread) & _find_pure_columns(inside, seen, _spread(inside))
    alone, unseen = _find_empty_columns(squares, outside, low, spread)
    clean &= alone
    if np.count_nonzero(clean) < _LEAST_COLUMNS:
        return None
    low = _level(grey[clean], outer[clean])
    foot = _FOOT * sigma_mm * unseen / (seen - low) * float(np.mean(~alone))
    share = (grey - low) / (seen - low) * float(expected[inner].mean())
    slope = beside * np.exp(-0.5 * (away / sigma_mm) ** 2) / (sigma_mm * np.sqrt(2.0 * np.pi))
    shift = np.sum((share - expected) * slope, axis=1) / np.maximum(np.sum(slope**2, axis=1), 1e-12)
    clean &= np.abs(shift) < _MOST_MOVE_MM + 2.0 * sigma_mm
    if np.count_nonzero(clean) < _LEAST_COLUMNS:
        return None
    edge = points[clean] + shift[clean, None] * face.normal
    plane_face = fitted_plane(edge, np.full(len(edge), face.area_mm2 / len(edge)), face.normal)
    before = face.samples_mm - face.distance(face.samples_mm)[:, None] * face.normal
    if float(np.max(np.abs(plane_face.distance(before)))) > 2.0 * _MOST_MOVE_MM:
        return None
    return replace(
        plane_face,
        covariance=_CORRELATED * plane_face.covariance + np.diag([_LEVELS_MM**2 + foot**2, 0.0, 0.0]),
        area_mm2=face.area_mm2,
        samples_mm=face.samples_mm,
        turning_1_mm=face.turning_1_mm,
    )


def _columns(
    face: PlaneFace, others: Sequence[PlaneFace], volume: Volume, sigma_mm: float
) -> tuple[Array, Array, Array, Array] | None:
    """Return columns across a face: points (n, 3) on it, grey values (n, k), heights (n, k) over it in mm.

    And what the blur across the other faces leaves of the material in every voxel (n, k).
    """
    steps = volume.direction * volume.spacing_mm
    across = face.normal @ steps
    axis = int(np.argmax(np.abs(face.normal @ volume.direction)))
    beside = [k for k in range(3) if k != axis]
    half = int(np.ceil(_WINDOW * sigma_mm / abs(across[axis])))
    index = volume.index_points(face.samples_mm)
    low = np.maximum(np.floor(index.min(axis=0)).astype(int), 0)
    high = np.minimum(np.ceil(index.max(axis=0)).astype(int) + 1, volume.size)
    low[axis] = max(low[axis] - half - 2, 0)
    high[axis] = min(high[axis] + half + 2, int(volume.size[axis]))
    if np.any(high - low < 2) or high[axis] - low[axis] < 2 * half + 1:
        return None
    count = face.area_mm2 * abs(face.normal @ volume.direction[:, axis]) / np.prod(volume.spacing_mm[beside])
    stride = np.ones(3, dtype=int)
    stride[beside] = max(1, round(float(np.sqrt(count / _MOST_COLUMNS))))
    ticks = [np.arange(low[k], high[k], stride[k]) for k in range(3)]
    flat = np.stack(np.meshgrid(ticks[beside[0]], ticks[beside[1]], indexing="ij"), axis=-1).reshape(-1, 2)
    crossing = np.zeros((len(flat), 3))
    crossing[:, beside] = flat
    offset = (face.point_mm - volume.origin_mm) @ face.normal
    crossing[:, axis] = (offset - flat @ across[beside]) / across[axis]
    points = volume.scan_points(crossing)
    first = np.round(crossing[:, axis]).astype(int) - half
    keep = (first >= low[axis]) & (first + 2 * half < high[axis])
    keep &= _is_covered(face, points)
    others = [other for other in others if _ends(face, other)]
    for other in others:
        keep &= other.distance(points) < -_CLEAR * sigma_mm
    if np.count_nonzero(keep) < _LEAST_COLUMNS:
        return None
    box = tuple(slice(int(low[k]), int(high[k]), int(stride[k])) for k in (2, 1, 0))
    block = np.asarray(volume.array[box])
    stack = np.moveaxis(block, 2 - axis, 2).transpose(1, 0, 2)
    rows = np.flatnonzero(keep)
    place = (first[keep] - low[axis])[:, None] + np.arange(2 * half + 1)
    shape = (len(ticks[beside[0]]), len(ticks[beside[1]]))
    row, column = (k[:, None] for k in np.unravel_index(rows, shape))
    grey = stack[row, column, place].astype(float)
    height = (first[keep][:, None] + np.arange(2 * half + 1) - crossing[keep, axis][:, None]) * across[axis]
    crossing[:, axis] = 0.0
    beside_others = _share_beyond_blur(
        others, volume.scan_points(crossing[keep]), place + low[axis], steps[:, axis], sigma_mm
    )
    finite = np.all(np.isfinite(grey), axis=1)
    return points[keep][finite], grey[finite], height[finite], beside_others[finite]


def _share_beyond_blur(
    others: Sequence[PlaneFace], feet: Array, index: NDArray[np.int64], step: Array, sigma_mm: float
) -> Array:
    """Return what the blur across other faces leaves of the material, (n, k), in voxels of columns.

    Parameters
    ----------
    others : sequence of PlaneFace
    feet : ndarray, (n, 3)
        Points of the columns at index 0, mm.
    index : ndarray of int, (n, k)
        Of the voxels along the columns.
    step : ndarray, (3,)
        From one voxel of a column to the next, mm.
    sigma_mm : float
    """
    left = np.ones(index.shape)
    for other in others:
        if other.at_border:
            continue
        foot, slope = other.distance(feet)[:, None], float(step @ other.normal)
        highest = (foot + index[:, [0, -1]] * slope).max(axis=1)
        near = np.flatnonzero(highest > -_NEAR * sigma_mm)
        left[near] *= _blurred_step((foot[near] + index[near] * slope) / sigma_mm)
    return left


def _ends(face: PlaneFace, other: PlaneFace) -> bool:
    """Return whether another face bounds this one: at a fair angle, and with nearly all of it inside.

    What looks like a narrow face at a smaller angle is an edge rounded by the blur.
    """
    if abs(face.normal @ other.normal) > (0.995 if other.at_border else _STEEP):
        return False
    return float(np.mean(other.distance(face.samples_mm) < _OUTSIDE_MM)) > _INSIDE


def _is_covered(face: PlaneFace, points: Array) -> NDArray[np.bool_]:
    """Return which points lie on the face as seen: in cells of 0.1 mm with samples, or between such."""
    # The grid lies about the middle of the face, so that one sample at the rim does not shift every cell.
    cells = np.floor((face.samples_mm - face.point_mm) @ face.basis / _CELL_MM).astype(int)
    start = cells.min(axis=0) - 2
    cells -= start
    seen = np.zeros(cells.max(axis=0) + 3, dtype=bool)
    seen[cells[:, 0], cells[:, 1]] = True
    inner = _close_gaps(seen)
    place = np.floor((points - face.point_mm) @ face.basis / _CELL_MM).astype(int) - start
    valid = np.all((place >= 0) & (place < np.array(seen.shape)), axis=1)
    result = np.zeros(len(points), dtype=bool)
    result[valid] = inner[place[valid, 0], place[valid, 1]]
    return result


def _close_gaps(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return cells (n, m) and those between them: grown by one all round and shrunk again."""
    for joined in (np.logical_or, np.logical_and):
        for axis in range(2):
            lines = np.moveaxis(np.pad(cells, [(1 - axis, 1 - axis), (axis, axis)]), axis, 0)
            cells = np.moveaxis(joined(joined(lines[:-2], lines[1:-1]), lines[2:]), 0, axis)
    return cells


def _blurred_step(height: Array) -> Array:
    """Return the share that a step blurred by 1 leaves at heights over it."""
    return normal_cdf(-height)


def _level(grey: Array, where: NDArray[np.bool_]) -> float:
    """Return the grey value of the material at one end of the columns, safe from a minority of others."""
    values = grey[where]
    values = values[:: max(1, len(values) // _LEVEL_VALUES)]
    middle = float(np.median(values))
    spread = 1.4826 * float(np.median(np.abs(values - middle)))
    near = np.abs(values - middle) <= 2.0 * spread
    return float(values[near].mean())


def _means(grey: Array, where: NDArray[np.bool_]) -> Array:
    """Return the mean at one end of every column, (n,); NaN where it has no voxel there."""
    count = where.sum(axis=1)
    total = np.where(where, grey, 0.0).sum(axis=1)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _spread(means: Array) -> float:
    """Return how far the means of columns scatter, safe from a minority of others."""
    known = means[np.isfinite(means)]
    if len(known) == 0:
        return float("inf")
    return max(1.4826 * float(np.median(np.abs(known - np.median(known)))), 1e-12)


def _squares(flat: Array) -> NDArray[np.intp]:
    """Return the number of the square that each column, at flat (n, 2) in mm, lies in."""
    cells = np.floor(flat / _SQUARE_MM).astype(np.int64)
    cells -= cells.min(axis=0)
    numbers = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    return np.asarray(np.unique(numbers, return_inverse=True)[1])


def _darkest(squares: NDArray[np.intp], means: Array, spread: float) -> float:
    """Return the level of air from the darkest tenth of the squares: the blur of bone near by only adds."""
    known = np.isfinite(means)
    count = np.bincount(squares, known)
    large = count >= max(0.5 * float(np.median(count[squares])), 1.0)
    total = np.bincount(squares, np.where(known, means, 0.0))
    values = total[large] / count[large]
    if len(values) == 0:
        return float("nan")
    sd = spread / float(np.sqrt(np.median(count[large])))
    level = float(np.quantile(values, 0.1)) + 1.28 * sd
    for _ in range(_SETTLING):
        near = np.abs(values - level) <= 2.0 * sd
        level = float(values[near].mean()) if np.any(near) else level
    return level


def _find_pure_columns(means: Array, level: float, spread: float) -> NDArray[np.bool_]:
    """Return in which columns the mean at one end equals that of the material within noise."""
    return np.asarray(np.isnan(means) | (np.abs(means - level) <= _DIRT * spread))


def _find_empty_columns(
    squares: NDArray[np.intp], means: Array, level: float, spread: float
) -> tuple[NDArray[np.bool_], float]:
    """Return the columns whose end is empty, and how much material noise may hide there.

    By means over squares of columns: single ones are too noisy to tell the foot of the blur of bone near by.
    """
    known = np.isfinite(means)
    count = np.bincount(squares, known)
    total = np.bincount(squares, np.where(known, means - level, 0.0))
    limit = _BESIDE_NOISE * spread
    alone = np.abs(total) <= limit * np.sqrt(count) + 1e-12
    return np.asarray(alone[squares]), limit / float(np.sqrt(max(np.median(count[squares]), 1.0)))
