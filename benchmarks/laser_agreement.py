"""Do the intervals of K and D hold when the lasers disagree? Coverage on simulated studies.

    python benchmarks/laser_agreement.py [STUDIES] [--lines 100] [--cases NAME,...]

Each study has its own pose, noise, point and fiducial errors and its own gain, phase and delay of each of
three lasers; the mass is exact. Printed per case: how many of the 12 entries their 95 % interval covers, the
worst entry, the spread in stated standard deviations, and the median error of the diagonal of K in percent.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

ENTRIES = np.triu_indices(3)
PARAMETERS = np.array(
    [3.2e-6, 1.43e-10, 3.5e-9, 4.35e-10, 9.8e-12, 5.0e-12, 1.114e-11, -2.0e-13, -4.0e-13, 3.0e-14]
)
MARKS = (("a", (-6, 0, -4)), ("b", (6, 0, -4)), ("c", (6, 0, 4)), ("d", (-6, 0, 4)), ("e", (0, 3, 0)))


@dataclass(frozen=True)
class Case:
    """True standard deviation of gain (percent), phase (degrees), delay (us), and the options stated."""

    truth: tuple[float, float, float]
    stated: tuple[float, float, float]
    calibrate: bool = False


CASES = {
    "exact, stated exact": Case((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "exact, default": Case((0.0, 0.0, 0.0), (1.0, 0.5, 1.0)),
    "as stated by default": Case((1.0, 0.5, 1.0), (1.0, 0.5, 1.0)),
    "gain 1.5 %, stated exact": Case((1.5, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "gain 1.5 %, default": Case((1.5, 0.0, 0.0), (1.0, 0.5, 1.0)),
    "gain 1.5 %, stated": Case((1.5, 0.0, 0.0), (1.5, 0.5, 1.0)),
    "gain 1.5 %, calibrate": Case((1.5, 0.0, 0.0), (1.5, 0.0, 0.0), True),
    "gain 3 %, default": Case((3.0, 0.0, 0.0), (1.0, 0.5, 1.0)),
    "phase 2 degrees, default": Case((0.0, 2.0, 0.0), (1.0, 0.5, 1.0)),
    "delay 3 us, default": Case((0.0, 0.0, 3.0), (1.0, 0.5, 1.0)),
}


def study(case: Case, seed: int, lines: int) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return errors of the 12 entries over their sd, errors of K's diagonal in percent, and the warnings."""
    from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_STIFFNESS
    from legacy.fitting.fit_kd import fit_kd
    from legacy.kinematics.fit_options import Options
    from legacy.kinematics.measurement import from_arrays
    from legacy.kinematics.points2dof import points2dof
    from legacy.kinematics.registration.fiducials import Fiducials
    from legacy.kinematics.registration.geometry_model import GeometryPriors
    from legacy.kinematics.registration.laser_errors import LaserPriors
    from legacy.kinematics.registration.placement import place
    from legacy.stapeskit.frames import RigidTransform
    from legacy.stapeskit.spatial import matrix_from_parameters
    from sample_volumes.vibrometer import Vibrometry, record

    how = Vibrometry(lines=lines, seed=seed)
    mass = matrix_from_parameters(PARAMETERS)
    marks = [(name, np.array(at, dtype=float)) for name, at in MARKS]
    recording = record(mass, RigidTransform.identity("footplate", "plate"), how, marks)
    rng = np.random.default_rng([seed, 11])
    gain, phase, delay = (np.array(sd) * rng.standard_normal(3) for sd in case.truth)
    omega = 2.0 * np.pi * recording.freq_hz
    factors = (1.0 + gain[:, None] / 100.0) * np.exp(
        1j * (np.deg2rad(phase)[:, None] - np.outer(delay * 1e-6, omega))
    )
    laser = np.arange(len(recording.point)) % 3
    value = recording.velocity_m_s * factors[laser]
    bodies = {}
    for name in dict.fromkeys(recording.body):
        mine = [k for k, body in enumerate(recording.body) if body == name]
        bodies[name] = {
            "points": [recording.point[k] for k in mine],
            "positions_mm": recording.position_mm[mine],
            "directions": recording.direction[mine],
            "value": value[:, mine],
            "sd": recording.sd_m_s[:, mine, None],
            "position_sd_mm": np.full(len(mine), how.position_sd_mm),
        }
    measurement = from_arrays(bodies, recording.freq_hz, frame="vibrometer")
    seen = np.array([at for _, at, _ in recording.fiducials])
    known = np.array([at for _, _, at in recording.fiducials])
    names = tuple(name for name, _, _ in recording.fiducials)
    ties = Fiducials(names, seen, known, ("footplate",) * len(names), np.full(len(names), how.fiducial_sd_mm))
    options = Options(
        lasers=LaserPriors(*case.stated),
        calibrate=GeometryPriors(0.2, 0.2, case.stated[0]) if case.calibrate else None,
    )
    motion = points2dof(measurement, place(ties), options).motion
    fit = fit_kd(motion, mass)
    wanted = np.concatenate([part[ENTRIES] for part in (PAPER_STIFFNESS, PAPER_DAMPING_CORRECTED)])
    estimates = np.concatenate([part[ENTRIES] for part in (fit.stiffness, fit.damping)])
    error = estimates - wanted
    percent = 100.0 * np.diag(fit.stiffness - PAPER_STIFFNESS) / np.diag(PAPER_STIFFNESS)
    return error / np.sqrt(np.diag(fit.covariance)), percent, [notice.code for notice in motion.notices]


def main() -> None:
    """Print one row a case."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("studies", type=int, nargs="?", default=40)
    parser.add_argument("--lines", type=int, default=100)
    parser.add_argument("--cases", default=",".join(CASES))
    chosen = parser.parse_args()
    print("| lasers | covered (%) | worst entry (%) | spread / sd | K11, K22, K33 rms error (%) | warnings |")
    print("|-|-|-|-|-|-|")
    names = [name for name in CASES if name in chosen.cases]
    for name in names:
        results = [study(CASES[name], seed, chosen.lines) for seed in range(chosen.studies)]
        z = np.array([result[0] for result in results])
        rms = np.sqrt(np.mean(np.array([result[1] for result in results]) ** 2, axis=0))
        covered = 100.0 * np.mean(np.abs(z) < 1.96, axis=0)
        codes: dict[str, int] = {}
        for result in results:
            for code in dict.fromkeys(result[2]):
                codes[code] = codes.get(code, 0) + 1
        counts = ", ".join(f"{code} {count}" for code, count in sorted(codes.items())) or "none"
        sizes = ", ".join(f"{value:.2g}" for value in rms)
        print(f"| {name} | {np.mean(covered):.1f} | {np.min(covered):.0f} | "
              f"{np.sqrt(np.mean(z**2)):.2f} | {sizes} | {counts} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
