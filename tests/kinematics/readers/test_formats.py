"""The table of vibrometer formats: every entry has its reader, and one entry makes a format known."""

from __future__ import annotations

import inspect
import sys
from dataclasses import replace
from importlib import import_module
from types import ModuleType

import numpy as np
import pytest

from legacy.kinematics.cli import parser
from legacy.kinematics.measure_motion import files_by_role
from legacy.kinematics.readers import recognise_format
from legacy.kinematics.readers.formats import FORMATS, TIDY, Format
from legacy.kinematics.readers.input_options import InputOptions
from legacy.kinematics.readers.measurement_files import read_measurement
from legacy.kinematics.readers.recognise_format import format_of
from legacy.kinematics.readers.recording import Recording, Recordings
from legacy.kinematics.tidy.ldv_csv import read_ldv
from legacy.stapeskit.faults import Place, StapeskitError
from tests.kinematics.readers.contract import CASES, FREQ_HZ, VELOCITY


@pytest.mark.parametrize("entry", FORMATS, ids=lambda entry: entry.name)
def test_every_entry_has_a_reader_that_takes_its_options(entry):
    if entry.name == TIDY:
        return
    parameters = inspect.signature(import_module(entry.module).read).parameters
    assert len(parameters) == 1 + len(entry.options)
    assert all(hasattr(InputOptions(), name) for name in entry.options)


@pytest.mark.parametrize("entry", FORMATS, ids=lambda entry: entry.name)
def test_every_format_gives_the_recording_that_was_written(entry, tmp_path):
    path, options = CASES[entry.name](tmp_path)
    assert format_of(path) is entry
    if entry.name == TIDY:
        body = read_ldv(path).bodies[0]
        seen = body.displacement[0] * (2j * np.pi * FREQ_HZ)
    elif entry.name == "vendor":
        with pytest.raises(StapeskitError, match="Export"):
            entry.read(path, options)
        return
    else:
        found = entry.read(path, options).recordings
        recordings = sorted(found, key=lambda one: (one.point, *(-one.direction)))
        lines = [np.searchsorted(one.freq_hz, FREQ_HZ - 1e-6) for one in recordings]
        assert all(one.order == 1 for one in recordings)
        seen = np.array([one.value[line] for one, line in zip(recordings, lines, strict=True)])
    np.testing.assert_allclose(seen, VELOCITY.reshape(9, -1), rtol=1e-3, atol=1e-8)


def test_the_help_of_the_command_lists_every_format():
    text = " ".join(parser().format_help().split())
    said = {entry.name: f"{entry.words}: {entry.reads.replace('`', '')}" for entry in FORMATS if entry.reads}
    assert [name for name, words in said.items() if words not in text] == []


def test_names_are_different():
    assert len({entry.name for entry in FORMATS}) == len(FORMATS)


def test_one_entry_makes_a_format_known(tmp_path, monkeypatch):
    def read(path):
        position, direction = np.zeros(3), np.array([0.0, 1.0, 0.0])
        recording = Recording(
            "1", np.array([100.0]), np.array([2.0 + 1.0j]), 0, Place(path.name),
            body="s", position_mm=position, direction=direction,
        )  # fmt: skip
        return Recordings((recording,), amplitude_stated=True)

    module = ModuleType("invented")
    module.read = read
    monkeypatch.setitem(sys.modules, "invented", module)
    entry = Format("new", "invented", "a new format (.new)", lambda head: head.content.startswith(b"NEW"))
    monkeypatch.setattr(recognise_format, "FORMATS", (entry, *FORMATS))
    path = tmp_path / "a.new"
    path.write_bytes(b"NEW")
    assert format_of(path).name == "new"
    assert read_measurement([path]).bodies[0].displacement[0, 0, 0] == 2.0 + 1.0j


def test_the_companions_of_a_format_are_inputs(tmp_path, monkeypatch):
    def named(path):
        return [path.with_suffix(".values"), path.with_suffix(".missing")]

    def fails(_path):
        raise KeyError

    for name in ("a.new", "a.values", "a.new.toml", "b.csv"):
        (tmp_path / name).write_text("NEW")
    entry = Format("new", "invented", "", lambda head: head.content.startswith(b"NEW"), companions=named)
    monkeypatch.setattr(recognise_format, "FORMATS", (entry, *FORMATS))
    roles = files_by_role((tmp_path / "a.new",), {})
    assert list(roles) == ["ldv", "a.new.toml", "a.values"]
    setup = [tmp_path / folder / "setup.xml" for folder in ("one", "two")]
    for file in setup:
        file.parent.mkdir()
        file.touch()
        (file.parent / f"{file.parent.name}.new").write_text("NEW")
    together = replace(entry, companions=lambda path: [path.with_name("setup.xml")])
    monkeypatch.setattr(recognise_format, "FORMATS", (together, *FORMATS))
    files = tuple(file.parent / f"{file.parent.name}.new" for file in setup)
    every = files_by_role(files, {"setup.xml": tmp_path / "b.csv"})
    assert set(every.values()) == {*files, *setup, tmp_path / "b.csv"}
    monkeypatch.setattr(recognise_format, "FORMATS", (replace(entry, companions=fails), *FORMATS))
    assert list(files_by_role((tmp_path / "a.new", tmp_path / "none.new"), {})) == [
        "ldv",
        "ldv 2",
        "a.new.toml",
    ]


@pytest.mark.parametrize(
    ("name", "content", "got"),
    [
        ("a.zip", b"PK\x03\x04....", "a ZIP archive"),
        ("a.xlsx", b"PK\x03\x04....", "a workbook"),
        ("a.uff", b"", "0 bytes"),
        ("a.dat", b"1 2 3", "a.dat"),
    ],
)
def test_unknown_content_is_refused(tmp_path, name, content, got):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(StapeskitError) as caught:
        format_of(path)
    (fault,) = caught.value.faults
    assert fault.got == got


def test_workbooks_are_no_scans_of_a_vibrometer(tmp_path):
    (tmp_path / "a.xls").write_bytes(bytes.fromhex("d0cf11e0a1b11ae1") + bytes(600))
    with pytest.raises(StapeskitError) as caught:
        read_measurement([tmp_path / "a.xls"])
    assert caught.value.faults[0].got == "a workbook"


@pytest.mark.parametrize(
    ("files", "got"),
    [((), "none"), (("b.jpg",), "none"), (("a.txt", "b.jpg"), "1 text files of other kinds")],
)
def test_a_folder_without_exports_is_refused_by_what_it_holds(tmp_path, files, got):
    for name in files:
        (tmp_path / name).write_text("words")
    with pytest.raises(StapeskitError) as caught:
        format_of(tmp_path)
    assert caught.value.faults[0].got == got
