"""The intervals of K and D hold in whole studies, everything drawn anew.

Each study has its own pose, scan noise, vibrometer noise, errors of points, fiducials and lasers, stated
density, and a ligament as it is expected beforehand: an uneven ring in a plane of its own. The whole chain
runs on its files. Printed per entry: bias and scatter in standard deviations, and how often
the 95 % interval holds; then the squared Mahalanobis distances of the 12 entries, and the same for M.

    python -m benchmarks.coverage_of_studies --studies 100 --first 7000
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks._table import PISTON_ENTRIES, arguments, percent, print_table
from fitting.result import KDFit
from simulate import Ear, Experiment, Scan, Truth, draw_uneven_ring, ring_ligament, simulate_study
from stapeskit.arrays import Array
from stapeskit.records.mass_matrix import MassMatrix

UPPER = np.triu_indices(3)


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """Deviations of one study in stated standard deviations, and errors of its mass."""

    entries: Array
    distance: float
    level: float
    mass_entries: Array
    mass_percent: float
    centre_um: float


def against(fit: KDFit, truth: Truth, mass: MassMatrix, centre_um: float) -> Outcome:
    """Compare K, D and M with the truth."""
    block = np.ix_(*[[truth.dof.index(name) for name in fit.dof]] * 2)
    true = np.concatenate([part[block][UPPER] for part in (truth.stiffness_si, truth.damping_si)])
    sd = np.sqrt(np.diag(fit.covariance))
    z = (fit.values - true) / sd
    exact, stated = truth.mass_matrix_si, mass.standard_deviation
    root = np.sqrt(np.diag(exact))
    off = mass.matrix - exact
    known = (stated > 0.0) & np.triu(np.ones((6, 6), dtype=bool))
    return Outcome(
        entries=z,
        distance=float(z @ np.linalg.solve(fit.covariance / np.outer(sd, sd), z)),
        level=fit.found.level,
        mass_entries=off[known] / stated[known],
        mass_percent=float(np.max(np.abs(off / np.outer(root, root)))) * 100.0,
        centre_um=centre_um,
    )


def whole_study(seed: int) -> Outcome:
    """Make a study and run the chain on its files."""
    from pipeline.run import scan2kd

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        experiment = Experiment(lines=200, laser_scatter=1.0, seed=seed)
        ear = Ear(ligament=ring_ligament(draw_uneven_ring(np.random.default_rng([seed, 3]))))
        scan, fit = Scan(voxel_um=34.0, seed=seed), {"dof": "y,alpha,gamma"}
        truth = simulate_study(ear, scan, experiment, folder, fit=fit)
        assert truth.study is not None
        result = scan2kd(truth.study, out=folder / "out")
        record = result.measured
        off = record.scan_from_footplate.translation_mm - truth.scan_from_footplate.translation_mm
        return against(result.fit, truth, record.mass_matrix, 1e3 * float(np.linalg.norm(off)))


def report(done: list[Outcome]) -> None:
    """Print the table and what follows it."""
    from scipy.stats import chi2

    z = np.array([one.entries for one in done])
    rows = list[list[object]]()
    for name, own in zip(PISTON_ENTRIES, z.T, strict=True):
        rows.append([name, f"{own.mean():+.2f}", f"{own.std():.2f}", percent(np.abs(own) < 1.96, 0)])
    rows.append(["all 12", "", "", percent(np.abs(z) < 1.96)])
    print_table(("entry", "mean z", "sd z", "95 % holds"), rows)
    distance = np.array([one.distance for one in done])
    p = chi2.sf(distance, len(PISTON_ENTRIES))
    entries = np.concatenate([one.mass_entries for one in done])
    print(f"* entries of M: 95 % intervals hold in {percent(np.abs(entries) < 1.96)}")
    print(
        f"* squared Mahalanobis distance of the 12 entries: mean {distance.mean():.1f} (12 expected),", end=""
    )
    print(f" p < 0.05 in {percent(p < 0.05, 0)} of studies")
    for label, values in (
        ("largest error of M, % of sqrt(Mii Mjj)", [one.mass_percent for one in done]),
        ("footplate centre, um", [one.centre_um for one in done]),
        ("chi2 per degree of freedom of the fit", [one.level for one in done]),
    ):
        print(f"* {label}: median {np.median(values):.3g}, {np.min(values):.3g} to {np.max(values):.3g}")


if __name__ == "__main__":
    given = arguments(__doc__, studies=4, first=7000)
    outcomes = [whole_study(seed) for seed in range(given.first, given.first + given.studies)]
    print(f"{len(outcomes)} studies.\n")
    report(outcomes)
