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
    """Return the points at fault that move with another body; fits by (run, body), diagnoses by body."""
    for number, found in diagnoses.items():
        body = placed.bodies[number]
        accused = {c for one in found.findings if one.owner in ("channel", "point") for c in one.channels}
        points = list(dict.fromkeys(body.points[channel] for channel in sorted(accused)))
        alone = _squares(placed, fits, number, number) if points else np.zeros(0)
        for other, mover in enumerate(placed.bodies if points else ()):
            left = _squares(placed, fits, number, other)
            own = {point: body.channels_of(point) for point in points}
            moved = [
                point for point in points if np.sum(left[own[point]]) < _CURED * np.sum(alone[own[point]])
            ]
            if moved:
                text = (
                    f"points {list_some(moved)} of body {body.body} move as body {mover.body} does at their"
                )
                yield Notice("channel_label_swap", f"{text} positions: their rows belong to it.")


def _squares(placed: Measurement, fits: Mapping[tuple[int, int], LineFit], number: int, mover: int) -> Array:
    """Return what the motion of one body leaves of the values of another, (c,), over their noise."""
    body = placed.bodies[number]
    total = np.zeros(len(body.points))
    for run in range(len(placed.runs)):
        own, other = fits[run, number], fits[run, mover]
        rows = point_rows(body.arms_m, body.directions)[:, dof_indices(other.beams.dof)]
        left = own.value - rows @ (other.q.T * placed.per_displacement)
        total += np.nansum(np.abs(left / (own.sd * own.factor)) ** 2, axis=1)
    return total
