"""What all commands share: options, messages, exit codes."""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path

import pytest

from stapeskit.command import Outcome, Parser, numbers, run, show, value_with_sd
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice


@pytest.fixture
def parser():
    made = Parser("tool", "A tool.")
    made.add_argument("scan", type=Path)
    made.add_argument("--anterior", type=numbers(3, "--anterior"))
    made.add_argument("--add-mass", type=numbers(4), action="append")
    made.add_argument("--side", choices=("left", "right"))
    made.add_argument("--report", action="store_true")
    made.add_config()
    return made


def test_minus_lists_in_both_forms(parser):
    for words in (["s.tif", "--anterior", "-0.9,0.1,0"], ["s.tif", "--anterior=-0.9,0.1,0"]):
        assert parser.parse(words).anterior == (-0.9, 0.1, 0.0)


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["s.tif", "--antrior", "1,0,0"], "Did you mean --anterior"),
        (["s.tif", "--zzzzzz"], "--help"),
        (["s.tif", "--anterior", "1,0"], "3 finite numbers"),
        (["s.tif", "--anterior", "1,0,nan"], "3 finite numbers"),
        (["s.tif", "--anterior", "a,b,c"], "3 finite numbers"),
        (["s.tif", "--side", "middle"], "--side must be one of left, right; got middle"),
        ([], "required"),
        (["s.tif", "--anterior"], "expected one argument"),
        (["s.tif", "--config", "nowhere.toml"], "an existing TOML file"),
    ],
)
def test_usage_faults_are_one_sentence(parser, words, match):
    with pytest.raises(StapeskitError, match=match):
        parser.parse(words)


def test_config_gives_defaults_and_the_line_wins(parser, tmp_path):
    path = tmp_path / "c.toml"
    path.write_text(
        'anterior = [-1, 0, 0]\nside = "left"\nreport = true\nadd-mass = [[0, 1, 2, 0.1], [1, 1, 1, 0.2]]\n'
    )
    found = parser.parse(["s.tif", "--config", str(path), "--side", "right"])
    assert found.anterior == (-1.0, 0.0, 0.0)
    assert found.side == "right"
    assert found.report is True
    assert found.add_mass == [(0.0, 1.0, 2.0, 0.1), (1.0, 1.0, 1.0, 0.2)]
    assert parser.parse(["s.tif", f"--config={path}"]).side == "left"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("anteror = [1, 0, 0]", r"Did you mean anterior\?$"),
        ("side = 'up'", "one of left, right"),
        ("report = 3", "true or false"),
        ("anterior = [1, 0]", "3 finite numbers"),
        ("= 3", "valid TOML"),
    ],
)
def test_faults_of_a_config_are_named(parser, tmp_path, text, match):
    path = tmp_path / "c.toml"
    path.write_text(text)
    with pytest.raises(StapeskitError, match=match):
        parser.parse(["s.tif", "--config", str(path)])


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("--anteri", "Did you mean --anterior?"),
        ("--densty", "--help"),
        ("--foo", "--help"),
        ("--sid", "--side?"),
    ],
)
def test_only_near_options_are_suggested(parser, word, said):
    with pytest.raises(StapeskitError, match=re.escape(said)):
        parser.parse(["s.tif", word])


def test_values_with_sd():
    assert value_with_sd("1900+-20") == (1900.0, 20.0)
    assert value_with_sd("1900±20") == (1900.0, 20.0)
    assert value_with_sd("3.2") == (3.2, None)
    for text in ("-1", "1+-", "1+-2+-3", "nan", "inf", "1+--2", "x"):
        with pytest.raises(argparse.ArgumentTypeError, match="positive number"):
            value_with_sd(text)


def leave(capsys, work, monkeypatch, arguments=()):
    monkeypatch.setattr("sys.argv", ["tool", *arguments])
    with pytest.raises(SystemExit) as caught:
        run("tool", work)
    return caught.value.code, capsys.readouterr()


def raiser(fault):
    def work(_arguments):
        raise fault

    return work


