"""Temporary folders of killed runs are removed by the next run, those of running ones are not."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from legacy.stapeskit.outputs import stage_outputs
from legacy.stapeskit.provenance import content_hash
from legacy.stapeskit.temporary_folders import _open, files_within, scratch

ROOT = Path(__file__).resolve().parents[2]
HOLD = """
from pathlib import Path
from legacy.stapeskit.temporary_folders import scratch
with scratch(Path('.')) as folder:
    (folder / 'half').write_text('half')
    print('at work', flush=True)
    input()
"""


def hold(folder):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "at work\n"
    return process


def age(folder, seconds=3600.0):
    for path in folder.glob("*stapeskit-*"):
        then = time.time() - seconds
        os.utime(path, (then, then))


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_what_a_killed_run_left_is_removed_and_a_running_one_keeps_its_folder(tmp_path):
    killed, running = hold(tmp_path), hold(tmp_path)
    killed.kill()
    killed.communicate()
    kept = [path for path in tmp_path.iterdir() if path.stat().st_mtime]
    assert len(kept) == 2
    with scratch(tmp_path):
        assert len(names(tmp_path)) == 3  # fresh ones stay: their lock may be about to be taken
    age(tmp_path)
    with scratch(tmp_path):
        assert len(names(tmp_path)) == 2
    running.communicate("\n")
    assert names(tmp_path) == []


def test_files_of_a_folder_are_those_of_no_run(tmp_path):
    (tmp_path / "b").write_text("b")
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / ".stapeskit").write_text("an output's record is no temporary folder")
    before = content_hash(tmp_path)
    with scratch(tmp_path) as folder:
        (folder / "half").write_text("half")
        assert [path.name for path in files_within(tmp_path)] == [".stapeskit", "b"]
        assert content_hash(tmp_path) == before


def test_foreign_folders_of_such_a_name_stay(tmp_path):
    for name in (".stapeskit-notes", ".stapeskit-12345678", ".stapeskit-abcdefgh-more"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine.txt").write_text("mine")
    (tmp_path / ".stapeskit-abcdefgh").write_text("a file")
    (tmp_path / ".stapeskit-analysis").mkdir()
    (tmp_path / "stapeskit-analysis").mkdir()
    (tmp_path / ".stapeskit-linked00").symlink_to(tmp_path / ".stapeskit-notes")
    before = names(tmp_path)
    age(tmp_path)
    with scratch(tmp_path):
        pass
    assert names(tmp_path) == before
    assert (tmp_path / ".stapeskit-12345678" / "mine.txt").exists()


def test_outputs_remove_what_the_run_that_made_their_folder_left_beside_it(tmp_path):
    (tmp_path / ".stapeskit-abcdefgh").mkdir(0o700)
    (tmp_path / "out").mkdir()
    age(tmp_path)
    with stage_outputs(tmp_path / "out") as stage:
        (stage / "a").write_text("1")
    assert names(tmp_path) == ["out"]


def test_an_empty_folder_of_a_run_that_was_killed_at_once_is_removed(tmp_path):
    (tmp_path / ".stapeskit-abcdefgh").mkdir(0o700)
    age(tmp_path)
    with scratch(tmp_path):
        pass
    assert names(tmp_path) == []


def test_a_folder_whose_removal_was_cut_short_is_removed(tmp_path, monkeypatch):
    def killed(path, **_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("legacy.stapeskit.temporary_folders.shutil.rmtree", killed)
        with suppress(KeyboardInterrupt), scratch(tmp_path) as folder:
            (folder / "half").write_text("half")
    (left,) = tmp_path.iterdir()
    for path in sorted(left.rglob("*"), reverse=True):
        _open.clear()
        age(tmp_path)
        copy = tmp_path.parent / "copy"
        shutil.copytree(tmp_path, copy)
        age(copy)
        with scratch(copy):
            pass
        assert names(copy) == []
        shutil.rmtree(copy)
        if path.name != "stapeskit-temporary":
            path.rmdir() if path.is_dir() else path.unlink()


def test_a_folder_that_could_not_be_removed_is_removed_by_the_next_run(tmp_path, monkeypatch):
    """With no file descriptor left, what is within cannot be listed and stays; other files go."""

    def starved(path, **_):
        if Path(path).name != "files":
            (Path(path) / "stapeskit-temporary").unlink()

    with monkeypatch.context() as patch, scratch(tmp_path) as folder:
        (folder / "half").write_text("half")
        patch.setattr(shutil, "rmtree", starved)
    left = folder.parent.name
    assert names(tmp_path) == [left]
    age(tmp_path)
    with scratch(tmp_path):
        assert left not in names(tmp_path)
