"""Exports give back what was fitted; CalculiX finds the frequency of the exported model."""

from __future__ import annotations

import csv
import io
import json
import shutil
import subprocess

import numpy as np
import pytest
from scipy.io import loadmat

from fitting.errors import FittingError
from fitting.export_formats import EXPORTS, exported, file_name
from fitting.exports.inp import mass_points, spring_points
from fitting.exports.joint import joint_parameters
from fitting.kd import fit_kd
from fitting.measure_kd import kd_of
from fitting.options import KDOptions
from stapeskit.spatial import matrix_from_parameters
from tests.fitting.cases import K, M, paper_motion, six_dof_mass, six_dof_motion, six_dof_parameters


@pytest.fixture(scope="module")
def fit():
    mass = six_dof_mass({"density": 0.02**2 * np.outer(six_dof_parameters(), six_dof_parameters())})
    return kd_of(six_dof_motion(0.01, 0, lines=60), mass, KDOptions(bands=0))


def test_every_export_is_written_beside_the_record(fit, tmp_path) -> None:
    files = fit.write(tmp_path, export=tuple(EXPORTS))
    assert {file.name for file in files} == {
        "kd.json",
        "kd.html",
        *(file_name("kd", name) for name in EXPORTS),
    }
    assert all(file.stat().st_size > 100 for file in files)


def test_matlab_and_table_hold_matrices_and_covariance(fit) -> None:
    read = loadmat(io.BytesIO(exported(fit, "mat")))
    assert np.array_equal(read["K"], fit.stiffness)
    assert np.array_equal(read["covariance"][:12, :12], joint_parameters(fit).covariance[:12, :12])
    rows = list(csv.DictReader(io.StringIO(exported(fit, "csv").decode())))
    assert [row["entry"] for row in rows] == list(fit.parameters)
    assert float(rows[0]["value"]) == fit.stiffness[0, 0]
    assert [float(rows[3][f"cov_{name}"]) for name in fit.parameters] == list(fit.covariance[3])


def test_joint_covariance_holds_the_errors_that_k_d_and_m_share(fit) -> None:
    """A density that is too high raises M and K together: their relative errors are nearly one."""
    found = json.loads(exported(fit, "joint"))
    names, covariance = found["parameters"], np.array(found["covariance_si"])
    assert np.allclose(covariance, covariance.T)
    sd = np.sqrt(np.diag(covariance))
    values = np.linalg.eigvalsh(covariance / np.outer(np.where(sd > 0, sd, 1), np.where(sd > 0, sd, 1)))
    assert values[0] > -1e-9
    k11, m11 = names.index("K11"), names.index("M11")
    assert covariance[k11, m11] == pytest.approx(0.02**2 * fit.stiffness[0, 0] * fit.mass[0, 0], rel=0.1)
    assert np.array_equal(covariance[:12, :12], 0.5 * (fit.covariance + fit.covariance.T))


def test_springs_and_masses_make_their_matrices() -> None:
    points = spring_points(K)
    rows = np.column_stack([np.ones(4), -points[:, 1], points[:, 0]])
    assert rows.T @ rows * K[0, 0] / 4.0 == pytest.approx(K, rel=1e-9, abs=1e-12)
    parameters = six_dof_parameters()
    total = np.zeros(10)
    for place in mass_points(parameters):
        mass = parameters[0] / 6.0
        tensor = mass * (place @ place * np.eye(3) - np.outer(place, place))
        entries = [tensor[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))]
        total += np.array([mass, *(mass * place), *entries])
    assert matrix_from_parameters(total) == pytest.approx(
        matrix_from_parameters(parameters), rel=1e-9, abs=1e-18
    )


@pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX is not installed")
def test_calculix_finds_the_first_natural_frequency(fit, tmp_path) -> None:
    (tmp_path / "kd.inp").write_bytes(exported(fit, "inp"))
    done = subprocess.run(
        ["ccx", "kd"], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stdout[-2000:]
    lines = (tmp_path / "kd.dat").read_text().splitlines()
    start = next(at for at, line in enumerate(lines) if "CYCLES/TIME" in line)
    rows = [line.split() for line in lines[start:] if len(line.split()) == 5 and line.split()[0].isdigit()]
    found = float(rows[0][3])
    squares = np.linalg.eigvals(np.linalg.solve(fit.mass, fit.stiffness)).real
    assert found == pytest.approx(float(np.sqrt(squares.min())) / (2.0 * np.pi), rel=1e-3)


def test_latex_and_methods_name_the_numbers(fit) -> None:
    assert r"\begin{pmatrix}" in exported(fit, "tex").decode()
    text = exported(fit, "methods").decode()
    assert "60 lines" in text
    assert "plane of the ligament" in text


def test_springs_need_the_paper_s_degrees_of_freedom() -> None:
    fit = fit_kd(paper_motion(0.01, 0, 40), M, KDOptions(bands=0))
    assert b"No masses" in exported(fit, "inp")
    one = fit_kd(six_dof_motion(0.01, 0, lines=40), six_dof_mass(), KDOptions(dof=("y",), bands=0))
    with pytest.raises(FittingError) as caught:
        exported(one, "inp")
    assert caught.value.faults[0].thing == "the export inp"
