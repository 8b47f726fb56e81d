"""Wide tables: names that say what a column is, mappings, and the sample in four formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from legacy.kinematics.readers.input_options import InputOptions
from legacy.kinematics.readers.measurement_files import read_measurement
from legacy.kinematics.readers.recognise_format import format_of
from legacy.kinematics.readers.wide.columns import meaning
from legacy.kinematics.readers.wide.spectra import read
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics.readers.recordings import read_recordings

EXPORTS = Path(__file__).resolve().parents[3] / "sample_volumes" / "exports"
GOOD = "f,x Mag [m],x Phase\n100,2,30\n"
VALUE = 2e-3 * np.exp(1j * np.radians(30.0))


def written(folder, text, name="ldv.csv", encoding="utf-8"):
    path = folder / name
    path.write_text(text, encoding=encoding)
    return path


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("Vx Mag", ("amp", "", "x")),
        ("P12 Vz Phase", ("phase", "12", "z")),
        ("Point 3 - Vib -Z - Real", ("re", "3", "-z")),
        ("Imag(apex, y)", ("im", "apex", "y")),
        ("p4-z-coh", ("coherence", "4", "z")),  # a hyphen between words is no sign
        ("Betrag 7", ("amp", "7", "")),
        ("temperature", None),
        ("Mag Phase x", None),
    ],
)
def test_a_name_says_part_point_and_axis(name, told):
    assert meaning(name) == told


@pytest.mark.parametrize(
    "text",
    [
        "Frequency [Hz], Vx Mag [mm/s], Vx Phase [deg]\n100, 2, 30\n200, 2, 30\n",
        "f (kHz);Vx Amplitude (m/s);Vx Phase (rad)\n0,1;0,002;0,5235987756\n0,2;0,002;0,5235987756\n",
        "By a script\n\nFrequency\tVx Real\tVx Imag\nHz\tmm/s\tmm/s\n100\t1.7320508\t1\n200\t1.7320508\t1\n",
        "freq_khz,Vx Mag (m/s),Vx Phase (rad)\n0.1,0.002,0.5235987756\n0.2,0.002,0.5235987756\n",
        "Frequency kHz,Vx Mag (m/s),Vx Phase (rad)\n0.1,0.002,0.5235987756\n0.2,0.002,0.5235987756\n",
        "f,Vx Re,Vx Im,remark\nkHz,mm/s,mm/s\n0.1,1.7320508,1,\n0.2,1.7320508,1,\n",
        '"Freq [Hz]","Re{Vx} [um/s]","Im{Vx} [um/s]"\r\n100,1732.0508,1000\r\n200,1732.0508,1000\r\n',
    ],
)
def test_the_same_value_in_every_way_of_writing(tmp_path, text):
    path = written(tmp_path, text, "apex.csv")
    assert format_of(path).name == "wide"
    (one,) = read(path).recordings
    assert (one.point, one.order) == ("apex", 1)
    np.testing.assert_allclose(one.freq_hz, [100.0, 200.0])
    np.testing.assert_allclose(one.value, [VALUE, VALUE], rtol=1e-7)
    np.testing.assert_array_equal(one.direction, [1.0, 0.0, 0.0])


def test_rms_in_the_unit_is_turned_into_peak(tmp_path):
    (one,) = read(written(tmp_path, "f,z Mag [mm/s rms],z Phase\n100,2,30\n")).recordings
    np.testing.assert_allclose(one.value, [np.sqrt(2.0) * VALUE])


def test_a_mapping_names_the_columns_of_every_point(tmp_path):
    path = written(tmp_path, "F,A1,B1,C1,A2,B2,C2\n0.1,2,30,0.9,4,30,0.8\n")
    written(
        tmp_path,
        'frequency = "F"\nfrequency_unit = "kHz"\namplitude = "peak"\nconvention = "-"\n[[signal]]\n'
        'magnitude = "A{point}"\nphase = "B{point}"\ncoherence = "C{point}"\nn_avg = 20\nunit = "mm/s"\n'
        'direction = "-y"\nbody = "stapes"\n',
        "ldv.csv.toml",
    )
    assert format_of(path).name == "wide"
    read_it = read(path)
    assert read_it.amplitude_stated
    first, second = read_it.recordings
    assert (first.point, second.point, first.body, second.n_avg) == ("1", "2", "stapes", 20.0)
    np.testing.assert_allclose(second.value, [2.0 * np.conj(VALUE)])
    np.testing.assert_array_equal(first.direction, [0.0, -1.0, 0.0])
    assert second.coherence == pytest.approx([0.8])


@pytest.mark.parametrize(
    ("text", "mapping", "thing"),
    [
        ("f,x Mag [mm/s],y Phase\n100,2,30\n", "", "the column x Mag"),
        ("f,x Mag [dB],x Phase\n100,2,30\n", "", "the unit of x Mag"),
        ("f,x Mag,x Phase\n100,2,30\n", "", "the unit of x Mag"),
        ("f,x Mag [m],x Phase [grad]\n100,2,30\n", "", "the unit of the phase"),
        ("f,x Mag [m],x Phase\n200,2,30\n100,2,30\n150,2,30\n", "", "the frequencies"),
        ("f,x Mag [m],x Phase\n100,2,30\n200,2\n", "", "a row"),
        ("f,x Mag [m],x Phase\n100,2,30\n200,2,abc\n", "", "a cell"),
        (GOOD, '[[signal]]\nmagnitude = "xMag"\nphase = "x Phase"', "the column xMag"),
        (GOOD, '[[signal]]\nmagnitude = "x Mag"', "the columns of a signal"),
        (
            "f,A,A,B\n100,2,3,30\n",
            'frequency = "f"\n[[signal]]\nmagnitude = "A"\nphase = "B"\nunit = "m"',
            "the column A",
        ),
        (GOOD, '[[signal]]\nmagnitud = "x Mag"\nphase = "p"', "a key"),
        (GOOD, 'amplitude = "top"\n[[signal]]\nmagnitude = "x Mag"\nphase = "x Phase"', "amplitude"),
    ],
)
def test_what_cannot_be_told_is_refused(tmp_path, text, mapping, thing):
    path = written(tmp_path, text)
    if mapping:
        written(tmp_path, mapping, "ldv.csv.toml")
    with pytest.raises(StapeskitError) as caught:
        read(path)
    assert thing in [fault.thing for fault in caught.value.faults]


def test_the_sample_is_one_measurement_in_four_formats():
    def values(name):
        recordings = read_recordings(EXPORTS / name).recordings
        found = {(one.point, one.direction.tobytes()): one.value for one in recordings}
        return recordings[0].freq_hz, np.array([found[key] for key in sorted(found)])

    freq, first = values("scan.uff")
    for name in ("scan.mat", "wide.csv", "fastscan.txt"):
        other_freq, other = values(name)
        np.testing.assert_allclose(other_freq, freq, rtol=1e-5)
        np.testing.assert_allclose(other, first, atol=5e-4 * np.abs(first).max())


def test_a_stated_unit_of_length_is_reported():
    body = ("stapes=1-10", "base=11-19")
    read_it = read_measurement([EXPORTS / "fastscan.txt"], options=InputOptions(body=body, length_unit="m"))
    assert read_it.said == ("fastscan.txt: coordinates of the scan, positions without unit, as m, as stated",)
