"""Measure a stapes of which only a mask is known: labels alone, or a thresholded scan."""

from __future__ import annotations

import numpy as np

from ct_inertia.bodies import BodySurface, Labelled, Mask, MeasuredBody
from ct_inertia.grey.border import with_border
from ct_inertia.grey.moments import common, voxel_moments
from ct_inertia.voxels.fields import smooth
from ct_inertia.voxels.masks import eroded, grown

_SMOOTH_VOXELS = 0.8  # of a mask for its surface: it rounds the stairs of voxels
_THRESHOLD_SD = 12.0**-0.5  # voxels, of the whole surface within its voxels: a uniform distribution


def measure_mask(labelled: Labelled) -> MeasuredBody:
    """Measure the solid that the voxels of a mask fill.

    Notes
    -----
    The surface may lie anywhere within half a voxel of where it is drawn, all of it together: that is the one
    contribution, ``voxels``. Voxels of the two layers on both sides of the surface, half of each, make a
    layer of one voxel.
    """
    box = labelled.box
    moments = voxel_moments(labelled.stapes, box.scan_from_index)
    padded = np.pad(labelled.stapes, 1)
    rim = (grown(padded) & ~eroded(padded))[1:-1, 1:-1, 1:-1]
    shift = rim.astype(np.float32) * np.float32(0.5 * _THRESHOLD_SD)
    moments = moments.with_source("voxels", common(shift, box.scan_from_index, moments))
    moments, notices = with_border(labelled, moments)
    return MeasuredBody(
        labelled=labelled,
        scene=None,
        moments=moments,
        surface=mask_surface(labelled.stapes, labelled),
        wall=mask_surface(labelled.other, labelled) if labelled.other.any() else None,
        evidence={"bone_from": "mask"},
        notices=(*labelled.notices, *notices),
    )


def mask_surface(mask: Mask, labelled: Labelled) -> BodySurface:
    """Return the surface of a mask, its stairs smoothed by less than a voxel."""
    box = labelled.box
    edge = float(box.spacing_mm.mean())
    blur = edge * float(np.sqrt(_SMOOTH_VOXELS**2 + 1.0 / 12.0))
    field = smooth(mask.astype(np.float32), np.full(3, _SMOOTH_VOXELS)) - np.float32(0.5)
    return BodySurface(
        field=field,
        scan_from_index=box.scan_from_index,
        blur_mm=blur,
        spread_mm2=blur**2 * np.eye(3),
        noise_mm4=0.0,
        misfit_sd_mm=np.zeros(mask.shape, dtype=np.float32),
        misfit_mm=edge,
        level_sd_mm=float(_THRESHOLD_SD) * edge,
    )
