"""The motion of a planned measurement: points seen by three beams, noise of readings, errors of all lines."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from fitting.model import simulate
from fitting.plane import INPLANE_DOF, PISTON_DOF
from stapeskit.arrays import Array, ComplexArray
from stapeskit.frames import cross_matrix
from stapeskit.records.motion_file import RigidMotion, SharedErrors
from stapeskit.spatial import DOF_NAMES, point_rows, shifted_point_rows

if TYPE_CHECKING:
    from fitting.plan import Plan

_HEIGHT_MM, _INPLANE_RATIO = 0.15, 2.2  # of the ligament that is planned for: calibrated.toml, usual values
_PHASE_HZ = 5000.0  # frequency over which the phase of rocking turns by about a radian
_ROCKING_RADIUS_M = 1e-3  # where rotations are stated as displacements: about the rim of a footplate


STAPES_POINTS_MM = (
    *((1.2, 0.15, 0.0), (-1.2, 0.15, 0.0), (0.5, 0.15, 0.5), (0.5, 0.15, -0.5), (-0.5, 0.15, 0.5)),
    *((-0.5, 0.15, -0.5), (0.9, 1.5, 0.1), (-0.8, 1.6, -0.1), (0.1, 3.2, 0.2)),
)
BASE_POINTS_MM = tuple(
    (x, 0.3, z) for x, z in ((2.5, 0), (-2.5, 0), (0, 2), (0, -2), (2, 1.5), (-2, 1.5), (2, -1.5), (-2, -1.5))
)
"""Nine points on a stapes and eight on the bone around it, footplate frame."""


def cone_beams(cone_deg: float) -> Array:
    """Return three beams (3, 3), one a row, at an angle from the y axis and evenly spread around it."""
    cone, around = np.radians(cone_deg), np.radians([90.0, 210.0, 330.0])
    across = np.sin(cone) * np.column_stack([np.cos(around), np.sin(around)])
    return np.column_stack([across[:, 0], np.full(3, np.cos(cone)), across[:, 1]])


@dataclass(frozen=True)
class Layout:
    """Points that three laser heads see."""

    points_mm: Array  # (n, 3): about the footplate centre in footplate axes
    # (3, 3): directions towards the heads, one a row, footplate axes
    beams: Array = field(default_factory=lambda: cone_beams(20.0))

    @cached_property
    def directions(self) -> Array:
        """Directions of the readings (3 n, 3), point by point."""
        return np.tile(self.beams, (len(self.points_mm), 1))

    @cached_property
    def rows(self) -> Array:
        """Observation rows (3 n, 6), point by point."""
        return point_rows(np.repeat(np.asarray(self.points_mm) * 1e-3, 3, axis=0), self.directions)

    @cached_property
    def inverse(self) -> Array:
        """What takes readings to the six degrees of freedom by least squares, (6, 3 n)."""
        return np.asarray(np.linalg.pinv(self.rows))

    @property
    def determines(self) -> bool:
        """Whether the points determine all six degrees of freedom."""
        norms = np.linalg.norm(self.rows, axis=0)
        return bool(np.all(norms > 0.0) and np.linalg.svd(self.rows / norms, compute_uv=False)[-1] > 1e-6)

    def position_maps(self) -> Array:
        """Return the maps (3 n, 6, 6) of the motion by an error of 1 m of each coordinate of each point."""
        maps = []
        for reading in range(len(self.rows)):
            place, axis = divmod(reading, 3)
            shift = np.zeros((len(self.rows), 3))
            shift[3 * place : 3 * place + 3] = np.eye(3)[axis]
            maps.append(-self.inverse @ shifted_point_rows(self.directions, shift))
        return np.array(maps)

    def laser_maps(self) -> Array:
        """Return the maps (3, 6, 6) of the motion by a relative error of each laser."""
        return np.array([self.inverse[:, beam::3] @ self.rows[beam::3] for beam in range(3)])


def frame_maps() -> Array:
    """Return the maps (6, 6, 6) of the motion by a displacement of its frame, per m and rad."""
    maps = np.zeros((6, 6, 6))
    for axis, arm in enumerate(map(cross_matrix, np.eye(3))):
        maps[axis, :3, 3:] = maps[3 + axis, :3, :3] = maps[3 + axis, 3:, 3:] = -arm
    return maps


def six_dof_matrices(plan: Plan) -> tuple[Array, Array]:
    """Return K and D (6, 6) about the footplate centre of a ligament with the planned piston block.

    Its plane is at the usual height and as stiff in it as usual: Z_rc = Y Z_cc.
    """
    rows = [DOF_NAMES.index(name) for name in PISTON_DOF]
    columns = [DOF_NAMES.index(name) for name in INPLANE_DOF]
    coupling = np.zeros((3, 3))
    coupling[1, 1], coupling[2, 0] = 1e-3 * _HEIGHT_MM, -1e-3 * _HEIGHT_MM
    found = []
    for block in (np.array(plan.stiffness, dtype=float), np.array(plan.damping, dtype=float)):
        inside = np.diag([_INPLANE_RATIO, _INPLANE_RATIO, _INPLANE_RATIO * 1e-6]) * block[0, 0]
        whole = np.zeros((6, 6))
        whole[np.ix_(rows, rows)], whole[np.ix_(columns, columns)] = block, inside
        whole[np.ix_(rows, columns)] = coupling @ inside
        whole[np.ix_(columns, rows)] = (coupling @ inside).T
        found.append(whole)
    return found[0], found[1]


def planned_motion(plan: Plan, mass: Array) -> RigidMotion:
    """Return the motion of a plan, exact, with the covariance and shared errors that it will have."""
    freq = np.linspace(*plan.band_hz, plan.lines)
    omega, runs = 2.0 * np.pi * freq, len(plan.directions)
    stiffness, damping = six_dof_matrices(plan)
    q = np.empty((runs, 2, plan.lines, 6), dtype=complex)
    covariance = np.empty((runs, 2, plan.lines, 6, 6), dtype=complex)
    for run, direction in enumerate(plan.directions):
        q[run, 1] = _base_motion(plan, freq, direction)
        q[run, 0] = simulate(mass, stiffness, damping, freq, q[run, 1])
    for body, layout in enumerate(plan.layouts):
        own = layout.inverse @ layout.inverse.T
        covariance[:, body] = 2.0 * np.square(plan.noise_m_s / omega)[:, None, None] * own
    names, sds, maps, powers = _errors(plan)
    growth = (1j * omega)[None] ** np.array(powers)[:, None]
    derivatives = np.einsum("kl,kbij,rblj->krbli", growth, maps, q)
    shared = SharedErrors(tuple(names), np.diag(np.square(sds)), derivatives, maps, np.array(powers))
    none = np.zeros((runs, 2, plan.lines))
    labels = tuple(f"run {run + 1}, driven along {name}" for run, name in enumerate(plan.directions))
    return RigidMotion(labels, ("stapes", "base"), DOF_NAMES, freq, q, covariance, none, none, shared=shared)


def _errors(plan: Plan) -> tuple[list[str], list[float], ComplexArray, list[int]]:
    """Return names, sd, maps (p, body, 6, 6) and powers of i w of what all lines share."""
    found = list[tuple[str, float, ComplexArray, int]]()
    for axis, change in zip(DOF_NAMES, frame_maps(), strict=True):
        sd = 1e-3 * plan.registration_sd_mm if axis in "xyz" else float(np.radians(plan.registration_sd_deg))
        found.append((f"registration.{axis}", sd, np.stack([change, change]).astype(complex), 0))
    for body, layout in enumerate(plan.layouts):
        for number, change in enumerate(layout.position_maps()):
            both = np.zeros((2, 6, 6), dtype=complex)
            both[body] = change
            name = f"position.{body}_{number // 3}_{'xyz'[number % 3]}"
            found.append((name, 1e-3 * plan.position_sd_mm, both, 0))
    lasers = np.stack([layout.laser_maps() for layout in plan.layouts], axis=1).astype(complex)
    for laser, both in enumerate(lasers, 1):
        found.append((f"laser_gain.{laser}", 0.01 * plan.gain_sd_percent, both, 0))
        found.append((f"laser_phase.{laser}", float(np.radians(plan.phase_sd_deg)), 1j * both, 0))
        found.append((f"laser_delay.{laser}", 1e-6 * plan.delay_sd_us, -both, 1))
    there = [one for one in found if one[1] > 0.0]
    maps = np.array([both for _, _, both, _ in there]).reshape(-1, 2, 6, 6)
    return [one[0] for one in there], [one[1] for one in there], maps, [one[3] for one in there]


def _base_motion(plan: Plan, freq: Array, direction: str) -> ComplexArray:
    """Return the base motion (lines, 6): constant velocity along the driven direction, some in the others."""
    motion = np.empty((len(freq), 6), dtype=complex)
    for place, name in enumerate(DOF_NAMES):
        turning = np.exp(1j * (1.0 + place) * freq / _PHASE_HZ)
        share = np.ones_like(turning) if name == direction else plan.rocking * turning
        arm = _ROCKING_RADIUS_M if place > 2 else 1.0
        motion[:, place] = plan.base_velocity_m_s / (2.0 * np.pi * freq) * share / arm
    return motion
