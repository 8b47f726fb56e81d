"""`stapeskit.points2dof`: the command points2dof as a function."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kinematics.options import NONE, MotionOptions
from kinematics.results import MotionResult
from stapeskit.options import with_options
from stapeskit.records.measured_mass import MassInput, measured_mass


@with_options(MotionOptions)
def points2dof(
    ldv: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    mass: MassInput | None = None,
    **options: Any,
) -> MotionResult:
    """Find the motion of rigid bodies about the footplate centre from what the beams read.

    Files that are not given are looked for beside the first vibrometer file: points.csv, fiducials.csv, and
    mass.json or the only ``*_mass/mass.json``; ``points="none"`` and the like turn one off.

    Parameters
    ----------
    ldv : path or sequence of paths
        Vibrometer files.
    mass : path or result of ct2mass, optional
        Frames and surfaces of the scan.

    Raises
    ------
    StapeskitError
        An option is unknown (the nearest is named), or options or files are at fault; all of it together.

    Examples
    --------
    >>> motion = points2dof("ldv.csv", mass=mass)  # doctest: +SKIP
    """
    from kinematics.companions import with_companions
    from kinematics.points2dof import measure_motion

    files = [ldv] if isinstance(ldv, str | os.PathLike) else list(ldv)
    chosen = MotionOptions.of(ldv=[Path(file) for file in files], **options)
    file = Path(mass) if isinstance(mass, str | os.PathLike) else None
    found = with_companions(chosen, NONE if mass is not None and file is None else file)
    source = found.mass if mass is None or file is not None else mass
    known = None if source is None else measured_mass(source)
    return measure_motion(found.options, known, command=["stapeskit.points2dof"], taken=found.taken)
