"""False alarms, power and pooling of repeats and levels: prints markdown tables.

``python benchmarks/points_repeats.py [REPLICATES [SEED]]``; 10 ms of processor time each.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from legacy.kinematics.measurement import BodyChannels, Measurement, Take
from legacy.kinematics.repeats.comparison import code_of
from legacy.kinematics.repeats.pooling import pool_repeats

RESONANCES = ((1753.0, 0.12), (2783.0, 0.14))
ALARM = {
    "5 repeats": {},
    "5 repeats, no sd stated": {"sd": False},
    "3 repeats, no sd stated": {"repeats": 3, "sd": False},
    "2 repeats": {"repeats": 2},
    "3 repeats at 3 levels": {"repeats": 3, "levels": (1.0, 2.0, 4.0)},
    "5 repeats, Hann window": {"window": True},
    "5 repeats, channels of unequal noise, no sd": {"unequal": True, "sd": False},
    "5 repeats, SNR 10": {"snr": 10.0},
    "3 repeats, sd estimated from 3 averages": {"repeats": 3, "averages": 3},
    "10 repeats, sd estimated from 3 averages": {"repeats": 10, "averages": 3},
}
FAULTS = {
    "resonance −0.3 % over 5 repeats": ("repeat_creep", {"creep": -0.003}),
    "resonance −0.5 % over 5 repeats": ("repeat_creep", {"creep": -0.005}),
    "resonance −0.5 % over 3 repeats, no sd": ("repeat_creep", {"creep": -0.005, "repeats": 3, "sd": False}),
    "one of 5 repeats with resonance +0.5 %": ("repeat_outlier", {"outlier": 0.005}),
    "one of 10 repeats 30 % louder": ("repeat_outlier", {"loud": 0.30, "repeats": 10}),
    "amplitude +20 % over 5 repeats": ("repeat_drift", {"drift": 0.2}),
    "amplitude +20 % over 10 repeats": ("repeat_drift", {"drift": 0.2, "repeats": 10}),
    "resonance −1 % over levels 1, 2, 4": (
        "level_nonlinear",
        {"nonlinear": -0.01, "levels": (1.0, 2.0, 4.0), "repeats": 2},
    ),
    "amplitude as level^0.9": ("level_gain", {"power": 0.9, "levels": (1.0, 2.0, 4.0), "repeats": 3}),
}


def simulate(
    rng,
    repeats=5,
    levels=(),
    lines=100,
    snr=50.0,
    sd=True,
    gain_sd=0.03,
    window=False,
    unequal=False,
    averages=0,
    vary=0.0,
    creep=0.0,
    outlier=0.0,
    loud=0.0,
    drift=0.0,
    nonlinear=0.0,
    power=1.0,
):
    """Return a measurement of two bodies with repeats, and the shapes (body, channel, freq) of the first."""
    freq = np.linspace(400.0, 5000.0, lines)
    takes = [Take("1", str(k + 1), level) for level in levels or (np.nan,) for k in range(repeats)]
    level = np.array([take.level if np.isfinite(take.level) else 1.0 for take in takes])
    order = np.array([float(take.repeat) - 1.0 for take in takes])
    share = order / max(repeats - 1, 1)
    steps = np.log(level / level.min()) / max(np.log(level.max() / level.min()), 1e-9)
    gain = level**power * np.exp(gain_sd * (rng.normal(size=len(takes)) + 0.3j * rng.normal(size=len(takes))))
    gain *= (1.0 + drift * share) * np.where(order == 1.0, 1.0 + loud, 1.0)
    moved = 1.0 + creep * share + nonlinear * steps + np.where(order == 1.0, outlier, 0.0)
    piston, turns = np.abs(rng.normal(size=12)) + 0.5, rng.normal(size=(2, 12))
    stapes = np.empty((len(takes), 12, lines), dtype=complex)
    for take in range(len(takes)):
        stapes[take] = piston[:, None]
        for (resonance, damping), weight in zip(RESONANCES, turns, strict=True):
            ratio = freq / (resonance * moved[take])
            stapes[take] += weight[:, None] / (1.0 - ratio**2 + 2j * damping * ratio)
    base = np.broadcast_to(1.0 + 0.1 * rng.normal(size=(6, 1)), (len(takes), 6, lines)).astype(complex)
    bodies, truth = [], []
    scale = np.sqrt(np.mean(np.abs(stapes[0]) ** 2)) / snr / np.sqrt(2.0) * np.max(level)
    for name, response in (("stapes", stapes), ("base", base)):
        count = response.shape[1]
        spread = np.full(count, scale) * (np.exp(0.7 * rng.normal(size=count)) if unequal else 1.0)
        noise = rng.normal(size=(len(takes), count, lines + 2, 2)) @ np.array([1.0, 1j])
        if window:
            noise = (noise - 0.5 * (np.roll(noise, 1, axis=2) + np.roll(noise, -1, axis=2))) / np.sqrt(1.5)
        spread = np.broadcast_to(spread[None, :, None], response.shape)
        value = gain[:, None, None] * response + spread * noise[..., 1:-1]
        if vary:
            value = value * (
                1.0 + vary * (rng.normal(size=(len(takes), count, 2)) @ np.array([1.0, 1j]))[..., None]
            )
        if averages:
            freedom = 2 * (averages - 1)
            spread = spread * np.sqrt(rng.chisquare(freedom, spread.shape) / freedom)
        points = tuple(str(k // 3) for k in range(count))
        places, beams = rng.normal(size=(count, 3)), np.tile(np.eye(3), (count // 3, 1))
        bodies.append(BodyChannels(name, points, places, beams, value, spread if sd else None, not sd))
        truth.append(response[0])
    runs = tuple(take.name for take in takes)
    return Measurement("footplate", runs, freq, tuple(bodies), 0, takes=tuple(takes)), truth


def alarms(replicates, seed):
    """Print how often data without a fault raise an alarm."""
    print("| no fault; amplitudes scatter by 3 % | any alarm | single tests below 0.05 |\n|-|-|-|")
    for row, (name, options) in enumerate(ALARM.items()):
        detected, low, count = 0, 0, 0
        for k in range(replicates):
            report = pool_repeats(simulate(np.random.default_rng([seed, row, k]), **options)[0]).repeats[0]
            detected += bool(report.found)
            values = [test.p_value for test in report.tests if test.name != "shape_scatter"]
            low, count = low + sum(p < 0.05 for p in values), count + len(values)
        print(f"| {name} | {100 * detected / replicates:.1f} % | {100 * low / count:.1f} % |", flush=True)


def powers(replicates, seed):
    """Print how often a fault is found and named."""
    print("\n| fault | found | named right | other findings beside it |\n|-|-|-|-|")
    for row, (name, (code, options)) in enumerate(FAULTS.items()):
        detected, right, others = 0, 0, Counter()
        for k in range(replicates):
            report = pool_repeats(
                simulate(np.random.default_rng([seed, 100 + row, k]), **options)[0]
            ).repeats[0]
            codes = [code_of(test) for test in report.found]
            detected += bool(codes)
            right += code in codes
            others.update(other for other in set(codes) - {code})
        extra = ", ".join(f"{other} {100 * n / replicates:.1f} %" for other, n in others.most_common(3))
        shares = f"{100 * detected / replicates:.1f} % | {100 * right / replicates:.1f} %"
        print(f"| {name} | {shares} | {extra or '—'} |", flush=True)


def pooling(replicates, seed):
    """Print the scatter of pooled values over their stated deviation, and the same of a plain mean."""
    print("\n| pooled, ratios to the common gain | error² / stated variance | 95 % intervals hold | ", end="")
    print("sd of a plain mean of ratios over that of the pooled one |\n|-|-|-|-|")
    cases = {
        "5 repeats": {},
        "5 repeats, no sd": {"sd": False},
        "3 repeats, no sd": {"repeats": 3, "sd": False},
        "2 repeats, no sd": {"repeats": 2, "sd": False},
        "5 repeats, unequal noise, no sd": {"unequal": True, "sd": False},
        "3 repeats, sd estimated from 3 averages": {"repeats": 3, "averages": 3},
        "10 repeats, sd estimated from 3 averages": {"repeats": 10, "averages": 3},
        "3 repeats, channels differ by 3 % between them": {"repeats": 3, "vary": 0.03},
        "5 repeats, channels differ by 10 % between them": {"vary": 0.1},
        "5 repeats, channels differ by 10 %, no sd": {"vary": 0.1, "sd": False},
        "3 levels 1, 2, 4": {"levels": (1.0, 2.0, 4.0), "repeats": 1},
    }
    for row, (name, options) in enumerate(cases.items()):
        square, inside, plain = [], [], []
        for k in range(replicates):
            measured, truth = simulate(np.random.default_rng([seed, 200 + row, k]), **options)
            mean = pool_repeats(measured).measurement
            value = np.concatenate([body.displacement[0] for body in mean.bodies])
            sd = np.concatenate([body.sd[0] for body in mean.bodies])
            true = np.concatenate(truth)
            weight = 1.0 / sd**2
            own = np.sum(weight * true.conj() * value, axis=0) / np.sum(weight * np.abs(true) ** 2, axis=0)
            error = (value - own * true) / sd
            lever = 1.0 - weight * np.abs(true) ** 2 / np.sum(weight * np.abs(true) ** 2, axis=0)
            error = error / np.sqrt(lever)
            square.append(np.mean(np.abs(error) ** 2) / 2.0)
            inside.append(np.mean(np.abs(error.real) < 1.959964))
            raw = np.concatenate([body.displacement for body in measured.bodies], axis=1)
            scaled = np.mean(raw / raw[:, -1:], axis=0)
            want = true / true[-1:]
            best = (
                np.abs(want) / np.abs(own * true) * sd * np.sqrt(1.0 + np.abs(want) ** 2 * (sd[-1] / sd) ** 2)
            )
            ratio = value / value[-1:]
            both = [np.mean(np.abs((x - want)[:-1] / best[:-1]) ** 2) for x in (scaled, ratio)]
            plain.append(np.sqrt(both[0] / both[1]))
        numbers = f"{np.mean(square):.3f} | {100 * np.mean(inside):.1f} % | {np.mean(plain):.2f}"
        print(f"| {name} | {numbers} |", flush=True)


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    start = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    alarms(count, start)
    powers(max(count // 5, 20), start)
    pooling(max(count // 10, 20), start)
