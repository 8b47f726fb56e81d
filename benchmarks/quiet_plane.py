"""Coverage of K and D where the bodies move as pistons and rock, and not in the plane.

    python benchmarks/quiet_plane.py --files 20
    python benchmarks/quiet_plane.py --files 20 --lines 20

Points, beams, base and K and D are those of tests/test_quiet_plane.py; all options have their defaults. The
lasers are exact, or off by 1 %, 0.5 degrees and 1 us (sd), as is taken of them by default.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.test_quiet_plane import deviations


def main() -> None:
    """Print the tables."""
    given = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    given.add_argument("--files", type=int, default=20)
    given.add_argument("--lines", type=int, default=120)
    options = given.parse_args()
    names = [f"{letter}{i + 1}{j + 1}" for letter in "KD" for i in range(3) for j in range(i, 3)]
    print("| lasers | what | " + " | ".join(names) + " |")
    print("|-|-|" + "-|" * len(names))
    with tempfile.TemporaryDirectory() as folder:
        for scatter, lasers in ((0.0, "exact"), (1.0, "1 %, 0.5 deg, 1 us")):
            off = np.array(
                [
                    deviations(Path(folder) / "ldv.csv", seed, scatter, options.lines)
                    for seed in range(options.files)
                ]
            )
            covered, sd = np.mean(np.abs(off) < 1.96, axis=0), np.std(off, axis=0)
            print(f"| {lasers} | 95 % interval covers | " + " | ".join(f"{v:.2f}" for v in covered) + " |")
            print(f"| {lasers} | sd of z | " + " | ".join(f"{v:.2f}" for v in sd) + " |")
    print(f"\n{options.files} files of {options.lines} lines each.")


if __name__ == "__main__":
    main()
