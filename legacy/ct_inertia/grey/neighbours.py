"""The blur of other bone near the stapes, modelled and subtracted from the grey values of the stapes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.grey.level_fit import blurred, fit_bodies, grow_mask
from legacy.ct_inertia.grey.partial_volume import sensitivity
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.segment.touching_bones import flood_from_markers
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.volume.distance import capped_distance
from legacy.ct_inertia.volume.grid_operations import eroded, labelled
from legacy.ct_inertia.volume.normal_distribution import normal_cdf, normal_density
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

# Bodies whose blur carries a layer thinner than this across the middle of their gap, mm, exchange less
# than 3e-4 of a stapes, of which most cancels.
_THIN_LAYER_MM = 5e-4
# Where they are nearer, planes up to this far apart are modelled: they share less than 0.005 of a width.
_CLOSE_SIGMAS = 5.0
# Gaps up to this many standard deviations of the blur have a border that blur may shift. Computation: a limit
# that saves time. Measured on 72 simulated slabs of 0.1 to 0.25 mm beside a wall, at 0.7 to 2.3 of these
# (scanned() of tests/ct_inertia/grey/test_neighbours.py): the rms error of the area is 3.7e-4 mm2 at half the
# limit, 3.6e-4 mm2 at the limit and at its double; from 1.4 on the shift no longer matters.
_SHIFTED_SIGMAS = 2.0
# Rounds and relaxation of the sharpening that shows the border: Landweber's iteration converges below 2.
_SHARPENINGS, _RELAXATION = 5, 1.5
_HELD = calibrated("neighbours.held_border")
_BRIDGE_SD_MM = calibrated("neighbours.bridge_sd_mm")
_NECK_SD_MM = calibrated("neighbours.neck_sd_mm")
# Contrasts of other bone, as shares of the stapes'; nearer to 1 than the last of these it counts as
# the same bone, for the tails that it adds are known no better.
_NEIGHBOURS, _SAME_BONE = (0.3, 2.0), 0.05
# Voxels of pure other bone from which their median tells its contrast. Chosen by judgement.
_LEAST_DEEP = 12
_SOLID = calibrated("neighbours.solid")
_LEAST_CUT_MM2 = calibrated("neighbours.least_cut_mm2")
_WEAK_SHARE = calibrated("neighbours.weak_share")


@dataclass(frozen=True)
class NeighbourSeparation:
    """How grey values near other bone are shared.

    Attributes
    ----------
    own : ndarray of bool, [z, y, x]
        The stapes' side of the border, within reach of its blur.
    foreign : ndarray of float32, [z, y, x], or None
        Share of other bone's blur in each voxel.
    behind : ndarray of float32, [z, y, x], or None
        Share of the stapes' blur in voxels on the other side.
    """

    own: NDArray[np.bool_]
    foreign: NDArray[np.float32] | None = None
    behind: NDArray[np.float32] | None = None


def away_from_others(
    cut: Cut, distance_mm: NDArray[np.float32], reach_mm: float, spacing_mm: Array, sigma_mm: float
) -> NDArray[np.float32] | None:
    """Return the distance of each voxel from other bone, mm, [z, y, x], capped; None where that is far.

    Parameters are those of `separate_from_neighbours`, ``distance_mm`` [z, y, x] from the stapes.
    """
    if not np.any(cut.others & (distance_mm < 2.0 * reach_mm)):
        return None
    return capped_distance(cut.others, spacing_mm, 1.01 * max(reach_mm, _CLOSE_SIGMAS * sigma_mm))


def separate_from_neighbours(
    cut: Cut,
    distances_mm: tuple[NDArray[np.float32], NDArray[np.float32] | None],
    reach_mm: float,
    spacing_mm: Array,
    levels: tuple[float, float],
    sigma_mm: float,
) -> NeighbourSeparation:
    """Decide which grey values belong to the stapes.

    Parameters
    ----------
    cut : Cut
    distances_mm : (ndarray of float32, [z, y, x], the same or None)
        From the stapes, and from other bone where that is near.
    reach_mm : float
        How far its blur reaches.
    spacing_mm : ndarray, (3,)
    levels : (air, bone)
    sigma_mm : float
        Standard deviation of the point spread.

    Notes
    -----
    The border runs half way between the bodies, and where they are a few widths of the blur apart along the
    watershed of the grey values; in a wide gap noise would lead a watershed astray. Where two bodies are
    alike their tails swap across it and cancel; a thin rim beside a thick bone gives more than it gets (0.1 %
    of a stapes at a gap of two voxels). Within a few widths of the blur both are therefore modelled as
    two-valued bodies fitted to the grey values: the neighbour's tail is subtracted on this side, the stapes'
    own added on the other.

    In a gap no wider than the blur the darkest line lies nearer to the thinner body, at the rim of a
    footplate of 0.1 mm even inside it (0.2 to 0.3 % of a stapes): the watershed is drawn once more, in grey
    values that are sharpened from the fitted bodies on. In solid bone, which has no valley, it stays.
    """
    distance_mm, away = distances_mm
    reach = distance_mm <= reach_mm
    if away is None:
        return NeighbourSeparation(reach)
    own = reach & (distance_mm <= away)
    if not np.any(cut.stapes & (away < _exchange_gap(sigma_mm))):
        return NeighbourSeparation(own)
    tight = reach & (distance_mm + away < _CLOSE_SIGMAS * sigma_mm)
    markers = cut.stapes.astype(np.int32) + 2 * cut.others.astype(np.int32)
    basins = flood_from_markers(cut.grey, markers, tight | (markers > 0))
    own = np.where(tight, basins == 1, own)
    close = cut.stapes & (away < _CLOSE_SIGMAS * sigma_mm)
    off: NDArray[np.float32] | None = None
    if np.any(cut.stapes & (away < _SHIFTED_SIGMAS * sigma_mm)):
        off = np.abs(distance_mm - away) / np.float32(0.5 * _CLOSE_SIGMAS * sigma_mm)
        off[~tight] = 1.0
    return _model(cut, (own, off), reach, close, reach_mm, spacing_mm, levels, sigma_mm)


def neighbour_share(cut: Cut, levels: tuple[float, float]) -> float:
    """Return the contrast of other bone inside, as a share of the stapes'; 1 where none is thick enough."""
    air, bone = levels
    deep = cut.grey[eroded(cut.others, 2)]
    if deep.size < _LEAST_DEEP:
        return 1.0
    share = float(np.clip((np.median(deep) - air) / (bone - air), *_NEIGHBOURS))
    return 1.0 if abs(share - 1.0) < _SAME_BONE else share


