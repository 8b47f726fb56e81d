"""MATLAB files in the layouts of File Access users, both versions; no vendor file was available."""

from __future__ import annotations

import struct
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from legacy.kinematics.cli import work
from legacy.kinematics.readers.containers.matlab_file import read_mat
from legacy.kinematics.readers.matlab.spectra import read
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics.readers.recordings import read_recordings
from tests.kinematics.written_mat import write_v73

pytestmark = pytest.mark.usefixtures("undrawn")

LINES, POINTS = 40, 7
RNG = np.random.default_rng(0)
FREQ = np.linspace(0.0, 3900.0, LINES)[None]
VALUE = RNG.normal(size=(POINTS, LINES)) + 1j * RNG.normal(size=(POINTS, LINES))
XYZ = RNG.normal(size=(POINTS, 3)) * 1e-3


def usd(unit="m/s", direction="ptcPlusZTranslation", **more):
    """Return the signal description that GetPointData returns."""
    return {
        "Name": "Velocity",
        "Complex": 1.0,
        "PowerSignal": 0.0,
        "Is3D": 0.0,
        "ResponseDOFs": {"ChannelName": "Vib", "Direction": direction, "Quantity": "Geschwindigkeit µ"},
        "XName": "Frequency",
        "XUnit": "Hz",
        "YUnit": unit,
        **more,
    }


def v5(path, variables):
    savemat(path, {name: _cells(value) for name, value in variables.items()})


def _cells(value):
    if isinstance(value, list):
        made = np.empty((1, len(value)), dtype=object)
        for k, one in enumerate(value):
            made[0, k] = _cells(one)
        return made
    return {key: _cells(one) for key, one in value.items()} if isinstance(value, dict) else value


@pytest.fixture(params=[v5, write_v73], ids=["v5", "v7.3"])
def file(request, tmp_path):
    """Return a function that writes variables and returns the path."""

    def write(**variables):
        request.param(tmp_path / "scan.mat", variables)
        return tmp_path / "scan.mat"

    return write


def values(found):
    return np.array([one.value for one in found.recordings])


def test_x_y_usd_and_positions(file):
    found = read_recordings(file(x=FREQ, y=VALUE, usd=usd("mm/s"), xyz=XYZ))
    np.testing.assert_allclose(values(found), VALUE * 1e-3)
    np.testing.assert_allclose([one.freq_hz for one in found.recordings], np.tile(FREQ, (POINTS, 1)))
    np.testing.assert_allclose([one.position_mm for one in found.recordings], XYZ * 1e3)
    assert [one.point for one in found.recordings] == [str(k + 1) for k in range(POINTS)]
    assert all(one.order == 1 and one.direction.tolist() == [0.0, 0.0, 1.0] for one in found.recordings)
    assert not found.length_stated
    assert not found.amplitude_stated


def test_real_and_imaginary_parts_in_turn(file):
    turns = np.empty((POINTS, 2 * LINES))
    turns[:, 0::2], turns[:, 1::2] = VALUE.real, VALUE.imag
    np.testing.assert_allclose(values(read(file(x=FREQ, y=turns, usd=usd()))), VALUE)


def test_separate_real_and_imaginary_variables(file):
    found = read(file(freq=FREQ, v_re=VALUE.real, v_im=VALUE.imag, unit="um/s"))
    np.testing.assert_allclose(values(found), VALUE * 1e-6)


def test_three_beams_by_their_names(file):
    beams = {f"amp_{axis}": VALUE * (k + 1) for k, axis in enumerate("xyz")}
    signs = {f"usd_{axis}": usd() for axis in "xyz"}
    found = read(
        file(freqp=FREQ, **beams, **signs, coh_x=np.full((POINTS, LINES), 0.5), xyz_mm=XYZ, n_avg=8.0)
    )
    np.testing.assert_allclose(values(found)[POINTS : 2 * POINTS], 2.0 * VALUE)
    assert [one.direction.tolist() for one in found.recordings[::POINTS]] == np.eye(3).tolist()
    np.testing.assert_allclose(found.recordings[0].position_mm, XYZ[0])
    assert found.recordings[0].coherence[3] == 0.5
    assert found.recordings[POINTS].coherence is None
    assert found.recordings[0].n_avg == 8.0
    assert found.length_stated


