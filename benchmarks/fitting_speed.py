"""Time of a fit: the estimators beside scipy's SLSQP in one run, growth with lines, and many fits at once.

Simulated as in fitting_estimators.py: 3 degrees of freedom, 5 % noise, 200 lines. SLSQP gets the problem of
`constrained` (balanced scaled rows, diagonals not negative, all eigenvalues stable) as one would write it by
hand, and the objective of `ml` under the same constraints. No constraint is active at the optimum here, which
`constrained` finds out by solving the relaxed problem first. Times are processor times, so that other work on
the machine counts little.
Run: python benchmarks/fitting_speed.py [fits].
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from scipy.optimize import Bounds, minimize

from legacy.fitting.estimators import constrained, irls, ml, pinv
from legacy.fitting.estimators.base import EstimatorOptions
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_DOF, PAPER_MASS, PAPER_STIFFNESS
from legacy.fitting.model.damping import VISCOUS
from legacy.fitting.model.inertia import inertia_of
from legacy.fitting.model.model import state_matrix
from legacy.fitting.model.observation import observe
from legacy.fitting.model.parameter_vector import join, pairs, split
from legacy.fitting.model.scaled_lines import Lines, Scale, real_rows, regressor
from sample_volumes.shaken_stapes import driven_base, simulated_motion

M, K, D, DOF = PAPER_MASS, PAPER_STIFFNESS, PAPER_DAMPING_CORRECTED, PAPER_DOF
OPTIONS = EstimatorOptions()


def problem_of(lines: int, noise: float = 0.05) -> Problem:
    """Return the simulated problem without noise drawn."""
    freq = np.linspace(400.0, 5000.0, lines)
    motion = simulated_motion(M, K, D, DOF, freq, driven_base(freq, DOF), noise, None)
    observation = observe(motion, DOF)
    return Problem(observation, inertia_of(M, DOF), Scale.of(observation, M), VISCOUS, "ml", OPTIONS)


def noisy_lines(problem: Problem, root: np.ndarray, rng: np.random.Generator) -> Lines:
    """Return the equations of one draw of the noise."""
    draw = rng.standard_normal((2, *problem.observation.q.shape)) * np.sqrt(0.5)
    return problem.lines(np.einsum("lij,lj->li", root, draw[0] + 1j * draw[1]))


def median_ms(call: Callable[[], object], most_seconds: float = 2.0) -> float:
    """Return the median time of a warm call."""
    call()
    spent: list[float] = []
    while sum(spent) < most_seconds and len(spent) < 300:
        start = time.process_time()
        call()
        spent.append(time.process_time() - start)
    return 1e3 * float(np.median(spent))


def stability(parameters: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Return the margins of all eigenvalues, not negative when stable."""
    values = np.linalg.eigvals(state_matrix(mass, *split(parameters, len(mass))))
    return -1e-6 - np.sort(values.real)[::-1]


def slsqp(objective: Callable[[np.ndarray], float], start: np.ndarray, lines: Lines) -> tuple:
    """Minimise under signs and stability with scipy's SLSQP and its own differences."""
    lower = np.full(len(start), -np.inf)
    half = len(start) // 2
    for place, (row, column) in enumerate(pairs(lines.n)):
        if row == column:
            lower[[place, place + half]] = 0.0
    unit = objective(start)
    result = minimize(
        lambda parameters: objective(parameters) / unit,
        start,
        method="SLSQP",
        bounds=Bounds(lower, np.full(len(start), np.inf)),
        constraints=[{"type": "ineq", "fun": lambda parameters: stability(parameters, lines.mass)}],
        options={"maxiter": 1000, "ftol": 1e-14},
    )
    return result.x, objective(result.x)


def side_by_side(problem: Problem) -> None:
    """Print time and objective of every estimator beside SLSQP."""
    root = np.linalg.cholesky(problem.observation.covariance)
    lines = noisy_lines(problem, root, np.random.default_rng(1))
    units = problem.units
    truth = join(K, D) / units
    rows, right = real_rows(regressor(lines.dq, lines.factor)), real_rows(lines.force)
    unit = float(right @ right)

    def equation(parameters: np.ndarray) -> float:
        residual = rows @ parameters - right
        return float(residual @ residual) / unit

    def likelihood(parameters: np.ndarray) -> float:
        return float(np.sum(ml.whiten(parameters, lines).distance))

    rough = np.where(truth == 0.0, 0.0, 1.0) * join(np.eye(3), 0.3 * np.eye(3))
    start = irls.quick_start(lines)
    results: list[tuple[str, str, Callable[[], np.ndarray], Callable[[np.ndarray], float]]] = [
        ("pinv", "(Ap - b)^2", lambda: pinv.estimate(lines, OPTIONS).parameters, equation),
        ("constrained", "(Ap - b)^2", lambda: constrained.estimate(lines, OPTIONS).parameters, equation),
        ("scipy SLSQP", "(Ap - b)^2", lambda: slsqp(equation, rough, lines)[0], equation),
        ("irls", "reweighted", lambda: irls.estimate(lines, OPTIONS).parameters, likelihood),
        ("ml", "likelihood", lambda: ml.estimate(lines, OPTIONS).parameters, likelihood),
        (
            "ml, Student t",
            "robust",
            lambda: ml.estimate(lines, EstimatorOptions(robust="t4")).parameters,
            likelihood,
        ),
        (
            "scipy SLSQP",
            "likelihood, from K = 1, D = 0.3",
            lambda: slsqp(likelihood, rough, lines)[0],
            likelihood,
        ),
        ("scipy SLSQP", "likelihood, from irls", lambda: slsqp(likelihood, start, lines)[0], likelihood),
    ]
    print("| what | objective | ms per fit | objective over the best |\n|-|-|-|-|")
    best = {equation: np.inf, likelihood: np.inf}
    table = []
    for name, goal, call, judge in results:
        value = judge(call())
        if name != "pinv":
            best[judge] = min(best[judge], value)
        table.append((name, goal, median_ms(call), value, judge))
    for name, goal, spent, value, judge in table:
        ratio = value / best[judge] if name != "pinv" else float("nan")
        shown = f"{ratio:.9f}" if np.isfinite(ratio) else "SI rows: not comparable"
        print(f"| {name} | {goal} | {spent:.2f} | {shown} |", flush=True)
    times = {(name, goal): spent for name, goal, spent, _, _ in table}
    ours, ml_ms = times["constrained", "(Ap - b)^2"], times["ml", "likelihood"]
    theirs = times["scipy SLSQP", "(Ap - b)^2"]
    print(f"\nSLSQP over constrained: {theirs / ours:.0f}; SLSQP over ml, same problem: ", end="")
    print(f"{times['scipy SLSQP', 'likelihood, from irls'] / ml_ms:.0f} (started from irls), ", end="")
    print(f"{times['scipy SLSQP', 'likelihood, from K = 1, D = 0.3'] / ml_ms:.0f} (rough start).")


