"""Simulated ears for the tests of points2dof: files of a measurement, and the mass of the true scan."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from kinematics.options import MotionOptions
from kinematics.points2dof import measure_motion
from simulate import Ear, Experiment, Truth, simulate_study
from stapeskit.frames import RigidTransform
from stapeskit.records.mass_file import mass_json
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.records.mass_record import MassRecord
from tests.scenes.chain import motion_errors

EAR = Ear()


def simulated(folder: Path, **experiment) -> Truth:
    """Write ldv.csv, points.csv and fiducials.csv of one ear into a folder."""
    return simulate_study(EAR, None, Experiment(**({"lines": 40} | experiment)), folder)


def mass_of(
    truth: Truth, frame_sd=(0.0, 0.0), draw: np.random.Generator | None = None, plate=True
) -> MassRecord:
    """Return the mass of the true scan; with ``draw``, frames that are off by their standard deviation."""
    spread = np.repeat(np.asarray(frame_sd, dtype=float), 3)

    def seen(pose: RigidTransform) -> RigidTransform:
        return pose if draw is None else pose.perturbed(spread * draw.normal(size=6))

    record = MassRecord(
        MassMatrix(truth.parameters_si, covariance=np.diag((0.01 * truth.parameters_si) ** 2)),
        seen(truth.scan_from_footplate),
        np.diag(spread**2),
        seen(truth.scan_from_plate) if plate else None,
        np.diag(spread**2) if plate else None,
    )
    solids = {"stapes": truth.ear.solid.moved(truth.scan_from_footplate)}
    meshes = {name: (solid.vertices_mm, np.asarray(solid.faces)) for name, solid in solids.items()}
    return replace(record, meshes=meshes)


def write_mass(folder: Path, mass: MassRecord) -> Path:
    """Write mass.json and the surfaces of a mass into a folder."""
    import trimesh

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "mass.json"
    path.write_text(json.dumps(mass_json(mass)))
    for name, (vertices, faces) in mass.meshes.items():
        trimesh.Trimesh(vertices, faces, process=False).export(folder / f"{name}.ply")
    return path


def options(folder: Path, **given) -> MotionOptions:
    """Return the options of a measurement with all its files."""
    files = {"points": folder / "points.csv", "fiducials": folder / "fiducials.csv"}
    files = {name: path for name, path in files.items() if path.is_file()}
    return MotionOptions.of(ldv=folder / "ldv.csv", **(files | given))


def measured(folder: Path, mass: MassRecord | None = None, **given):
    """Return the result of points2dof for the files of a folder."""
    return measure_motion(options(folder, **given), mass)


def error_in_sd(result, truth: Truth) -> np.ndarray:
    """Return errors of real and imaginary parts over their sd of all sources, (2, run, body, freq, dof)."""
    return motion_errors(result.motion, truth)


def rewrite(path: Path, change) -> None:
    """Change a table in place."""
    table = pd.read_csv(path)
    change(table)
    table.to_csv(path, index=False)
