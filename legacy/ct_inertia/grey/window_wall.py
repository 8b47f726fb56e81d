"""The surface of other bone near the stapes: what faces the rim of the footplate across the ligament."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.bodies import WindowWall
from legacy.ct_inertia.grey.air_level import Air
from legacy.ct_inertia.grey.bone_level import Bone
from legacy.ct_inertia.grey.frame_surface import blur_on_grid, coarse_share, straightened
from legacy.ct_inertia.grey.level_fit import grow_mask
from legacy.ct_inertia.grey.neighbours import NeighbourSeparation, neighbour_share
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.surface.contours import contoured
from legacy.ct_inertia.volume.volume import Volume

# Widths of the blur around other bone within which its own grey values are followed.
_REACH_SIGMAS = 3.0


def window_wall(
    cut: Cut,
    parted: NeighbourSeparation,
    levels: tuple[Air, Bone],
    sigma_mm: float,
    grid: Volume,
    tail_sd: float,
) -> WindowWall | None:
    """Return the surface of other bone in the box around the stapes; None where there is none.

    Parameters
    ----------
    cut : Cut
    parted : NeighbourSeparation
        Which grey values are the stapes', and what blur carries between it and other bone.
    levels : (air, bone)
    sigma_mm : float
        Standard deviation of the blur.
    grid : Volume
        What the box is a part of.
    tail_sd : float
        Standard deviation of what blur carries between close bodies, as a share of it.

    Notes
    -----
    Other bone has a contrast of its own; its surface is at its half level. The stapes' tail is
    subtracted from it as its tail was subtracted from the stapes, and the grid is that of `frame_surface`.
    """
    if not np.any(cut.others):
        return None
    air, bone = levels[0].level, levels[1].level
    contrast = neighbour_share(cut, (air, bone))
    share = share_of_bone(cut.grey, air, bone)
    if parted.behind is not None:
        share -= parted.behind
    np.copyto(share, np.float32(0.0) if parted.foreign is None else parted.foreign, where=parted.own)
    share[cut.plate] = 0.0
    near = cut.others
    for _ in range(int(np.ceil(_REACH_SIGMAS * sigma_mm / float(grid.spacing_mm.min())))):
        near = grow_mask(near)
    share /= np.float32(contrast)
    share[~near] = 0.0
    part, transform, variance = coarse_share(share, cut.scan_from_box(grid))
    points, faces = contoured(straightened(part), 0.0)
    if len(faces) == 0:
        return None
    points = points @ transform[:3, :3].T + transform[:3, 3]
    level_sd = 0.5 * float(np.hypot(levels[0].sd, levels[1].sd)) / (bone - air)
    return WindowWall(points, faces, blur_on_grid(sigma_mm, transform, variance), level_sd, tail_sd)


def share_of_bone(grey: NDArray[np.float32], air: float, bone: float) -> NDArray[np.float32]:
    """Return grey values as the share of bone in each voxel, between the levels of air and bone."""
    share = grey - np.float32(air)
    share /= np.float32(bone - air)
    return share
