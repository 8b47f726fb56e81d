"""Results of the commands obey the published JSON Schemas; the schemas are strict enough to notice faults."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest

SCHEMAS = Path(__file__).resolve().parents[2] / "docs" / "schemas"


def schema(name: str) -> dict:
    return json.loads((SCHEMAS / f"{name}.schema.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["mass", "kd"])
def test_results_obey_their_schema(name, finished):
    content = json.loads((finished[1] / f"{name}.json").read_text(encoding="utf-8"))
    checker = jsonschema.Draft202012Validator(schema(name))
    checker.check_schema(schema(name))
    checker.validate(content)


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