def test_three_beams_in_one_array(file):
    cube = np.stack([VALUE, 2.0 * VALUE, 3.0 * VALUE], axis=2)
    found = read(file(x=FREQ, y=cube, usd=usd()))
    np.testing.assert_allclose(values(found), np.concatenate([VALUE, 2.0 * VALUE, 3.0 * VALUE]))
    assert [one.direction.tolist() for one in found.recordings[::POINTS]] == np.eye(3).tolist()


def test_structs_are_runs(file):
    part = {"f": FREQ, "H1": VALUE, "usd": usd("m/s / V")}
    found = read(file(N1=part, N2={**part, "H1": -VALUE}))
    assert [one.run for one in found.recordings] == ["N1"] * POINTS + ["N2"] * POINTS
    np.testing.assert_allclose(values(found), np.concatenate([VALUE, -VALUE]))
    assert {one.per for one in found.recordings} == {"V"}


def test_a_struct_array_of_points(file):
    parts = [{"x": FREQ, "y": VALUE[k : k + 1], "usd": usd(), "name": f"p{k}"} for k in range(POINTS)]
    found = read(file(points=parts))
    np.testing.assert_allclose(values(found), VALUE)
    assert [one.point for one in found.recordings] == [f"p{k}" for k in range(POINTS)]


def test_cells_of_points_with_one_missing(file):
    rows = [VALUE[k : k + 1] for k in range(POINTS)]
    rows[2] = np.zeros((0, 0))
    found = read(file(x=FREQ, y=rows, usd=usd(), index=np.arange(11.0, 18.0)))
    assert np.all(np.isnan(found.recordings[2].value))
    np.testing.assert_allclose(values(found)[3:], VALUE[3:])
    assert found.recordings[3].point == "14"


def test_points_across_are_turned(file):
    np.testing.assert_allclose(values(read(file(x=FREQ.T, y=VALUE.T, usd=usd()))), VALUE)


@pytest.mark.parametrize(
    ("direction", "want"),
    [
        ("ptcMinusXTranslation", [-1, 0, 0]),
        (2.0, [0, 1, 0]),
        (-3.0, [0, 0, -1]),
        ("ptcVector", None),
        (7.0, None),
    ],
)
def test_directions_of_the_description(file, direction, want):
    got = read(file(x=FREQ, y=VALUE, usd=usd(direction=direction))).recordings[0].direction
    np.testing.assert_array_equal(got, np.full(3, np.nan) if want is None else want)


def test_a_mapping_says_which_variable_is_what(file, tmp_path):
    path = file(
        data={"f0": FREQ, "a": VALUE * np.sqrt(0.5), "c": np.full((POINTS, LINES), 0.9)},
        where=XYZ * 1e6,
        label=[f"q{k}" for k in range(POINTS)],
        beams=np.tile([0.0, 0.6, 0.8], (POINTS, 1)),
    )
    mapping = tmp_path / "scan.mat.toml"
    mapping.write_text(
        'frequency = "data.f0"\nposition = "where"\nposition_unit = "um"\npoints = "label"\n'
        'amplitude = "rms"\nconvention = "-"\nbody = "stapes"\n'
        '[[signal]]\nvalue = "data.a"\ndirection = "beams"\nunit = "nm"\ncoherence = "data.c"\nn_avg = 12\n'
        'run = "y"\n'
    )
    found = read(path)
    np.testing.assert_allclose(values(found), VALUE.conj() * 1e-9)
    one = found.recordings[1]
    assert (one.point, one.body, one.run, one.order, one.n_avg) == ("q1", "stapes", "y", 0, 12.0)
    np.testing.assert_allclose(one.position_mm, XYZ[1] * 1e3)
    np.testing.assert_allclose(one.direction, [0.0, 0.6, 0.8])
    assert found.amplitude_stated
    assert found.length_stated


