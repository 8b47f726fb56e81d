"""From the bodies in a scan, or the surface of a stapes, to its frames and its mass matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.auxiliary_inputs import SmallInputs
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.anatomy import AnatomyHints
from legacy.ct_inertia.frames.footplate import FootplateFrame, footplate_frame, footplate_pose
from legacy.ct_inertia.mass.mass_estimates import (
    MassByWay,
    at_uniform_density,
    disagreements,
    masses_by_way,
    not_stated,
)
from legacy.ct_inertia.mass.mass_properties import (
    MassProperties,
    footplate_mass_matrix,
    plate_axes_mass_matrix,
    point_masses,
    scaled,
    with_added,
)
from legacy.ct_inertia.mass.plausibility import implausible, size_notice, unsuitable
from legacy.ct_inertia.mass.published_sizes import measured_values, unusual_notice
from legacy.ct_inertia.mass.voxel_scale import voxel_scale
from legacy.ct_inertia.mass_measurement import MassMeasurement
from legacy.ct_inertia.options import MassOptions
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.surface.surface import Surface
from legacy.stapeskit.background import Later
from legacy.stapeskit.frames import vector_from_rotation
from legacy.stapeskit.option_names import named
from legacy.stapeskit.records.mass_record import MassMatrix
from legacy.stapeskit.warnings import Notice, unique

if TYPE_CHECKING:
    from legacy.ct_inertia.bodies import Bodies, PlateFrame
    from legacy.ct_inertia.frames.window_gap import WindowGap


def mass_of_bodies(
    options: MassOptions,
    known: SmallInputs,
    bodies: Bodies | None,
    stapes: Surface,
    frame_surface: Surface,
    plate: Surface | None,
    notices: Sequence[Notice],
) -> MassMeasurement:
    """Find the frames of a stapes that was found, and its mass matrix by every way to a mass.

    Parameters
    ----------
    options : MassOptions
    known : SmallInputs
    bodies : Bodies or None
        The segmentation; None for a mesh.
    stapes, frame_surface : Surface
        The stapes, and the surface that its footplate is found on.
    plate : Surface or None
    notices : sequence of Notice
        What was noticed until here.

    Raises
    ------
    CtInertiaError
        No footplate, a body that cannot be a stapes, or contradicting hints.
    """
    mesh_moments = stapes.moments() if bodies is None else bodies.mesh_moments
    moments = mesh_moments if bodies is None else bodies.moments
    later = Later(_plate_frame, known, bodies, stapes, plate)
    footplate, doubts = _footplate(options, known, frame_surface, bodies, moments, notices)
    gap = Later(_gap, bodies, footplate)
    added = point_masses(options.add_mass)
    found_by = masses_by_way(options, known.calibration, bodies, moments)
    scale = None if bodies is None else voxel_scale(options, bodies.volume)
    factor, scale_sd = (1.0, options.voxel_size_sd) if scale is None else (scale.factor, scale.sd)
    bodies_by = {way: with_added(scaled(bare, factor), added) for way, bare in found_by.items()}
    ways = tuple(MassByWay(way, body, _matrix(body, footplate, scale_sd)) for way, body in bodies_by.items())
    body, matrix = ways[0].body, ways[0].matrix
    by_mesh = with_added(scaled(at_uniform_density(body, mesh_moments), factor), added)
    frame = later.result()
    plate_matrix = None
    if frame is not None:
        plate_from_footplate = frame.scan_from_plate.inverse() @ footplate.scan_from_footplate
        plate_matrix = plate_axes_mass_matrix(
            matrix, plate_from_footplate, footplate.covariance, frame.covariance
        )
    collected = [
        *notices,
        *doubts,
        *footplate.notices,
        *(_no_plate(bodies) if frame is None else frame.notices),
        *not_stated(matrix.contributions, ways[0].way),
        *disagreements(ways),
        *(() if scale is None or bodies is None else (scale.notice(bodies.volume.spacing_mm.tolist()),)),
        *unusual_notice(measured_values(body.volume_m3, body.density_kg_m3, footplate)),
    ]
    return MassMeasurement(
        options,
        stapes,
        plate,
        moments,
        mesh_moments,
        body,
        footplate,
        frame,
        matrix,
        plate_matrix,
        _matrix(by_mesh, footplate, scale_sd),
        bodies,
        unique(collected),
        ways,
        gap=gap.result(),
    )


def _gap(bodies: Bodies | None, footplate: FootplateFrame) -> WindowGap | None:
    if bodies is None or bodies.wall is None:
        return None
    from legacy.ct_inertia.frames.window_gap import window_gap

    return window_gap(footplate, bodies.frame_surface, bodies.frame_blur_mm, bodies.wall)


def _footplate(
    options: MassOptions,
    known: SmallInputs,
    surface: Surface,
    bodies: Bodies | None,
    moments: Moments,
    notices: Sequence[Notice],
) -> tuple[FootplateFrame, list[Notice]]:
    """Find the footplate; a body that cannot be a stapes is refused unless somebody named it."""
    blur, noise = (0.0, 0.0) if bodies is None else (bodies.frame_blur_mm, bodies.frame_noise_mm4)
    named = options.is_mesh or options.seed_mm is not None or options.labels is not None
    try:
        footplate = footplate_frame(surface, known.hints, blur, noise)
    except CtInertiaError:
        # Where the body is wrong, correct landmarks do not fit it: report the body first.
        reasons = [] if named else implausible(footplate_frame(surface, blur_mm=blur), moments.volume_mm3)
        if reasons:
            raise unsuitable(reasons, notices) from None
        raise
    reasons = implausible(footplate, moments.volume_mm3)
    if reasons and not named:
        raise unsuitable(reasons, notices)
    return _with_doubt(footplate, known.hints, bodies), [size_notice(reasons)] if reasons else []


def _with_doubt(footplate: FootplateFrame, hints: AnatomyHints, bodies: Bodies | None) -> FootplateFrame:
    """Add the uncertainty from soft tissue around the stapes to the covariance of its frame."""
    if bodies is None or bodies.frame_doubt is None:
        return footplate
    other = footplate_pose(bodies.frame_doubt, hints, bodies.frame_blur_mm)
    moved = footplate.scan_from_footplate.inverse() @ other
    step = np.concatenate([moved.translation_mm * 1e-3, vector_from_rotation(moved.rotation)])
    return replace(footplate, contributions={**footplate.contributions, "surroundings": np.outer(step, step)})


def _matrix(body: MassProperties, footplate: FootplateFrame, voxel_size_sd: float | None) -> MassMatrix:
    return footplate_mass_matrix(body, footplate.scan_from_footplate, footplate.covariance, voxel_size_sd)


def _no_plate(bodies: Bodies | None) -> tuple[Notice, ...]:
    """Return the warning that a scan shows no plate; a surface of the stapes alone never does."""
    if bodies is None:
        return ()
    text = (
        "No plate was found beside the stapes: there is no plate frame, and no mass matrix in its axes. If "
        f"the scan holds one, give {named('plate_fiducials')}, or label it ({named('labels')})."
    )
    return (Notice("plate_not_found", text),)


def _plate_frame(
    known: SmallInputs, bodies: Bodies | None, stapes: Surface, plate: Surface | None
) -> PlateFrame | None:
    middle = stapes.vertices_mm.mean(axis=0)
    if known.fiducials is not None:
        from legacy.ct_inertia.frames.plate_fiducials import plate_frame_from_fiducials

        return plate_frame_from_fiducials(known.fiducials, middle)
    if plate is None or bodies is None:
        return None
    if bodies.plate_frame is not None:
        return bodies.plate_frame.result()
    from legacy.ct_inertia.frames.plate_frame import plate_frame

    grey = None if bodies.levels is None else bodies.volume
    return plate_frame(plate, middle, _on_border(bodies, plate), grey, bodies.psf_sigma_mm, bodies.plate_face)


def _on_border(bodies: Bodies, plate: Surface) -> NDArray[np.bool_]:
    """Return which vertices (n,) of the plate lie at the border of the scan."""
    from legacy.ct_inertia.frames.plate_surface import PlateSurface

    if isinstance(plate, PlateSurface):
        return plate.on_border
    index = bodies.volume.index_points(plate.vertices_mm)
    return np.asarray(np.any((index < 0.6) | (index > bodies.volume.size - 1.6), axis=1))
