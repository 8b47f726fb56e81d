"""Polytec scan files against the universal file that Polytec's program exported of the same scan."""

import gzip
from pathlib import Path

import numpy as np
import olefile
import pytest

import kinematics
from kinematics.api import read_vibrometer
from kinematics.readers.formats import read_file
from kinematics.readers.stated_by_user import FileFacts
from stapeskit.faults import StapeskitError

DATA = Path(__file__).parent / "data"
SHARED = Path(kinematics.__file__).parents[2] / "shared" / "data" / "polytec_psv"
ROUNDING = 5e-6  # of the export: six digits
CROSS = "AVG[CP[S[T[0]],S[T[1]]]]"


@pytest.fixture(scope="module")
def export(tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "surface.unv"
    path.write_bytes(gzip.decompress((DATA / "surface_h1_receptance.unv.gz").read_bytes()))
    return read_file(path, FileFacts())


def test_h1_positions_direction_and_reference_are_those_of_the_export(export):
    scan = read_vibrometer(DATA / "surface.svd")
    assert np.array_equal(scan.freq_hz, export.freq_hz)
    assert np.array_equal(scan.points_m, export.points_m)
    assert np.array_equal(scan.directions, export.directions)
    assert scan.points == export.points
    assert (scan.units, scan.reference, export.units) == ("(m/s)/N", "N", "(m)/N")
    receptance = scan.frf / (2j * np.pi * scan.freq_hz)
    largest = np.max(np.abs(export.value), axis=1, keepdims=True)
    assert np.max(np.abs(receptance - export.value) / largest) < ROUNDING
    assert np.linalg.norm(receptance - export.value) < ROUNDING * np.linalg.norm(export.value)


def test_coherence_gives_the_noise():
    """The sd is that of Bendat and Piersol with the averages that the file names."""
    scan = read_vibrometer(DATA / "surface.svd")
    gamma = scan.coherence
    assert np.all((gamma > 0.0) & (gamma <= 1.0))
    assert np.all(scan.n_avg == scan.n_avg[0, 0])
    assert scan.n_avg[0, 0] > 1
    assert np.allclose(scan.sd, np.abs(scan.value) * np.sqrt((1 - gamma) / (2 * scan.n_avg * gamma)))


def test_the_object_shows_itself():
    scan = read_vibrometer(DATA / "surface.svd")
    frame = scan.to_frame()
    assert len(frame) == 25 * 571
    assert {"point", "dir_x", "x_m", "freq_hz", "re", "im", "sd", "coherence", "n_avg"} <= set(frame.columns)
    assert np.allclose(frame["re"][:571], scan.value[0].real)
    figure = scan.plot()
    assert len(figure.axes) == 2
    assert hasattr(figure, "_repr_png_")
    assert "25 channels at 25 points" in repr(scan)


@pytest.mark.shared
def test_the_shared_pair_is_the_one_here():
    assert (SHARED / "surface.svd").read_bytes() == (DATA / "surface.svd").read_bytes()
    recording = read_file(SHARED / "surface_h1_receptance.unv", FileFacts())
    assert recording.value.shape == (25, 571)


def changed(folder, stream, at, content):
    """The scan with some bytes of a stream replaced."""
    path = folder / "a.svd"
    path.write_bytes((DATA / "surface.svd").read_bytes())
    with olefile.OleFileIO(path, write_mode=True) as file:
        old = file.openstream(stream).read()
        file.write_stream(stream, old[:at] + content + old[at + len(content) :])
    return path


# What another mode, version or scan would have there: averaging (2 is complex), versions, the quantity of the
# vibrometer (12 is velocity), the number of points, which record is whose, the number of lines.
OTHERS = {
    "another averaging": ("Info/DAQ_Settings_Fft/Average", 4, b"\x01", "the averaging"),
    "no averages": ("Info/DAQ_Settings_Fft/Average", 12, b"\x00", "the averaging"),
    "another layout": ("Info/Geometry/MeasPoints", 0, b"\x08", "the layout of Info/Geometry/MeasPoints"),
    "a displacement": ("Polytec_Data/M0/Static_Info", 76, b"\x0b", "the quantity of the vibrometer"),
    "more points": ("Info/Geometry/MeasPoints", 90, b"\x1a", "the scan file"),
    "another length": ("Polytec_Data/M0/Media_Type", 98, b"\x2c", f"the frequencies of {CROSS}"),
    "another sampling": ("Info/DAQ_Settings_Fft/Fft", 16, b"\x41", f"the frequencies of {CROSS}"),
    "exchanged records": ("Polytec_Data/M0/ManyStreamsData-0", 40, b"\x05", f"a record of {CROSS}"),
}  # fmt: skip


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_not_recognised_is_refused_with_how_to_export(name, tmp_path):
    stream, at, content, thing = OTHERS[name]
    with pytest.raises(StapeskitError) as caught:
        read_vibrometer(changed(tmp_path, stream, at, content))
    fault = caught.value.faults[0]
    assert fault.thing == thing
    assert "universal file" in fault.next_step


@pytest.mark.parametrize(
    ("code", "direction"),
    [(0, (np.nan,) * 3), (2, (1, 0, 0)), (3, (-1, 0, 0)), (4, (0, 1, 0)), (6, (0, 0, 1))],
)
def test_directions_by_their_codes(code, direction, tmp_path):
    """Of the first channel; those beyond exports are reported as assumed, unknown ones left to the user."""
    recording = read_vibrometer(changed(tmp_path, "Info/DAQ_Settings_Fft/Channels", 20, bytes([code])))
    assert np.array_equal(recording.directions[0], direction, equal_nan=True)
    assert ("axes_assumed" in {notice.code for notice in recording.notices}) == (code == 6)


@pytest.mark.parametrize("medium", ["M3", "M4"])
def test_auto_powers_that_a_damage_made_smaller_are_refused(medium, tmp_path):
    """A coherence above 1 was taken as 1, with a noise of 0."""
    with pytest.raises(StapeskitError) as caught:
        read_vibrometer(
            changed(tmp_path, f"Polytec_Data/{medium}/ManyStreamsData-0", 8 + 248 + 400, b"\0" * 64)
        )
    assert caught.value.faults[0].thing == "the coherence"


def test_points_without_a_record_are_left_out(tmp_path):
    path = tmp_path / "a.svd"
    path.write_bytes((DATA / "surface.svd").read_bytes())
    whole = read_vibrometer(path)
    with olefile.OleFileIO(path, write_mode=True) as file:
        for medium in ("M0", "M3", "M4"):
            name = f"Polytec_Data/{medium}/ManyStreamsInfo"
            info = np.frombuffer(file.openstream(name).read(), "<i4").copy()
            info[
                6 + 25 + 2 * 7 + 1
            ] = -1  # the record of point 8: pairs of length and record behind 25 numbers
            file.write_stream(name, info.tobytes())
    lacking = read_vibrometer(path)
    assert lacking.points == tuple(point for point in whole.points if point != "8")
    assert np.array_equal(lacking.value, np.delete(whole.value, 7, axis=0))
    assert "zero_rows" in {notice.code for notice in lacking.notices}
