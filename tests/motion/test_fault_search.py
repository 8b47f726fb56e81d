"""Faults are found, called by their name, and files without one are left alone."""

from dataclasses import replace

import numpy as np
import pytest

from kinematics.faults.correct import corrected
from kinematics.faults.rounds import detectable
from kinematics.faults.search import diagnose
from kinematics.faults.verdicts import WORDS, channel_verdicts, fault_notices, write_channels
from kinematics.fit.few_averages import with_steady_noise
from kinematics.measurement import BodyChannels
from simulate import KINDS as SIMULATED
from stapeskit.spatial import DOF_NAMES
from tests.motion.bodies import as_measurement, fitted, recorded

ONE_BODY = (
    "gain", "phase", "delay", "sign", "drift", "noise", "direction", "position", "point_sign", "laser_gain",
    "laser_sign", "laser_direction", "axes",
)  # fmt: skip


def diagnosed(recording, stated=True):
    """Return body, fits and diagnosis of a recording."""
    measurement = as_measurement(recording, stated)
    dof = DOF_NAMES if recording.laser.max() else ("y", "alpha", "gamma")
    body, fits = fitted(measurement, dof)
    return body, fits, diagnose(body, fits, recording.freq_hz)


def verdicts(found):
    """Return the verdict of each channel at fault."""
    return {channel: one.verdict for one in reversed(found.findings) for channel in one.channels}


@pytest.mark.parametrize("stated", [True, False])
def test_faults_are_called_by_their_names(stated):
    missed = []
    for seed, kind in enumerate(ONE_BODY):
        recording = recorded(seed, points=10, lines=80, faults=[{"kind": kind}])
        body, _, found = diagnosed(recording, stated)
        if verdicts(found) != dict(recording.culprits):
            missed.append(kind)
        assert len(fault_notices(body, found)) == len(found.findings)
    assert set(ONE_BODY) <= set(SIMULATED)
    assert len(missed) <= 1, missed


@pytest.mark.parametrize("stated", [True, False])
def test_a_dead_channel_drives_no_other_error_beyond_what_is_stated(stated):
    """It read noise alone; gain and phase of its laser took the blame, and beams of its point."""
    for seed in range(4):
        recording = recorded(seed, points=8, lines=60, beam_cone_deg=54.7356)
        value = recording.velocity_m_s.copy()
        noise = np.random.default_rng(seed).normal(size=(1, 60, 2)).view(complex)[..., 0]
        value[:, 4] = recording.sd_m_s[:, 4] * noise
        found = diagnosed(replace(recording, velocity_m_s=value), stated)[2]
        assert verdicts(found) == {4: "gain"}
        assert found.findings[0].values[0] == pytest.approx(-1.0, abs=0.02)


def test_two_faults_at_once_are_both_found():
    faults = [{"kind": "gain", "point": "3"}, {"kind": "sign", "point": "7"}]
    for seed in (0, 1):
        recording = recorded(seed, points=10, lines=60, faults=faults)
        assert verdicts(diagnosed(recording)[2]) == dict(recording.culprits)


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("missing", [0.0, 0.15])
def test_files_without_fault_raise_few_alarms(stated, missing):
    alarms = 0
    for seed in range(40):
        recording = recorded(100 + seed, points=6, lines=60, missing=missing)
        alarms += bool(verdicts(diagnosed(recording, stated)[2]))
    assert alarms <= 3  # 1 % expected: more than 3 of 40 has a probability of 7e-4


def test_few_channels_of_unknown_noise_raise_few_alarms():
    """Their weights follow the noise that they are estimated from: that of the motion is larger."""
    given = {"points": 4, "lines": 120, "noise_spread": (0.6, 1.6)}
    firsts = [diagnosed(recorded(9000 + seed, **given), False)[2].first for seed in range(40)]
    # 1 % expected, 20 % where this is left out
    assert sum(first.log_whole < np.log(0.01) for first in firsts) <= 3


