"""From recordings of one or several files to one measurement: bodies, positions, lines, all checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from kinematics.errors import KinematicsError, sentence
from kinematics.measurement import Measurement
from kinematics.points_csv import Points
from kinematics.readers.recording import Recordings


def assemble(
    files: Sequence[Recordings],
    points: Points | None = None,
    bodies: Mapping[str, Sequence[str]] | None = None,
    frame: str = "vibrometer",
) -> Measurement:
    """Put the recordings of one or several files together.

    Parameters
    ----------
    files : sequence of Recordings
    points : Points, optional
        Positions from a points file; they complete and must not contradict those of the files.
    bodies : mapping of str to sequence of str, optional
        Names of the points of every body.
    frame : str
        Frame of positions and directions.

    Raises
    ------
    KinematicsError
        Anything missing or contradictory; all faults together.
    """
    raise KinematicsError(sentence("the recordings", "of one point at least", "none"))
