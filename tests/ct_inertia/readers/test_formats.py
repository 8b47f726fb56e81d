"""The table of formats: what every entry must do, and that nothing about formats stands elsewhere."""

import importlib
import inspect
from pathlib import Path

import numpy as np
import pytest

from legacy import ct_inertia
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.read_scan import read_volume
from legacy.ct_inertia.readers.companions import data_files, with_data_files
from legacy.ct_inertia.readers.formats import FORMATS, RAW, Format, ReadOptions, format_of
from legacy.ct_inertia.readers.raw_layout import RawLayout
from tests.ct_inertia.readers import scanner_writers as scanners
from tests.ct_inertia.readers import writers as f
from tests.ct_inertia.readers.contract import CASES
from tests.ct_inertia.readers.writers import SPACING, check_corners, picture

EVERY = pytest.mark.parametrize("entry", FORMATS, ids=lambda entry: entry.module)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A scan of every case of the contract of readers: path, layout, case."""
    folder = tmp_path_factory.mktemp("scans")
    scans = {}
    for name, case in CASES.items():
        (folder / name.replace(".", "_")).mkdir()
        path = case.write(
            folder / name.replace(".", "_") / name, picture(case.types[0].lstrip(">")), **case.options
        )
        layout = None if case.raw is None else RawLayout((5, 6, 7), _name(case.types[0]), **case.raw)
        scans[name] = (path, layout, case)
    return scans


def _name(kind):
    return np.dtype(kind).name


def scans_of(entry, written):
    return [
        (path, layout, case) for path, layout, case in written.values() if format_of(path, layout) is entry
    ]


@EVERY
def test_a_module_has_what_the_table_promises(entry):
    code = importlib.import_module(f"legacy.ct_inertia.readers.{entry.module}")
    assert list(inspect.signature(code.read).parameters)[1:] == ["options"]
    assert bool(entry.sniffs) is hasattr(code, "recognises")
    assert set(entry.headers) <= set(entry.suffixes)
    assert not entry.headers or hasattr(code, "companion_files")
    assert entry.suffixes or entry.sniffs
    assert all(suffix == suffix.lower() and suffix.startswith(".") for suffix in entry.suffixes)


def test_every_suffix_belongs_to_one_format():
    suffixes = [suffix for entry in FORMATS for suffix in entry.suffixes]
    assert len(suffixes) == len(set(suffixes))


def test_every_module_that_reads_stands_in_the_table():
    folder = Path(ct_inertia.readers.__file__).parent
    modules = {path.stem for path in folder.glob("*.py") if "\ndef read(" in path.read_text("utf-8")}
    assert modules == {entry.module for entry in FORMATS}


@EVERY
def test_every_format_is_under_the_contract_of_readers(entry, written):
    assert scans_of(entry, written)


@EVERY
@pytest.mark.parametrize("axis", "xyz")
def test_every_format_is_mirrored_alike(entry, written, axis):
    for path, layout, case in scans_of(entry, written):
        volume = read_volume(path, SPACING if case.asks else None, axis, raw=layout)
        check_corners(volume, mirrored=axis)
        assert volume.origin_mm == pytest.approx(np.zeros(3), abs=1e-9)


@EVERY
def test_a_given_spacing_replaces_that_of_the_file(entry, written):
    for path, layout, case in scans_of(entry, written):
        volume = read_volume(path, 2.0 * SPACING, raw=layout)
        assert volume.spacing_mm == pytest.approx(2.0 * SPACING)
        codes = {notice.code for notice in volume.notices}
        assert case.asks or "spacing_overridden" in codes


@EVERY
def test_a_name_in_a_header_does_not_lead_out_of_its_folder(entry, written, tmp_path):
    """Voxels beside the folder of the header, which names them there, are not read."""
    for number, (path, _, _) in enumerate(scans_of(entry, written)):
        if path.suffix not in entry.headers:
            continue
        (tmp_path / str(number) / "in").mkdir(parents=True)
        content = path.read_bytes()
        for file in data_files(path):
            (tmp_path / str(number) / file.name).write_bytes(file.read_bytes())
            content = content.replace(file.name.encode(), f"../{file.name}".encode())
        header = tmp_path / str(number) / "in" / path.name
        header.write_bytes(content)
        with pytest.raises(CtInertiaError):
            read_volume(header, SPACING)


@pytest.mark.parametrize(
    ("entry", "suffix"), [(entry, suffix) for entry in FORMATS for suffix in entry.suffixes]
)
def test_other_content_under_a_suffix_is_refused(tmp_path, entry, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"this is a letter, no scan\n" * 40)
    assert format_of(path) is entry
    with pytest.raises(CtInertiaError):
        read_volume(path, 0.02)


def test_every_format_is_named_where_none_fits(tmp_path):
    path = tmp_path / "a.doc"
    path.write_bytes(b"this is a letter, no scan")
    with pytest.raises(CtInertiaError) as caught:
        format_of(path)
    assert all(entry.title in str(caught.value) for entry in FORMATS)


def test_a_new_format_needs_a_line_alone(tmp_path, monkeypatch):
    import sys
    import types

    module = types.ModuleType("legacy.ct_inertia.readers.invented")
    module.read = lambda path, options: (path, options)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(
        "legacy.ct_inertia.readers.formats.FORMATS",
        (Format("new", "invented", "all of it", (".new",)), *FORMATS),
    )
    path, options = tmp_path / "a.new", ReadOptions(mirror="x")
    assert format_of(path).read(path, options) == (path, options)
    assert data_files(path) == []


def test_a_damaged_header_names_no_companions(tmp_path, monkeypatch):
    def fails(_path):
        raise ValueError

    monkeypatch.setattr("legacy.ct_inertia.readers.metaimage.companion_files", fails)
    assert data_files(f.itk(tmp_path / "a.mhd", picture(np.int16))) == []


def test_companions_are_read_with_a_scan(tmp_path):
    array = picture(np.int16)
    header = f.itk(tmp_path / "a.mhd", array)
    (voxels,) = data_files(header)
    assert voxels.name == "a.raw"
    assert format_of(voxels) is RAW
    assert data_files(voxels) == [header]
    check_corners(read_volume(voxels))
    pair = f.itk(tmp_path / "b.img", array)
    assert data_files(pair.with_suffix(".hdr")) == [pair]
    assert data_files(pair) == [pair.with_suffix(".hdr")]
    parts = scanners.vgi(tmp_path / "c.vgi", array, parts=3)
    assert len(data_files(parts)) == 3
    assert data_files(f.plain(tmp_path / "d.tif", array)) == []
    named = with_data_files({"scan": parts, "labels": None, "landmarks": header})
    assert list(named) == [
        "scan",
        "scan_data",
        "scan_data_2",
        "scan_data_3",
        "labels",
        "landmarks",
        "landmarks_data",
    ]
