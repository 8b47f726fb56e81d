"""Frequency responses from time series: bias and stated noise by Monte Carlo; speed beside scipy.

Prints two tables. Usage: python benchmarks/frf_estimates.py [REPLICAS [SEED]]
"""

from __future__ import annotations

import sys
import time

import numpy as np
from scipy.signal import csd, lfilter, welch

from legacy.kinematics.signals.frf import Welch, welch_frf
from legacy.kinematics.signals.frf_local import Local, local_frf
from legacy.kinematics.signals.frf_periodic import Periodic, periodic_frf
from legacy.kinematics.signals.lock_in import SteppedSine
from legacy.kinematics.signals.stepped_sine import Step, stepped_frf

RATE = 8192.0
LINES = np.arange(10, 200, 3)
PERIOD = 512
FREQ = np.linspace(200.0, 2000.0, 12)
COUNT = 1600


def plant(freq_hz):
    """Return 0.5 / (1 - 0.4 z^-1)."""
    return 0.5 / (1.0 - 0.4 * np.exp(-2j * np.pi * freq_hz / RATE))


def coloured(rng, shape, colour):
    """Return noise of unit variance with a pole at ``colour``."""
    return lfilter([np.sqrt(1.0 - colour**2)], [1.0, -colour], rng.standard_normal(shape))


def random(how, into, out):
    """Return a replica of an estimate from random excitation."""

    def make(rng):
        drive = rng.standard_normal(8192)
        answer = lfilter([0.5], [1.0, -0.4], drive)[None]
        return welch_frf(
            [(drive + into * rng.standard_normal(8192), answer + out * rng.standard_normal(answer.shape))],
            RATE,
            how,
        )

    return make


def local(into, out):
    """Return a replica of an estimate by local polynomials from random excitation."""

    def make(rng):
        drive = rng.standard_normal(8192)
        answer = lfilter([0.5], [1.0, -0.4], drive)[None]
        noisy = answer + out * rng.standard_normal(answer.shape)
        return local_frf([(drive + into * rng.standard_normal(8192), noisy)], RATE, Local(RATE / 256))

    return make


def periodic(into, out, periods, colour=0.0):
    """Return a replica of an estimate from a multisine of random phases."""

    def make(rng):
        at = np.arange(PERIOD * (periods + 1))
        phase = rng.uniform(0.0, 2.0 * np.pi, len(LINES))
        drive = np.cos(2.0 * np.pi * np.outer(at, LINES) / PERIOD + phase).sum(axis=1)
        answer = lfilter([0.5], [1.0, -0.4], drive)[None]
        noise = out * coloured(rng, answer.shape, colour)
        return periodic_frf(
            [(drive + into * rng.standard_normal(len(at)), answer + noise)], RATE, Periodic(PERIOD / RATE)
        )

    return make


def stepped(into, out, colour=0.0, clock=1.0):
    """Return a replica of a stepped sine with drift and 10 % second harmonic."""

    def make(rng):
        at = np.arange(COUNT) / RATE
        steps = []
        for freq in FREQ:
            wave = np.exp(1j * (2.0 * np.pi * freq * clock * at + rng.uniform(0.0, 2.0 * np.pi)))
            answer = np.real(plant(freq * clock) * wave + 0.05 * wave**2) + 0.5 * at
            noise = out * coloured(rng, (1, COUNT), colour)
            steps.append(Step(freq, wave.real + into * rng.standard_normal(COUNT), answer[None] + noise))
        return stepped_frf(steps, RATE, SteppedSine(settle=0.0))

    return make


