"""Folders of text exports: all faults in one message, and files that do not belong to them."""

from __future__ import annotations

import os
import tracemalloc

import numpy as np
import pytest

from legacy.kinematics.readers.input_options import InputOptions
from legacy.kinematics.readers.measurement_files import read_measurement
from legacy.kinematics.readers.recognise_format import format_of
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics.readers.recordings import read_recordings
from tests.kinematics.readers.test_psv import FREQ, SPECTRUM, pointwise, scanned
from tests.kinematics.written_psv import fastscan, point


def fault(path):
    with pytest.raises(StapeskitError) as caught:
        read_recordings(path)
    return str(caught.value)


def test_every_malformed_row_of_every_file_is_told_by_line_and_column(tmp_path):
    folder = scanned(tmp_path)
    first, second = folder / "scan_500Hz.txt", folder / "scan_1000Hz.txt"
    lines = first.read_text().split("\n")
    lines[11] = lines[11].replace("0.001", "0.0o1")
    lines[12] = "\t".join(lines[12].split("\t")[:-2])
    first.write_text("\n".join(lines))
    cells = second.read_text().split("\n")
    row = cells[12].split("\t")
    row[4], row[7] = "1_0", "--3"
    cells[12] = "\t".join(row)
    cells[4] = "Frequency:\tmany Hz"
    second.write_text("\n".join(cells))
    told = fault(folder).splitlines()
    assert len(told) == 5
    for words in (
        'a row must be of numbers; got "0.0o1" (scan_500Hz.txt, line 12, column "X")',
        "a row must be of 10 numbers; got 8 (scan_500Hz.txt, line 13)",
        'got "1_0" (scan_1000Hz.txt, line 13, column "Real X")',
        'got "--3" (scan_1000Hz.txt, line 13, column "Imaginary X")',
        'the frequency must be a number in Hz; got "many Hz" (scan_1000Hz.txt, line 11)',
    ):
        assert sum(words in line for line in told) == 1


def test_faults_of_single_points_are_told_together(tmp_path):
    folder = pointwise(
        tmp_path,
        point("one", FREQ, SPECTRUM, unit="dB"),
        point(2, FREQ[::-1], SPECTRUM),
        point(3, FREQ, SPECTRUM, names=("Magnitude",)),
        point(4, FREQ, SPECTRUM),
    )
    told = fault(folder).splitlines()
    assert len(told) == 4
    assert "got 1000 at place 2 and 1 more (p1.txt" in told[2]


def test_a_long_list_is_cut_and_counted(tmp_path):
    freq = np.arange(1.0, 101.0)
    content = point(1, freq, freq * 1j).replace(b"\t0\t", b"\tx\t")
    told = fault(pointwise(tmp_path, content)).splitlines()
    assert len(told) == 1
    assert "(p0.txt, lines 8 to 107, column" in told[0]


def test_files_that_do_not_belong_to_an_export_are_passed_over_or_named(tmp_path):
    folder = scanned(tmp_path)
    expected = len(read_recordings(folder).recordings)
    (folder / "Thumbs.db").write_bytes(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(90))
    (folder / ".DS_Store").write_bytes(bytes(range(200)))
    (folder / "._scan_500Hz.txt").write_bytes(bytes(range(200)))
    (folder / "a.svd").write_bytes(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(90))
    os.symlink(folder, folder / "loop")
    os.symlink(folder / "nowhere.txt", folder / "gone.txt")
    assert format_of(folder).name == "fastscan"
    assert len(read_recordings(folder).recordings) == expected
    (folder / "notes.txt").write_text("Measured on Monday\n")
    assert "no table (notes.txt). Export it again as ASCII, or take it out of the folder." in fault(folder)


def test_files_of_a_second_scan_are_refused(tmp_path):
    folder = scanned(tmp_path)
    other = fastscan(2000.0, np.eye(3) * 1e-3, np.ones((3, 3)) * 1j).replace(b"ear.svd", b"plate.svd")
    (folder / "other.txt").write_bytes(other)
    text = fault(folder)
    assert (
        'the source of the files must be one measurement; got "ear.svd" (scan_500Hz.txt) and "plate.svd"'
        in text
    )
    assert "the position of point 2 must be one" in text
    again = fastscan(1000.0, np.eye(3)[:2] * 1e-3, np.ones((2, 3)) * 1j)
    (folder / "other.txt").write_bytes(again)
    assert "the frequency 1000 Hz must be there once; got other.txt and scan_1000Hz.txt" in fault(folder)


def test_points_of_two_measurements_are_one_run_and_said_so(tmp_path):
    parts = [point(n, FREQ, SPECTRUM, source="a.svd" if n < 3 else "b.svd") for n in (1, 2, 3)]
    made = read_recordings(pointwise(tmp_path, *parts))
    assert [one.run for one in made.recordings] == ["", "", ""]
    assert "points of 2 measurements (a.svd, b.svd)" in made.notices[-1].text


def test_localised_columns_and_radians(tmp_path):
    text = point(1, FREQ, SPECTRUM, names=("Magnitude", "Phase"), unit="mm/s").decode("latin-1")
    german = (
        text.replace("Frequency", "Frequenz")
        .replace("Magnitude", "Betrag")
        .replace("Point Index", "Punktindex")
    )
    german = german.replace("Vib Velocity", "Vib Geschwindigkeit - \u00fcber Fl\u00e4che \u00b5").replace(
        ".", ","
    )
    english = read_recordings(pointwise(tmp_path, text.encode("latin-1"))).recordings[0]
    for encoding in ("latin-1", "utf-8", "utf-16"):
        path = tmp_path / "d.txt"
        path.write_bytes(german.encode(encoding).replace(b"ear,svd", b"ear.svd"))
        (one,) = read_recordings(path).recordings
        np.testing.assert_allclose(one.value, english.value, rtol=1e-12)
    radians = [line.split("\t") for line in text.split("\r\n")]
    for row in radians[7:-1]:
        row[2] = repr(float(np.deg2rad(float(row[2]))))
    radians[6][2] = "[ rad ]"
    path.write_text("\r\n".join("\t".join(row) for row in radians))
    np.testing.assert_allclose(read_recordings(path).recordings[0].value, english.value, rtol=1e-12)


def test_values_too_large_to_be_motion_are_refused(tmp_path):
    folder = pointwise(tmp_path, point(1, FREQ, np.array([1e200, 1.0, 1.0]), place=(0, 0, 0), component="Z"))
    with pytest.raises(StapeskitError, match=r"the values of point 1 must be below 1e\+100"):
        read_measurement([folder], options=InputOptions(body=("s=1",)))


def test_a_line_of_millions_of_cells_is_refused_in_little_memory(tmp_path):
    path = tmp_path / "wide.txt"
    path.write_text("Point Index: 1\nFrequency [Hz]\tX [m/s]\n" + "1\t2\n" * 3 + "3\t" * 4_000_000 + "4\n")
    tracemalloc.start()
    told = fault(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert "got 10001" in told or "of 2 numbers" in told
    assert peak <= 2 * path.stat().st_size + (50 << 20)


def test_a_number_of_millions_of_digits_is_no_number(tmp_path):
    path = tmp_path / "long.txt"
    path.write_text("Point Index: 1\nFrequency [Hz]\tX [m/s]\n1\t2\n2\t" + "7" * 3_000_000 + "\n3\t4\n")
    assert "a row must be of numbers" in fault(path)
