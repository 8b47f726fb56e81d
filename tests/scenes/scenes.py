"""Scenes: what the ear, the scan, the shaker and the lasers are, and what the commands are asked for.

A scene lists the warnings that must appear, and no others may. `bars.json` holds, for each, the standard
deviations that version 0.2 stated: they may not grow by more than a quarter. Of version 0.3 are those of the
formats, which are the same voxels, and those of K and D of `whole_right_ear`, where the search of 0.2 for the
plane of the ligament did not end: the minimum is the same from five starts, and over eight measurements of
that ear the errors are 0.3 to 0.8 of the stated standard deviations (root mean square; that of K22 is 5 to 15
%, by how well the height is determined).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from simulate import (
    Ear,
    Experiment,
    Ligament,
    MeasurementFault,
    Ring,
    Scan,
    Stapes,
    damped_alike,
    ring_ligament,
)
from tests.scan_files.scan_writers import dicom, ome_zarr


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One scene.

    Attributes
    ----------
    ear : Ear
    scan : Scan or None
        None: there is no scan, and the mass is the true one.
    experiment : Experiment or None
        None: the scene ends with the mass.
    fits : bool
        Whether K and D are asked for.
    motion_is_given : bool
        The fit starts from the rigid motion that simple least squares gives, not from points2dof.
    writer, scan_file : callable, str
        What writes the scan, and to which name, where `simulate` does not.
    labels : str
        Ending of a file of the true labels that is given with the scan, or empty.
    ct2mass, points2dof, dof2kd : str
        Further words of the command lines.
    codes : dict of str to tuple of str
        Warnings of each command beyond those that the table of usual ones lists.
    without : tuple of str
        Usual warnings that this scene must not have.
    culprits : bool
        Whether every channel that is at fault, and no other, must have its verdict.
    refused : str
        The command that must end with exit code 2, or empty.
    """

    ear: Ear = field(default_factory=Ear)
    scan: Scan | None = None
    experiment: Experiment | None = None
    fits: bool = False
    motion_is_given: bool = False
    writer: Callable[..., Path] | None = None
    scan_file: str = ""
    labels: str = ""
    ct2mass: str = ""
    points2dof: str = ""
    dof2kd: str = ""
    codes: dict[str, tuple[str, ...]] = field(default_factory=dict)
    without: tuple[str, ...] = ()
    culprits: bool = False
    refused: str = ""


_SCAN = Scan(voxel_um=32.0, seed=3)
_IN_SITU = Scan(voxel_um=28.0, seed=2)
_POINTS = Experiment(lines=80, in_footplate=True, seed=4)
_PISTON = Experiment(lines=100, others=0.3, seed=5)
_PLANE = Experiment(lines=120, seed=6)


def _ct(scan: Scan = _SCAN, **more: object) -> Scene:
    return Scene(scan=scan, **more)  # type: ignore[arg-type]


def _mass(*codes: str) -> dict[str, tuple[str, ...]]:
    return {"ct2mass": codes}


def _format(
    name: str,
    codes: tuple[str, ...] = (),
    without: tuple[str, ...] = (),
    writer: Callable[..., Path] | None = None,
    **more: str,
) -> Scene:
    """A stapes alone, in a format of `simulate` or a file by a writer: less bone shows what a format does."""
    fmt = name if writer is None else ""
    scan = Scan(voxel_um=(44.0, 40.0, 48.0), format=fmt, seed=7, **more)  # type: ignore[arg-type]
    return Scene(
        ear=Ear(bone=False, plate=False),
        scan=scan,
        writer=writer,
        scan_file=name,
        codes=_mass("plate_not_found", *codes),
        without=("plate_axis_sign", *without),
    )


def _points(experiment: Experiment = _POINTS, warnings: tuple[str, ...] = (), **more: object) -> Scene:
    return Scene(experiment=experiment, codes={"points2dof": warnings}, **more)  # type: ignore[arg-type]


def _with_fault(kind: str, experiment: Experiment = _POINTS, **more: object) -> Scene:
    from dataclasses import replace

    fault = MeasurementFault(kind=kind, **more)  # type: ignore[arg-type]
    codes = {"points2dof": (f"channel_{kind}",)}
    return Scene(experiment=replace(experiment, faults=(fault,)), codes=codes, culprits=True)


