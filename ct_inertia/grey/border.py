"""A stapes that the border of the scan cuts: where, how large the cut is, and what it leaves uncertain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ct_inertia.bodies import BorderContact, Box, Grey, Grid, Mask, Moments
from ct_inertia.grey.moments import sensitivity
from ct_inertia.voxels.masks import grown
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

_HALF_BALL = 2.0 / (3.0 * np.sqrt(np.pi))  # volume of half a ball over its cross-section to the power of 3/2


def border_contacts(stapes: Mask, box: Box) -> tuple[BorderContact, ...]:
    """Return where a mask [z, y, x] reaches an end of the scan or what was not measured."""
    contacts = []
    for axis in range(3):
        area = box.voxel_mm3 / float(box.spacing_mm[axis])
        for end, there, place in (
            ("first", box.begins[axis], 0),
            ("last", box.ends[axis], stapes.shape[2 - axis] - 1),
        ):
            layer = np.take(stapes, place, axis=2 - axis)
            count = int(np.count_nonzero(layer)) if there else 0
            if count:
                middle = np.insert(np.argwhere(layer)[:, ::-1].mean(axis=0), axis, place)
                contacts.append(
                    BorderContact("xyz"[axis], end, count * area, box.scan_points(middle[None])[0])
                )
    if box.measured is not None and np.any(rim := stapes & grown(~box.measured)):
        area = float(np.count_nonzero(rim)) * box.voxel_mm3 ** (2.0 / 3.0)
        middle = np.argwhere(rim)[:, ::-1].mean(axis=0)
        contacts.append(BorderContact("", "", area, box.scan_points(middle[None])[0]))
    return tuple(contacts)


def border_covariance(contacts: Sequence[BorderContact], share: Grey, box: Grid, moments: Moments) -> Array:
    """Return the covariance (10, 10) of the moments because the border of the scan cuts the body.

    Notes
    -----
    Neither is in the scan: the standard deviation is half a ball as wide as each cut, at its middle.
    ``share`` [z, y, x] is that of the body in each voxel; blur of what lies beyond counts.
    """
    covariance = np.zeros((10, 10))
    for contact in contacts:
        area = _blurred_area(contact, share, box) if contact.axis else contact.area_mm2
        away = (contact.centre_mm - moments.centroid_mm)[None]
        step = sensitivity(away, moments.volume_mm3, 0.0)[0] * _HALF_BALL * area**1.5
        covariance += np.outer(step, step)
    return covariance


def _blurred_area(contact: BorderContact, share: Grey, box: Grid) -> float:
    axis = "xyz".index(contact.axis)
    place = 0 if contact.end == "first" else share.shape[2 - axis] - 1
    layer = np.clip(np.take(share, place, axis=2 - axis), 0.0, 1.0)
    return float(layer.sum()) * box.voxel_mm3 / float(box.spacing_mm[axis])


def border_notice(contacts: Sequence[BorderContact]) -> Notice:
    """Report which layers cut the body, and what either cause does to the result."""
    text = (
        f"The body measured touches the border of the scan, at {' and at '.join(map(str, contacts))}. "
        "Either the stapes ends there: what lies beyond is missing from volume and mass. Or another bone "
        "that the field of view crops, such as the tip of the incus, touches the stapes and is counted "
        "with it. The budget holds a rounded end as wide as the cut (border), no more. Look at the slices "
        "of the report; scan or export a larger field of view, or correct the labels (--labels)."
    )
    return Notice("touches_border", text)
