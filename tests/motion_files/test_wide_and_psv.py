"""Wide tables and text exports of scanning vibrometers: names, units, decimal commas, and what is refused."""

import re

import numpy as np
import pytest

from kinematics.readers.assemble import read_measurement
from kinematics.readers.formats import read_file
from kinematics.readers.stated_by_user import FileFacts
from kinematics.readers.wide import meaning
from stapeskit.faults import StapeskitError
from tests.motion_files.written_files import FREQ_HZ, PLACES_M, VELOCITY, fastscan, point_block, wide_table


def written(folder, text, name="ldv.csv"):
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def faults(path, facts=None):
    with pytest.raises(StapeskitError) as caught:
        read_file(path, facts or FileFacts())
    return caught.value.faults


NAMES = {
    "P3 Vx Mag": ("amp", "3", "x"),
    "Point 3 - Vib Z - Real": ("re", "3", "z"),
    "apex -y Phase": ("phase", "apex", "-y"),
    "Imag": ("im", "", ""),
    "P1 Coherence": ("coherence", "1", ""),
    "Point A Vz Real": ("re", "A", "z"),
    "1.0 x Re": ("re", "1.0", "x"),
    "P1_z_im": ("im", "1", "z"),
    "P1 Vz Partie réelle": ("re", "1", "z"),
    "P1 Vz RMS Mag": ("amp", "1", "z"),
    "comment": None,
    "x Real Imag": None,
}


@pytest.mark.parametrize("name", NAMES)
def test_meaning_of_names(name):
    assert meaning(name) == NAMES[name]


@pytest.mark.parametrize(("separator", "comma"), [(",", False), (";", True), ("\t", True), (";", False)])
def test_separators_and_decimal_commas(separator, comma, tmp_path):
    text = wide_table(separator)
    recording = read_file(written(tmp_path, text.replace(".", ",") if comma else text), FileFacts())
    assert np.allclose(recording.value, VELOCITY.reshape(9, -1), rtol=0, atol=1e-17)


def test_lines_above_units_below_and_descending_rows(tmp_path):
    names, *rows = wide_table().strip().split("\n")
    bare = ",".join(name.split(" [")[0] for name in names.split(","))
    units = ",".join("[" + name.split("[")[1] for name in names.split(","))
    text = "\n".join(["Measured by hand", "Date, 2026-11-21", "", bare, units, *rows[::-1]])
    recording = read_file(written(tmp_path, text), FileFacts())
    assert np.allclose(recording.value, VELOCITY.reshape(9, -1), rtol=0, atol=1e-17)
    assert np.allclose(recording.freq_hz, FREQ_HZ)


@pytest.mark.parametrize(("phase", "frequency"), [("[rad]", "[Hz]"), ("[deg]", "[kHz]")])
def test_stated_units(phase, frequency, tmp_path):
    recording = read_file(written(tmp_path, wide_table(phase=phase, frequency=frequency)), FileFacts())
    assert np.allclose(recording.value, VELOCITY.reshape(9, -1), rtol=0, atol=1e-17)
    assert np.allclose(recording.freq_hz, FREQ_HZ)


def test_a_unit_that_may_be_another_must_be_stated(tmp_path):
    """Phases within 3.14 without a unit may be degrees or radians; lines up to 1.15 may be Hz or kHz."""
    radians = wide_table(phase="[rad]").replace(" [rad]", "")
    assert [fault.thing for fault in faults(written(tmp_path, radians))] == ["the unit of the phases"]
    kilohertz = wide_table(frequency="[kHz]").replace(" [kHz]", "")
    assert [fault.thing for fault in faults(written(tmp_path, kilohertz))] == ["the unit of the frequencies"]


def test_decibels_are_one_fault_with_the_cure(tmp_path):
    found = faults(written(tmp_path, wide_table().replace("[mm/s]", "[dB re 1 m/s]")))
    assert len(found) == 1
    assert "10^(dB/20)" in found[0].next_step


THOUSANDS = {
    "wide": "f [Hz];P1 x Re [m/s];P1 x Im [m/s]\n{}\n",
    "tidy": "freq_hz;re_m_s;im_m_s;body;point;dir\n{}\n",
}


@pytest.mark.parametrize("mark", [".", ","])
@pytest.mark.parametrize("name", THOUSANDS)
def test_thousands_that_look_like_decimals_are_refused(name, mark, tmp_path):
    """Without decimals elsewhere 1.050 behind 950 would be 1.05 Hz."""
    rest = ";a;1;z" if name == "tidy" else ""
    rows = [
        f"{freq};1E-5;{k}E-5{rest}" for k, freq in enumerate(["900", "950", f"1{mark}000", f"1{mark}050"])
    ]
    for order in (rows, rows[::-1]):
        (fault,) = faults(written(tmp_path, THOUSANDS[name].format("\n".join(order))))
        assert fault.thing == "the frequencies"
        assert "1050" in fault.next_step