def test_a_mapping_of_elements(file, tmp_path):
    parts = [{"w": VALUE[k : k + 1]} for k in range(POINTS)]
    path = file(ff=FREQ, scan=parts)
    mapping = tmp_path / "map.toml"
    mapping.write_text(
        'frequency = "ff"\neach = "scan"\n[[signal]]\nvalue = "w"\nunit = "m/s"\ndirection = [0, 0, 1]\n'
    )
    np.testing.assert_allclose(values(read(path, mapping)), VALUE)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frequency = 3\n", "frequency must be a text in quotes"),
        ('frequenzy = "x"\n', "Did you mean frequency"),
        ('frequency = "x"\n', "of one \\[\\[signal\\]\\] at least"),
        ("= 3", "a mapping must be a TOML file"),
        (
            'frequency = "x"\namplitude = "pk"\n[[signal]]\nvalue = "y"\n',
            "amplitude must be peak or rms; got pk",
        ),
        (
            'frequency = "x"\nposition_unit = "in"\n[[signal]]\nvalue = "y"\n',
            "position_unit must be m, mm or um",
        ),
        ('frequency = "x"\n[[signal]]\nunit = "m/s"\n', "given as value, or as value_re and value_im"),
        (
            'frequency = "x"\n[[signal]]\nvalue = "z"\n',
            "the variable z must be in the file; got no such one .*It holds x \\(1 x 40",
        ),
        (
            'frequency = "y"\n[[signal]]\nvalue = "y"\nunit = "m/s"\n',
            "the variable y must be real numbers; got complex",
        ),
        ('frequency = "x"\n[[signal]]\nvalue = "y"\nunit = "mph"\n', 'the unit of y must be .*got "mph"'),
        (
            'frequency = "x"\n[[signal]]\nvalue = "y"\nunit = "m/s"\nsd = "short"\n',
            "short must be|the variable short must be",
        ),
        (
            'frequency = "x"\n[[signal]]\nvalue = "y"\nunit = "m/s"\ndirection = [1, 0]\n',
            "direction must be x, -x",
        ),
        (
            'frequency = "x"\n[[signal]]\nvalue = "y"\nunit = "m/s"\nn_avg = 0\n',
            "n_avg must be a number from 1 on",
        ),
        ('frequency = "x"\npoints = "short"\n[[signal]]\nvalue = "y"\nunit = "m/s"\n', "7 different names"),
        (
            'frequency = "x"\nposition = "short"\n[[signal]]\nvalue = "y"\nunit = "m/s"\n',
            "points x 3, here 7 x 3",
        ),
        (
            'frequency = "x"\neach = "y"\n[[signal]]\nvalue = "y"\nunit = "m/s"\n',
            "a struct array or a cell array",
        ),
    ],
)
def test_faulty_mappings(tmp_path, text, message):
    v5(tmp_path / "scan.mat", {"x": FREQ, "y": VALUE, "short": np.arange(3.0)[None]})
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(StapeskitError, match=message):
        read(tmp_path / "scan.mat", tmp_path / "map.toml")


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"a": FREQ, "note": "hello"}, r"got the variables a \(1 x 40 numbers\), note \(text\)\..*--mapping"),
        ({"t": FREQ, "amp": VALUE.real}, "It holds time series: name its channels by --channels FILE"),
        ({"x": FREQ, "y": abs(VALUE), "usd": usd()}, "y must be complex; got real numbers"),
        ({"x": FREQ, "y": VALUE, "usd": usd(PowerSignal=1.0)}, "an amplitude spectrum; got a power"),
        ({"x": FREQ, "y": VALUE}, "the unit of y must be .*; got none"),
        ({"x": FREQ, "y": VALUE, "usd": usd("Pa")}, 'the unit of y must be .*; got "Pa"'),
        (
            {"x": FREQ, "y": VALUE, "usd": usd(), "xyz": XYZ[:3]},
            "xyz must be points x 3, here 7 x 3; got 3 x 3",
        ),
    ],
)
def test_what_cannot_be_read_is_said(file, variables, message):
    with pytest.raises(StapeskitError, match=message):
        read(file(**variables))


