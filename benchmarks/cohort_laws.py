"""Laws over simulated cohorts with a planted exponent, beside the regressions that laboratories use.

    python benchmarks/cohort_laws.py [--cohorts 500]

Prints coverage of the 95 % intervals, median bias in standard errors, and the same of least squares,
orthogonal distance regression and York's regression (no scatter), on the same cohorts; then predictions and
components.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from scipy import stats

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pipeline.cohort.components import independent_parameters
from pipeline.cohort.law import fit_law
from pipeline.cohort.prediction import Predictor
from tests.pipeline.cohort.simulated import cohort

EXPONENT = 1.5
SCENES = {
    "no measurement error": {"error": (0.0, 0.0, 0.0)},
    "errors in both": {},
    "large errors of x": {"error": (0.1, 0.07, 0.3)},
    "an error common to all": {"common": 0.1},
    "two scanners": {"batches": 0.1},
    "left-right pairs": {"pairs": 0.6},
    "heavy tails": {"heavy": True},
    "no law (false positives)": {"exponent": 0.0},
}


def least_squares(pairs):
    """Return estimate and 95 % half width of ordinary least squares."""
    line = stats.linregress(pairs.x, pairs.y)
    return line.slope, stats.t.ppf(0.975, pairs.n - 2) * line.stderr


def york(pairs, rounds=60):
    """Return estimate and half width of York et al. (2004, doi:10.1119/1.1632486), without scatter."""
    own = pairs.own + 1e-12 * np.eye(2)
    s_xx, s_xy, s_yy = own[:, 0, 0], own[:, 0, 1], own[:, 1, 1]
    b = stats.linregress(pairs.x, pairs.y).slope
    for _ in range(rounds):
        weight = 1.0 / np.maximum(s_yy + b**2 * s_xx - 2.0 * b * s_xy, 1e-12)
        u = pairs.x - np.average(pairs.x, weights=weight)
        v = pairs.y - np.average(pairs.y, weights=weight)
        beta = weight * (u * s_yy + b * v * s_xx - (b * u + v) * s_xy)
        b = float(np.clip(np.sum(weight * beta * v) / np.sum(weight * beta * u), -1e3, 1e3))
    return b, 1.96 / np.sqrt(np.sum(weight * beta**2) + 1e-300)


def orthogonal(pairs):
    """Return estimate and half width of orthogonal regression scaled by the mean errors."""
    scale = np.sqrt(pairs.own[:, 1, 1].mean() / max(pairs.own[:, 0, 0].mean(), 1e-12)) or 1.0
    x, y = pairs.x * scale, pairs.y
    c = np.cov(x, y)
    angle = 0.5 * np.arctan2(2.0 * c[0, 1], c[0, 0] - c[1, 1])
    b = np.tan(angle) * scale
    left = np.std((y - np.tan(angle) * x) - np.mean(y - np.tan(angle) * x), ddof=2)
    return b, 1.96 * left / np.sqrt(np.sum((pairs.x - pairs.x.mean()) ** 2))


def main() -> None:
    """Print the tables."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--cohorts", type=int, default=500)
    count = given.parse_args().cohorts
    print(
        f"Coverage of 95 % intervals of the exponent, {count} cohorts a cell (sd "
        f"{np.sqrt(0.0475 / count):.3f})\n"
    )
    print("| cohort | n | this | bias/sd | scatter | prediction | least squares | orthogonal | York | ms |")
    print("|-|-|-|-|-|-|-|-|-|-|")
    for name, scene in SCENES.items():
        truth = scene.get("exponent", EXPONENT)
        for n in (8, 16, 40):
            rng = np.random.default_rng(n)
            hits = np.zeros((count, 6))
            estimates, seconds = [], 0.0
            for k in range(count):
                pairs, (x, y) = cohort(rng, n, **scene)
                begun = time.process_time()
                law = fit_law(pairs)
                seconds += time.process_time() - begun
                estimates.append(law.exponent)
                hits[k, 0] = law.interval[0] <= truth <= law.interval[1]
                hits[k, 1] = law.sigma_interval[0] <= 0.2 <= law.sigma_interval[1]
                hits[k, 2] = np.nan
                if k < count // 5 and not scene.get("common") and not scene.get("batches"):
                    sd = float(np.sqrt(pairs.own[0, 0, 0]))
                    low, high = Predictor(pairs).predict(x + sd * rng.standard_normal(), sd**2).interval
                    hits[k, 2] = low <= y <= high
                for column, method in ((3, least_squares), (4, orthogonal), (5, york)):
                    b, half = method(pairs)
                    hits[k, column] = abs(b - truth) <= half
            spread = np.subtract(*np.percentile(estimates, [75, 25])) / 1.349
            bias = (np.median(estimates) - truth) / spread
            prediction = f"{np.nanmean(hits[:, 2]):.3f}" if np.any(np.isfinite(hits[:, 2])) else "–"
            cells = [f"{hits[:, c].mean():.3f}" for c in (0, 1, 3, 4, 5)]
            row = [cells[0], f"{bias:+.2f}", cells[1], prediction, *cells[2:], f"{1e3 * seconds / count:.0f}"]
            print(f"| {name} | {n} | {' | '.join(row)} |", flush=True)
    print(
        "\nComponents: 2 of 6 planted (sd .60, .30; errors .08)\n"
        "\n| n | counted 2 | interval holds 2 |\n|-|-|-|"
    )
    for n in (8, 16, 40):
        rng = np.random.default_rng(n)
        found = []
        for k in range(max(count // 5, 20)):
            axes, _ = np.linalg.qr(rng.standard_normal((6, 2)))
            values = rng.standard_normal((n, 2)) @ (axes * [0.6, 0.3]).T
            values += 0.08 * rng.standard_normal((n, 6))
            found.append(independent_parameters(values, np.tile(0.08**2 * np.eye(6), (n, 1, 1)), seed=k))
        exact = np.mean([one.estimate == 2 for one in found])
        held = np.mean([one.interval[0] <= 2 <= one.interval[1] for one in found])
        print(f"| {n} | {exact:.2f} | {held:.2f} |")


if __name__ == "__main__":
    main()
