"""Every declared option: its value survives command line, TOML and template; help and page follow from it."""

from __future__ import annotations

import json
import os
import tomllib
from pathlib import Path

import pytest

from legacy.ct_inertia.cli import parser as ct2mass
from legacy.fitting.cli import parser as dof2kd
from legacy.kinematics.cli import parser as points2dof
from legacy.pipeline.cli import parser as scan2kd
from legacy.pipeline.options_page import COMMANDS, options_page
from legacy.pipeline.study import TABLES
from legacy.pipeline.template import TEMPLATE
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.option_docs import example_of
from legacy.stapeskit.option_values import toml
from legacy.stapeskit.options import declared

ROOT = Path(__file__).parents[2]
PARSERS = {"ct2mass": ct2mass, "points2dof": points2dof, "dof2kd": dof2kd, "scan2kd": scan2kd}
EVERY = [
    pytest.param(one, id=f"{command}-{one.name}")
    for command, tables in COMMANDS.items()
    for table in tables
    for one in declared(table)
]
OF_STUDIES = [
    pytest.param(one, id=one.place) for table in TABLES.values() for one in declared(table) if one.table
]


def value_of(one):
    """A value of an option: of its example, or its default."""
    example = True if one.kind.is_flag else example_of(one) if one.name != "studies" else "study.toml"
    return one.kind.read(example)


@pytest.mark.parametrize("one", EVERY)
def test_a_value_is_the_same_from_the_command_line(one):
    value = value_of(one)
    if not one.kind.is_flag:
        words = one.kind.words(value)
        assert one.kind.read(words if one.kind.repeats else words[0]) == value


@pytest.mark.parametrize("one", [*EVERY, *OF_STUDIES])
def test_a_value_is_the_same_from_toml(one):
    value = value_of(one)
    assert one.kind.read(tomllib.loads(f"key = {toml(value)}")["key"]) == value
    assert one.kind.read(value) == value


@pytest.mark.parametrize("one", EVERY)
def test_a_default_is_a_value_of_its_kind(one):
    if one.default is not None:
        assert one.kind.read(one.default) == one.default


@pytest.mark.parametrize("one", EVERY)
@pytest.mark.parametrize("wrong", [object(), float("nan"), [[]], {"a": object()}])
def test_an_unfit_value_is_refused(one, wrong):
    with pytest.raises((ValueError, TypeError)):
        one.kind.read(wrong)


def test_a_decimal_comma_is_explained():
    one = next(entry.values[0] for entry in EVERY if entry.values[0].name == "density")
    assert one.fault("1394,4").next_step == "Write a decimal point: 1394.4"
    assert one.fault("1,394").next_step == "Write 1394, or a decimal point: 1.394"
    assert one.fault("heavy").next_step == "Write for example 1900.0+-60.0"


def test_two_values_of_one_option_are_refused(tmp_path):
    (tmp_path / "scan.tif").touch()
    words = [str(tmp_path / "scan.tif"), "--density", "1900+-60"]
    assert PARSERS["ct2mass"]().parse([*words, "--density", "1900+-60"]).density == (1900.0, 60.0)
    with pytest.raises(StapeskitError) as refused:
        PARSERS["ct2mass"]().parse([*words, "--density", "1800+-60"])
    (fault,) = (one for one in refused.value.faults if one.thing == "--density")
    assert fault.got == "1900+-60 and 1800+-60"


def test_a_flag_without_its_no_is_recognised(tmp_path):
    (tmp_path / "a.toml").write_text("report = false\n", encoding="utf-8")
    with pytest.raises(StapeskitError) as refused:
        PARSERS["ct2mass"]().parse(["--density", "1900", "--config", str(tmp_path / "a.toml")])
    assert "Did you mean no-report?" in [fault.next_step for fault in refused.value.faults]


def test_a_mistyped_word_is_recognised():
    one = next(entry.values[0] for entry in EVERY if entry.values[0].name == "estimator")
    assert one.fault("pinw").next_step == "Did you mean pinv?"
    assert one.fault("neural", "fit.estimator").next_step == 'Write for example "ml"'


