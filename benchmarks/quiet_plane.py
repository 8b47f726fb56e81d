"""The intervals of K and D hold where the bodies move as pistons and rock, and not in the plane.

Delays, gains and phases of lasers, known to little, must not be laid on columns of the motion that are noise.
The lasers are exact, or off by 1 %, 0.5 degrees and 1 us (sd), as `points2dof` takes of them by default.

    python -m benchmarks.quiet_plane --files 20 --lines 20
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from benchmarks._table import arguments, covers, print_table
from fitting.dof2kd import dof2kd
from kinematics.api import points2dof
from simulate import Ear, Experiment, Recording, base_motion, measure_motion, stapes_motion, write_recording
from simulate.points import bone_points, visible_points
from simulate.vibrometer import laser_directions, vibrometer_pose
from stapeskit.arrays import Array

STILL = [0, 2, 4]
LASERS = {"exact": 0.0, "1 %, 0.5 deg, 1 us": 1.0}


def recording(lines: int, seed: int, scatter: float) -> Recording:
    """Measure a stapes that does not move in the plane of its footplate."""
    ear, pose = Ear(), vibrometer_pose(np.random.default_rng(3))
    experiment = Experiment(
        lines=lines, in_footplate=True, noise=0.004, position_sd_mm=0.0, laser_scatter=scatter, seed=seed
    )
    freq_hz = experiment.freq_hz
    base = base_motion(freq_hz, "y")
    base[:, STILL] = 0.0
    stapes = stapes_motion(freq_hz, base, ear.moving_mass_si(), ear.ligament)
    beams = pose.inverse().vectors(laser_directions(3, experiment.beam_cone_deg))
    places = {"stapes": visible_points(ear.solid, 10, beams), "base": bone_points(ear.solid, 9)}
    return measure_motion({"stapes": stapes[None], "base": base[None]}, places, experiment, pose)


def deviations(folder: Path, seed: int, scatter: float, lines: int) -> Array:
    """Return how many of their standard deviations the entries of K and D (12,) lie off."""
    ear = Ear()
    path = write_recording(folder, recording(lines, seed, scatter), "csv")
    fit = dof2kd(points2dof(path), mass=ear.moving_mass_si(), mass_sign="tensor")
    upper = np.triu_indices(3)
    truth = np.concatenate([ear.ligament.stiffness_si[upper], ear.ligament.damping_si[upper]])
    return np.asarray((fit.values - truth) / np.sqrt(np.diag(fit.covariance)))


def row(name: str, files: int, lines: int) -> list[object]:
    """Return how often the intervals of the twelve entries hold, and the scatter of their deviations."""
    with tempfile.TemporaryDirectory() as folder:
        off = np.array([deviations(Path(folder), seed, LASERS[name], lines) for seed in range(files)])
    scatter = np.std(off, axis=0)
    spread = f"{np.median(scatter):.2f} ({scatter.min():.2f} to {scatter.max():.2f})"
    return [name, f"{100 * covers(off).min():.0f} %", spread]


if __name__ == "__main__":
    given = arguments(__doc__, files=20, lines=120)
    head = ("lasers", "95 % interval holds, least of 12 entries", "sd of error/stated sd, median")
    print_table(head, (row(name, given.files, given.lines) for name in LASERS))
    print(f"{given.files} files of {given.lines} lines each.")
