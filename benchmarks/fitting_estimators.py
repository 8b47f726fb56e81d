"""Estimators against the Cramer-Rao bound: RMSE, bias, coverage and time, as a markdown table.

Simulated: the paper's M, K and corrected D; base along y with 5 % rocking; 9 points on the stapes and 8 on
the bone, each seen along three axes; white velocity noise on every channel.
Run: python benchmarks/fitting_estimators.py [replicates].
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace

import numpy as np

from fitting.damping import VISCOUS
from fitting.estimators import EstimatorOptions, estimator, ml
from fitting.experiment import driven_base, simulated_motion
from fitting.inertia import inertia_of
from fitting.lines import Scale
from fitting.observation import observe
from fitting.paper import PAPER_DAMPING_CORRECTED, PAPER_DOF, PAPER_MASS, PAPER_STIFFNESS
from fitting.problem import Problem
from fitting.symmetric import join
from fitting.uncertainty import attenuation, invert, noise_covariance

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


CASES = (
    Case("1 %, 200 lines", 0.01, 200),
    Case("5 %, 100 lines", 0.05, 100),
    Case("5 %, 200 lines", 0.05, 200),
    Case("10 %, 200 lines", 0.10, 200),
    Case("10 %, 500 lines", 0.10, 500),
    Case("5 %, 200 lines, 3 % of them x10", 0.05, 200, outliers=0.03),
    Case("weak: 30 %, 30 lines", 0.30, 30),
)


def run(case: Case, name: str, robust: str, replicates: int) -> str:
    """Return one row of the table."""
    freq = np.linspace(400.0, case.high_hz, case.lines)
    exact = simulated_motion(M, K, D, DOF, freq, driven_base(freq, DOF), case.noise, None)
    observation = observe(exact, DOF)
    scale = Scale.of(observation, M)
    truth = join(K, D) / scale.parameter_units(VISCOUS)
    options = EstimatorOptions(robust=robust)
    problem = Problem(observation, inertia_of(M, DOF), scale, VISCOUS, name, options)
    hessian, _ = ml.normal_equations(truth, problem.lines())
    bound = np.sqrt(np.diag(0.5 * invert(hessian)))
    root = np.linalg.cholesky(observation.covariance)
    rng = np.random.default_rng(20190901)
    errors, hits, spent = [], [], []
    for _ in range(replicates):
        draw = (rng.standard_normal((case.lines, 6)) + 1j * rng.standard_normal((case.lines, 6))) * np.sqrt(
            0.5
        )
        bad = rng.random(case.lines) < case.outliers
        draw[bad] *= 10.0
        noisy = replace(observation, q=observation.q + np.einsum("lij,lj->li", root, draw))
        made = replace(problem, observation=noisy)
        lines = made.lines()
        start = time.perf_counter()
        found = estimator(name).estimate(lines, options)
        spent.append(time.perf_counter() - start)
        error = found.parameters - truth
        covariance, _, _ = noise_covariance(made, lines, found)
        bias = attenuation(made, lines, found.parameters)
        sd = np.sqrt(np.diag(covariance) + bias**2)
        errors.append(error)
        hits.append(np.abs(error) < 1.96 * sd)
    relative = np.sqrt(np.mean(np.square(errors), axis=0)) / bound
    bias = np.abs(np.mean(errors, axis=0)) / np.std(errors, axis=0)
    label = f"{name} ({robust})" if robust != "none" else name
    return (
        f"| {case.name} | {label} | {np.median(relative):.2f} | {relative.max():.2f} | {bias.max():.2f} "
        f"| {np.mean(hits):.3f} | {np.mean(hits, axis=0).min():.3f} | {1e3 * np.median(spent):.2f} |"
    )


def main(replicates: int) -> None:
    """Print the table."""
    print(f"{replicates} replicates each; CRB is that of clean lines.\n\n{HEADER}")
    for case in CASES:
        chosen = [("pinv", "none"), ("constrained", "none"), ("irls", "none"), ("ml", "none"), ("ml", "t4")]
        for name, robust in chosen:
            print(run(case, name, robust, replicates), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400)
