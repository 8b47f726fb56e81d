"""The small inputs of `ct2mass`: landmarks, fiducials of the plate, calibration; read before the scan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from legacy.ct_inertia.frames.anatomy import AnatomyHints
from legacy.stapeskit.arrays import Array

if TYPE_CHECKING:
    from legacy.ct_inertia.frames.plate_fiducials import PlateFiducials
    from legacy.ct_inertia.mass.calibration import Calibration
    from legacy.ct_inertia.options import MassOptions


@dataclass(frozen=True)
class SmallInputs:
    """What a person knows about the ear and the plate, and the line from grey values to density."""

    hints: AnatomyHints
    fiducials: PlateFiducials | None
    calibration: Calibration | None


def read_small_inputs(options: MassOptions) -> SmallInputs:
    """Read the files of the options other than the scan and its labels.

    Raises
    ------
    CtInertiaError
        What is wrong with them.
    """
    landmarks: dict[str, Array] = {}
    if options.landmarks is not None:
        from legacy.ct_inertia.frames.landmarks import read_landmarks

        landmarks = read_landmarks(options.landmarks)
    anterior = None if options.anterior is None else np.array(options.anterior, dtype=float)
    hints = AnatomyHints(anterior, landmarks, options.side)
    fiducials = None
    if options.plate_fiducials is not None:
        from legacy.ct_inertia.frames.plate_fiducials import read_plate_fiducials

        fiducials = read_plate_fiducials(options.plate_fiducials)
    calibration = None
    if options.calibration is not None:
        from legacy.ct_inertia.mass.calibration import read_calibration

        calibration = read_calibration(options.calibration)
    return SmallInputs(hints, fiducials, calibration)