def _fit(
    ligament: Ligament | None = None,
    experiment: Experiment = _PISTON,
    words: str = "",
    warnings: tuple[str, ...] = (),
) -> Scene:
    """A fit of a given motion with a plain table as mass, which states neither signs nor an uncertainty."""
    return Scene(
        ear=Ear() if ligament is None else Ear(ligament=ligament),
        experiment=experiment,
        fits=True,
        motion_is_given=True,
        dof2kd=words,
        codes={"dof2kd": ("file_read", "mass_uncertainty_not_given", *warnings)},
    )


_ORIENTED = ("handedness_unconfirmed",)  # this format states which way the axes of the patient point
_RING = ring_ligament(Ring(centre_mm=(-0.1, 0.1, 0.05), tilt_deg=(1.0, -0.5)))
_FIVE = np.ix_([0, 1, 2, 3, 5], [0, 1, 2, 3, 5])

SCENES: dict[str, Scene] = {
    # scans: gaps, bridges, incus, resolution, storing, shapes
    "clean_scan": _ct(),
    "gap_100um": _ct(_IN_SITU, ear=Ear(gap_mm=0.1)),
    "gap_60um_two_bridges": _ct(_IN_SITU, ear=Ear(gap_mm=0.06, bridges=2), codes=_mass("cut_through_bone")),
    "gap_30um": _ct(_IN_SITU, ear=Ear(gap_mm=0.03), codes=_mass("cut_through_bone")),
    "incus_40um_away": _ct(ear=Ear(incus_gap_mm=0.04)),
    "coarse_voxels": _ct(Scan(voxel_um=50.0, seed=3)),
    "fine_voxels": _ct(Scan(voxel_um=22.0, seed=5)),
    "eight_bits": _ct(Scan(voxel_um=32.0, dtype="uint8", window=(4000.0, 36000.0), seed=8)),
    "correlated_noise": _ct(
        Scan(voxel_um=32.0, noise=0.05, noise_correlation_voxels=1.0, seed=9),
    ),
    "round_field_of_view": _ct(
        Scan(voxel_um=32.0, round_field=True, padding=0.0, seed=10), codes=_mass("file_read")
    ),
    "foreign_stapes": _ct(ear=Ear(stapes=Stapes(family="analytic"))),
    "small_warped_right_ear": _ct(
        ear=Ear(stapes=Stapes(scale=0.85, warp=0.03, mirrored=True, seed=4)),
        codes=_mass("outside_published_sizes"),
    ),
    "glued_bead": _ct(ear=Ear(loose_masses=((0.3, 1.2, 0.2, 5e-8),))),
    "named_segments": _ct(Scan(voxel_um=40.0, seed=3), labels=".seg.nrrd"),
    "closed_mesh": _ct(
        Scan(voxel_um=32.0, format="ply", seed=3),
        codes=_mass("grey_values_missing"),
        without=("bare_bone_assumed", "plate_axis_sign"),
    ),
    "mended_mesh": _ct(
        Scan(voxel_um=32.0, format="stl", seed=3),
        codes=_mass("grey_values_missing", "file_read"),
        without=("bare_bone_assumed", "plate_axis_sign"),
    ),
    # the ways in which a file can hold a scan; every format has the same voxels and places: tests/scan_files
    "nifti_left_handed": _format("nii.gz", ("file_read",), _ORIENTED),
    "dicom": _format("scan_dicom", without=_ORIENTED, writer=dicom),
    "zarr": _format("scan.zarr", writer=partial(ome_zarr, version="0.5", chunk=32)),
    "slices": _format("slices"),
    # measurements: noise, geometry, formats, faults
    "points_in_footplate_axes": _points(),
    "three_points_robust": _points(
        Experiment(lines=80, in_footplate=True, stapes_points=4, seed=5), points2dof="--robust t4"
    ),
    "noise_from_coherence": _points(Experiment(lines=80, in_footplate=True, stated="coherence", seed=6)),
    "noise_not_stated": _points(
        Experiment(lines=80, in_footplate=True, stated="none", seed=7), ("noise_estimated",)
    ),
    "one_laser": _points(
        Experiment(lines=80, in_footplate=True, lasers=1, stapes_points=12, bone_points=12, seed=8),
        ("neglected_motion",),
        points2dof="--dof y,alpha,gamma",
    ),
    "missing_values": _points(
        Experiment(lines=80, in_footplate=True, missing=0.1, missing_band=True, seed=9), ("file_read",)
    ),
    "three_excitations": _points(
        Experiment(lines=60, in_footplate=True, excitations=("x", "y", "z"), seed=10)
    ),
    "repeats": _points(
        Experiment(lines=60, in_footplate=True, excitations=("y", "y", "y", "y"), repeats=True, seed=19)
    ),
    "calibrated_lasers": _points(Experiment(lines=80, in_footplate=True, seed=20), points2dof="--calibrate"),
    "per_reference": _points(points2dof="--reference base:y"),
    "noise_free": _points(
        Experiment(lines=40, in_footplate=True, exact=True, position_sd_mm=0.0, seed=11), ("noise_estimated",)
    ),
    "universal_file": _points(
        Experiment(lines=60, in_footplate=True, format="uff", seed=12),
        ("amplitude_assumed", "noise_estimated", "file_read"),
    ),
    "matlab_file": _points(
        Experiment(lines=60, in_footplate=True, format="mat", seed=13),
        ("amplitude_assumed", "length_unit_assumed", "noise_estimated"),
    ),
    "wide_table": _points(
        Experiment(lines=60, in_footplate=True, format="wide", seed=14),
        ("amplitude_assumed", "noise_estimated"),
    ),
    "gain": _with_fault("gain", size=0.2, point="3", laser=0),
    "sign": _with_fault("sign", point="2", laser=1),
    "wrong_position": _with_fault("position", size=0.4, point="5"),
    "exchanged_points": _with_fault("label_swap", point="3", other="4"),
    # the whole chain, registered by fiducials on the plate
    "whole_ear": Scene(scan=Scan(voxel_um=34.0, seed=12), experiment=_PLANE, fits=True),
    "whole_right_ear": Scene(
        ear=Ear(stapes=Stapes(mirrored=True)), scan=Scan(voxel_um=34.0, seed=13), experiment=_PLANE, fits=True
    ),
    "fiducials_in_the_scan": Scene(
        ear=Ear(plate=False),
        scan=Scan(voxel_um=34.0, seed=14),
        experiment=Experiment(lines=60, seed=22),
        codes=_mass("plate_not_found"),
        without=("plate_axis_sign",),
    ),
    # fits of K and D: estimators, laws, degrees of freedom, plane, closed forms
    "piston": _fit(),
    "piston_pinv": _fit(words="--estimator pinv", warnings=("estimator_biased", "misfit")),
    "piston_constrained": _fit(words="--estimator constrained", warnings=("estimator_biased",)),
    "piston_t4": _fit(words="--robust t4"),
    "hysteretic": _fit(damped_alike(Ligament(), "hysteretic"), words="--damping hysteretic"),
    "fractional": _fit(damped_alike(Ligament(), "fractional"), words="--damping fractional"),
    "laws_compared": _fit(damped_alike(Ligament(), "hysteretic"), words="--damping compare"),
    "ring_in_its_plane": _fit(_RING, _PLANE),
    "six_degrees_of_freedom": _fit(
        _RING, Experiment(lines=120, excitations=("x", "y", "z"), seed=15), words="--dof all"
    ),
    "five_degrees_of_freedom": _fit(
        Ligament(
            stiffness_si=_RING.stiffness_si[_FIVE],
            damping_si=_RING.damping_si[_FIVE],
            dof=("x", "y", "z", "alpha", "gamma"),
        ),
        Experiment(lines=120, excitations=("x", "y", "z"), seed=16),
        words="--dof x,y,z,alpha,gamma",
    ),
    "few_lines": _fit(experiment=Experiment(lines=14, others=0.3, seed=17)),
    "closed_form": _fit(
        experiment=Experiment(lines=100, others=0.0, exact=True, position_sd_mm=0.0, seed=18),
        warnings=("inplane_assumed", "noise_level"),
    ),
}

USUAL = {
    "ct2mass": {"bare_bone_assumed", "handedness_unconfirmed", "plate_axis_sign"},
    "points2dof": set[str](),
    "dof2kd": set[str](),
}
"""Warnings that every scene of a command has: nothing confirms the handedness of a simulated scan, ..."""
