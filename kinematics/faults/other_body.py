"""Points at fault that move with another body: their rows bear the wrong name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from kinematics.faults.search import Diagnosis
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import Measurement
from stapeskit.arrays import Array
from stapeskit.faults import list_some
from stapeskit.spatial import dof_indices, point_rows
from stapeskit.warnings import Notice

_CURED = 0.1  # share of the squares that the motion of the other body may leave


def points_of_other_bodies(
    placed: Measurement, fits: Mapping[tuple[int, int], LineFit], diagnoses: Mapping[int, Diagnosis]
) -> Iterator[Notice]:
    """Return the points at fault that move with another body.

    Parameters
    ----------
    placed : Measurement
        About the reference point.
    fits : mapping of (run, body) to LineFit
    diagnoses : mapping of int to Diagnosis
        By body.
    """
    bodies = range(len(placed.bodies))
    for number, found in diagnoses.items():
        body = placed.bodies[number]
        accused = {c for one in found.findings if one.owner in ("channel", "point") for c in one.channels}
        left = [_squares(placed, fits, number, other) for other in bodies] if accused else []
        for other in bodies if accused else ():
            points = []
            for point in dict.fromkeys(body.points[channel] for channel in sorted(accused)):
                own = body.channels_of(point)
                if np.sum(left[other][own]) < _CURED * np.sum(left[number][own]):
                    points.append(point)
            if points:
                text = (
                    f"{list_some(points)} of body {body.body} move as body {placed.bodies[other].body} does"
                )
                yield Notice(
                    "channel_label_swap", f"points {text} at their positions: their rows belong to it."
                )


def _squares(placed: Measurement, fits: Mapping[tuple[int, int], LineFit], number: int, mover: int) -> Array:
    """Return what the motion of one body leaves of the values of another, (c,), over their noise."""
    body = placed.bodies[number]
    total = np.zeros(len(body.points))
    for run in range(len(placed.runs)):
        own, other = fits[run, number], fits[run, mover]
        rows = point_rows(body.arms_m, body.directions)[:, dof_indices(other.beams.dof)]
        left = own.value - rows @ (other.q.T * placed.per_displacement)
        sd = own.sd * own.factor
        used = np.isfinite(left) & np.isfinite(sd)
        total += np.sum(np.abs(np.where(used, left, 0.0) / np.where(used, sd, 1.0)) ** 2, axis=1)
    return total
