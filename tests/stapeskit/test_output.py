"""Outputs appear whole or not at all; provenance names what a result was made from."""

from __future__ import annotations

import errno
import hashlib
from importlib import metadata

import pytest

from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.outputs import stage_outputs
from legacy.stapeskit.provenance import Hashes, content_hash, input_record, record, versions


def test_outputs_replace_old_ones_at_once(tmp_path):
    folder = tmp_path / "a" / "b"
    with stage_outputs(folder) as stage:
        (stage / "x.txt").write_text("new")
        (stage / "sub").mkdir()
        (stage / "sub" / "y.txt").write_text("deep")
        assert not folder.exists()
    assert (folder / "x.txt").read_text(encoding="utf-8") == "new"
    assert (folder / "sub" / "y.txt").read_text(encoding="utf-8") == "deep"
    with stage_outputs(folder) as stage:
        (stage / "x.txt").write_text("newer")
    assert (folder / "x.txt").read_text(encoding="utf-8") == "newer"
    assert sorted(p.name for p in tmp_path.rglob(".stapeskit*")) == []


@pytest.mark.parametrize("fault", [RuntimeError, KeyboardInterrupt])
def test_failure_leaves_nothing(tmp_path, fault):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "x.txt").write_text("old")

    def work():
        with stage_outputs(folder) as stage:
            (stage / "x.txt").write_text("half")
            (stage / "y.txt").write_text("half")
            raise fault

    with pytest.raises(fault):
        work()
    assert [p.name for p in tmp_path.rglob("*")] == ["out", "x.txt"]
    assert (folder / "x.txt").read_text(encoding="utf-8") == "old"


def test_failure_makes_no_folder(tmp_path):
    with pytest.raises(RuntimeError), stage_outputs(tmp_path / "new" / "deep"):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / "out").write_text("a file")
    with (
        pytest.raises(StapeskitError, match="must be a folder; got the file"),
        stage_outputs(tmp_path / "out" / "deep"),
    ):
        pass


@pytest.mark.parametrize(
    "fault",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        RuntimeError(
            "Can't decrement id ref count (file write failed: errno = 28, error message = 'No space')"
        ),
    ],
)
def test_a_full_disk_is_told_and_leaves_the_old_files(tmp_path, fault):
    (tmp_path / "x.txt").write_text("old")
    with (
        pytest.raises(StapeskitError, match="with room for the outputs; got no space left"),
        stage_outputs(tmp_path),
    ):
        raise fault
    assert [path.name for path in tmp_path.iterdir()] == ["x.txt"]
    assert (tmp_path / "x.txt").read_text(encoding="utf-8") == "old"


def test_other_faults_of_the_system_are_no_full_disk(tmp_path):
    with pytest.raises(PermissionError), stage_outputs(tmp_path):
        raise PermissionError(errno.EACCES, "denied")


def test_nothing_is_replaced_where_a_folder_stands_in_the_way_of_a_file(tmp_path):
    (tmp_path / "a.txt").write_text("old")
    (tmp_path / "b.txt").mkdir()
    (tmp_path / "c").write_text("a file")

    def work():
        with stage_outputs(tmp_path) as stage:
            (stage / "a.txt").write_text("new")
            (stage / "b.txt").write_text("new")
            (stage / "c").mkdir()

    with pytest.raises(StapeskitError) as caught:
        work()
    text = str(caught.value)
    assert "b.txt must be a file; got a folder" in text
    assert "c must be a folder; got a file" in text
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.txt", "b.txt", "c"]


def test_content_hash_follows_the_bytes(tmp_path):
    path = tmp_path / "data.bin"
    path.write_bytes(b"stapes" * 1000)
    assert content_hash(path, sha256=True) == "sha256:" + hashlib.sha256(b"stapes" * 1000).hexdigest()
    first = content_hash(path)
    assert first.startswith("xxh3_128:")
    path.write_bytes(b"stapes" * 999 + b"stapeS")
    assert content_hash(path) != first
    folder = tmp_path / "slices"
    folder.mkdir()
    (folder / "1.txt").write_text("a")
    before = content_hash(folder)
    (folder / "1.txt").rename(folder / "2.txt")
    assert content_hash(folder) != before
    assert input_record(folder)["size_bytes"] == 1


def test_provenance_names_inputs_versions_and_command(tmp_path):
    path = tmp_path / "ldv.csv"
    path.write_text("x")
    numbers = {"room/calibrated.toml": "xxh3-128:0"}
    block = record({"ldv": path, "mass": None}, {"dof": "all"}, numbers, ["points2dof", "ldv.csv"])
    assert block["versions"] == {**versions(), **numbers}
    assert list(block["inputs"]) == ["ldv"]
    assert block["command"] == "points2dof ldv.csv"
    found = versions()
    assert "numpy" in found
    for name in found.keys() - {"python"}:
        assert found[name] == metadata.version(name)
    assert record({}, {}, {})["command"]


def test_hashes_made_in_the_background_are_the_same(tmp_path):
    path, gone = tmp_path / "a.bin", tmp_path / "gone.bin"
    path.write_bytes(b"stapes" * 200_000)
    for sha256 in (False, True):
        hashes = Hashes([path, None, gone], sha256)
        assert hashes.of(path) == content_hash(path, sha256)
        assert input_record(path, sha256, hashes) == input_record(path, sha256)
        with pytest.raises(FileNotFoundError):
            hashes.of(gone)


def test_a_file_that_changed_since_it_was_hashed_is_hashed_again(tmp_path):
    path = tmp_path / "scan"
    path.write_bytes(b"half")
    hashes = Hashes([path])
    assert hashes.of(path) == content_hash(path)
    path.write_bytes(b"the whole of it")
    assert hashes.of(path) == content_hash(path)
