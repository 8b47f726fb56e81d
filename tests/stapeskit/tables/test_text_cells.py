"""No text of a CSV file is taken for a formula by a spreadsheet."""

import pytest

from legacy.stapeskit.tables.text_cells import as_text_cell, from_text_cell


@pytest.mark.parametrize("text", ["=1+cmd|' /C calc'!A0", "+x", "-x", "@SUM(A1)", "\tx", "\rx", "-1+1"])
def test_what_begins_a_formula_is_text(text):
    assert as_text_cell(text) == f"'{text}"
    assert from_text_cell(as_text_cell(text)) == text


@pytest.mark.parametrize("text", ["stapes", "12", "-12", "+3.5", "1e-3", "", "a=b"])
def test_names_and_numbers_stay(text):
    assert as_text_cell(text) == text
    assert from_text_cell(text) == text


@pytest.mark.parametrize("text", ["'", "'stapes", "'-12", "''=1"])
def test_an_apostrophe_of_a_name_stays(text):
    assert from_text_cell(text) == text
