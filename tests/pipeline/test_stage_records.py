"""Fingerprints: they change with what matters and only then."""

import pytest

from legacy.ct_inertia.readers.companions import with_data_files
from legacy.pipeline import stage_records
from legacy.stapeskit.provenance import Hashes

CODE = stage_records.code_hash


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Let the code of a stage be a small package of this test."""
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "a.py").write_text("x = 1\n")
    monkeypatch.setattr(stage_records, "__file__", str(tmp_path / "pipeline" / "stage_records.py"))
    monkeypatch.setattr(stage_records, "code_hash", CODE)
    return tmp_path


def mark(tmp_path, parameters=None, name="scan.tif"):
    return stage_records.fingerprint(
        ["room"], {"scan": tmp_path / name, "labels": None}, parameters or {}, Hashes()
    )


def test_input_parameters_and_code_each_change_it(package):
    (package / "scan.tif").write_bytes(b"1")
    first = mark(package, {"side": "left"})
    assert mark(package, {"side": "left"}) == first
    record = stage_records.StageRecord("scan", first, {}, 0.0)
    assert record.changes(mark(package, {"side": "right"})) == ["side"]
    (package / "scan.tif").write_bytes(b"2")
    assert record.changes(mark(package, {"side": "left"})) == ["input scan"]
    (package / "scan.tif").write_bytes(b"1")
    (package / "room" / "a.py").write_text("x = 2\n")
    assert record.changes(mark(package, {"side": "left"})) == ["stapeskit"]


def test_data_beside_a_header_count(package):
    header, data = package / "scan.mhd", package / "voxels.raw"
    header.write_text("NDims = 3\nDimSize = 2 2 2\nElementDataFile = voxels.raw\n")
    data.write_bytes(b"1")

    def mark():
        return stage_records.fingerprint(["room"], with_data_files({"scan": header}), {}, Hashes())

    first = mark()
    data.write_bytes(b"2")
    assert stage_records.StageRecord("scan", first, {}, 0.0).changes(mark()) == ["input scan_data"]


def test_long_settings_are_kept_as_a_hash(package):
    (package / "scan.tif").write_bytes(b"1")
    made = mark(package, {"matrix": list(range(200))})
    assert len(made["matrix"]) == 32


def test_a_record_that_points_outside_its_folder_is_not_believed(tmp_path):
    good = stage_records.StageRecord("fit", {"a": "1"}, {"kd.json": "xxh3_128:0"}, 1.0)
    stage_records.write_record(tmp_path, good)
    assert stage_records.read_record(tmp_path, "fit") == good
    assert good.spoiled(tmp_path, Hashes()) == ["kd.json"]
    for name in ("../kd.json", "/etc/passwd"):
        stage_records.write_record(tmp_path, stage_records.StageRecord("fit", {}, {name: "0"}, 1.0))
        assert stage_records.read_record(tmp_path, "fit") is None
    assert stage_records.read_record(tmp_path, "scan") is None
    whole = (
        (tmp_path / stage_records.record_name("fit")).read_text(encoding="utf-8").replace("/etc/passwd", "a")
    )
    for old, text in (("", whole), ("no", "[" * 100_000), ("1.0", "1" * 400), ("1.0", "[]"), ("no", "[]")):
        content = whole.replace(old, text) if old in whole and old else text
        (tmp_path / stage_records.record_name("fit")).write_text(content, encoding="utf-8")
        assert (stage_records.read_record(tmp_path, "fit") is None) == bool(old)
