"""MATLAB and HDF5 files by names and structs; time series by a table of channels."""

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from kinematics.readers.formats import read_file
from kinematics.readers.stated_by_user import FileFacts
from stapeskit.faults import StapeskitError
from tests.motion_files.written_files import FREQ_HZ, PLACES_M, VELOCITY, matlab_variables, v73

Z = VELOCITY[:, 2]
USD = {"YUnit": "m/s", "ResponseDOFs": {"Direction": 3.0}}


def read(folder, variables, **options):
    savemat(folder / "a.mat", variables, **options)
    return read_file(folder / "a.mat", FileFacts())


def faults(folder, variables):
    with pytest.raises(StapeskitError) as caught:
        read(folder, variables)
    return caught.value.faults


def how_read(recording):
    return [notice.text for notice in recording.notices if notice.code == "file_read"]


LAYOUTS = {
    "one beam": {"x": FREQ_HZ, "y": Z, "usd": USD},
    "columns": {"f": FREQ_HZ[:, None], "Y": Z.T, "usd": USD},
    "parts": {"freq": FREQ_HZ, "v_re": Z.real, "v_im": Z.imag, "unit": "m/s"},
    "a struct array": {"pt": [{"x": FREQ_HZ, "y": row, "usd": USD} for row in Z]},
    "in a struct": {"data": {"x": FREQ_HZ, "y": Z, "usd": USD}},
    "micrometres": {"x": FREQ_HZ, "y": 1e6 * Z, "unit": "um/s"},
    "with noise": {"x": FREQ_HZ, "y": Z, "usd": USD, "coh": np.full(Z.shape, 0.5), "n_avg": 8.0},
    "a direction in words": {
        "x": FREQ_HZ,
        "y": Z,
        "usd": {"YUnit": "m/s", "ResponseDOFs": {"Direction": "ptcPlusZTranslation"}},
    },
    "a title": {"x": FREQ_HZ, "y": Z, "usd": USD, "name": "scan 3"},
    "an empty unit of frequencies": {"x": FREQ_HZ, "y": Z, "usd": {**USD, "XUnit": ""}},
    "kilohertz": {"x": FREQ_HZ / 1e3, "y": Z, "usd": {**USD, "XUnit": "kHz"}},
    "one axis a point in words": {
        "x": FREQ_HZ,
        "y": Z,
        "unit": "m/s",
        "direction": np.array(["z", "+z", "Z"]),
    },
    "named points": {"x": FREQ_HZ, "y": Z, "usd": USD, "names": np.array(["1", "2", "3"], dtype=object)},
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_by_their_names(name, tmp_path):
    recording = read(tmp_path, LAYOUTS[name])
    assert recording.points == ("1", "2", "3")
    assert np.allclose(recording.value, Z, rtol=1e-14)
    if "coh" in LAYOUTS[name]:
        assert np.all(recording.coherence == 0.5)
        assert np.all(recording.n_avg == 8.0)
    if "usd" in LAYOUTS[name]:
        assert np.allclose(recording.directions, [[0.0, 0.0, 1.0]] * 3)


def test_positions_of_three_points_are_in_the_order_of_the_values_and_named(tmp_path):
    (text,) = how_read(read(tmp_path, {**LAYOUTS["one beam"], "xyz": PLACES_M}))
    assert "xyz" in text
    assert how_read(read(tmp_path, LAYOUTS["one beam"])) == []
    (fault,) = faults(tmp_path, {**LAYOUTS["columns"], "xyz": PLACES_M})
    assert fault.thing == "the variable Y".lower()


def test_square_matrices_of_values_are_refused_but_for_those_that_read_alike_both_ways(tmp_path):
    square = {"x": FREQ_HZ[:3], "y": Z[:, :3], "usd": USD}
    assert [fault.thing for fault in faults(tmp_path, square)] == ["the variable y"]
    alike = Z[:, :3] + Z[:, :3].T
    assert np.array_equal(read(tmp_path, {**square, "y": alike}).value, alike)


def test_versions_of_matlab_files(tmp_path):
    """4 and 5 by scipy, 7.3 by h5py: the same recording."""
    variables = {**matlab_variables(), "unit": "m/s"}
    plain = {name: value for name, value in variables.items() if name != "usd"}
    v73(tmp_path / "b.mat", variables)
    versions = [read(tmp_path, plain, format=version) for version in ("4", "5")]
    for recording in [*versions, read(tmp_path, variables), read_file(tmp_path / "b.mat", FileFacts())]:
        assert np.allclose(recording.value.reshape(3, 3, -1).swapaxes(0, 1), VELOCITY)
        assert np.allclose(recording.points_m[:3], PLACES_M)
        assert np.array_equal(recording.directions, np.repeat(np.eye(3), 3, axis=0))


def test_values_of_unknown_names_are_not_left_out_in_silence(tmp_path):
    """Two of three beams would be missing; positions and times of another length are no values."""
    variables = {"x": FREQ_HZ, "amp_z": Z, "unit": "m/s", "vel_x": Z, "vel_y": Z.T, "note": np.arange(99.0)}
    (text,) = how_read(read(tmp_path, variables))
    assert all((name in text) is left for name, left in (("vel_x, vel_y", True), ("note", False)))
    assert how_read(read(tmp_path, LAYOUTS["with noise"])) == []


MISTAKES = {
    "kilohertz that nothing names": (
        {"f": FREQ_HZ / 1e3, "y": Z, "unit": "m/s"},
        "the unit of the frequencies",
    ),
    "heads of several directions": (
        {"x": FREQ_HZ, "y": Z, "usd": {**USD, "ResponseDOFs": [{"Direction": 1.0}, {"Direction": 3.0}]}},
        "the ResponseDOFs of usd",
    ),
    "no unit": ({"x": FREQ_HZ, "y": Z}, "the unit of y"),
    "angular frequencies": (
        {"x": FREQ_HZ, "y": Z, "usd": {**USD, "XUnit": "rad/s"}},
        "the unit of the frequencies",
    ),
    "a direction in other words": ({"x": FREQ_HZ, "y": Z, "unit": "m/s", "direction": "up"}, "direction"),
    "peak to peak": ({"x": FREQ_HZ, "y": Z, "unit": "m/s", "amplitude": "p-p"}, "the unit of y"),
    "a power": ({"x": FREQ_HZ, "y": Z, "usd": {**USD, "PowerSignal": 1.0}}, "y"),
    "a magnitude": ({"x": FREQ_HZ, "y": np.abs(Z), "usd": USD}, "the variable y"),
    "nothing": ({"a": 1.0}, "a.mat"),
    "two structs": ({name: {"x": FREQ_HZ, "y": Z, "usd": USD} for name in ("push", "tilt")}, "a.mat"),
    "another name": ({"x": FREQ_HZ, "speed": Z, "usd": USD}, "a.mat"),
    "too few positions": ({"x": FREQ_HZ, "y": Z, "usd": USD, "xyz": PLACES_M[:2]}, "the variable xyz"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes(name, tmp_path):
    variables, thing = MISTAKES[name]
    assert [fault.thing for fault in faults(tmp_path, variables)] == [thing]


@pytest.mark.parametrize("kind", ["string", "table"])
def test_newer_classes_of_matlab_are_named_with_the_cure(kind, tmp_path):
    """In version 7.3 they are data sets of their class that no library reads."""
    path = tmp_path / "a.mat"
    v73(path, {"x": FREQ_HZ, "y": Z})
    with h5py.File(path, "r+") as file:
        file["unit"] = np.zeros(6, dtype=np.uint32)
        file["unit"].attrs["MATLAB_class"] = np.bytes_(kind)
        file["unit"].attrs["MATLAB_object_decode"] = np.int32(3)
    with pytest.raises(StapeskitError) as caught:
        read_file(path, FileFacts())
    assert "unit" in caught.value.faults[0].got
    assert "cellstr" in caught.value.faults[0].next_step


def test_units_of_data_sets_are_read(tmp_path):
    """HDF5 holds them as attributes; one that contradicts the name is refused."""
    path = tmp_path / "a.h5"
    for name, factor in (("frequency", 1e-3), ("freq_hz", 1.0)):
        with h5py.File(path, "w") as file:
            group = file.create_group("scan")
            group["value"], group[name], group["position"] = 1e3 * Z, factor * FREQ_HZ, 1e3 * PLACES_M
            for key, unit in (("value", "mm/s"), (name, "kHz"), ("position", "mm")):
                group[key].attrs["unit"] = unit
            group.attrs["direction"] = "z"
        if name == "freq_hz":
            assert [fault.thing for fault in _refused(path).faults] == ["the unit of the frequencies"]
            return
        recording = read_file(path, FileFacts())
        assert np.allclose(recording.value, Z)
        assert np.allclose(recording.freq_hz, FREQ_HZ)
        assert np.allclose(recording.points_m, PLACES_M)


@pytest.mark.parametrize(("name", "unit"), [("xyz_mm", "m"), ("xyz", "furlong")])
def test_a_unit_of_positions_that_contradicts_their_name_or_is_unknown_is_refused(name, unit, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["value"], file["freq_hz"], file[name] = Z, FREQ_HZ, 1e3 * PLACES_M
        file["direction"] = "z"
        file[name].attrs["unit"] = unit
    assert {fault.thing for fault in _refused(tmp_path / "a.h5").faults} == {f"the unit of {name}"}


def _refused(path):
    with pytest.raises(StapeskitError) as caught:
        read_file(path, FileFacts())
    return caught.value


def multisine(noise=0.0, seconds=2.0, rate=8000.0, seed=4):
    """Responses of two points to a multisine drive of 0.1 s period: (time, drive, responses, freq, truth)."""
    rng = np.random.default_rng(seed)
    freq = np.arange(200.0, 1000.0, 50.0)
    truth = rng.normal(size=(2, len(freq))) + 1j * rng.normal(size=(2, len(freq)))
    time = np.arange(int(seconds * rate)) / rate
    turning = np.exp(1j * (2 * np.pi * freq[:, None] * time + rng.uniform(0, 2 * np.pi, (len(freq), 1))))
    responses = (truth @ turning).real
    responses += noise * rng.normal(size=responses.shape)
    return time, np.sum(turning.real, axis=0), responses, freq, truth


def channels(folder, rows, name="channels.csv"):
    path = folder / name
    path.write_text(
        "\n".join(["channel,role,body,point,dir,unit,sensitivity", *rows]) + "\n", encoding="utf-8"
    )
    return path


LISTED = ("a,response,stapes,1,z,mm/s,2", "b,response,stapes,2,z,mm/s,2", "d,reference,,,,V,")


@pytest.mark.parametrize("kind", ["npz", "csv", "mat"])
def test_series_of_every_kind_of_file(kind, tmp_path):
    time, drive, responses, freq, truth = multisine()
    path = tmp_path / f"a.{kind}"
    names = {"a": responses[0], "b": responses[1], "d": drive}
    if kind == "npz":
        np.savez(path, sample_rate_hz=8000.0, **names)
    elif kind == "mat":
        savemat(path, {"fs": 8000.0, **names})
    else:
        rows = [",".join(f"{v:.15g}" for v in row) for row in zip(time, *responses, drive, strict=True)]
        path.write_text("\n".join(["time_s,a,b,d", *rows]) + "\n", encoding="utf-8")
    facts = FileFacts(channels=channels(tmp_path, LISTED), period_s=0.1)
    recording = read_file(path, facts)
    assert np.allclose(recording.freq_hz, freq)
    assert np.allclose(recording.value, 2e-3 * truth, atol=1e-9)
    assert (recording.reference, recording.quantity) == ("V", "velocity")


@pytest.mark.parametrize(("name", "factor"), [("Time [s]", 1.0), ("Time [ms]", 1e3)])
def test_times_are_read_in_seconds_alone(name, factor, tmp_path):
    time, drive, responses, freq, _ = multisine()
    rows = [f"{factor * t:.9g},{a:.9g},{d:.9g}" for t, a, d in zip(time, responses[0], drive, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join([f"{name},a,d", *rows]) + "\n", encoding="utf-8")
    facts = FileFacts(channels=channels(tmp_path, (LISTED[0], LISTED[2])), period_s=0.1)
    if factor == 1.0:
        assert np.allclose(read_file(tmp_path / "a.csv", facts).freq_hz, freq)
        return
    with pytest.raises(StapeskitError) as caught:
        read_file(tmp_path / "a.csv", facts)
    assert "time_s" in caught.value.faults[0].got


def test_a_response_that_is_the_reference_is_one(tmp_path):
    """Its spectrum is real but for rounding: no second half of a whole transform."""
    drive = np.random.default_rng(2).normal(size=20_000)
    np.savez(tmp_path / "a.npz", fs=8000.0, a=drive, b=2.0 * drive, d=drive)
    recording = read_file(tmp_path / "a.npz", FileFacts(channels=channels(tmp_path, LISTED)))
    assert np.allclose(recording.value, [[2e-3], [4e-3]])


SERIES_MISTAKES = {
    "a missing channel": (["e,response,stapes,1,z,m/s,", "d,reference,,,,V,"], "channel e"),
    "no reference": (["a,response,stapes,1,z,m/s,"], "the table of channels"),
    "two references": (
        ["a,response,stapes,1,z,m/s,", "b,reference,,,,V,", "d,reference,,,,V,"],
        "the table of channels",
    ),
    "rms of samples": (["a,response,stapes,1,z,mm/s (rms),", "d,reference,,,,V,"], "unit"),
    "no unit": (["a,response,stapes,1,z,V,", "d,reference,,,,V,"], "unit"),
    "another direction": (["a,response,stapes,1,w,m/s,", "d,reference,,,,V,"], "dir"),
    "listed twice": (
        ["a,response,stapes,1,z,m/s,", "a,response,stapes,1,z,m/s,", "d,reference,,,,V,"],
        "channel a",
    ),
}


@pytest.mark.parametrize("name", SERIES_MISTAKES)
def test_mistakes_of_series(name, tmp_path):
    rows, thing = SERIES_MISTAKES[name]
    _, drive, responses, _, _ = multisine()
    np.savez(tmp_path / "a.npz", fs=8000.0, a=responses[0], b=responses[1], d=drive)
    with pytest.raises(StapeskitError) as caught:
        read_file(tmp_path / "a.npz", FileFacts(channels=channels(tmp_path, rows)))
    assert [fault.thing for fault in caught.value.faults] == [thing]


def test_several_records_in_one_variable_are_refused(tmp_path):
    """Six records of samples in columns would be interleaved: a phase slope six times too large."""
    samples = np.random.default_rng(1).normal(size=(512, 6))
    np.savez(tmp_path / "a.npz", fs=8000.0, a=samples, d=samples)
    rows = ["a,response,stapes,1,z,m/s,", "d,reference,,,,V,"]
    with pytest.raises(StapeskitError) as caught:
        read_file(tmp_path / "a.npz", FileFacts(channels=channels(tmp_path, rows)))
    assert sorted(fault.thing for fault in caught.value.faults) == ["the variable a", "the variable d"]


STUCK = {
    "as it is": (lambda signal: signal, False),
    "clipped": (lambda signal: np.clip(signal, np.quantile(signal, 0.1), None), True),
    "coarse steps": (lambda signal: np.round(signal, 1), False),
}


@pytest.mark.parametrize("name", STUCK)
def test_clipped_samples_are_reported(name, tmp_path):
    change, expected = STUCK[name]
    _, drive, responses, _, _ = multisine(noise=0.01)
    np.savez(tmp_path / "a.npz", fs=8000.0, a=change(responses[0]), b=responses[1], d=drive)
    recording = read_file(tmp_path / "a.npz", FileFacts(channels=channels(tmp_path, LISTED), period_s=0.1))
    found = [notice.text for notice in recording.notices if notice.code == "samples_stuck"]
    assert (len(found) > 0) is expected
    assert all(text.startswith("a of") for text in found)
