"""Grey values of bare bone: plate, coat, fluid in voids and anything soft subtracted, with their budget."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.grey.air_level import Guess
from legacy.ct_inertia.grey.bone_level import Bone
from legacy.ct_inertia.grey.grey_scale import bend_of_scale, with_bent_scale
from legacy.ct_inertia.grey.neighbours import away_from_others
from legacy.ct_inertia.grey.partial_volume import with_contribution
from legacy.ct_inertia.grey.plate_face import FaceFit, displaced_share, face_near, plate_share
from legacy.ct_inertia.grey.plate_face_uncertainty import face_covariance, face_doubt
from legacy.ct_inertia.grey.preparation import Prepared, blur_of
from legacy.ct_inertia.grey.soft_coat import (
    USUAL,
    Coat,
    CoatImage,
    coat_image,
    with_coat_sd,
    with_suspected_coat,
)
from legacy.ct_inertia.grey.soft_tissue import (
    SoftTissue,
    soft_notices,
    soft_tissue_covariance,
    subtract_soft_tissue,
    taken_off,
)
from legacy.ct_inertia.grey.voids import Voids, closed_voids, empty_voids, filling_covariance, void_notices
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.warnings import Notice

Field = NDArray[np.float32]
# Standard deviation of the point spread, its standard uncertainty (mm), and where it comes from.
Blur = tuple[float, float, str]

_SAME_BLUR = calibrated("measure.same_blur")
_OTHER_BLUR = calibrated("measure.other_blur")
_PLATE_DOUBT = calibrated("measure.plate_doubt")
_FACE_BLUR_SD = calibrated("measure.face_blur_sd")


@dataclass(frozen=True)
class BareBone:
    """Grey values of the bone as if in air, and the images of its surroundings that were subtracted.

    Attributes
    ----------
    cut : Cut
    blur : (float, float, str)
    reach_mm : float
        How far the stapes' blur reaches.
    distance_mm : ndarray of float32, [z, y, x]
        From the stapes.
    away_mm : ndarray of float32, [z, y, x], or None
        From other bone, where that is near.
    face : FaceFit or None
        The plate's face, where one was fitted.
    displaced : ndarray of float32, [z, y, x], or None
        Grey values given back where bone displaces the plastic.
    coat, suspected : CoatImage or None
        The coat that was stated, or the usual one where edges look coated and none was stated.
    bend : ndarray of float32, [z, y, x], or None
        By how much shares are too bright if the asymmetry of edges comes from the grey scale.
    voids : Voids or None
    soft : SoftTissue or None
    unfitted_plate : bool
        Plastic touches the stapes and has no face: it was subtracted like soft tissue.
    """

    cut: Cut
    blur: Blur
    reach_mm: float
    distance_mm: Field
    away_mm: Field | None
    face: FaceFit | None
    displaced: Field | None
    coat: CoatImage | None
    suspected: CoatImage | None
    bend: Field | None
    voids: Voids | None
    soft: SoftTissue | None
    unfitted_plate: bool

    def with_budget(
        self, moments: Moments, own: NDArray[np.bool_], volume: Volume, contrast: float
    ) -> tuple[Moments, tuple[Notice, ...]]:
        """Return the moments with the uncertainty of each subtracted medium, and warnings.

        Parameters
        ----------
        moments : Moments
        own : ndarray of bool, [z, y, x]
            Voxels over which was integrated.
        volume : Volume
        contrast : float
            Bone minus air.
        """
        notices: list[Notice] = []
        if self.soft is not None:
            covariance = soft_tissue_covariance(self.soft, own, self.cut, volume, moments)
            moments = with_contribution(moments, "surroundings", covariance)
            notices += soft_notices(self.soft, own, volume, moments)
        if self.voids is not None and self.voids.sd > 0.0:
            covariance = filling_covariance(self.voids, self.cut, volume, moments)
            moments = with_contribution(moments, "voids", covariance)
            notices += void_notices(self.voids, volume, moments)
        if self.coat is not None:
            moments = with_coat_sd(self.coat, own, self.cut, volume, moments)
        if self.suspected is not None:
            moments, notice = with_suspected_coat(self.suspected, own, self.cut, volume, moments)
            notices.append(notice)
        if self.bend is not None:
            moments, notice = with_bent_scale(self.bend, own, self.cut, volume, moments)
            notices.append(notice)
        if self.face is not None:
            covariance = face_covariance(
                self.face, volume, self.cut, self._is_within_reach, contrast, moments, self.displaced
            )
            moments = with_contribution(moments, "plate", covariance)
        return moments, tuple(notices)

    def coat_share(self, own: NDArray[np.bool_], volume: Volume, moments: Moments) -> float | None:
        """Return the volume of the stated coat's image over that of the stapes; None without one."""
        if self.coat is None:
            return None
        return float(self.coat.share[own].sum(dtype=float)) * volume.voxel_mm3 / moments.volume_mm3

    def doubt(self, own: NDArray[np.bool_], volume: Volume, contrast: float) -> Field | None:
        """Return by how much the share of bone [z, y, x] may be wrong at once; None without cause."""
        parts: list[Field] = []
        if self.soft is not None:
            parts.append(self.soft.doubt * np.float32(_PLATE_DOUBT if self.unfitted_plate else 1.0))
        if self.coat is not None:
            parts.append(self.coat.doubt)
        if self.suspected is not None:
            parts.append(self.suspected.share)
        if self.bend is not None:
            parts.append(self.bend)
        if self.face is not None:
            plate = face_doubt(self.face, volume, self.cut, self._is_within_reach, contrast)
            parts += [] if plate is None else [plate]
        return np.where(own, sum(parts[1:], parts[0]), np.float32(0.0)) if parts else None

    @property
    def _is_within_reach(self) -> NDArray[np.bool_]:
        return np.asarray(self.distance_mm <= self.reach_mm)


