"""A stapes that the border of the scan cuts: where, and how large the cut is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.grey.partial_volume import sensitivity
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

CODE = "touches_border"
# Volume of half a ball over its cross-section to the power of 3/2.
_HALF_BALL = 2.0 / (3.0 * np.sqrt(np.pi))


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


def cut_notice(cuts: Iterable[BorderCut], where: str = "scan", held: bool = False) -> Notice:
    """Report which layers cut the body, and what either cause does to the result.

    ``held``: the budget holds the rounded end that may be missing (`border_covariance`).
    """
    layers = " and at ".join(cut.told for cut in cuts)
    holds = "a rounded end as wide as the cut, no more" if held else "neither"
    text = (
        f"The body measured touches the border of the {where}, at {layers}. Either the stapes ends there: "
        f"what lies beyond is missing from volume and mass. Or another bone that the field of view crops, "
        f"such as the tip of the incus, touches the stapes and is counted with it. The uncertainty holds "
        f"{holds}. Look at the slices of the report; scan or export a larger field of view, or correct the "
        f"labels ({named('labels')})."
    )
    return Notice(CODE, text)


def cropped_notice() -> Notice:
    """Report bone that the border crops and that was cut off the stapes."""
    text = (
        f"Another bone that the border of the scan crops, most likely the tip of the incus, joins the stapes "
        f"and was cut off it along the darkest sheet between them. "
        f"Too little of it is in the scan to see where it ends as well as elsewhere; the budget holds the "
        f"cut (separation). Export 1 mm more beyond the head, or correct the cut ({named('labels')})."
    )
    return Notice("incus_cropped", text)


def border_covariance(
    cuts: Iterable[BorderCut], share: NDArray[np.float32], cut: Cut, volume: Volume, moments: Moments
) -> Array:
    """Return the covariance (10, 10) of what the border of the scan cuts off the body, or leaves on it.

    ``share`` [z, y, x] is that of the body's bone in each voxel.

    Notes
    -----
    Neither is in the scan: the standard deviation is half a ball as wide as each cut, at its middle. Blur
    of what lies beyond counts.
    """
    covariance = np.zeros((10, 10))
    for one in cuts:
        k = "xyz".index(one.axis)
        place = 0 if one.end == "first" else share.shape[2 - k] - 1
        layer = np.clip(np.take(share, place, axis=2 - k), 0.0, 1.0)
        area = float(layer.sum() * np.prod(np.delete(volume.spacing_mm, k)))
        middle = np.argwhere(layer > 0.5 * layer.max())[:, ::-1].mean(axis=0)
        away = volume.scan_points(np.insert(middle, k, place)[None] + cut.first) - moments.centroid_mm
        step = sensitivity(away, moments.volume_mm3, 0.0)[0] * _HALF_BALL * area**1.5
        covariance += np.outer(step, step)
    return covariance


def border_cuts(volume: Volume, cut: Cut) -> tuple[BorderCut, ...]:
    """Return where the stapes reaches the first or last voxel of the scan."""
    if cut.working is None:
        size = np.array(cut.stapes.shape[::-1])
        begins, ends = cut.first <= 0, cut.first + size >= volume.size
        spacing = volume.spacing_mm
    else:
        begins, ends = cut.working.at_border(volume)
        spacing = cut.working.volume.spacing_mm
    return cut_layers(cut.stapes, spacing, begins, ends)


def border_notices(volume: Volume, cut: Cut) -> list[Notice]:
    """Warn when the stapes reaches the first or last voxel of the scan."""
    cuts = border_cuts(volume, cut)
    return [cut_notice(cuts)] if cuts else []
