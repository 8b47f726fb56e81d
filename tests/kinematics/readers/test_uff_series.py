"""Time responses in universal files: the same estimates as from other time series, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.kinematics.cli import work
from legacy.kinematics.options import SeriesOptions
from legacy.kinematics.readers.input_options import InputOptions
from legacy.kinematics.readers.series.frequency_responses import read as read_series
from legacy.kinematics.readers.uff.spectra import read
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics import written_uff as uff
from tests.kinematics.readers.recordings import read_recordings

pytestmark = pytest.mark.usefixtures("undrawn")

RATE, COUNT = 2000.0, 4096
TIME = np.arange(COUNT) / RATE
RNG = np.random.default_rng(3)
FORCE = RNG.standard_normal(COUNT)
# Two points: one follows the force two samples later, one against it; both with a little noise.
ANSWERS = {
    1: 2e-3 * np.roll(FORCE, 2) + 1e-4 * RNG.standard_normal(COUNT),
    2: -1e-3 * FORCE + 1e-4 * RNG.standard_normal(COUNT),
}


def signal(samples, node, direction=3, **how):
    """One record: velocity in mm/s unless said otherwise."""
    given = {"unit": "mm/s", "quantity": uff.VELOCITY, "form": 4, **how}
    return uff.function(TIME[: len(samples)], samples, node, direction, kind=uff.TIME, abscissa=17, **given)


def force(samples=FORCE, node=9, **how):
    return signal(samples, node, quantity=uff.FORCE, unit="N", **how)


def written(tmp_path, *parts):
    path = tmp_path / "scan.uff"
    path.write_bytes(b"".join([uff.units(), *parts]))
    return path


def responses(**how):
    return [signal(samples * 1e3, node, **how) for node, samples in ANSWERS.items()]


def fault(path, options=None):
    with pytest.raises(StapeskitError) as caught:
        read(path, options)
    return str(caught.value)


@pytest.fixture
def expected(tmp_path):
    """The estimates from the same samples in a NumPy archive."""
    table = tmp_path / "channels.csv"
    table.write_text(
        "channel,role,point,dir,unit\na,response,1,z,mm/s\nb,response,2,z,mm/s\nf,reference,,,N\n"
    )
    np.savez(tmp_path / "t.npz", a=ANSWERS[1] * 1e3, b=ANSWERS[2] * 1e3, f=FORCE, fs=RATE)
    return lambda **how: read_series(tmp_path / "t.npz", SeriesOptions(table, **how)).recordings


@pytest.mark.parametrize("how", [{}, {"frf": "h2"}, {"window": "none", "resolution_hz": 20.0}])
@pytest.mark.parametrize("binary", ["", "<", ">"])
def test_estimates_are_those_of_other_files(how, binary, expected, tmp_path):
    path = written(tmp_path, force(binary=binary), *responses(binary=binary))
    made = read_recordings(path, InputOptions(series=SeriesOptions(**how)))
    assert (made.amplitude_stated, made.from_series, made.file) == (True, True, "scan.uff")
    assert "reference 9+z" in made.frame_units
    for one, other in zip(made.recordings, expected(**how), strict=True):
        np.testing.assert_allclose(one.freq_hz, other.freq_hz, rtol=1e-9)
        np.testing.assert_allclose(one.value, other.value, rtol=1e-6)
        np.testing.assert_allclose(one.sd, other.sd, rtol=1e-6)
        np.testing.assert_allclose(one.coherence, other.coherence, rtol=1e-6)
        assert (one.point, one.order, one.per, one.n_avg) == (other.point, 1, "N", other.n_avg)
        assert one.direction.tolist() == [0.0, 0.0, 1.0]


def test_the_reference_is_told_by_what_responses_name_by_its_kind_or_by_the_option(tmp_path):
    named = written(tmp_path, *responses(reference=(7, 2)), signal(FORCE, 7, 2), force())
    made = read(named)
    assert {one.point for one in made.recordings} == {"1", "2"}
    assert {one.per for one in made.recordings} == {"m/s"}
    other = read(named, SeriesOptions(reference_channel="9+z"))
    assert {one.point for one in other.recordings} == {"1", "2", "7"}
    assert {one.per for one in other.recordings} == {"N"}
    assert read(named, SeriesOptions(reference_channel="9")).recordings[0].per == "N"
    for said in ("33", "Vib  Geschwindigkeit"):
        assert "--reference-channel must be one of 1+z, 2+z, 7+y, 9+z" in fault(
            named, SeriesOptions(reference_channel=said)
        )
    two = written(tmp_path, *responses(), force(), force(node=10))
    assert "must be one signal; got 9+z and 10+z" in fault(two)
    assert "got none among 1+z, 2+z" in fault(written(tmp_path, *responses()))


def test_several_records_are_averaged_and_load_cases_are_runs(tmp_path):
    half = COUNT // 2
    parts = []
    for version, part in enumerate((slice(0, half), slice(half, None)), 1):
        parts += [force(FORCE[part], version=version)]
        parts += [signal(a[part] * 1e3, node, version=version) for node, a in ANSWERS.items()]
    path = written(tmp_path, *parts)
    one = read(path, SeriesOptions(resolution_hz=20.0)).recordings
    assert len(one) == 2
    assert one[0].n_avg > 25.0
    parts = [force(load_case=case) for case in (1, 2)]
    parts += [signal(ANSWERS[1] * 1e3 * case, 1, load_case=case) for case in (1, 2)]
    made = read(written(tmp_path, *parts)).recordings
    assert [one.run for one in made] == ["case 1", "case 2"]
    np.testing.assert_allclose(made[1].value, 2.0 * made[0].value, rtol=1e-9)


@pytest.mark.parametrize("before", [True, False])
def test_a_reference_recorded_with_each_point_belongs_to_it(before, tmp_path):
    others = RNG.standard_normal(COUNT)
    pairs = [(force(), signal(ANSWERS[1] * 1e3, 1)), (force(others), signal(2e-3 * others * 1e3, 2))]
    parts = [part for pair in pairs for part in (pair if before else pair[::-1])]
    made = {one.point: one for one in read(written(tmp_path, *parts)).recordings}
    assert np.median(made["1"].coherence) > 0.99
    np.testing.assert_allclose(made["2"].value, 2e-3, rtol=1e-9)
    wrong = written(tmp_path, parts[0], parts[2], parts[1], parts[3])
    assert "one for each group of responses" in fault(wrong)


def test_a_stepped_sine_needs_no_reference(tmp_path):
    half = COUNT // 2
    wave = np.concatenate([np.sin(2 * np.pi * f * TIME[:half]) for f in (100.0, 200.0)])
    steps = tmp_path / "steps.csv"
    steps.write_text(f"start_s,stop_s,freq_hz\n0,{half / RATE},100\n{half / RATE},{COUNT / RATE},200\n")
    path = written(tmp_path, signal(wave, 1), signal(-0.5 * wave, 2))
    first, second = read(path, SeriesOptions(steps=steps)).recordings
    np.testing.assert_allclose(first.freq_hz, [100.0, 200.0])
    np.testing.assert_allclose(np.abs(first.value), 1e-3, rtol=1e-6)
    np.testing.assert_allclose(second.value / first.value, -0.5, rtol=1e-6)


def test_all_faults_of_time_responses_are_told_together(tmp_path):
    path = written(
        tmp_path,
        force(),
        signal(ANSWERS[1], 1, unit="parsec"),
        signal(ANSWERS[2], 2, direction=5),
        signal(ANSWERS[2], 3).replace(b"  5.00000E-04", b"  5.0000xE-04"),
    )
    text = fault(path)
    assert (
        'must be one of m, mm, um, nm; m/s, mm/s, um/s; m/s2, mm/s2, g [per unit of a reference]; got "p'
        in text
    )
    assert "the direction at node 2 must be 0 (scalar)" in text
    assert "the abscissa of a function must be a first value and a step" in text
    assert len(text.splitlines()) == 3
    short = written(tmp_path, force(FORCE[:100]), *responses())
    assert "of one number of samples; got 100 and 4096" in fault(short)
    slow = signal(ANSWERS[1], 1).replace(b"  5.00000E-04", b"  6.00000E-04")
    assert "the sampling rate must be one in all records" in fault(written(tmp_path, force(), slow))
    assert "none (scan.uff)" in fault(written(tmp_path, force()), SeriesOptions(reference_channel="9"))
    holed = written(tmp_path, force(), signal(np.where(np.arange(COUNT) == 7, np.nan, 1e3 * ANSWERS[1]), 1))
    assert "the first in sample 8" in fault(holed)


def test_responses_win_unless_time_series_are_asked_for(tmp_path):
    lines = np.arange(1, 9) * 10.0
    path = written(tmp_path, force(), *responses(), uff.function(lines, lines * 1j, 1, per=13, per_unit="N"))
    made = read(path)
    assert not made.from_series
    assert "3 time response" in made.notices[0].text
    assert read(path, SeriesOptions(frf="h1")).from_series


def test_the_command_reads_time_responses(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    nodes = uff.nodes_15({1: (0.0, 0.0, 0.0), 2: (0.001, 0.0, 0.0), 9: (0.0, 0.0, 0.0)})
    written(tmp_path, nodes, force(), *responses())
    words = ["scan.uff", "--body", "stapes=1,2", "--dof", "z,beta"]
    _, outcome = work([*words, "--resolution", "20"])
    assert outcome.result["lines"] == 48
    assert any("H1, window hann, resolution 20 Hz" in text for text in outcome.result["inputs_say"])
    with pytest.raises(StapeskitError, match="--overlap must be between 0 and"):
        work([*words, "--overlap", "2"])
    (tmp_path / "frf.uff").write_bytes(nodes + uff.function(TIME[1:9], TIME[1:9], 1, per_unit="N"))
    with pytest.raises(StapeskitError, match="left out: no file holds time series"):
        work(["frf.uff", "--body", "stapes=1", "--frf", "h1"])
