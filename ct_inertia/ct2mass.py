"""From a scan, a label volume or a closed mesh to the mass matrix: everything `ct2mass` does but writing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ct_inertia.errors import CtInertiaError
from ct_inertia.frames.anatomy import AnatomyHints
from ct_inertia.frames.footplate import FootplateFrame, footplate_frame, footplate_pose
from ct_inertia.mass.mass_properties import (
    MassProperties,
    footplate_mass_matrix,
    plate_axes_mass_matrix,
    point_masses,
    scaled,
    with_added,
)
from ct_inertia.mass.masses import MassByWay, at_uniform_density, disagreements, masses_by_way, not_stated
from ct_inertia.mass.plausibility import check_mesh, implausible, size_notice, unsuitable
from ct_inertia.mass.published import measured_values, unusual_notice
from ct_inertia.mass.voxel_scale import voxel_scale
from ct_inertia.options import MassOptions
from ct_inertia.readers.mapping import lost_pages
from ct_inertia.surface.moments import Moments
from ct_inertia.surface.surface import Surface, read_surface
from stapeskit.background import Later
from stapeskit.faults import Fault
from stapeskit.frames import vector_from_rotation
from stapeskit.progress import Tell, silent
from stapeskit.records.mass_record import MassMatrix
from stapeskit.unchanged import InputStates
from stapeskit.vocabulary import named
from stapeskit.warnings import Notice, unique

if TYPE_CHECKING:
    from ct_inertia.bodies import Bodies
    from ct_inertia.frames.plate_fiducials import PlateFiducials
    from ct_inertia.frames.plate_frame import PlateFrame
    from ct_inertia.frames.window_gap import WindowGap
    from ct_inertia.mass.calibration import Calibration

__all__ = ["MassMeasurement", "MassOptions", "ct2mass"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MassMeasurement:
    """What `ct2mass` found.

    Attributes
    ----------
    options : MassOptions
    stapes : Surface
    plate : Surface or None
    moments, mesh_moments : Moments
        The ones used, and those of the surface.
    body : MassProperties
        In scan axes.
    footplate : FootplateFrame
    plate_frame : PlateFrame or None
    matrix : MassMatrix
        About the footplate centre in footplate axes.
    plate_matrix : MassMatrix or None
        About the footplate centre in plate axes.
    mesh_matrix : MassMatrix
        As ``matrix``, from the moments of the surface: a cross-check.
    bodies : Bodies or None
        The segmentation; None for a mesh.
    notices : tuple of Notice
    ways : tuple of MassByWay
        The mass matrix by every way to a mass that was given; the leading one, which is ``matrix``, first.
    inputs : InputStates or None
        The input files as they were when they were read.
    gap : WindowGap or None
        Between the footplate's rim and the bone around it, where the scan shows it.
    """

    options: MassOptions
    stapes: Surface
    plate: Surface | None
    moments: Moments
    mesh_moments: Moments
    body: MassProperties
    footplate: FootplateFrame
    plate_frame: PlateFrame | None
    matrix: MassMatrix
    plate_matrix: MassMatrix | None
    mesh_matrix: MassMatrix
    bodies: Bodies | None = None
    notices: tuple[Notice, ...] = field(default=())
    ways: tuple[MassByWay, ...] = ()
    inputs: InputStates | None = None
    gap: WindowGap | None = None


@dataclass(frozen=True)
class _Known:
    """The small inputs, read before the large one."""

    hints: AnatomyHints
    fiducials: PlateFiducials | None
    calibration: Calibration | None


def ct2mass(options: MassOptions, progress: Tell = silent) -> MassMeasurement:
    """Find the stapes, its frames and its mass matrix.

    Parameters
    ----------
    options : MassOptions
    progress : callable
        Called with a few words at the beginning of each stage.

    Raises
    ------
    CtInertiaError, KinematicsError
        Anything that is wrong with the options or the files, in one sentence.
    """
    inputs = InputStates.of(options.inputs.values())
    lost = lost_pages()
    try:
        result = _measure(options, progress)
    except Exception:
        # Where a file has changed, that is the cause of whatever failed.
        _check_inputs(inputs, lost)
        raise
    _check_inputs(inputs, lost)
    return replace(result, inputs=inputs)


def _check_inputs(inputs: InputStates, lost: int) -> None:
    inputs.check(CtInertiaError)
    if lost_pages() != lost:
        raise CtInertiaError(
            Fault("the scan", "readable to its end", "a part that its disk did not give", "", "Copy it anew")
        )


def _measure(options: MassOptions, progress: Tell) -> MassMeasurement:
    known = _known(options)
    progress("reading and finding the stapes")
    if options.is_mesh:
        surface = read_surface(Path(str(options.scan)))
        check_mesh(surface, Path(str(options.scan)).name)
        exact = Notice(
            "surface_taken_as_exact",
            "The input is a surface: it is taken as exact, and the budget holds density or mass and the "
            "frame only.",
        )
        return _result(options, known, None, surface, surface, None, (*surface.notices, exact))
    bodies = _bodies(options, progress)
    progress("finding the frames")
    _ = bodies.labels.packed  # is packed in the background
    return _result(options, known, bodies, bodies.stapes, bodies.frame_surface, bodies.plate, bodies.notices)


def _known(options: MassOptions) -> _Known:
    landmarks: dict[str, Array] = {}
    if options.landmarks is not None:
        from ct_inertia.frames.landmarks import read_landmarks

        landmarks = read_landmarks(options.landmarks)
    anterior = None if options.anterior is None else np.array(options.anterior, dtype=float)
    hints = AnatomyHints(anterior, landmarks, options.side)
    fiducials = None
    if options.plate_fiducials is not None:
        from ct_inertia.frames.plate_fiducials import read_plate_fiducials

        fiducials = read_plate_fiducials(options.plate_fiducials)
    calibration = None
    if options.calibration is not None:
        from ct_inertia.mass.calibration import read_calibration

        calibration = read_calibration(options.calibration)
    return _Known(hints, fiducials, calibration)


def _bodies(options: MassOptions, progress: Tell) -> Bodies:
    from ct_inertia.read import read_labels, read_volume

    volume, glance = None, None
    if options.scan is not None:
        volume = read_volume(
            options.scan,
            options.spacing_mm,
            options.mirror,
            options.nan_as_air,
            options.raw,
            options.follow,
        )
        if options.labels is None and options.box_mm is None:
            from ct_inertia.volume.coarse import take_glance

            glance = Later(take_glance, volume)
    from ct_inertia.grey.coat import stated_coat
    from ct_inertia.labelling.from_scan import find_bodies
    from ct_inertia.segment.sight import SearchOptions

    labels = None
    if options.labels is not None:
        if not Path(options.labels).exists():
            raise CtInertiaError(
                Fault("{labels}", "an existing label volume", options.labels, next_step="Check the path")
            )
        spacing = options.spacing_mm if volume is None else tuple(float(v) for v in volume.spacing_mm)
        labels = read_labels(options.labels, spacing, options.mirror, options.follow)
    search = SearchOptions(
        threshold=options.threshold,
        seed_mm=None if options.seed_mm is None else np.array(options.seed_mm),
        box_mm=None if options.box_mm is None else np.array(options.box_mm),
        labels=labels,
        stapes_label=options.stapes_label,
        plate_label=options.plate_label,
    )
    coat = stated_coat(options.coat_um, options.coat_grey)
    return find_bodies(volume, search, progress, glance, coat)


def _result(
    options: MassOptions,
    known: _Known,
    bodies: Bodies | None,
    stapes: Surface,
    frame_surface: Surface,
    plate: Surface | None,
    notices: Sequence[Notice],
) -> MassMeasurement:
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
    from ct_inertia.frames.window_gap import window_gap

    return window_gap(footplate, bodies.frame_surface, bodies.frame_blur_mm, bodies.wall)


def _footplate(
    options: MassOptions,
    known: _Known,
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
    """Say that a scan shows no plate; a surface of the stapes alone cannot."""
    if bodies is None:
        return ()
    text = (
        "No plate was found beside the stapes: there is no plate frame, and no mass matrix in its axes. If "
        f"the scan holds one, give {named('plate_fiducials')}, or label it ({named('labels')})."
    )
    return (Notice("plate_not_found", text),)


def _plate_frame(
    known: _Known, bodies: Bodies | None, stapes: Surface, plate: Surface | None
) -> PlateFrame | None:
    middle = stapes.vertices_mm.mean(axis=0)
    if known.fiducials is not None:
        from ct_inertia.frames.plate_fiducials import plate_frame_from_fiducials

        return plate_frame_from_fiducials(known.fiducials, middle)
    if plate is None:
        return None
    from ct_inertia.frames.plate_frame import plate_frame

    if bodies is None:
        return plate_frame(plate, stapes)
    grey = None if bodies.levels is None else bodies.volume
    return plate_frame(plate, stapes, _on_border(bodies, plate), grey, bodies.psf_sigma_mm, bodies.plate_face)


def _on_border(bodies: Bodies, plate: Surface) -> NDArray[np.bool_]:
    """Return which vertices (n,) of the plate lie at the border of the scan."""
    from ct_inertia.frames.plate_surface import PlateSurface

    if isinstance(plate, PlateSurface):
        return plate.on_border
    index = bodies.volume.index_points(plate.vertices_mm)
    return np.asarray(np.any((index < 0.6) | (index > bodies.volume.size - 1.6), axis=1))
