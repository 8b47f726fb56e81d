"""Universal files: forms of numbers, geometry, units, coherence, runs, and what is refused."""

import gzip
from pathlib import Path

import numpy as np
import pytest

import kinematics
from kinematics.fit.beams import beam_set
from kinematics.fit.rigid_fit import fit_lines
from kinematics.readers.assemble import read_measurement
from kinematics.readers.formats import read_file
from kinematics.readers.stated_by_user import FileFacts
from stapeskit.faults import StapeskitError
from tests.motion_files.written_files import (
    COHERENCE,
    DISPLACEMENT,
    FORCE,
    FREQ_HZ,
    TIME,
    VELOCITIES,
    VELOCITY,
    function,
    nodes_15,
    nodes_2411,
    system_18,
    system_2420,
    units,
    universal_file,
)

DATA = Path(__file__).parent / "data"
SHARED = Path(kinematics.__file__).parents[2] / "shared" / "data" / "uff"
VALUE = VELOCITY[0, 0]
PLACE = {1: (0.5, 0.0, 0.0)}


def read(folder, *parts, name="a.uff"):
    path = folder / name
    path.write_bytes(b"".join(parts))
    return read_file(path, FileFacts())


def faults(folder, *parts):
    with pytest.raises(StapeskitError) as caught:
        read(folder, *parts)
    return caught.value.faults


@pytest.mark.parametrize("binary", ["", "<"])
def test_micro_in_latin_1(binary, tmp_path):
    part = function(FREQ_HZ, 1e6 * VALUE, unit="µm/s", binary=binary)
    assert b"\xb5m/s" in part
    assert np.allclose(read(tmp_path, units(), nodes_2411(PLACE), part).value[0], VALUE, rtol=1e-11)


@pytest.mark.parametrize("binary", ["", "<", ">"])
@pytest.mark.parametrize(("form", "even"), [(5, True), (5, False), (6, True), (6, False)])
def test_every_form_of_numbers(form, even, binary, tmp_path):
    recording = read(
        tmp_path, units(), nodes_2411(PLACE), function(FREQ_HZ, VALUE, form=form, even=even, binary=binary)
    )
    digits = 1e-5 if form == 5 else 1e-11
    assert np.allclose(recording.value[0], VALUE, rtol=digits)
    assert np.allclose(recording.freq_hz, FREQ_HZ)


WRITINGS = {
    "windows": lambda text: text.replace(b"\n", b"\r\n"),
    "padded": lambda text: b"\n".join(line.ljust(80) for line in text.split(b"\n")),
    "fortran": lambda text: text.replace(b"E-0", b"D-0"),
    "end mark": lambda text: text + b"\x1a",
    "byte order mark": lambda text: b"\xef\xbb\xbf" + text,
    "a blank line first": lambda text: b"\n" + text,
}


@pytest.mark.parametrize("name", WRITINGS)
def test_writings_of_other_programs(name, tmp_path):
    recording = read(tmp_path, WRITINGS[name](universal_file()))
    assert np.allclose(recording.value, VELOCITY.reshape(9, -1), rtol=1e-11)


def test_units_of_positions_and_values(tmp_path):
    """Dataset 164: SI = file value / factor, also for values without a unit of their own."""
    millimetres = read(tmp_path, units(1e3), nodes_15({1: (5e2, 0.0, 0.0)}), function(FREQ_HZ, VALUE))
    assert np.allclose(millimetres.points_m[0], PLACE[1])
    assert np.allclose(millimetres.value[0], VALUE)
    silent = read(tmp_path, units(1e3), nodes_2411(PLACE), function(FREQ_HZ, 1e3 * VALUE, unit="NONE"))
    assert np.allclose(silent.value[0], VALUE)
    scaled = read(tmp_path, units(), nodes_2411(PLACE), function(FREQ_HZ, 1e6 * VALUE, unit="um/s"))
    assert np.allclose(scaled.value[0], VALUE)


