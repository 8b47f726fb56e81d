"""A set of outputs replaces what it made itself, and nothing else."""

from __future__ import annotations

import os
from dataclasses import replace

import pytest

from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.own_files import FOREIGN_FILE_KEPT, RECORDS, OutputSet


def outputs(folder, **more):
    return OutputSet("command", folder, ("a.json", "b.ply"), leftovers=("c.stl",), **more)


def write(made, **files):
    made.check()
    with made.staged() as stage:
        for name, text in files.items():
            (stage / name.replace("_", ".")).write_text(text)


def contents(folder):
    """Every file but the records."""
    files = [path for path in folder.rglob("*") if path.is_file() and RECORDS not in path.parts]
    return {str(path.relative_to(folder)): path.read_text(encoding="utf-8") for path in files}


def refused(made, words):
    before = contents(made.folder)
    with pytest.raises(StapeskitError, match=words) as caught:
        made.check()
    with pytest.raises(StapeskitError, match=words):
        write(replace(made), a_json="never", b_ply="never")
    assert contents(made.folder) == before
    return [str(fault) for fault in caught.value.faults]


def test_own_outputs_are_replaced_and_own_leftovers_removed(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    write(outputs(tmp_path), a_json="1", b_ply="1", c_stl="1")
    write(outputs(tmp_path), a_json="2")
    assert contents(tmp_path) == {"a.json": "2", "notes.txt": "mine"}


def test_the_record_moves_with_the_folder(tmp_path):
    write(outputs(tmp_path / "x"), a_json="1", b_ply="1")
    (tmp_path / "x").rename(tmp_path / "y")
    write(outputs(tmp_path / "y"), a_json="2", b_ply="2")
    assert contents(tmp_path / "y") == {"a.json": "2", "b.ply": "2"}


@pytest.mark.parametrize("name", ["a.json", "b.ply"])
def test_a_foreign_file_is_replaced_by_force_alone(tmp_path, name):
    (tmp_path / name).write_text("theirs")
    (fault,) = refused(outputs(tmp_path), "not known to have written.*--force")
    assert name in fault
    write(outputs(tmp_path, force=True), a_json="1", b_ply="1")
    assert contents(tmp_path) == {"a.json": "1", "b.ply": "1"}
    write(outputs(tmp_path), a_json="2", b_ply="2")


def test_an_edited_output_is_foreign_until_it_is_restored(tmp_path):
    write(outputs(tmp_path), a_json="1", b_ply="1")
    (tmp_path / "b.ply").write_text("edited")
    (fault,) = refused(outputs(tmp_path, hints={"b.ply": "Ask first"}), "b.ply, edited since")
    assert "Ask first" in fault
    (tmp_path / "b.ply").write_text("1")
    write(outputs(tmp_path), a_json="2", b_ply="2")


def test_what_another_command_wrote_is_foreign(tmp_path):
    write(outputs(tmp_path), a_json="1", b_ply="1")
    refused(replace(outputs(tmp_path), command="other"), "not known to have written")
    write(replace(outputs(tmp_path), command="other", names=("z.json",)), z_json="1")
    write(outputs(tmp_path), a_json="2", b_ply="2")


def test_foreign_files_that_are_not_written_stay_and_are_named(tmp_path):
    (tmp_path / "c.stl").write_text("theirs")
    (tmp_path / "b.ply").write_text("theirs")
    refused(outputs(tmp_path), "b.ply")
    made = outputs(tmp_path, force=True)
    write(made, a_json="1")
    assert contents(tmp_path) == {"a.json": "1", "b.ply": "theirs", "c.stl": "theirs"}
    (notice,) = made.kept_notices(["a.json"])
    assert notice.code == FOREIGN_FILE_KEPT
    assert "b.ply and c.stl" in notice.text
    assert outputs(tmp_path, inputs=(tmp_path / "b.ply", tmp_path / "c.stl")).kept_notices(["a.json"]) == ()


@pytest.mark.parametrize("link", [None, os.symlink, os.link])
@pytest.mark.parametrize("force", [False, True])
def test_an_input_is_never_replaced(tmp_path, link, force):
    folder = tmp_path / "out"
    folder.mkdir()
    given = folder / "b.ply" if link is None else tmp_path / "input.ply"
    given.write_text("read")
    if link is not None:
        link(given, folder / "b.ply")
    (fault,) = refused(outputs(folder, inputs=(given,), force=force), "another file than the inputs")
    assert str(given) in fault
    assert given.read_text(encoding="utf-8") == "read"


def test_inputs_and_foreign_files_are_told_together(tmp_path):
    for name in ("a.json", "b.ply"):
        (tmp_path / name).write_text("theirs")
    read, foreign = refused(outputs(tmp_path, inputs=(tmp_path / "b.ply",)), "--force")
    assert "b.ply" in read
    assert "a.json" in foreign
    assert "b.ply" not in foreign


@pytest.mark.parametrize("force", [False, True])
def test_an_own_output_that_is_read_is_neither_replaced_nor_removed(tmp_path, force):
    write(outputs(tmp_path), a_json="1", b_ply="1", c_stl="1")
    refused(outputs(tmp_path, inputs=(tmp_path / "b.ply",), force=force), "another file than the inputs")
    write(outputs(tmp_path, inputs=(tmp_path / "c.stl",), force=force), a_json="2", b_ply="2")
    assert contents(tmp_path) == {"a.json": "2", "b.ply": "2", "c.stl": "1"}


def test_a_file_within_a_folder_that_is_read_is_not_replaced_by_force(tmp_path):
    (tmp_path / "slices").mkdir()
    (tmp_path / "slices" / "b.ply").write_text("slice")
    for folder in (tmp_path / "slices", tmp_path / "linked"):
        if folder.name == "linked":
            folder.mkdir()
            os.link(tmp_path / "slices" / "b.ply", folder / "b.ply")
        refused(outputs(folder, inputs=(tmp_path / "slices",), force=True), "another file than the inputs")


@pytest.mark.parametrize("force", [False, True])
def test_folders_and_links_at_the_names_of_outputs(tmp_path, force):
    (tmp_path / "a.json").mkdir()
    refused(outputs(tmp_path, force=force), "must be a file; got a folder")
    (tmp_path / "a.json").rmdir()
    (tmp_path / "elsewhere").write_text("theirs")
    (tmp_path / "a.json").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "b.ply").symlink_to(tmp_path / "nowhere")
    if not force:
        refused(outputs(tmp_path), "a.json and b.ply")
    else:
        write(outputs(tmp_path, force=True), a_json="1", b_ply="1")
        assert (tmp_path / "elsewhere").read_text(encoding="utf-8") == "theirs"
        assert not (tmp_path / "nowhere").exists()


