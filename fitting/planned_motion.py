"""The motion of a planned measurement: six degrees of freedom, noise of its readings, errors of its lines."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fitting.layout import Layout, frame_maps
from fitting.plane import INPLANE_DOF, PISTON_DOF
from stapeskit.arrays import Array, ComplexArray
from stapeskit.records.motion import RigidMotion, SharedErrors
from stapeskit.spatial import DOF_NAMES

if TYPE_CHECKING:
    from fitting.plan import Plan

_HEIGHT_MM, _INPLANE_RATIO = 0.15, 2.2  # of the ligament that is planned for: calibrated.toml, usual values
_PHASE_HZ = 5000.0  # frequency over which the phase of rocking turns by about a radian
_ROCKING_RADIUS_M = 1e-3  # where rotations are stated as displacements: about the rim of a footplate


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


def planned_motion(plan: Plan, mass: Array, rng: np.random.Generator | None = None) -> RigidMotion:
    """Return the motion of a plan with covariance and shared errors; with ``rng`` all of them are drawn."""
    from fitting.model import simulate

    freq = np.linspace(*plan.band_hz, plan.lines)
    omega, runs = 2.0 * np.pi * freq, len(plan.directions)
    stiffness, damping = six_dof_matrices(plan)
    q = np.empty((runs, 2, plan.lines, 6), dtype=complex)
    covariance = np.empty((runs, 2, plan.lines, 6, 6), dtype=complex)
    names, sds, maps, powers = _errors(plan)
    drawn = np.zeros(len(names)) if rng is None else np.array(sds) * rng.standard_normal(len(names))
    for run, direction in enumerate(plan.directions):
        q[run, 1] = _base_motion(plan, freq, direction)
        q[run, 0] = simulate(mass, stiffness, damping, freq, q[run, 1])
        for body, layout in enumerate(plan.layouts):
            level = _noise(plan, layout, q[run, body], omega)
            inverse = layout.inverse
            covariance[run, body] = np.square(level)[:, None, None] * (inverse @ inverse.T)
            turn = np.eye(6) + np.einsum("k,kl,kij->lij", drawn, _growth(powers, omega), maps[:, body])
            q[run, body] = (turn @ q[run, body][..., None])[..., 0]
            if rng is not None:
                draws = rng.standard_normal((2, plan.lines, inverse.shape[1])) * np.sqrt(0.5)
                q[run, body] += level[:, None] * ((draws[0] + 1j * draws[1]) @ inverse.T)
    derivatives = np.einsum("kl,kbij,rblj->krbli", _growth(powers, omega), maps, q)
    shared = SharedErrors(tuple(names), np.diag(np.square(sds)), derivatives, maps, np.array(powers))
    none = np.full((runs, 2, plan.lines), np.nan)
    labels = tuple(f"run {run + 1}, driven along {name}" for run, name in enumerate(plan.directions))
    return RigidMotion(labels, ("stapes", "base"), DOF_NAMES, freq, q, covariance, none, none, shared=shared)


def _noise(plan: Plan, layout: Layout, q: ComplexArray, omega: Array) -> Array:
    """Return the root of E|noise|^2 of a reading, m."""
    if plan.noise_m_s is not None:
        return np.asarray(np.sqrt(2.0) * plan.noise_m_s / omega)
    velocity = (q * omega[:, None]) @ layout.rows.T
    return np.asarray(plan.noise_relative * np.sqrt(np.mean(np.abs(velocity) ** 2)) / omega)


def _growth(powers: list[int], omega: Array) -> ComplexArray:
    return np.asarray((1j * omega)[None] ** np.array(powers)[:, None])


def _errors(plan: Plan) -> tuple[list[str], list[float], ComplexArray, list[int]]:
    """Return names, sd, maps (p, body, 6, 6) and powers of i w of what all lines share."""
    names, sds, maps, powers = list[str](), list[float](), list[ComplexArray](), list[int]()

    def add(name: str, sd: float, both: NDArray[Any], power: int = 0) -> None:
        if sd > 0.0:
            names.append(name)
            sds.append(sd)
            maps.append(both.astype(complex))
            powers.append(power)

    for axis, change in zip(DOF_NAMES, frame_maps(), strict=True):
        sd = 1e-3 * plan.registration_sd_mm if axis in "xyz" else float(np.radians(plan.registration_sd_deg))
        add(f"registration.{axis}", sd, np.stack([change, change]))
    for body, layout in enumerate(plan.layouts):
        for number, change in enumerate(layout.position_maps()):
            both = np.zeros((2, 6, 6))
            both[body] = change
            add(f"position.{body}_{number // 3}_{'xyz'[number % 3]}", 1e-3 * plan.position_sd_mm, both)
    lasers = np.stack([layout.laser_maps() for layout in plan.layouts], axis=1)
    for laser, both in enumerate(lasers, 1):
        add(f"laser_gain.{laser}", 0.01 * plan.gain_sd_percent, both)
        add(f"laser_phase.{laser}", float(np.radians(plan.phase_sd_deg)), 1j * both)
        add(f"laser_delay.{laser}", 1e-6 * plan.delay_sd_us, -both, 1)
    return names, sds, np.array(maps).reshape(-1, 2, 6, 6), powers


def _base_motion(plan: Plan, freq: Array, direction: str) -> ComplexArray:
    """Return the base motion (lines, 6): constant velocity along the driven direction, some in the others."""
    motion = np.empty((len(freq), 6), dtype=complex)
    for place, name in enumerate(DOF_NAMES):
        share: Any = (
            1.0 if name == direction else plan.rocking * np.exp(1j * (1.0 + place) * freq / _PHASE_HZ)
        )
        arm = _ROCKING_RADIUS_M if place > 2 else 1.0
        motion[:, place] = plan.base_velocity_m_s / (2.0 * np.pi * freq) * share / arm
    return motion
