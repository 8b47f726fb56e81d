"""Maximum likelihood reaches the Cramer-Rao bound, and its 95 % intervals hold; the textbooks' do not.

The paper's M, K and D; the base is driven along y with 5 % rocking; 10 points on the stapes and 9 on the
bone are seen by three beams each with white velocity noise. "Equal noise": the same displacement noise at
every line, a share of the piston motion; "x10": that share of the lines has ten times the noise. With six
degrees of freedom the ligament is a ring and the base is driven along several axes in runs of their own. The
bound is that of lines without noise.

    python -m benchmarks.fitting_estimators --replicates 100 --six 20
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from benchmarks._table import NOTHING, arguments, print_table
from fitting.dof2kd import dof2kd
from fitting.result import KDFit
from simulate import Ear, Experiment, Ligament, Ring, measure_motion, motion_of, ring_ligament, stapes_motion
from simulate.points import bone_points, visible_points
from simulate.vibrometer import laser_directions, vibrometer_pose
from stapeskit.arrays import Array, ComplexArray
from stapeskit.records.rigid_motion import RigidMotion
from stapeskit.spatial import DOF_NAMES, dof_indices

# CURAC 2019, p. 98 ff., Eq. 6: y, alpha, gamma.
PAPER_MASS = np.array(
    [
        [3.2e-6, -434.88e-12, 143.04e-12],
        [-434.88e-12, 9.77e-12, -29.7e-15],
        [143.04e-12, -29.7e-15, 11.14e-12],
    ]
)
PINV, CONSTRAINED, ML, T4 = "pinv", "constrained", "ml", "ml (t4)"
OPTIONS = {
    PINV: {"estimator": "pinv"},
    CONSTRAINED: {"estimator": "constrained"},
    ML: {"unknowns": ("none",)},
    T4: {"robust": "t4", "unknowns": ("none",)},
}


@dataclass(frozen=True)
class Case:
    """One condition: noise of the points, lines, share of lines with tenfold noise, runs with six degrees."""

    name: str
    noise: float
    lines: int
    outliers: float = 0.0
    directions: str = ""
    equal: bool = False


CASES = (
    Case("1 %, 200 lines", 0.01, 200),
    Case("5 %, 100 lines", 0.05, 100),
    Case("5 %, 200 lines", 0.05, 200),
    Case("10 %, 200 lines", 0.10, 200),
    Case("10 %, 500 lines", 0.10, 500),
    Case("5 %, 200 lines, 3 % of them x10", 0.05, 200, outliers=0.03),
    Case("weak: 30 %, 30 lines", 0.30, 30),
    Case("equal noise, 5 %, 200 lines", 0.05, 200, equal=True),
    Case("equal noise, 10 %, 400 lines", 0.10, 400, equal=True),
)
SIX = (
    Case("6 DOF, 5 %, 2 x 200 lines, y and x", 0.05, 200, directions="yx"),
    Case("6 DOF, 5 %, 3 x 200 lines, y, x and z", 0.05, 200, directions="yxz"),
)


def driven_base(freq_hz: Array, dof: tuple[str, ...], driven: str) -> ComplexArray:
    """Return a base motion (lines, 6) of constant velocity along one axis, a twentieth in the others."""
    motion = np.zeros((len(freq_hz), 6), dtype=complex)
    for name in dof:
        place = DOF_NAMES.index(name)
        share = 0.05 * np.exp(1j * (1.0 + place) * freq_hz / freq_hz.max())
        motion[:, place] = 1.0 if name == driven else share * (1e3 if place > 2 else 1.0)
    return motion * (1e-4 / freq_hz)[:, None]


def exact_motion(case: Case) -> tuple[RigidMotion, Array, Ligament]:
    """Return the motion of a case without noise drawn but with its covariance, the mass and the ligament."""
    ear = Ear(ligament=ring_ligament(Ring(tilt_deg=(1.0, -0.5)))) if case.directions else Ear()
    dof, mass = ear.ligament.dof, ear.moving_mass_si()
    if not case.directions:
        mass = np.zeros((6, 6))
        mass[np.ix_(dof_indices(dof), dof_indices(dof))] = PAPER_MASS
    experiment = Experiment(
        lines=case.lines,
        noise=case.noise,
        noise_spread=(1.0, 1.0),
        excitations=tuple(case.directions or "y"),
        position_sd_mm=0.0,
        exact=True,
        seed=11,
    )
    freq_hz = experiment.freq_hz
    base = np.array([driven_base(freq_hz, dof, name) for name in experiment.excitations])
    stapes = np.array([stapes_motion(freq_hz, run, mass, ear.ligament) for run in base])
    pose = vibrometer_pose(np.random.default_rng(11))
    beams = pose.inverse().vectors(laser_directions(3, experiment.beam_cone_deg))
    places = {"stapes": visible_points(ear.solid, 10, beams), "base": bone_points(ear.solid, 9)}
    recording = measure_motion({"stapes": stapes, "base": base}, places, experiment, pose)
    motion = motion_of(recording, dof=dof)
    if case.equal:
        level = case.noise * np.sqrt(np.mean(np.abs(motion.q[:, 0, :, 0]) ** 2))
        sd = level * np.array([[1.0, 1e3, 1e3], [0.5, 5e2, 5e2]])
        covariance = np.zeros(motion.covariance.shape, dtype=complex)
        covariance += 2.0 * (sd**2)[None, :, None, :, None] * np.eye(3)
        motion = replace(motion, covariance=covariance)
    matrix = mass if case.directions else PAPER_MASS
    return motion, matrix, ear.ligament


def fitted(motion: RigidMotion, mass: Array, dof: tuple[str, ...], name: str) -> KDFit:
    """Fit K and D of all degrees of freedom by an estimator."""
    return dof2kd(motion, mass=mass, dof=dof, mass_sign="tensor", **OPTIONS[name])


def figures(case: Case, name: str, replicates: int) -> str:
    """Return error over bound (median, largest) and coverage of an estimator."""
    motion, mass, ligament = exact_motion(case)
    dof = ligament.dof
    upper = np.triu_indices(len(dof))
    truth = np.concatenate([ligament.stiffness_si[upper], ligament.damping_si[upper]])
    bound = fitted(motion, mass, dof, ML).bound
    root = np.linalg.cholesky(motion.covariance)
    rng = np.random.default_rng([20190901, (*CASES, *SIX).index(case)])
    errors, inside = [], []
    for _ in range(replicates):
        draw = rng.standard_normal((*motion.q.shape, 2)) @ np.array([1.0, 1j]) * np.sqrt(0.5)
        loud = rng.random(motion.q.shape[2]) < case.outliers
        draw = draw * np.where(loud, 10.0, 1.0)[:, None]
        noisy = replace(motion, q=motion.q + np.einsum("rblij,rblj->rbli", root, draw))
        fit = fitted(noisy, mass, dof, name)
        errors.append(fit.values - truth)
        inside.append(np.abs(errors[-1]) < 1.96 * np.sqrt(np.diag(fit.covariance)))
    relative = np.sqrt(np.mean(np.square(errors), axis=0)) / bound
    return f"{np.median(relative):.2f}/{relative.max():.2f} ({100.0 * np.mean(inside):.0f})"


def rows(replicates: int, six: int, names: list[str]) -> Iterator[list[object]]:
    """Yield the rows of all cases."""
    for case in (*CASES, *(SIX if six else ())):
        cells = list[object]([case.name])
        for name in names:
            fits = case in CASES or name == ML
            cells.append(figures(case, name, replicates if case in CASES else six) if fits else NOTHING)
        yield cells


if __name__ == "__main__":
    given = arguments(__doc__, replicates=20, six=4, estimators=",".join(OPTIONS))
    print(f"{given.replicates} replicates each, {given.six} with 6 DOF. Root mean square error over its")
    print("bound, median/largest of the entries, and how many percent of the 95 % intervals hold.\n")
    names = given.estimators.split(",")
    print_table(("case", *names), rows(given.replicates, given.six, names))
