"""Write a whole simulated study in one call, and keep the truth behind it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from simulate.ear import Ear, Placed
from simulate.files.recordings import write_recording
from simulate.files.volumes import WITHOUT_SPACING, write_scan
from simulate.ligament import base_motion, stapes_motion
from simulate.mass import MassProperties
from simulate.points import bone_points, visible_points
from simulate.scanner import Scan
from simulate.vibrometer import Experiment, Recording, laser_directions, measure_motion, vibrometer_pose
from stapeskit.arrays import Array, ComplexArray
from stapeskit.frames import RigidTransform
from stapeskit.options import toml

DENSITY_SD = 0.01
"""Relative sd of the density that a study states, drawn around the true one: a bone that was weighed."""
_SIMULATED = (
    "the grey values, the bone around it, the plate and all vibrometer data are computed. Nothing here is a "
    "measurement."
)
_REAL = (
    f"SIMULATED on real geometry: the stapes is a real one (OpenEar library, Sieber et al. 2019, CC BY 4.0); "
    f"{_SIMULATED}"
)
_MADE = f"SIMULATED: the stapes is a made one; {_SIMULATED}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """The exact truth of a simulated study: everything follows from the ear and its place in the scan."""

    ear: Ear
    placed: Placed  # the ear in the scan
    scan: Scan
    # the measurement with the true motion and the channels at fault; None when only scanned
    recording: Recording | None = None
    study: Path | None = None  # the study file, when one was written

    @cached_property
    def mass(self) -> MassProperties:
        """Mass properties of the bone, in footplate axes."""
        return self.ear.mass()

    @property
    def volume_m3(self) -> float:
        """Volume of the bone."""
        return self.ear.solid.moments().volume_mm3 * 1e-9

    @property
    def parameters_si(self) -> Array:
        """Ten inertial parameters (10,) of the bone about the footplate centre in footplate axes."""
        return self.mass.parameters()

    @property
    def mass_matrix_si(self) -> Array:
        """Mass matrix (6, 6) of the bone alone."""
        return self.mass.matrix()

    @property
    def stated_density_kg_m3(self) -> tuple[float, float]:
        """Density that the study states, the true one and a drawn error, and its standard deviation."""
        draw = np.random.default_rng([self.scan.seed, 11]).standard_normal()
        true = self.ear.density_kg_m3
        return float(true * (1.0 + DENSITY_SD * draw)), DENSITY_SD * true

    @property
    def scan_from_footplate(self) -> RigidTransform:
        """Pose of the footplate in the scan."""
        return self.placed.scan_from_footplate

    @property
    def scan_from_plate(self) -> RigidTransform:
        """Pose of the plate in the scan."""
        return self.placed.scan_from_plate

    @property
    def plate_from_footplate(self) -> RigidTransform:
        """Pose of the footplate on the plate."""
        return self.scan_from_plate.inverse() @ self.scan_from_footplate

    @property
    def centre_of_mass_in_scan_mm(self) -> Array:
        """Centre of mass of the bone, (3,)."""
        return self.scan_from_footplate.points(self.mass.centre_of_mass_mm)

    @property
    def dof(self) -> tuple[str, ...]:
        """Degrees of freedom of the ligament."""
        return self.ear.ligament.dof

    @property
    def stiffness_si(self) -> Array:
        """K of the ligament, (n, n)."""
        return self.ear.ligament.stiffness_si

    @property
    def damping_si(self) -> Array:
        """D of the ligament, (n, n)."""
        return self.ear.ligament.damping_si

    @property
    def motion_m(self) -> Mapping[str, ComplexArray]:
        """True motion of each body, (run, freq, 6), m and rad."""
        return {} if self.recording is None else self.recording.motion_m

    def to_json(self) -> dict[str, Any]:
        """Return the truth in the keys of mass.json and kd.json where they exist."""
        ear, scan, placed = self.ear, self.scan, self.placed
        centroid = ear.solid.moments().centroid_mm
        return {
            "density_kg_m3": ear.density_kg_m3,
            "volume_m3": self.volume_m3,
            "mass_kg": self.mass.mass_kg,
            "center_of_mass_in_scan_mm": self.centre_of_mass_in_scan_mm.tolist(),
            "centroid_in_scan_mm": self.scan_from_footplate.points(centroid).tolist(),
            "scan_from_footplate": self.scan_from_footplate.matrix.tolist(),
            "scan_from_plate": self.scan_from_plate.matrix.tolist(),
            "plate_from_footplate": self.plate_from_footplate.matrix.tolist(),
            "mass_matrix_si": self.mass_matrix_si.tolist(),
            "inertial_parameters_si": self.parameters_si.tolist(),
            "fiducials_in_plate_mm": {name: mark.tolist() for name, mark in placed.fiducials_mm().items()},
            "voxel_mm": placed.voxel_mm.tolist(),
            "gap_mm": ear.gap_mm,
            "levels": scan.stored_levels(),
            "stapes_voxels_noise_free": self.volume_m3 * 1e9 / float(np.prod(placed.voxel_mm)),
            "dof": list(self.dof),
            "stiffness_si": self.stiffness_si.tolist(),
            "damping_si": self.damping_si.tolist(),
        }


def simulate_truth(ear: Ear, scan: Scan | None = None) -> Truth:
    """Return the truth of an ear in a scan; nothing is rendered, measured or written."""
    scan = scan or Scan()
    return Truth(ear=ear, placed=scan.placed(ear), scan=scan)


def simulate_recording(truth: Truth, experiment: Experiment | None = None) -> Recording:
    """Shake an ear and measure it, with fiducials in the frame of its plate or in that of the scan."""
    experiment, ear = experiment or Experiment(), truth.ear
    freq_hz, mass = experiment.freq_hz, ear.moving_mass_si()
    bases = [base_motion(freq_hz, name, experiment.others) for name in experiment.excitations]
    stapes = [stapes_motion(freq_hz, base, mass, ear.ligament, run) for run, base in enumerate(bases)]
    motions = {"stapes": np.array(stapes), "base": np.array(bases)}
    rng = np.random.default_rng([experiment.seed, 7])
    pose = vibrometer_pose(rng)
    beams = laser_directions(experiment.lasers, experiment.beam_cone_deg)
    places = {
        "stapes": visible_points(ear.solid, experiment.stapes_points, pose.inverse().vectors(beams)),
        "base": bone_points(ear.solid, experiment.bone_points),
    }
    marks = truth.placed.fiducials_mm()
    frame = truth.plate_from_footplate.inverse()
    if experiment.marks_in_scan or not ear.plate:
        marks = {name: truth.scan_from_plate.points(mark) for name, mark in marks.items()}
        frame = truth.scan_from_footplate.inverse()
    return measure_motion(motions, places, experiment, pose, rng, (frame, marks))


def simulate_study(
    ear: Ear,
    scan: Scan | None,
    experiment: Experiment | None,
    folder: Path,
    *,
    name: str = "simulated ear",
    about: Mapping[str, Any] | None = None,
    fit: Mapping[str, Any] | None = None,
) -> Truth:
    """Write a study into a folder and return the truth behind it.

    Parameters
    ----------
    scan : Scan or None
        None: nothing is scanned, as with an empty ``format``; the truth is that of a usual scan.
    experiment : Experiment or None
        None: the measurement is left away.
    about, fit : mapping, optional
        Further keys of [study] and [fit].
    """
    folder.mkdir(parents=True, exist_ok=True)
    scan = scan or Scan(format="")
    truth = simulate_truth(ear, scan)
    state = "Incus removed" if ear.incus_gap_mm is None else "Incus attached"
    notes = f"{_REAL if ear.stapes.family == 'openear' else _MADE} {state}, cochlea open."
    heading = {"name": name, "notes": notes, **(about or {})}
    tables: dict[str, dict[str, Any]] = {"study": heading, "scan": {}}
    if scan.format:
        tables["scan"] = {"file": write_scan(folder, truth.placed, scan).name}
        if scan.format in WITHOUT_SPACING:
            tables["scan"] |= {"spacing_mm": [round(float(size), 9) for size in truth.placed.voxel_mm]}
    tables["scan"] |= _scan_keys(truth, scan)
    recording = None
    if experiment is not None:
        recording = simulate_recording(truth, experiment)
        tables["ldv"] = {"file": write_recording(folder, recording, experiment.format).name}
        if (folder / "points.csv").exists():
            tables["ldv"] |= {"points": "points.csv"}
        if recording.fiducials:
            tables["ldv"] |= {"fiducials": "fiducials.csv"}
        if experiment.mirror:
            tables["ldv"] |= {"mirror": experiment.mirror}
    tables["fit"] = {"dof": ",".join(truth.dof), "estimator": "ml", **(fit or {})}
    study = folder / "study.toml"
    parts = [
        "\n".join([f"[{name}]", *(f"{key} = {toml(value)}" for key, value in table.items())])
        for name, table in tables.items()
    ]
    study.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    (folder / "truth.json").write_text(json.dumps(truth.to_json(), indent=1) + "\n", encoding="utf-8")
    return replace(truth, recording=recording, study=study)


def _scan_keys(truth: Truth, scan: Scan) -> dict[str, Any]:
    stated, sd = truth.stated_density_kg_m3
    anterior = [round(float(part), 1) for part in truth.scan_from_footplate.rotation[:, 0]]
    keys = {
        "density_kg_m3": f"{stated:.1f}+-{sd:.1f}",
        "side": truth.ear.side,
        "anterior": anterior,
    }
    return keys | ({"mirror": scan.mirror} if scan.mirror else {})
