"""Errors that all lines of a planned measurement will share: points, registration, lasers, and the mass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.fitting.errors import FittingError
from legacy.fitting.model.point_layout import Layout
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.frames import cross_matrix
from legacy.stapeskit.option_declaration import option
from legacy.stapeskit.option_kinds import number
from legacy.stapeskit.options import OptionTable
from legacy.stapeskit.records.motion import SharedErrors
from legacy.stapeskit.spatial import dof_indices

_AXES = "xyz"


_SD = number("a number, zero or positive", lambda value: value >= 0.0)


@dataclass(frozen=True)
class PlannedErrors(OptionTable):
    """Standard deviations of what stays the same over the lines, keys of plan.toml; 0 means exact."""

    title = "plan"
    error = FittingError

    position_sd_mm: float = option(_SD, "of each coordinate of a point", 0.03)
    registration_sd_mm: float = option(_SD, "of the footplate centre in the vibrometer", 0.02)
    registration_sd_deg: float = option(_SD, "of the footplate axes in it", 0.1)
    gain_sd_percent: float = option(_SD, "of each laser, with the next two", 1.0)
    phase_sd_deg: float = option(_SD, "", 0.5)
    delay_sd_us: float = option(_SD, "", 1.0)
    mass_sd_percent: float = option(_SD, "density; leave it out beside a mass.json", 3.0)


def shared_errors(
    errors: PlannedErrors,
    dof: tuple[str, ...],
    layouts: tuple[Layout, ...],
    freq_hz: Array,
    q: ComplexArray,
) -> SharedErrors:
    """Return how the common errors move the rigid motion that least squares gives.

    Parameters
    ----------
    dof : tuple of str, (n,)
    layouts : tuple of Layout
        Points of each body; each is seen along three axes, by one laser an axis.
    freq_hz : ndarray, (lines,)
    q : ndarray, (runs, bodies, lines, n), complex
        True motion.

    Notes
    -----
    A reading is u = d . (T + theta x p). An error e of the readings moves q by pinv(A) e; that of a point is
    d . (theta x dp), that of a laser its own readings times the relative gain, i phase or -i w delay. In a
    frame whose centre is off by s and which is turned by r the same motion has T - theta x s + r x T and
    theta + r x theta.
    """
    places = dof_indices(dof)
    twist = np.zeros((*q.shape[:-1], 6), dtype=complex)
    twist[..., places] = q
    names: list[str] = []
    sds: list[float] = []
    derivatives: list[NDArray[Any]] = []

    def add(name: str, sd: float, derivative: NDArray[Any]) -> None:
        if sd > 0.0:
            names.append(name)
            sds.append(sd)
            derivatives.append(derivative)

    for axis in range(3):
        turn = cross_matrix(np.eye(3)[axis])
        moved = np.zeros_like(twist)
        # -theta x s = s x theta
        moved[..., :3] = twist[..., 3:] @ turn.T
        add(f"registration.{_AXES[axis]}", 1e-3 * errors.registration_sd_mm, moved[..., places])
        turned = np.concatenate([twist[..., :3] @ turn.T, twist[..., 3:] @ turn.T], axis=-1)
        add(f"registration.turn_{_AXES[axis]}", np.radians(errors.registration_sd_deg), turned[..., places])
    for body, layout in enumerate(layouts):
        inverse = layout.inverse(dof)
        for point in range(len(layout.points_mm)):
            for axis in range(3):
                # d . (theta x dp) for d along x, y and z is (theta x dp) itself
                by_turn = inverse[:, 3 * point : 3 * point + 3] @ cross_matrix(np.eye(3)[axis]).T
                moved = np.zeros_like(q)
                moved[:, body] = twist[:, body, :, 3:] @ by_turn.T
                add(f"position.{body}.{point}.{_AXES[axis]}", 1e-3 * errors.position_sd_mm, moved)
    late = -2j * np.pi * freq_hz[:, None]
    for axis in range(3):
        parts = [layout.inverse(dof)[:, axis::3] @ layout.rows()[axis::3] for layout in layouts]
        read = np.stack([twist[:, body] @ part.T for body, part in enumerate(parts)], axis=1)
        add(f"laser_gain.{_AXES[axis]}", 1e-2 * errors.gain_sd_percent, read)
        add(f"laser_phase.{_AXES[axis]}", np.radians(errors.phase_sd_deg), 1j * read)
        add(f"laser_delay.{_AXES[axis]}", 1e-6 * errors.delay_sd_us, late * read)
    stacked = np.array(derivatives) if derivatives else np.zeros((0, *q.shape), dtype=complex)
    return SharedErrors(tuple(names), np.diag(np.square(sds)), stacked)