CASES = [
    ("H1, Hann, 50 % overlap, 31 segments", random(Welch(512), 0.0, 0.5), "0 / 0.5"),
    ("H1, Hann, 75 % overlap", random(Welch(512, overlap=0.75), 0.0, 0.5), "0 / 0.5"),
    ("H1, no window, no overlap", random(Welch(512, "none", 0.0), 0.0, 0.5), "0 / 0.5"),
    ("H1, 7 segments", random(Welch(2048), 0.0, 0.5), "0 / 0.5"),
    ("H1", random(Welch(512), 0.3, 0.0), "0.3 / 0"),
    ("H2", random(Welch(512, estimator="h2"), 0.3, 0.0), "0.3 / 0"),
    ("H2", random(Welch(512, estimator="h2"), 0.0, 0.3), "0 / 0.3"),
    ("H1", random(Welch(512), 0.3, 0.3), "0.3 / 0.3"),
    ("Hv, powers of the signals", random(Welch(512, estimator="hv"), 0.3, 0.3), "0.3 / 0.3"),
    ("Hv, noise ratio known", random(Welch(512, estimator="hv", noise_ratio=1.0), 0.3, 0.3), "0.3 / 0.3"),
    ("local polynomials, 32 lines", local(0.0, 0.5), "0 / 0.5"),
    ("multisine, 10 periods", periodic(0.0, 1.0, 10), "0 / 1"),
    ("multisine, 10 periods", periodic(0.5, 1.0, 10), "0.5 / 1"),
    ("multisine, 3 periods, coloured noise", periodic(0.0, 1.0, 3, 0.9), "0 / 1"),
    ("stepped sine", stepped(0.0, 0.3), "0 / 0.3"),
    ("stepped sine, noise in both", stepped(0.2, 0.3), "0.2 / 0.3"),
    ("stepped sine, coloured noise", stepped(0.0, 0.3, 0.97), "0 / 0.3"),
    ("stepped sine, clocks 200 ppm apart", stepped(0.0, 0.3, clock=1.0 + 2e-4), "0 / 0.3"),
]


def accuracy(replicas, seed):
    """Print bias, spread over stated sd, and coverage about the mean."""
    print("| estimate | noise in reference / response | bias | sd of error / stated sd | 95 % holds |")
    print("|-|-|-|-|-|")
    for number, (name, make, noise) in enumerate(CASES):
        rng = np.random.default_rng([seed, number])
        estimates = [make(rng) for _ in range(replicas)]
        value = np.array([estimate.value[0] for estimate in estimates])
        sd = np.array([estimate.sd[0] for estimate in estimates])
        true = plant(estimates[0].freq_hz)
        bias = np.mean(value / true) - 1.0
        error = value - np.mean(value, axis=0)
        ratio = np.sqrt(np.mean(np.abs(error) ** 2) / 2.0 / np.mean(sd**2) * replicas / (replicas - 1))
        parts = np.concatenate([np.abs(error.real) / sd, np.abs(error.imag) / sd])
        held = np.mean(parts < 1.959964)
        print(
            f"| {name} | {noise} | {100.0 * bias.real:+.2f} % | {ratio:.3f} | {100.0 * held:.1f} % |",
            flush=True,
        )


def speed(seed):
    """Print processor seconds for one reference, 60 channels and 400 000 samples."""
    rng = np.random.default_rng(seed)
    drive = rng.standard_normal(400_000)
    answer = np.arange(1.0, 61.0)[:, None] * drive + rng.standard_normal((60, len(drive)))
    jobs = {
        "scipy.signal csd + welch (H1, coherence)": lambda: (
            csd(drive, answer, 5e4, nperseg=16384),
            welch(drive, 5e4, nperseg=16384),
            welch(answer, 5e4, nperseg=16384),
        ),
        "welch_frf (H1, coherence, sd, noise of the reference)": lambda: welch_frf(
            [(drive, answer)], 5e4, Welch(16384)
        ),
    }
    print("\n| 60 channels, 400 000 samples, 47 segments | CPU, least of three |\n|-|-|")
    for name, job in jobs.items():
        best = np.inf
        for _ in range(3):
            start = time.process_time()
            job()
            best = min(best, time.process_time() - start)
        print(f"| {name} | {best:.2f} s |")


def main():
    """Run both tables."""
    replicas = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    accuracy(replicas, seed)
    speed(seed)


if __name__ == "__main__":
    main()
