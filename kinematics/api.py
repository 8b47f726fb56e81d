"""`stapeskit.points2dof` and `stapeskit.read_vibrometer`: the command as a function, and its reader."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kinematics.options import NONE, MotionOptions
from kinematics.results import MotionResult
from stapeskit.options import with_options
from stapeskit.records.mass_file import MassInput, read_mass

if TYPE_CHECKING:
    from kinematics.readers.recording import Recording


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
    from kinematics.inputs import with_companions
    from kinematics.points2dof import measure_motion

    files = [ldv] if isinstance(ldv, str | os.PathLike) else list(ldv)
    chosen = MotionOptions.of(ldv=[Path(file) for file in files], **options)
    file = Path(mass) if isinstance(mass, str | os.PathLike) else None
    found = with_companions(chosen, NONE if mass is not None and file is None else file)
    source = found.mass if mass is None or file is not None else mass
    known = None if source is None else read_mass(source)
    return measure_motion(found.options, known, command=["stapeskit.points2dof"], taken=found.taken)


def read_vibrometer(
    path: str | Path,
    *,
    channels: str | Path | None = None,
    n_avg: float | None = None,
) -> Recording:
    """Read a vibrometer file: Polytec scan, UFF, PSV text, MATLAB, HDF5, CSV, time series.

    Parameters
    ----------
    path : path
        A file, or a folder of text exports.
    channels : path, optional
        Table of the channels of time series.
    n_avg : float, optional
        Averages behind each value, where the file does not say them: with the coherence they give the noise.

    Returns
    -------
    Recording
        ``freq_hz`` (L,), ``points_m`` (P, 3), ``directions`` (P, 3), ``frf`` or ``velocity`` (P, L)
        complex, ``coherence`` (P, L) or None, ``sd`` (P, L) or None, ``units``, ``reference``;
        ``to_frame()``, ``plot()``.
        What the file does not say, such as peak or rms, is in ``lacks`` and, with what was assumed, in
        ``notices``.

    Raises
    ------
    StapeskitError
        The file is missing, damaged, of no known format, or holds no motion with a phase.
    """
    from kinematics.readers.formats import read_file
    from kinematics.readers.stated_by_user import FileFacts

    return read_file(
        Path(path), FileFacts(n_avg=n_avg, channels=None if channels is None else Path(channels))
    )
