"""Third-party results: the virtual point transformation of pyFBS 1.0.7 on its own data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import from_arrays
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.registration.laser_errors import LaserPriors
from legacy.stapeskit.spatial import DOF_NAMES

# Accelerometers have no lasers whose gains could differ.
EXACT = LaserPriors(0.0, 0.0, 0.0)
DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "virtual_point"


def motion(data, frf, dof=DOF_NAMES, weights=None):
    """Fit responses (freq, channel, force) with one run per force."""
    value = np.moveaxis(frf, -1, 0).swapaxes(1, 2)
    parts = {
        "points": [str(name)[:2] for name in data["chn_name"]],
        "positions_mm": (data["chn_pos"] - data["vp_pos"]) * 1e3,
        "directions": data["chn_dir"],
        "value": value,
    }
    if weights is not None:
        parts["sd"] = 1.0 / np.sqrt(weights)[None, :, None]
    runs = tuple(str(run) for run in range(len(value)))
    measured = from_arrays({"beam": parts}, np.arange(1.0, len(frf) + 1.0), order=0, runs=runs)
    return np.moveaxis(points2dof(measured, options=Options(dof, lasers=EXACT)).motion.q[:, 0], 0, -1)


def difference(found, expected):
    return np.max(np.abs(found - expected)) / np.max(np.abs(expected))


@pytest.mark.shared
def test_beam_tip():
    data = np.load(DATA / "fe_beam_tip.npz")
    force = data["tf"]
    clean, noisy = data["frf_clean"] @ force, data["frf_noisy"] @ force
    assert difference(motion(data, clean), data["vp_frf_clean"]) < 1e-12
    assert difference(motion(data, noisy), data["vp_frf_noisy"]) < 1e-12
    weighted = motion(data, clean, weights=data["weights_wu"])
    assert difference(weighted, data["vp_frf_weighted"]) < 1e-12
    subset = motion(data, clean, ("y", "alpha", "gamma"))
    assert difference(subset, data["vp_frf_subset_uy_rx_rz"]) < 1e-12


@pytest.mark.shared
def test_lab_test_bench():
    data = np.load(DATA / "lab_testbench_semisynthetic.npz")
    assert difference(motion(data, data["chn_frf_noisy"]), data["vp_frf_pyfbs_from_noisy"]) < 1e-10
