"""Files that change while they are read are refused."""

import pytest

from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.input_changes import refuse_changes


@pytest.mark.parametrize("change", ["12", ""])
@pytest.mark.parametrize("fails", [False, True])
def test_a_file_that_changes_is_refused_whatever_it_led_to(tmp_path, change, fails):
    path, missing = tmp_path / "a.csv", tmp_path / "b.csv"
    path.write_text("1")

    def read():
        with refuse_changes([path, missing, None]):
            path.write_text(change)
            if fails:
                raise ValueError("half a table")

    with pytest.raises(StapeskitError, match=r"left alone while it is read.*a\.csv"):
        read()


def test_what_fails_otherwise_fails_as_it_is(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("1")
    with pytest.raises(ValueError, match="no number"), refuse_changes([path]):
        raise ValueError("no number")
    with refuse_changes([path]) as states:
        pass
    assert path in states.states
