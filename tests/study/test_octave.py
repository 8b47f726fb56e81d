"""kd.mat, mass.mat, dof.mat in Octave: every number is that of JSON or the motion, to the last bit."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from ct_inertia.exports.write import EXPORTS
from pipeline.run import StudyResult

pytestmark = pytest.mark.octave

SCRIPT = r"""
function put(name, value)
  printf('%s', name);
  printf(' %.17g', [real(value(:).'); imag(value(:).')]);
  printf('\n');
end
kd = load('kd.mat'); mass = load('mass.mat'); dof = load('dof.mat');
for name = {'K', 'D', 'M', 'K_sd', 'D_sd', 'covariance'}, put(['kd.' name{1}], kd.(name{1})); end
for name = {'M', 'M_sd', 'parameters_covariance'}, put(['mass.' name{1}], mass.(name{1})); end
for name = {'q', 'covariance', 'freq_hz'}, put(['dof.' name{1}], dof.(name{1})); end
"""


def test_octave_reads_every_mat_file(finished: StudyResult, tmp_path: Path) -> None:
    (tmp_path / "kd.mat").write_bytes((finished.out / "kd.mat").read_bytes())
    assert finished.measured_now is not None
    EXPORTS["mat"][1](finished.measured_now, tmp_path / "mass.mat")
    finished.moved.write_into(tmp_path, report=False, export=("mat",))
    (tmp_path / "show.m").write_text(f"1;\n{SCRIPT}")
    words = ["octave-cli", "--no-gui", "--quiet", "show.m"]
    said = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    read = {}
    for line in said.splitlines():
        name, *numbers = line.split()
        pairs = np.array(numbers, dtype=float).reshape(-1, 2)
        read[name] = pairs[:, 0] + 1j * pairs[:, 1]
    kd, mass = (json.loads((finished.out / f"{name}.json").read_text()) for name in ("kd", "mass"))
    expected = {
        "kd.K": kd["stiffness_si"],
        "kd.D": kd["damping_si"],
        "kd.M": kd["mass_matrix_si"],
        "kd.K_sd": kd["stiffness_sd_si"],
        "kd.D_sd": kd["damping_sd_si"],
        "kd.covariance": kd["covariance_si"],
        "mass.M": mass["mass_matrix"]["matrix_si"],
        "mass.M_sd": mass["mass_matrix"]["standard_deviation_si"],
        "mass.parameters_covariance": mass["inertial_parameters"]["covariance_si"],
        "dof.q": finished.moved.motion.q,
        "dof.covariance": finished.moved.motion.covariance,
        "dof.freq_hz": finished.moved.motion.freq_hz,
    }
    assert read.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(read[name], np.asarray(value).ravel(order="F"), err_msg=name)