@pytest.mark.parametrize(("factor", "unit", "named"), [(1e3, "m/s", 1), (1.0, "um/s", 1), (1e3, "mm/s", 0)])
def test_a_label_that_contradicts_dataset_164_is_reported(factor, unit, named, tmp_path):
    parts = (units(factor), nodes_2411(PLACE), function(FREQ_HZ, VALUE, unit=unit))
    texts = [notice.text for notice in read(tmp_path, *parts).notices if "dataset 164" in notice.text]
    assert len(texts) == named
    assert all(unit in text for text in texts)


def test_a_reference_without_a_label_is_in_the_units_of_dataset_164(tmp_path):
    """In mm, motion over motion is a ratio; in mm and kN, 1 mm/s over 1 kN is 1e-6 m/s over 1 N."""
    system = units(1e3).replace(f"{1.0:25.16E}".replace("E", "D").encode(), b"1.0D-3".rjust(25), 1)
    for quantity, per, scale in ((VELOCITIES, "m/s", 1.0), (FORCE, "N", 1e-6)):
        part = function(FREQ_HZ, VALUE, unit="NONE", per=quantity)
        recording = read(tmp_path, system, nodes_2411(PLACE), part)
        assert np.allclose(recording.value[0], scale * VALUE, rtol=1e-11)
        assert recording.reference == per


def test_a_response_is_per_unit_of_its_reference(tmp_path):
    response = function(FREQ_HZ, VALUE, per=FORCE, quantity=DISPLACEMENT, unit="m", reference=(2, 3))
    recording = read(tmp_path, units(), nodes_2411(PLACE), response)
    assert (recording.quantity, recording.reference, recording.units) == ("displacement", "N", "(m)/N")
    assert recording.frf is not None
    assert recording.velocity is None


TURNED = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]


@pytest.mark.parametrize(
    "described",
    [
        lambda origin: system_18(7, origin, np.add(origin, [0, 1, 0]), np.add(origin, [0, 1, 1])),
        lambda origin: system_2420(7, TURNED, origin),
    ],
    ids=["18", "2420"],
)
def test_directions_and_places_are_those_of_the_systems_of_a_node(described, tmp_path):
    """+x of the system points along +y, +z along +z: a third axis follows by the right hand."""
    parts = [function(FREQ_HZ, VALUE, 1, code) for code in (1, 2, -3)]
    for nodes in (nodes_15, nodes_2411):  # a place of dataset 2411 is in the global system
        recording = read(tmp_path, units(), described((1, 1, 1)), nodes(PLACE, measured=7), *parts)
        assert np.allclose(recording.directions, [[0, 1, 0], [-1, 0, 0], [0, 0, -1]])
        assert np.allclose(recording.points_m[0], PLACE[1])
    recording = read(tmp_path, units(), described((1, 0, 0)), nodes_15(PLACE, defined=7), *parts)
    assert np.allclose(recording.directions, [[1, 0, 0], [0, 1, 0], [0, 0, -1]])
    assert np.allclose(recording.points_m[0], np.array([1, 0, 0]) + PLACE[1] @ np.array(TURNED))


BAD_SYSTEMS = {
    "curved": system_18(7, (0, 0, 0), (1, 0, 0), (1, 0, 1), shape=1),
    "in another one": system_18(7, (0, 0, 0), (1, 0, 0), (1, 0, 1), parent=3),
    "without axes": system_18(7, (0, 0, 0), (0, 0, 0), (1, 0, 1)),
    "left-handed": system_2420(7, np.diag([1, 1, -1]), (0, 0, 0)),
}


@pytest.mark.parametrize("name", BAD_SYSTEMS)
def test_nodes_in_a_system_that_is_not_cartesian_are_refused(name, tmp_path):
    parts = (units(), BAD_SYSTEMS[name], nodes_15(PLACE, measured=7), function(FREQ_HZ, VALUE))
    assert [fault.thing for fault in faults(tmp_path, *parts)] == ["coordinate system 7"]


