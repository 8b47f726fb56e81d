"""Laws of a cohort of ears with a planted law; which ears make a cohort; what is written."""

import json
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from pipeline.cohort.cohort import cohort, cohort_of
from pipeline.cohort.ears import ear_table, quantities, read_ear
from pipeline.cohort.laws import LEAST_EARS
from pipeline.cohort.page import FILES
from stapeskit.faults import StapeskitError
from tests.cohort.simulated_ears import ear

SCHEMA = Path(__file__).parents[2] / "docs/schemas/cohort.schema.json"


@pytest.fixture(scope="module", autouse=True)
def laws_of_the_mass():
    """Fit no laws of other predictors: they take eight times as long and are fitted alike."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.cohort.laws.product", lambda names, _: [(one, "mass_kg") for one in names])
        yield


@pytest.fixture(scope="module")
def ears():
    rng = np.random.default_rng(3)
    return [ear(number, rng) for number in range(9)]


@pytest.fixture(scope="module")
def laws(ears):
    return cohort_of(ears)


def test_the_planted_exponent_lies_in_its_interval(laws):
    law = laws.law("K11", "mass")
    low, high = law.interval
    assert low < 2.0 < high
    assert law.p_value < 0.05
    assert law.reliability > 0.9
    assert len(laws.to_frame()) == len(laws.laws)
    assert laws.plot().axes


def test_density_is_an_error_that_all_ears_share(laws):
    assert any(source.startswith("density") for source in laws.table.sources)
    column = laws.table.column("mass_kg")
    assert np.all(np.sqrt(laws.table.own[:, column, column]) < 0.005)


def test_the_assumed_error_of_lengths_is_reported_where_none_is_stated(ears, laws):
    assert "file_read" in {notice.code for notice in laws.notices}
    keys = ("height", "footplate_length", "footplate_width")
    stated = [{**one.mass["found"], **{f"{key}_sd_mm": 0.01 for key in keys}} for one in ears]
    known = [replace(one, mass={**one.mass, "found": found}) for one, found in zip(ears, stated, strict=True)]
    assert "file_read" not in {notice.code for notice in cohort_of(known).notices}


def test_an_ear_is_predicted_from_its_scan_alone(ears, laws):
    further = ear(40, np.random.default_rng(8))
    found = laws.predict(further.mass, "K11", "mass")
    low, high = found.interval_si
    assert low < further.kd["stiffness_si"][0][0] < high


def test_too_few_ears_are_listed_only(ears):
    few = cohort_of(ears[: LEAST_EARS - 1])
    assert few.table is None
    assert [notice.code for notice in few.notices] == ["laws_left_open"]


def with_verdict(one, level):
    kd = {**one.kd, "verdict": {"level": level, "reasons": [{"code": "misfit", "text": "."}]}}
    return replace(one, kd=kd)


def test_an_ear_not_to_be_used_enters_no_law_unless_asked(ears):
    marked = [with_verdict(ears[0], "do not use"), *ears[1:]]
    found = cohort_of(marked)
    assert [name for name, _ in found.excluded] == ["ear 0"]
    assert found.law("K11", "mass").n == len(ears) - 1
    assert cohort_of(marked, use_all=True).law("K11", "mass").n == len(ears)


def test_an_ear_that_follows_no_law_of_the_others_is_named(ears, laws):
    """A mass in grams, as a wrong unit makes it, moves the exponent of a whole cohort."""
    assert "ear_unlike_others" not in {notice.code for notice in laws.notices}
    record = ears[4].mass["inertial_parameters"]
    mass = {**ears[4].mass, "mass_kg": 1e3 * ears[4].mass["mass_kg"]}
    mass["inertial_parameters"] = {name: (1e3 * np.array(part)).tolist() if name == "values_si" else part
                                   for name, part in record.items()}  # fmt: skip
    found = cohort_of([*ears[:4], replace(ears[4], mass=mass), *ears[5:]])
    texts = [notice.text for notice in found.notices if notice.code == "ear_unlike_others"]
    assert [("ear 4" in text, "ear 5" in text) for text in texts] == [(True, False)]


def test_ears_of_one_body_of_one_scan_are_named(ears):
    scan = {"provenance": {"inputs": {"scan": {"hash": "abc"}}}}
    twice = [replace(ear, mass={**ear.mass, **scan}) for ear in ears[:2]]
    assert "scan_shared" in {notice.code for notice in cohort_of([*twice, *ears[2:]]).notices}
    apart = [replace(ear, mass={**ear.mass, "provenance": {
        "inputs": {"scan": {"hash": "abc"}}, "parameters": {"seed_mm": [float(number), 0.0, 0.0]}
    }}) for number, ear in enumerate(ears[:2])]  # fmt: skip
    assert "scan_shared" not in {notice.code for notice in cohort_of([*apart, *ears[2:]]).notices}


def test_what_a_study_states_of_an_ear_is_a_column(ears):
    known = [
        replace(one, about={**one.about, "storage_days": float(k), "verdict": "mine"})
        for k, one in enumerate(ears[:3])
    ]
    table = ear_table([*known, ears[4]], {"lost": "no scan"})
    assert table["subject"].tolist()[:4] == ["s0", "s1", "s2", "s4"]
    assert table["storage_days"].tolist()[:3] == [0.0, 1.0, 2.0]
    assert table["stated_verdict"].tolist()[:3] == ["mine"] * 3
    assert "mine" not in table["verdict"].tolist()
    assert table["storage_days"].isna().tolist() == [False] * 3 + [True] * 2


CHANGES = {
    "twice": lambda ears: [*ears, ears[0]],
    "same motion": lambda ears: [*ears, replace(ears[0], folder="copy")],
    "other dof": lambda ears: [*ears, replace(ears[0], folder="x", kd={**ears[0].kd, "dof": ["y"]})],
    "other law": lambda ears: [*ears[1:], replace(ears[0], kd={**ears[0].kd, "model": {"damping_law": "h"}})],
    "side": lambda ears: [*ears[1:], replace(ears[0], about={"side": "right"})],
    "none": lambda _: [],
}


@pytest.mark.parametrize("kind", CHANGES)
def test_ears_that_make_no_cohort_are_refused(kind, ears):
    with pytest.raises(StapeskitError):
        cohort_of(CHANGES[kind](ears))


@pytest.mark.parametrize("law", ["K99~mass", "K11~height_of_tree"])
def test_unknown_planned_laws_are_refused(law, ears):
    with pytest.raises(StapeskitError) as raised:
        cohort_of(ears, laws=[law])
    assert raised.value.faults[0].thing == "--laws"


def test_a_right_ear_is_compared_as_its_mirror_image(ears):
    right = replace(ears[0], side="right", folder="right")
    rows = {row.name: row.values for row in quantities([ears[0], right])}
    assert rows["K_y_y"][0] == rows["K_y_y"][1]
    assert rows["K_y_alpha"][0] == -rows["K_y_alpha"][1]
    assert rows["K_y_gamma"][0] == rows["K_y_gamma"][1]


def test_folders_are_read_and_the_page_table_and_json_are_written(ears, tmp_path):
    for one in ears:
        folder = tmp_path / one.folder
        folder.mkdir()
        (folder / "mass.json").write_text(json.dumps(one.mass))
        (folder / "kd.json").write_text(json.dumps(one.kd))
    assert read_ear(tmp_path / "ear0", "ear 0").kd == json.loads(json.dumps(ears[0].kd))
    found = cohort([tmp_path / one.folder for one in ears])
    paths = found.write(tmp_path / "out")
    assert {path.name for path in paths} == set(FILES)
    content = json.loads((tmp_path / "out" / "cohort.json").read_text())
    schema = json.loads(SCHEMA.read_text(encoding="utf-8"))
    jsonschema.validate(content, schema)
    assert content["laws"]
    for name in ("independent_parameters", None):  # nothing is promised that is not written
        promised = schema["properties"][name] if name else schema
        assert set(promised["properties"]) == set(content[name] if name else content)
    table = (tmp_path / "out" / "cohort.csv").read_text().splitlines()
    assert len(table) == 1 + len(ears)
    assert "ear 0" in repr(found) or "Cohort of 9 ears" in repr(found)
    with pytest.raises(StapeskitError):
        cohort([tmp_path / "out"])
