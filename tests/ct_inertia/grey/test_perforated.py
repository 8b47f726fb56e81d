"""A footplate with a hole through it has two holes, and no reason to read the grey levels otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.ct_inertia.labelling.from_scan import find_bodies
from legacy.ct_inertia.volume.volume import Volume
from sample_volumes import phantom
from sample_volumes.analytic import write_analytic_stapes


def perforated(grey, ear, placed, radius_mm=0.2, at_mm=0.2):
    """Take a rod of bone out of the footplate, its edge blurred; also return the share taken (z, y, x)."""
    footplate = placed.scan_from_footplate.inverse()
    z, y, x = np.indices(grey.shape)
    points = footplate.points(np.stack([x, y, z], axis=-1).reshape(-1, 3) * ear.voxel_mm[0])
    away = np.hypot(points[:, 0] - at_mm, points[:, 2]) - radius_mm
    share = 1.0 / (1.0 + np.exp(away / (0.75 * ear.voxel_mm[0])))
    taken = np.where(np.abs(points[:, 1] - 0.2) < 0.4, share, 0.0).reshape(grey.shape)
    return ear.levels[0] + (grey - ear.levels[0]) * (1.0 - taken), taken


def test_a_perforated_footplate_is_measured_as_it_is_and_told(tmp_path):
    ear = phantom.Ear(
        voxel_mm=(0.04,) * 3,
        gap_mm=0.1,
        psf_voxels=1.1,
        noise=0.03,
        plate_distance_mm=0.4,
        tilt_deg=180.0,
        pose_seed=5,
        noise_seed=5,
        stapes=write_analytic_stapes(tmp_path / "stapes.ply"),
    )
    placed = phantom.scene(ear)
    whole = phantom.render(placed).astype(float)
    grey, taken = perforated(whole, ear, placed)
    missing = float(((whole - ear.levels[0]) * taken).sum()) / (ear.levels[2] - ear.levels[0]) * 0.04**3
    true = phantom.truth(placed)["volume_m3"] * 1e9 - missing
    found = find_bodies(Volume(grey.round().astype(np.uint16), np.full(3, 0.04), np.zeros(3), np.eye(3)))
    assert found.evidence["stapes"]["holes"] == 2
    assert "stapes_uncertain" in [notice.code for notice in found.notices]
    assert found.moments.volume_mm3 == pytest.approx(true, rel=0.004)
