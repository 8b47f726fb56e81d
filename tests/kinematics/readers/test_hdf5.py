"""The HDF5 layout: written by Python and as MATLAB writes it, read back; what is wrong is said."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from legacy.kinematics.readers.hdf5 import read, write_hdf5
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics.readers.recordings import read_recordings

RNG = np.random.default_rng(0)
FREQ = np.linspace(100.0, 4000.0, 40)
VALUE = RNG.normal(size=(6, 40)) + 1j * RNG.normal(size=(6, 40))
BEAMS = np.tile(np.eye(3), (2, 1))
PLACES = RNG.normal(size=(6, 3))
NAMES = ["1", "1", "1", "ä2", "ä2", "ä2"]


def written(path, value=VALUE, **more):
    given = {
        "point": NAMES,
        "direction": BEAMS,
        "unit": "mm/s",
        "body": "stapes",
        "position_mm": PLACES,
        **more,
    }
    write_hdf5(path, FREQ, value, **given)
    return path


def test_round_trip(tmp_path):
    coherence = RNG.uniform(0.2, 1.0, VALUE.shape)
    path = written(tmp_path / "ldv.h5", sd=np.abs(VALUE), coherence=coherence, n_avg=np.arange(1.0, 7.0))
    found = read_recordings(path)
    assert found.amplitude_stated
    assert found.length_stated
    for k, one in enumerate(found.recordings):
        np.testing.assert_allclose(one.value, VALUE[k] * 1e-3, rtol=1e-15)
        np.testing.assert_allclose(one.sd, np.abs(VALUE[k]) * 1e-3, rtol=1e-15)
        np.testing.assert_array_equal(one.coherence, coherence[k])
        np.testing.assert_array_equal(one.freq_hz, FREQ)
        np.testing.assert_array_equal(one.position_mm, PLACES[k])
        np.testing.assert_array_equal(one.direction, BEAMS[k])
        assert (one.point, one.body, one.order, one.n_avg) == (NAMES[k], "stapes", 1, k + 1.0)


def test_runs_and_rms(tmp_path):
    value = np.stack([VALUE, 2.0 * VALUE])
    path = written(tmp_path / "ldv.h5", value, run=["y", "x"], amplitude="rms", unit="(m/s)/Pa")
    found = read(path)
    assert [one.run for one in found.recordings] == ["y"] * 6 + ["x"] * 6
    assert found.recordings[0].per == "Pa"
    np.testing.assert_allclose(found.recordings[7].value, 2.0 * VALUE[1] * np.sqrt(2.0))


@pytest.mark.parametrize("runs", [1, 2])
def test_as_matlab_writes_it(tmp_path, runs):
    """MATLAB reverses dimensions and writes texts most simply as attributes."""
    path = tmp_path / "ldv.h5"
    value = VALUE if runs == 1 else np.stack([VALUE, -VALUE])
    with h5py.File(path, "w") as file:
        file["freq_hz"] = FREQ[None]
        file["re"], file["im"] = value.T.real, value.T.imag
        file["direction"], file["position_mm"] = BEAMS.T, PLACES.T
        file["n_avg"] = np.array([[25.0]])
        file.attrs["unit"], file.attrs["amplitude"] = "m/s", np.bytes_("peak")
        file.attrs["schema"] = np.array([b"stapeskit.ldv/1"])
        file.attrs["body"], file.attrs["point"] = "base", ";".join(NAMES)
        file.attrs["convention"] = "-"
    found = read(path)
    assert len(found.recordings) == 6 * runs
    np.testing.assert_allclose(found.recordings[4].value, VALUE[4].conj())
    np.testing.assert_allclose(found.recordings[4].position_mm, PLACES[4])
    assert found.recordings[4].n_avg == 25.0
    assert {one.run for one in found.recordings} == ({""} if runs == 1 else {"1", "2"})


def test_compound_values_and_square_arrays_need_dims(tmp_path):
    path = tmp_path / "ldv.h5"
    with h5py.File(path, "w") as file:
        file["freq_hz"] = FREQ[:6]
        pairs = np.empty((6, 6), dtype=[("r", float), ("i", float)])
        pairs["r"], pairs["i"] = VALUE[:, :6].real.T, VALUE[:, :6].imag.T
        file["value"] = pairs
        file["direction"] = BEAMS.T
        file.attrs["unit"], file.attrs["point"] = "m", ";".join(NAMES)
    with pytest.raises(StapeskitError, match="the order of dimensions must be clear"):
        read(path)
    with h5py.File(path, "a") as file:
        file.attrs["dims"] = "freq,channel"
    np.testing.assert_allclose(read(path).recordings[2].value, VALUE[2, :6])


def test_other_layouts_by_name_or_mapping(tmp_path):
    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as file:
        file["scan/x"], file["scan/y"] = FREQ, VALUE
        file["scan/unit"] = "m/s"
    np.testing.assert_allclose(read(path).recordings[3].value, VALUE[3])
    (tmp_path / "map.toml").write_text(
        'frequency = "scan.x"\n[[signal]]\nvalue = "scan.y"\nunit = "nm"\ndirection = "-y"\n'
    )
    one = read(path, tmp_path / "map.toml").recordings[3]
    np.testing.assert_allclose(one.value, VALUE[3] * 1e-9)
    assert one.direction.tolist() == [0.0, -1.0, 0.0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.attrs.__setitem__("unit", "Pa"), "the attribute unit must be"),
        (lambda f: f.attrs.__delitem__("unit"), "the attribute unit must be .*; got none"),
        (lambda f: f.attrs.__setitem__("schema", "other/2"), "the attribute schema must be stapeskit.ldv/1"),
        (lambda f: f.attrs.__setitem__("amplitude", "pp"), "the attribute amplitude must be peak or rms"),
        (lambda f: f.attrs.__setitem__("convention", "i"), "the attribute convention must be"),
        (lambda f: f.attrs.__setitem__("dims", "a,b"), "the attribute dims must be"),
        (lambda f: f.attrs.__setitem__("dims", "freq,channel"), "the values must be as dims says"),
        (lambda f: f.__delitem__("im"), "the data set im must be in the file"),
        (lambda f: f.__delitem__("point"), "point must be the names of 6 channels; got none"),
        (lambda f: _replace(f, "freq_hz", FREQ[::-1]), "freq_hz must be ascending"),
        (lambda f: _replace(f, "freq_hz", FREQ[:7]), "the values must be of shape"),
        (lambda f: _replace(f, "im", np.zeros((2, 2))), "re and im must be of one shape"),
        (lambda f: _replace(f, "direction", np.eye(3)), r"direction must be numbers of shape \(6, 3\)"),
        (lambda f: _replace(f, "coherence", np.zeros((2, 5))), "coherence must be of shape"),
        (lambda f: f.attrs.__setitem__("run", "a;b"), "run must be 1 names; got 2"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, change, message):
    path = written(tmp_path / "ldv.h5")
    with h5py.File(path, "a") as file:
        change(file)
    with pytest.raises(StapeskitError, match=message):
        read(path)


def test_all_that_is_wrong_is_said_at_once(tmp_path):
    path = written(tmp_path / "ldv.h5")
    with h5py.File(path, "a") as file:
        file.attrs["unit"] = "furlong"
        file["direction"][3] = 0.0
        file["freq_hz"][0] = -5.0
        file["re"][2, 1] = np.inf
    with pytest.raises(StapeskitError) as caught:
        read(path)
    said = str(caught.value).splitlines()
    assert [line.split(" must be")[0] for line in said] == [
        "the attribute unit",
        "freq_hz",
        "the values",
        "direction",
    ]
    assert "at place 1, 3, 2" in said[2]


def _replace(file, name, values):
    if name in file:
        del file[name]
    file[name] = values


def test_the_writer_refuses_what_the_reader_would(tmp_path):
    path = tmp_path / "ldv.h5"
    with pytest.raises(StapeskitError, match="point must be 6 names"):
        written(path, point=["1"])
    assert not list(tmp_path.iterdir())


def test_sizes_that_the_file_cannot_hold(tmp_path):
    path = tmp_path / "ldv.h5"
    with h5py.File(path, "w") as file:
        file["freq_hz"] = FREQ
        file.create_dataset("re", shape=(10**8, 40), chunks=(1000, 40), dtype="f8")
        file.create_dataset("im", shape=(10**8, 40), chunks=(1000, 40), dtype="f8")
    with pytest.raises(StapeskitError, match="as large as the file can hold"):
        read(path)


def test_damaged_files_are_refused_in_a_sentence(tmp_path):
    whole = written(tmp_path / "ldv.h5").read_bytes()
    bad = tmp_path / "bad.h5"
    for length in np.linspace(8, len(whole) - 1, 20).astype(int):
        bad.write_bytes(whole[:length])
        with pytest.raises(StapeskitError):
            read(bad)


def test_the_example_of_the_page_runs(tmp_path, monkeypatch):
    page = (Path(__file__).parents[3] / "docs" / "vibrometer_files.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    exec(page.split("```python\n")[1].split("```")[0], {})
    found = read(tmp_path / "ldv.h5")
    assert [one.direction.tolist() for one in found.recordings] == np.eye(3).tolist()
    np.testing.assert_allclose(found.recordings[0].value, 1e-3)


def test_all_faults_of_a_file_are_told_together(tmp_path):
    path = written(tmp_path / "ldv.h5", sd=np.abs(VALUE))
    with h5py.File(path, "r+") as file:
        file.attrs["unit"], file.attrs["amplitude"] = "dB", "some"
        del file["sd"], file["position_mm"], file["point"]
        file["sd"] = np.ones((2, 40))
        file["coherence"] = np.full(VALUE.shape, b"x")
        file["position_mm"] = np.zeros((6, 2))
        file["point"] = ["1", "2"]
        file["direction"][2] = (0.0, 0.0, 2.0)
        file["re"][1, 3] = np.inf
    with pytest.raises(StapeskitError) as caught:
        read(path)
    told = str(caught.value).splitlines()
    expected = [
        'the attribute unit must be m, mm, um, nm; m/s, mm/s, um/s; m/s2, mm/s2, g; got "dB"',
        "the attribute amplitude must be peak or rms; got some",
        "point must be 6 names; got 2",
        "position_mm must be numbers of shape (6, 3); got (6, 2)",
        "sd must be of shape (6, 40) or (6,)",
        "coherence must be real numbers",
        "the values must be finite, or NaN where missing",
        "direction must be a unit vector (within 1e-3); got length 2 (ldv.h5, channel 3)",
    ]
    assert len(told) == len(expected)
    for words in expected:
        assert sum(words in line for line in told) == 1
    with h5py.File(path, "r+") as file:
        file["freq_hz"][4] = 1.0
    with pytest.raises(StapeskitError) as caught:
        read(path)
    assert "freq_hz must be ascending and finite; got 1 at place 5" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 3


@pytest.mark.parametrize(
    "numbers", [FREQ, VALUE.real, VALUE.imag, PLACES], ids=["freq", "re", "im", "places"]
)
def test_a_damaged_number_of_a_written_file_is_told(tmp_path, numbers):
    path = written(tmp_path / "ldv.h5")
    whole = path.read_bytes()
    place = whole.index(np.ascontiguousarray(numbers).tobytes()[:32]) + 6
    path.write_bytes(whole[:place] + bytes([whole[place] ^ 2]) + whole[place + 1 :])
    with pytest.raises(StapeskitError, match=r"ldv\.h5") as caught:
        read(path)
    assert " must be " in str(caught.value)
