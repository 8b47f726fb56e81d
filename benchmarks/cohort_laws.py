"""Laws over simulated cohorts with a planted exponent, compared with the regressions that laboratories use.

    python benchmarks/cohort_laws.py [--cohorts 240 120 120] [--page docs/cohort_coverage.md]
    python benchmarks/cohort_laws.py --ranges 160

Coverage of the 95 % intervals of exponent, scatter and predictions, median bias in standard errors, and the
coverage of least squares, orthogonal and York's regression (no scatter) on the same cohorts; then the number
of components, and findings where there is no law. ``--ranges`` prints instead how often the normal range of a
response and the prediction of a further ear hold its true value, from so many cohorts a row, and the bias of
the exponent at n = 8 from five times as many.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import stats

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from legacy.pipeline.cohort.false_discovery import false_discovery
from legacy.pipeline.cohort.independent_parameters import independent_parameters
from legacy.pipeline.cohort.log_pairs import LogPairs
from legacy.pipeline.cohort.power_law import Profile, fit_law
from legacy.pipeline.cohort.prediction import Predictor
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


def law_row(name, scene, n, count):
    """Return the cells of one simulated population."""
    truth = scene.get("exponent", EXPONENT)
    rng = np.random.default_rng(n)
    hits, estimates, seconds = np.full((count, 6), np.nan), [], 0.0
    for k in range(count):
        pairs, (x, y) = cohort(rng, n, **scene)
        begun = time.process_time()
        law = fit_law(pairs)
        seconds += time.process_time() - begun
        estimates.append(law.exponent)
        hits[k, 0] = law.interval[0] <= truth <= law.interval[1]
        hits[k, 1] = law.sigma_interval[0] <= 0.2 <= law.sigma_interval[1]
        if not scene.get("common") and not scene.get("batches"):
            sd = float(np.sqrt(pairs.own[0, 0, 0]))
            low, high = Predictor(pairs).predict(x + sd * rng.standard_normal(), sd**2).interval
            hits[k, 2] = low <= y <= high
        for column, method in ((3, least_squares), (4, orthogonal), (5, york)):
            b, half = method(pairs)
            hits[k, column] = abs(b - truth) <= half
    spread = np.subtract(*np.percentile(estimates, [75, 25])) / 1.349
    bias = (np.median(estimates) - truth) / spread
    shares = [f"{hits[:, c].mean():.3f}" if np.all(np.isfinite(hits[:, c])) else "–" for c in range(6)]
    return [name, n, count, shares[0], f"{bias:+.2f}", *shares[1:], f"{1e3 * seconds / count:.0f}"]


def range_row(name, scene, n, count):
    """Return how often range and prediction of a further ear hold, with the shared errors and without them.

    The error that all ears have in common is in what is measured of the further ear, too.
    """
    scene = dict(scene)
    shift = scene.pop("common", 0.0)
    rng = np.random.default_rng([n, 15])
    hits, widths = np.zeros((count, 4)), []
    for k in range(count):
        pairs, (x, y) = cohort(rng, n, **scene)
        error = shift * rng.standard_normal()
        pairs = replace(pairs, x=pairs.x + error, y=pairs.y + error)
        predictor, own = Predictor(pairs), float(pairs.own[0, 0, 0])
        seen = x + error + np.sqrt(own) * rng.standard_normal()
        found = [predictor.tolerance(), predictor.predict(seen, own).interval]
        shared = shift**2 + float(np.mean(np.sum(pairs.shared[:, 1] ** 2, axis=1)))
        found += [predictor.tolerance(shared), predictor.predict(seen, own, shared).interval]
        hits[k] = [low <= y <= high for low, high in found]
        widths.append([0.5 * (high - low) for low, high in found[2:]])
    shares = [f"{share:.3f}" for share in hits.mean(axis=0)]
    return [
        name,
        n,
        count,
        shares[0],
        shares[2],
        shares[1],
        shares[3],
        *(f"{width:.2f}" for width in np.median(widths, 0)),
    ]


def bias_row(name, scene, count):
    """Return the median bias of the exponent over its sd at n = 8 and its standard error."""
    truth, rng = scene.get("exponent", EXPONENT), np.random.default_rng([8, 15])
    found = []
    for _ in range(count):
        pairs, _ = cohort(rng, 8, **scene)
        found.append(Profile(pairs.centred().without_common_errors()).best.point[1])
    spread = np.subtract(*np.percentile(found, [75, 25])) / 1.349
    return [name, count, f"{(np.median(found) - truth) / spread:+.2f}", f"{1.253 / np.sqrt(count):.2f}"]


def component_row(n, count):
    """Return how often two planted components of six quantities are counted."""
    rng = np.random.default_rng(n)
    results = []
    for k in range(count):
        axes, _ = np.linalg.qr(rng.standard_normal((6, 2)))
        values = rng.standard_normal((n, 2)) @ (axes * [0.6, 0.3]).T
        values += 0.08 * rng.standard_normal((n, 6))
        results.append(independent_parameters(values, np.tile(0.08**2 * np.eye(6), (n, 1, 1)), seed=k))
    exact = np.mean([result.estimate == 2 for result in results])
    held = np.mean([result.interval[0] <= 2 <= result.interval[1] for result in results])
    return [n, f"{exact:.3f}", f"{held:.3f}"]


def discovery_row(n, count):
    """Return how often 72 dependent tests without any law yield a finding, adjusted and not."""
    rng = np.random.default_rng(n)
    adjusted = plain = 0
    own = np.tile([[0.03**2, 0.0], [0.0, 0.05**2]], (n, 1, 1))
    for _ in range(count):
        size, shape, stiff = rng.standard_normal((3, n, 1))
        x = 0.12 * (0.8 * size + 0.4 * shape + 0.4 * rng.standard_normal((n, 9)))
        y = 0.25 * (0.8 * stiff + 0.6 * rng.standard_normal((n, 8)))
        x, y = x + 0.03 * rng.standard_normal(x.shape), y + 0.05 * rng.standard_normal(y.shape)
        pairs = [LogPairs(a, b, own).centred() for a in x.T for b in y.T]
        p = np.array([Profile(pair).p_value() for pair in pairs])
        plain += p.min() < 0.05
        adjusted += np.nanmin(false_discovery(p)) < 0.10
    return [n, f"{adjusted / count:.3f}", f"{plain / count:.2f}"]


def table(header, rows):
    """Return lines of a table in Markdown."""
    lines = [header, ["-"] * len(header), *rows]
    return ["| " + " | ".join(map(str, line)) + " |" for line in lines]


LAWS = ("population", "n", "cohorts", "exponent", "bias / sd", "scatter", "prediction")
LAWS = (*LAWS, "least squares", "orthogonal", "York", "ms a law")


def kept(path):
    """Return the part of a page that another command makes."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    return "\n" + text[text.index(MARK) :] if MARK in text else ""


