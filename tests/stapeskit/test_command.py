"""What all commands share: options, messages, exit codes."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pytest

from legacy.stapeskit.command import Outcome, show
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.process import run
from legacy.stapeskit.warnings import Notice


def leave(capsys, work, monkeypatch, arguments=()):
    monkeypatch.setattr("sys.argv", ["tool", *arguments])
    monkeypatch.setattr("legacy.stapeskit.process.listen", lambda _prog: None)
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


def test_outcome_is_a_table_or_json(capsys, monkeypatch):
    outcome = Outcome("tool", [("mass", "3.2 mg")], [Notice("code", "Text.")], [Path("a.csv")], {"mass": 3.2})

    def work(arguments):
        return argparse.Namespace(quiet="quiet" in arguments, json="json" in arguments), outcome

    code, printed = leave(capsys, work, monkeypatch)
    assert code == 0
    assert "mass  3.2 mg" in printed.out
    assert "a.csv" in printed.out
    assert "warning [code] Text." in printed.err
    code, printed = leave(capsys, work, monkeypatch, ["json"])
    assert json.loads(printed.out) == {"mass": 3.2}
    code, printed = leave(capsys, work, monkeypatch, ["quiet"])
    assert printed.out == printed.err == ""


def test_work_that_printed_itself_needs_no_table(capsys, monkeypatch):
    code, printed = leave(capsys, lambda _arguments: None, monkeypatch)
    assert (code, printed.out) == (0, "")


def test_show_keeps_quiet(capsys):
    show(argparse.Namespace(quiet=True, json=False), Outcome("t", []))
    assert capsys.readouterr().out == ""


HOSTILE = "ear\x1b]0;owned\x07\x9b2J\r\u202egpj.\n"
SHOWN = "ear?]0;owned??2J??gpj.\n"


def test_no_text_of_a_file_gives_orders_to_the_terminal(capsys, monkeypatch):
    _, said = leave(capsys, raiser(StapeskitError(HOSTILE)), monkeypatch)
    assert said.err == f"{SHOWN}\n"
    outcome = Outcome("tool", [("name", HOSTILE)], [Notice("touches_border", HOSTILE)], [Path(HOSTILE)])
    show(argparse.Namespace(quiet=False, json=False), outcome)
    said = capsys.readouterr()
    assert said.err == f"warning [touches_border] {SHOWN}\n"
    assert said.out.count(SHOWN) == 2
    assert not set(said.out) & set("\x1b\x07\x9b\r\u202e")
