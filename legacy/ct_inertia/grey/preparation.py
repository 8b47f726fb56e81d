"""Prepare the box around the stapes: measure the air, undo storing, make the point spread a Gaussian."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.grey.air_level import Air, Guess, Surroundings, air_shell, measure_air, unclipped
from legacy.ct_inertia.grey.clipped_levels import ClippedLevels, clipped_levels, undo_storing
from legacy.ct_inertia.grey.edge_shape import EdgeShape, edge_shape, fringe_notice, uneven_notice
from legacy.ct_inertia.grey.level_fit import blurred, body_share, grow_mask
from legacy.ct_inertia.grey.point_spread import equalise_blur, retrieve_phase
from legacy.ct_inertia.grey.psf import edge_sigma
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.volume.distance import capped_distance
from legacy.ct_inertia.volume.grid_operations import gaussian
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

# The blur of a plane edge beyond 4.2 widths holds 3e-6 of a width.
_TAIL_SIGMAS = 4.2
_DEFAULT_SIGMA_VOXELS = calibrated("preparation.default_sigma_voxels")
# Edge voxels of the first look at the blur, from which only the reach of what is measured follows.
_FEW_EDGES = 800
_LONG_VOXELS = calibrated("preparation.long_voxels")
# Rounds of phase retrieval: the first underestimates the length of a sharp scan, later ones add what is left.
_RETRIEVALS = 3


@dataclass(frozen=True)
class Prepared:
    """The box around the stapes, ready for measuring.

    Attributes
    ----------
    cut : Cut
        Grey values corrected for storing and for the shape of the point spread.
    around : Surroundings
        The same grey values with masks.
    rim : ndarray of bool, [z, y, x]
        The stapes and two voxels around it: where its edges are.
    air : Air
    stored : ClippedLevels or None
        What storing did.
    overshoot : float
        How far air at the bone was darker than air, as a share of the contrast, before that was corrected.
    sigma_mm, reach_mm : float
        A first width of the point spread, and how far blur reaches.
    distance_mm : ndarray of float32, [z, y, x]
        From the stapes, up to twice the reach.
    edges : EdgeShape or None
        What edges of the bone show; None with too few, and in fluid.
    notices : tuple of Notice
    """

    cut: Cut
    around: Surroundings
    rim: NDArray[np.bool_]
    air: Air
    stored: ClippedLevels | None
    overshoot: float
    sigma_mm: float
    reach_mm: float
    distance_mm: NDArray[np.float32]
    edges: EdgeShape | None
    notices: tuple[Notice, ...]


def prepare(cut: Cut, guess: Guess, spacing_mm: Array) -> Prepared:
    """Measure the air near the stapes, and correct grey values for storing and for the point spread's shape.

    Parameters
    ----------
    cut : Cut
    guess : Guess
    spacing_mm : ndarray, (3,)
    """
    rim = grow_mask(grow_mask(cut.stapes))
    first = _locate(cut, rim, (guess.air, guess.bone), spacing_mm, guess.air)
    cut, air, sigma = first.cut, first.air, first.sigma_mm
    own = first.distance_mm <= first.reach_mm
    stored = clipped_levels(first.around, air, first.shell, sigma)
    bone = guess.bone if stored is None else stored.bone.level
    if stored is not None:
        air = stored.air_known(air)
        for _ in range(2):
            now = undo_storing(cut.grey, first.around, own, stored, sigma)
            sigma = blur_of(replace(cut, grey=now), rim, (air.level, bone), spacing_mm, air.noise)[0]
        cut = replace(cut, grey=now)
    elif air.clipped:
        cut = replace(cut, grey=_unclip(cut, first.around, own, air, bone, sigma))
    around = replace(first.around, grey=cut.grey)
    foreign = cut.others | cut.plate
    noise = air.noise / (bone - air.level)
    shared = 0.0 if stored is None else stored.within_step / (bone - air.level)
    shapes, grey = [], cut.grey
    # In fluid there is no air to compare with.
    for _ in range(0 if cut.immersed else _RETRIEVALS):
        shape = edge_shape(grey, rim, foreign, (air.level, bone), spacing_mm, noise, shared, air.correlation)
        if shape is None:
            break
        shapes.append(shape)
        if not shape.sharpening_mm2:
            break
        grey = retrieve_phase(grey, shape.sharpening_mm2, spacing_mm)
    sharp = [shape for shape in shapes if shape.sharpening_mm2]
    uneven = shapes[-1] if shapes and shapes[-1].uneven else None
    if uneven is not None:
        grey = equalise_blur(grey, uneven.covariance_mm2, spacing_mm)
    edges = shapes[-1] if shapes else None
    if grey is cut.grey:
        reach, distance = first.reach_mm, first.distance_mm
        return Prepared(cut, around, rim, air, stored, 0.0, sigma, reach, distance, edges, ())
    again = _locate(replace(cut, grey=grey), rim, (air.level, bone), spacing_mm, air.level, seen=False)
    air = replace(again.air, clipped=air.clipped, sd=max(air.sd, again.air.sd))
    long = spacing_mm.max() > _LONG_VOXELS * spacing_mm.min()
    notices = [] if uneven is None or long else [uneven_notice(uneven)]
    if sharp:
        notices.append(fringe_notice(sharp[0].overshoot, sum(shape.sharpening_mm2 for shape in sharp)))
    return Prepared(
        cut=again.cut,
        around=again.around,
        rim=rim,
        air=air,
        stored=stored,
        overshoot=sharp[0].overshoot if sharp else 0.0,
        sigma_mm=again.sigma_mm,
        reach_mm=again.reach_mm,
        distance_mm=again.distance_mm,
        edges=edges,
        notices=tuple(notices),
    )


@dataclass(frozen=True)
class _Located:
    cut: Cut
    around: Surroundings
    air: Air
    shell: NDArray[np.bool_]
    sigma_mm: float
    reach_mm: float
    distance_mm: NDArray[np.float32]


def _locate(
    cut: Cut,
    rim: NDArray[np.bool_],
    levels: tuple[float, float],
    spacing_mm: Array,
    air: float,
    seen: bool = True,
) -> _Located:
    """Measure the air beyond the reach of blur; ``seen``: single voxels of the scan show clipping."""
    sigma = blur_of(cut, rim, levels, spacing_mm, 0.0, _FEW_EDGES)[0]
    reach = _TAIL_SIGMAS * sigma + float(spacing_mm.max())
    single = cut.working.single if seen and cut.working is not None else None
    around = Surroundings(cut.grey, cut.stapes, cut.others | cut.plate, spacing_mm, single)
    distance = capped_distance(cut.stapes, spacing_mm, 2.0 * reach)
    shell = air_shell(around, distance, reach)
    return _Located(cut, around, measure_air(around, shell, air), shell, sigma, reach, distance)


def blur_of(
    cut: Cut,
    rim: NDArray[np.bool_],
    levels: tuple[float, float],
    spacing_mm: Array,
    noise: float,
    most: int | None = None,
) -> tuple[float, float, str]:
    """Return the width of the point spread, its standard deviation (mm), and where they come from."""
    air, bone = levels
    more = {} if most is None else {"most": most}
    edge = edge_sigma(cut.grey, rim, air, bone, spacing_mm, noise / (bone - air), **more)
    if edge is None:
        sigma = _DEFAULT_SIGMA_VOXELS * float(spacing_mm.mean())
        return sigma, 0.5 * sigma, "assumed: one voxel"
    return edge[0], edge[1], "edges of the stapes"


def _unclip(
    cut: Cut, around: Surroundings, own: NDArray[np.bool_], air: Air, bone: float, sigma_mm: float
) -> NDArray[np.float32]:
    """Subtract the bias of clipping, estimated from each voxel's surroundings, then from the body found."""
    first = unclipped(cut.grey, own, air)
    contrast = np.float32(bone - air.level)
    share = gaussian((first - np.float32(air.level)) / contrast, 1.0, truncate=3.0)
    known = own & ~grow_mask(grow_mask(around.foreign))
    body = body_share(share, np.full(share.shape, 0.5, dtype=np.float32), known)
    expected = np.float32(air.level) + contrast * blurred(body, sigma_mm, around.spacing_mm[::-1])
    return np.where(known, unclipped(cut.grey, own, air, expected), first)
