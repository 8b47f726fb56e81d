"""Labels made elsewhere: which voxels are stapes and plate, with the scan or alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import OTHER_BONE, PLATE, STAPES, Box, Cells, Labelled, PlateRegion
from ct_inertia.find.box import read_box
from ct_inertia.find.label_volume import LEAST_VOXELS, read_labels
from ct_inertia.find.levels import readings
from ct_inertia.find.overview import Overview, look_at, noise_of, scan_notices
from ct_inertia.find.plate import drawn_plate, find_plate, plate_mask
from ct_inertia.find.refuse import check_background
from ct_inertia.scan.scan import Scan
from ct_inertia.voxels.distance import capped_distance
from ct_inertia.voxels.flood import flood
from ct_inertia.voxels.grid import Grid
from ct_inertia.voxels.masks import Mask, grown, used_box, widened
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

_SAME_GRID = 0.05  # voxels between grids that are one: rounding of origins, not half a voxel of conventions
_DRAWN_VOXELS = 3.0  # how far off the surface a label may be drawn
_ON_BONE = 0.85  # of a drawn body that is bone, or of the bone there that it holds: one of the two is more
_BESIDE_VOXELS, _MORE_BONE = 2, 0.1  # a shift, and the share of bone that it gains, which no drawing has
_PLACES = 20_000  # voxels of a label that are looked at: shares are known to 0.3 %
_MARGIN_VOXELS = 8  # around labels alone: room to smooth their surface
_CUT = 0.8  # of the layer before: a flat end is as wide as what it cuts
_SINGLE = np.ones(3, dtype=np.int64)

Drawn = NDArray[np.uint8]
"""Labels as drawn, by the numbers of the results."""


def label_stapes(
    labels: Scan,
    scan: Scan | None = None,
    stapes_label: int | None = None,
    plate_label: int | None = None,
    progress: Callable[[str], Any] | None = None,
) -> Labelled:
    """Take the bodies from a label volume; their surfaces from the grey values where there is a scan.

    Parameters
    ----------
    scan : Scan, optional
        The grey values that they were drawn on: the same grid, or a larger one.
    stapes_label, plate_label : int, optional
        Numbers of the bodies; None: by the names of the segments, else 1 and 2.

    Raises
    ------
    StapeskitError
        No voxel of the stapes' number, values that are no labels, islands, or labels whose grid is not a part
        of the scan's.
    """
    tell = progress or (lambda _: None)
    tell("reading the labels")
    drawn, notices = read_labels(labels, stapes_label, plate_label)
    if scan is None:
        return _alone(drawn, labels, notices)
    tell("laying the labels on the scan")
    grid = _grid_in(scan, labels)
    overview = look_at(scan)
    notices = [*scan_notices(overview), *notices]
    return (
        _alone(drawn, labels, notices) if overview.is_mask else _on_scan(drawn, grid, scan, overview, notices)
    )


def _alone(drawn: Drawn, scan: Scan, notices: list[Notice]) -> Labelled:
    """Return the solid that the labelled voxels fill."""
    every = Grid.of(scan, drawn.shape, np.zeros(3, dtype=np.int64), _SINGLE)
    part = widened(used_box(drawn == STAPES), _MARGIN_VOXELS)
    labels = drawn[part]
    stapes = labels == STAPES
    # A crop that only touches the body does not count as a border.
    ends = {name: _cut_flat(drawn == STAPES, end) for name, end in (("begins", 0), ("ends", -1))}
    text = (
        "The bodies come from labels alone: without grey values their surfaces are known to the voxel "
        "only, and a threshold's bias of some percent in volume stays unseen. Give the scan together with "
        "--labels."
    )
    return Labelled(
        box=Box(**{**vars(every.part(part)), **ends}, grey=stapes.astype(np.float32), is_mask=True),
        stapes=stapes,
        other=labels == OTHER_BONE,
        plate=labels == PLATE,
        cells=_cells(drawn, every),
        plate_region=drawn_plate(drawn == PLATE, every),
        air=0.0,
        bone=1.0,
        plastic=None,
        noise=0.0,
        separation="labels alone",
        named=True,
        notices=(*notices, Notice("file_read", text)),
    )


def _cut_flat(stapes: Mask, end: int) -> Mask:
    """Return along which of x, y, z a body ends flat in the first (0) or last (-1) layer of the labels."""
    inner = 1 if end == 0 else -2
    layers = [[np.count_nonzero(np.take(stapes, k, axis=axis)) for k in (end, inner)] for axis in (2, 1, 0)]
    return np.array([outer > max(LEAST_VOXELS, _CUT * before) for outer, before in layers])


def _on_scan(drawn: Drawn, grid: Grid, scan: Scan, overview: Overview, notices: list[Notice]) -> Labelled:
    """Lay labels on a scan: bodies by the labels, surfaces by the grey values."""
    used = used_box(drawn == STAPES) or (slice(0, 1),) * 3
    low, high = (grid.first + [getattr(part, end) for part in used[::-1]] for end in ("start", "stop"))
    box = read_box(scan, low, high, float(scan.spacing_mm.min()), overview)
    local = box.taken(drawn, grid)
    air, bone = _levels(box, local)
    middle = 0.5 * (air + bone)
    _check_place(box, local, box.grey > np.float32(middle))
    plastic_mask = local == PLATE
    plastic = float(np.median(box.grey[plastic_mask])) if plastic_mask.any() else None
    region = drawn_plate(drawn == PLATE, grid)
    found = _plate_in(scan, overview, overview.grid.taken(drawn == STAPES, grid)) if region is None else None
    if found is not None:
        region, plastic = found, found.plastic
        plastic_mask = plate_mask(region, box, box.grey, box.grey > np.float32(middle)) & (local == 0)
        region = None if region.immersing else region
    stapes, other = _by_grey_values(box, local, plastic_mask, middle)
    check_background(box, stapes, stapes | other | plastic_mask, air, bone)
    air, bone = _levels(box, _bodies(stapes, other, local))
    return Labelled(
        box=box,
        stapes=stapes,
        other=other,
        plate=plastic_mask & ~stapes & ~other,
        cells=_cells(drawn, grid),
        plate_region=region,
        air=air,
        bone=bone,
        plastic=plastic,
        noise=noise_of(box.grey),
        separation="labels made elsewhere",
        named=True,
        notices=(*notices, *_cut_by_labels(box, local, grid, middle)),
    )


def _grid_in(scan: Scan, labels: Scan) -> Grid:
    """Return the grid of labels in the scan that they were drawn on."""
    spacing = float(np.max(np.abs(labels.spacing_mm / scan.spacing_mm - 1.0)))
    turned = float(np.max(np.abs(labels.direction - scan.direction)))
    place = scan.index_points(labels.origin_mm)
    first = np.rint(place).astype(np.int64)
    inside = np.all(first >= 0) and np.all(first + labels.size <= scan.size)
    if not (spacing < 1e-3 and turned < 1e-3 and np.max(np.abs(place - first)) < _SAME_GRID and inside):
        if not np.array_equal(labels.size, scan.size) or labels.handedness_confirmed:
            raise StapeskitError.of(
                "the label volume",
                f"on the voxels of the scan ({_in_words(scan)})",
                _in_words(labels) + (" and other axes" if turned >= 1e-3 else ""),
                labels.name,
                "Resample it onto the scan, or give --labels alone",
            )
        first = np.zeros(3, dtype=np.int64)  # of the same size, and its format knows no place
    return Grid.of(scan, labels.shape, first, _SINGLE)


def _in_words(scan: Scan) -> str:
    size = " x ".join(map(str, scan.size))
    spacing = " x ".join(f"{v:.6g}" for v in scan.spacing_mm)
    return f"{size} voxels of {spacing} mm from {', '.join(f'{v:.6g}' for v in scan.origin_mm)}"


def _check_place(box: Box, local: Drawn, bright: Mask) -> None:
    """Refuse labels that lie beside their bone, as those of a crop that has lost its place do.

    Labels drawn too large or too small hold all of the bone, or nothing else; where neither is true the shift
    is looked for at which they hold most bone, step by step: of the piece that they hold most of, since a
    wall beside the stapes would draw them.
    """
    from scipy.ndimage import label

    stapes = local == STAPES
    pieces, _ = label(bright)
    bright = pieces == 1 + np.argmax(np.bincount(pieces[stapes])[1:]) if np.any(pieces[stapes]) else bright
    held = np.count_nonzero(stapes & bright)
    around = stapes
    for _ in range(int(_DRAWN_VOXELS)):
        around = grown(around)
    near = np.count_nonzero(around & bright & ((local == 0) | stapes))
    if held > _ON_BONE * min(np.count_nonzero(stapes), near):
        return
    places = np.argwhere(stapes)
    places = places[:: max(1, len(places) // _PLACES)]

    def share(shift: NDArray[np.int64]) -> float:
        moved = places + shift
        inside = np.all((moved >= 0) & (moved < bright.shape), axis=1)
        return float(np.count_nonzero(bright[tuple(moved[inside].T)])) / len(places)

    shift = np.zeros(3, dtype=np.int64)
    sides = np.vstack([np.eye(3, dtype=np.int64), -np.eye(3, dtype=np.int64)])
    for step in (8, 4, 2, 1):
        while share(best := max((shift + step * side for side in sides), key=share)) > share(shift):
            shift = best
    here, there = share(np.zeros(3, dtype=np.int64)), share(shift)
    if np.abs(shift).max() >= _BESIDE_VOXELS and there > here + _MORE_BONE:
        got = f"{100.0 * here:.0f} % of its voxels on bone"
        if there > _ON_BONE:  # else the bone is too far to tell the way
            way = ", ".join(f"{value:+.3g}" for value in shift[::-1] * box.spacing_mm)
            got += f"; moved by {way} mm along x, y, z of the grid it would be {100.0 * there:.0f} %"
        advice = "Save the labels with their origin, on the grid of the scan"
        thing = "the stapes of the label volume"
        raise StapeskitError.of(thing, "on the bone of the scan", got, next_step=advice)


def _levels(box: Box, local: Drawn) -> tuple[float, float]:
    """Return first levels: air away from every label, bone deep inside the stapes."""
    step = float(box.spacing_mm.max())
    far = capped_distance(local != 0, box.spacing_mm, 6.0 * step) > np.float32(5.0 * step)
    depth = capped_distance(local != STAPES, box.spacing_mm, 6.0 * step)
    outside = box.grey[far] if far.any() else box.grey.ravel()
    low, air = np.percentile(outside, (5.0, 30.0))
    bone = float(np.median(box.grey[depth >= np.float32(0.9 * float(depth.max()))]))
    if not bone - air > 4.0 * (air - low):
        raise StapeskitError.of(
            "the stapes of the label volume",
            "brighter than the air around it",
            f"grey values about {bone:.6g} inside and {air:.6g} outside",
            next_step="Check that the labels belong to this scan and lie on it",
        )
    return float(air), bone


def _by_grey_values(box: Box, local: Drawn, plastic: Mask, middle: float) -> tuple[Mask, Mask]:
    """Let the grey values place the surfaces where a label was drawn a voxel or two off them.

    Bone beside the drawn stapes that has no label means the same as bone labelled other: it is not the
    stapes. Excepted is what the flood of grey values gives to the body that reaches it first: a layer between
    the label and the air of up to three voxels, and a gap in the stapes no wider than twice that.
    """
    bone = (box.grey > np.float32(middle)) & ~plastic
    drawn = local == STAPES
    step = float(box.spacing_mm.max())
    near = capped_distance(drawn, box.spacing_mm, (_DRAWN_VOXELS + 1.0) * step) <= _DRAWN_VOXELS * step
    other = bone & ~drawn & (~near | (local == OTHER_BONE))
    other |= _goes_on(box, drawn, bone, bone & ~drawn & ~other, other)
    markers = (drawn & bone).astype(np.int32) + 2 * other.astype(np.int32)
    parts = flood(-box.grey, markers, bone, smoothing=0.7)
    return parts == 1, parts == 2


def _goes_on(box: Box, drawn: Mask, bone: Mask, beside: Mask, other: Mask) -> Mask:
    """Return the voxels next to the labelled stapes that belong to bone reaching on to other bone.

    From the nearest drawn voxel through the voxel and on to four voxels away there is bone, and none of the
    drawn stapes; and such voxels lead to other bone, which a rough surface seen along itself does not.
    """
    from scipy.ndimage import binary_erosion, binary_propagation
    from scipy.spatial import cKDTree

    result = np.zeros_like(beside)
    voxels = np.argwhere(beside)
    if not len(voxels):
        return result
    spacing = box.spacing_mm[::-1]
    step = float(spacing.max())
    border = np.argwhere(drawn & ~binary_erosion(drawn))
    distance, nearest = cKDTree(border * spacing).query(voxels * spacing)
    start = border[nearest] * spacing
    along = (voxels * spacing - start) / distance[:, None]
    last = np.array(drawn.shape) - 1
    on = np.ones(len(voxels), dtype=bool)
    for reach in np.arange(1.0, _DRAWN_VOXELS + 1.5, 0.5) * step:
        place = np.clip(np.rint((start + reach * along) / spacing), 0, last).astype(np.int64)
        at = tuple(place.T)
        on &= (bone[at] & ~drawn[at]) | (reach < distance)
    result[tuple(voxels[on].T)] = True
    return np.asarray(binary_propagation(other, mask=other | result)) & result


def _bodies(stapes: Mask, other: Mask, local: Drawn) -> NDArray[np.uint8]:
    """Return the labels of the bodies as they are measured, the same whichever way bone was labelled."""
    bodies = np.where(local == PLATE, np.uint8(PLATE), np.uint8(0))
    bodies[other] = OTHER_BONE
    bodies[stapes] = STAPES
    return bodies


def _plate_in(scan: Scan, overview: Overview, stapes: Mask) -> PlateRegion | None:
    """Seek the plate in the grey values where the labels hold none."""
    with_plastic = (one for one in readings(overview.levels) if one.plastic is not None)
    reading = next(with_plastic, None)
    return find_plate(scan, overview, reading, stapes) if reading is not None and stapes.any() else None


def _cells(labels: Drawn, grid: Grid) -> Cells:
    used = used_box(labels > 0) or (slice(0, 1),) * 3
    return Cells(labels[used], grid.part(used))


def _cut_by_labels(box: Box, local: Drawn, grid: Grid, middle: float) -> list[Notice]:
    """Warn when the label volume ends on the stapes while the scan shows that its bone goes on."""
    within = box.taken(np.ones(grid.shape, dtype=bool), grid)
    end = (local == STAPES) & grown(~within)
    # Two layers further: the first is its blur.
    beyond = grown(grown(end)) & ~within & ~grown(within) & (box.grey > np.float32(middle))
    if np.count_nonzero(beyond) <= max(10, 0.5 * np.count_nonzero(end)):
        return []
    text = (
        "The stapes touches the border of the label volume while its bone goes on in the scan: what lies "
        "beyond is missing from volume and mass, and the uncertainty does not hold it. Draw the labels to "
        "its end."
    )
    return [Notice("touches_border", text)]
