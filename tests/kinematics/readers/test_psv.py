"""Text exports of scanning vibrometers: FastScan folders and single points, and what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from legacy.kinematics.readers.psv import fastscan as psv_fastscan
from legacy.kinematics.readers.psv import per_point as psv_points
from legacy.kinematics.readers.psv.signals import frequency_hz
from legacy.kinematics.readers.psv.text_blocks import fields_of
from legacy.kinematics.readers.recognise_format import format_of
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics.readers.recordings import read_recordings
from tests.kinematics.written_psv import fastscan, point

FREQ = np.array([500.0, 1000.0, 1500.5])
POINTS = np.array([[0.001, 0.002, 0.0], [0.0015, 0.002, 0.0001]])
VALUES = (np.random.default_rng(2).normal(size=(3, 2, 3, 2)) @ [1.0, 1.0j]) * 1e-4


def scanned(tmp_path, **how):
    folder = tmp_path / "scan"
    folder.mkdir()
    for freq, values in zip(FREQ, VALUES, strict=True):
        (folder / f"scan_{freq:g}Hz.txt").write_bytes(fastscan(freq, POINTS, values, **how))
    return folder


def by_channel(made):
    return {(one.point, tuple(one.direction)): one for one in made.recordings}


def test_a_folder_of_frequencies(tmp_path):
    folder = scanned(tmp_path)
    assert format_of(folder).name == "fastscan"
    made = read_recordings(folder)
    assert [notice.code for notice in made.notices] == ["axes_from_beams"]
    assert (len(made.recordings), made.file, made.length_stated) == (6, "scan", False)
    for number, name in enumerate(("1", "2")):
        for axis in range(3):
            one = by_channel(made)[name, tuple(np.eye(3)[axis])]
            np.testing.assert_allclose(one.freq_hz, FREQ)
            np.testing.assert_allclose(one.value, VALUES[:, number, axis], rtol=1e-8)
            np.testing.assert_allclose(one.position_mm, POINTS[number] * 1e3)
            assert (one.order, one.per) == (1, "")


@pytest.mark.parametrize("text", ["1500 Hz", "1,5 kHz", "1.5e3Hz", " 0.0015 MHz ", "1500000 mHz"])
def test_frequencies_in_words(text):
    assert frequency_hz(text, "") == pytest.approx(1500.0, rel=1e-15)


@pytest.mark.parametrize(
    ("how", "scale", "order"),
    [
        ({"unit": "mm/s"}, 1e-3, 1),
        ({"unit": "nm", "signal": "Displacement"}, 1e-9, 0),
        ({"unit": "m/s²", "encoding": "latin-1"}, 1.0, 2),
        ({"encoding": "utf-16"}, 1.0, 1),
        ({"comma": True}, 1.0, 1),
        ({"unit": "\N{MICRO SIGN}m/s", "encoding": "latin-1"}, 1e-6, 1),
    ],
)
def test_units_and_encodings(how, scale, order, tmp_path):
    made = read_recordings(scanned(tmp_path, **how))
    one = by_channel(made)["1", (1.0, 0.0, 0.0)]
    assert one.order == order
    np.testing.assert_allclose(one.value, VALUES[:, 0, 0] * scale, rtol=1e-8)


def test_positions_in_stated_units(tmp_path):
    made = read_recordings(scanned(tmp_path, place_unit="mm"))
    assert made.length_stated
    np.testing.assert_allclose(by_channel(made)["2", (1.0, 0.0, 0.0)].position_mm, POINTS[1])


def test_responses_per_volt(tmp_path):
    made = read_recordings(scanned(tmp_path, unit="m/s / V", signal="Velocity / Ref1 Voltage"))
    assert {one.per for one in made.recordings} == {"V"}


def test_a_single_head_and_a_single_file(tmp_path):
    path = tmp_path / "band.txt"
    path.write_bytes(fastscan(750.0, POINTS, VALUES[0, :, 0]))
    made = read_recordings(path)
    assert [one.point for one in made.recordings] == ["1", "2"]
    assert all(np.all(np.isnan(one.direction)) for one in made.recordings)
    assert all(one.freq_hz.tolist() == [750.0] for one in made.recordings)


def test_points_that_some_frequencies_lack_are_missing_there(tmp_path):
    folder = scanned(tmp_path)
    (folder / "scan_1000Hz.txt").write_bytes(fastscan(1000.0, POINTS[:1], VALUES[1, :1]))
    one = by_channel(read_recordings(folder))["2", (0.0, 1.0, 0.0)]
    assert np.isnan(one.value).tolist() == [False, True, False]


def test_interpolated_values_are_told(tmp_path):
    made = read_recordings(scanned(tmp_path, treated="Yes"))
    assert "exported interpolated and filtered" in {n.code: n.text for n in made.notices}["values_smoothed"]


def test_velocity_before_displacement(tmp_path):
    folder = scanned(tmp_path)
    for freq, values in zip(FREQ, VALUES, strict=True):
        text = fastscan(freq, POINTS, values * 1e-4, "m", "Displacement")
        (folder / f"displacement_{freq:g}.txt").write_bytes(text)
    made = read_recordings(folder)
    assert {one.order for one in made.recordings} == {1}
    assert [notice.code for notice in made.notices] == ["quantity_chosen", "axes_from_beams"]


def spoiled(tmp_path, old, new):
    folder = scanned(tmp_path)
    path = folder / "scan_1000Hz.txt"
    assert old in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(StapeskitError) as caught:
        psv_fastscan.read(folder)
    assert "must be" in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b"1000 Hz", b"500 Hz", "the frequency 500 Hz must be there once"),
        (b"1000 Hz", b"1000 rpm", 'a number in Hz; got "1000 rpm" (scan_1000Hz.txt, line 11)'),
        (b"Frequency:", b"Band:", "one with a line Frequency: <f> Hz"),
        (b"Index", b"Number", "one with a column Index"),
        (b"[m/s]", b"[dB]", 'the values of axis x must be in one unit; got "dB" and "m/s"'),
        (b"Imaginary", b"Other", "got real part alone"),
        (b"Z\tReal", b"Z [yd]\tReal", "the unit of X, Y, Z must be one length unit"),
        (b"\r\n2\t", b"\r\n1\t", "Index must be different in each row; got 1 twice"),
        (b"\r\n2\t", b"\r\n1.5\t", "Index must be whole numbers"),
        (b"\r\n2\t0.0015", b"\r\n2\t0.0025", "the position of point 2 must be one"),
    ],
)
def test_spoiled_frequencies_are_named(old, new, words, tmp_path):
    assert words in spoiled(tmp_path, old, new)


def test_a_row_cut_short_is_named(tmp_path):
    folder = scanned(tmp_path)
    path = folder / "scan_1000Hz.txt"
    text = path.read_bytes()
    for end in (text.rindex(b"\t"), text.rindex(b"e-") + 1):
        path.write_bytes(text[:end])
        with pytest.raises(StapeskitError, match=r"a row must be of .*scan_1000Hz.txt, line 13"):
            psv_fastscan.read(folder)


def test_every_file_at_fault_is_told(tmp_path):
    folder = scanned(tmp_path)
    for path in folder.iterdir():
        path.write_bytes(path.read_bytes().replace(b"[m/s]", b"[dB]"))
    with pytest.raises(StapeskitError) as caught:
        psv_fastscan.read(folder)
    assert len(str(caught.value).splitlines()) == 3
    assert "not in dB" in str(caught.value)


def pointwise(tmp_path, *contents):
    folder = tmp_path / "points"
    folder.mkdir()
    for number, content in enumerate(contents):
        (folder / f"p{number}.txt").write_bytes(content)
    return folder


SPECTRUM = VALUES[:, 0, 0]


def test_a_folder_of_points(tmp_path):
    folder = pointwise(
        tmp_path,
        *(
            point(n + 1, FREQ, VALUES[:, n, k], place=POINTS[n], component="XYZ"[k])
            for n in (0, 1)
            for k in (0, 1, 2)
        ),
    )
    assert format_of(folder).name == "points"
    made = read_recordings(folder)
    assert len(made.recordings) == 6
    for n in (0, 1):
        for k in (0, 1, 2):
            one = by_channel(made)[str(n + 1), tuple(np.eye(3)[k])]
            np.testing.assert_allclose(one.value, VALUES[:, n, k], rtol=1e-8)
            np.testing.assert_allclose(one.position_mm, POINTS[n] * 1e3)


@pytest.mark.parametrize(
    ("how", "direction"),
    [
        ({"component": "-Z"}, (0, 0, -1)),
        ({"component": "Vib X"}, (1, 0, 0)),
        ({"component": "3D", "signal": "FFT - Vib Y Velocity - Real & Imag."}, (0, 1, 0)),
        ({"component": "Root Point"}, (np.nan,) * 3),
    ],
)
def test_direction_of_component_or_signal(how, direction, tmp_path):
    (one,) = psv_points.read(pointwise(tmp_path, point(1, FREQ, SPECTRUM, **how))).recordings
    np.testing.assert_array_equal(one.direction, direction)


def test_three_axes_in_one_file(tmp_path):
    made = psv_points.read(pointwise(tmp_path, point(1, FREQ, VALUES[:, 0], component="3D")))
    assert len(made.recordings) == 3
    np.testing.assert_allclose(by_channel(made)["1", (0.0, 0.0, 1.0)].value, VALUES[:, 0, 2], rtol=1e-8)


def test_magnitude_and_phase(tmp_path):
    content = point(1, FREQ, SPECTRUM, names=("Magnitude", "Phase"), unit="mm/s")
    (one,) = psv_points.read(pointwise(tmp_path, content)).recordings
    np.testing.assert_allclose(one.value, SPECTRUM * 1e-3, rtol=1e-7)


def test_all_points_in_one_file(tmp_path):
    path = tmp_path / "all.txt"
    path.write_bytes(b"\r\n".join(point(n, FREQ, SPECTRUM * n) for n in (1, 2, 3)))
    assert format_of(path).name == "points"
    made = psv_points.read(path)
    assert [one.point for one in made.recordings] == ["1", "2", "3"]
    np.testing.assert_allclose(made.recordings[2].value, 3.0 * SPECTRUM, rtol=1e-7)


def test_measurements_exported_into_one_folder_are_runs(tmp_path):
    contents = [point(n, FREQ, SPECTRUM, source=source) for n in (1, 2) for source in ("C:\\a.svd", "b.svd")]
    made = psv_points.read(pointwise(tmp_path, *contents))
    assert [(one.point, one.run) for one in made.recordings] == [
        ("1", "a"),
        ("1", "b"),
        ("2", "a"),
        ("2", "b"),
    ]


def test_responses_before_spectra(tmp_path):
    folder = pointwise(tmp_path, point(1, FREQ, SPECTRUM), point(1, FREQ, SPECTRUM * 3.0, unit="m/s / V"))
    made = psv_points.read(folder)
    assert [one.per for one in made.recordings] == ["V"]
    assert [notice.code for notice in made.notices] == ["function_chosen"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (point(1, FREQ, SPECTRUM, names=("Magnitude",)), "magnitude alone"),
        (point(1, FREQ, SPECTRUM, unit="dB"), "on a linear scale, not in dB"),
        (point(1, FREQ, SPECTRUM, unit="V"), "the unit must be m, mm, um, nm, m/s"),
        (point(1, FREQ, SPECTRUM, first=("Time", "s")), "over frequency; got a time series"),
        (point(1, FREQ, SPECTRUM, first=("Order", "1")), "the first column must be Frequency [Hz]"),
        (point(1, FREQ[::-1], SPECTRUM), "ascending and not negative"),
        (point("one", FREQ, SPECTRUM), 'the point index must be a number; got "one"'),
        (point(1, FREQ, SPECTRUM).replace(b"Point Index", b"Place"), "a line Point Index: <n>"),
        (point(1, FREQ, SPECTRUM, names=("Value", "Other")), "columns of real and imaginary part"),
        (point(1, FREQ, SPECTRUM)[:140], "a table of numbers; got no table"),
        (b"", "a table of numbers; got no table"),
    ],
)
def test_spoiled_points_are_named(content, words, tmp_path):
    with pytest.raises(StapeskitError) as caught:
        psv_points.read(pointwise(tmp_path, content))
    assert words in str(caught.value)
    assert "must be" in str(caught.value)


def test_one_point_twice_is_refused(tmp_path):
    with pytest.raises(StapeskitError, match="the signal of point 1 must be there once"):
        psv_points.read(pointwise(tmp_path, point(1, FREQ, SPECTRUM), point(1, FREQ, SPECTRUM)))


def test_the_layouts_of_the_documentation_are_read(tmp_path):
    page = (Path(__file__).parents[3] / "docs" / "vibrometer_files.md").read_text(encoding="utf-8")
    fast, single = (text.split("```")[0] for text in page.split("```text\n")[1:3])
    (tmp_path / "a.txt").write_text(fast)
    (tmp_path / "b.txt").write_text(single)
    first = read_recordings(tmp_path / "a.txt")
    assert [one.value[0] for one in first.recordings] == [1.2e-05 + 4e-06j, 2.5e-06 + 5e-06j, -3e-07 + 6e-06j]
    (one,) = read_recordings(tmp_path / "b.txt").recordings
    assert (one.point, one.value[0]) == ("5", 1.2e-05 - 3.4e-06j)
    np.testing.assert_allclose(one.position_mm, first.recordings[0].position_mm)


@pytest.mark.parametrize("name", ["scan.svd", "point.pvd", "renamed.dat"])
def test_files_of_the_vendors_program_say_what_to_export(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(64))
    with pytest.raises(StapeskitError) as caught:
        read_recordings(path)
    assert "as UFF (universal file, with geometry) or as ASCII" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_folders_and_files_of_no_known_kind(tmp_path):
    with pytest.raises(StapeskitError, match="one with text exports"):
        format_of(tmp_path)
    (tmp_path / "a.xyz").write_text("something")
    with pytest.raises(StapeskitError, match="a universal file"):
        format_of(tmp_path / "a.xyz")
    with pytest.raises(StapeskitError, match="an existing file"):
        format_of(tmp_path / "none.uff")


def test_fields_of_a_head_and_a_line_of_blanks_is_soon_read():
    text = "Signal: Vib X\n\t Band No. \t: 3\nA\tB: 1\nx: 2\n" + " " * 10**6
    assert fields_of(text) == {"signal": "Vib X", "band no.": "3"}
