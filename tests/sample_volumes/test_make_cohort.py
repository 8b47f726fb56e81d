"""The sample cohort: truth by the planted law, right ears mirrored, results compared with the truth."""

import json

import numpy as np
import pytest

from legacy.fitting.examples.paper import PAPER_STIFFNESS
from legacy.pipeline.study import read_study
from sample_volumes.old_cohort import REFERENCE_KG, Population, compare, make_cohort


def test_two_ears_of_one_person_follow_the_law(tmp_path):
    still = Population(ears=2, pairs=1, scatter=0.0, entry_scatter=0.0)
    truth = make_cohort(tmp_path, still)
    assert json.loads((tmp_path / "truth.json").read_text()) == truth
    for one, side in zip(truth["ears"], ("left", "right"), strict=True):
        study = read_study(tmp_path / "ears" / one["folder"] / "study.toml")
        assert (study.study.side, study.scan.side, study.study.subject) == (side, side, "P01")
        stiffness, size = np.array(one["stiffness_si"]), one["mass_kg"] / REFERENCE_KG
        assert stiffness[0, 0] == pytest.approx(PAPER_STIFFNESS[0, 0] * size, rel=1e-9)
        assert stiffness[1, 1] == pytest.approx(PAPER_STIFFNESS[1, 1] * size ** (5 / 3), rel=1e-9)
        turned = -1.0 if side == "right" else 1.0
        assert np.sign(stiffness[0, 1]) == turned * np.sign(PAPER_STIFFNESS[0, 1])
        assert np.all(np.linalg.eigvalsh(stiffness) > 0.0)


def test_what_was_found_is_set_against_the_truth(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "truth.json").write_text(
        json.dumps({"exponents_of_mass": {"K11": 1.0}, "intrinsic_sd_log": 0.13})
    )
    law = {
        "response": "K11",
        "predictor": "mass_kg",
        "exponent": 1.2,
        "exponent_interval_95": [1.1, None],
        "intrinsic_sd_log": 0.1,
        "intrinsic_sd_log_interval_95": [0.05, 0.2],
    }
    others = [{**law, "response": "K12"}, {**law, "predictor": "gap_m"}]
    (tmp_path / "out" / "cohort.json").write_text(json.dumps({"laws": [law, *others]}))
    (row,) = compare(tmp_path)
    assert not row["inside"]
    assert row["scatter_inside"]
    assert row["high_95"] == np.inf
