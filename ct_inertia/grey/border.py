"""A stapes that the border of the scan cuts: where, and how large the cut is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ct_inertia.segment.cutting import Cut
from ct_inertia.volume.volume import Volume
from stapeskit.arrays import Array
from stapeskit.vocabulary import named
from stapeskit.warnings import Notice

CODE = "touches_border"


@dataclass(frozen=True)
class BorderCut:
    """One plane in which the scan ends and the body does not.

    Attributes
    ----------
    axis : str
        ``x``, ``y`` or ``z``, across the plane.
    end : str
        ``first`` or ``last`` layer of voxels along that axis.
    area_mm2 : float
        Of the body in that layer.
    """

    axis: str
    end: str
    area_mm2: float

    @property
    def told(self) -> str:
        """In words."""
        return f"the {self.end} layer along {self.axis} ({self.area_mm2:.2g} mm2)"


def cut_layers(
    mask: NDArray[np.bool_], spacing_mm: Array, begins: Iterable[bool], ends: Iterable[bool]
) -> tuple[BorderCut, ...]:
    """Return where a mask reaches those ends of its grid that are ends of the scan.

    Parameters
    ----------
    mask : ndarray of bool, [z, y, x]
    spacing_mm : ndarray, (3,)
    begins, ends : 3 bool each
        Whether the grid begins, and whether it ends, where the scan does, along x, y, z.
    """
    cuts = []
    for k, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        area = float(np.prod(np.delete(spacing_mm, k)))
        for place, name, there in ((0, "first", begin), (-1, "last", end)):
            count = int(np.count_nonzero(np.take(mask, place, axis=2 - k))) if there else 0
            if count:
                cuts.append(BorderCut("xyz"[k], name, count * area))
    return tuple(cuts)


def cut_notice(cuts: Iterable[BorderCut], where: str = "scan") -> Notice:
    """Report which layers cut the body, and what either cause does to the result."""
    layers = " and at ".join(cut.told for cut in cuts)
    text = (
        f"The body measured touches the border of the {where}, at {layers}. Either the stapes ends there: "
        f"what lies beyond is missing from volume and mass. Or another bone that the field of view crops, "
        f"such as the tip of the incus, touches the stapes and is counted with it. The uncertainty holds "
        f"neither. Look at the slices of the report; scan or export a larger field of view, or correct the "
        f"labels ({named('labels')})."
    )
    return Notice(CODE, text)


def border_notices(volume: Volume, cut: Cut) -> list[Notice]:
    """Warn when the stapes reaches the first or last voxel of the scan."""
    if cut.working is None:
        size = np.array(cut.stapes.shape[::-1])
        begins, ends = cut.first <= 0, cut.first + size >= volume.size
        spacing = volume.spacing_mm
    else:
        begins, ends = cut.working.at_border(volume)
        spacing = cut.working.volume.spacing_mm
    cuts = cut_layers(cut.stapes, spacing, begins, ends)
    return [cut_notice(cuts)] if cuts else []
