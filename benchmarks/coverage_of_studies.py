"""Do the intervals hold? Whole studies, everything drawn anew, recovered K and D against the truth.

    python benchmarks/coverage_of_studies.py [STUDIES] [FIRST_SEED]

Each study has its own pose, scan noise, vibrometer noise, point and fiducial errors and stated density; the
whole chain runs on its files. Printed per entry: bias and spread in standard deviations, and how often the
95 % interval covers the truth; then the squared Mahalanobis distances of the 12 entries, and the same for M.
"""

from __future__ import annotations

import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

ENTRIES = np.triu_indices(3)


def one_study(seed: int) -> dict[str, Any]:
    """Make a study, run the chain on its files, compare with the truth."""
    from legacy.ct_inertia.results import mass_of
    from legacy.fitting.fit_kd import fit_kd
    from legacy.kinematics.fit_options import fit_options
    from legacy.kinematics.measure_motion import motion_inputs, motion_of, read_inputs
    from legacy.pipeline.study import read_study
    from sample_volumes.old_study import make_study
    from sample_volumes.phantom import Ear
    from sample_volumes.vibrometer import Vibrometry

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        truth = make_study(folder, Ear(pose_seed=seed, noise_seed=seed), Vibrometry(seed=seed), f"ear {seed}")
        study = read_study(folder / "study.toml")
        started = time.perf_counter()
        measured = mass_of(study.scan).measured_mass()
        mass, content = measured.record, measured.record.raw
        inputs = motion_inputs(study.ldv)
        motion = motion_of(inputs, read_inputs(inputs), fit_options(study.ldv), measured).motion
        fit = fit_kd(motion, mass.mass_matrix, study.fit)
        seconds = time.perf_counter() - started
    wanted = np.concatenate([np.array(truth[key])[ENTRIES] for key in ("stiffness_si", "damping_si")])
    estimates = np.concatenate([np.asarray(part)[ENTRIES] for part in (fit.stiffness, fit.damping)])
    error = estimates - wanted
    sd = np.sqrt(np.diag(fit.covariance))
    correlation = fit.covariance / np.outer(sd, sd)
    matrix, exact = mass.mass_matrix.matrix, np.array(truth["mass_matrix_si"])
    root = np.sqrt(np.diag(exact))
    mass_sd = mass.mass_matrix.standard_deviation
    frame = np.linalg.inv(np.array(truth["scan_from_footplate"])) @ mass.scan_from_footplate.matrix
    return {
        "z": error / sd,
        "mahalanobis": float((error / sd) @ np.linalg.solve(correlation, error / sd)),
        "mass_z": ((matrix - exact) / np.where(mass_sd > 0.0, mass_sd, np.inf))[np.triu_indices(6)],
        "mass_percent": float(np.abs((matrix - exact) / np.outer(root, root)).max() * 100.0),
        "volume_percent": (content["volume_m3"] / truth["volume_m3"] - 1.0) * 100.0,
        "origin_um": float(np.linalg.norm(frame[:3, 3]) * 1e3),
        "normal_deg": float(np.degrees(np.arccos(min(1.0, frame[1, 1])))),
        "chi2": fit.chi2 / fit.n_dof,
        "seconds": seconds,
    }


def main() -> None:
    """Run the studies on two processes and print the table."""
    from scipy.stats import chi2

    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 1000
    with ProcessPoolExecutor(2) as pool:
        done = list(pool.map(one_study, range(first, first + count)))
    z = np.array([result["z"] for result in done])
    print(f"{count} studies, {np.mean([result['seconds'] for result in done]):.1f} s each\n")
    print("| entry | mean z | sd z | 95 % interval covers |\n|-|-|-|-|")
    names = [f"{letter}{i + 1}{j + 1}" for letter in "KD" for i, j in zip(*ENTRIES, strict=True)]
    for k, name in enumerate(names):
        covered = np.mean(np.abs(z[:, k]) < 1.96)
        print(f"| {name} | {z[:, k].mean():+.2f} | {z[:, k].std():.2f} | {100 * covered:.0f} % |")
    print(f"| all 12 | | | {100 * np.mean(np.abs(z) < 1.96):.1f} % |\n")
    distance = np.array([result["mahalanobis"] for result in done])
    p = chi2.sf(distance, 12)
    print(
        f"squared Mahalanobis distance of the 12 entries: mean {distance.mean():.1f} (12 expected), ", end=""
    )
    print(
        f"p < 0.01 in {100 * np.mean(p < 0.01):.0f} %, p < 0.05 in {100 * np.mean(p < 0.05):.0f} % of studies"
    )
    mass_z = np.array([result["mass_z"] for result in done])
    moving = np.any(mass_z != 0.0, axis=0)
    print(f"entries of M: 95 % intervals cover {100 * np.mean(np.abs(mass_z[:, moving]) < 1.96):.1f} %")
    for key, label in (
        ("mass_percent", "largest error of M, % of sqrt(Mii Mjj)"),
        ("volume_percent", "volume error, %"),
        ("origin_um", "footplate centre, um"),
        ("normal_deg", "piston direction, degrees"),
        ("chi2", "chi2 per degree of freedom of the fit"),
    ):
        values = np.array([result[key] for result in done])
        print(f"{label}: median {np.median(values):.3g}, range {values.min():.3g} to {values.max():.3g}")


if __name__ == "__main__":
    main()
