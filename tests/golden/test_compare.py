"""What the comparison of recorded results lets pass and what it reports."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.golden.collect import LARGEST, of_json, packed
from tests.golden.compare import differences
from tests.golden.inputs import NOISE_SD, noise


def table(**content):
    return json.loads(json.dumps({f"kd.json:{place}": value for place, value in of_json(content)}))


def kinds(old, new, renamed=None):
    return [one.kind for one in differences(old, new, renamed or {})]


CONTENT = {
    "stiffness_si": [[1722.0, 0.4, 0.0], [0.4, 1.3e-3, -6.4e-5], [0.0, -6.4e-5, 3.8e-3]],
    "warnings": [{"code": "a", "text": "one"}, {"code": "b", "text": "two"}],
    "budget": {"noise": {"K11": 2.0}, "density": {"K11": 1e-9}},
    "fit": {"chi2": 40.0, "estimator": "ml", "passive": True},
    "provenance": {"date": "today", "versions": {}},
}


def changed(*path, value):
    content = json.loads(json.dumps(CONTENT))
    place = content
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return table(**content)


@pytest.mark.parametrize(
    ("path", "value", "found"),
    [
        (("fit", "chi2"), 40.0 * (1 + 3e-10), []),
        (("fit", "chi2"), 40.0 * (1 + 3e-9), ["number"]),
        (("stiffness_si", 0, 2), 1e-13, []),  # of 1722 and 3.8e-3: an exact zero but for rounding
        (("stiffness_si", 0, 2), 1e-11, ["number"]),
        (("stiffness_si", 1, 1), 1.3e-3 + 1e-11, ["number"]),
        (("budget", "density", "K11"), 5e-8, []),
        (("budget", "density", "K11"), 5e-6, ["number"]),
        (("fit", "estimator"), "irls", ["word"]),
        (("fit", "passive"), False, ["word"]),
        (("warnings", 0, "code"), "c", ["word"]),
        (("warnings", 0, "text"), "three words more", ["message"]),
        (("provenance", "date"), "tomorrow", []),
    ],
)
def test_what_is_told_of_one_change(path, value, found):
    assert kinds(table(**CONTENT), changed(*path, value=value)) == found


def test_codes_in_another_order_differ():
    assert kinds(table(**CONTENT), changed("warnings", value=CONTENT["warnings"][::-1])) == [
        "word",
        "message",
    ]


def test_renamed_keys_are_missing_and_added_until_they_are_named():
    old = table(fit={"chi2": 40.0, "lines": 3})
    new = table(fit={"chi_squared": 40.0, "lines": 3})
    missing, added = differences(old, new, {})
    assert (missing.kind, added.kind) == ("missing", "added")
    assert "chi_squared" in missing.old
    assert kinds(old, new, {"chi2$": "chi_squared"}) == []


@pytest.mark.parametrize("factor", [1 + 1e-6, -1.0])
def test_one_entry_of_a_large_array_is_seen(factor):
    values = np.random.default_rng(0).normal(size=(40, LARGEST // 20))
    other = values.copy()
    other[7, 11] *= factor
    old, new = {"dof.h5:q": packed(values)}, {"dof.h5:q": packed(other)}
    assert kinds(old, {"dof.h5:q": packed(values)}) == []
    assert kinds(old, new) == ["number"]


def test_the_noise_of_the_scans_is_what_it_says():
    values = noise(200_000, 3)
    assert values.dtype == np.int64
    assert abs(values.mean()) < 5 * NOISE_SD / np.sqrt(len(values)) + 0.5  # rounded down
    assert values.std() == pytest.approx(NOISE_SD, rel=0.02)
    assert np.array_equal(values[:5], noise(5, 3))
