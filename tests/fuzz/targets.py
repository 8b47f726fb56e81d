"""What reads the inputs: single readers, which are fast, and the four commands as a whole."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path

PRELOADED = (
    "numpy scipy.optimize scipy.ndimage scipy.spatial scipy.stats scipy.linalg scipy.io h5py pandas tifffile "
    "imagecodecs SimpleITK trimesh skimage.measure xxhash tomllib ct_inertia.read_scan ct_inertia.ct2mass "
    "legacy.ct_inertia.mass.calibration legacy.ct_inertia.frames.landmarks ct_inertia.surface.surface fitting.fit_files "
    "legacy.fitting.options legacy.kinematics.measure_motion kinematics.readers.assemble_measurement "
    "legacy.kinematics.readers.recognise_format legacy.kinematics.tidy.ldv_csv kinematics.tidy.points_csv "
    "legacy.pipeline.study legacy.pipeline.report pipeline.figure_files matplotlib.figure matplotlib.backends.backend_pdf "
    "kinematics.registration.scan_surfaces stapeskit.records.mass_record stapeskit.records.motion_files"
)
"""Imported once, before the process that reads is forked."""

SPACING_MM = 0.02


def preload() -> None:
    """Import what the readers need."""
    for name in PRELOADED.split():
        importlib.import_module(name)


def _scan(path: str, *_: str) -> None:
    from legacy.ct_inertia.read_scan import read_volume
    from legacy.ct_inertia.readers.companions import with_data_files

    with_data_files({"scan": Path(path)})
    volume = read_volume(path, SPACING_MM)
    for plane in volume.array:
        plane.sum()


def _labels(path: str, *_: str) -> None:
    from legacy.ct_inertia.read_scan import read_labels

    read_labels(path, SPACING_MM)


def _mesh(path: str, *_: str) -> None:
    from legacy.ct_inertia.surface.surface import read_surface

    read_surface(path)


def _landmarks(path: str, *_: str) -> None:
    from legacy.ct_inertia.frames.landmarks import read_landmarks

    read_landmarks(Path(path))


def _calibration(path: str, *_: str) -> None:
    from legacy.ct_inertia.mass.calibration import read_calibration

    read_calibration(Path(path))


def _ldv(*words: str) -> None:
    """Read vibrometer files by the words that points2dof takes, without fitting."""
    from legacy.kinematics.cli import parser
    from legacy.kinematics.measure_motion import motion_inputs
    from legacy.kinematics.options import LdvOptions

    options = parser().parse(list(words)).make(LdvOptions)
    from legacy.kinematics.measure_motion import read_inputs

    read_inputs(motion_inputs(options))


def _motion(path: str, *_: str) -> None:
    from legacy.stapeskit.records.motion_files import read_motion

    read_motion(Path(path))


def _mass(path: str, *_: str) -> None:
    from legacy.stapeskit.records.mass_record import read_mass_record

    read_mass_record(Path(path))


def _study(path: str, *_: str) -> None:
    from legacy.pipeline.study import read_study

    read_study(Path(path))


def _plan(path: str, *_: str) -> None:
    from legacy.fitting.plan.plan_file import read_plan

    read_plan(Path(path))


def _surface(path: str, *_: str) -> None:
    """Read a surface or the labels beside mass.json."""
    from legacy.kinematics.registration.scan_surfaces import read_labels, read_mesh

    (read_labels(Path(path)) if path.endswith("nrrd") else read_mesh(Path(path), "stapes"))


def _own(stage: str) -> None:
    """Read what the program keeps beside outputs."""
    from legacy.pipeline.stage_records import read_record, read_stage_report, stage_report_name
    from legacy.stapeskit.own_files import OutputSet, unfinished

    folder = Path()
    read_record(folder, stage)
    read_stage_report(folder / stage_report_name(stage))
    unfinished(folder)
    OutputSet("dof2kd", folder, ("plan.json", "plan.html")).check()


def _truth(path: str, *_: str) -> None:
    from legacy.pipeline.report import read_truth

    read_truth(Path(path))


def _command(module: str) -> Callable[..., None]:
    def run(*words: str) -> None:
        importlib.import_module(module).work(list(words))

    return run


def _parse(module: str) -> Callable[..., None]:
    def run(*words: str) -> None:
        importlib.import_module(module).parser().parse(list(words))

    return run


TARGETS: dict[str, Callable[..., None]] = {
    "read_scan": _scan,
    "read_labels": _labels,
    "read_mesh": _mesh,
    "read_landmarks": _landmarks,
    "read_calibration": _calibration,
    "read_ldv": _ldv,
    "read_motion": _motion,
    "read_mass": _mass,
    "read_study": _study,
    "read_plan": _plan,
    "read_own": _own,
    "read_beside_mass": _surface,
    "read_truth": _truth,
    "parse_ct2mass": _parse("legacy.ct_inertia.cli"),
    "parse_points2dof": _parse("legacy.kinematics.cli"),
    "parse_dof2kd": _parse("legacy.fitting.cli"),
    "ct2mass": _command("legacy.ct_inertia.cli"),
    "points2dof": _command("legacy.kinematics.cli"),
    "dof2kd": _command("legacy.fitting.cli"),
    "scan2kd": _command("legacy.pipeline.cli"),
    "stapeskit": _command("legacy.pipeline.stapeskit_command"),
}
