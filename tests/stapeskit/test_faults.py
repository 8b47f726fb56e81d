"""Faults are data; the sentence and the list of many are made from them."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from legacy.stapeskit.faults import (
    FEW,
    LONGEST,
    Fault,
    Place,
    StapeskitError,
    collect_faults,
    format_faults,
    format_ranges,
    raise_all,
    render,
)

SPACING = Fault("the spacing", "positive", -1, "scan.tif", "Give --spacing.")


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        (SPACING, "the spacing must be positive; got -1 (scan.tif). Give --spacing."),
        (Fault("x", "1", 2), "x must be 1; got 2."),
        (Fault("x", "1", 2, next_step="Did you mean y?"), "x must be 1; got 2. Did you mean y?"),
        (
            Fault("x", "1", 2, Place("a.csv", "line", (4,), "x_mm")),
            "x must be 1; got 2 (a.csv, line 4, x_mm).",
        ),
        (
            Fault("x", "1", 2, Place("a.csv", "row", (4, 6, 5, 9))),
            "x must be 1; got 2 (a.csv, rows 4 to 6, 9).",
        ),
        (Fault("nothing was written"), "nothing was written"),
    ],
)
def test_the_sentence_of_a_fault(fault, sentence):
    assert str(fault) == sentence


def test_options_are_written_as_the_reader_knows_them():
    fault = Fault("the stapes", "inside {voi_box}", "{seed}", "{box}", "Change {box}")
    assert render(fault) == "the stapes must be inside --voi-box; got {seed} ({box}). Change --box."
    in_study = render(fault, lambda name: f"scan.{name}_mm")
    assert in_study == "the stapes must be inside scan.voi_box_mm; got {seed} ({box}). Change scan.box_mm."


def test_faults_compare_and_hash_whatever_the_value_was():
    assert Fault("x", "1", np.zeros(2)) == Fault("x", "1", np.zeros(2))
    assert len({Fault("x", "1", [1, 2]), Fault("x", "1", [1, 2])}) == 1


def test_an_error_holds_its_faults_and_survives_another_process():
    error = StapeskitError(SPACING, "nothing was written")
    assert error.faults == (SPACING, Fault("nothing was written"))
    again = pickle.loads(pickle.dumps(error))
    assert again.faults == error.faults
    assert str(again) == str(error) == f"{SPACING}\nnothing was written"


def test_all_faults_come_in_one_error_each_once():
    raise_all(StapeskitError, [])
    with pytest.raises(StapeskitError) as caught:
        raise_all(StapeskitError, [SPACING, Fault("x", "1", 2), SPACING])
    assert caught.value.faults == (SPACING, Fault("x", "1", 2))


def test_faults_are_collected_and_the_work_goes_on():
    faults = []
    with collect_faults(faults):
        raise StapeskitError(SPACING)
    assert faults == [SPACING]


def test_the_same_fault_in_many_rows_is_one_sentence():
    rows = [Fault("x_mm", "a number", f"t{k}", Place("a.csv", "line", (k,))) for k in range(2, 92)]
    error = StapeskitError(*rows, Fault("dir", "given", "none", "a.csv"))
    assert len(error.faults) == 91
    assert str(error).splitlines() == [
        "x_mm must be a number; got t2, t3, t4 and 87 more (a.csv, lines 2 to 91).",
        "dir must be given; got none (a.csv).",
    ]
    assert len(str(StapeskitError(*rows[:FEW])).splitlines()) == FEW


def test_the_same_fault_of_many_things_is_one_sentence_when_they_do_not_fit():
    points = [
        Fault(f"point {k}", "in points.csv", "none", Place("a.csv", "line", (k,))) for k in range(2, 400)
    ]
    assert str(StapeskitError(*points)) == (
        "point 2, point 3, point 4 and 395 more must be in points.csv; got none (a.csv, lines 2 to 399)."
    )


def test_of_many_kinds_as_many_as_fit_are_written_and_the_rest_counted_with_its_rows():
    kinds = [Fault("x", f"as rule {k} says", "y" * 90, Place("a.csv", "line", (k,))) for k in range(1, 101)]
    lines = str(StapeskitError(*kinds)).splitlines()
    assert lines[0].startswith("x must be as rule 1 says")
    assert lines[-1] == f"... and {101 - len(lines)} more faults (lines {len(lines)} to 100 of a.csv)."


texts = st.text(st.characters(codec="utf-8", exclude_characters="\n"), max_size=30) | st.integers(
    1, 9000
).map(lambda n: "name " * (n // 5))
places = st.builds(
    Place,
    st.sampled_from(["a.csv", "b" * 250]),
    st.sampled_from(["line", "dataset"]),
    st.lists(st.integers(1, 10**6), max_size=4).map(tuple),
    texts,
)
listed = st.lists(
    st.builds(Fault, texts, texts, texts, texts | places, texts)
    | st.builds(Fault, st.integers().map(str), st.sampled_from("ab"), texts, places, st.just("z")),
    min_size=1,
    max_size=60,
)


@given(listed, st.integers(1, 9))
@settings(deadline=None, max_examples=60)
def test_no_message_is_longer_than_fits_on_a_screen_or_two(faults, times):
    text = format_faults(faults * times)
    assert 0 < len(text) <= LONGEST or not any(str(fault) for fault in faults)


def test_numbers_are_written_as_ranges():
    assert format_ranges([3]) == "line 3"
    assert format_ranges([5, 3, 4, 9], "row") == "rows 3 to 5, 9"
    assert format_ranges(range(1, 200, 2), most=2) == "lines 1, 3 and 98 more places"
