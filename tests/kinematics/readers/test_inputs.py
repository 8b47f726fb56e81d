"""Several vibrometer files as one measurement: bodies, runs, beams, units, lines, and every refusal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from legacy.kinematics.options import LdvOptions
from legacy.kinematics.readers.assemble_measurement import assemble
from legacy.kinematics.readers.from_options import input_options
from legacy.kinematics.readers.input_options import InputOptions
from legacy.kinematics.readers.recording import Recording, Recordings, scaled
from legacy.kinematics.tidy.points_csv import read_points
from legacy.stapeskit.faults import Place, StapeskitError
from tests.kinematics.simulated import readings, smooth_motion, stapes_points

SAMPLE = Path(__file__).resolve().parents[3] / "sample_volumes"
F = np.arange(1, 41) * 25.0
RNG = np.random.default_rng(5)
PLACES = stapes_points(RNG, 12)
MOTION = smooth_motion(RNG, F)
AXES = np.eye(3)


def value(number, axis, order=1):
    """What a beam along an axis reads at a point, SI."""
    displacement = readings(PLACES[[number]], AXES[[axis]], MOTION)[0]
    return displacement * (2j * np.pi * F) ** order


def recordings(numbers=range(6), body="stapes", first=1, **how):
    """Recordings of three beams a point, named from ``first`` on."""
    made = [
        Recording(
            str(first + place),
            F,
            value(number, axis),
            1,
            Place("a.uff", "dataset", (place,)),
            body=body,
            position_mm=PLACES[number],
            direction=AXES[axis],
        )
        for place, number in enumerate(numbers)
        for axis in range(3)
    ]
    return Recordings(tuple(replace(one, **how) for one in made), file="a.uff", amplitude_stated=True)


def codes(measurement):
    return [notice.code for notice in measurement.notices]


def fault(*files, points=None, **said):
    with pytest.raises(StapeskitError) as caught:
        assemble(files, points, InputOptions(**said))
    text = str(caught.value)
    assert all("must be" in line for line in text.splitlines())
    return text


def test_one_file_becomes_displacement_of_its_bodies():
    stapes, base = recordings(), recordings(range(6, 12), "base")
    both = Recordings(stapes.recordings + base.recordings, file="a.uff", amplitude_stated=True)
    made = assemble([both])
    assert [body.body for body in made.bodies] == ["stapes", "base"]
    assert (made.runs, made.order, made.notices) == (("1",), 1, ())
    want = readings(np.repeat(PLACES[:6], 3, axis=0), np.tile(AXES, (6, 1)), MOTION)
    np.testing.assert_allclose(made.bodies[0].displacement[0], want, rtol=1e-12)
    np.testing.assert_allclose(made.freq_hz, F)


def test_bodies_by_numbers_by_file_and_by_points_file(tmp_path):
    first, second = recordings(body=""), recordings(range(6, 12), "", 1)
    second = replace(second, file="b.uff")
    by_file = assemble([first, second], None, InputOptions(body=("stapes=a.uff", "base=b.uff:1-3,4,5,6")))
    assert [body.body for body in by_file.bodies] == ["stapes", "base"]
    assert by_file.runs == ("1",)
    by_name = assemble([first, second], None, InputOptions(body=("stapes=a", "base=b")))
    assert [body.body for body in by_name.bodies] == ["stapes", "base"]
    apart = replace(recordings(range(6, 12), "", 7), file="b.uff")
    by_number = assemble([first, apart], None, InputOptions(body=("stapes=1-3,4,5,6", "base=7-12")))
    assert [len(body.points) for body in by_number.bodies] == [18, 18]
    path = tmp_path / "points.csv"
    rows = [
        f"{'stapes' if n < 6 else 'base'},{n + 1},{','.join(map(str, PLACES[n]))},0.02" for n in range(12)
    ]
    path.write_text("body,point,x_mm,y_mm,z_mm,sd_mm\n" + "\n".join(rows) + "\n")
    listed = assemble([first, apart], read_points(path))
    np.testing.assert_allclose(listed.bodies[1].displacement, by_number.bodies[1].displacement)
    assert np.all(listed.bodies[0].position_sd_mm == 0.02)


def test_points_without_or_with_two_bodies_are_named(tmp_path):
    text = fault(recordings(body=""))
    assert "points 1, 2, 3, 4, 5, 6 must be of a body; got none (a.uff)" in text
    assert "--body stapes=1-10" in text
    text = fault(recordings(body=""), body=("stapes=1-4", "base=4-6"))
    assert "point 4 must be of one body; got stapes and base" in text
    text = fault(recordings(body=""), body=("stapes=1-6", "base=17"))
    assert "--body base must be points that were measured (1, 2, 3, 4, 5, 6)" in text
    assert "got stapes and other" not in text
    assert "of one body; got other and stapes" in fault(recordings(), body=("other=1-6",))
    path = tmp_path / "points.csv"
    path.write_text("body,point,x_mm,y_mm,z_mm\nstapes,1,0,0,0\nbase,1,1,1,1\n")
    text = fault(recordings([0], body=""), points=read_points(path))
    assert "point 1 must be of one body; got stapes and base" in text
    assert "base.uff:1-9" in text


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"body": ("stapes",)}, "--body must be NAME=POINTS, or a table"),
        ({"body": ("=1",)}, "--body must be NAME=POINTS"),
        ({"body": ("stapes=1,,2",)}, "the points of --body must be numbers, ranges or names"),
        ({"body": ("stapes=5-2",)}, "the points of --body must be numbers, ranges or names; got stapes=5-2"),
        ({"run": ("push",)}, "--run must be NAME=FILE, or a table"),
        ({"beam": "up"}, "--beam must be x, y, z, -x, -y, -z or three numbers of length 1"),
        ({"beam": "1,1,1"}, "three numbers of length 1 (within 1e-3); got 1,1,1"),
        ({"beam": "nan,0,0"}, "three numbers of length 1"),
        ({"amplitude": "pp"}, "--amplitude must be one of peak, rms; got pp"),
        ({"n_avg": 0.5}, "--n-avg must be a number of averages, 1 or more; got 0.5"),
        ({"length_unit": "inch"}, "--length-unit must be one of m, mm, um; got inch"),
    ],
)
def test_what_is_said_is_checked_first(said, words):
    with pytest.raises(StapeskitError) as caught:
        input_options(LdvOptions(**said))
    assert words in str(caught.value)


def test_all_that_is_said_wrongly_is_told_at_once():
    with pytest.raises(StapeskitError) as caught:
        LdvOptions(body=("a", "b=3-1"), beam="up", run=("x",))
    assert len(str(caught.value).splitlines()) == 3
    with pytest.raises(StapeskitError) as caught:
        input_options(LdvOptions(body=("a=1,,2", "b=3-1"), frf="h2"))
    assert len(str(caught.value).splitlines()) == 3


def test_files_that_nobody_gave_are_named():
    text = fault(recordings(), run=("push=c.uff",), body=("stapes=d.uff:1",))
    assert "the file of --run push=c.uff must be one of a.uff; got c.uff" in text
    assert "the file of --body stapes must be one of a.uff; got d.uff" in text


def test_files_that_measure_the_same_points_are_runs():
    second = replace(recordings(), file="tilt.uff")
    made = assemble([recordings(), second])
    assert made.runs == ("a", "tilt")
    assert codes(made) == ["runs_by_file"]
    made = assemble([recordings(), second], None, InputOptions(run=("push=a", "tilt=tilt.uff")))
    assert made.runs == ("push", "tilt")
    assert codes(made) == []
    signed = tuple(
        replace(one, direction=np.where(one.direction == 0.0, -0.0, one.direction))
        for one in second.recordings
    )
    assert assemble([recordings(), replace(second, recordings=signed)]).runs == ("a", "tilt")


def test_runs_and_bodies_in_four_files():
    files = [
        replace(recordings(numbers, body), file=name)
        for name, numbers, body in (
            ("s1.uff", range(6), "stapes"),
            ("b1.uff", range(6, 12), "base"),
            ("s2.uff", range(6), "stapes"),
            ("b2.uff", range(6, 12), "base"),
        )
    ]
    made = assemble(files, None, InputOptions(run=("1=s1", "1=b1", "2=s2", "2=b2")))
    assert made.runs == ("1", "2")
    assert all(np.all(np.isfinite(body.displacement)) for body in made.bodies)


def test_runs_of_one_file_stay_and_repeats_are_takes():
    one = recordings(run="push").recordings + recordings(run="pull").recordings
    assert assemble([Recordings(one, file="a", amplitude_stated=True)]).runs == ("push", "pull")
    one = recordings(repeat="1").recordings + recordings(repeat="2", level=0.5).recordings
    made = assemble([Recordings(one, file="a", amplitude_stated=True)])
    assert [take.repeat for take in made.takes] == ["1", "2"]
    assert made.takes[1].level == 0.5
    assert made.runs == tuple(take.name for take in made.takes)


def test_one_channel_twice_is_refused():
    twice = Recordings(
        recordings().recordings + recordings([0]).recordings, file="a.uff", amplitude_stated=True
    )
    text = fault(twice)
    assert "the channel stapes 1 (x) must be there once in a run" in text
    assert len(text.splitlines()) == 3


def test_one_channel_in_parts_of_the_band_is_joined():
    low = tuple(replace(one, freq_hz=F[:20], value=one.value[:20]) for one in recordings().recordings)
    high = tuple(replace(one, freq_hz=F[20:], value=one.value[20:]) for one in recordings().recordings)
    made = assemble([Recordings(low + high, file="a.uff", amplitude_stated=True)])
    np.testing.assert_allclose(made.bodies[0].displacement, assemble([recordings()]).bodies[0].displacement)


def test_a_line_at_zero_is_dropped_with_a_warning():
    freq = np.concatenate([[0.0], F])
    parts = {"freq_hz": freq, "coherence": np.full(41, 0.9), "n_avg": 10.0, "sd": None}
    one = tuple(replace(r, value=np.concatenate([[1.0], r.value]), **parts) for r in recordings().recordings)
    made = assemble([Recordings(one, file="a.uff", amplitude_stated=True)])
    assert "the line at 0 Hz of 18 spectra of a.uff holds no motion" in made.notices[0].text
    np.testing.assert_allclose(made.freq_hz, F)
    with pytest.raises(StapeskitError, match="must be above 0 Hz; got 0 Hz alone"):
        assemble([recordings(freq_hz=np.zeros(1), value=np.ones(1, complex))])


def test_positions_that_are_missing_or_differ(tmp_path):
    lost = recordings(position_mm=np.full(3, np.nan))
    assert "points 1, 2, 3, 4, 5, 6 of body stapes must be given with positions" in fault(lost)
    path = tmp_path / "points.csv"
    rows = [f"stapes,{n + 1},{','.join(map(str, PLACES[n]))}" for n in range(6)]
    path.write_text("body,point,x_mm,y_mm,z_mm\n" + "\n".join(rows) + "\n")
    np.testing.assert_allclose(assemble([lost], read_points(path)).bodies[0].positions_mm[::3], PLACES[:6])
    text = fault(recordings(position_mm=PLACES[0] * 1e3), points=read_points(path))
    assert "the position of point 1 of body stapes must be one" in text
    assert "--length-unit" in text


def test_a_position_of_one_channel_holds_for_the_point():
    made = recordings().recordings
    some = tuple(
        one if np.argmax(one.direction) == 1 else replace(one, position_mm=np.full(3, np.nan)) for one in made
    )
    joined = assemble([Recordings(some, file="a.uff", amplitude_stated=True)])
    np.testing.assert_allclose(joined.bodies[0].positions_mm[::3], PLACES[:6])


def test_the_direction_of_beams_is_said_or_asked_for():
    blind = recordings(direction=np.full(3, np.nan))
    one = Recordings(blind.recordings[::3], file="a.uff", amplitude_stated=True)
    text = fault(one)
    assert "must be given with the direction of the beam" in text
    assert "--beam" in text
    made = assemble([one], None, InputOptions(beam="0,-0.6,0.8"))
    np.testing.assert_allclose(made.bodies[0].directions, np.tile([0.0, -0.6, 0.8], (6, 1)))
    assert "--beam must be left out" in fault(recordings(), beam="z")


def test_amplitudes_are_peak_unless_said_otherwise():
    plain = replace(recordings(sd=np.full(40, 1e-9)), amplitude_stated=False)
    peak = assemble([plain])
    assert codes(peak) == ["amplitude_assumed"]
    rms = assemble([plain], None, InputOptions(amplitude="rms"))
    assert codes(rms) == []
    root = np.sqrt(2.0)
    np.testing.assert_allclose(rms.bodies[0].displacement, peak.bodies[0].displacement * root)
    np.testing.assert_allclose(rms.bodies[0].sd, peak.bodies[0].sd * root)
    ratio = replace(recordings(per="V"), amplitude_stated=False)
    assert codes(assemble([ratio])) == ["per_reference"]
    assert "--amplitude must be left out" in fault(ratio, amplitude="rms")
    assert "--amplitude must be left out" in fault(recordings(), amplitude="peak")


def test_positions_without_unit_are_metres_unless_said_otherwise():
    plain = replace(recordings(), length_stated=False)
    made = assemble([plain])
    assert codes(made) == ["length_unit_assumed"]
    assert "Say --length-unit" in made.notices[0].text
    small = assemble([plain], None, InputOptions(length_unit="mm"))
    np.testing.assert_allclose(small.bodies[0].positions_mm * 1e3, made.bodies[0].positions_mm)
    assert "--length-unit must be left out" in fault(recordings(), length_unit="mm")


def test_responses_to_different_things_are_not_mixed():
    mixed = Recordings(
        recordings(per="V").recordings + recordings(range(6, 12), "base").recordings,
        file="a.uff",
        amplitude_stated=True,
    )
    assert "the values of one run must be of one unit; got responses per V" in fault(mixed)
    made = assemble([recordings(per="Pa")])
    assert "responses per Pa" in made.notices[0].text


def test_lines_are_matched_or_refused():
    near = tuple(
        replace(one, freq_hz=F * (1.0 + 4e-6)) for one in recordings(range(6, 12), "base").recordings
    )
    both = Recordings(recordings().recordings + near, file="a.uff", amplitude_stated=True)
    assert len(assemble([both]).freq_hz) == 40
    assert codes(assemble([both])) == ["frequencies_matched"]
    far = tuple(replace(one, freq_hz=F + 0.5) for one in recordings(range(6, 12), "base").recordings)
    text = fault(Recordings(recordings().recordings + far, file="a.uff", amplitude_stated=True))
    assert "the frequencies of bodies stapes and base must be the same within 1 % of their spacing" in text


def test_noise_of_coherence_averages_and_sd():
    coherence = np.linspace(0.6, 1.0, 40)
    made = assemble([recordings(coherence=coherence, n_avg=12.0)]).bodies[0]
    want = np.abs(made.displacement) * np.sqrt((1.0 - coherence) / (24.0 * coherence))
    np.testing.assert_allclose(made.sd, want)
    assert not made.relative
    alone = recordings(coherence=coherence)
    assert assemble([alone]).bodies[0].relative
    said = assemble([alone], None, InputOptions(n_avg=12.0)).bodies[0]
    np.testing.assert_allclose(said.sd, want)
    assert not said.relative
    assert "--n-avg must be left out" in fault(recordings(n_avg=4.0), n_avg=12.0)
    many = assemble([recordings(n_avg=4.0)]).bodies[0]
    assert many.relative
    np.testing.assert_allclose(many.sd * 2.0 * np.pi * F, 0.5)
    assert assemble([recordings()]).bodies[0].sd is None
    sd = recordings(sd=np.full(40, 1e-6))
    mixed = Recordings(sd.recordings[:-1] + recordings().recordings[-1:], file="a.uff", amplitude_stated=True)
    made = assemble([mixed])
    assert codes(made) == ["sd_missing"]
    np.testing.assert_allclose(made.bodies[0].sd[0, 0], 1e-6 / (2.0 * np.pi * F))
    assert np.all(np.isnan(made.bodies[0].sd[0, -1]))


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"value": np.where(F == 50.0, np.inf, 1.0 + 0.0j)}, "the values of point 1 must be finite"),
        ({"sd": np.where(F < 100.0, -1.0, 1.0)}, "got -1.0 at 25 Hz and 2 more (a.uff, dataset 0)"),
        ({"coherence": np.full(40, 1.5)}, "the coherence of point 1 must be within 0 and 1; got 1.5"),
        ({"n_avg": 0.0}, "the number of averages must be 1 or more; got 0"),
    ],
)
def test_impossible_numbers_are_refused(how, words):
    assert words in fault(recordings([0], **how))


def test_displacement_and_velocity_are_joined():
    order = [
        replace(one, value=one.value / (2j * np.pi * F), order=0) for one in recordings([0, 1]).recordings
    ]
    mixed = Recordings(
        (*recordings(range(2, 6), first=3).recordings, *order), file="a", amplitude_stated=True
    )
    made = assemble([mixed])
    assert made.order == 1
    places = [made.bodies[0].points.index(str(n)) for n in range(1, 7)]
    plain = assemble([recordings()]).bodies[0]
    np.testing.assert_allclose(made.bodies[0].displacement[0][places], plain.displacement[0][::3], rtol=1e-12)


def test_frequencies_below_zero_are_no_dc_line():
    made = recordings([0])
    freq = np.concatenate([[-5.0], F[1:]])
    turned = Recordings(
        tuple(replace(one, freq_hz=freq) for one in made.recordings), file="a.uff", amplitude_stated=True
    )
    with pytest.raises(StapeskitError, match="the frequencies must be positive; got -5 Hz"):
        assemble([turned])


def test_scaling_leaves_the_other_part_of_an_infinite_number_alone():
    made = scaled(np.array([complex(np.inf, 0.0), 1.0 + 2.0j]), 0.5)
    assert made.tolist() == [complex(np.inf, 0.0), 0.5 + 1.0j]