PLAIN = "Frequency [Hz],1.0 x Re [m/s],1.0 x Im [m/s]\n400,0.1,0.2\n500,0.3,0.4\n"
WRITINGS = {
    "quotes": '"' + PLAIN.strip().replace(",", '","').replace("\n", '"\n"') + '"\n',
    "decimal commas in quotes": re.sub(r"0\.(\d)", r'"0,\1"', PLAIN),
    "comments": "# by hand\n" + PLAIN.replace("\n500", "\n# lost\n500") + "# end\n",
    "a header as comment": "# " + PLAIN,
    "empty rows at the end": PLAIN + ",,\n\n;\n",
    "UTF-16": PLAIN.encode("utf-16"),
    "byte order mark": b"\xef\xbb\xbf" + PLAIN.encode(),
}  # fmt: skip


@pytest.mark.parametrize("name", WRITINGS)
def test_writings_of_tables(name, tmp_path):
    recording = read_file(written(tmp_path, WRITINGS[name]), FileFacts())
    assert recording.points == ("1",)
    assert np.array_equal(recording.value, [[0.1 + 0.2j, 0.3 + 0.4j]])


UNCLEAR = {
    "two signals": ("Vx Re [m/s],Vx Im [m/s],Dx Re [m],Dx Im [m]", "1,2,3,4", "the parts of a beam"),
    "negative magnitudes": ("P1 x Mag [m/s],P1 x Phase [deg]", "-60,120", "the magnitudes"),
    "radians without end": ("P1 x Mag [m/s],P1 x Phase", "1,-9", "the unit of the phases"),
    "peak to peak": ("P1 x Mag [mm/s p-p],P1 x Phase [deg]", "1,9", "the unit of P1 x Mag"),
}  # fmt: skip


@pytest.mark.parametrize("name", UNCLEAR)
def test_numbers_that_may_mean_something_else_are_refused(name, tmp_path):
    head, row, thing = UNCLEAR[name]
    path = written(tmp_path, f"Frequency [Hz],{head}\n400,{row}\n500,{row}\n")
    assert [fault.thing for fault in faults(path)] == [thing]


def test_coherence_in_percent_is_read_by_its_unit(tmp_path):
    text = "Frequency [Hz],P1 x Re [m/s],P1 x Im [m/s],P1 x Coherence [%]\n400,1,2,98\n500,2,3,0.5\n"
    assert np.allclose(read_file(written(tmp_path, text), FileFacts()).coherence, [[0.98, 0.005]])


@pytest.mark.parametrize("whole", [True, False])
def test_a_transform_up_to_the_sampling_rate_is_refused(whole, tmp_path):
    """Its second half mirrors the first; with 0 Hz or without."""
    signal = np.random.default_rng(2).normal(size=32)
    lines = np.column_stack([50.0 * np.arange(32), np.fft.fft(signal).real, np.fft.fft(signal).imag])
    rows = [",".join(f"{value:.9g}" for value in line) for line in lines[0 if whole else 1 :]]
    text = "\n".join(["Frequency [Hz],P1 x Re [m/s],P1 x Im [m/s]", *rows]) + "\n"
    assert [fault.thing for fault in faults(written(tmp_path, text))] == ["the spectra"]


def test_cells_and_rows_at_fault_are_listed_with_their_lines(tmp_path):
    lines = wide_table().strip().split("\n")
    lines[2] = lines[2].replace(lines[2].split(",")[3], "lost")
    lines[4] = ",".join(lines[4].split(",")[:-2])
    found = faults(written(tmp_path, "\n".join(lines)))
    assert [fault.where.numbers for fault in found] == [(3,), (5,)]


def test_peak_beside_rms_is_refused(tmp_path):
    text = "f,P1 x Re [m/s rms],P1 x Im [m/s rms],P2 x Re [m/s],P2 x Im [m/s]\n100,1,1,1,1\n200,1,1,1,1\n"
    text = text.replace("f,", "f [Hz],", 1)
    assert [fault.thing for fault in faults(written(tmp_path, text))] == ["the units of the amplitudes"]


