"""Beside the table of scenes: virtual points that pyFBS computed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import kinematics.cli
from stapeskit.records.motion_file import read_motion

SHARED = Path(__file__).parents[3] / "shared" / "data" / "virtual_point"


@pytest.mark.shared
def test_virtual_points_are_those_of_pyfbs(tmp_path: Path) -> None:
    """Noisy channels of a test bench, six impacts: pyFBS 1.0.7 squares the condition number (1e-10)."""
    known = np.load(SHARED / "lab_testbench_semisynthetic.npz")
    freq, frf = known["freq"][1::10], known["chn_frf_noisy"][1::10]
    sd = float(known["noise_sigma_complex"]) / np.sqrt(2.0)
    arms_mm = 1e3 * (known["chn_pos"] - known["vp_pos"])
    points = [f"beam,{number + 1},{','.join(f'{value:.17g}' for value in arm)},1e-9"
              for number, arm in enumerate(arms_mm)]  # fmt: skip
    (tmp_path / "points.csv").write_text("\n".join(["body,point,x_mm,y_mm,z_mm,sd_mm", *points]) + "\n")
    lines = ["body,point,dir_x,dir_y,dir_z,run,freq_hz,re_m_s,im_m_s,sd_m_s"]
    for channel, beam in enumerate(known["chn_dir"]):
        along = ",".join(f"{value:.17g}" for value in beam)
        for run in range(frf.shape[2]):
            for hz, value in zip(freq, frf[:, channel, run], strict=True):
                measured = f"{value.real:.17g},{value.imag:.17g},{sd:.17g}"
                lines.append(f"beam,{channel + 1},{along},{run + 1},{hz},{measured}")
    (tmp_path / "ldv.csv").write_text("\n".join(lines) + "\n")
    out = tmp_path / "dof.csv"
    exact = [f"--{name}-sd=0" for name in ("gain", "phase", "delay")]
    kinematics.cli.work([str(tmp_path / "ldv.csv"), *exact, "--out", str(out), "--quiet"])
    motion = read_motion(out.with_suffix(".h5"))
    velocity = (2j * np.pi * motion.freq_hz)[:, None] * motion.q[:, 0]
    expected = known["vp_frf_pyfbs_from_noisy"][1::10].transpose(2, 0, 1)
    assert np.abs(velocity - expected).max() < 1e-9 * np.abs(expected).max()
