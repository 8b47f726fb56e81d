"""Outputs appear whole or not at all, and nothing of the user's is lost."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from stapeskit.faults import StapeskitError
from stapeskit.outputs import MANIFEST, Outputs


def written(folder: Path, text: str = "new", name: str = "a.json", **more: object) -> None:
    """Write one output as a command does."""
    inputs = [Path(str(path)) for path in more.pop("inputs", [])]  # type: ignore[attr-defined]
    outputs = Outputs("ct2mass", folder, (name, "b.txt"), inputs, **more)  # type: ignore[arg-type]
    with outputs.staged() as stage:
        (stage / name).write_text(text)


def test_an_own_output_is_replaced(tmp_path: Path) -> None:
    written(tmp_path / "out", "first")
    written(tmp_path / "out", "second")
    assert (tmp_path / "out" / "a.json").read_text() == "second"
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [MANIFEST, "a.json"]


def foreign(folder: Path) -> None:
    (folder / "a.json").write_text("mine")


def edited(folder: Path) -> None:
    written(folder, "first")
    (folder / "a.json").write_text("mine")


def link_to_a_foreign_file(folder: Path) -> None:
    (folder / "mine.txt").write_text("mine")
    (folder / "a.json").symlink_to(folder / "mine.txt")


def broken_link(folder: Path) -> None:
    (folder / "a.json").symlink_to(folder / "nowhere")


@pytest.mark.parametrize("prepare", [foreign, edited, link_to_a_foreign_file, broken_link])
def test_a_file_of_another_origin_is_refused_and_replaced_by_force_only(
    prepare: Callable[[Path], None], tmp_path: Path
) -> None:
    prepare(tmp_path)
    before = {path.name: path.is_file() and path.read_text() for path in tmp_path.iterdir()}
    with pytest.raises(StapeskitError):
        written(tmp_path)
    assert {path.name: path.is_file() and path.read_text() for path in tmp_path.iterdir()} == before
    written(tmp_path, force=True)
    assert (tmp_path / "a.json").read_text() == "new"
    if (tmp_path / "mine.txt").exists():
        assert (tmp_path / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize("make", [lambda a, b: b.write_text(a.read_text()), Path.symlink_to, os.link])
def test_an_input_is_never_replaced(make: Callable[[Path, Path], object], tmp_path: Path) -> None:
    source = tmp_path / "data" / "a.json"
    source.parent.mkdir()
    source.write_text("input")
    target = tmp_path / "out" / "a.json"
    target.parent.mkdir()
    if make is Path.symlink_to:
        target.symlink_to(source)
    elif make is os.link:
        os.link(source, target)
    else:
        target = source
    with pytest.raises(StapeskitError) as raised:
        written(target.parent, inputs=[source], force=True)
    assert raised.value.faults[0].expected == "another file than the inputs"
    assert source.read_text() == "input"


def test_a_file_within_an_input_folder_is_an_input(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("slice")
    with pytest.raises(StapeskitError):
        written(tmp_path, inputs=[tmp_path], force=True)


def test_a_failed_run_changes_nothing(tmp_path: Path) -> None:
    written(tmp_path / "out", "first")

    def interrupted() -> None:
        with Outputs("ct2mass", tmp_path / "out", ("a.json",), ()).staged() as stage:
            (stage / "a.json").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert (tmp_path / "out" / "a.json").read_text() == "first"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_what_appears_while_the_command_works_is_not_replaced(tmp_path: Path) -> None:

    def overtaken() -> None:
        with Outputs("ct2mass", tmp_path, ("a.json",), ()).staged() as stage:
            (stage / "a.json").write_text("new")
            (tmp_path / "a.json").write_text("mine")

    with pytest.raises(StapeskitError):
        overtaken()
    assert (tmp_path / "a.json").read_text() == "mine"


def test_outputs_of_an_earlier_run_that_are_not_written_again_go(tmp_path: Path) -> None:
    written(tmp_path, name="a.json")
    with Outputs("ct2mass", tmp_path, ("a.json", "c.json"), ()).staged() as stage:
        (stage / "c.json").write_text("new")
    assert sorted(path.name for path in tmp_path.iterdir()) == [MANIFEST, "c.json"]


def test_a_folder_in_the_way_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").mkdir()
    with pytest.raises(StapeskitError):
        written(tmp_path, force=True)
    (tmp_path / "file").write_text("x")
    with pytest.raises(StapeskitError):
        written(tmp_path / "file" / "out")


@pytest.mark.parametrize("text", ["", "[]", "{", '{"ct2mass": 3}', "\x00"])
def test_a_damaged_record_makes_every_output_foreign(text: str, tmp_path: Path) -> None:
    written(tmp_path, "first")
    (tmp_path / MANIFEST).write_text(text)
    with pytest.raises(StapeskitError):
        written(tmp_path)


def test_unchanged_tells_edited_and_missing_outputs(tmp_path: Path) -> None:
    written(tmp_path)
    outputs = Outputs("ct2mass", tmp_path, ("a.json",), ())
    assert outputs.unchanged()
    (tmp_path / "a.json").write_text("edited")
    assert not outputs.unchanged()
    (tmp_path / "a.json").unlink()
    assert not outputs.unchanged()
    assert not Outputs("dof2kd", tmp_path, ("a.json",), ()).unchanged()