def page(counts, laws, components, discoveries):
    """Return docs/cohort_coverage.md without what `kept` returns."""
    few, tests = counts
    return "\n".join(
        [
            "# Laws over simulated cohorts: what the intervals hold",
            "",
            "Made by `python benchmarks/cohort_laws.py --page docs/cohort_coverage.md`. Planted: exponent 1.5"
            " (0 without a law), scatter 0.20, spread of ln x 0.12, errors 0.05 and 0.07 (correlation 0.3).",
            "",
            "Share of simulated cohorts whose 95 % interval holds the truth (standard error 0.010 with 480 "
            "cohorts, 0.014 with 240, 0.020 with 120; of the bias 0.06, 0.08, 0.11): exponent, scatter and "
            "the response of a further ear by this program, then the exponent by least squares, orthogonal "
            "and York's regression on the same "
            "cohorts. Meant: exponent 0.93 to 0.98 (0.91 with heavy tails), bias at most 0.15 sd, scatter "
            "0.93 to 0.98, prediction 0.93 to 0.99. The interval of the scatter assumes a normal one: with "
            "heavy tails it holds in 80 to 90 of 100 cohorts.",
            "",
            *table(LAWS, laws),
            "",
            f"Two planted components among six quantities (sd 0.60 and 0.30, errors 0.08), {few} cohorts a "
            "row. Meant: 0.90, 0.95, 0.95.",
            "",
            *table(("n", "counted 2", "interval holds 2"), components),
            "",
            f"72 dependent tests where there is no law, {tests} cohorts a row: share of cohorts with a "
            "finding at q = 0.10 (meant: at most 0.11), and with an unadjusted p < 0.05.",
            "",
            *table(("n", "q < 0.10", "p < 0.05"), discoveries),
            "",
        ]
    )


RANGES = ("population", "n", "cohorts", "range", "range, true", "prediction", "prediction, true")
RANGES = (*RANGES, "half width of the range (ln)", "of the prediction")


RANGES_TEXT = """Share of further ears whose true response lies in the 95 % normal range of the cohort ("is
this ear normal") and in the prediction from the ear's scan alone, on other cohorts than above. "True" adds
the errors that ears share, as `cohort.json` and `predict` do; without them the interval is one of what these
laboratories would measure."""
BIAS_TEXT = """Median bias of the exponent over its sd at n = 8, from more cohorts, the same draws in every
row (meant: 0.15)."""
MARK = "<!-- python benchmarks/cohort_laws.py --ranges"


def ranges(count):
    """Print the tables of normal ranges and predictions, and of the bias at n = 8."""
    print(RANGES_TEXT, "", sep="\n")
    print(*table(RANGES, []), sep="\n", flush=True)
    for n in (8, 16, 40):
        for name, scene in SCENES.items():
            print(*table(RANGES, [range_row(name, scene, n, count)])[2:], sep="\n", flush=True)
    print("", BIAS_TEXT, sep="\n")
    print("", *table(("population", "cohorts", "bias / sd", "standard error"), []), sep="\n", flush=True)
    for name, scene in SCENES.items():
        print(*table([0] * 4, [bias_row(name, scene, 5 * count)])[2:], sep="\n", flush=True)


def main() -> None:
    """Print the page, or write it as it grows."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument(
        "--cohorts", type=int, nargs=3, default=(60, 60, 60), help="for n = 8, 16 and 40; 0 leaves n out"
    )
    given.add_argument("--page", type=Path)
    given.add_argument("--ranges", type=int, default=0, help="cohorts a row of the table of ranges")
    options = given.parse_args()
    if options.ranges:
        ranges(options.ranges)
        return
    laws, components, discoveries = [], [], []
    sizes = [(n, count) for n, count in zip((8, 16, 40), options.cohorts, strict=True) if count]
    counts = max(sizes[-1][1] // 2, 20), max(sizes[-1][1] // 3, 10)
    scenes = [(name, scene, n, count) for n, count in sizes for name, scene in SCENES.items()]
    parts = [(laws, law_row, case) for case in scenes]
    parts += [(components, component_row, (n, counts[0])) for n in (8, 16, 40)]
    parts += [(discoveries, discovery_row, (n, counts[1])) for n in (8, 16)]
    for rows, work, arguments in parts:
        rows.append(work(*arguments))
        print(*rows[-1], sep="\t", flush=True)
        if options.page is not None:
            text = page(counts, laws, components, discoveries) + kept(options.page)
            options.page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
