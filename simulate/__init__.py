"""One simulator of ears, their micro-CT scans and their vibrometer data, with the exact truth behind them.

Samples, tests and benchmarks use it; it imports nothing of the rooms that it tests. All is decided by seeds.

One study in one call:

    from pathlib import Path
    from simulate import Ear, Experiment, MeasurementFault, Scan, Stapes, simulate_study

    truth = simulate_study(
        Ear(gap_mm=0.06, bridges=2, stapes=Stapes(scale=0.9)),
        Scan(voxel_um=50.0, noise=0.04, seed=2),
        Experiment(lines=60, faults=(MeasurementFault(kind="gain", point="3", laser=1, size=0.05),), seed=2),
        Path("ear2"),
    )
    truth.parameters_si, truth.mass_matrix_si            # about the footplate centre, footplate axes
    truth.scan_from_footplate, truth.plate_from_footplate, truth.centre_of_mass_in_scan_mm
    truth.dof, truth.stiffness_si, truth.damping_si      # K and D of the ligament
    truth.motion_m["stapes"]                             # (run, freq, 6), m and rad
    truth.recording.culprits                             # {channel: right verdict}
    truth.placed.solids                                  # all bodies in scan coordinates, mm

It writes scan.tif, ldv.csv, points.csv, fiducials.csv, study.toml and truth.json. Its parts:

* ``simulate_truth(ear, scan)``: frames and matrices; ``render(truth.placed, scan)``: the volume in memory;
  ``simulate_recording(truth, experiment)``: a `Recording` in memory.
* ``measure_motion(motions, places, experiment)``: any bodies, motions and points, for example
  ``{"a": resonant_motion(rng, freq_hz)[None]}`` at ``{"a": scattered_points(rng, 9)}``.
* ``motion_of(recording)``: the rigid motion by plain least squares (`RigidMotion`).
* ``ring_ligament(Ring(...))``, ``draw_ring(rng)``, ``damped_alike(ligament, law)``: other ligaments.
* ``cohort``: many ears with a planted law.
* ``write_recording``, ``write_scan``, ``write_labels``: files; formats in simulate.files.
* Exact bodies: ``box``, ``ring``, ``rod``, ``ellipsoid``, ``stapes_solid``, ``Solid.moments()``,
  ``uniform_mass``, ``footplate_frame``, ``coverage_of`` (partial volumes).

Stated standard deviations of a study are true. Kinds of faults: ``KINDS``; families of stapes: ``STAPES``.
"""

from simulate.cohort import Population, cohort
from simulate.coverage import coverage_of
from simulate.ear import FIDUCIALS_MM, Ear
from simulate.faults import KINDS, MeasurementFault
from simulate.files.recordings import write_recording
from simulate.files.volumes import write_labels, write_scan
from simulate.footplate import footplate_frame
from simulate.ligament import (
    LAWS,
    Ligament,
    Ring,
    base_motion,
    damped_alike,
    draw_ring,
    draw_uneven_ring,
    resonant_motion,
    ring_ligament,
    stapes_motion,
)
from simulate.mass import MassProperties, point_mass, uniform_mass
from simulate.motion import motion_of
from simulate.points import scattered_points
from simulate.scanner import Scan, render
from simulate.solids import Moments, Solid, box, ellipsoid, ring, rod
from simulate.stapes import STAPES, Stapes, stapes_solid
from simulate.study import Truth, simulate_recording, simulate_study, simulate_truth
from simulate.vibrometer import Experiment, Recording, measure_motion

__all__ = [
    "FIDUCIALS_MM", "KINDS", "LAWS", "STAPES", "Ear", "Experiment", "Ligament", "MassProperties",
    "MeasurementFault", "Moments", "Population", "Recording", "Ring", "Scan", "Solid", "Stapes", "Truth",
    "base_motion", "box", "cohort", "coverage_of", "damped_alike", "draw_ring", "draw_uneven_ring",
    "ellipsoid", "footplate_frame", "measure_motion", "motion_of", "point_mass", "render", "resonant_motion",
    "ring", "ring_ligament", "rod", "scattered_points", "simulate_recording", "simulate_study",
    "simulate_truth", "stapes_motion", "stapes_solid", "uniform_mass", "write_labels", "write_recording",
    "write_scan",
]  # fmt: skip
