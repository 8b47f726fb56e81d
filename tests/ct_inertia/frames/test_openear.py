"""The footplate frame of the real OpenEar stapes stays put over voxel size, pose and noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.ct_inertia.frames.anatomy import AnatomyHints
from legacy.ct_inertia.frames.footplate import footplate_frame
from legacy.ct_inertia.surface.isosurface import iso_surface
from legacy.stapeskit.frames import vector_from_rotation
from sample_volumes import phantom


@pytest.mark.parametrize(("voxel", "pose"), [(0.04, 2), (0.03, 5)])
def test_frame_is_stable(voxel, pose):
    ear = phantom.Ear(voxel_mm=(voxel,) * 3, plate=False, bone=False, pose_seed=pose, noise_seed=pose)
    placed = phantom.scene(replace(ear, tilt_deg=80.0))
    grey = phantom.render(placed).astype(np.float32)
    share = (grey - ear.levels[0]) / (ear.levels[2] - ear.levels[0])
    surface = iso_surface(share, 0.5, np.diag([voxel, voxel, voxel, 1.0]))
    truth = placed.scan_from_footplate
    frame = footplate_frame(surface, AnatomyHints(anterior=truth.rotation[:, 0])).scan_from_footplate
    between = truth.inverse() @ frame
    assert np.linalg.norm(between.translation_mm) < 0.008
    assert np.degrees(np.linalg.norm(vector_from_rotation(between.rotation))) < 0.4
