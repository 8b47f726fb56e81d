"""Names of options in the words of the edge that a person uses."""

from __future__ import annotations

import pytest

from legacy import stapeskit
from legacy.pipeline.study import words
from legacy.stapeskit.faults import Fault, StapeskitError, translate_option_names
from legacy.stapeskit.option_names import as_command, as_keyword, named, use_vocabulary, written


def test_an_option_is_named_as_on_the_command_line_unless_an_edge_says_otherwise():
    assert named("header_bytes") == "--header-bytes"
    with use_vocabulary(as_keyword):
        assert named("header_bytes") == "header_bytes"
        with use_vocabulary(as_command):
            assert named("box") == "--box"
        assert named("box") == "box"
    assert named("box") == "--box"


@pytest.mark.parametrize(
    ("table", "text", "expected"),
    [
        ("scan", "Give {spacing}.", "Give scan.spacing_mm."),
        ("ldv", "{mirror} x or {seed} X,Y,Z", "ldv.mirror x or scan.seed_mm X,Y,Z"),
        ("fit", "{robust} t4 needs {band}", "fit.robust t4 needs fit.band_hz"),
        (
            "ldv",
            "{axes_sd}, {plate_points}, {gain_sd}",
            "ldv.axes_sd_deg, ldv.plate_points, ldv.gain_sd_percent",
        ),
        (
            "scan",
            "{shape} and {header_bytes}; see --no-such",
            "scan.shape and scan.header_bytes; see --no-such",
        ),
    ],
)
def test_a_study_names_its_keys_and_looks_in_the_table_of_the_stage_first(table, text, expected):
    assert written(text, words(table)) == expected


def test_errors_leave_an_edge_in_its_words():
    with pytest.raises(StapeskitError) as caught, translate_option_names(words("scan")):
        raise StapeskitError(Fault("{box}", "inside the scan", "{x}", "", f"Give {named('seed')}"))
    assert caught.value.faults == (Fault("scan.box_mm", "inside the scan", "{x}", "", "Give scan.seed_mm"),)


def test_a_notebook_reads_keywords(tmp_path):
    with pytest.raises(StapeskitError) as caught:
        stapeskit.ct2mass(tmp_path / "none.tif", spacing=(1, 2))
    assert "--" not in str(caught.value)