@pytest.mark.parametrize("averages", [4, 16])
def test_noise_from_coherence_of_few_averages_raises_few_alarms(averages):
    """Half of such files were called bodies that bend: their noise scatters from line to line."""
    alarms, squares = 0, []
    for seed in range(20):
        recording = recorded(800 + seed, points=6, lines=80)
        (body,) = as_measurement(recording).bodies
        energy = np.random.default_rng(seed).chisquare(2 * (averages - 1), body.sd.shape)
        body = replace(
            body, sd=body.sd * np.sqrt(energy / (2 * averages)), averages=np.full(18, float(averages))
        )
        measurement = replace(as_measurement(recording), bodies=(with_steady_noise(body),))
        body, (fit,) = fitted(measurement)
        found = diagnose(body, [fit], recording.freq_hz)
        alarms += bool(found.findings or found.causes)
        sd = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2) / 2.0)
        squares.append(np.mean(np.abs((fit.q - recording.motion_m["stapes"][0]) / sd) ** 2) / 2.0)
    assert alarms <= 2
    assert np.mean(squares) == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_noise_of_few_averages_follows_the_amplitude_where_it_does(share):
    """White noise, and noise in proportion to a sharp resonance: a pool that smears it is 8 times off."""
    averages, shape = 5, (100, 1, 120)
    rng, freq_hz = np.random.default_rng(11), np.geomspace(200.0, 6000.0, 120)
    amplitude = np.abs(1.0 / (1.0 - (freq_hz / 2000.0) ** 2 + 0.03j * freq_hz / 2000.0))
    truth = 0.05 * amplitude**share
    stated = truth * np.sqrt(rng.chisquare(2 * (averages - 1), shape) / (2 * averages))
    body = BodyChannels(
        "stapes", ("1",), np.zeros((1, 3)), np.eye(3)[:1], np.broadcast_to(amplitude + 0j, shape), stated,
        averages=np.array([float(averages)]),
    )  # fmt: skip
    found = np.sqrt(np.mean(with_steady_noise(body).sd ** 2, axis=(0, 1)))
    assert found == pytest.approx(truth, rel=0.1)


def test_stated_errors_of_positions_are_expected():
    alarms = sum(
        bool(verdicts(diagnosed(recorded(200 + seed, points=6, position_sd_mm=0.03))[2]))
        for seed in range(12)
    )
    assert alarms <= 2


@pytest.mark.parametrize(("points", "lasers", "size"), [(8, 3, 0.06), (20, 1, 0.03)])
def test_a_body_that_bends_is_flexible(points, lasers, size):
    named = 0
    for seed in (1, 2):
        bends = [{"kind": "flexible", "size": size}]
        found = diagnosed(recorded(seed, points=points, lines=60, lasers=lasers, faults=bends))[2]
        named += set(verdicts(found).values()) == {"flexible"}
    assert named == 2


def test_points_at_fault_that_hide_each_other_are_named():
    faults = [{"kind": "point_gain", "size": 1.0, "point": point} for point in "2468"]
    recording = recorded(3, points=10, lines=60, faults=faults)
    assert verdicts(diagnosed(recording)[2]) == dict(recording.culprits)


def test_a_point_that_moves_on_its_own_is_the_only_one_accused():
    recording = recorded(5, points=10)
    other = recorded(6, points=10)
    value = recording.velocity_m_s.copy()
    value[:, 9:12] = other.velocity_m_s[:, 9:12]
    changed = replace(recording, velocity_m_s=value)
    assert set(verdicts(diagnosed(changed)[2])) == {9, 10, 11}


def test_noise_larger_than_stated_everywhere_is_no_fault():
    recording = recorded(7)
    louder = replace(recording, sd_m_s=recording.sd_m_s / 1.5)
    found = diagnosed(louder)[2]
    assert found.findings == ()
    assert found.noise_level == pytest.approx(1.5, rel=0.05)


def test_gains_that_differ_everywhere_are_one_cause():
    recording = recorded(8, points=12)
    factor = 1.0 + 0.02 * np.random.default_rng(8).normal(size=36)
    changed = replace(recording, velocity_m_s=recording.velocity_m_s * factor[:, None])
    _body, _, found = diagnosed(changed)
    assert found.findings == ()
    (cause,) = found.causes
    assert cause.code == "channels_scattered"
    assert " % " in cause.text


