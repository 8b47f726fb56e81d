"""The plane face of the plate under the stapes, to a fraction of a voxel, and its blurred edge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.bodies import PlateFace
from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.grey.level_fit import blurred, body_share, fit_bodies
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.volume.distance import capped_distance
from legacy.ct_inertia.volume.grid_operations import dilated, gaussian
from legacy.ct_inertia.volume.normal_distribution import normal_cdf, normal_density
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array


@dataclass(frozen=True)
class FaceFit:
    """A fitted face and how well it is known.

    Attributes
    ----------
    face : PlateFace
    centre : ndarray, (3,)
        Where the fit is best, scan coordinates, mm.
    basis : ndarray, (3, 2)
        Directions in the face.
    covariance : ndarray, (6, 6)
        Of height at the centre (mm), slopes along the basis, blur (mm), air, plastic.
    """

    face: PlateFace
    centre: Array
    basis: Array
    covariance: Array


# Planes that are tried through edge points: a face with 5 % of them is missed once in 2000 times.
_TRIALS = 150
# Most edge points: for time only.
_MOST = 6000
_LEAST = calibrated("plate_face.least_points")
# Reweighted steps of the fit: a fixed count.
_ROUNDS = 12
# Distance from the face, in standard deviations of its blur, beyond which both materials are pure (0.02 %).
_WIDTHS = 3.5
# Voxels of the stapes behind the face below which nothing is displaced: noise. Chosen by judgement.
_LEAST_SUNK = 20
# Edge points agree with a plane within this many voxels.
_AGREED_VOXELS = 0.7
# Least share of the edge points with a plane's normal (cosine) near it (voxels) that lie in it.
_FLAT, _ALIKE, _NEAR_VOXELS = calibrated("plate_face.least_flatness"), 0.9, 4.0
# Of the normal matrix in units of its diagonal: beyond it half of the digits of a double are lost.
_MOST_CONDITION = 1e8
# A plane through edge points alone: its height in their scatter, its tilt in radians.
_EDGE_PLANE = calibrated("plate_face.edge_plane_sd")
_EDGE_TILT = calibrated("plate_face.edge_tilt_sd")
# Distance from bone, in standard deviations of the blur, from which voxels are free of it (0.1 %).
_CLEAR_WIDTHS = 3.0
_KNOWN_BLUR = calibrated("plate_face.blur_sd")
_KNOWN_AIR = calibrated("plate_face.air_sd")
_KNOWN = calibrated("plate_face.plastic_sd")
_DISPLACED_ROUNDS = (False, False, False, True, True)


def face_near(
    volume: Volume,
    cut: Cut,
    distance_mm: NDArray[np.float32],
    reach_mm: float,
    start: tuple[float, float, float],
) -> FaceFit | None:
    """Fit the face of the plate below the stapes, when the blur of the stapes reaches it.

    Parameters
    ----------
    volume : Volume
    cut : Cut
    distance_mm : ndarray of float32, [z, y, x]
        From the stapes.
    reach_mm : float
        How far blur reaches.
    start : (air, plastic, sigma_mm)

    Returns
    -------
    FaceFit or None
        None when the plate is far, or shows no plane face away from bone.

    Notes
    -----
    A plane through the edge points that most others agree with (random trials), then a least-squares fit of
    the blurred edge g = air + (plastic - air) Phi(-d / s) to all voxels within a few widths, bone's
    surroundings left out, with weights that fall off for voxels the model does not explain.
    """
    if not np.any(cut.plate & (distance_mm < 2.0 * reach_mm)):
        return None
    air, plastic, sigma = start
    bone = cut.stapes | cut.others
    clear = _CLEAR_WIDTHS * sigma + 0.5 * float(volume.spacing_mm.max())
    free = capped_distance(bone, volume.spacing_mm, clear) >= 0.999 * clear
    points, normals = _edge_points(volume, cut, free, air, plastic)
    if len(points) < _LEAST:
        return None
    body = volume.scan_points(np.argwhere(cut.stapes)[::50, ::-1] + cut.first).mean(axis=0)
    voxel = float(volume.spacing_mm.max())
    plane = _find_common_plane(points, normals, body, _AGREED_VOXELS * voxel)
    if plane is None or _flatness(points, normals, plane, voxel) < _FLAT:
        return None
    return _refine(volume, cut, free, plane, (air, plastic, sigma), points)


def plate_share(face: PlateFace, volume: Volume, cut: Cut, where: NDArray[np.bool_]) -> Array:
    """Return the grey value above air (n,) that the plate's face alone gives to voxels of a mask."""
    points = volume.scan_points(np.argwhere(where)[:, ::-1] + cut.first)
    away = points @ face.normal - face.offset_mm
    return np.asarray((face.plastic - face.air) * normal_cdf(-away / face.sigma_mm))


