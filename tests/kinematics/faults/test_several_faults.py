"""Two faults of one body are both named, and a motion that drifts between points is no body that bends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fault_bodies import BODIES, FAULTS, draw
from benchmarks.faults_gate import judged, scattered
from legacy.kinematics.faults.noise_size import channel_noise
from legacy.kinematics.faults.packed_readings import packed
from legacy.kinematics.faults.proposals.drifting_motion import drifting_motion
from legacy.kinematics.faults.score_information import State
from tests.kinematics.faults.test_alternatives import suspected
from tests.kinematics.faults.test_catalogue import data_of
from tests.kinematics.simulated import scene

PAIRS = [fault for fault in FAULTS if " + " in fault]
THREE_HEADS = [body for body in BODIES if "1 head" not in body]


def accused(reading, stated):
    """Return the verdicts of the channels that have one."""
    return {c: v.verdict for c, v in enumerate(judged(reading, stated).channels) if v.verdict != "ok"}


def test_a_motion_that_drifts_is_seen_beside_a_point_without_readings():
    reading = draw(1003, THREE_HEADS[1], "drying 3 %", lines=60)
    reading.value[[point == "P4" for point in reading.points]] = np.nan
    ((remedy, words),) = drifting_motion(suspected(reading))
    assert not remedy.alike
    assert (words["first"], words["last"]) == ("P1", "P12")


def in_order(reading, order):
    """Return a reading with its rows in another order."""
    names = ("positions_mm", "directions", "head", "value", "sd")
    points = [reading.points[c] for c in order]
    return replace(reading, points=points, **{name: getattr(reading, name)[order] for name in names})


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize(("fault", "body"), [*zip(PAIRS, BODIES, strict=True)])
def test_both_of_two_faults_are_named(fault, body, stated):
    reading = draw(2100, body, fault, lines=60)
    assert accused(reading, stated) == reading.expected  # one of three before each was estimated alone


@pytest.mark.parametrize("fault", PAIRS[1:3])
def test_both_of_two_faults_are_named_next_to_lasers_that_scatter(fault):
    reading = scattered(draw(2001, "shell, 12 points, 3 heads", fault, lines=60), 2001)
    assert accused(reading, True) == reading.expected  # never when a body that bends counted as two faults


@pytest.mark.parametrize("seed", [6000, 6002])
def test_a_misplaced_point_and_a_gain_next_to_lasers_are_no_body_that_bends(seed):
    """Neither fault alone leaves nothing."""
    reading = draw(seed, "rod, 8 points, 2-3 heads", "gain 6 % + position", lines=60)
    assert accused(scattered(reading, seed), True) == reading.expected


def test_a_second_fault_of_channels_that_are_left_out_is_found():
    """Exchanged names leave both points out, and with them the gain of one of their channels."""
    body = "shell, 12 points, 3 heads"
    for seed in range(2):
        reading = draw(2200 + seed, body, "names of points", lines=60)
        reading.value[reading.culprits[1]] *= 1.06
        assert set(accused(reading, True)) == set(reading.culprits)


@pytest.mark.parametrize(("body", "stated"), [*zip(THREE_HEADS, (True, True, False), strict=True)])
def test_a_stiffness_that_rises_between_points_is_no_body_that_bends(body, stated):
    named = 0
    for seed in range(1002, 1006):
        result = judged(draw(seed, body, "drying 3 %", lines=60), stated)
        (verdict,) = {channel.verdict for channel in result.channels}
        (text,) = (
            notice.text for notice in result.notices if notice.code in ("drift_between_points", "flexible")
        )
        # Where places explain the order of the points, a body that bends is not ruled out.
        assert "in the order of the file, by" in text
        assert "measure the first point again" in text
        named += verdict == "drift"
    assert named >= (2 if body == THREE_HEADS[0] else 3)


@pytest.mark.parametrize("body", THREE_HEADS)
def test_a_fault_of_a_few_points_is_no_drift(body):
    """A polynomial of the order takes up most of a fault of the first or the last point."""
    said = []
    for seed in range(6000, 6006):
        for fault in ("sign", "position", "names of points", "names of three points"):
            reading = scattered(draw(seed, body, fault, lines=60), seed)
            said += [(seed, fault) for _ in drifting_motion(suspected(reading))]
    assert said == []


def test_degrees_of_freedom_are_whole_numbers():
    """On 5 points 3 directions are left beside a drift: rounding decided whether that is enough."""
    for seed in range(8):
        reading = draw(seed, THREE_HEADS[0], lines=20)
        assert set(State.of(data_of(reading)).free()) == {9.0}


@pytest.mark.parametrize("body", THREE_HEADS)
@pytest.mark.parametrize("in_rows", [False, True])
def test_a_body_that_bends_is_not_said_to_dry(body, in_rows):
    """Measured along itself it changes in the order of the file as well: neither is ruled out then."""
    said = []
    for seed in range(4000, 4008):
        reading = draw(seed, body, "bends 6 %", lines=60)
        if in_rows:
            along = np.argmax(np.ptp(reading.positions_mm, axis=0))
            reading = in_order(reading, np.argsort(reading.positions_mm[:, along], kind="stable"))
        said += [remedy.alike for remedy, _words in drifting_motion(suspected(reading))]
    assert all(said)
    assert bool(said) == in_rows or body == THREE_HEADS[0]


def test_the_noise_of_channels_with_a_drifting_factor_is_that_of_all_lines():
    made = scene(31, lines=400)
    data = data_of(made)
    factor = [([4], lambda tau, _ratio: 1.0 - 0.2 * tau)]
    drifting = packed(data.source, replace(data.assumed, factors=tuple(factor)))
    assert np.ptp(drifting.weight, axis=0).max() > 0.0
    before, after = (channel_noise(State.of(one)) for one in (data, drifting))
    others = np.arange(len(made.points)) != 4
    assert after.ratios[others] == pytest.approx(before.ratios[others], rel=0.2)
    assert after.number[others] == pytest.approx(before.number[others], rel=0.1)