def test_damaged_files_are_refused_in_a_sentence(tmp_path):
    """Cut at many places, or with bytes changed: a sentence, or values; never another error."""
    rng = np.random.default_rng(1)
    for write in (v5, write_v73):
        path = tmp_path / "whole.mat"
        write(path, {"x": FREQ, "y": VALUE, "usd": usd(), "c": ["a", FREQ]})
        whole = path.read_bytes()
        cut = tmp_path / "cut.mat"
        for length in np.linspace(0, len(whole) - 1, 25).astype(int):
            cut.write_bytes(whole[:length])
            with pytest.raises(StapeskitError):
                read(cut)
        if write is write_v73:
            continue
        for _ in range(150):
            data = bytearray(whole)
            for place in rng.integers(0, len(whole), 4):
                data[place] = rng.integers(256)
            cut.write_bytes(bytes(data))
            with suppress(StapeskitError):
                read(cut)


def test_other_files_of_this_ending(tmp_path):
    path = tmp_path / "scan.mat"
    path.write_bytes(b"# Created by Octave 8.1\n# name: x\n")
    with pytest.raises(StapeskitError, match=r"must be a MATLAB file; got Octave's text format.*save -v7"):
        read(path)
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(600))
    with pytest.raises(StapeskitError, match="no HDF5 behind its header"):
        read(path)
    path.write_bytes(b"\0" * 200)
    with pytest.raises(StapeskitError, match=r"a MATLAB file of version 4 to 7\.3"):
        read(path)


def test_the_command_reads_a_mat_file(tmp_path):
    beams = {f"amp_{axis}": VALUE * 1e-3 for axis in "xyz"}
    variables = {"x": FREQ, **beams, **{f"usd_{axis}": usd() for axis in "xyz"}, "xyz": XYZ}
    v5(tmp_path / "scan.mat", variables)
    out = tmp_path / "dof.csv"
    options = ["--body", "stapes=1-7", "--amplitude", "rms", "--length-unit", "m", "--out", str(out)]
    _, outcome = work([str(tmp_path / "scan.mat"), *options])
    assert out.is_file()
    assert "dc_line" in {notice.code for notice in outcome.notices}
    (said,) = outcome.result["inputs_say"]
    assert said.startswith("scan.mat: ")
    assert ("input", said) in outcome.rows


def test_the_mapping_of_the_page_is_read(tmp_path):
    page = (Path(__file__).parents[3] / "docs" / "vibrometer_files.md").read_text(encoding="utf-8")
    (tmp_path / "map.toml").write_text(page.split("```toml\n")[1].split("```")[0])
    names = [f"n{k}" for k in range(POINTS)]
    data = {"f": FREQ, "vz": VALUE, "coh": np.full((POINTS, LINES), 0.5)}
    v5(tmp_path / "scan.mat", {"data": data, "where": XYZ, "names": names})
    one = read(tmp_path / "scan.mat", tmp_path / "map.toml").recordings[2]
    assert (one.point, one.coherence[0]) == ("n2", 0.5)
    np.testing.assert_allclose(one.value, VALUE[2] * 1e-3)
    np.testing.assert_allclose(one.position_mm, XYZ[2])


def test_objects_of_matlab_classes_are_left_out(tmp_path):
    """Strings, tables and the like are stored as numbers that mean nothing here."""
    path = tmp_path / "scan.mat"
    write_v73(path, {"x": FREQ, "y": VALUE, "usd": usd(), "names": np.arange(float(POINTS))})
    with h5py.File(path, "a") as file:
        file["names"].attrs["MATLAB_class"] = np.bytes_("string")
    assert [one.point for one in read(path).recordings] == [str(k + 1) for k in range(POINTS)]


def test_big_endian_files_are_read(tmp_path):
    """MATLAB on other machines wrote the most significant byte first."""
    numbers = FREQ.reshape(-1).astype(">f8").tobytes()
    name = b"freq\0\0\0\0"
    body = struct.pack(">II", 6, 8) + struct.pack(">II", 6, 0)
    body += struct.pack(">II", 5, 8) + struct.pack(">ii", 1, LINES)
    body += struct.pack(">II", 1, 4) + name + struct.pack(">II", 9, len(numbers)) + numbers
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x01\x00MI"
    path = tmp_path / "scan.mat"
    path.write_bytes(head + struct.pack(">II", 14, len(body)) + body)
    np.testing.assert_array_equal(read_mat(path)["freq"], FREQ)
