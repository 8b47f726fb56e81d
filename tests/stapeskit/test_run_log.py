"""The log file of a command."""

from __future__ import annotations

import os

import pytest

from legacy.stapeskit import run_log
from legacy.stapeskit.command import Outcome, show
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.option_parser import Parser
from legacy.stapeskit.warnings import Notice


def test_runs_are_appended_with_what_they_said(tmp_path, capsys):
    log = tmp_path / "ear.log"
    for words in (["--log", str(log)], ["--quiet", "--log", str(log)]):
        given = Parser("try", "", "").parse(words)
        run_log.note("reading")
        show(given, Outcome("title", [("mass", "3 mg")], [Notice("dc_line", "one line dropped")]))
        run_log.end(0)
    run_log.note("nobody listens")
    text = log.read_text(encoding="utf-8")
    assert text.startswith("# log of stapeskit\n")
    for part in (
        " try --log",
        "stapeskit 0.",
        "s  reading",
        "[dc_line] one line",
        "mass  3 mg",
        "exit code 0",
    ):
        assert text.count(part) == 2 - (part == " try --log"), part
    assert "nobody listens" not in text
    assert "3 mg" in capsys.readouterr().out


def test_another_file_is_never_written_to(tmp_path):
    other = tmp_path / "notes.log"
    other.write_text("mine", encoding="utf-8")
    with pytest.raises(StapeskitError):
        Parser("try", "", "").parse(["--log", str(other)])
    assert other.read_text(encoding="utf-8") == "mine"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have names on POSIX only")
def test_a_pipe_is_no_log(tmp_path):
    os.mkfifo(tmp_path / "pipe.log")
    with pytest.raises(StapeskitError):
        Parser("try", "", "").parse(["--log", str(tmp_path / "pipe.log")])
