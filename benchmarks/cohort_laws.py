"""The 95 % intervals of laws over cohorts hold where those of the usual regressions do not.

Simulated cohorts with a planted exponent of 1.5 (0 without a law), scatter 0.20, spread of ln x 0.12, errors
0.05 and 0.07 with correlation 0.3. Printed: coverage of the intervals of exponent, scatter and the response
of a further ear, and that of least squares, orthogonal and York's regression on the same cohorts.
Meant: exponent 0.93 to 0.98 (0.91 with heavy tails), bias at most 0.15 sd, prediction 0.93 to 0.99.

    python -m benchmarks.cohort_laws --cohorts 120
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy import stats

from benchmarks._table import NOTHING, arguments, print_table
from pipeline.cohort.law import LogPairs, fit_law
from pipeline.cohort.predict import Predictor

SCATTER, SPREAD_X = 0.2, 0.12
SIZES = (8, 16, 40)
"""Ears of a cohort."""


@dataclass(frozen=True, kw_only=True)
class Population:
    """How cohorts are drawn.

    Attributes
    ----------
    exponent : float
    error : (float, float, float)
        Standard deviations of ln x and ln y, and their correlation.
    common, batches : float
        An error of all ears, and one of every second ear (a scanner).
    pairs : float
        Correlation of the two ears of a subject.
    heavy : bool
        Scatter by Student's t with four degrees of freedom.
    """

    exponent: float = 1.5
    error: tuple[float, float, float] = (0.05, 0.07, 0.3)
    common: float = 0.0
    batches: float = 0.0
    pairs: float = 0.0
    heavy: bool = False

    def draw(self, rng: np.random.Generator, n: int) -> tuple[LogPairs, tuple[float, float]]:
        """Return the logarithms of n ears, and the true (x, y) of a further one."""
        people = n // 2 if self.pairs else n
        subject = np.repeat(np.arange(people), 2)[:n] if self.pairs else np.arange(n)
        alike = np.sqrt(self.pairs)

        def scatter(size: int) -> np.ndarray:
            return rng.standard_t(4, size) / np.sqrt(2.0) if self.heavy else rng.standard_normal(size)

        own_x = alike * rng.standard_normal(people)[subject]
        own_y = alike * scatter(people)[subject]
        apart = np.sqrt(1.0 - self.pairs)
        x = SPREAD_X * (own_x + apart * rng.standard_normal(n))
        y = self.exponent * x + SCATTER * (own_y + apart * scatter(n))
        further = SPREAD_X * float(rng.standard_normal())
        truth = (further, self.exponent * further + SCATTER * float(scatter(1)[0]))
        sd_x, sd_y, correlation = self.error
        covariance = np.array([[sd_x**2, correlation * sd_x * sd_y], [correlation * sd_x * sd_y, sd_y**2]])
        shared = np.zeros((n, 2, 2))
        shared[:, :, 0] = self.common
        shared[::2, :, 1] = self.batches
        root = np.linalg.cholesky(covariance + 1e-30 * np.eye(2))
        noise = rng.standard_normal((n, 2)) @ root.T + shared @ rng.standard_normal(2)
        return LogPairs(
            x + noise[:, 0], y + noise[:, 1], np.tile(covariance, (n, 1, 1)), shared, subject
        ), truth


POPULATIONS = {
    "no measurement error": Population(error=(0.0, 0.0, 0.0)),
    "errors in both": Population(),
    "large errors of x": Population(error=(0.1, 0.07, 0.3)),
    "an error common to all": Population(common=0.1),
    "two scanners": Population(batches=0.1),
    "left-right pairs": Population(pairs=0.6),
    "heavy tails": Population(heavy=True),
    "no law (false positives)": Population(exponent=0.0),
}


def least_squares(pairs: LogPairs) -> tuple[float, float]:
    """Return exponent and 95 % half width of ordinary least squares."""
    line = stats.linregress(pairs.x, pairs.y)
    return line.slope, stats.t.ppf(0.975, pairs.n - 2) * line.stderr


def orthogonal(pairs: LogPairs) -> tuple[float, float]:
    """Return exponent and half width of orthogonal regression scaled by the mean errors."""
    scale = np.sqrt(pairs.own[:, 1, 1].mean() / max(pairs.own[:, 0, 0].mean(), 1e-12)) or 1.0
    x, y = pairs.x * scale, pairs.y
    c = np.cov(x, y)
    slope = np.tan(0.5 * np.arctan2(2.0 * c[0, 1], c[0, 0] - c[1, 1]))
    left = np.std((y - slope * x) - np.mean(y - slope * x), ddof=2)
    return slope * scale, 1.96 * left / np.sqrt(np.sum((pairs.x - pairs.x.mean()) ** 2))


def york(pairs: LogPairs, rounds: int = 60) -> tuple[float, float]:
    """Return exponent and half width of York et al. (2004, doi:10.1119/1.1632486), without scatter."""
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


OTHERS: tuple[Callable[[LogPairs], tuple[float, float]], ...] = (least_squares, orthogonal, york)


def law_cells(name: str, n: int, count: int) -> list[str]:
    """Return coverage of exponent, scatter and prediction, and of the exponents of other regressions."""
    population, rng = POPULATIONS[name], np.random.default_rng(n)
    exponents, hits = list[float](), np.full((count, 3 + len(OTHERS)), np.nan)
    for k in range(count):
        pairs, (x, y) = population.draw(rng, n)
        law, _ = fit_law(pairs)
        exponents.append(law.exponent)
        hits[k, 0] = law.interval[0] <= population.exponent <= law.interval[1]
        hits[k, 1] = law.sigma_interval[0] <= SCATTER <= law.sigma_interval[1]
        if not population.common and not population.batches:
            sd = float(np.sqrt(pairs.own[0, 0, 0]))
            low, high = Predictor(pairs).predict(x + sd * rng.standard_normal(), sd**2).interval
            hits[k, 2] = low <= y <= high
        for column, other in enumerate(OTHERS, start=3):
            value, half = other(pairs)
            hits[k, column] = abs(value - population.exponent) <= half
    spread = np.subtract(*np.percentile(exponents, [75, 25])) / 1.349
    bias = (np.median(exponents) - population.exponent) / spread
    means = [NOTHING if np.isnan(column).all() else f"{100 * column.mean():.0f}" for column in hits.T]
    return [means[0], f"{bias:+.2f}", *means[1:]]


def rows(cells: Callable[[str, int, int], list[str]], count: int) -> Iterator[list[str]]:
    """Yield one row a population; each cell has the figures of all sizes of a cohort."""
    for name in POPULATIONS:
        by_size = [cells(name, n, count) for n in SIZES]
        yield [
            name,
            *("/".join(own) if set(own) != {NOTHING} else NOTHING for own in zip(*by_size, strict=True)),
        ]


if __name__ == "__main__":
    given = arguments(__doc__, cohorts=40)
    error = 100.0 * np.sqrt(0.0475 / given.cohorts)
    print(f"Intervals that hold, in %, with {', '.join(map(str, SIZES))} ears; {given.cohorts} cohorts each,")
    print(f"standard error of a share {error:.1f} %.\n")
    head = ("population", "exponent", "bias / sd", "scatter", "prediction")
    print_table((*head, "least squares", "orthogonal", "York"), rows(law_cells, given.cohorts))
