"""From the tables of a study file to the options of the three rooms, and back to words a study file knows."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from pipeline.study import Fit, Ldv, Scan

if TYPE_CHECKING:
    from ct_inertia.ct2mass import MassOptions
    from fitting.kd import KDOptions
    from kinematics.points2dof import Options

_KEYS = {
    "--spacing": "spacing_mm in [scan]",
    "--density": "density_kg_m3 in [scan]",
    "--mass-mg": "mass_mg in [scan]",
    "--calibration": "calibration in [scan]",
    "--labels": "labels in [scan]",
    "--stapes-label": "stapes_label in [scan]",
    "--plate-label": "plate_label in [scan]",
    "--landmarks": "landmarks in [scan]",
    "--plate-fiducials": "plate_fiducials in [scan]",
    "--side": "side in [scan]",
    "--anterior": "anterior in [scan]",
    "--threshold": "threshold in [scan]",
    "--seed": "seed_mm in [scan]",
    "--box": "box_mm in [scan]",
    "--add-mass": "add_mass in [scan]",
    "--nan-as-air": "nan_as_air in [scan]",
    "--voxel-size-sd": "voxel_size_sd_percent in [scan]",
    "--mirror": "mirror in [scan] or [ldv]",
    "--points": "points in [ldv]",
    "--fiducials": "fiducials in [ldv]",
    "--frame": "frame in [ldv]",
    "--reference": "reference in [ldv]",
    "--robust": "robust in [ldv] or [fit]",
    "--dof": "dof in [ldv] or [fit]",
    "--structure": "structure in [fit]",
    "--base": "base in [fit]",
    "--estimator": "estimator in [fit]",
    "--damping": "damping in [fit]",
    "--inplane": "inplane in [fit]",
    "--band": "band_hz in [fit]",
    "--exclude": "exclude_hz in [fit]",
    "--constraint": "constraint in [fit]",
    "--lower": "lower in [fit]",
    "--upper": "upper in [fit]",
    "--mass": "the scan",
}
_OPTION = re.compile(r"--[a-z]+(?:-[a-z]+)*")


def in_study_words(text: str) -> str:
    """Name the keys of a study file where a message of a single command names its options."""
    return _OPTION.sub(lambda found: _KEYS.get(found.group(), found.group()), text)


def mass_options(scan: Scan) -> MassOptions:
    """Return the options of `ct2mass`."""
    import numpy as np

    from ct_inertia.ct2mass import MassOptions
    from ct_inertia.mass_properties import PointMass

    percent = scan.voxel_size_sd_percent
    return MassOptions(
        scan=scan.file,
        density=scan.density_kg_m3,
        mass_mg=scan.mass_mg,
        calibration=scan.calibration,
        spacing_mm=scan.spacing_mm,
        labels=scan.labels,
        stapes_label=scan.stapes_label,
        plate_label=scan.plate_label,
        landmarks=scan.landmarks,
        plate_fiducials=scan.plate_fiducials,
        side=scan.side,
        anterior=scan.anterior,
        threshold=scan.threshold,
        seed_mm=scan.seed_mm,
        box_mm=scan.box_mm,
        mirror=scan.mirror,
        nan_as_air=scan.nan_as_air,
        added=tuple(PointMass(np.array(row[:3]), row[3] * 1e-6, row[4] * 1e-6) for row in scan.add_mass),
        voxel_size_sd=None if percent is None else percent / 100.0,
    )


def motion_options(ldv: Ldv) -> Options:
    """Return the options of `points2dof`."""
    from kinematics.points2dof import Options

    return Options(ldv.dof, ldv.reference, ldv.robust)


def fit_options(fit: Fit) -> KDOptions:
    """Return the options of `dof2kd`."""
    from fitting.kd import KDOptions

    return KDOptions(
        dof=fit.dof,
        structure=fit.structure,
        base=fit.base,
        estimator=fit.estimator,
        robust=fit.robust,
        damping=fit.damping,
        inplane=fit.inplane,
        band_hz=fit.band_hz,
        exclude_hz=fit.exclude_hz,
        constraint=fit.constraint,
        lower=fit.lower,
        upper=fit.upper,
    )
