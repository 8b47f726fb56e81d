"""Several files as one measurement: bodies, runs, positions, lines, units, and what does not fit together."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kinematics.readers.assemble import assemble, read_measurement
from kinematics.readers.in_si import settled
from kinematics.readers.lines import common_grid
from kinematics.readers.points import read_points
from kinematics.readers.recording import Recording, Row
from kinematics.readers.stated_by_user import FileFacts
from kinematics.readers.units import MotionUnit, motion_unit
from stapeskit.faults import StapeskitError
from tests.motion_files.written_files import FREQ_HZ, PLACES_M, VELOCITY, tidy_table, universal_file

EXPORTS = Path(__file__).parents[2] / "sample_volumes" / "exports"
Z = np.array([0.0, 0.0, 1.0])


def row(point="1", freq=FREQ_HZ, value=1.0, **further):
    known = {"body": "stapes", "direction": Z, "position_m": np.zeros(3)} | further
    return Row(point, np.asarray(freq), np.full(len(freq), value, dtype=complex), **known)


def one(*rows, name="a.uff", facts=None, **further):
    return settled(Recording(name, rows, **further), facts or FileFacts())


def things(error):
    return [fault.thing for fault in error.value.faults]


UNITS = {
    "m/s": (1, 1.0, ""), "[ um/s / V ]": (1, 1e-6, "V"), "(m/s^2)/N": (2, 1.0, "N"), "g": (2, 9.80665, ""),
    "mm": (0, 1e-3, ""), "m s-1": (1, 1.0, ""), "µm": (0, 1e-6, ""), "m/s/s": (2, 1.0, ""),
    "m/s/m/s": (1, 1.0, "m/s"), "(mm/s)/(mm/s)": (1, 1e-3, "mm/s"), "mm/s/uPa": (1, 1e-3, "uPa"),
    "m/s/Volt": (1, 1.0, "Volt"),
    **dict.fromkeys(("dB", "V", "m/s/sqrt(Hz)", "rad/s", "", "(m/s)^2/Hz", "m/s per V", "m/second", "m/min")),
}  # fmt: skip


@pytest.mark.parametrize("label", UNITS)
def test_units_of_motion(label):
    unit = motion_unit(label)
    assert (unit and (unit.order, unit.scale, unit.per)) == UNITS[label]


AMPLITUDES = {
    "mm/s (rms)": "rms", "m/s [rms]": "rms", "m/s_rms": "rms", "(m/s) eff": "rms", "m/s 0-pk": "peak",
    "m/s (Peak)": "peak", "m/s": "", **dict.fromkeys(("mm/s p-p", "mm/s pk-pk", "m/s dB", "m/s wrms")),
}  # fmt: skip


@pytest.mark.parametrize("label", AMPLITUDES)
def test_peak_and_rms_beside_units(label):
    """A word that is not known makes the unit unknown, not that of a response per this word."""
    unit = motion_unit(label)
    assert (unit and unit.amplitude) == AMPLITUDES[label]
    assert unit is None or (unit.order, unit.per) == (1, "")


def test_grids_that_differ_by_rounding_are_one():
    first = np.arange(100.0, 2000.0, 25.0)
    grid, places, notices = common_grid([first, first * (1.0 + 3e-7), first[3:9] + 0.005])
    assert np.array_equal(grid, first)
    assert np.array_equal(places[1], np.arange(len(first)))
    assert np.array_equal(places[2], np.arange(3, 9))
    (notice,) = notices
    assert notice.code == "file_read"
    assert " 0.005 Hz" in notice.text
    grid, places, _ = common_grid([np.array([100.0, 300.0]), np.array([200.0, 300.0])])
    assert np.array_equal(grid, [100.0, 200.0, 300.0])
    assert [place.tolist() for place in places] == [[0, 2], [1, 2]]


def test_the_same_measurement_from_every_export_of_the_sample():
    """Values of the exports agree to the digits that each of them writes."""
    names = FileFacts(body=("stapes=1-10", "base=11-19"))
    points = EXPORTS / "points.csv"
    measured = [
        read_measurement([EXPORTS / name], facts=names) for name in ("scan.uff", "scan.mat", "fastscan.txt")
    ]
    measured.append(read_measurement([EXPORTS / "wide.csv"], points))
    for other in measured[1:]:
        assert np.allclose(other.freq_hz, measured[0].freq_hz, rtol=1e-6)
        for body, same in zip(other.bodies, measured[0].bodies, strict=True):
            beams = [list(zip(b.points, map(tuple, b.directions), strict=True)) for b in (body, same)]
            order = [beams[0].index(beam) for beam in beams[1]]
            assert np.allclose(
                body.value[:, order], same.value, rtol=0, atol=2e-4 * np.max(np.abs(same.value))
            )
            assert np.allclose(body.positions_m[order], same.positions_m, atol=1e-7)


def test_files_of_different_points_are_parts_and_of_the_same_points_runs(tmp_path):
    parts = [one(row("1"), name="a.uff"), one(row("2"), name="b.uff")]
    assert assemble(parts).runs == ("1",)
    again = [one(row("1"), name="a.uff"), one(row("1", value=2.0), name="b.uff")]
    measured = assemble(again)
    assert measured.runs == ("a", "b")
    assert np.allclose(measured.bodies[0].value[:, 0, 0], [1.0, 2.0])
    assert assemble(again, facts=FileFacts(run=("push=a.uff", "tilt=b"))).runs == ("push", "tilt")


def test_bodies_by_rules_files_and_points(tmp_path):
    bare = [row(point, body="") for point in ("1", "2", "11")]
    assert [body.body for body in assemble([one(*bare)]).bodies] == ["body"]
    measured = assemble([one(*bare)], facts=FileFacts(body=("stapes=1-10", "base=11")))
    assert [(body.body, body.points) for body in measured.bodies] == [
        ("stapes", ("1", "2")),
        ("base", ("11",)),
    ]
    by_file = [one(row("1", body=""), name="a.uff"), one(row("1", body=""), name="b.uff")]
    measured = assemble(by_file, facts=FileFacts(body=("stapes=a.uff", "base=b.uff")))
    assert [body.body for body in measured.bodies] == ["stapes", "base"]
    (tmp_path / "points.csv").write_text(
        "body,point,x_mm,y_mm,z_mm,sd_mm\nbase,1,1,2,3,0.1\n", encoding="utf-8"
    )
    listed = read_points(tmp_path / "points.csv")
    body = assemble([one(row("1", body="", position_m=np.full(3, np.nan)))], listed).bodies[0]
    assert body.body == "base"
    assert np.allclose(body.positions_m, [[1e-3, 2e-3, 3e-3]])
    assert np.allclose(body.position_sd_m, 1e-4)


def test_quantities_are_converted_to_the_most_common_one():
    """v = i w q."""
    measured = assemble([one(row("1"), row("2"), row("3", value=0.5, unit=MotionUnit(0)))])
    assert measured.quantity == "velocity"
    assert np.allclose(measured.bodies[0].value[0, 2], 0.5 * 2j * np.pi * FREQ_HZ)


def test_facts_fill_what_files_do_not_say():
    silent = row("1", direction=np.full(3, np.nan), position_m=np.ones(3))
    facts = FileFacts(beam="0,3,4", amplitude="rms", length_unit="mm", n_avg=4.0)
    body = assemble([one(silent, facts=facts, length_stated=False)], facts=facts).bodies[0]
    assert np.allclose(body.directions, [[0.0, 0.6, 0.8]])
    assert np.allclose(body.positions_m, 1e-3)
    assert np.allclose(body.value, np.sqrt(2.0))
    assert body.relative
    found = one(silent, facts=FileFacts(beam="z"), length_stated=False)
    codes = {notice.code for notice in assemble([found], facts=FileFacts(beam="z")).notices}
    assert codes == {"amplitude_assumed", "length_unit_assumed"}


def test_rms_is_applied_where_peak_is_not_stated():
    rows = [row("1", unit="m/s peak"), row("2", unit="m/s")]
    assert np.allclose(np.abs(one(*rows, facts=FileFacts(amplitude="rms")).value[:, 0]), [1.0, np.sqrt(2.0)])


def test_a_line_at_0_hz_may_hold_anything():
    """Displacement from velocity is infinite there."""
    found = one(
        replace(row(freq=np.array([0.0, *FREQ_HZ])), value=np.array([np.inf, 1, 1, 1, 1], dtype=complex))
    )
    assert np.array_equal(found.freq_hz, FREQ_HZ)
    assert any("0 Hz" in notice.text for notice in found.notices)
    with pytest.raises(StapeskitError) as caught:
        one(row("1", [0.0]))
    assert caught.value.faults[0].got == "0"


def test_positions_of_two_sources_must_agree(tmp_path):
    (tmp_path / "points.csv").write_text("body,point,x_mm,y_mm,z_mm\nstapes,1,0,0.5,0\n", encoding="utf-8")
    with pytest.raises(StapeskitError) as caught:
        assemble([one(row("1"))], read_points(tmp_path / "points.csv"))
    assert things(caught) == ["the position of point 1 of body stapes"]


UNFIT = {
    "one channel twice": ([row("1"), row("1")], FileFacts(), "the channel stapes 1 (z)"),
    "no direction": ([row(direction=np.full(3, np.nan))], FileFacts(), "points 1 of body stapes"),
    "two references": (
        [row("1", unit="m/s/N"), row("2", unit="m/s/V")], FileFacts(), "the values of one run"
    ),
    "an option for nothing": ([row()], FileFacts(beam="z"), "--beam"),
    "an unknown file": ([row()], FileFacts(run=("push=c.uff",)), "the file of --run push=c.uff"),
    **{
        f"the rule {text}": ([row()], FileFacts(body=(text,)), "--body")
        for text in ("stapes", "stapes=", "=1-3", "stapes=3-1", "stapes=1,,2")
    },
    "a rule in part for nothing": ([row()], FileFacts(body=("stapes=1,typo.uff:1",)), "--body stapes"),
    "a rule for nothing": ([row()], FileFacts(body=("base=7-9",)), "--body base"),
    "infinite values": ([row(value=np.inf)], FileFacts(), "the values"),
    "half of the positions": (
        [row("1"), row("2", position_m=np.full(3, np.nan))], FileFacts(), "points 2 of body stapes",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", UNFIT)
def test_what_does_not_belong_together_is_refused(name):
    rows, facts, thing = UNFIT[name]
    with pytest.raises(StapeskitError) as caught:
        assemble([one(*rows, facts=facts)], facts=facts)
    assert things(caught) == [thing]


IMPOSSIBLE = {
    "the frequencies": {"freq_hz": FREQ_HZ[0] * (1.0 + 1e-7 * np.arange(4))},
    "the unit of the values": {"unit": "dB"},
    "the unit of the frequencies": {"freq_unit": "rad/s"},
    "the values": {"value": np.full(4, np.inf, dtype=complex)},
    "the coherence": {"coherence": 1.5},
    "the number of averages": {"n_avg": 0.0},
    "the standard deviations": {"sd": -1.0},
    "the length of a direction": {"direction": 2.0 * Z},
    "the coordinates of points, in mm": {"position_m": np.full(3, 1e10)},
}


@pytest.mark.parametrize("thing", IMPOSSIBLE)
def test_what_no_motion_can_have_is_refused_whatever_the_format(thing):
    """Two rows of one kind are one sentence."""
    rows = [replace(row(point), **IMPOSSIBLE[thing]) for point in "12"]
    with pytest.raises(StapeskitError) as caught:
        one(*rows)
    assert things(caught) == [thing]
    assert " 0 more" not in str(caught.value.faults[0].got)


def test_rows_in_any_order_and_unit_are_one_recording():
    """rms in um/s from high to low frequencies against peak in m/s; coherence follows its lines."""
    gamma = np.array([0.9, 0.8, 0.7, 0.6])
    plain = replace(row(value=np.sqrt(2.0)), coherence=gamma, sd=np.sqrt(2.0) * gamma)
    turned = replace(
        row(value=1e6), freq_hz=FREQ_HZ[::-1], coherence=gamma[::-1], sd=1e6 * gamma[::-1], unit="um/s rms"
    )
    expected, found = one(plain), one(turned)
    assert np.allclose(found.value, expected.value, rtol=1e-14)
    assert np.array_equal(found.coherence, expected.coherence)
    assert np.allclose(found.sd, expected.sd, rtol=1e-14)
    assert "amplitude" not in found.lacks
    assert "amplitude" in expected.lacks


def test_tidy_tables_and_other_files_are_one_measurement(tmp_path):
    (tmp_path / "a.csv").write_text(tidy_table(body="base"), encoding="utf-8")
    (tmp_path / "b.uff").write_bytes(universal_file())
    measured = read_measurement(
        [tmp_path / "a.csv", tmp_path / "b.uff"], facts=FileFacts(body=("stapes=b.uff",))
    )
    assert [body.body for body in measured.bodies] == ["base", "stapes"]
    assert np.allclose(measured.bodies[0].value[0], VELOCITY.reshape(9, -1), rtol=1e-14)
    assert np.allclose(measured.bodies[1].positions_m[::3], PLACES_M)
    assert set(measured.inputs) == {"ldv", "ldv 2"}
