"""kd.json is checked against its schema; further keys travel along."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from stapeskit.faults import StapeskitError
from stapeskit.records.kd import kd_record, read_kd_json, schema

DOF = ["y", "alpha", "gamma"]
NAMES = [f"{letter}{i}{j}" for letter in "KD" for i in (1, 2, 3) for j in (1, 2, 3) if j >= i]
MATRIX = [[1.0, 0.0, 0.0], [0.0, 2.0, None], [0.0, None, 3.0]]
MODE = {
    "frequency_hz": 1000.0, "undamped_frequency_hz": 1001.0, "damping_ratio": 0.05,
    "shape_re": [1.0, 0.0, 0.0], "shape_im": [0.0, 0.0, 0.0], "normalisation": "largest entry 1",
}  # fmt: skip


@pytest.fixture
def content() -> dict:
    return copy.deepcopy({
        "schema": "stapeskit.kd/1", "dof": DOF, "model": {"equation": "w^2 M q"}, "estimator": "ml",
        "stiffness_si": MATRIX, "stiffness_sd_si": MATRIX, "damping_si": MATRIX, "damping_sd_si": MATRIX,
        "noise_only_sd_si": {"stiffness": MATRIX, "damping": MATRIX}, "parameters": NAMES,
        "covariance_si": np.eye(12).tolist(), "verdict": {"level": "believe", "reasons": []},
        "budget": {"noise": {"K11": 0.1}}, "stable": True, "max_real_eigenvalue_1_s": -3.0,
        "passive": {"stiffness": True, "damping": False}, "modes": [MODE], "overdamped_roots_1_s": [],
        "principal_axes": None, "identifiability": {}, "provenance": {}, "ligament": {"height_mm": 0.1},
        "fit": {"chi2": 1.0, "n_dof": 5, "chi2_per_dof": 0.2, "iterations": 3, "active_constraints": []},
        "warnings": [{"code": "weak_identifiability", "text": "So."}],
    })  # fmt: skip


def test_a_result_is_read_with_its_further_keys(tmp_path: Path, content: dict) -> None:
    path = tmp_path / "kd.json"
    path.write_text(json.dumps(content))
    read = read_kd_json(path)
    assert read.model_extra == {"ligament": {"height_mm": 0.1}}
    assert np.array_equal(read.array("stiffness_si"), np.array(MATRIX, dtype=float), equal_nan=True)
    assert read.model_dump(by_alias=True) == content
    content.pop("verdict")  # as files of version 0.2
    assert kd_record(content).verdict is None


@pytest.mark.parametrize(("key", "value", "thing"), [
    ("schema", "other", "schema"),
    ("dof", ["alpha", "y", "gamma"], "dof"),
    ("dof", ["y", "y", "gamma"], "dof"),
    ("dof", ["w"], "dof.0"),
    ("stable", "yes", "stable"),
    ("stiffness_si", [[1.0]], "stiffness_si"),
    ("damping_sd_si", [["a", 0.0, 0.0]] * 3, "damping_sd_si.0.0"),
    ("covariance_si", [[1.0]], "covariance_si"),
    ("modes", [MODE | {"frequency_hz": -1.0}], "modes.0.frequency_hz"),
    ("verdict", {"level": "perhaps"}, "verdict.level"),
    ("warnings", [{"code": "Not so", "text": "x"}], "warnings.0.code"),
    ("fit", None, "fit"),
])  # fmt: skip
def test_what_the_schema_does_not_allow_is_refused(
    content: dict, key: str, value: object, thing: str
) -> None:
    with pytest.raises(StapeskitError) as caught:
        kd_record(content | {key: value})
    assert {fault.thing for fault in caught.value.faults} >= {thing}
    assert all((fault.where, bool(fault.next_step)) == ("kd.json", True) for fault in caught.value.faults)


def test_all_faults_come_at_once(content: dict) -> None:
    for key in ("dof", "fit", "parameters"):
        content.pop(key)
    with pytest.raises(StapeskitError) as caught:
        kd_record(content)
    assert [fault.thing for fault in caught.value.faults] == ["dof", "parameters", "fit"]


def test_the_schema_describes_the_file(content: dict) -> None:
    jsonschema.validate(content, schema())
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(content | {"stable": 3}, schema())