def test_a_drift_in_the_order_of_the_file_is_one_cause():
    recording = recorded(8, points=12)
    course = 1.0 + 0.06 * np.repeat(np.linspace(-1.0, 1.0, 12), 3)
    changed = replace(recording, velocity_m_s=recording.velocity_m_s * course[:, None])
    found = diagnosed(changed)[2]
    assert found.findings == ()
    (cause,) = found.causes
    assert cause.code == "channels_scattered"
    assert "repeat" in cause.step


@pytest.mark.parametrize("stated", [True, False])
def test_noise_in_proportion_to_amplitude_accuses_no_channel(stated):
    accused, named = 0, 0
    for seed in range(3):
        exact = recorded(300 + seed, exact=True)
        value = exact.velocity_m_s.copy()
        noise = np.random.default_rng(seed).normal(size=(*value.shape, 2)).view(complex)[..., 0]
        sd = np.broadcast_to(0.01 * np.sqrt(np.mean(np.abs(value) ** 2)), value.shape).copy()
        clean = replace(exact, velocity_m_s=value + 0.01 * np.abs(value) * noise, sd_m_s=sd, stated="sd")
        accused += bool(verdicts(diagnosed(clean, stated)[2]))
        changed = clean.velocity_m_s.copy()
        changed[:, 4] *= 1.05
        named += verdicts(diagnosed(replace(clean, velocity_m_s=changed), stated)[2]) == {4: "gain"}
    assert (accused, named) == (0, 3)


@pytest.mark.parametrize(("single", "mains"), [(True, False), (False, False), (False, True)])
def test_values_and_lines_far_off_are_one_cause(single, mains):
    recording = recorded(4)
    rng = np.random.default_rng(0)
    value = recording.velocity_m_s.copy()
    if single:
        far = rng.random(value.shape) < 0.01
        value[far] += 30.0 * recording.sd_m_s[far] * (1.0 + 1.0j)
    else:
        lines = [10, 30, 50, 70]
        value[:, :, lines] += 20.0 * recording.sd_m_s[:, :, lines] * rng.normal(size=(1, 27, 4))
    freq = np.linspace(403.0, 5163.0, 120) if not mains else 50.0 * np.arange(8, 128)
    found = diagnosed(replace(recording, velocity_m_s=value, freq_hz=freq))[2]
    assert found.findings == ()
    (cause,) = found.causes
    assert cause.code == "outliers"
    assert ("50 Hz" in cause.step) == mains


def test_values_far_off_in_strong_signals_are_no_bending():
    """They pull least squares, and the errors of positions with it, farther than any shape of bending."""
    recording = recorded(38, lines=40, noise=0.003)
    far = np.random.default_rng(3).random(recording.velocity_m_s.shape) < 0.03
    value = np.where(far, 3.0, 1.0) * recording.velocity_m_s
    (cause,) = diagnosed(replace(recording, velocity_m_s=value))[2].causes
    assert cause.code == "outliers"
    assert cause.text.startswith(tuple(str(count) for count in range(22, 44)))


def test_estimates_lie_within_their_sd():
    pulls = []
    for seed in range(8):
        recording = recorded(seed, lines=60, faults=[{"kind": "gain", "size": 0.06}])
        (one,) = diagnosed(recording)[2].findings
        pulls.append((one.values[0] - 0.06) / one.sd[0])
    assert 0.3 < np.sqrt(np.mean(np.square(pulls))) < 1.8


def test_a_corrected_laser_agrees_with_the_others():
    recording = recorded(3, points=10, faults=[{"kind": "laser_gain", "size": 0.2}])
    body, _, found = diagnosed(recording)
    fixed = corrected(body, found, recording.freq_hz)
    assert len(fixed.errors) == len(fixed.covariance) == 1
    measurement = replace(as_measurement(recording), bodies=(fixed.body,))
    _, (after,) = fitted(measurement)
    freedom = np.sum(after.n_dof)
    assert np.sum(after.chi2) < freedom + 5.0 * np.sqrt(2.0 * freedom)
    wrong = sorted(recording.culprits)
    factor = body.value[:, wrong] / fixed.body.value[:, wrong]
    assert np.allclose(factor, 1.2, rtol=0.01)


