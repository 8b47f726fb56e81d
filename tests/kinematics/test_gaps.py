"""Missing values cost only themselves: the same fault is found beside them, and its culprit named."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.corrections import fitted
from benchmarks.fault_bodies import draw
from benchmarks.fault_scenes import measured, scene, two_faults, with_gaps
from benchmarks.points_conditions import verdicts

TEN, FIVE = "stapes, 10 points 3D", "footplate, 5 points 3D"


@pytest.mark.parametrize("fault", ["sign", "point sign", "label swap", "laser sign", "zeros", "flexible 3 %"])
def test_a_large_fault_beside_missing_values_is_named(fault):
    made = scene(31_001, TEN, fault)
    said = verdicts(made, with_gaps(measured(made, 31_001), 31_001, 0.2))
    assert said == dict.fromkeys(made.culprits, made.verdict)


@pytest.mark.parametrize("seed", [1001, 1004])
def test_a_laser_of_wrong_sign_beside_two_fifths_missing_is_named_and_not_refused(seed):
    made = scene(seed, FIVE, "laser sign")
    said = verdicts(made, with_gaps(measured(made, seed), seed, 0.4))
    assert said == dict.fromkeys(made.culprits, "sign")


def test_a_laser_of_wrong_sign_where_channels_lack_the_upper_lines_is_no_flexible_body():
    made = scene(41_027, "stapes, 9 points, lasers at 20 deg", "laser sign")
    value = measured(made, 41_027)
    value[[1, 7, 11, 12, 17, 23, 24, 25, 26], 96:] = np.nan
    assert verdicts(made, value) == dict.fromkeys(made.culprits, "sign")


@pytest.mark.parametrize("fault", ["phase 3 deg", "direction 3 deg"])
def test_a_fault_is_named_where_channels_lack_the_upper_lines_and_no_noise_is_stated(fault):
    made = scene(43_007, "stapes, 9 points, lasers at 20 deg", fault)
    value = measured(made, 43_007)
    value[[0, 9, 13, 17, 18, 19, 23, 24, 25], 96:] = np.nan
    assert set(verdicts(made, value, False)) == set(made.culprits)


def test_lines_without_a_channel_to_spare_do_not_spoil_the_search():
    made = scene(43_010, FIVE, "label swap")
    value = measured(made, 43_010)
    value[[2, 3, 8, 10, 11], 96:] = np.nan
    assert verdicts(made, value, False) == dict.fromkeys(made.culprits, "label_swap")


def test_a_file_with_two_fifths_missing_is_not_accused():
    made = scene(31_002, FIVE)
    assert verdicts(made, with_gaps(measured(made, 31_002), 31_002, 0.4)) == {}


def test_a_channel_missing_over_half_the_lines_is_not_accused_and_a_fault_beside_it_named():
    made = scene(31_003, TEN)
    assert verdicts(made, with_gaps(measured(made, 31_003), 31_003, 0.0, band=True)) == {}
    made = scene(31_003, TEN, "gain 5 %")
    said = verdicts(made, with_gaps(measured(made, 31_003), 31_003, 0.0, band=True))
    assert said == dict.fromkeys(made.culprits, "gain")


@pytest.mark.parametrize("stated", [True, False])
def test_axes_are_told_beside_a_channel_without_readings(stated):
    made = scene(41_021, TEN, "axes 2 deg")
    value = measured(made, 41_021)
    value[4] = np.nan
    said = verdicts(made, value, stated)
    assert said.pop(4) == "unused"
    assert said == {c: "direction" for c in range(30) if c != 4}


def test_two_faults_beside_missing_values_are_both_named():
    made = two_faults(31_004, TEN, ("sign", "gain 5 %"))
    said = verdicts(made, with_gaps(measured(made, 31_004), 31_004, 0.2))
    assert said == dict(zip(made.culprits, ("sign", "gain"), strict=True))


def test_position_errors_that_nobody_stated_are_told_as_such():
    made = scene(31_005, TEN, position_sd_mm=0.02)
    said = verdicts(made, measured(made, 31_005))
    assert said == dict.fromkeys(range(30), "position")


def test_gaps_change_neither_data_nor_scene():
    made = scene(31_006, FIVE)
    value = measured(made, 31_006)
    gone = with_gaps(value, 31_006, 0.3)
    assert np.all(np.isfinite(value))
    assert 0.2 < np.mean(np.isnan(gone)) < 0.4


def test_a_channel_that_one_line_depends_on_is_tested_by_its_other_lines():
    made = draw(1003, "shell, 5 points, 3 heads", "gain 6 %", gaps=0.2)
    found = fitted(made, correct=False).channels
    assert {c: v.verdict for c, v in enumerate(found) if v.verdict != "ok"} == {made.culprits[0]: "gain"}


def test_noise_that_is_not_stated_and_gaps_make_no_outliers_of_one_end_of_the_band():
    made = draw(1501013, "shell, 5 points, 3 heads", lines=60, gaps=0.2)
    assert {v.verdict for v in fitted(made, correct=False, stated=False).channels} == {"ok"}