def test_the_mistyped_word_of_a_list_is_recognised():
    one = next(entry.values[0] for entry in EVERY if entry.id == "scan2kd-export")
    assert one.fault("csv,latx").next_step == "Did you mean latex?"
    assert one.fault(["csv", "xls"], "export").next_step == "Did you mean xlsx?"


@pytest.mark.parametrize("one", [*EVERY, *OF_STUDIES])
def test_the_fault_of_an_unfit_value_says_what_to_do(one):
    assert one.fault("?").next_step
    assert one.fault(1, one.place, "study.toml").next_step


@pytest.mark.parametrize("one", OF_STUDIES)
def test_the_template_has_every_key_with_a_value(one):
    line = f"{one.key} = {toml(example_of(one))}"
    assert line in TEMPLATE.splitlines() or f"# {line}" in TEMPLATE.splitlines()


@pytest.mark.parametrize("command", PARSERS)
def test_help_has_every_option_within_80_columns(command):
    text = PARSERS[command]().format_help()
    assert max(map(len, text.splitlines())) <= 80
    for table in COMMANDS[command]:
        for one in declared(table):
            assert one.flag in text


def test_names_of_a_command_are_different():
    for tables in COMMANDS.values():
        names = [one.name for table in tables for one in declared(table)]
        assert len(set(names)) == len(names)


def test_names_of_a_table_are_the_keys_without_their_units():
    for table in TABLES.values():
        for one in declared(table):
            assert one.positional or not one.table or one.key.startswith(one.name)


@pytest.mark.parametrize(("command", "file"), [("ct2mass", "SCAN"), ("points2dof", "LDV"), ("dof2kd", "DOF")])
def test_options_of_a_config_file_are_those_of_the_line(command, file, tmp_path, monkeypatch):
    """Every option on its own: the two ways give the same value, or the same refusal by a rule."""
    monkeypatch.chdir(tmp_path)
    for table in COMMANDS[command]:
        for one in declared(table):
            if one.positional or one.kind.is_file:
                continue
            value = value_of(one)
            Path("o.toml").write_text(f"{one.name.replace('_', '-')} = {toml(value)}\n")
            words = [one.flag] if one.kind.is_flag else [f"{one.flag}={w}" for w in one.kind.words(value)]
            assert outcome(command, words, one.field) == outcome(command, ["--config", "o.toml"], one.field)


def test_a_folder_as_config_file_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("o.toml").mkdir()
    with pytest.raises(StapeskitError, match="--config must be valid TOML; got Is a directory"):
        ct2mass().parse(["scan.tif", "--config", "o.toml"])


@pytest.mark.parametrize("command", ["ct2mass", "points2dof", "dof2kd"])
def test_two_hyphens_are_a_value_like_others(command):
    with pytest.raises(StapeskitError, match="--config must be an existing TOML file; got --"):
        PARSERS[command]().parse(["--config=--"])


def outcome(command, words, field):
    """The value that a parser reads, or the faults of what is missing beside it."""
    try:
        return getattr(PARSERS[command]().parse(words), field)
    except StapeskitError as error:
        return error.faults


def test_the_page_of_options_is_current():
    assert (ROOT / "docs" / "options.md").read_text(encoding="utf-8") == options_page(), "run make docs"


def test_parameters_of_the_provenance_are_json():
    for table in TABLES.values():
        one = table.__new__(table)
        for option in declared(table):
            object.__setattr__(one, option.field, value_of(option))
        parameters = one.parameters()
        assert json.loads(json.dumps(parameters, allow_nan=False)) == parameters


def test_an_unknown_keyword_names_the_nearest():
    with pytest.raises(StapeskitError) as caught:
        TABLES["fit"].of(estimatr="ml")
    (fault,) = caught.value.faults
    assert fault.got == "estimatr"
    assert "estimator" in fault.next_step


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have names on POSIX only")
def test_a_pipe_is_no_file(tmp_path):
    """A command that opened one would wait without end."""
    pipe = tmp_path / "scan.tif"
    os.mkfifo(pipe)
    scan = next(one for one in declared(TABLES["scan"]) if one.kind.is_file)
    assert [fault.got for fault in scan.missing_files(pipe, "the scan")] == [str(pipe)]
