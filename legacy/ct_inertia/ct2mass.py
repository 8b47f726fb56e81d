"""From a scan, a label volume or a closed mesh to the mass matrix: everything `ct2mass` does but writing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from legacy.ct_inertia.auxiliary_inputs import read_small_inputs
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.mass_measurement import MassMeasurement
from legacy.ct_inertia.options import MassOptions
from legacy.ct_inertia.readers.memory_mapping import lost_pages
from legacy.stapeskit.background import Later
from legacy.stapeskit.input_changes import InputStates
from legacy.stapeskit.progress import Tell, silent
from legacy.stapeskit.warnings import Notice

if TYPE_CHECKING:
    from legacy.ct_inertia.bodies import Bodies

# Imported while the stapes is sought, not when it is waited for.
_NEEDED_LATER = (
    "legacy.ct_inertia.frames.plane_faces",
    "numpy.ma",
    "numpy.random",
    "legacy.ct_inertia.frames.plate_frame",
    "legacy.ct_inertia.frames_and_mass",
    "legacy.ct_inertia.frames.window_gap",
    "legacy.ct_inertia.exports.write_result",
)

__all__ = ["MassMeasurement", "MassOptions", "ct2mass"]


def ct2mass(
    options: MassOptions, progress: Tell = silent, found: Callable[[Bodies], None] | None = None
) -> MassMeasurement:
    """Find the stapes, its frames and its mass matrix.

    Parameters
    ----------
    options : MassOptions
    progress : callable
        Called with a few words at the beginning of each stage.
    found : callable, optional
        Called with the bodies in a scan before their frames are sought: for outputs that need no frames.

    Raises
    ------
    CtInertiaError, KinematicsError
        Anything that is wrong with the options or the files, in one sentence.
    """
    inputs = InputStates.of(options.inputs.values())
    lost = lost_pages()
    try:
        result = _measure(options, progress, found)
    except Exception:
        # Where a file has changed, that is the cause of whatever failed.
        _check_inputs(inputs, lost)
        raise
    _check_inputs(inputs, lost)
    return replace(result, inputs=inputs)


def _check_inputs(inputs: InputStates, lost: int) -> None:
    inputs.check(CtInertiaError)
    if lost_pages() != lost:
        raise CtInertiaError.of(
            "the scan", "readable to its end", "a part that its disk did not give", "", "Copy it anew"
        )


def _measure(options: MassOptions, progress: Tell, found: Callable[[Bodies], None] | None) -> MassMeasurement:
    known = read_small_inputs(options)
    progress("reading and finding the stapes")
    if options.is_mesh:
        from legacy.ct_inertia.frames_and_mass import mass_of_bodies
        from legacy.ct_inertia.mass.plausibility import check_mesh
        from legacy.ct_inertia.surface.surface import read_surface

        surface = read_surface(Path(str(options.scan)))
        check_mesh(surface, Path(str(options.scan)).name)
        exact = Notice(
            "surface_taken_as_exact",
            "The input is a surface: it is taken as exact, and the budget holds density or mass and the "
            "frame only.",
        )
        turned = Notice(
            "handedness_unconfirmed",
            f"Nothing in {Path(str(options.scan)).name} confirms that the slices of its scan were in "
            "right-handed order: if not, the ear is a mirror image. Check a known asymmetry in the report.",
        )
        notices = (*surface.notices, exact, turned)
        return mass_of_bodies(options, known, None, surface, surface, None, notices)
    bodies = _bodies(options, progress)
    progress("finding the frames")
    if found is not None:
        found(bodies)
    _ = bodies.labels.packed  # is packed in the background
    from legacy.ct_inertia.frames_and_mass import mass_of_bodies

    surfaces = (bodies.stapes, bodies.frame_surface, bodies.plate)
    return mass_of_bodies(options, known, bodies, *surfaces, bodies.notices)


def _bodies(options: MassOptions, progress: Tell) -> Bodies:
    from legacy.ct_inertia.read_scan import read_labels, read_volume

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
            from legacy.ct_inertia.volume.coarse_view import coarse_overview

            glance = Later(coarse_overview, volume)
    from legacy.ct_inertia.grey.soft_coat import stated_coat
    from legacy.ct_inertia.labelling.from_scan import find_bodies
    from legacy.ct_inertia.segment.coarse_segmentation import SearchOptions

    labels = None
    if options.labels is not None:
        if not Path(options.labels).exists():
            raise CtInertiaError.of(
                "{labels}", "an existing label volume", options.labels, next_step="Check the path"
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
    imports = Later(_import, _NEEDED_LATER)
    bodies = find_bodies(volume, search, progress, glance, coat)
    imports.result()
    return bodies


def _import(names: Sequence[str]) -> None:
    for name in names:
        import_module(name)
