"""How often are wrong sizes and shifted frequencies of two bodies named, and right ones called wrong?

    python benchmarks/two_bodies.py --motions 100

A stapes of six degrees of freedom in a ligament of drawn stiffness, damping and coupling, and the bone that
shakes it, with a resonance of its own; the geometry of either is off by up to 3 %. Named: one body is in rms
and the other in peak values, or in a range 5 times another, or its frequencies are shifted by some lines,
and the warning says so; wrong: a warning says something else. Noise is a share of the motion.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from legacy.kinematics.faults.judges.phase_convention import compare_labels, size_notices
from legacy.kinematics.faults.proposals.two_bodies import Pair

LEVER_M = 1e-3
UNIT_M = np.array([1.0, 1.0, 1.0, LEVER_M, LEVER_M, LEVER_M])


def shaken(
    seed: int,
    lines: int,
    *,
    band: tuple[float, float] = (200.0, 6000.0),
    even: bool = False,
    runs: int = 1,
    noise: float = 0.01,
    off: float = 0.0,
    fluid: float = 0.0,
) -> Pair:
    """Draw a stapes of six degrees of freedom on its ligament and the bone that shakes it.

    Parameters
    ----------
    seed, lines, runs : int
    band : tuple of float
        First and last frequency, Hz.
    even : bool
        Lines at even steps, as an FFT has them; else logarithmic.
    noise, off : float
        Noise of the motions, and errors of either geometry, as shares of the motion.
    fluid : float
        Mass of a load that moves with the stapes and is not in its mass matrix, as a share of that.
    """
    rng = np.random.default_rng([seed, 31])
    freq = np.linspace(*band, lines) if even else np.geomspace(*band, lines)
    size = 1e-7 * np.array([0.3, 1.0, 0.3, 200.0, 100.0, 200.0])
    mass = np.diag([3e-6, 3e-6, 3e-6, 2.4e-12, 7e-13, 3e-12])
    resonance = 2.0 * np.pi * np.exp(rng.uniform(np.log(1200.0), np.log(6000.0), 6))
    stiffness = mass * resonance**2
    stiffness[1, 3] = stiffness[3, 1] = 0.3 * np.sqrt(stiffness[1, 1] * stiffness[3, 3])
    damping = 2.0 * rng.uniform(0.05, 0.25, 6) * mass * resonance
    moving = mass * (1.0 + fluid)
    moved = np.zeros((2, runs, lines, 6), dtype=complex)
    for run in range(runs):
        own, shape = rng.uniform(500.0, 7000.0), rng.normal(size=(6, 2)) @ [1.0, 0.3j]
        moved[1, run] = size * (
            rng.choice([-1.0, 1.0]) + np.outer(1.0 / (1.0 - (freq / own) ** 2 + 0.4j), shape)
        )
        for k, w in enumerate(2.0 * np.pi * freq):
            ligament = stiffness * (1.0 + 0.05j) + 1j * w * damping
            moved[0, run, k] = np.linalg.solve(ligament - w**2 * moving, ligament @ moved[1, run, k])
    spread = np.sqrt(0.5 * np.mean(np.abs(moved * UNIT_M) ** 2, axis=(2, 3), keepdims=True)) * noise / UNIT_M
    sd = np.broadcast_to(spread, moved.shape)
    read = moved + sd * (rng.normal(size=(*moved.shape, 2)) @ [1.0, 1j])
    geometry = np.eye(6) + off * rng.normal(size=(2, 1, 6, 6))
    read = (read * UNIT_M) @ geometry / UNIT_M
    names, numbers = ("stapes", "base"), tuple(str(1 + run) for run in range(runs))
    return Pair(read[0], read[1], sd.swapaxes(0, 1), freq, np.eye(6), names, numbers, UNIT_M)


def resized(pair: Pair, factor: float, run: int | slice = slice(None)) -> Pair:
    """Return a pair with the base read ``factor`` times too small."""
    base, sd = pair.base.copy(), pair.sd.copy()
    base[run] /= factor
    sd[run, 1] /= factor
    return replace(pair, base=base, sd=sd)


def shifted(pair: Pair, lines: int) -> Pair:
    """Return a pair with the readings of the base some lines from where they belong."""
    there, here = slice(lines, None), slice(None, -lines)
    sd = np.stack([pair.sd[:, 0, here], pair.sd[:, 1, there]], axis=1)
    return replace(
        pair, structure=pair.structure[:, here], base=pair.base[:, there], sd=sd, freq_hz=pair.freq_hz[here]
    )


def said(pair: Pair) -> list[str]:
    """Return the warnings on labels, or else on sizes."""
    labels = compare_labels(pair)
    if labels is not None and labels.believed:
        return [labels.notice().text]
    return [notice.text for notice in size_notices(pair)]


Wrong = Callable[[Pair], Pair]
# The error, fewest lines at which it is looked for, what is made of a pair, and a pattern of the warning: it
# names a size together with those that explain as much.
ERRORS: dict[str, tuple[int, Wrong, str]] = {
    "base in rms": (2, lambda pair: resized(pair, np.sqrt(2.0)), "base looks given in rms"),
    "stapes in rms": (2, lambda pair: resized(pair, np.sqrt(0.5)), "stapes looks given in rms"),
    "another range (5)": (2, lambda pair: resized(pair, 5.0), r"with base (\S+ or )*5 (or \S+ )*times"),
    "shift by 1 line": (60, lambda pair: shifted(pair, 1), r"\(1 lines\)"),
    "shift by 2 lines": (60, lambda pair: shifted(pair, 2), r"\(2 lines\)"),
    "shift by 3 lines": (60, lambda pair: shifted(pair, 3), r"\(3 lines\)"),
}
LINES = (6, 9, 12, 24, 60, 120)
NOISE = (0.003, 0.01, 0.03)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--motions", type=int, default=100, help="of a cell")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    started, count = time.process_time(), arguments.motions

    def seeds(lines: int, column: int) -> range:
        first = 1_000_000 * arguments.seed + 10_000 * lines + 1_000 * column
        return range(first, first + count)

    print(
        "| error | lines | "
        + " | ".join(f"noise {100.0 * noise:g} %: named; wrong" for noise in NOISE)
        + " |"
    )
    print("|-|-|" + "-|" * len(NOISE))
    for error, (least, wrong, words) in ERRORS.items():
        for lines in LINES:
            if lines < least:
                continue
            row = []
            for column, noise in enumerate(NOISE):
                pairs = (
                    shaken(seed, lines, even=lines >= 60, noise=noise, off=0.01 * (seed % 4))
                    for seed in seeds(lines, column)
                )
                texts = [said(wrong(pair)) for pair in pairs]
                named = sum(any(re.search(words, text) for text in of_one) for of_one in texts)
                row.append(f"{named / count:.2f}; {(sum(map(bool, texts)) - named) / count:.2f}")
            print(f"| {error} | {lines} | " + " | ".join(row) + " |")
    print()
    print(
        "| right motions | lines | "
        + " | ".join(f"noise {100.0 * noise:g} %: warned" for noise in NOISE)
        + " |"
    )
    print("|-|-|" + "-|" * len(NOISE))
    for name, fluid, runs in (("as simulated", 0.0, 1), ("three runs", 0.0, 3), ("load of .5 M", 0.5, 1)):
        for lines in LINES:
            row = []
            for column, noise in enumerate(NOISE):
                warned = 0
                for seed in seeds(lines, column + 5):
                    low = 100.0 * 10.0 ** (seed % 5 / 4.0)
                    band, off = (low, min(30.0 * low, 12e3)), 0.01 * (seed % 4)
                    pair = shaken(
                        seed, lines, band=band, even=lines >= 60, runs=runs, noise=noise, off=off, fluid=fluid
                    )
                    warned += bool(said(pair))
                row.append(f"{warned / count:.3f}")
            print(f"| {name} | {lines} | " + " | ".join(row) + " |")
    print(f"\n{time.process_time() - started:.0f} s of processor time, seed {arguments.seed}.")


if __name__ == "__main__":
    main()
