"""Faults are data; the sentence and the list of many are made from them."""

import pickle

import numpy as np
import pytest

from stapeskit.faults import Fault, Place, StapeskitError, collecting, raise_all, ranges, render

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
    with collecting(faults):
        raise StapeskitError(SPACING)
    assert faults == [SPACING]


def test_of_many_faults_some_of_each_kind_are_written_and_the_rest_counted_with_their_lines():
    bad = [Fault("x_mm", "a number", f"t{k}", Place("a.csv", "line", (k,))) for k in range(2, 92)]
    error = StapeskitError(*bad, Fault("dir", "given", "none", "a.csv"))
    text = str(error)
    assert len(error.faults) == 91
    assert "dir must be given" in text
    assert "... and 51 more faults: x_mm in lines 41 to 91 of a.csv." in text


def test_numbers_are_written_as_ranges():
    assert ranges([3]) == "line 3"
    assert ranges([5, 3, 4, 9], "row") == "rows 3 to 5, 9"
    assert ranges(range(1, 200, 2), most=2) == "lines 1, 3 and 98 more places"
