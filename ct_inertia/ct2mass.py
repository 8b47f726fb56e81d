"""From a scan, labels or a closed mesh to the mass matrix: everything ``ct2mass`` does but writing.

One way for all: open -> find, or take labels -> measure the grey values -> surfaces -> frames -> mass.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib import import_module
from threading import Thread
from typing import TYPE_CHECKING

import numpy as np

from ct_inertia.bodies import BodySurface, Labelled, MeasuredBody, Moments
from ct_inertia.calibrated import calibrated
from ct_inertia.frames.anatomy import AnatomyHints
from ct_inertia.frames.footplate import FootplateFrame, footplate_frame, pose_near
from ct_inertia.frames.gap import WindowGap, fluid_contrast_at_rim, window_gap
from ct_inertia.frames.plate_frame import MOST_SUNK, PlateFrame, plate_frame
from ct_inertia.inputs import Inputs
from ct_inertia.mass.properties import point_masses
from ct_inertia.mass.sizes import (
    check_mesh,
    check_unit,
    impossible,
    measured_sizes,
    unsuitable,
    unusual_notice,
)
from ct_inertia.mass.ways import MassByWay, assumed_notice, disagreements, masses_by_way, not_stated
from ct_inertia.options import MassOptions
from ct_inertia.results import MassResult
from ct_inertia.surface.contour import contour
from ct_inertia.surface.matched import moment_matched
from ct_inertia.surface.surface import Surface
from stapeskit.arrays import Array, return_memory
from stapeskit.command import no_progress
from stapeskit.faults import Fault, StapeskitError, collect_faults, raise_all
from stapeskit.warnings import Notice, once

if TYPE_CHECKING:
    from ct_inertia.frames.fiducials import PlateFiducials
    from ct_inertia.mass.calibration import Calibration
    from ct_inertia.scan.scan import Scan
    from stapeskit.command import Progress

_PLATE_SHIFT = calibrated("plate_frame.level_shift")

_HEAVY = ("scipy.spatial", "scipy.sparse.linalg", "vtkmodules.vtkFiltersCore")
"""Libraries whose import takes most of a second."""


@dataclass
class _Work:
    """What a run has found so far; a mesh has neither ``scan`` nor ``measured``."""

    options: MassOptions
    hints: AnatomyHints
    fiducials: PlateFiducials | None
    calibration: Calibration | None
    scan: Scan | None = None
    measured: MeasuredBody | None = None
    notices: list[Notice] = field(default_factory=list)


def measure_mass(options: MassOptions, progress: Progress = no_progress) -> MassResult:
    """Find the stapes, its frames and its mass matrix; call ``progress`` as each stage begins.

    Raises
    ------
    StapeskitError
        Anything that is wrong with the options or the files.
    """
    inputs = Inputs(options.inputs)
    try:
        return _measured(options, progress, inputs)
    except Exception:
        inputs.check()  # where a file has changed, that is the cause of whatever failed
        raise
    finally:
        inputs.close()


def check_inputs(options: MassOptions) -> None:
    """Make the cheap checks of the inputs: landmarks, fiducials, calibration, and the header of the scan.

    Raises
    ------
    StapeskitError
        What is wrong with them.
    """
    from ct_inertia.scan.open_scan import open_scan

    faults: list[Fault] = []
    with collect_faults(faults):
        _small_inputs(options)
    if options.file is not None and not options.is_mesh:
        with collect_faults(faults):
            open_scan(options.file, options.spacing_mm, options.mirror, options.nan_as_air, options.raw)
    raise_all(faults)


def _measured(options: MassOptions, progress: Progress, inputs: Inputs) -> MassResult:
    work = _small_inputs(options)
    if options.is_mesh:
        progress("reading the mesh")
        body, moments = _mesh(work)
        surface = body
    else:
        measured = _measured_body(work, progress, inputs)
        progress("finding the frames")
        moments = measured.moments
        surface = contour(measured.surface.field, measured.surface.scan_from_index)
        body = moment_matched(measured.surface.field, moments, measured.surface.scan_from_index)
    footplate = _footplate(work, surface, moments)
    pose = _plate_frame(work, moments)
    gap = None if work.measured is None else _gap(work.measured, footplate, surface)
    progress("computing the mass matrix")
    ways = _ways(work, moments, footplate)
    sizes = measured_sizes(ways[0].body.volume_m3, ways[0].body.density_kg_m3, footplate)
    work.notices += [*footplate.notices, *([] if pose is None else pose.notices)]
    work.notices += [*not_stated(ways[0]), *disagreements(ways), *unusual_notice(sizes)]
    records = inputs.records()
    inputs.check()
    return MassResult(
        options=options,
        matrix=ways[0].matrix,
        footplate=footplate,
        plate_frame=pose,
        stapes=body,
        plate=None if work.measured is None else work.measured.plate,
        moments=moments,
        ways=ways,
        gap=gap,
        scan=work.scan,
        body=work.measured,
        inputs=records,
        notices=once(work.notices),
    )


def _small_inputs(options: MassOptions) -> _Work:
    """Read landmarks, fiducials of the plate and calibration, before the scan."""
    landmarks: dict[str, Array] = {}
    fiducials, calibration = None, None
    if options.landmarks is not None:
        from ct_inertia.frames.landmarks import read_landmarks

        landmarks = read_landmarks(options.landmarks)
    if options.plate_fiducials is not None:
        from ct_inertia.frames.fiducials import read_plate_fiducials

        fiducials = read_plate_fiducials(options.plate_fiducials)
    if options.calibration is not None:
        from ct_inertia.mass.calibration import read_calibration

        calibration = read_calibration(options.calibration)
    anterior = None if options.anterior is None else np.array(options.anterior)
    return _Work(options, AnatomyHints(anterior, landmarks, options.side), fiducials, calibration)


def _mesh(work: _Work) -> tuple[Surface, Moments]:
    """Read a closed mesh of the stapes, which is taken as exact."""
    from ct_inertia.surface.repair import read_mesh

    path = work.options.source
    mesh = read_mesh(path, work.options.close)
    check_mesh(mesh, path.name)
    exact = (
        "The input is a surface: it is taken as exact; the budget holds only density or mass, the frame, and "
        "what closed holes may lack."
    )
    turned = (
        f"Nothing in {path.name} confirms that the slices of its scan were in right-handed order: if not, "
        "the ear is a mirror image. Check a known asymmetry in the report."
    )
    work.notices += [
        *mesh.notices,
        Notice("grey_values_missing", exact),
        Notice("handedness_unconfirmed", turned),
    ]
    return mesh, mesh.moments()


def _measured_body(work: _Work, progress: Progress, inputs: Inputs) -> MeasuredBody:
    """Open the scan, find the stapes or take the labels, and measure it."""
    from ct_inertia.grey.measure import measure
    from ct_inertia.voxels.masks import used_box

    labelled = _labelled(work, progress, inputs)
    used = used_box(labelled.stapes) if labelled.named else None
    if used is not None:
        size_mm = np.array([part.stop - part.start for part in used[::-1]]) * labelled.box.spacing_mm
        check_unit(float(size_mm.max()), "the stapes", work.options.source.name)
    progress("measuring the stapes")
    return_memory()
    work.measured = measure(labelled, work.options.coat)
    return_memory()
    work.notices += work.measured.notices
    return work.measured


def _labelled(work: _Work, progress: Progress, inputs: Inputs) -> Labelled:
    """Return the bodies: by labels, or found in the scan."""
    from ct_inertia.scan.open_scan import open_labels, open_scan

    options = work.options
    progress("reading the scan")
    if options.file is not None:
        work.scan = open_scan(
            options.file, options.spacing_mm, options.mirror, options.nan_as_air, options.raw
        )
        _add_files(inputs, "scan", work.scan)
        work.notices += work.scan.notices
    if options.labels is None:
        from ct_inertia.find.choose import Search
        from ct_inertia.find.find import find_stapes

        assert work.scan is not None  # noqa: S101 - the options ask for a scan or labels
        if options.box_mm is not None:
            work.scan = work.scan.part(work.scan.box_of(options.box_mm))
        seed = None if options.seed_mm is None else np.array(options.seed_mm)
        with _importing_ahead():
            return find_stapes(work.scan, Search(options.threshold, seed), progress)
    from ct_inertia.find.labels import label_stapes

    spacing = options.spacing_mm if work.scan is None else tuple(work.scan.spacing_mm)
    array, grid = open_labels(options.labels, spacing, options.mirror)
    _add_files(inputs, "labels", grid)
    grid = replace(grid, dtype=array.dtype, fetch=lambda box: array[box])  # read once
    with _importing_ahead():
        labelled = label_stapes(grid, work.scan, options.stapes_label, options.plate_label, progress)
    work.scan = work.scan or grid
    return labelled


@contextmanager
def _importing_ahead() -> Iterator[None]:
    """Import what later steps need on another thread; no child may be forked before it has ended."""

    def work() -> None:
        for name in _HEAVY:
            import_module(name)

    thread = Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        thread.join()


def _add_files(inputs: Inputs, role: str, scan: Scan) -> None:
    """Take the files that belong to a scan, other than those in its folder."""
    source = scan.source
    for number, path in enumerate(scan.files[1:], start=2):
        if source is None or source not in (path, *path.parents):
            inputs.add(f"{role} {number}", path)


def _footplate(work: _Work, surface: Surface, moments: Moments) -> FootplateFrame:
    """Find the footplate; a body that cannot be a stapes is refused unless somebody named it."""
    named = work.measured is None or work.measured.labelled.named
    body = None if work.measured is None else _with_cuts(work.measured)
    try:
        footplate = footplate_frame(surface, work.hints, body)
    except StapeskitError:
        # Where the body is wrong, correct landmarks do not fit it: report the body first.
        if not named:
            plain = footplate_frame(surface, None, body)
            reasons = impossible(measured_sizes(moments.volume_m3, 1.0, plain))
            if reasons:
                raise unsuitable(reasons, work.notices) from None
        raise
    reasons = impossible(measured_sizes(moments.volume_m3, 1.0, footplate))
    if reasons and not named:
        raise unsuitable(reasons, work.notices)
    if body is not None and body.one_sd is not None:
        other = contour(body.one_sd, body.scan_from_index)
        footplate = footplate.with_other_surface(pose_near(other, footplate, body))
    return footplate


def _with_cuts(measured: MeasuredBody) -> BodySurface:
    """Return the surface of the stapes, and where the border of the scan cuts it."""
    from ct_inertia.grey.border import border_contacts

    contacts = border_contacts(measured.labelled.stapes, measured.labelled.box)
    return replace(measured.surface, cuts=tuple((one.centre_mm, one.area_mm2) for one in contacts))


def _plate_frame(work: _Work, moments: Moments) -> PlateFrame | None:
    """Return the plate frame by fiducials, else by the faces of the plate; None, with a warning, without."""
    if work.fiducials is not None:
        from ct_inertia.frames.fiducials import plate_frame_from_fiducials

        return plate_frame_from_fiducials(work.fiducials, moments.centroid_mm)
    if work.measured is None:
        return None
    labelled, plate = work.measured.labelled, work.measured.plate
    region, text = labelled.plate_region, "No plate was found beside the stapes"
    if plate is not None and region is not None:
        cell = float(np.linalg.norm(region.scan_from_index[:3, 0]))
        pose = plate_frame(work.measured.plate_faces, moments.centroid_mm, _PLATE_SHIFT * cell)
        sunk = 0.0
        if pose is not None and not region.named:
            sunk = pose.share_behind(labelled.box.scan_points(np.argwhere(labelled.stapes)[:, ::-1]))
        if pose is not None and sunk <= MOST_SUNK:
            if region.one_of_several:
                several = (
                    "The scan holds several bodies of plastic; the one nearest to the stapes was taken for "
                    "the plate. If it is another one, label it (--labels) or give --plate-fiducials."
                )
                work.notices.append(Notice("plate_uncertain", several))
            return pose
        text = "The plastic beside the stapes has no plane face with plane sides towards it (a tube has none)"
        if sunk > MOST_SUNK:
            text = f"What is as bright as plastic covers {100.0 * sunk:.0f} % of the stapes, as a fluid does"
        if not region.named:
            text += ", and counts as no plate"
            work.measured = replace(work.measured, plate=None)
    text += (
        ": there is no plate frame, and no mass matrix in its axes. If the scan holds a plate, give "
        "--plate-fiducials, or label it (--labels)."
    )
    work.notices.append(Notice("plate_not_found", text))
    return None


def _gap(measured: MeasuredBody, footplate: FootplateFrame, surface: Surface) -> WindowGap | None:
    if measured.wall is None or not np.any(measured.wall.field > 0.0):
        return None

    wall = contour(measured.wall.field, measured.wall.scan_from_index, largest=False)
    bodies = (measured.surface, measured.wall)
    return window_gap(footplate, surface, wall, bodies, fluid_contrast_at_rim(measured, footplate))


def _ways(work: _Work, moments: Moments, footplate: FootplateFrame) -> tuple[MassByWay, ...]:
    """Return the mass by every way given, with what was glued on, the leading one first."""
    options = work.options
    found = masses_by_way(moments, options.density_kg_m3, options.mass_mg, work.calibration, work.measured)
    if options.density_kg_m3 is None and "density" in found:
        work.notices.insert(0, assumed_notice())
    added = point_masses(options.add_mass)
    pose = footplate.scan_from_footplate, footplate.covariance
    bodies = {way: bare.with_added(added) for way, bare in found.items()}
    return tuple(
        MassByWay(way, body, body.mass_matrix(*pose, options.voxel_size_sd)) for way, body in bodies.items()
    )