def displaced_share(
    face: PlateFace,
    volume: Volume,
    cut: Cut,
    above_plate: NDArray[np.float32],
    contrast: float,
    near: NDArray[np.bool_],
) -> NDArray[np.float32] | None:
    """Return the grey values [z, y, x] of the plastic that bone displaces.

    Parameters
    ----------
    face : PlateFace
    volume : Volume
    cut : Cut
    above_plate : ndarray of float32, [z, y, x]
        Grey values minus air and minus those of the whole half space behind the face.
    contrast : float
        Bone minus air.
    near : ndarray of bool, [z, y, x]
        Where the half space was subtracted.

    Returns
    -------
    ndarray or None
        To be added to ``above_plate``; None when no bone reaches behind the face.

    Notes
    -----
    The body is where the grey values exceed half the contrast; what of it lies behind the face is blurred,
    times the plastic's contrast, and added; that moves the body's surface, so it is done again, at last
    with a body whose own blurred image agrees with the grey values at its edges and corners too.
    A voxel with a share a of body and b behind the face holds a + b - 1 of both: the two faces are nearly
    parallel, and where they touch they divide the voxel between them.
    """
    sunk = _sunk_box(face, volume, cut)
    if sunk is None:
        return None
    box, away = sunk
    spacing = volume.spacing_mm[::-1]
    along = np.abs(face.normal @ (volume.direction * volume.spacing_mm)).sum()
    behind = np.clip(0.5 - away / along, 0.0, 1.0).astype(np.float32)
    plastic = np.float32((face.plastic - face.air) / contrast)
    share = above_plate[box] / np.float32(contrast)
    half, own = np.full(share.shape, 0.5, dtype=np.float32), near[box]
    missing = np.zeros_like(share)
    for fitted in _DISPLACED_ROUNDS:
        now = share + missing
        body = body_share(now, half, own)
        if fitted:
            body = fit_bodies(now, own, volume.spacing_mm, 1.0, face.sigma_mm, 0.0, fit_contrast=False).body
        missing = plastic * blurred(np.maximum(body + behind - 1.0, 0.0), face.sigma_mm, spacing)
    result = np.zeros_like(above_plate)
    result[box] = missing * np.float32(contrast)
    return result


def _sunk_box(face: PlateFace, volume: Volume, cut: Cut) -> tuple[tuple[slice, ...], Array] | None:
    """Return a box around the stapes' voxels behind the face, and the distances to the face in it, mm."""
    matrix = volume.direction * volume.spacing_mm
    along = (face.normal @ matrix)[::-1]
    start = float(face.normal @ volume.scan_points(cut.first)) - face.offset_mm
    axes = np.meshgrid(*(np.arange(n) for n in cut.grey.shape), indexing="ij", sparse=True)
    away = start + sum(k * axis for k, axis in zip(along, axes, strict=True))
    index = np.nonzero(cut.stapes & (away < 0.5 * np.abs(along).sum()))
    if len(index[0]) < _LEAST_SUNK:
        return None
    margin = np.ceil(5.0 * face.sigma_mm / volume.spacing_mm[::-1]).astype(int) + 1
    box = tuple(
        slice(max(0, int(k.min()) - m), int(k.max()) + m + 1) for k, m in zip(index, margin, strict=True)
    )
    return box, np.asarray(away[box])


def _edge_points(
    volume: Volume, cut: Cut, free: NDArray[np.bool_], air: float, plastic: float
) -> tuple[Array, Array]:
    """Return points (n, 3) on the plate's surface and outward normals, scan coordinates."""
    smooth = gaussian(cut.grey, 1.0, truncate=3.0)
    share = (smooth - air) / (plastic - air)
    edge = dilated(cut.plate, 2) & free & (np.abs(share - 0.5) < 0.3)
    for axis in range(3):
        part = np.moveaxis(edge, axis, 0)
        part[0] = part[-1] = False
    index = np.argwhere(edge)
    if len(index) > _MOST:
        index = np.random.default_rng(0).permutation(index)[:_MOST]
    slopes = []
    for axis in (2, 1, 0):
        step = np.eye(3, dtype=int)[axis]
        ahead, back = share[tuple((index + step).T)], share[tuple((index - step).T)]
        slopes.append((ahead - back).astype(float) / (2.0 * volume.spacing_mm[2 - axis]))
    gradient = np.stack(slopes, axis=1) @ volume.direction.T
    size = np.linalg.norm(gradient, axis=1)
    good = size > 0.1 / float(volume.spacing_mm.max())
    gradient, size, index = gradient[good], size[good], index[good]
    inward = gradient / size[:, None]
    offset = (0.5 - share[tuple(index.T)]) / size
    return volume.scan_points(index[:, ::-1] + cut.first) + offset[:, None] * inward, -inward


