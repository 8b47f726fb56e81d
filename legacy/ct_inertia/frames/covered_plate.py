"""The plate's face where bone, glue or fluid covers so much of it that its own surface misleads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from legacy.ct_inertia.bodies import PlateFace
from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.frames.plane_faces import PlaneFace
from legacy.ct_inertia.frames.plane_fit import fit_to_grey_values
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

# Cosine and distance up to which the face beside the stapes is the same as that of the plate.
_SAME_WAY, _SAME_PLACE_MM = 0.97, 0.4
_COVERED_MM = calibrated("plate_covered.height_mm")
_COVERED_RAD = calibrated("plate_covered.tilt_rad")


def covered_face(
    main: PlaneFace, faces: Sequence[PlaneFace], near: PlateFace | None, volume: Volume, sigma_mm: float
) -> tuple[PlaneFace, tuple[Notice, ...]]:
    """Place a face whose visible part is too small for a fit at its visible voxels next to the stapes.

    Parameters
    ----------
    main : PlaneFace
        As the surface of the plate has it.
    faces : sequence of PlaneFace
        All plane faces of the plate.
    near : PlateFace or None
        The face as fitted beside the stapes.
    volume : Volume
    sigma_mm : float
        Standard deviation of the blur.

    Returns
    -------
    face : PlaneFace
    notices : tuple of Notice
        Empty when the face could be fitted from there; otherwise what is uncertain, which is in the face's
        covariance.
    """
    if near is not None:
        off = near.offset_mm - float(near.normal @ main.point_mm)
        if near.normal @ main.normal > _SAME_WAY and abs(off) < _SAME_PLACE_MM:
            basis = np.linalg.svd(near.normal[None, :])[2][1:].T
            start = replace(main, normal=near.normal, point_mm=main.point_mm + off * near.normal, basis=basis)
            others = [face for face in faces if face is not main]
            fitted = fit_to_grey_values([start], others, volume, sigma_mm)[0]
            if fitted is not start:
                return fitted, ()
            main = start
    doubt = np.diag(np.square([_COVERED_MM, _COVERED_RAD, _COVERED_RAD]))
    text = (
        "The plate's face could not be fitted to the grey values (bone, glue or fluid covers it): its "
        f"place is uncertain by {1e3 * _COVERED_MM:.0f} um, its normal by "
        f"{np.degrees(_COVERED_RAD):.1f} degrees (standard deviation). Give {named('plate_fiducials')}."
    )
    return replace(main, covariance=main.covariance + doubt), (Notice("plate_face_covered", text),)
