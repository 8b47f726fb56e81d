"""Is an incus cut off that has grown onto a small stapes, and a stapes without one left whole? As a table.

    python benchmarks/grown_incus.py                 12 ears, each with and without its incus (3 minutes)
    python benchmarks/grown_incus.py 4 --first 100

The real stapes is stretched to published sizes, voxels of 27 to 35 um, gap and noise are drawn. The incus
reaches 20 to 80 um into the head and ends some 1 mm above it: both together have the size of a stapes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.verdicts import small_stapes
from sample_volumes.phantom import Ear


def drawn(seed: int, folder: Path) -> Ear:
    """Draw an ear whose incus has grown onto its stapes."""
    rng = np.random.default_rng([seed, 77])
    return Ear(
        pose_seed=seed,
        noise_seed=seed,
        stapes=small_stapes(folder, rng),
        voxel_mm=(float(rng.uniform(0.027, 0.035)),) * 3,
        gap_mm=float(rng.uniform(0.08, 0.25)),
        noise=float(rng.uniform(0.02, 0.05)),
        incus_gap_mm=-float(rng.uniform(0.02, 0.08)),
    )


def measured(ear: Ear, folder: Path) -> tuple[float, bool]:
    """Return the error of the volume in percent, and True if the warning of a cut through bone was given."""
    from legacy import stapeskit
    from sample_volumes.phantom import scene, truth, write_scan

    placed = scene(ear)
    write_scan(folder / "scan.tif", placed)
    mass = stapeskit.ct2mass(folder / "scan.tif", spacing=ear.voxel_mm, density=1900.0, coat=0.0)
    error = 100.0 * (1e-9 * mass.moments.volume_mm3 / truth(placed)["volume_m3"] - 1.0)
    return error, any(notice.code == "cut_through_bone" for notice in mass.warnings)


def main() -> None:
    """Print one row an ear."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("ears", nargs="?", type=int, default=12)
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    given = parser.parse_args()
    print("| voxel | incus in the head | volume off | told | without incus: volume off | cut |")
    print("|-|-|-|-|-|-|")
    for seed in range(given.first, given.first + given.ears):
        with tempfile.TemporaryDirectory() as name:
            ear = drawn(seed, Path(name))
            error, told = measured(ear, Path(name))
            bare, cut = measured(replace(ear, incus_gap_mm=None), Path(name))
        reach = -1e3 * (ear.incus_gap_mm or 0.0)
        print(
            f"| {1e3 * ear.voxel_mm[0]:.0f} µm | {reach:.0f} µm | {error:+.2f} % | {'yes' if told else 'no'} "
            f"| {bare:+.2f} % | {'yes' if cut else 'no'} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