def test_fastscan_of_a_folder_and_of_one_file(tmp_path):
    blocks = [fastscan(freq, PLACES_M, VELOCITY[:, :, k]) for k, freq in enumerate(FREQ_HZ)]
    for number, block in enumerate(blocks[::-1]):
        written(tmp_path, block, f"scan/band{number}.txt")
    folder = read_file(tmp_path / "scan", FileFacts())
    assert np.allclose(folder.value, VELOCITY.reshape(9, -1), rtol=1e-11)
    comma = b"\r\n".join(fastscan(f, PLACES_M, VELOCITY[:, :, k], comma=True) for k, f in enumerate(FREQ_HZ))
    single = read_file(written(tmp_path, comma, "a.txt"), FileFacts())
    assert np.allclose(single.value, folder.value, rtol=1e-11)
    assert "axes_from_beams" in {notice.code for notice in folder.notices}


SCANS = {
    "one frequency twice": ([fastscan(400, PLACES_M, VELOCITY[:, :, 0])] * 2, "the frequencies"),
    "two scans": (
        [
            fastscan(400, PLACES_M, VELOCITY[:, :, 0]),
            fastscan(500, PLACES_M, VELOCITY[:, :, 0]).replace(b"ear.svd", b"old.svd"),
        ],
        "the tables",
    ),
    "points that move": (
        [fastscan(400, PLACES_M, VELOCITY[:, :, 0]), fastscan(500, 2 * PLACES_M, VELOCITY[:, :, 0])],
        "the tables",
    ),
    "decibels": ([fastscan(400, PLACES_M, VELOCITY[:, :, 0], "dB")], "the unit of Real X, Real Y, Real Z"),
    "a row cut short": ([fastscan(400, PLACES_M, VELOCITY[:, :, 0]).rsplit(b"\t", 1)[0]], "a row"),
}


@pytest.mark.parametrize("name", SCANS)
def test_refusals_of_fastscans(name, tmp_path):
    blocks, thing = SCANS[name]
    assert thing in {fault.thing for fault in faults(written(tmp_path, b"\r\n".join(blocks), "a.txt"))}


@pytest.mark.parametrize(("number", "comma"), [(b"1,150", False), (b"1.150", True), (b"1.150,0", True)])
def test_frequencies_with_marks_of_thousands_are_refused(number, comma, tmp_path):
    """Against the decimals of the rows: the last line would be read as 1.15 Hz."""
    block = fastscan(1150, PLACES_M, VELOCITY[:, :, 3], comma=comma).replace(b"1150 Hz", number + b" Hz")
    (fault,) = faults(written(tmp_path, block, "a.txt"))
    assert "thousands" in fault.expected


def test_rms_of_the_signal_holds_for_its_columns(tmp_path):
    block = point_block(1, VELOCITY[0, 0], PLACES_M[0], component="-Z").replace(
        b"Velocity -", b"RMS Velocity -"
    )
    recording = read_file(written(tmp_path, block, "a.txt"), FileFacts())
    assert np.allclose(recording.value[0], np.sqrt(2.0) * VELOCITY[0, 0], rtol=1e-11)
    assert "amplitude" not in recording.lacks


def test_rms_of_a_name_holds_for_its_column(tmp_path):
    text = wide_table().replace(" Mag", " RMS Mag")
    recording = read_file(written(tmp_path, text), FileFacts())
    assert np.allclose(recording.value, np.sqrt(2.0) * VELOCITY.reshape(9, -1), rtol=1e-12)
    assert recording.points[:4] == ("1", "1", "1", "2")


def test_rows_that_a_table_of_a_point_lacks_count_as_missing_with_a_notice(tmp_path):
    blocks = [point_block(number, VELOCITY[number], PLACES_M[number]) for number in (0, 1)]
    short = blocks[1].rsplit(b"\r\n", 3)[0] + b"\r\n#400\t1\t2"
    path = written(tmp_path, b"\r\n".join([blocks[0], short]), "a.txt")
    texts = [notice.text for notice in read_measurement([path]).notices if notice.code == "file_read"]
    assert any(text.startswith("6 readings of 3 channels") for text in texts)
    assert any("begin with #" in text for text in texts)


ALIENS = {
    "complex numbers in cells": ("Frequency [Hz],P1 x [m/s]\n400,1+2i\n500,2-3i\n", "column P1 x"),
    "parts that no column names": ("Frequency [Hz],P1 x [m/s]\n400,1\n500,2\n", "the columns"),
    "angular frequencies": ("Frequency [rad/s],x Re [m],x Im [m]\n400,1,2\n", "the unit of the frequencies"),
    "a tidy table without points": ("freq_hz,dir_x,re_m_s,im_m_s\n400,1,1,2\n", "the table"),
    "a tidy table without directions": ("freq_hz,re_m_s,im_m_s\n400,1,2\n", "the table"),
}


@pytest.mark.parametrize("name", ALIENS)
def test_a_table_is_refused_as_what_it_is_nearest_to(name, tmp_path):
    text, thing = ALIENS[name]
    assert {fault.thing for fault in faults(written(tmp_path, text))} == {thing}