@pytest.mark.parametrize(
    ("fault", "code", "said"),
    [
        (StapeskitError("the scan must be 3D; got 2D."), 2, "the scan must be 3D"),
        (KeyboardInterrupt(), 130, "nothing was written"),
        (MemoryError(), 2, "not enough memory"),
        (BrokenPipeError(), 0, ""),
        (ZeroDivisionError("x"), 1, "this is a bug in stapeskit"),
    ],
)
def test_exit_codes(capsys, monkeypatch, fault, code, said):
    left, printed = leave(capsys, raiser(fault), monkeypatch)
    assert left == code
    assert said in printed.err
    assert ("Traceback" in printed.err) == (code == 1)


def test_outcome_is_a_table_or_json(capsys, monkeypatch, parser):
    outcome = Outcome("tool", [("mass", "3.2 mg")], [Notice("code", "Text.")], [Path("a.csv")], {"mass": 3.2})

    def work(arguments):
        return parser.parse(arguments), outcome

    code, printed = leave(capsys, work, monkeypatch, ["s.tif"])
    assert code == 0
    assert "mass  3.2 mg" in printed.out
    assert "a.csv" in printed.out
    assert "warning [code] Text." in printed.err
    code, printed = leave(capsys, work, monkeypatch, ["s.tif", "--json"])
    assert json.loads(printed.out) == {"mass": 3.2}
    code, printed = leave(capsys, work, monkeypatch, ["s.tif", "--quiet"])
    assert printed.out == printed.err == ""


def test_work_that_printed_itself_needs_no_table(capsys, monkeypatch):
    code, printed = leave(capsys, lambda _arguments: None, monkeypatch)
    assert (code, printed.out) == (0, "")


def test_version_and_help_end_well(parser):
    for word in ("--help", "--version"):
        with pytest.raises(SystemExit) as caught:
            parser.parse([word])
        assert caught.value.code == 0


def test_show_keeps_quiet(capsys):
    show(argparse.Namespace(quiet=True, json=False), Outcome("t", []))
    assert capsys.readouterr().out == ""


def test_all_usage_faults_are_told_together(parser, tmp_path):
    config = tmp_path / "c.toml"
    config.write_text('report = 3\nsidd = "left"\nanterior = [1, 0]\n')
    words = ["s.tif", "--side", "up", "--add-mass", "1,2", "--add-mass=0,0,0,1", "--add-mass=a", "--anterior"]
    with pytest.raises(StapeskitError) as caught:
        parser.parse([*words, "--config", str(config), "--rport", "--zzzzzz=4"])
    told = str(caught.value).splitlines()
    expected = [
        "report must be true or false; got 3 (c.toml)",
        "a key of --config must be an option of the command; got sidd (c.toml). Did you mean side",
        "must be 3 finite numbers separated by commas; got 1,0 (c.toml)",
        "--side must be one of left, right; got up",
        "must be 4 finite numbers separated by commas; got 1,2",
        "must be 4 finite numbers separated by commas; got a.",
        "--anterior: expected one argument",
        "--rport must be a known option or argument; got an unknown one. Did you mean --report?",
        "--zzzzzz=4 must be a known option or argument; got an unknown one.",
    ]
    assert len(told) == len(expected)
    for words in expected:
        assert sum(words in line for line in told) == 1


def test_words_in_place_of_a_number_are_told_alike_on_the_line_and_in_a_config(tmp_path):
    made = Parser("fit", "Fit.")
    made.add_config()
    made.add_argument("--sd", type=float)
    made.add_argument("--count", type=int)
    (tmp_path / "c.toml").write_text('sd = "wide"\ncount = 1.5\n')
    with pytest.raises(StapeskitError) as caught:
        made.parse(["--sd", "wide", "--count=few", "--config", str(tmp_path / "c.toml")])
    assert sorted(str(caught.value).splitlines()) == [
        "count must be a whole number; got 1.5 (c.toml).",
        "fit: --count must be a whole number; got few.",
        "fit: --sd must be a number; got wide.",
        "sd must be a number; got wide (c.toml).",
    ]