def test_nodes_of_2411_in_a_system_that_turns_are_refused(tmp_path):
    """Programs differ in whether they are in the part's axes or in their export system."""
    nodes = nodes_2411(PLACE).replace(f"{1:10d}{0:10d}".encode(), f"{1:10d}{7:10d}".encode())
    parts = (units(), system_2420(7, TURNED, [1, 1, 1]), nodes, function(FREQ_HZ, VALUE))
    assert [fault.thing for fault in faults(tmp_path, *parts)] == ["the nodes of dataset 2411 in system 7"]


def test_a_system_that_no_dataset_describes_is_the_global_one_with_a_warning(tmp_path):
    parts = [function(FREQ_HZ, VALUE, 1, code) for code in (1, -3)]
    recording = read(tmp_path, units(), nodes_15(PLACE, measured=7), *parts)
    assert np.array_equal(recording.directions, [[1, 0, 0], [0, 0, -1]])
    assert "axes_assumed" in {notice.code for notice in recording.notices}


def test_coherence_belongs_to_its_response(tmp_path):
    gamma = np.array([0.9, 0.8, 0.7, 0.6])
    recording = read(
        tmp_path, units(), nodes_2411(PLACE), function(FREQ_HZ, VALUE, per=FORCE, reference=(2, 3)),
        function(FREQ_HZ, gamma, kind=COHERENCE, form=4, quantity=0, unit="NONE", reference=(2, 3)),
    )  # fmt: skip
    assert np.allclose(recording.coherence[0], gamma)


def test_coherence_at_other_lines_is_refused_and_that_of_another_reference_left_out(tmp_path):
    response = function(FREQ_HZ, VALUE, per=FORCE, reference=(2, 3))
    gamma = {"kind": COHERENCE, "form": 4, "quantity": 0, "unit": "NONE"}
    for lines in (FREQ_HZ + 50.0, FREQ_HZ[::-1]):
        (fault,) = faults(
            tmp_path, units(), nodes_2411(PLACE), response,
            function(lines, np.full(4, 0.9), reference=(2, 3), **gamma),
        )  # fmt: skip
        assert fault.thing == "the coherence"
    others = [function(FREQ_HZ, np.full(4, 0.1 * node), reference=(node, 3), **gamma) for node in (2, 3)]
    assert np.allclose(read(tmp_path, units(), nodes_2411(PLACE), response, *others).coherence, 0.2)


def test_frequencies_are_in_the_unit_of_their_axis(tmp_path):
    """Not 0.4 Hz for 0.4 kHz; angular frequencies are none."""
    labels = [
        function(freq, VALUE).replace(b"Hz ".ljust(20), unit.ljust(20))
        for freq, unit in ((FREQ_HZ / 1e3, b"kHz"), (FREQ_HZ, b"rad/s"))
    ]
    assert np.allclose(read(tmp_path, units(), nodes_2411(PLACE), labels[0]).freq_hz, FREQ_HZ)
    assert "over something else" in faults(tmp_path, units(), nodes_2411(PLACE), labels[1])[0].got


def test_two_excitations_in_one_file_are_refused(tmp_path):
    """Also where they have no node in common: body and base of two excitations are no one motion."""
    nodes = nodes_2411({1: (0.5, 0.0, 0.0), 2: (0.0, 0.5, 0.0)})
    for parts in (
        [function(FREQ_HZ, VALUE, per=FORCE, reference=(node, 3)) for node in (8, 9)],
        [function(FREQ_HZ, VALUE, node, per=FORCE, reference=(7 + node, 3)) for node in (1, 2)],
        [function(FREQ_HZ, VALUE, load_case=case) for case in (1, 2)],
        [function(FREQ_HZ, VALUE, case, load_case=case) for case in (1, 2)],
    ):
        assert [fault.thing for fault in faults(tmp_path, units(), nodes, *parts)] == ["the functions"]
    twice = [function(FREQ_HZ, VALUE, version=version) for version in (1, 2)]
    assert [fault.thing for fault in faults(tmp_path, units(), nodes, *twice)] == ["the channel 1 (z)"]


