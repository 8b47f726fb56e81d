"""Results of the commands obey the published JSON Schemas; the schemas are strict enough to notice faults."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from legacy.fitting.estimators import ESTIMATORS

SCHEMAS = Path(__file__).resolve().parents[2] / "docs" / "schemas"


def schema(name: str) -> dict:
    return json.loads((SCHEMAS / f"{name}.schema.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["mass", "kd"])
def test_results_obey_their_schema(name, finished):
    content = json.loads((finished[1] / f"{name}.json").read_text(encoding="utf-8"))
    checker = jsonschema.Draft202012Validator(schema(name))
    checker.check_schema(schema(name))
    checker.validate(content)


def test_the_schema_names_every_estimator():
    assert set(schema("kd")["properties"]["estimator"]["enum"]) == set(ESTIMATORS)


def test_a_plan_obeys_its_schema(tmp_path, monkeypatch):
    from legacy.fitting.fit_files import plan_files

    monkeypatch.chdir(tmp_path)
    (tmp_path / "plan.toml").write_text("lines = 40\n", encoding="utf-8")
    plan_files(tmp_path / "plan.toml", tmp_path / "plan.json")
    content = json.loads((tmp_path / "plan.json").read_text(encoding="utf-8"))
    checker = jsonschema.Draft202012Validator(schema("plan"))
    checker.check_schema(schema("plan"))
    checker.validate(content)
    assert list(checker.iter_errors(content | {"budget": {"channel_noise": {"K17": 1.0}}}))


@pytest.mark.parametrize("count", [2, 8])
def test_a_cohort_obeys_its_schema(count):
    from legacy.pipeline.cohort.cohort_laws import cohort_laws
    from tests.pipeline.cohort.simulated_ears import ear

    rng = np.random.default_rng(4)
    ears = [ear(number, rng) for number in range(count)]
    provenance = {"inputs": {}, "versions": {}, "parameters": {}, "date": ""}
    content = json.loads(json.dumps(cohort_laws(ears).as_json(provenance)))
    checker = jsonschema.Draft202012Validator(schema("cohort"))
    checker.check_schema(schema("cohort"))
    checker.validate(content)
    assert bool(content["laws"]) == (count > 5)
    assert list(checker.iter_errors(content | {"laws": [{"response": "K11"}]}))


@pytest.mark.parametrize(
    ("name", "key", "wrong"),
    [
        ("mass", "mass_kg", -1.0),
        ("mass", "schema", "stapeskit.mass/2"),
        ("mass", "warnings", [{"text": "without a code"}]),
        ("kd", "stiffness_si", "1722"),
        ("kd", "modes", [{"frequency_hz": 1.0}]),
        ("kd", "dof", ["y", "delta"]),
    ],
)
def test_a_wrong_value_is_noticed(name, key, wrong, finished):
    content = json.loads((finished[1] / f"{name}.json").read_text(encoding="utf-8"))
    checker = jsonschema.Draft202012Validator(schema(name))
    assert list(checker.iter_errors(content | {key: wrong}))
    assert list(checker.iter_errors({one: value for one, value in content.items() if one != key}))
