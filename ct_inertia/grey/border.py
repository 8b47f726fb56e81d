"""A stapes that the border of the scan cuts: where, how large the cut is, and what it leaves uncertain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ct_inertia.bodies import Box, Labelled, Mask, Moments
from ct_inertia.voxels.masks import grown
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

_HALF_BALL = 2.0 / (3.0 * np.sqrt(np.pi))  # volume of half a ball over its cross-section to the power of 3/2


@dataclass(frozen=True)
class BorderContact:
    """A cut of the border of the scan through the body: where, in words; mm2; its middle (3,) in the scan."""

    place: str
    area_mm2: float
    centre_mm: Array

    def __str__(self) -> str:
        return f"{self.place} ({self.area_mm2:.2g} mm2)"


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
                place_mm = box.scan_points(middle[None])[0]
                contacts.append(BorderContact(f"the {end} layer along {'xyz'[axis]}", count * area, place_mm))
    if box.measured is not None and np.any(rim := stapes & grown(~box.measured)):
        area = float(np.count_nonzero(rim)) * box.voxel_mm3 ** (2.0 / 3.0)
        middle = np.argwhere(rim)[:, ::-1].mean(axis=0)
        contacts.append(BorderContact("the rim of the field of view", area, box.scan_points(middle[None])[0]))
    return tuple(contacts)


def with_border(labelled: Labelled, moments: Moments) -> tuple[Moments, list[Notice]]:
    """Add the source ``border`` where the border of the scan cuts the body, and say where.

    Half a ball as wide as each cut, at its middle: neither it nor less of the body is in the scan.
    """
    contacts = border_contacts(labelled.stapes, labelled.box)
    if not contacts:
        return moments, []
    for contact in contacts:
        moments = moments.with_lump("border", contact.centre_mm, _HALF_BALL * contact.area_mm2**1.5)
    text = (
        f"The body measured touches the border of the scan, at {' and at '.join(map(str, contacts))}. "
        "Either the stapes ends there: what lies beyond is missing from volume and mass. Or another bone "
        "that the field of view crops, such as the tip of the incus, touches the stapes and is counted "
        "with it. The budget holds a rounded end as wide as the cut (border), no more. Look at the slices "
        "of the report; scan or export a larger field of view, or correct the labels (--labels)."
    )
    return moments, [Notice("touches_border", text)]
