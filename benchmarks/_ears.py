"""Ears whose ligament is a ring, with every error that an experimenter has, for the benchmarks of fitting.

Drawn are the ring, its plane and loss, the mass, the motion of the bone, noise, positions (30 um), the pose
of the footplate (30 um, 0.3 degrees), density (2 %) and centre of mass (6 um). One error of a known size may
be added.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from fitting.dof2kd import dof2kd
from fitting.result import KDFit
from simulate import (
    Ear,
    Experiment,
    Ligament,
    base_motion,
    damped_alike,
    draw_ring,
    draw_uneven_ring,
    measure_motion,
    motion_of,
    point_mass,
    ring_ligament,
    stapes_motion,
)
from simulate.points import bone_points, visible_points
from simulate.vibrometer import laser_directions, vibrometer_pose
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import StapeskitError
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.records.rigid_motion import RigidMotion
from stapeskit.spatial import dof_indices, matrix_from_parameters

LINES = 120  # of an ear, as version 0.2 had: the tables are compared with its
ALARMS = {"misfit", "cause_found", "fluid_found", "frequency_dependent"}
POSITION_SD_MM, REGISTRATION_SD = 0.03, (30e-6, float(np.radians(0.3)))
DENSITY_SD, CENTRE_SD_M = 0.02, 6e-6
_PISTON = np.ix_(*[dof_indices(("y", "alpha", "gamma"))] * 2)
_UPPER = np.triu_indices(3)
_HEAD_MM = (0.1, 3.3, 0.1)


@dataclass(frozen=True, kw_only=True)
class RingEar:
    """How an ear is drawn."""

    height_mm: float | None = 0.1  # of the plane of an even ring; None: an uneven one, as expected beforehand
    noise: float = 0.01  # of a channel over its root mean square
    law: str = "viscous"
    cause: str = ""  # one error of what the experimenter is given, or of the ligament, and its size
    size: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """What the experimenter has, and the true entries of K and D (12,) for y, alpha, gamma."""

    motion: RigidMotion
    mass: MassMatrix
    truth: Array

    def fit(self, **options: object) -> KDFit | None:
        """Return the fit; None where it is refused."""
        try:
            return dof2kd(self.motion, mass=self.mass, **options)
        except StapeskitError:
            return None

    def deviations(self, fit: KDFit) -> Array:
        """Return the errors of K and D (12,) over their standard deviation."""
        return np.asarray((fit.values - self.truth) / np.sqrt(np.diag(fit.covariance)))

    def relative_errors(self, fit: KDFit) -> Array:
        """Return the errors over sqrt(Xii Xjj), (12,)."""
        sizes = []
        for part in (self.truth[:6], self.truth[6:]):
            root = np.sqrt(part[[0, 3, 5]])
            sizes.append(np.outer(root, root)[_UPPER])
        return np.asarray((fit.values - self.truth) / np.concatenate(sizes))


@cache
def _places() -> tuple[dict[str, Array], object]:
    """Return true points of both bodies (mm) and the pose of the vibrometer; one experimenter chose them."""
    pose = vibrometer_pose(np.random.default_rng(3))
    beams = pose.inverse().vectors(laser_directions(3, 30.0))
    solid = Ear().solid
    return {"stapes": visible_points(solid, 10, beams), "base": bone_points(solid, 9)}, pose


@cache
def _usual_mass() -> tuple[float, ...]:
    return tuple(Ear().mass().parameters())


def _ligament(ear: RingEar, rng: np.random.Generator) -> Ligament:
    ring = draw_uneven_ring(rng) if ear.height_mm is None else draw_ring(rng, ear.height_mm)
    changes = {
        "drift": {"drift": 0.01 * ear.size},
        "step": {"step": 0.01 * ear.size},
        "second_run": {"run_change": 0.01 * ear.size},
        "fluid": {"fluid_mass_kg": 1e-6 * ear.size},
    }
    return damped_alike(ring_ligament(ring, **changes.get(ear.cause, {})), ear.law)


def _stated(parameters: Array, ear: RingEar) -> Array:
    """Return the inertial parameters that the experimenter has, wrong by the cause."""
    stated = parameters.copy()
    if ear.cause.startswith("centre_"):
        mass, centre = parameters[0], parameters[1:4] / parameters[0] * 1e3
        moved = centre - ear.size * np.eye(3)["xyz".index(ear.cause[-1])]
        stated += point_mass(mass, moved) - point_mass(mass, centre)
    if ear.cause == "mirrored":
        stated *= np.array([1, 1, 1, -1, 1, 1, 1, 1, -1, -1])
    if ear.cause == "inertia":
        stated[4:] /= 1.0 + 0.01 * ear.size
    return stated


def _seen(ear: RingEar, freq_hz: Array, stapes: ComplexArray, base: ComplexArray) -> tuple[ComplexArray, ...]:
    """Return the motions that reach the lasers, wrong by the cause."""
    omega = 2.0 * np.pi * freq_hz
    factors = {
        "delay": np.exp(-1e-6j * ear.size * omega),
        "phase": np.exp(-1j * np.radians(ear.size)) + 0.0 * omega,
        "gain": 1.0 / (1.0 + 0.01 * ear.size) + 0.0 * omega,
    }
    if ear.cause in factors:
        stapes = stapes * factors[ear.cause][:, None]
    if ear.cause == "holder":
        ratio = freq_hz / 2600.0
        base = base * (1.0 + 0.001 * ear.size / (1.0 - ratio**2 + 0.1j * ratio))[:, None]
    return stapes, base


def draw_ear(ear: RingEar, *seed: int) -> Measured:
    """Draw an ear and measure it; the same seed draws the same ear whatever its cause."""
    rng = np.random.default_rng(seed)
    number = int(rng.integers(1 << 31))
    runs = 2 if ear.cause == "second_run" else 1
    experiment = Experiment(
        lines=LINES, noise=ear.noise, noise_spread=(1.0, 1.0), beam_cone_deg=30.0,
        position_sd_mm=POSITION_SD_MM, excitations=("y",) * runs, seed=number,
    )  # fmt: skip
    freq_hz = experiment.freq_hz
    parameters = np.array(_usual_mass()) * rng.uniform(0.85, 1.15)
    ligament = _ligament(ear, rng)
    moving = matrix_from_parameters(parameters)
    if ear.cause == "head_mass":
        moving = moving + matrix_from_parameters(point_mass(1e-6 * ear.size, _HEAD_MM))
    share = rng.uniform(0.5, 1.5, 6) * np.exp(2j * np.pi * rng.uniform(size=6))
    share[1] = 1.0
    base = base_motion(freq_hz, "y") * share
    pairs = [
        _seen(ear, freq_hz, stapes_motion(freq_hz, base, moving, ligament, run), base) for run in range(runs)
    ]
    motions = {"stapes": np.array([pair[0] for pair in pairs]), "base": np.array([pair[1] for pair in pairs])}
    places, pose = _places()
    recording = measure_motion(motions, places, experiment, pose)  # type: ignore[arg-type]
    motion = motion_of(recording, registration_sd=REGISTRATION_SD, seed=number)
    stated = _stated(parameters, ear)
    centre_sd = np.zeros(10)
    centre_sd[1:4] = CENTRE_SD_M * parameters[0]
    contributions = {"density": DENSITY_SD**2 * np.outer(stated, stated), "centre": np.diag(centre_sd**2)}
    stated = stated * (1.0 + DENSITY_SD * rng.standard_normal()) + centre_sd * rng.standard_normal(10)
    entries = [part[_PISTON][_UPPER] for part in (ligament.stiffness_si, ligament.damping_si)]
    return Measured(
        motion=motion, mass=MassMatrix(stated, contributions=contributions), truth=np.concatenate(entries)
    )


def has_alarm(fit: KDFit, ignored: frozenset[str] = frozenset()) -> bool:
    """Return whether a warning says that the model does not hold."""
    return bool({notice.code for notice in fit.notices} & (ALARMS - ignored))


def fluid_mg(fit: KDFit) -> tuple[float, float] | None:
    """Return the mass of fluid in the model and its standard deviation, mg; None where it holds none."""
    likelihood = fit.found.likelihood
    names = [unknown.name for unknown in likelihood.model.extras]
    if "fluid" not in names:
        return None
    place = likelihood.at["extra"].start + names.index("fluid")
    return float(fit.found.theta[place]), float(np.sqrt(fit.found.covariance[place, place]))
