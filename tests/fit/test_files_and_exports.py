"""Files: the command, exports whose numbers give K and D back, outputs that replace nothing."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.io import loadmat

from fitting.cli import work
from fitting.dof2kd import check_chain, dof2kd
from fitting.exports import EXPORTS, abaqus, ansys, comsol, file_names, matlab, prior_csv, prior_json
from fitting.mass import inertia_of
from stapeskit.faults import StapeskitError
from stapeskit.records.motion_file import write_motion
from tests.fit.fit_cases import DOF, M, fit, paper_motion


@pytest.fixture(scope="module")
def result():
    return fit(paper_motion(0.02, 1, 60)[0], M)


@pytest.fixture
def folder(tmp_path):
    write_motion(tmp_path, "dof", paper_motion(0.02, 1, 60)[0])
    np.savetxt(tmp_path / "M.csv", M, delimiter=",", fmt="%.15g")
    return tmp_path


def test_command_writes_json_page_mat_and_csv(folder, monkeypatch):
    monkeypatch.chdir(folder)
    outcome = work(["dof.csv", "--mass", "M.csv", "--out", "ear.json", "--export", "fe,prior", "--quiet"])
    names = {path.name for path in outcome.files}
    assert names == set(file_names("ear.json", ("fe", "prior")))
    assert {path.name for path in folder.iterdir()} >= names
    content = json.loads((folder / "ear.json").read_text())
    same = dof2kd(folder / "dof.csv", mass=folder / "M.csv")
    assert np.array(content["stiffness_si"]) == pytest.approx(same.stiffness, rel=1e-12)
    assert content["provenance"]["inputs"]["motion"]["file"] == "dof.csv"
    page = (folder / "ear.html").read_text()
    assert content["verdict"]["sentence"] in page
    assert "<script src" not in page


def test_matlab_and_csv_hold_numbers(result, tmp_path):
    (tmp_path / "kd.mat").write_bytes(matlab(result))
    content = loadmat(tmp_path / "kd.mat")
    assert content["K"] == pytest.approx(result.stiffness)
    assert content["covariance"] == pytest.approx(result.covariance)
    frame = result.to_frame()
    assert frame["sd"].to_numpy() == pytest.approx(np.sqrt(np.diag(result.covariance)))
    assert frame.dtypes[["value", "sd", "lower_95", "upper_95"]].map(str).eq("float64").all()


def test_matrix27_is_k_of_the_difference_of_two_nodes(result):
    text = ansys(result)
    values, current = {}, None
    for line in text.splitlines():
        word, *rest = line.split(",")
        if word in ("R", "RMORE"):
            current = int(rest.pop(0)) if word == "R" else current
            values.setdefault(current, []).extend(float(number) for number in rest)
    full = np.zeros((12, 12))
    full[np.triu_indices(12)] = values[1]
    full = full + np.triu(full, 1).T
    rows = [1, 3, 5]
    assert full[np.ix_(rows, rows)] == pytest.approx(result.stiffness, rel=1e-8)
    assert full @ np.tile(np.arange(6.0), 2) == pytest.approx(np.zeros(12), abs=1e-9 * np.abs(full).max())
    assert len(values[3]) == 78


def test_user_element_lists_lower_triangles(result):
    numbers, kept = {}, None
    for line in abaqus(result).splitlines():
        if line.startswith("*MATRIX"):
            kept = line.split("=")[1]
            numbers[kept] = []
        elif line.startswith("*"):
            kept = None
        elif kept:
            numbers[kept] += [float(number) for number in line.split(",")]
    assert set(numbers) == {"STIFFNESS", "VISCOUS DAMPING", "MASS"}
    full = np.zeros((12, 12))
    full[np.tril_indices(12)] = numbers["VISCOUS DAMPING"]
    assert full[np.ix_([1, 3, 5], [1, 3, 5])][np.tril_indices(3)] == pytest.approx(
        result.damping[np.tril_indices(3)], rel=1e-8
    )


def test_comsol_parameters_have_units(result):
    lines = comsol(result).splitlines()
    first = lines[0].split()
    assert first[0] == "K11"
    assert float(first[1].split("[")[0]) == pytest.approx(result.stiffness[0, 0])
    assert first[1].endswith("[N/m]")
    assert len(lines) == 18


def test_prior_is_the_joint_normal_distribution(result):
    content = json.loads(prior_json(result))
    assert np.array(content["covariance_si"]) == pytest.approx(result.covariance)
    assert prior_csv(result).splitlines()[0].startswith("entry,mean,unit,cov_K11")
    assert set(EXPORTS) == {"fe", "prior"}
    with pytest.raises(StapeskitError):
        file_names("kd.json", ("step",))
    with pytest.raises(StapeskitError):
        file_names("kd.txt")


def test_fe_refuses_a_law_that_has_no_matrix():
    motion, _ = paper_motion(0.02, 1, 40, "fractional")
    with pytest.raises(StapeskitError):
        ansys(fit(motion, M, damping="fractional", unknowns="none"))


def test_another_mass_is_refused_unless_forced():
    source = replace(inertia_of(M, DOF), record=SimpleNamespace(raw={"frames": {}}, notices=()))
    motion, _ = paper_motion(0.02, 1, 20)
    stored = {"file": "mass.json", "document_hash": "sha256:00"}
    motion = replace(motion, provenance={"inputs": {"mass": stored}})
    with pytest.raises(StapeskitError, match="--mass"):
        check_chain(motion, "dof.csv", source)
    forced = check_chain(motion, "dof.csv", source, force=True)
    assert [notice.code for notice in forced] == ["other_mass_file"]
