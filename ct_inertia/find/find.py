"""Find the stapes in a scan: from the first look to masks on a box that is fine enough to measure on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import OTHER_BONE, PLATE, STAPES, Box, Cells, Labelled, Mask, PlateRegion, Separation
from ct_inertia.find.box import ALONE_MM, IN_SITU_MM, block_for, from_coarse, read_box
from ct_inertia.find.choose import Candidate, choose
from ct_inertia.find.distance import used_box
from ct_inertia.find.overview import Overview, look_at, noise_of, scan_notices, smooth_noise
from ct_inertia.find.pieces import describe
from ct_inertia.find.plate import find_plate, plate_mask
from ct_inertia.scan.scan import Scan
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

_DUST_VOXELS = 6  # of other bone that is left out
_MOST_BOX = 24_000_000  # voxels of a box in situ; beyond, its blocks are as large as those of a stapes alone


@dataclass(frozen=True)
class Search:
    """What a user can say about where the stapes is.

    Attributes
    ----------
    threshold : float or None
        Grey value between air and bone (--threshold).
    seed_mm : ndarray, (3,), or None
        A point inside the stapes, scan coordinates (--seed).
    box_mm : ndarray, (6,), or None
        Two corners of the part of the scan to look at: x0, y0, z0, x1, y1, z1 (--box).
    """

    threshold: float | None = None
    seed_mm: Array | None = None
    box_mm: Array | None = None


def find_stapes(
    scan: Scan, search: Search | None = None, progress: Callable[[str], Any] | None = None
) -> Labelled:
    """Find the stapes, other bone and the plate in a scan.

    Parameters
    ----------
    scan : Scan
    search : Search, optional
    progress : callable, optional
        Called with a few words at the beginning of each stage.

    Raises
    ------
    StapeskitError
        No body that can be a stapes, or several; options that do not fit the scan.
    """
    search = search or Search()
    tell = progress or (lambda _: None)
    if search.box_mm is not None:
        scan = scan.part(scan.box_of(search.box_mm))
    tell("looking at the scan")
    overview = look_at(scan)
    tell("finding the stapes")
    chosen, notices = choose(scan, overview, search.threshold, search.seed_mm)
    tell("cutting the stapes out")
    labelled = _label(scan, overview, chosen)
    named = search.seed_mm is not None
    return replace(labelled, named=named, notices=(*scan_notices(overview), *labelled.notices, *notices))


def _label(scan: Scan, overview: Overview, chosen: Candidate) -> Labelled:
    reading = chosen.reading
    view = _view(scan, overview, chosen)
    own = _coarse_own(overview, chosen)
    where = used_box(own) or (slice(0, 1),) * 3
    piece = describe(own.astype(np.int32), 1, where, overview.spacing_mm)
    region = None
    if not overview.is_mask:
        levels = (reading.air, reading.plastic, reading.bone)
        region = find_plate(scan, overview, levels, reading.between, (own, piece))
    box = view.box
    plate = np.zeros(box.shape, dtype=bool)
    if region is not None:
        plate = plate_mask(region, box, view.quiet, view.bone)
    if region is not None and region.immersing:
        region = None
    if overview.is_mask:
        box = replace(box, grey=view.own.astype(np.float32), is_mask=True)
    return Labelled(
        box=box,
        stapes=view.own,
        other=view.rest,
        plate=plate,
        cells=_cells(overview, chosen, own, region),
        plate_region=region,
        air=reading.air,
        bone=reading.bone,
        plastic=reading.plastic,
        noise=view.noise,
        separation=Separation(view.method) if chosen.split is None else chosen.split.separation(),
        unmeasured_share=overview.unmeasured_share,
        evidence=_evidence(overview, chosen),
        notices=_separation_notices(chosen),
    )


@dataclass(frozen=True)
class _View:
    """Bone on the grid of a box: the stapes, the rest, how they were separated."""

    box: Box
    quiet: NDArray[np.float32]
    bone: Mask
    own: Mask
    rest: Mask
    noise: float
    method: str


def _view(scan: Scan, overview: Overview, chosen: Candidate) -> _View:
    """Read the box of the stapes; on finer blocks where other bone touches it."""
    body, split = chosen.body, chosen.split
    if split is None:
        low, high = body.low * overview.step, body.high * overview.step
    else:
        low = split.grid.first + body.low * split.grid.block
        high = split.grid.first + body.high * split.grid.block
    size_mm = (high - low) * scan.spacing_mm + 0.5
    fine = max(IN_SITU_MM, float(np.prod(size_mm) / _MOST_BOX) ** (1.0 / 3.0))
    coarse = float(scan.spacing_mm.min()) if overview.is_mask else ALONE_MM
    view = _mark(read_box(scan, low, high, fine if split is not None else coarse, overview), overview, chosen)
    smaller = np.any(block_for(scan.spacing_mm, fine) < view.box.block)
    if split is None and view.method != "connected component" and smaller and not overview.is_mask:
        view = _mark(read_box(scan, low, high, fine, overview), overview, chosen)
    return view


def _mark(box: Box, overview: Overview, chosen: Candidate) -> _View:
    """Tell the stapes from other bone in a box: by pieces; where they touch, by a flood from their cores."""
    import cc3d

    from ct_inertia.grey.start import flood

    reading = chosen.reading
    noise = overview.noise if np.all(box.block == 1) else noise_of(box.grey)
    quiet = smooth_noise(box.grey, noise / (reading.bone - reading.air))
    bone = quiet > np.float32(reading.between)
    if box.measured is not None:
        bone &= box.measured
    labels = cc3d.connected_components(bone, connectivity=6)
    own_cores, other_cores = _cores(box, overview, chosen)
    votes = np.bincount(labels[own_cores & bone], minlength=int(labels.max()) + 1)
    votes[0] = 0
    own = labels == int(np.argmax(votes))
    sizes = np.bincount(labels.ravel())
    kept = sizes >= _DUST_VOXELS
    kept[[0, int(np.argmax(votes))]] = False
    rest = kept[labels]
    method = "connected component"
    if np.any(own & other_cores):
        markers = (bone & own_cores).astype(np.int32) + 2 * (bone & other_cores & ~own_cores).astype(np.int32)
        flooded = flood(quiet, markers, bone)
        own, rest = flooded == 1, (flooded != 1) & bone
        method = "flooded by grey value from the cores of the pieces"
    return _View(box, quiet, bone, own, rest, noise, method)


def _cores(box: Box, overview: Overview, chosen: Candidate) -> tuple[Mask, Mask]:
    """Return blocks that surely belong to the stapes, and to other bone."""
    from ct_inertia.grey.start import eroded

    if chosen.split is not None:
        split = chosen.split
        first = split.grid.first + split.grid.block // 2
        labels = from_coarse(box, np.where(split.sure, split.labels, 0), first, split.grid.block)
        inside = _within(box, split.grid)
        own = inside & (labels == chosen.body.label)
        coarse = from_coarse(box, chosen.pieces, overview.step // 2, overview.step)
        other = (inside & (labels > 0) & (labels != chosen.body.label)) | (
            (coarse > 0) & (coarse != chosen.whole.label)
        )
        return own, other
    part = chosen.pieces
    own_cells = part == chosen.whole.label
    thinner = eroded(own_cells)
    first, step = overview.step // 2, overview.step
    own = from_coarse(box, thinner if thinner.any() else own_cells, first, step)
    known = np.zeros(int(part.max()) + 1, dtype=bool)
    known[[piece.label for piece in chosen.others]] = True
    return own, from_coarse(box, eroded(known[part]), first, step)


def _within(box: Box, grid: Box) -> Mask:
    """Return which blocks of a box lie within another grid."""
    places = []
    for axis in range(3):
        k = 2 - axis
        centre = box.first[k] + (box.block[k] - 1) / 2.0 + np.arange(box.shape[axis]) * box.block[k]
        end = grid.first[k] + grid.block[k] * grid.shape[axis]
        places.append((centre >= grid.first[k] - 0.5) & (centre <= end - 0.5))
    z, y, x = places
    return np.asarray(z[:, None, None] & y[:, None] & x)


def _coarse_own(overview: Overview, chosen: Candidate) -> Mask:
    """Return the stapes in coarse voxels."""
    own = chosen.pieces == chosen.whole.label
    split = chosen.split
    if split is None:
        return own
    index = np.argwhere(own)
    voxel = index[:, ::-1] * overview.step + overview.step // 2
    fine = split.grid.blocks_of(voxel)
    fine = np.clip(fine, 0, np.array(split.grid.shape[::-1]) - 1)
    kept = split.labels[fine[:, 2], fine[:, 1], fine[:, 0]] == chosen.body.label
    result = np.zeros_like(own)
    result[tuple(index[kept].T)] = True
    return result


def _cells(overview: Overview, chosen: Candidate, own: Mask, region: PlateRegion | None) -> Cells:
    """Return the labels of the whole scan on the coarse grid."""
    labels = np.where(chosen.pieces > 0, np.uint8(OTHER_BONE), np.uint8(0))
    labels[own] = STAPES
    if region is not None:
        thin = region.step // overview.step
        index = np.argwhere(region.mask)[:, ::-1] * region.step + region.first - region.step // 2
        cells = index // overview.step
        size = np.array(labels.shape[::-1])
        for shift in np.ndindex(*(int(n) for n in thin)):
            some = cells + np.array(shift)
            x, y, z = some[np.all((some >= 0) & (some < size), axis=1)].T
            free = labels[z, y, x] == 0
            labels[z[free], y[free], x[free]] = PLATE
    return Cells(labels, np.zeros(3, dtype=np.int64), overview.step)


def _separation_notices(chosen: Candidate) -> tuple[Notice, ...]:
    if chosen.split is None or not chosen.split.at_border:
        return ()
    text = (
        "Another bone that the border of the scan crops, most likely the tip of the incus, joins the "
        "stapes and was cut off it at the narrowest section between them. Too little of it is in the scan "
        "to see where it ends as well as elsewhere; the budget holds the cut (separation). Export 1 mm "
        "more beyond the head, or correct the cut (--labels)."
    )
    return (Notice("incus_cropped", text),)


def _evidence(overview: Overview, chosen: Candidate) -> dict[str, Any]:
    reading = chosen.reading
    return {
        "stapes": chosen.body.as_json(),
        "other_bone": [piece.as_json() for piece in chosen.others[:5]],
        "coarse_spacing_mm": [float(v) for v in overview.spacing_mm],
        "material_levels": [float(v) for v in overview.levels],
        "bone_above": float(reading.between),
    }
