"""What a clean verdict excludes: the information is that of the whole regression, the power what it says."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, ncx2

from legacy.kinematics.faults.detectable import POWER, detectable, invisible
from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.fit.rigid_fit import fit_lines
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.report.detectable_sections import size_of
from legacy.kinematics.report.fault_sections import verdict_section
from legacy.stapeskit.frames import rotation_from_vector
from tests.kinematics.simulated import body, measurement, readings, scene

ALARM = 1e-4
LINES = 12


@pytest.fixture(scope="module")
def made():
    one = scene(11, lines=LINES)
    rng = np.random.default_rng(2)
    one.sd *= rng.uniform(0.5, 2.0, one.sd.shape)
    one.value = readings(one.positions_mm, one.directions, one.q)
    return one


def spread_of(made, columns):
    """Covariance of extra parameters when the motion at every line is fitted with them, all at once."""
    count, lines = made.value.shape
    basis = np.hstack([made.directions, np.cross(made.positions_mm * 1e-3, made.directions)])
    size = columns.shape[-1]
    rows = np.zeros((2 * count * lines, 12 * lines + size))
    for line in range(lines):
        for part, value in ((0, np.real), (1, np.imag)):
            at = slice((2 * line + part) * count, (2 * line + part + 1) * count)
            scale = 1.0 / made.sd[:, line, None]
            rows[at, 12 * line + 6 * part : 12 * line + 6 * part + 6] = basis * scale
            rows[at, 12 * lines :] = value(columns[:, line]) * scale
    norm = np.linalg.norm(rows, axis=0)
    inverse = np.linalg.inv((rows / norm).T @ (rows / norm))
    return (inverse / np.outer(norm, norm))[-size:, -size:]


def needed(size):
    """Noncentrality with which chi2 of some degrees of freedom passes its limit with the stated power."""
    low, high, limit = 0.0, 1e3, chi2.isf(ALARM, size)
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if ncx2.sf(limit, size, middle) < POWER else (low, middle)
    return middle


@pytest.mark.parametrize("channel", [0, 13, 26])
def test_the_smallest_faults_are_those_of_the_whole_regression(made, channel):
    channels = body("stapes", made)
    beams = beam_set("stapes", made.positions_mm, made.directions, ("x", "y", "z", "alpha", "beta", "gamma"))
    least = detectable(fit_lines(beams, made.value, made.sd), channels, made.freq_hz, ALARM)
    columns = np.zeros((*made.value.shape, 1), dtype=complex)
    columns[channel, :, 0] = made.value[channel]
    expected = np.sqrt(needed(1) * spread_of(made, columns)[0, 0])
    assert least.gain[channel] == pytest.approx(expected, rel=1e-3)

    beam = made.directions[channel]
    first = np.linalg.svd(beam[None])[2][1:].T
    local = made.q[:, :3] + np.cross(made.q[:, 3:], made.positions_mm[channel] * 1e-3)
    columns = np.zeros((*made.value.shape, 2), dtype=complex)
    columns[channel] = local @ first
    worst = np.linalg.eigvalsh(spread_of(made, columns))[-1]
    assert least.angle_rad[channel] == pytest.approx(np.sqrt(needed(2) * worst), rel=1e-3)

    columns = np.zeros((*made.value.shape, 3), dtype=complex)
    for own in range(3 * (channel // 3), 3 * (channel // 3) + 3):
        for axis in range(3):
            columns[own, :, axis] = np.cross(made.q[:, 3:], np.eye(3)[axis]) @ made.directions[own]
    worst = np.linalg.eigvalsh(spread_of(made, columns))[-1]
    assert least.shift_m[channel] == pytest.approx(np.sqrt(needed(3) * worst), rel=1e-3)


def test_a_stated_position_error_adds_to_what_can_hide(made):
    beams = beam_set("stapes", made.positions_mm, made.directions, ("x", "y", "z", "alpha", "beta", "gamma"))
    fit = fit_lines(beams, made.value, made.sd)
    sure = detectable(fit, body("stapes", made), made.freq_hz, ALARM)
    vague, others = (
        detectable(fit, body("stapes", made, sd), made.freq_hz, ALARM)
        for sd in (0.05, np.where(np.array(made.points) == made.points[0], np.nan, 0.05))
    )
    # The error of the point itself adds its square to what hides behind the errors of the others.
    added = np.sqrt(others.shift_m[0] ** 2 + needed(3) * 0.05e-3**2)
    assert vague.shift_m[0] == pytest.approx(added, rel=1e-3)
    assert others.shift_m[0] > 1.01 * sure.shift_m[0]
    assert np.all(vague.gain > sure.gain)


def test_a_motion_that_turns_nothing_hides_every_position(made):
    still = made.q.copy()
    still[:, 3:] = 0.0
    value = readings(made.positions_mm, made.directions, still)
    beams = beam_set("stapes", made.positions_mm, made.directions, ("x", "y", "z", "alpha", "beta", "gamma"))
    least = detectable(fit_lines(beams, value, made.sd), body("stapes", made), made.freq_hz, ALARM)
    assert np.all(np.isnan(least.shift_m))
    assert np.all(np.isfinite(least.gain))


def test_a_gain_of_that_size_is_found_as_often_as_said():
    found, runs = 0, 20
    for seed in range(runs):
        one = scene(100 + seed, lines=30)
        least = detectable(fitted(one), body("stapes", one), one.freq_hz, 0.01 / (4.0 * 27))
        one.value[7] *= 1.0 + least.gain[7]
        spoiled = points2dof(measurement(body("stapes", one), freq_hz=one.freq_hz))
        found += any(v.verdict != "ok" for v in spoiled.channels[6:9])
    assert found >= 17


def test_the_report_says_what_would_have_been_found():
    one = scene(3, lines=60)
    result = points2dof(measurement(body("stapes", one), freq_hz=one.freq_hz))
    text = "".join(verdict_section(result).blocks)
    assert "What would have been found" in text
    assert "position of a point" in text


DOF = ("x", "y", "z", "alpha", "beta", "gamma")


def fitted(made):
    beams = beam_set("stapes", made.positions_mm, made.directions, DOF)
    return fit_lines(beams, made.value, made.sd)


def test_the_smallest_turn_of_all_axes_is_that_of_the_whole_regression(made):
    found = detectable(fitted(made), body("stapes", made), made.freq_hz, ALARM)
    columns = np.zeros((*made.value.shape, 3), dtype=complex)
    for channel, beam in enumerate(made.directions):
        local = made.q[:, :3] + np.cross(made.q[:, 3:], made.positions_mm[channel] * 1e-3)
        for axis in range(3):
            columns[channel, :, axis] = local @ np.cross(np.eye(3)[axis], beam)
    worst = np.linalg.eigvalsh(spread_of(made, columns))[-1]
    assert found.axes_rad == pytest.approx(np.sqrt(needed(3) * worst), rel=1e-3)


def exchanged(made, one, two):
    value = made.value.copy()
    i, j = [[c for c, name in enumerate(made.points) if name == point] for point in (one, two)]
    value[i], value[j] = made.value[j], made.value[i]
    return value


def test_the_chance_to_find_exchanged_names_is_that_of_their_residual():
    one = scene(11, lines=2, snr=6.0)
    one.value = readings(one.positions_mm, one.directions, one.q)
    beams = beam_set("stapes", one.positions_mm, one.directions, DOF)
    pairs = detectable(fit_lines(beams, one.value, one.sd), body("stapes", one), one.freq_hz, ALARM).pairs
    for first, second, distance, chance in pairs:
        left = fit_lines(beams, exchanged(one, first, second), one.sd).chi2.sum()
        assert chance == pytest.approx(ncx2.sf(chi2.isf(ALARM, 3), 3, left), rel=1e-3)
        i, j = one.points.index(first), one.points.index(second)
        assert distance == pytest.approx(np.linalg.norm(one.positions_mm[i] - one.positions_mm[j]))
    assert 1e-3 < pairs[-1][3] < 0.99


def test_stated_position_errors_hide_turned_axes_and_exchanges(made):
    sure, vague = (
        detectable(fitted(made), body("stapes", made, sd), made.freq_hz, ALARM) for sd in (np.nan, 0.1)
    )
    assert vague.axes_rad > 1.2 * sure.axes_rad
    assert all(few[3] <= many[3] for few, many in zip(vague.pairs[:1], sure.pairs[:1], strict=True))


def test_turned_axes_of_that_size_are_found_as_often_as_said():
    found, runs = 0, 20
    for seed in range(runs):
        one = scene(300 + seed, lines=30)
        size = detectable(fitted(one), body("stapes", one), one.freq_hz, 0.01 / 0.3).axes_rad
        axis = np.random.default_rng(seed).normal(size=3)
        turn = rotation_from_vector(size * axis / np.linalg.norm(axis))
        noise = one.value - readings(one.positions_mm, one.directions, one.q)
        one.value = readings(one.positions_mm, one.directions @ turn.T, one.q) + noise
        spoiled = points2dof(measurement(body("stapes", one), freq_hz=one.freq_hz))
        found += any(v.verdict != "ok" for v in spoiled.channels)
    assert found >= 17


def test_errors_that_never_show_change_the_motion_as_said():
    one = scene(12, lines=30)
    never = invisible(one.q, DOF, one.directions)
    size = np.sqrt(np.mean(np.abs(one.q) ** 2, axis=0))
    rng = np.random.default_rng(1)
    most_turn, most_shift = np.zeros(6), np.zeros(6)
    for axis in rng.normal(size=(400, 3)):
        axis = axis / np.linalg.norm(axis)
        turn = rotation_from_vector(np.radians(1.0) * axis)
        value = readings(one.positions_mm, one.directions, one.q)
        for place, beams, most in (
            (one.positions_mm @ turn.T, one.directions @ turn.T, most_turn),
            (one.positions_mm + 0.05 * axis, one.directions, most_shift),
        ):
            fit = fit_lines(beam_set("stapes", place, beams, DOF), value, one.sd)
            assert np.max(fit.chi2) < 1e-9
            change = np.sqrt(np.mean(np.abs(fit.q - one.q) ** 2, axis=0)) / size
            np.maximum(most, change, out=most)
    assert never.turn == pytest.approx(most_turn, rel=0.05)
    assert never.shift[:3] == pytest.approx(most_shift[:3], rel=0.05)
    assert np.all(never.shift[3:] == 0.0)
    assert np.all(np.isnan(never.tilt))
    straight = invisible(one.q, ("y", "alpha", "gamma"), np.tile([0.0, 1.0, 0.0], (9, 1)))
    assert straight.tilt[0] == pytest.approx(np.tan(np.radians(1.0)) * max(size[:3]) / size[1])


def test_the_report_says_what_never_shows():
    one = scene(3, lines=60)
    result = points2dof(measurement(body("stapes", one), freq_hz=one.freq_hz))
    text = "".join(verdict_section(result).blocks)
    for words in ("What never shows", "turned together by 1", "axes of all beams together", "exchanged"):
        assert words in text


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (4.4321, "%", "4.43 %"),
        (1234.5, "%", "1230 %"),
        (13.94, "°", "13.9°"),
        (3490.0, "°", "> 60°"),
        (212.6, "µm", "213 µm"),
        (7391.0, "µm", "7.39 mm"),
    ],
)
def test_sizes_are_written_without_exponents_and_angles_stay_angles(value, unit, text):
    assert size_of(value, unit) == text


def test_along_one_beam_a_turn_is_a_tilt_that_cannot_be_seen():
    q = np.zeros((4, 6), dtype=complex)
    q[:, 2] = 1e-8
    never = invisible(q, ("z",), np.array([[0.0, 0.0, 1.0]]))
    several = invisible(q, ("z",), np.tile([0.0, 0.0, 1.0], (3, 1)))
    np.testing.assert_array_equal(never.tilt, several.tilt)
    assert np.all(np.isfinite(never.tilt))
