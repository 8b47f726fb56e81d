"""Find the stapes in a scan: from the first look to masks on a box that is fine enough to measure on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import OTHER_BONE, PLATE, STAPES, Box, Cells, Labelled, PlateRegion
from ct_inertia.find.box import ALONE_MM, IN_SITU_MM, block_for, read_box
from ct_inertia.find.choose import Candidate, Search, choose
from ct_inertia.find.overview import Overview, look_at, noise_of, scan_notices, smooth_noise
from ct_inertia.find.plate import find_plate, plate_mask
from ct_inertia.find.refuse import check_background
from ct_inertia.scan.scan import Scan
from ct_inertia.voxels.fields import Grey
from ct_inertia.voxels.flood import flood
from ct_inertia.voxels.masks import Mask, eroded
from stapeskit.warnings import Notice

_DUST_VOXELS = 6  # of other bone that is left out
_MOST_BOX = 24_000_000  # voxels of a box in situ; beyond, its blocks are as large as those of a stapes alone


def find_stapes(
    scan: Scan, search: Search | None = None, progress: Callable[[str], Any] | None = None
) -> Labelled:
    """Find the stapes, other bone and the plate in a scan.

    Raises
    ------
    StapeskitError
        No body that can be a stapes, or several; options that do not fit the scan.
    """
    search = search or Search()
    tell = progress or (lambda _: None)
    tell("looking at the scan")
    overview = look_at(scan)
    tell("finding the stapes")
    chosen, notices = choose(scan, overview, search)
    tell("cutting the stapes out")
    labelled = _label(scan, overview, chosen)
    named = search.seed_mm is not None
    return replace(labelled, named=named, notices=(*scan_notices(overview), *labelled.notices, *notices))


def _label(scan: Scan, overview: Overview, chosen: Candidate) -> Labelled:
    reading, split = chosen.reading, chosen.split
    view = _view(scan, overview, chosen)
    box = view.box
    own = _in_first_look(overview, chosen)
    if not overview.is_mask:
        check_background(box, view.own, view.bone, reading.air, reading.bone)
    region = None if overview.is_mask else find_plate(scan, overview, reading, own)
    plate = np.zeros(box.shape, dtype=bool)
    if region is not None:
        plate = plate_mask(region, box, view.quiet, view.bone)
        region = None if region.immersing else region
    return Labelled(
        box=replace(box, grey=view.own.astype(np.float32), is_mask=True) if overview.is_mask else box,
        stapes=view.own,
        other=view.rest,
        plate=plate,
        cells=_cells(overview, chosen, own, region),
        plate_region=region,
        air=reading.air,
        bone=reading.bone,
        plastic=reading.plastic,
        noise=view.noise,
        separation=view.method if split is None else str(split),
        at_neck=split is not None and split.neck is not None,
        notices=_cropped_notice(chosen),
    )


@dataclass(frozen=True, eq=False)
class _View:
    """Bone on the grid of a box: the stapes, the rest, how they were separated."""

    box: Box
    quiet: Grey
    bone: Mask
    own: Mask
    rest: Mask
    noise: float
    method: str


def _view(scan: Scan, overview: Overview, chosen: Candidate) -> _View:
    """Read the box of the stapes; on finer blocks where other bone touches it."""
    low, high = chosen.body.voxels
    size_mm = (high - low) * scan.spacing_mm + 0.5
    fine = max(IN_SITU_MM, float(np.prod(size_mm) / _MOST_BOX) ** (1.0 / 3.0))
    coarse = float(scan.spacing_mm.min()) if overview.is_mask else ALONE_MM
    split = chosen.split is not None
    view = _mark(read_box(scan, low, high, fine if split else coarse, overview), overview, chosen)
    finer = np.any(block_for(scan.spacing_mm, fine) < view.box.block)
    if view.method == _BY_FLOOD and finer and not split and not overview.is_mask:
        view = _mark(read_box(scan, low, high, fine, overview), overview, chosen)
    return view


_BY_FLOOD = "flooded by grey value from the cores of the pieces"


def _mark(box: Box, overview: Overview, chosen: Candidate) -> _View:
    """Tell the stapes from other bone in a box: by pieces; where they touch, by a flood from their cores."""
    import cc3d

    reading = chosen.reading
    noise = overview.noise if np.all(box.block == 1) else noise_of(box.grey)
    quiet = smooth_noise(box.grey, noise / reading.contrast)
    bone = quiet > np.float32(reading.between)
    if box.measured is not None:
        bone &= box.measured
    own_cores, other_cores = _cores(box, overview, chosen)
    labels = cc3d.connected_components(bone, connectivity=6)
    sizes = np.bincount(labels.ravel())
    votes = np.bincount(labels[own_cores & bone], minlength=len(sizes))
    votes[0] = 0
    body = int(np.argmax(votes))
    own = labels == body
    if np.any(own & other_cores):
        markers = (bone & own_cores).astype(np.int32) + 2 * (bone & other_cores & ~own_cores).astype(np.int32)
        own = flood(-quiet, markers, bone, smoothing=0.7) == 1
        return _View(box, quiet, bone, own, bone & ~own, noise, _BY_FLOOD)
    kept = sizes >= _DUST_VOXELS
    kept[[0, body]] = False
    return _View(box, quiet, bone, own, kept[labels], noise, "connected component")


def _cores(box: Box, overview: Overview, chosen: Candidate) -> tuple[Mask, Mask]:
    """Return blocks that surely belong to the stapes, and to other bone."""
    whole, split = chosen.whole, chosen.split
    if split is None:
        cells = whole.labels == whole.label
        thinner = eroded(cells)
        own = box.taken(thinner if thinner.any() else cells, overview.grid)
        known = np.isin(whole.labels, [piece.label for piece in chosen.others])
        return own, box.taken(eroded(known), overview.grid)
    coarse = box.taken(whole.labels, overview.grid)
    labels = box.taken(np.where(split.sure, split.labels, 0), split.grid)
    own = labels == chosen.body.label
    return own, ((labels > 0) & ~own) | ((coarse > 0) & (coarse != whole.label))


def _in_first_look(overview: Overview, chosen: Candidate) -> Mask:
    """Return the stapes in coarse voxels."""
    whole, split = chosen.whole, chosen.split
    own = whole.labels == whole.label
    if split is None:
        return own
    return np.asarray(own & overview.grid.taken(split.labels == chosen.body.label, split.grid))


def _cells(overview: Overview, chosen: Candidate, own: Mask, region: PlateRegion | None) -> Cells:
    """Return the labels of the whole scan on the grid of the first look."""
    labels: NDArray[np.uint8] = np.where(chosen.whole.labels > 0, np.uint8(OTHER_BONE), np.uint8(0))
    labels[own] = STAPES
    if region is not None:
        labels[overview.grid.taken(region.mask, region.grid) & (labels == 0)] = PLATE
    return Cells(labels, overview.grid)


def _cropped_notice(chosen: Candidate) -> tuple[Notice, ...]:
    if chosen.split is None or not chosen.split.cropped:
        return ()
    text = (
        "Another bone that the border of the scan crops, most likely the tip of the incus, joins the "
        "stapes and was cut off it at the narrowest section between them. Too little of it is in the scan "
        "to see where it ends as well as elsewhere; the budget holds the cut (separation). Export 1 mm "
        "more beyond the head, or correct the cut (--labels)."
    )
    return (Notice("cut_through_bone", text),)