def test_a_fault_of_the_detectable_size_is_found_as_often_as_promised():
    clean = recorded(11, lines=48)
    now = diagnosed(clean)[2].first
    size = {(one.kind, one.place.channels): one.size for one in detectable(now)}
    exact = recorded(11, lines=48, exact=True).velocity_m_s.copy()
    exact[:, 4] *= 1.0 + size["gain", (4,)]
    found = 0
    for seed in range(16):
        rng = np.random.default_rng(seed)
        noise = clean.sd_m_s * rng.normal(size=(*clean.sd_m_s.shape, 2)).view(complex)[..., 0]
        found += not diagnosed(replace(clean, velocity_m_s=exact + noise))[2].first.clean()
    assert found >= 11  # 90 % expected: less than 11 of 16 has a probability of 1 %


def test_the_table_of_channels_has_one_row_each(tmp_path):
    recording = recorded(1, points=5, faults=[{"kind": "sign", "point": "2", "laser": 1}])
    body, (fit,), found = diagnosed(recording)
    rows = channel_verdicts("1", body, found, fit.channel_rms_m, fit.solution.weight, {0: "unused"})
    assert [row.verdict for row in rows] == ["unused", *["ok"] * 3, "sign", *["ok"] * 10]
    assert all(row.verdict in WORDS for row in rows)
    assert np.isnan(rows[0].p_value)
    assert rows[4].p_value < 1e-6
    write_channels(tmp_path / "dof.channels.csv", rows)
    lines = (tmp_path / "dof.channels.csv").read_text().splitlines()
    assert len(lines) == 16
    assert lines[0] == "run,body,point,dir_x,dir_y,dir_z,residual_rms_m,weight,verdict,estimate,p_value"
    assert [notice.code for notice in fault_notices(body, found)] == ["channel_sign"]


@pytest.mark.parametrize("where", ["laser", "point"])
def test_a_laser_or_point_that_is_louder_in_all_its_beams_is_one_finding(where):
    recording = recorded(11, points=10)
    own = [c for c in range(30) if (c % 3 == 1 if where == "laser" else c // 3 == 4)]
    sd = recording.sd_m_s.copy()
    sd[:, own] /= 1.4
    (finding,) = diagnosed(replace(recording, sd_m_s=sd))[2].findings
    assert finding.kind == "noise"
    assert list(finding.channels) == own
    assert finding.values[0] == pytest.approx(1.4, rel=0.1)


def rounded(recording, digits):
    """Return a recording whose stated sd have so many significant digits."""
    sd = recording.sd_m_s
    unit = 10.0 ** (np.floor(np.log10(sd)) - digits + 1)
    return replace(recording, sd_m_s=np.round(sd / unit) * unit)


@pytest.mark.parametrize(("digits", "lines"), [(1, 40), (1, 300), (2, 1000)])
def test_sd_of_few_digits_make_no_channel_loud_and_no_body_flexible(digits, lines):
    given = {"points": 7, "lines": lines, "noise_spread": (0.6, 1.6)}
    alarms = [verdicts(diagnosed(rounded(recorded(seed, **given), digits))[2]) for seed in range(8)]
    assert sum(map(bool, alarms)) <= 1
    faulty = rounded(recorded(3, faults=[{"kind": "noise"}], **given), digits)
    assert verdicts(diagnosed(faulty)[2]) == dict(faulty.culprits)
    faulty = rounded(recorded(4, faults=[{"kind": "gain"}], **given), digits)
    assert verdicts(diagnosed(faulty)[2]) == dict(faulty.culprits)


def test_no_fault_explains_more_than_there_is():
    """Else a reversed point, loud in all its beams, is called noise: its squares there exceed the misfit."""
    first = diagnosed(recorded(1, points=10, faults=[{"kind": "point_sign"}]))[2].first
    whole = first.estimate.chi2 + first.state.noise_energy[0].sum()
    assert first.evidence(2.0 * whole, 1) <= first.evidence(whole, 1)