def bare_bone(
    volume: Volume, ready: Prepared, bone: Bone, blur: Blur, fitted: bool, guess: Guess, coat: Coat | None
) -> BareBone:
    """Subtract from the grey values all that surrounds the stapes and is not air.

    Parameters
    ----------
    volume : Volume
    ready : Prepared
    bone : Bone
    blur : (float, float, str)
    fitted : bool
        The blur is that of a fit of body and level, which edges show no better.
    guess : Guess
    coat : Coat or None
        As stated.

    Notes
    -----
    In turn: the plate by its fitted face; the coat by its image, as stated or as the usual one where edges
    look coated; fluid in closed voids; then what is left and neither air nor bone. A plate without a face is
    subtracted like something soft.
    """
    spacing = volume.spacing_mm
    air, distance, reach = ready.air, ready.distance_mm, ready.reach_mm
    contrast = bone.level - air.level
    cut, face, displaced = _without_plate(volume, ready, (air.level, guess.plastic, blur[0]), bone.level)
    if face is not None and abs(face.face.sigma_mm / blur[0] - 1.0) < _SAME_BLUR:
        blur = (face.face.sigma_mm, _FACE_BLUR_SD * face.face.sigma_mm, "face of the plate")
    near = distance < 1.99 * reach
    stated: CoatImage | None = None
    if coat is not None and coat.thickness_mm > 0.0:
        stated = coat_image(cut, coat, near, spacing, (air.level, bone.level), blur[0])
        cut = replace(cut, grey=cut.grey - np.float32(contrast) * stated.share)
    edges = ready.edges
    skewness, long_tails = 0.0, False
    # What moved, and what was sharpened, has edges that are not symmetric either.
    if edges is not None and not ready.overshoot and not edges.uneven:
        skewness, long_tails = edges.departures(air.level, bone.level_at, bone.sd)
    suspected: CoatImage | None = None
    if coat is None and (long_tails or skewness > 0.0):
        suspected = coat_image(cut, USUAL, near, spacing, (air.level, bone.level), blur[0])
    away = away_from_others(cut, distance, reach, spacing, blur[0])
    unfitted = face is None and bool(np.any(cut.plate & (distance <= reach)))
    voids = closed_voids(cut, spacing, (air, bone.level), blur[:2])
    if voids is not None and voids.filled:
        cut = replace(cut, grey=empty_voids(cut, voids, contrast))
    soft: SoftTissue | None = None
    if unfitted:
        soft = taken_off(cut, (distance, away), reach, spacing, (air, bone.level), blur[0])
    else:
        known = (air, bone.level, guess.between)
        soft = subtract_soft_tissue(cut, (distance, away), reach, spacing, known, blur[0])
    if soft is not None:
        # Edges in something soft are less high and looked blurred otherwise: once more without it.
        clear = blur_of(replace(cut, grey=soft.grey), ready.rim, (air.level, bone.level), spacing, air.noise)
        if not fitted and abs(clear[0] / blur[0] - 1.0) > _OTHER_BLUR:
            blur = clear
            soft = taken_off(cut, (distance, away), reach, spacing, (air, bone.level), blur[0])
        cut = replace(cut, grey=soft.grey)
    bend: Field | None = None
    if skewness < 0.0 or (skewness > 0.0 and stated is None and suspected is None):
        share = (cut.grey - np.float32(air.level)) / np.float32(contrast)
        bend = bend_of_scale(share, skewness, air.noise / contrast)
    return BareBone(
        cut, blur, reach, distance, away, face, displaced, stated, suspected, bend, voids, soft, unfitted
    )


def _without_plate(
    volume: Volume, ready: Prepared, start: tuple[float, float | None, float], bone: float
) -> tuple[Cut, FaceFit | None, Field | None]:
    """Subtract the plate's blurred face from the grey values near the stapes; its mask ends there, too.

    The third value holds the grey values given back where bone displaces the plastic.
    """
    (air, plastic, sigma), cut = start, ready.cut
    if plastic is None:
        return cut, None, None
    fit = face_near(volume, cut, ready.distance_mm, ready.reach_mm, (air, plastic, sigma))
    if fit is None:
        return cut, None, None
    face = fit.face
    # What is soft around the stapes is looked for within twice the reach.
    near = ready.distance_mm < 1.99 * ready.reach_mm
    grey = cut.grey.copy()
    grey[near] -= plate_share(face, volume, cut, near).astype(np.float32)
    missing = displaced_share(face, volume, cut, grey - np.float32(air), bone - air, near)
    if missing is not None:
        grey[near] += missing[near]
    return replace(cut, grey=grey, plate=cut.plate & ~near), fit, missing
