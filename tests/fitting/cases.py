"""Simulated cases that the fitting tests share."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_DOF, PAPER_MASS, PAPER_STIFFNESS
from legacy.fitting.model.damping import VISCOUS, DampingLaw
from legacy.stapeskit.records.mass_record import MassMatrix
from legacy.stapeskit.records.motion import RigidMotion
from legacy.stapeskit.spatial import DOF_NAMES, matrix_from_parameters
from sample_volumes.shaken_stapes import driven_base, simulated_motion

K, D, M, DOF = PAPER_STIFFNESS, PAPER_DAMPING_CORRECTED, PAPER_MASS, PAPER_DOF
FREQ = np.linspace(400.0, 5000.0, 200)


def paper_motion(
    noise: float = 0.05, seed: int | None = 0, lines: int = 200, law: DampingLaw = VISCOUS
) -> RigidMotion:
    """The paper's stapes, base moved along y with 5 % rocking; exact when seed is None."""
    freq = np.linspace(400.0, 5000.0, lines)
    rng = None if seed is None else np.random.default_rng(seed)
    return simulated_motion(M, K, damping_for(law), DOF, freq, driven_base(freq, DOF), noise, rng, law)


def damping_for(law: DampingLaw) -> np.ndarray:
    """The paper's D, rescaled so that every law damps alike at 2.7 kHz."""
    return D * (2.0 * np.pi * 2700.0) ** (1.0 - law.time_power)


def six_dof_parameters() -> np.ndarray:
    """Ten inertial parameters of a stapes: 3.2 mg, centre of mass 1.3 mm above the footplate."""
    mass, centre = 3.2e-6, np.array([0.0447e-3, 1.3e-3, 0.1359e-3])
    central = np.array(
        [[4.2e-12, -0.1e-12, 0.05e-12], [-0.1e-12, 2.1e-12, 0.08e-12], [0.05e-12, 0.08e-12, 5.0e-12]]
    )
    tensor = central + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    entries = [tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 1], tensor[1, 2], tensor[0, 2]]
    return np.array([mass, *(mass * centre), *entries])


@lru_cache(maxsize=1)
def six_dof_matrices() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M, K, D of six degrees of freedom; the y, alpha, gamma block of K and D is the paper's."""
    mass = matrix_from_parameters(six_dof_parameters())
    places = [DOF_NAMES.index(name) for name in DOF]
    stiffness = np.diag([2600.0, 0.0, 3100.0, 0.0, 2.2e-3, 0.0])
    damping = np.diag([2.6e-2, 0.0, 3.0e-2, 0.0, 4.0e-8, 0.0])
    stiffness[np.ix_(places, places)] = K
    damping[np.ix_(places, places)] = D
    return mass, stiffness, damping


def six_dof_motion(noise: float, seed: int | None, directions: str = "y", lines: int = 200) -> RigidMotion:
    """The six degrees of freedom, the base driven along each of the directions in a run of its own."""
    mass, stiffness, damping = six_dof_matrices()
    freq = np.linspace(400.0, 5000.0, lines)
    base = np.concatenate([driven_base(freq, DOF_NAMES, name) for name in directions])
    rng = None if seed is None else np.random.default_rng(seed)
    return simulated_motion(mass, stiffness, damping, DOF_NAMES, freq, base, noise, rng)


def six_dof_mass(contributions: dict[str, np.ndarray] | None = None) -> MassMatrix:
    """The mass of the six degrees of freedom as ct2mass gives it."""
    return MassMatrix("footplate_centre", "footplate", six_dof_parameters(), contributions or {})
