"""TOML from anywhere is read or refused in a moment."""

import pytest

from legacy.stapeskit.json_toml import parse_toml


@pytest.mark.parametrize(
    "text", ["a" + ".a" * 100_000 + " = 1", "a" + ' . "a"' * 1000 + " = 1", "[" + "a." * 1000 + "a]"]
)
def test_a_key_of_very_many_parts_is_refused(text):
    with pytest.raises(ValueError, match="keys are nested too deeply"):
        parse_toml(text)


def test_dots_and_brackets_elsewhere_are_no_keys():
    numbers = ", ".join(["1.5"] * 1000)
    dots, brackets = "." * 500, "[" * 500
    text = f'notes = """{dots}\n{brackets}"""\nx = [{numbers}]\ny = "{dots}"  # {dots}\na.b.c = 1.5'
    read = parse_toml(text)
    assert len(read["x"]) == 1000
    assert read["a"] == {"b": {"c": 1.5}}


@pytest.mark.parametrize("text", ['"\\' * 200_000, "'''\\\"" * 50_000, '"""' + '"\\' * 200_000])
def test_strings_that_do_not_end_are_refused(text):
    with pytest.raises(ValueError, match=r"line 1|end of document"):
        parse_toml(text)