def _find_common_plane(
    points: Array, normals: Array, body: Array, width: float
) -> tuple[Array, float] | None:
    """Return the plane (outward normal, offset) with most points, among those the stapes is outside of."""
    rng = np.random.default_rng(0)
    best, most = None, _LEAST
    for k in rng.integers(0, len(points), _TRIALS):
        normal, offset = normals[k], float(normals[k] @ points[k])
        if normal @ body <= offset:
            continue
        for _ in range(3):
            inside = (np.abs(points @ normal - offset) < width) & (normals @ normal > 0.9)
            if np.count_nonzero(inside) < 20:
                break
            centre = points[inside].mean(axis=0)
            _, _, axes = np.linalg.svd(points[inside] - centre, full_matrices=False)
            normal = axes[2] * np.sign(axes[2] @ normal)
            offset = float(normal @ centre)
        count = int(np.count_nonzero(inside))
        if count > most and normal @ body > offset:
            best, most = (normal, offset), count
    return best


def _flatness(points: Array, normals: Array, plane: tuple[Array, float], voxel_mm: float) -> float:
    """Return the share of the edge points with a plane's normal near it that lie in it.

    A plane face has nearly all of them within its own scatter; the surface of a fluid curves away beyond.
    """
    normal, offset = plane
    away = points @ normal - offset
    alike = (normals @ normal > _ALIKE) & (np.abs(away) < _NEAR_VOXELS * voxel_mm)
    agreed = alike & (np.abs(away) < _AGREED_VOXELS * voxel_mm)
    if not np.any(agreed):
        return 0.0
    scatter = 1.4826 * float(np.median(np.abs(away[agreed])))
    return float(np.mean(np.abs(away[alike]) < max(_AGREED_VOXELS * voxel_mm, 3.0 * scatter)))


