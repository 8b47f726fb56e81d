"""The stated uncertainties of volume, frame and mass matrix hold the truth: random simulated ears.

Every ear has its own pose, noise (2 to 6 % of the contrast between bone and air), blur, distance and tilt of
the plate, and gap to the bone around it. The density is exact, so that the budget holds levels, noise, blur,
separation and frame. For each number: root mean square error, mean and scatter of (found - true) / stated sd,
and how often the 95 % interval holds. 0.2 drew other ears of the same population.

    python -m benchmarks.mass_coverage --ears 16 --voxel-um 25
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks._masses import UPPER, Measured, measure, shares
from benchmarks._table import Before, arguments, print_table
from simulate import Ear, Scan, Stapes
from stapeskit.arrays import Array
from stapeskit.spatial import DOF_NAMES

BEFORE = Before("mass_coverage_ears_16_voxel_um_25")
"""At 25 um."""
COLUMNS = ("error (rms)", "mean / sd", "scatter / sd", "95 % interval holds")


def random_ear(seed: int, voxel_um: float, family: str, folder: Path) -> Measured:
    """Measure the ear of a seed."""
    rng = np.random.default_rng([seed, 77])
    ear = Ear(
        stapes=Stapes(family=family),
        gap_mm=float(rng.uniform(0.06, 0.25)),
        plate_distance_mm=float(rng.uniform(0.25, 0.9)),
        plate_tilt_deg=(float(rng.uniform(-5.0, 5.0)), float(rng.uniform(-5.0, 5.0))),
        plate_turn_deg=float(rng.uniform(-20.0, 20.0)),
        bone=family == "openear",
    )
    scan = Scan(
        voxel_um=voxel_um, blur_voxels=float(rng.uniform(1.0, 1.5)), noise=float(rng.uniform(0.02, 0.06)),
        tilt_deg=25.0, upright=str(rng.choice(["x", "y", "z"])), seed=seed,
    )  # fmt: skip
    return measure(ear, scan, folder)


def row(name: str, deviations: Array, errors: Array, unit: str) -> list[object]:
    """Return a row: deviations in stated sd, errors in a unit."""
    cells = [
        f"{np.sqrt(np.mean(errors**2)):.3g} {unit}",
        f"{np.mean(deviations):+.2f}",
        f"{np.std(deviations):.2f}",
        f"{100 * np.mean(np.abs(deviations) < 1.96):.0f} %",
    ]
    old = [BEFORE.cell(column, name) for column in COLUMNS]
    return [name, *(cell for pair in zip(cells, old, strict=True) for cell in pair)]


def rows(found: list[Measured]) -> Iterator[list[object]]:
    """Yield volume, frame and all entries of M."""
    volume = np.array([one.volume_error for one in found])
    yield row("volume", volume / [one.volume_sd for one in found], 100 * volume, "%")
    moved = np.array([one.frame_deviation for one in found])
    stated = np.array([one.frame_sd for one in found])
    for place, name in enumerate(DOF_NAMES):
        factor, unit = (1e6, "um") if place < 3 else (np.degrees(1.0), "deg")
        errors = factor * moved[:, place]
        yield row(f"footplate frame, {name}", moved[:, place] / stated[:, place], errors, unit)
    entries = np.array([one.matrix_deviations for one in found])
    errors = 100 * np.array([shares(one.matrix.matrix, one.truth.mass_matrix_si)[UPPER] for one in found])
    known = np.all(np.isfinite(entries), axis=0)
    for place, (i, j) in enumerate(zip(*UPPER, strict=True)):
        if known[place]:
            mark = ", reduced" if {i, j} <= {1, 3, 5} else ""
            name = f"M {DOF_NAMES[i]} {DOF_NAMES[j]}{mark}"
            yield row(name, entries[:, place], errors[:, place], "% of sqrt")
    yield row("all entries of M", entries[:, known].ravel(), errors[:, known].ravel(), "% of sqrt")


if __name__ == "__main__":
    given = arguments(__doc__, ears=3, voxel_um=25.0, family="openear", seed=1)
    with tempfile.TemporaryDirectory() as place:
        measured = [
            random_ear(seed, given.voxel_um, given.family, Path(place))
            for seed in range(given.seed, given.seed + given.ears)
        ]
    good = [one for one in measured if one.record is not None]
    print_table(("", *(cell for column in COLUMNS for cell in (column, "0.2"))), rows(good))
    refused = [one.refusal for one in measured if one.record is None]
    print(f"{len(good)} of {given.ears} ears; refused: {'; '.join(refused) or 'none'}.")
    print(f"CPU an ear, scan to mass matrix: {np.mean([one.seconds for one in good]):.2f} s.")