def test_a_dc_line_is_dropped(tmp_path):
    recording = read(tmp_path, units(), nodes_2411(PLACE), function([0.0, 100.0, 200.0], VALUE[:3]))
    assert np.allclose(recording.freq_hz, [100.0, 200.0])
    assert any(notice.code == "file_read" and "0 Hz" in notice.text for notice in recording.notices)


REFUSED = {
    "a rotation": (function(FREQ_HZ, VALUE, 1, 5), "a universal file"),
    "fewer values": (function(FREQ_HZ, VALUE, count=9), "a dataset"),
    "quantity and unit": (function(FREQ_HZ, VALUE, quantity=DISPLACEMENT), "a universal file"),
    "one frequency twice": (function([1.0, 1.0, 2.0, 3.0], VALUE, even=False), "the frequencies"),
    "time alone": (function(FREQ_HZ, VALUE.real, kind=TIME, form=4, abscissa=17), "a universal file"),
    "two units": (units(1e3) + function(FREQ_HZ, VALUE), "the length factor of dataset 164"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refusals(name, tmp_path):
    part, thing = REFUSED[name]
    assert [fault.thing for fault in faults(tmp_path, units(), nodes_2411(PLACE), part)] == [thing]


def test_directions_that_stand_in_the_text_alone_are_refused(tmp_path):
    """+z in record 6 of every function, three of a node or one of each node."""
    nodes = nodes_2411({node: (0.1 * node, 0.0, 0.0) for node in (1, 2, 3)})
    for functions in ([(1, axis) for axis in "XYZ"], list(enumerate("XYZ", 1))):
        parts = [function(FREQ_HZ, VALUE, node, 3, names=(f"Vib {axis}", "V")) for node, axis in functions]
        (fault,) = faults(tmp_path, units(), nodes, *parts)
        assert "record 6" in fault.next_step
    parts = [function(FREQ_HZ, VALUE, node, node, names=("Vib -Z", "V")) for node in (1, 3)]
    codes = [notice.code for notice in read(tmp_path, units(), nodes, *parts).notices]
    assert codes.count("axes_assumed") == 1


def test_a_genuine_export_is_fitted_as_by_plain_least_squares(tmp_path):
    """x, beta, gamma of 25 points with one head along -x, against numpy's least squares a line."""
    path = tmp_path / "surface.unv"
    path.write_bytes(gzip.decompress((DATA / "surface_h1_receptance.unv.gz").read_bytes()))
    measured = read_measurement([path], facts=FileFacts(body=("probe=1-25",)))
    body = measured.bodies[0]
    beams = beam_set(body.body, body.arms_m, body.directions, ("x", "beta", "gamma"))
    fitted = fit_lines(beams, body.value[0], np.ones(1), measured.per_displacement)
    _, y, z = body.positions_m.T
    base = body.directions[:, :1] * np.column_stack([np.ones(25), z, -y])
    expected = np.linalg.lstsq(base, body.value[0], rcond=None)[0]
    assert np.max(np.abs(fitted.q.T - expected)) < 1e-12 * np.max(np.abs(expected))


@pytest.mark.shared
@pytest.mark.parametrize("path", sorted(SHARED.glob("*")), ids=lambda path: path.name)
def test_universal_files_without_motion_are_refused_with_what_they_hold(path):
    """Files of pyuff and TestLab: time responses, geometry alone, and one that is no universal file."""
    with pytest.raises(StapeskitError) as caught:
        read_file(path, FileFacts())
    assert caught.value.faults[0].thing in {"a universal file", "the table", "the first line"}