def _refine(
    volume: Volume,
    cut: Cut,
    free: NDArray[np.bool_],
    plane: tuple[Array, float],
    start: tuple[float, float, float],
    edges: Array,
) -> FaceFit | None:
    """Fit plane, levels and blur to the voxels across the face (Gauss-Newton with Tukey's weights).

    Where bone leaves too little of the face free, the plane through the edge points (n, 3) is kept.
    """
    (normal, offset), (air, plastic, sigma) = plane, start
    under = _over_the_face(volume, cut, normal, offset, sigma)
    index = np.argwhere(free & under)
    points = volume.scan_points(index[:, ::-1] + cut.first)
    supported = _over_plastic(volume, cut, points, (normal, offset), sigma)
    index, points = index[supported], points[supported]
    if len(index) < _LEAST:
        away = edges @ normal - offset
        rms = float(np.sqrt(np.median(away[np.abs(away) < sigma] ** 2)))
        face = PlateFace(normal, offset, sigma, air, plastic, rms)
        contrast = abs(plastic - air)
        sds = [_EDGE_PLANE * rms, _EDGE_TILT, _EDGE_TILT, _KNOWN_BLUR * sigma]
        sds += [_KNOWN_AIR * contrast, _KNOWN * contrast]
        basis = np.linalg.svd(normal[None, :])[2][1:].T
        return FaceFit(face, edges.mean(axis=0), basis, np.diag(np.square(sds)))
    grey = cut.grey[tuple(index.T)].astype(float)
    centre = points.mean(axis=0)
    basis = np.linalg.svd(normal[None, :])[2][1:].T
    scale = 1.0
    # What is known before: blur and levels, so that a small free part of the face does not bend them.
    contrast = abs(plastic - air)
    known = np.array([np.inf, np.inf, np.inf, _KNOWN_BLUR * sigma, _KNOWN_AIR * contrast, _KNOWN * contrast])
    for _ in range(_ROUNDS):
        z = (points @ normal - offset) / sigma
        cover, bell = normal_cdf(-z), normal_density(z)
        rest = grey - (air + (plastic - air) * cover)
        scale = max(1.4826 * float(np.median(np.abs(rest))), 1e-9 * abs(plastic - air))
        weight = np.clip(1.0 - (rest / (4.685 * scale)) ** 2, 0.0, None) ** 2
        slope = (plastic - air) * bell / sigma
        flat = (points - centre) @ basis
        design = np.column_stack(
            [slope, -slope * flat[:, 0], -slope * flat[:, 1], slope * z, 1.0 - cover, cover]
        )
        normal_matrix = (design * weight[:, None]).T @ design + np.diag(scale**2 / known**2)
        away = np.array([0.0, 0.0, 0.0, start[2] - sigma, start[0] - air, start[1] - plastic])
        right = design.T @ (weight * rest) + away * scale**2 / known**2
        step = np.linalg.lstsq(normal_matrix, right, rcond=None)[0]
        height = offset - float(normal @ centre) + step[0]
        turned = normal + basis @ step[1:3]
        normal = turned / np.linalg.norm(turned)
        basis = np.linalg.svd(normal[None, :])[2][1:].T
        offset = float(normal @ centre) + height
        sigma = float(np.clip(sigma + step[3], 0.3 * start[2], 3.0 * start[2]))
        air, plastic = air + step[4], plastic + step[5]
    z = (points @ normal - offset) / sigma
    middle = np.abs(z) < 0.7
    rest = grey - (air + (plastic - air) * normal_cdf(-z))
    slope = (plastic - air) * normal_density(z) / sigma
    rms = float(np.sqrt(np.median((rest[middle] / slope[middle]) ** 2))) if np.any(middle) else 0.0
    # A singular fit knows no plane: what was taken for a plate is none.
    size = np.sqrt(np.diag(normal_matrix))
    if not np.all(size > 0.0) or np.linalg.cond(normal_matrix / np.outer(size, size)) > _MOST_CONDITION:
        return None
    covariance = scale**2 * np.linalg.inv(normal_matrix)
    if not covariance[0, 0] < float(volume.spacing_mm.max()) ** 2:
        return None
    face = PlateFace(normal, offset, sigma, float(air), float(plastic), rms)
    return FaceFit(face, centre, basis, covariance)


def _over_plastic(
    volume: Volume, cut: Cut, points: Array, plane: tuple[Array, float], sigma: float
) -> NDArray[np.bool_]:
    """Return which points (n, 3) have plate below the face under them and around, as far as blur reaches.

    Where the box ends nothing is known of the plate's edge: points so near to it are left out too.
    """
    normal, offset = plane
    basis = np.linalg.svd(normal[None, :])[2][1:]
    below = points - (points @ normal - offset + 1.2 * _WIDTHS * sigma)[:, None] * normal
    good = np.ones(len(points), dtype=bool)
    size = np.array(cut.plate.shape)
    for turn in (None, *np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)):
        aside = 0.0 if turn is None else _WIDTHS * sigma * (np.array([np.cos(turn), np.sin(turn)]) @ basis)
        index = np.rint(volume.index_points(below + aside) - cut.first).astype(np.int64)[:, ::-1]
        inside = np.all((index >= 0) & (index < size), axis=1)
        good &= inside
        good[inside] &= cut.plate[tuple(index[inside].T)]
    return good


def _over_the_face(volume: Volume, cut: Cut, normal: Array, offset: float, sigma: float) -> NDArray[np.bool_]:
    """Return the voxels within a few widths of the plane with plate below them, away from its edges."""
    axes = [np.arange(n) for n in cut.grey.shape]
    matrix = volume.direction * volume.spacing_mm
    along = normal @ matrix
    start = float(normal @ volume.scan_points(cut.first)) - offset
    away = start + (
        along[2] * axes[0][:, None, None]
        + along[1] * axes[1][None, :, None]
        + along[0] * axes[2][None, None, :]
    )
    band = np.abs(away) < _WIDTHS * sigma
    deep = cut.plate & (away < -_WIDTHS * sigma)
    near_side = capped_distance(deep | (away >= -_WIDTHS * sigma), volume.spacing_mm, 1e-6) > 0.0
    reach = 3.0 * _WIDTHS * sigma
    from_plate = capped_distance(deep, volume.spacing_mm, reach)
    from_side = capped_distance(near_side, volume.spacing_mm, reach)
    return np.asarray(band & (from_plate < 2.2 * _WIDTHS * sigma) & (from_side > 2.6 * _WIDTHS * sigma))
