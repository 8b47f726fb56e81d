"""`stapeskit.points2dof`: the command points2dof as a function."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legacy.stapeskit.faults import translate_option_names
from legacy.stapeskit.option_names import as_keyword

if TYPE_CHECKING:
    from legacy.kinematics.results import MotionResult
    from legacy.stapeskit.records.measured_mass import MassInput


@translate_option_names(as_keyword)
def points2dof(
    ldv: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    mass: MassInput | None = None,
    **options: Any,
) -> MotionResult:
    """Find the motion of rigid bodies about the footplate centre from what the beams read.

    Parameters
    ----------
    ldv : path or sequence of paths
        Vibrometer files.
    mass : path or result of ct2mass, optional
        Frames and surfaces of the scan.
    **options
        The options of the command points2dof by their names: ``points``, ``fiducials``, ``frame``, ``dof``,
        ``reference``, ``robust``, ``calibrate`` ...

    Raises
    ------
    StapeskitError
        An option is unknown (the nearest is named), or options or files are at fault; all of it together.

    Examples
    --------
    >>> motion = points2dof("ldv.csv", points="points.csv", mass=mass)  # doctest: +SKIP
    """
    from legacy.kinematics.measure_motion import measure, motion_inputs
    from legacy.kinematics.options import LdvOptions

    files = [ldv] if isinstance(ldv, str | os.PathLike) else list(ldv)
    chosen = LdvOptions.of(ldv=[Path(file) for file in files], **options)
    return measure(chosen, motion_inputs(chosen), Path(mass) if isinstance(mass, str) else mass)