def test_a_file_that_appears_while_the_command_works_is_not_replaced(tmp_path):
    made = outputs(tmp_path / "out")
    made.check()

    def work():
        with made.staged() as stage:
            (stage / "a.json").write_text("1")
            (tmp_path / "out").mkdir()
            (tmp_path / "out" / "a.json").write_text("theirs")

    with pytest.raises(StapeskitError, match=r"a\.json"):
        work()
    assert contents(tmp_path) == {"out/a.json": "theirs"}


def test_a_failed_run_leaves_files_and_record_as_they_were(tmp_path):
    write(outputs(tmp_path), a_json="1", b_ply="1")

    def fail():
        with outputs(tmp_path).staged() as stage:
            (stage / "a.json").write_text("2")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert contents(tmp_path) == {"a.json": "1", "b.ply": "1"}
    write(outputs(tmp_path), a_json="3", b_ply="3")


def test_a_run_that_is_killed_between_two_files_leaves_only_known_ones(tmp_path, monkeypatch):
    write(outputs(tmp_path), a_json="1", b_ply="1")
    move = os.replace

    def killed(source, target):
        if target == tmp_path / "b.ply":
            raise KeyboardInterrupt
        move(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            write(outputs(tmp_path), a_json="2", b_ply="2")
    assert contents(tmp_path) == {"a.json": "2", "b.ply": "1"}
    write(outputs(tmp_path), a_json="3", b_ply="3")
    assert contents(tmp_path) == {"a.json": "3", "b.ply": "3"}


@pytest.mark.parametrize(
    "text", ["", "[]", '{"schema": "x"}', '{"schema": "stapeskit.outputs/1", "files": 3}', "[" * 100_000]
)
def test_a_damaged_record_knows_nothing(tmp_path, text):
    write(outputs(tmp_path), a_json="1", b_ply="1")
    (tmp_path / RECORDS / "command-a.json.json").write_text(text)
    refused(outputs(tmp_path), "a.json and b.ply, which it is not known to have written")


def test_a_file_in_the_place_of_the_records_or_the_folder(tmp_path):
    (tmp_path / RECORDS).write_text("mine")
    refused(outputs(tmp_path), "must be the folder of records")
    (tmp_path / "out").write_text("mine")
    with pytest.raises(StapeskitError, match="must be a folder"):
        outputs(tmp_path / "out").check()


def test_long_names_have_a_record_too(tmp_path):
    name = "x" * 240 + ".csv"
    for _ in range(2):
        made = OutputSet("command", tmp_path, (name,))
        made.check()
        with made.staged() as stage:
            (stage / name).write_text("1")


def test_names_that_no_file_can_have_are_told_before_the_work(tmp_path):
    made = OutputSet("command", tmp_path, ("x.csv", "x" * 244 + ".channels.csv"))
    with pytest.raises(StapeskitError, match="the name of an output must be of at most 255 bytes"):
        made.check()


def test_records_are_not_written_through_a_link(tmp_path):
    notes = tmp_path / "notes"
    notes.mkdir()
    (notes / "command-a.json.json").write_text("mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / RECORDS).symlink_to(notes)
    made = outputs(tmp_path / "out", force=True)
    with pytest.raises(StapeskitError, match="must be the folder of records; got a link"):
        made.check()
    with pytest.raises(StapeskitError, match="must be the folder of records; got a link"):
        write(made, a_json="never")
    assert (notes / "command-a.json.json").read_text(encoding="utf-8") == "mine"


def test_names_of_no_utf8_are_recorded(tmp_path):
    name = os.fsdecode(b"\xff.json")
    made = OutputSet("command", tmp_path, (name,))
    for text in ("1", "2"):
        made.check()
        with made.staged() as stage:
            (stage / name).write_text(text)
    assert contents(tmp_path) == {name: "2"}
