"""The border of the stapes through bone: where it runs, and what it leaves uncertain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ct_inertia.bodies import Labelled, Mask, Moments
from ct_inertia.calibrated import calibrated
from ct_inertia.grey.start import Start
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

_BRIDGE_SD_MM = calibrated("separation.bridge_sd_mm")
_NECK_SD_MM = calibrated("separation.neck_sd_mm")
_SOLID = 0.8  # way from the middle level to bone at which a voxel of the border is full of bone
_LEAST_MM2 = 0.003  # of a border through bone that is named: a few voxels
_WEAK_SHARE = 3e-3  # of the volume from which the cut decides the result


@dataclass(frozen=True)
class BoneBorder:
    """The border of the stapes through bone, which no gap in the grey values shows.

    Attributes
    ----------
    area_mm2, full_mm2 : float
        Of the border through voxels above the middle level; the same weighted by how full of bone it is.
    covariance : ndarray, (10, 10)
        Of (V, c, S).
    place_mm : ndarray, (3,), or None
        Middle of the largest connected patch, scan coordinates.
    at_neck : bool
        The border is a plane at a neck.
    """

    area_mm2: float
    full_mm2: float
    covariance: Array
    place_mm: Array | None
    at_neck: bool

    def notices(self, volume_mm3: float) -> list[Notice]:
        """Return the warnings about a cut through bone, and about a weakly determined end of the stapes."""
        if self.place_mm is None or self.area_mm2 < _LEAST_MM2:
            return []
        text = (
            f"The stapes was cut off other bone that it touches, over {self.area_mm2:.3f} mm2. Check the "
            "cut in the report; where it is wrong, draw or correct labels by hand (--labels)."
        )
        notices = [Notice("cut_through_bone", text)]
        share = float(np.sqrt(self.covariance[0, 0])) / volume_mm3
        if self.at_neck or share > _WEAK_SHARE:
            where = "at a neck, the narrowest section near its end" if self.at_neck else "across bridges"
            place = ", ".join(f"{v:.2f}" for v in self.place_mm)
            text = (
                f"Little shows where the stapes ends: {self.full_mm2:.3f} mm2 of the cut run through solid "
                f"bone, {where}, the largest patch around {place} mm (scan), and leave its volume uncertain "
                f"by {100.0 * share:.2g} %. Look at the cut in the report; where the stapes ends elsewhere, "
                "draw it (--labels)."
            )
            notices.append(Notice("cut_through_bone", text))
        return notices


def bone_border(
    labelled: Labelled, begin: Start, own: Mask, levels: tuple[float, float], moments: Moments
) -> BoneBorder:
    """Return where the border runs through bone, and what that leaves uncertain.

    ``own``: the stapes' side of the border, [z, y, x]; ``levels``: of air and bone.

    Notes
    -----
    The true end of the stapes inside a bridge is not in the grey values: each connected patch of the border
    is taken to be known to one voxel and a calibrated length, independent of the others. Where blur alone
    fills a gap its middle stays darker than bone and shows the border: a voxel counts by the cube of its
    share of the way from the middle level to 80 % of bone.
    """
    import cc3d

    grid = begin.grid
    air, full = levels
    middle = 0.5 * (air + full)
    neck = labelled.at_neck
    stapes, other = (mask[begin.part] for mask in (labelled.stapes, labelled.other))
    bodies = (stapes | other) & (begin.grey > np.float32(middle))
    edge = own & bodies & _across_faces(bodies & ~own)
    covariance = np.zeros((10, 10))
    if not other.any() or not edge.any():
        return BoneBorder(0.0, 0.0, covariance, None, neck)
    patches = cc3d.connected_components(edge, connectivity=26)
    points = grid.scan_points(np.argwhere(edge)[:, ::-1])
    part = (begin.grey[edge].astype(float) - middle) / (_SOLID * (full - middle))
    weight = np.clip(part, 0.0, 1.0) ** 3
    edge_mm = grid.voxel_mm3 ** (1.0 / 3.0)
    sd_mm = float(np.hypot(edge_mm, _NECK_SD_MM if neck else _BRIDGE_SD_MM))
    steps = moments.sensitivity(points) * edge_mm**2 * sd_mm
    owner = patches[edge]
    for patch in np.unique(owner):
        step = weight[owner == patch] @ steps[owner == patch]
        covariance += np.outer(step, step)
    largest = int(np.argmax(np.bincount(owner, weight)))
    return BoneBorder(
        len(points) * edge_mm**2,
        float(weight.sum()) * edge_mm**2,
        covariance,
        points[owner == largest].mean(axis=0),
        neck,
    )


def _across_faces(mask: Mask) -> Mask:
    """Return the voxels that touch a mask [z, y, x] in a face, so that an area is counted once."""
    result = np.zeros_like(mask)
    for axis in range(3):
        into, source = np.moveaxis(result, axis, 0), np.moveaxis(mask, axis, 0)
        into[1:] |= source[:-1]
        into[:-1] |= source[1:]
    return result
