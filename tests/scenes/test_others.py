"""Scenes beside the table: a plan and the measurement it plans, and virtual points that pyFBS computed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import fitting.cli
import kinematics.cli
from fitting.plan import read_plan, stated_mass
from fitting.planned_motion import planned_motion, six_dof_matrices
from stapeskit.records.motion_file import read_motion, write_motion
from tests.fit.fit_cases import drawn
from tests.scenes.chain import distance_of

SHARED = Path(__file__).parents[3] / "shared" / "data" / "virtual_point"


def test_a_measurement_as_planned_states_what_the_plan_promised(tmp_path: Path) -> None:
    (tmp_path / "plan.toml").write_text('lines = 60\ndirections = ["y", "x"]\nmass_sd_percent = 0\n')
    fitting.cli.work(["--plan", str(tmp_path / "plan.toml"), "--out", str(tmp_path / "plan.json"), "--quiet"])
    plan, _ = read_plan(tmp_path / "plan.toml")
    mass = stated_mass(plan).matrix
    np.savetxt(tmp_path / "M.csv", mass, delimiter=",", fmt="%.17g")
    write_motion(tmp_path, "dof", drawn(planned_motion(plan, mass), np.random.default_rng(3)))
    words = [str(tmp_path / "dof.csv"), "--mass", str(tmp_path / "M.csv"), "--mass-sign", "tensor"]
    fitting.cli.work([*words, "--unknowns", "none", "--out", str(tmp_path / "kd.json"), "--quiet"])
    promised, found = (json.loads((tmp_path / name).read_text()) for name in ("plan.json", "kd.json"))
    for name in ("stiffness", "damping"):
        ratio = np.diag(found[f"{name}_sd_si"]) / np.diag(promised[f"expected_{name}_sd_si"])
        assert np.all(np.abs(ratio - 1.0) < 0.25), ratio
    rows, upper = [1, 3, 5], np.triu_indices(3)
    truth = [part[np.ix_(rows, rows)][upper] for part in six_dof_matrices(plan)]
    stated = [np.array(found[f"{name}_si"])[upper] for name in ("stiffness", "damping")]
    off = np.concatenate(stated) - np.concatenate(truth)
    distance, limit = distance_of(off, np.array(found["covariance_si"]))
    assert distance < limit
    assert {warning["code"] for warning in found["warnings"]} == {"mass_uncertainty_not_given"}


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
