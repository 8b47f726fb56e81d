"""Do the intervals of K and D hold where K >= 0 or D >= 0 holds the estimate back?

    python benchmarks/constrained_coverage.py [EARS [SEED]]

Each family draws ears until EARS of them have an active constraint, and prints how many entries of K and D
lie inside their 95 % intervals, in intervals and in 1.96 standard deviations; the lowest entry; the largest
error in standard deviations; how often several other starts reach a lower chi2; and the time of a fit.
"""

from __future__ import annotations

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is loaded: times are of one thread

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.random import Generator

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.ring_ears import PISTON, EarSettings, ear
from legacy.fitting.errors import FittingError
from legacy.fitting.examples.paper import PAPER_DOF, PAPER_MASS
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.model.parameter_vector import entry_names, join
from legacy.fitting.options import KDOptions
from legacy.stapeskit.records.mass_record import MassMatrix
from legacy.stapeskit.records.motion import RigidMotion
from sample_volumes.shaken_stapes import driven_base, simulated_motion

Drawn = tuple[RigidMotion, MassMatrix | np.ndarray, np.ndarray, np.ndarray]
_BLOCK = np.ix_(PISTON, PISTON)


def passive_matrix(rng: Generator, size: np.ndarray, smallest: float) -> np.ndarray:
    """Return a matrix with the given root diagonal whose smallest eigenvalue is about ``smallest``."""
    axes, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    values = np.array([1.0, rng.uniform(0.3, 1.0), smallest])
    matrix = (axes * values) @ axes.T
    root = size / np.sqrt(np.diag(matrix))
    return matrix * np.outer(root, root)


def plain(rng: Generator, noise: tuple[float, float]) -> Drawn:
    """Return an ear of three degrees of freedom with D near its limit: eigenvalues from 1e-3 to 0.3."""
    spread = np.exp(0.3 * rng.standard_normal(3))
    stiffness = passive_matrix(rng, np.sqrt([1500.0, 1.0e-3, 2.2e-3]) * spread, rng.uniform(0.2, 0.9))
    loss = np.exp(rng.uniform(np.log(3e-6), np.log(3e-5)))
    damping = loss * passive_matrix(
        rng, np.sqrt([1500.0, 1.0e-3, 2.2e-3]) * spread, np.exp(rng.uniform(np.log(1e-3), np.log(0.3)))
    )
    freq = np.linspace(400.0, 5000.0, int(rng.integers(30, 120)))
    base = driven_base(freq, PAPER_DOF, others=rng.uniform(0.05, 0.3))
    level = float(np.exp(rng.uniform(*np.log(noise))))
    motion = simulated_motion(PAPER_MASS, stiffness, damping, PAPER_DOF, freq, base, level, rng)
    return motion, PAPER_MASS, stiffness, damping


def ring(rng: Generator, noise: tuple[float, float]) -> Drawn:
    """Return an ear of six degrees of freedom with a ring of springs (benchmarks/ring_ears.py)."""
    level = float(np.exp(rng.uniform(*np.log(noise))))
    case = ear(EarSettings(0.1, level, lines=int(rng.integers(30, 120))), rng)
    return case.motion, case.mass, case.stiffness[_BLOCK], case.damping[_BLOCK]


FAMILIES: dict[str, tuple[Callable[[Generator, tuple[float, float]], Drawn], tuple[float, float]]] = {
    "D near its limit, noise 1 to 5 %": (plain, (0.01, 0.05)),
    "D near its limit, noise 5 to 30 %": (plain, (0.05, 0.3)),
    "ring of springs, noise 10 to 30 %": (ring, (0.1, 0.3)),
}


def main(wanted: int, seed: int, chosen: str) -> None:
    """Print the table."""
    print(
        "| family | ears drawn; constrained | inside intervals | inside 1.96 sd | lowest entry "
        "| largest error / sd | refused | ms |\n|-|-|-|-|-|-|-|-|"
    )
    for place, (name, (draw, noise)) in enumerate(FAMILIES.items()):
        if chosen not in name:
            continue
        inside, errors, spent, drawn, refused = [], [], 0.0, 0, 0
        while len(inside) < wanted and drawn < 40 * wanted:
            case = draw(np.random.default_rng([seed, place, drawn]), noise)
            drawn += 1
            begun = time.process_time()
            try:
                fit = fit_kd(*case[:2], KDOptions(bands=0))
            except FittingError:
                refused += 1
                continue
            if not fit.estimate.active:
                continue
            spent += time.process_time() - begun
            truth = join(*case[2:])
            low, high = fit.intervals.T
            inside.append((low <= truth) & (truth <= high))
            errors.append((join(fit.stiffness, fit.damping) - truth) / np.sqrt(np.diag(fit.covariance)))
        hits, z = np.array(inside), np.abs(errors)
        lowest = int(np.argmin(hits.mean(axis=0)))
        cells = (
            name,
            f"{drawn}; {len(hits)}",
            f"{100 * hits.mean():.1f} %",
            f"{100 * np.mean(z < 1.96):.1f} %",
            f"{entry_names(3)[lowest]} {100 * hits[:, lowest].mean():.0f} %",
            f"{z.max():.1f}",
            str(refused),
            f"{1e3 * spent / len(hits):.0f}",
        )
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    given = sys.argv[1:]
    main(
        int(given[0]) if given else 200,
        int(given[1]) if len(given) > 1 else 1,
        given[2] if len(given) > 2 else "",
    )
