"""Files that are unusual and right: made after the descriptions of their formats, read as they are meant."""

import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from legacy.kinematics.measure_motion import MotionInputs
from legacy.kinematics.readers.containers.matlab_file import read_mat
from legacy.kinematics.readers.input_options import InputOptions
from legacy.kinematics.readers.measurement_files import read_measurement
from legacy.kinematics.readers.series.series_files import read_series
from legacy.kinematics.readers.unit_labels import motion_unit
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics.readers.recordings import read_recordings

FREQ = np.array([100.0, 250.0, 400.0, 800.0])
VALUE = np.array([1.0 + 2.0j, -3.0e-4j, 2.5e-3, -1.0 + 1.0e-3j])


@pytest.mark.parametrize("label", ["mm s^-1", "mm·s⁻¹", "mm*s**-1", "mm s-1", "mm/s"])
def test_per_second_in_every_way_of_writing(label):
    unit = motion_unit(label)
    assert (unit.order, unit.scale, unit.per) == (1, 1e-3, "")


@pytest.mark.parametrize(
    ("label", "order", "per"), [("m s⁻²", 2, ""), ("m·s⁻¹/V", 1, "V"), ("m/s²/N", 2, "N")]
)
def test_powers_of_seconds_and_references(label, order, per):
    unit = motion_unit(label)
    assert (unit.order, unit.scale, unit.per) == (order, 1.0, per)


def per_point(folder, words, mark="\t"):
    source, point, component, frequency, real, imaginary = words
    for axis in "xyz":
        lines = [
            f"{source}:{mark}ear.svd",
            f"{point}:{mark}5  x = 0.001  y = 0  z = 0",
            f"{component}:{mark}{axis}",
        ]
        lines += [f"Signal:{mark}FFT - Vib Velocity", "", mark.join((frequency, real, imaginary))]
        lines += [mark.join(("[ Hz ]", "[ m/s ]", "[ m/s ]"))]
        lines += [f"{f:g}{mark}{v.real!r}{mark}{v.imag!r}" for f, v in zip(FREQ, VALUE.tolist(), strict=True)]
        (folder / f"{axis}.txt").write_text("\r\n".join(lines) + "\r\n", encoding="latin-1")
    return folder


ENGLISH = ("Source File Name", "Point Index", "Component", "Frequency", "Real", "Imaginary")
GERMAN = ("Quelldatei", "Punktindex", "Komponente", "Frequenz", "Realteil", "Imaginärteil")


@pytest.mark.parametrize(("words", "mark"), [(ENGLISH, "\t"), (ENGLISH, ";"), (GERMAN, "\t"), (GERMAN, ";")])
def test_points_with_german_headers_and_semicolons(tmp_path, words, mark):
    found = read_recordings(per_point(tmp_path, words, mark)).recordings
    assert sorted(one.direction.tolist() for one in found) == [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
    for one in found:
        assert one.point == "5"
        np.testing.assert_allclose(one.value, VALUE)
        np.testing.assert_allclose(one.position_mm, [1.0, 0.0, 0.0])


def test_a_wide_table_from_high_to_low_frequencies(tmp_path):
    rows = [f"{f:g},{v.real!r},{v.imag!r}" for f, v in zip(FREQ, VALUE.tolist(), strict=True)]
    path = tmp_path / "ldv.csv"
    path.write_text("\n".join(["Frequency [Hz],P1 Vz Real [m/s],P1 Vz Imag [m/s]", *rows[::-1]]) + "\n")
    (one,) = read_recordings(path).recordings
    np.testing.assert_array_equal(one.freq_hz, FREQ)
    np.testing.assert_allclose(one.value, VALUE)
    path.write_text("\n".join(["Frequency [Hz],P1 Vz Real [m/s],P1 Vz Imag [m/s]", *rows[1::-1], *rows[2:]]))
    with pytest.raises(StapeskitError, match="ascending"):
        read_recordings(path)


def test_matlab_4(tmp_path):
    path = tmp_path / "scan.mat"
    whole = np.array([[1, 2], [3, 4]], np.int32)
    content = {
        "x": FREQ[None],
        "y": np.array([VALUE, 2.0 * VALUE]),
        "whole": whole,
        "unit": "mm/s",
        "none": [],
    }
    savemat(path, content, format="4")
    tree = read_mat(path)
    np.testing.assert_array_equal(tree["x"], FREQ[None])
    np.testing.assert_array_equal(tree["whole"], whole)
    assert tree["unit"] == "mm/s"
    assert tree["none"].size == 0
    first, second = read_recordings(path).recordings
    np.testing.assert_allclose(first.value, 1e-3 * VALUE)
    np.testing.assert_allclose(second.value, 2e-3 * VALUE)


def test_matlab_4_of_another_byte_order(tmp_path):
    head = struct.pack(">5i", 1000, 2, 1, 0, 2) + b"x\0"
    (tmp_path / "a.mat").write_bytes(head + struct.pack(">2d", 3.0, -4.0))
    np.testing.assert_array_equal(read_mat(tmp_path / "a.mat")["x"], [[3.0], [-4.0]])


@pytest.mark.parametrize("cut", [1, 21, 400])
def test_a_matlab_4_file_that_is_cut_is_refused(tmp_path, cut):
    path = tmp_path / "scan.mat"
    savemat(path, {"x": FREQ[None], "y": np.tile(VALUE, (9, 1))}, format="4")
    path.write_bytes(path.read_bytes()[:-cut])
    with pytest.raises(StapeskitError, match="a whole MATLAB file"):
        read_mat(path)
    path.write_bytes(struct.pack("<5i", 0, 2**31 - 1, 2**31 - 1, 1, 2) + b"x\0")
    with pytest.raises(StapeskitError, match="bytes where"):
        read_mat(path)


def test_a_recording_longer_than_4_gb_may_be(tmp_path):
    samples = np.arange(-50, 50, dtype="<i2")
    sizes = struct.pack("<QQQI", 72 + samples.nbytes, samples.nbytes, samples.size, 0)
    form = struct.pack("<HHIIHH", 1, 1, 8000, 16000, 2, 16)
    content = b"RF64" + b"\xff" * 4 + b"WAVE" + b"ds64" + struct.pack("<I", len(sizes)) + sizes
    content += b"fmt " + struct.pack("<I", len(form)) + form + b"data" + b"\xff" * 4 + samples.tobytes()
    (tmp_path / "a.wav").write_bytes(content)
    series = read_series(tmp_path / "a.wav", ["1"])
    assert series.sample_rate_hz == 8000.0
    np.testing.assert_array_equal(series.channels["1"][0], samples / 32768.0)


def test_the_working_folder_is_a_folder_like_others(tmp_path, monkeypatch):
    monkeypatch.chdir(per_point(tmp_path, ENGLISH))
    here = MotionInputs((Path(),)).by_role["ldv"]
    options = InputOptions(body=(f"stapes={tmp_path.name}",), length_unit="m")
    assert [body.body for body in read_measurement([here], options=options).bodies] == ["stapes"]


def test_a_folder_of_too_many_files_is_not_searched(tmp_path, monkeypatch):
    monkeypatch.setattr("legacy.kinematics.readers.psv.text_blocks._MOST_FILES", 5)
    for number in range(6):
        (tmp_path / f"{number}.jpg").touch()
    with pytest.raises(StapeskitError, match="more than 5"):
        read_recordings(tmp_path)
