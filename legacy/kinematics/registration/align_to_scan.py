"""Tie the vibrometer to the scan with all that was given, and see whether the points lie on its surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.measurement import Measurement
from legacy.kinematics.registration.fiducials import Fiducials
from legacy.kinematics.registration.icp import fit_to_surface
from legacy.kinematics.registration.icp_refine import Cloud
from legacy.kinematics.registration.mesh_distance import TriangleSurface
from legacy.kinematics.registration.placement import Placement, place, place_on_surface, scan_guess
from legacy.kinematics.registration.sample_displacement import check_surfaces, clouds
from legacy.kinematics.registration.scan_surfaces import ScanSurfaces
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.records.mass_record import MassRecord


def align_to_scan(
    measurement: Measurement,
    fiducials: Fiducials | None = None,
    frame: str = "footplate",
    mass: MassRecord | None = None,
    surfaces: ScanSurfaces | None = None,
    plate: Cloud | None = None,
    bone: Cloud | None = None,
) -> Placement:
    """Find the pose of the measurement in the footplate frame.

    Parameters
    ----------
    measurement : Measurement
        In vibrometer coordinates, or in ``frame`` when there are neither fiducials nor plate points.
    fiducials : Fiducials, optional
    mass : MassRecord, optional
    surfaces : ScanSurfaces, optional
        The surfaces of the scan; with them the measured points are held against the surfaces.
    plate : Cloud, optional
        Points on the plate, laid on its surface; fiducials then are the first guess and count by their
        covariance.
    bone : Cloud, optional
        More points on the bone, for the check only.

    Raises
    ------
    KinematicsError
        What place, fit_to_surface and check_surfaces refuse, or surfaces that are not there.
    """
    if plate is None:
        placement = place(fiducials, frame, mass)
    else:
        placement = _on_plate(measurement, fiducials, mass, surfaces, plate)
    if mass is None or surfaces is None:
        return placement
    return check_surfaces(measurement, placement, mass, surfaces, bone)


def _on_plate(
    measurement: Measurement,
    fiducials: Fiducials | None,
    mass: MassRecord | None,
    surfaces: ScanSurfaces | None,
    plate: Cloud,
) -> Placement:
    mesh = None if surfaces is None else surfaces.mesh("plate")
    if mass is None or surfaces is None or mesh is None:
        raise KinematicsError.of(
            "{plate_points}",
            "given with a mass.json that has a plate.ply beside it",
            "no plate.ply",
            next_step="Scan stapes and plate together with ct2mass, or use fiducials in frame scan",
        )
    first = None if fiducials is None else place(fiducials, "footplate", mass)
    fit = fit_to_surface(
        plate,
        mesh,
        guess=None if first is None else scan_guess(first, mass),
        towards=_mean_direction(measurement),
        witnesses=_witnesses(measurement, surfaces),
        axes=_plate_axes(mass),
        source=measurement.frame,
    )
    placement = place_on_surface(fit.registration, mass)
    if first is None:
        return placement
    return replace(placement, notices=(*first.notices, *placement.notices))


def _mean_direction(measurement: Measurement) -> Array:
    mean = np.concatenate([body.directions for body in measurement.bodies]).mean(axis=0)
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-12))


def _witnesses(measurement: Measurement, surfaces: ScanSurfaces) -> list[tuple[Array, TriangleSurface]]:
    """Return the points on the stapes, whose surface is known without a placement."""
    stapes = surfaces.mesh("stapes")
    return [
        (cloud.points_mm, stapes)
        for cloud in clouds(measurement)
        if stapes is not None and cloud.kind == "stapes" and len(cloud.points_mm) >= 3
    ]


def _plate_axes(mass: MassRecord) -> RigidTransform | None:
    if mass.plate_from_footplate is None:
        return None
    return mass.scan_from_footplate @ mass.plate_from_footplate.inverse()