def modelled(problem: constrained.Quadratic) -> np.ndarray:
    """Solve the same convex problem through cvxpy, as one would write it by hand."""
    import cvxpy

    n = problem.n
    stiffness, damping = cvxpy.Variable((n, n), PSD=True), cvxpy.Variable((n, n), PSD=True)
    entries = cvxpy.hstack([part[i, j] for part in (stiffness, damping) for i, j in pairs(n)])
    goal = cvxpy.sum_squares(problem.triangle @ entries - problem.right)
    cvxpy.Problem(cvxpy.Minimize(goal)).solve(solver=cvxpy.CLARABEL)
    return join(stiffness.value, damping.value)


def semidefinite() -> None:
    """Print the times of K >= 0, D >= 0 beside cvxpy with Clarabel, where it is installed."""
    try:
        import cvxpy
    except ImportError:
        print("\ncvxpy is not installed: no row of a modelling layer (pip install cvxpy).")
        return
    print(f"\n| K >= 0, D >= 0 | active | constrained, ms | cvxpy {cvxpy.__version__}, ms | ml, ms |", end="")
    print(" cvxpy over constrained, ml | objective, cvxpy over ours - 1 |\n|-|-|-|-|-|-|-|")
    options = EstimatorOptions(constraint="psd")
    for noise, count, seed in ((0.05, 200, 1), (0.3, 30, 2), (0.3, 30, 5)):
        problem = problem_of(count, noise)
        root = np.linalg.cholesky(problem.observation.covariance)
        lines = noisy_lines(problem, root, np.random.default_rng(seed))
        reduced = constrained.reduce(lines, options)
        fit = constrained.estimate(lines, options)
        ours = median_ms(lambda lines=lines: constrained.estimate(lines, options), 0.5)
        theirs = median_ms(lambda reduced=reduced: modelled(reduced), 1.0)
        likely = median_ms(lambda lines=lines: ml.estimate(lines, OPTIONS), 0.5)
        excess = reduced.value(modelled(reduced)) / reduced.value(fit.parameters) - 1.0
        active = ", ".join(fit.active) or "none"
        print(f"| noise {100 * noise:g} %, {count} lines | {active} | {ours:.2f} | {theirs:.2f} ", end="")
        print(f"| {likely:.2f} | {theirs / ours:.1f}, {theirs / likely:.1f} | {excess:.1e} |", flush=True)


def growth() -> None:
    """Print the time of one ml fit over the number of lines."""
    print("\n| lines | ml, ms per fit |\n|-|-|")
    for lines in (100, 200, 500, 1000, 2000, 5000):
        problem = problem_of(lines)
        drawn = noisy_lines(
            problem, np.linalg.cholesky(problem.observation.covariance), np.random.default_rng(2)
        )
        print(f"| {lines} | {median_ms(lambda drawn=drawn: ml.estimate(drawn, OPTIONS), 1.0):.2f} |")


def many(seed: int, fits: int) -> tuple[float, float, np.ndarray]:
    """Simulate and fit; return processor seconds in the fits and in all, and the estimates."""
    problem = problem_of(200)
    root = np.linalg.cholesky(problem.observation.covariance)
    rng = np.random.default_rng(seed)
    estimates, spent, begun = np.empty((fits, 12)), 0.0, time.process_time()
    for place in range(fits):
        lines = noisy_lines(problem, root, rng)
        start = time.process_time()
        estimates[place] = ml.estimate(lines, OPTIONS).parameters
        spent += time.process_time() - start
    return spent, time.process_time() - begun, estimates


def main(fits: int) -> None:
    """Print all tables."""
    problem = problem_of(200)
    side_by_side(problem)
    semidefinite()
    growth()
    with ProcessPoolExecutor(2) as pool:
        list(pool.map(many, (0, 1), (3, 3)))
        start = time.perf_counter()
        parts = list(pool.map(many, (0, 1), (fits // 2, fits - fits // 2)))
        whole = time.perf_counter() - start
    print(
        f"\n{fits} fits on 2 processes, drawing and assembling their data included: {whole:.1f} s on the ",
        end="",
    )
    print(f"clock, processor time of the busier process {max(part[1] for part in parts):.1f} s, ", end="")
    print(f"of which {max(part[0] for part in parts):.1f} s in the fits.")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