def _exchange_gap(sigma_mm: float) -> float:
    """Return the gap, mm, below which blur carries more than a thin layer of each body across its middle.

    Of a plane body the layer s (phi(z) - z Phi(-z)) lies further out than z widths s of the blur.
    """
    z = np.linspace(0.0, 0.5 * _CLOSE_SIGMAS, 251)
    layer = sigma_mm * (normal_density(z) - z * normal_cdf(-z))
    return 2.0 * sigma_mm * float(z[layer > _THIN_LAYER_MM].max(initial=0.0))


def _model(
    cut: Cut,
    border: tuple[NDArray[np.bool_], NDArray[np.float32] | None],
    reach: NDArray[np.bool_],
    close: NDArray[np.bool_],
    reach_mm: float,
    spacing_mm: Array,
    levels: tuple[float, float],
    sigma_mm: float,
) -> NeighbourSeparation:
    """Model both bodies on the two sides of a border, which is found anew where blur may have shifted it.

    ``border``: the stapes' side [z, y, x], and how far off it is, as a share of the most by which it
    may be shifted; None where blur shifts nothing.
    """
    (own, off), (air, bone) = border, levels
    margin = np.ceil((_CLOSE_SIGMAS * sigma_mm + reach_mm) / spacing_mm[::-1]).astype(int) + 2
    index = np.nonzero(close)
    box = tuple(
        slice(max(0, int(k.min()) - m), int(k.max()) + m + 1) for k, m in zip(index, margin, strict=True)
    )
    known, beside = np.ones(own[box].shape, dtype=bool), None
    if np.any(cut.plate[box]):
        known = capped_distance(cut.plate[box], spacing_mm, reach_mm) >= 0.999 * reach_mm
        beside = ~known & ~cut.plate[box]
    excess = cut.grey[box] - np.float32(air)
    # Bone of another density gets the stapes' height for the fit, and its tail its own height again.
    other = np.float32(neighbour_share(cut, levels))
    spacing = np.asarray(spacing_mm)[::-1]

    def fitted(side: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        alike = np.where(side, excess, excess / other)
        start = (bone - air, sigma_mm, 0.0, False, side)
        return alike, fit_bodies(alike, known, spacing_mm, *start, beside=beside).body

    alike, body = fitted(own[box])
    if off is not None:
        share = np.where(known, alike / np.float32(bone - air), blurred(body, sigma_mm, spacing))
        sharp = _sharpen(body, share, sigma_mm, spacing)
        free = off[box] < 1.0
        markers = np.where(free, 0, np.where(own[box], 1, 2 * (reach | cut.others)[box])).astype(np.int32)
        basins = flood_from_markers(sharp + np.float32(_HELD) * off[box], markers, free | (markers > 0))
        own = own.copy()
        own[box] = np.where(free, basins == 1, own[box])
        body = fitted(own[box])[1]
    mine = np.where(own[box], body, np.float32(0.0))
    foreign, behind = np.zeros_like(cut.grey), np.zeros_like(cut.grey)
    foreign[box] = np.where(own[box], other * blurred(body - mine, sigma_mm, spacing), np.float32(0.0))
    behind[box] = np.where(reach[box] & ~own[box], blurred(mine, sigma_mm, spacing), np.float32(0.0))
    return NeighbourSeparation(own, foreign, behind)


def _sharpen(
    body: NDArray[np.float32], share: NDArray[np.float32], sigma_mm: float, spacing: Array
) -> NDArray[np.float32]:
    """Undo part of the blur of shares [z, y, x], from a body of about their shape on.

    Notes
    -----
    Landweber's iteration (1951, Amer. J. Math. 73:615), held between air and bone.
    """
    for _ in range(_SHARPENINGS):
        rest = share - blurred(body, sigma_mm, spacing)
        body = np.clip(body + np.float32(_RELAXATION) * blurred(rest, sigma_mm, spacing), 0.0, 1.0)
    return body


@dataclass(frozen=True)
class ThroughBone:
    """Where the border runs through bone, which no gap in the grey values parts.

    Attributes
    ----------
    area_mm2 : float
        Of the border through voxels above the middle level.
    full_mm2 : float
        The same weighted by how full of bone the border is.
    covariance : ndarray, (10, 10)
        Of volume and moments.
    place_mm : ndarray, (3,), or None
        Middle of the largest connected patch, scan coordinates.
    at_neck : bool
        The border is a plane at a neck.
    """

    area_mm2: float
    full_mm2: float
    covariance: Array
    place_mm: Array | None
    at_neck: bool

    def notices(self, volume_mm3: float) -> list[Notice]:
        """Return the warnings about a cut through bone, and about a weakly determined end of the stapes."""
        if self.place_mm is None or self.area_mm2 < _LEAST_CUT_MM2:
            return []
        text = (
            f"The stapes was cut off other bone that it touches, over {self.area_mm2:.3f} mm2. Check the "
            f"cut in the report; where it is wrong, draw or correct labels by hand ({named('labels')})."
        )
        notices = [Notice("cut_through_bone", text)]
        share = float(np.sqrt(self.covariance[0, 0])) / volume_mm3
        if self.at_neck or share > _WEAK_SHARE:
            where = "at a neck, the narrowest section near its end" if self.at_neck else "across bridges"
            place = ", ".join(f"{v:.2f}" for v in self.place_mm)
            text = (
                f"Little shows where the stapes ends: {self.full_mm2:.3f} mm2 of the cut run through solid "
                f"bone, {where}, the largest patch around {place} mm (scan), and leave its volume uncertain "
                f"by {100.0 * share:.2g} %. Look at the cut in the report; where the stapes ends elsewhere, "
                f"draw it ({named('labels')})."
            )
            notices.append(Notice("separation_weak", text))
        return notices


def cut_through_bone(
    cut: Cut, parted: NeighbourSeparation, levels: tuple[float, float], volume: Volume, moments: Moments
) -> ThroughBone:
    """Return where the border runs through bone, and what that leaves uncertain.

    Parameters
    ----------
    cut : Cut
    parted : NeighbourSeparation
    levels : (air, bone)
    volume : Volume
    moments : Moments

    Notes
    -----
    The true end of the stapes inside a bridge is not in the grey values: each connected patch of the
    border is taken to be known to one voxel and 0.04 mm (standard deviation: a bridge leaves the stapes up to
    half a narrow gap from the middle of the gap, where it is cut), at a neck to 0.06 mm, independent of the
    others. Where blur alone fills a gap its middle stays darker than bone and shows the border: a voxel
    counts by the cube of its share of the way from the middle level to 90 % of bone.
    """
    air, full = levels
    middle = 0.5 * (air + full)
    bone = cut.grey > middle
    bodies = (cut.stapes | cut.others) & bone
    edge = parted.own & bodies & grow_mask(bodies & ~parted.own, corners=False)
    covariance = np.zeros((10, 10))
    if not np.any(edge):
        return ThroughBone(0.0, 0.0, covariance, None, cut.at_neck)
    patches, count = labelled(edge, corners=True)
    index = np.argwhere(edge)
    points = volume.scan_points(index[:, ::-1] + cut.first)
    weight = np.clip((cut.grey[edge].astype(float) - middle) / (_SOLID * (full - middle)), 0.0, 1.0) ** 3
    edge_mm = volume.voxel_mm3 ** (1.0 / 3.0)
    sd_mm = float(np.hypot(edge_mm, _NECK_SD_MM if cut.at_neck else _BRIDGE_SD_MM))
    steps = sensitivity(points - moments.centroid_mm, moments.volume_mm3, 0.0) * edge_mm**2 * sd_mm
    owner = patches[edge]
    for patch in range(1, count + 1):
        own = owner == patch
        step = weight[own] @ steps[own]
        covariance += np.outer(step, step)
    largest = int(np.argmax(np.bincount(owner, weight)))
    return ThroughBone(
        len(index) * edge_mm**2,
        float(weight.sum()) * edge_mm**2,
        covariance,
        points[owner == largest].mean(axis=0),
        cut.at_neck,
    )
