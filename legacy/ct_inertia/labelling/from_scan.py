"""From a scan to the bodies in it: the stapes with its moments, the plate, the other bone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from legacy.ct_inertia.bodies import Bodies, PlateFrame
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.plate_surface import PlateSurface, surface_with_planes
from legacy.ct_inertia.grey.air_level import Guess
from legacy.ct_inertia.grey.frame_surface import doubted_surface, frame_surface, height_noise_of
from legacy.ct_inertia.grey.measure_stapes import Measured, measure_stapes
from legacy.ct_inertia.grey.partial_volume import with_contribution, with_voxel_size
from legacy.ct_inertia.grey.ring_artefacts import ring_notices
from legacy.ct_inertia.grey.scan_border import border_covariance, border_cuts, cropped_notice, cut_notice
from legacy.ct_inertia.grey.soft_coat import Coat, bare_bone_notice
from legacy.ct_inertia.grey.thresholded import is_thresholded, with_threshold
from legacy.ct_inertia.labelling.label_box import label_box
from legacy.ct_inertia.segment.coarse_segmentation import CoarseSegmentation, SearchOptions
from legacy.ct_inertia.segment.extract_stapes import Cut, extract_stapes
from legacy.ct_inertia.segment.find_stapes import find_stapes
from legacy.ct_inertia.segment.plate_region import PlateRegion, find_plate
from legacy.ct_inertia.surface.moment_matching import moment_matched
from legacy.ct_inertia.volume.coarse_view import CoarseOverview, coarse_overview, smooth_noise
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.background import Later
from legacy.stapeskit.progress import Tell, silent
from legacy.stapeskit.warnings import unique


def find_bodies(
    volume: Volume | None,
    options: SearchOptions | None = None,
    progress: Tell = silent,
    glance: Later[CoarseOverview] | None = None,
    coat: Coat | None = None,
) -> Bodies:
    """Find stapes, plate and other bone in a scan, and measure the stapes.

    Parameters
    ----------
    volume : Volume or None
        Grey values; None to take the bodies from ``options.labels`` alone.
    options : SearchOptions, optional
    progress : callable
        Called with a few words at the beginning of each stage.
    glance : Later of CoarseOverview, optional
        The coarse view of the whole volume, when it is being taken already.
    coat : Coat, optional
        A soft coat on the bone; None: not stated, bare bone is assumed.

    Returns
    -------
    Bodies

    Raises
    ------
    CtInertiaError
        No body that can be a stapes, or several; labels that are missing or lie elsewhere; nothing given.
    """
    options = options or SearchOptions()
    if options.labels is not None:
        from legacy.ct_inertia.labelling.from_labels import bodies_from_labels

        return bodies_from_labels(volume, options, coat)
    if volume is None:
        raise CtInertiaError.of("the scan", "given", "none", "", "Give a volume or labels")
    if options.box_mm is not None:
        volume, glance = volume.cropped(options.box_mm), None
    glance = glance or Later(coarse_overview, volume)
    sight = find_stapes(volume, options, glance.taken())
    progress("cutting the stapes out")
    finding = Later(find_plate, sight)
    cut = extract_stapes(volume, sight, finding.result)
    plate = finding.result()
    if plate is not None and plate.immersing:
        plate = None
    plate_mesh = None if plate is None else Later(surface_with_planes, volume, sight, plate)
    # The coarse grey values have done their work: the working copy takes their place in memory.
    sight = replace(sight, scan=replace(sight.scan, grey=sight.scan.grey[:0].copy()))
    progress("measuring the stapes")
    return _assemble(volume, sight, plate, plate_mesh, cut, options, coat)


def _assemble(
    volume: Volume,
    sight: CoarseSegmentation,
    plate: PlateRegion | None,
    plate_mesh: Later[PlateSurface | None] | None,
    cut: Cut,
    options: SearchOptions,
    coat: Coat | None,
) -> Bodies:
    """Measure what was cut out and build surfaces and labels."""
    grid = volume if cut.working is None else cut.working.volume
    measured = measure_stapes(grid, cut, Guess(sight.air, sight.bone, sight.plastic, sight.between), coat)
    moments = measured.moments
    frame = None if plate_mesh is None else Later(_plate_frame, volume, plate_mesh, measured)
    if options.voxel_size_sd is not None:
        moments = with_voxel_size(moments, options.voxel_size_sd, volume.origin_mm)
    share = smooth_noise(measured.share, measured.levels.noise / measured.levels.contrast)
    mesh = Later(moment_matched, share, moments, cut.scan_from_box(grid))
    coarse = frame_surface(measured.share, cut.scan_from_box(grid), measured.sigma_mm)
    notices = [*volume.notices, *sight.notices, *cut.notices, *measured.notices]
    cuts = border_cuts(volume, cut)
    if cuts:
        moments = with_contribution(
            moments, "border", border_covariance(cuts, measured.share, cut, grid, moments)
        )
        notices.append(cut_notice(cuts, held=True))
    if sight.cropped:
        notices.append(cropped_notice())
    notices += ring_notices(cut, measured.levels, measured.sigma_mm, grid.spacing_mm)
    if any(notice.code == "phase_fringes" for notice in notices):
        # Bright edges of bone look like cupping.
        notices = [notice for notice in notices if notice.code != "bone_cupping"]
    if coat is None:
        notices.append(bare_bone_notice(coarse.surface, moments.volume_mm3, measured.sigma_mm))
    thresholded = is_thresholded(_as_stored(cut))
    stapes, level = mesh.result()
    if thresholded:
        moments, notice = with_threshold(moments, stapes, float(volume.spacing_mm.max()))
        notices.append(notice)
    levels = replace(measured.levels, plastic=None if plate is None else sight.plastic)
    return Bodies(
        volume=volume,
        labels=label_box(volume, sight, plate, cut, replace(measured, share=share), level),
        stapes=stapes,
        frame_surface=coarse.surface,
        frame_blur_mm=coarse.blur_mm,
        frame_noise_mm4=height_noise_of(
            measured.levels.noise / measured.levels.contrast,
            measured.correlation,
            cut.scan_from_box(grid),
            coarse.blur_mm,
        ),
        frame_doubt=doubted_surface(
            measured.share, measured.doubt, cut.scan_from_box(grid), measured.sigma_mm, coarse
        ),
        wall=measured.wall.result(),
        plate=None if plate_mesh is None else plate_mesh.result(),
        moments=moments,
        mesh_moments=stapes.moments(),
        levels=levels,
        psf_sigma_mm=measured.sigma_mm,
        plate_face=measured.plate_face,
        plate_frame=frame,
        evidence=_evidence(sight, cut, measured, level),
        notices=unique(notices),
    )


def _plate_frame(volume: Volume, mesh: Later[PlateSurface | None], measured: Measured) -> PlateFrame | None:
    from legacy.ct_inertia.frames.plate_frame import plate_frame

    plate, middle = mesh.result(), measured.moments.centroid_mm
    if plate is None:
        return None
    return plate_frame(plate, middle, plate.on_border, volume, measured.sigma_mm, measured.plate_face)


def _as_stored(cut: Cut) -> NDArray[Any]:
    """Return grey values of the box that are no means of several voxels."""
    single = None if cut.working is None else cut.working.single
    return cut.grey if single is None else single


def _evidence(sight: CoarseSegmentation, cut: Cut, measured: Measured, level: float) -> dict[str, Any]:
    def listed(values: Sequence[float] | Array) -> list[float]:
        return [float(v) for v in values]

    return {
        "stapes": sight.stapes.as_json(),
        "other_bone": [piece.as_json() for piece in sight.others[:5]],
        "coarse_spacing_mm": listed(sight.scan.spacing_mm),
        "material_levels": listed(
            [sight.air, *([] if sight.plastic is None else [sight.plastic]), sight.bone]
        ),
        "bone_above": float(sight.between),
        "separation": cut.method,
        "iso_level_share": float(level),
        "psf_sigma_mm": float(measured.sigma_mm),
        "psf_from": measured.sigma_from,
        "noise_correlation": float(measured.correlation),
        "air_clipped_share": float(measured.air_clipped),
        **({} if measured.coat_share is None else {"coat_share_of_volume": measured.coat_share}),
    }
