"""Estimators against the Cramer-Rao bound: RMSE, bias, coverage and time, as a markdown table.

Simulated: the paper's M, K and corrected D; base along y with 5 % rocking; 9 points on the stapes and 8 on
the bone, each seen along three axes; white velocity noise on every channel. The 6-DOF rows have the same
points, the base driven along two or three directions in runs of their own, and ml with several starts where
the data are weak, as dof2kd does it. Coverage is over the first 400 replicates.
"Equal noise" cases have the same noise at every line: a share of the piston motion in y, the same at 1 mm in
the rotations, the base half of it; at the low end of the band it is as large as the deflection.
Run: python benchmarks/fitting_estimators.py [replicates [six-DOF replicates [estimators]]].
"""

from __future__ import annotations

import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from legacy.fitting.estimators import estimator, ml
from legacy.fitting.estimators.base import EstimatorOptions
from legacy.fitting.estimators.multistart import improve
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_DOF, PAPER_MASS, PAPER_STIFFNESS
from legacy.fitting.model.damping import VISCOUS
from legacy.fitting.model.inertia import inertia_of
from legacy.fitting.model.observation import observe
from legacy.fitting.model.parameter_vector import join
from legacy.fitting.model.scaled_lines import Scale
from legacy.fitting.uncertainty.covariance import attenuation, invert, noise_covariance
from legacy.fitting.uncertainty.identifiability import identifiability
from legacy.stapeskit.records.mass_record import MassMatrix
from legacy.stapeskit.spatial import DOF_NAMES, dof_indices
from sample_volumes.shaken_stapes import driven_base, simulated_motion

M, K, D, DOF = PAPER_MASS, PAPER_STIFFNESS, PAPER_DAMPING_CORRECTED, PAPER_DOF
HEADER = (
    "| case | estimator | RMSE/CRB median | max | bias/sd max | coverage 95 % | lowest entry | ms per fit |\n"
    "|-|-|-|-|-|-|-|-|"
)


@dataclass(frozen=True)
class Case:
    """One condition: noise of the points, number of lines, band, share of lines with tenfold noise."""

    name: str
    noise: float
    lines: int
    high_hz: float = 5000.0
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
CHOSEN = (("pinv", "none"), ("constrained", "none"), ("irls", "none"), ("ml", "none"), ("ml", "t4"))
INTERVALS = 400


def six_dof() -> tuple[MassMatrix, np.ndarray, np.ndarray]:
    """Return a six-DOF truth whose y, alpha, gamma block of K and D is the paper's."""
    mass, centre = 3.2e-6, np.array([0.0447e-3, 1.3e-3, 0.1359e-3])
    central = np.diag([4.2e-12, 2.1e-12, 5.0e-12])
    tensor = central + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    entries = [tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 1], tensor[1, 2], tensor[0, 2]]
    record = MassMatrix("footplate_centre", "footplate", np.array([mass, *(mass * centre), *entries]), {})
    places = np.ix_(dof_indices(DOF), dof_indices(DOF))
    stiffness = np.diag([2600.0, 0.0, 3100.0, 0.0, 2.2e-3, 0.0])
    damping = np.diag([2.6e-2, 0.0, 3.0e-2, 0.0, 4.0e-8, 0.0])
    stiffness[places], damping[places] = K, D
    return record, stiffness, damping


def truth_of(case: Case) -> tuple[Problem, np.ndarray]:
    """Return the problem of a case without noise drawn, and its true scaled parameters."""
    freq = np.linspace(400.0, case.high_hz, case.lines)
    if case.directions:
        record, stiffness, damping = six_dof()
        dof, inertia = DOF_NAMES, inertia_of(record, DOF_NAMES)
        base = np.concatenate([driven_base(freq, dof, name) for name in case.directions])
    else:
        dof, inertia, stiffness, damping = DOF, inertia_of(M, DOF), K, D
        base = driven_base(freq, dof)
    mass = inertia.rows(dof, ())
    observation = observe(simulated_motion(mass, stiffness, damping, dof, freq, base, case.noise, None), dof)
    if case.equal:
        level = case.noise * np.sqrt(np.mean(np.abs(observation.structure[:, 0]) ** 2))
        sd = level * np.array([1.0, 1e3, 1e3, 0.5, 5e2, 5e2])
        covariance = np.broadcast_to(np.diag(2.0 * sd**2).astype(complex), observation.covariance.shape)
        observation = replace(observation, covariance=covariance.copy())
    scale = Scale.of(observation, mass)
    problem = Problem(observation, inertia, scale, VISCOUS, "ml", EstimatorOptions())
    return problem, join(stiffness, damping) / scale.parameter_units(VISCOUS)


def run(task: tuple[Case, str, str, int]) -> str:
    """Return one row of the table."""
    case, name, robust, replicates = task
    options = EstimatorOptions(robust=robust)
    problem, truth = truth_of(case)
    problem = replace(problem, name=name, options=options)
    observation = problem.observation
    hessian, _ = ml.normal_equations(truth, problem.lines())
    bound = np.sqrt(np.diag(0.5 * invert(hessian)))
    root = np.linalg.cholesky(observation.covariance)
    rng = np.random.default_rng(20190901)
    errors, hits, spent = [], [], []
    for place in range(replicates):
        draw = rng.standard_normal((2, *observation.q.shape)) * np.sqrt(0.5)
        draw = draw[0] + 1j * draw[1]
        draw[rng.random(len(draw)) < case.outliers] *= 10.0
        repeated = replace(problem, observation=observation.shifted(np.einsum("lij,lj->li", root, draw)))
        lines = repeated.lines()
        start = time.process_time()
        fit = estimator(name).estimate(lines, options)
        if case.directions and identifiability(fit.parameters, lines, repeated.units).weak:
            fit = improve(repeated, lines, fit)
        spent.append(time.process_time() - start)
        error = fit.parameters - truth
        errors.append(error)
        if place < INTERVALS:
            covariance, _, _ = noise_covariance(repeated, lines, fit)
            bias = attenuation(repeated, lines, fit.parameters)
            hits.append(np.abs(error) < 1.96 * np.sqrt(np.diag(covariance) + bias**2))
    relative = np.sqrt(np.mean(np.square(errors), axis=0)) / bound
    bias = np.abs(np.mean(errors, axis=0)) / np.std(errors, axis=0)
    label = f"{name} ({robust})" if robust != "none" else name
    return (
        f"| {case.name} | {label} | {np.median(relative):.2f} | {relative.max():.2f} | {bias.max():.2f} "
        f"| {np.mean(hits):.3f} | {np.mean(hits, axis=0).min():.3f} | {1e3 * np.median(spent):.2f} |"
    )


def main(replicates: int, six: int, names: tuple[str, ...]) -> None:
    """Print the table."""
    print(f"{replicates} replicates each, {six} with 6 DOF; CRB is that of clean lines; times are of one ")
    print(f"processor. The largest of p biases has a scatter of 1/sqrt(replicates).\n\n{HEADER}")
    tasks = [(case, name, robust, replicates) for case in CASES for name, robust in CHOSEN if name in names]
    tasks += [(case, "ml", "none", six) for case in SIX if six and "ml" in names]
    with ProcessPoolExecutor(2) as pool:
        for row in pool.map(run, tasks):
            print(row, flush=True)


if __name__ == "__main__":
    given = [int(word) for word in sys.argv[1:3]]
    chosen = tuple(sys.argv[3].split(",")) if len(sys.argv) > 3 else tuple(name for name, _ in CHOSEN)
    main(given[0] if given else 1000, given[1] if len(given) > 1 else 200, chosen)
