"""The command stapeskit: its words, their help, and what it says to words that it does not know."""

import subprocess

import pytest

from legacy.pipeline.stapeskit_command import COMMANDS, work
from legacy.stapeskit.faults import StapeskitError

WORDS = ("sample", "figures", "completion")


def refused(*words):
    with pytest.raises(StapeskitError) as caught:
        work([*words])
    return caught.value.faults[0]


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"], ["help"], ["--version"]])
def test_help_and_version(words, capsys):
    assert work(words) is None
    assert "stapeskit" in capsys.readouterr().out


@pytest.mark.parametrize("word", WORDS)
def test_every_word_has_its_own_help(word, capsys):
    work([word, "--help"])
    text = capsys.readouterr().out
    assert text.startswith(f"usage: stapeskit {word}")
    assert max(map(len, text.splitlines())) <= 82


def test_help_lists_every_word(capsys):
    work([])
    text = capsys.readouterr().out
    assert all(f"  {word}" in text for word in (*COMMANDS, *WORDS))


def test_a_near_word_is_proposed():
    assert refused("sampel").next_step == "Did you mean sample?"
    assert "stapeskit --help" in refused("zzz").next_step


@pytest.mark.parametrize("words", [["sample"], ["sample", "a", "b"], ["figures", "a"], ["completion", "csh"]])
def test_words_that_miss_something(words):
    assert refused(*words).thing == f"stapeskit {words[0]}"


def test_sample_leaves_what_was_edited(tmp_path, capsys):
    work(["sample", str(tmp_path / "ear")])
    points = tmp_path / "ear" / "points.csv"
    own = points.read_text() + "\n"
    points.write_text(own)
    fault = refused("sample", str(tmp_path / "ear"))
    assert fault.next_step.startswith("Name another folder")
    assert points.read_text() == own
    work(["sample", str(tmp_path / "ear"), "--force"])
    assert points.read_text() != own
    assert "scan2kd" in capsys.readouterr().out


@pytest.mark.parametrize("word", COMMANDS)
def test_the_four_commands_by_their_words(word, capsys):
    with pytest.raises(SystemExit) as end:
        work([word, "--help"])
    assert end.value.code == 0
    assert capsys.readouterr().out.startswith(f"usage: {word}")


def test_completion_is_a_script_that_bash_reads(capsys):
    work(["completion", "bash"])
    script = capsys.readouterr().out
    subprocess.run(["bash", "-n"], input=script, text=True, check=True)
    assert "--density" in script
