"""The sample study from its scan to its report, against the truth behind it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from legacy.pipeline.scan2kd import run_study
from tests.conftest import leave_drawing

SAMPLE = Path(__file__).parents[2] / "sample_volumes"


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    """The finished study, without its drawings: those of `finished` and of the README's commands are made."""
    with pytest.MonkeyPatch.context() as patch:
        leave_drawing(patch)
        result = run_study(SAMPLE / "study.toml", tmp_path_factory.mktemp("sample"))
    return result, json.loads((SAMPLE / "truth.json").read_text(encoding="utf-8"))


def test_stiffness_and_damping_agree_with_the_truth_within_their_covariance(sample):
    result, truth = sample
    upper = np.triu_indices(3)
    error = np.concatenate(
        [
            np.array(result.kd[f"{name}_si"])[upper] - np.array(truth[f"{name}_si"])[upper]
            for name in ("stiffness", "damping")
        ]
    )
    covariance = np.array(result.kd["covariance_si"])
    sd = np.sqrt(np.diag(covariance))
    scaled = error / sd
    distance = scaled @ np.linalg.solve(covariance / np.outer(sd, sd), scaled)
    assert chi2.sf(distance, 12) > 0.01
    assert np.all(np.abs(scaled) < 3.5)
    assert result.kd["stable"]
    assert all(result.kd["passive"].values())
    assert chi2.sf(result.kd["fit"]["chi2"], result.kd["fit"]["n_dof"]) > 1e-3


def test_mass_matrix_agrees_with_the_exact_one_of_the_mesh(sample):
    result, truth = sample
    exact = np.array(truth["mass_matrix_si"])
    root = np.sqrt(np.diag(exact))
    found = np.array(result.mass["mass_matrix"]["matrix_si"])
    shape_error = found * truth["density_kg_m3"] / result.mass["density_kg_m3"] - exact
    assert np.max(np.abs(shape_error) / np.outer(root, root)) < 0.005
    assert np.max(np.abs(found - exact) / np.outer(root, root)) < 0.02
    assert result.mass["volume_m3"] == pytest.approx(truth["volume_m3"], rel=1e-3)


@pytest.mark.parametrize(
    ("frame", "most_mm", "most_deg"), [("scan_from_footplate", 0.01, 0.3), ("scan_from_plate", 0.003, 0.06)]
)
def test_frames_agree_with_the_truth(sample, frame, most_mm, most_deg):
    result, truth = sample
    error = np.linalg.inv(np.array(truth[frame])) @ np.array(result.mass["frames"][frame])
    assert np.linalg.norm(error[:3, 3]) < most_mm
    angle = np.degrees(np.arccos(np.clip((np.trace(error[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
    assert angle < most_deg


def test_a_simulated_study_says_so_at_the_top(sample):
    text = (sample[0].out / "report.html").read_text(encoding="utf-8")
    assert "SIMULATED" in text.split("<section")[0]
    assert 'src="http' not in text
    assert 'href="http' not in text
    assert all(
        notice["code"] in text for part in (sample[0].mass, sample[0].kd) for notice in part["warnings"]
    )
    assert {path.name for path in sample[0].files} >= {"labels.nrrd", "plate.ply", "stapes.ply"}
    assert "Segmentation" in text


def test_warnings_of_a_study_name_options_as_its_file_does(sample):
    result, _ = sample
    written = [notice["text"] for part in (result.mass, result.kd) for notice in part["warnings"]]
    assert written
    assert not [text for text in written if re.search(r"(^|\s)--[a-z]", text)]
