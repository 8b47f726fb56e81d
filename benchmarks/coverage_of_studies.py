"""The intervals of K and D hold in whole studies, everything drawn anew.

Each study has its own pose, scan noise, vibrometer noise, errors of points and fiducials, and stated density;
the whole chain runs on its files. Printed per entry: bias and scatter in standard deviations, and how often
the 95 % interval holds; then the squared Mahalanobis distances of the 12 entries, and the same for M.
``--what motion`` leaves the scans away: the true mass with the density's error, and the rigid motion by plain
least squares.

    python -m benchmarks.coverage_of_studies --studies 100 --first 7000
    python -m benchmarks.coverage_of_studies --what motion --studies 100
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks._table import PISTON_ENTRIES, Before, arguments, percent, print_table
from fitting.dof2kd import dof2kd
from fitting.result import KDFit
from simulate import (
    Ear,
    Experiment,
    Scan,
    Truth,
    motion_of,
    simulate_recording,
    simulate_study,
    simulate_truth,
)
from stapeskit.arrays import Array
from stapeskit.records.mass_matrix import MassMatrix

UPPER = np.triu_indices(3)
REGISTRATION_SD = (1e-5, 2e-3)
BEFORE = Before("coverage_of_studies_100_7000")


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """Deviations of one study in stated standard deviations, and errors of its mass."""

    entries: Array
    distance: float
    level: float
    mass_entries: Array
    mass_percent: float = 0.0
    centre_um: float = 0.0


def against(fit: KDFit, truth: Truth, mass: MassMatrix, centre_um: float = 0.0) -> Outcome:
    """Compare K, D and M with the truth."""
    true = np.concatenate([truth.stiffness_si[UPPER], truth.damping_si[UPPER]])
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
        experiment = Experiment(lines=200, seed=seed)
        truth = simulate_study(Ear(), Scan(voxel_um=34.0, seed=seed), experiment, folder)
        assert truth.study is not None
        result = scan2kd(truth.study, out=folder / "out")
        record = result.measured.record
        off = record.scan_from_footplate.translation_mm - truth.scan_from_footplate.translation_mm
        return against(result.fit, truth, record.mass_matrix, 1e3 * float(np.linalg.norm(off)))


def study_without_scan(seed: int) -> Outcome:
    """Fit the motion by plain least squares with the true mass, its density off as stated."""
    truth = simulate_truth(Ear(), Scan(seed=seed))
    recording = simulate_recording(truth, Experiment(lines=200, seed=seed))
    motion = motion_of(recording, registration_sd=REGISTRATION_SD, seed=seed)
    stated = truth.parameters_si * truth.stated_density_kg_m3 / truth.ear.density_kg_m3
    share = truth.stated_density_sd_kg_m3 / truth.stated_density_kg_m3
    mass = MassMatrix(stated, contributions={"density": share**2 * np.outer(stated, stated)})
    return against(dof2kd(motion, mass=mass), truth, mass)


def report(done: list[Outcome]) -> None:
    """Print the table and what follows it."""
    from scipy.stats import chi2

    z = np.array([one.entries for one in done])
    rows = []
    for place, name in enumerate(PISTON_ENTRIES):
        own = z[:, place]
        cells = [f"{own.mean():+.2f}", f"{own.std():.2f}", percent(np.abs(own) < 1.96, 0)]
        old = [BEFORE.cell(column, name) for column in ("mean z", "sd z", "95 % interval covers")]
        rows.append([name, *(cell for pair in zip(cells, old, strict=True) for cell in pair)])
    whole = BEFORE.cell("95 % interval covers", "all 12")
    rows.append(["all 12", "", "", "", "", percent(np.abs(z) < 1.96), whole])
    print_table(("entry", "mean z", "0.2", "sd z", "0.2", "95 % interval covers", "0.2"), rows)
    distance = np.array([one.distance for one in done])
    p = chi2.sf(distance, len(PISTON_ENTRIES))
    start = "squared Mahalanobis distance of the 12 entries:"
    print(f"{start} mean {distance.mean():.1f} (12 expected), p < 0.01 in {percent(p < 0.01, 0)}, ", end="")
    print(f"p < 0.05 in {percent(p < 0.05, 0)} of studies. 0.2: {BEFORE.line(start)}")
    entries = np.concatenate([one.mass_entries for one in done])
    start = "entries of M: 95 % intervals cover"
    print(f"\n{start} {percent(np.abs(entries) < 1.96)}. 0.2: {BEFORE.line(start)}")
    for label, values in (
        ("largest error of M, % of sqrt(Mii Mjj):", [one.mass_percent for one in done]),
        ("footplate centre, um:", [one.centre_um for one in done]),
        ("chi2 per degree of freedom of the fit:", [one.level for one in done]),
    ):
        spread = f"median {np.median(values):.3g}, range {np.min(values):.3g} to {np.max(values):.3g}"
        print(f"\n{label} {spread}. 0.2: {BEFORE.line(label)}")


if __name__ == "__main__":
    given = arguments(__doc__, what="studies", studies=4, first=7000)
    study = whole_study if given.what == "studies" else study_without_scan
    outcomes = [study(seed) for seed in range(given.first, given.first + given.studies)]
    print(f"{len(outcomes)} studies.\n")
    report(outcomes)
