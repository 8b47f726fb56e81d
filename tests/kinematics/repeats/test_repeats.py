"""Repeats and levels: compared, judged at a known false alarm rate, and pooled without losing anything."""

from __future__ import annotations

import json
import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from legacy.kinematics.cli import work
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import BodyChannels, Measurement, Take
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.repeats.comparison import code_of
from legacy.kinematics.repeats.noise_degrees_of_freedom import inverse_moments, stated_freedom
from legacy.kinematics.repeats.pooling import pool_repeats
from legacy.kinematics.tidy.ldv_csv import read_ldv
from tests.kinematics.simulated import HEADER, readings, scene


def measured(seed, takes, gain=None, resonance=None, lines=60, snr=80.0, sd=True):
    """Return stapes and base in several takes, and the true responses of the first."""
    rng = np.random.default_rng([seed, 77])
    freq = np.linspace(400.0, 5000.0, lines)
    count = len(takes)
    if gain is None:
        gain = np.exp(0.03 * rng.normal(size=count) + 0.01j * rng.normal(size=count))
    moved = np.ones(count) if resonance is None else np.asarray(resonance)
    weights = rng.normal(size=(2, 9))
    bodies, truth = [], []
    for name, channels in (("stapes", 9), ("base", 6)):
        value = np.ones((count, channels, lines), dtype=complex)
        if name == "stapes":
            for take in range(count):
                for (f0, zeta), weight in zip(((1753.0, 0.12), (2783.0, 0.14)), weights, strict=True):
                    ratio = freq / (f0 * moved[take])
                    value[take] += weight[:, None] / (1.0 - ratio**2 + 2j * zeta * ratio)
        truth.append(value[0])
        spread = np.full(value.shape, 1.0 / snr)
        noise = rng.normal(size=(*value.shape, 2)) @ np.array([1.0, 1j])
        points = tuple(str(c // 3) for c in range(channels))
        beams = np.tile(np.eye(3), (channels // 3, 1))
        value = 1e-9 * (np.asarray(gain)[:, None, None] * value + spread * noise)
        places = rng.normal(size=(channels, 3))
        bodies.append(BodyChannels(name, points, places, beams, value, 1e-9 * spread if sd else None, not sd))
    runs = tuple(take.name for take in takes)
    return Measurement("footplate", runs, freq, tuple(bodies), 0, takes=tuple(takes)), truth


def repeats(count, level=np.nan, run="1"):
    return [Take(run, str(k + 1), level) for k in range(count)]


def findings(measurement):
    return [code_of(test) for report in pool_repeats(measurement).repeats for test in report.found]


def test_false_alarms_are_as_rare_as_stated():
    alarms, low, count = 0, 0, 0
    for seed in range(150):
        report = pool_repeats(measured(seed, repeats(5), lines=40, sd=bool(seed % 2))[0]).repeats[0]
        alarms += bool(report.found)
        values = [test.p_value for test in report.tests if test.name != "shape_scatter"]
        low, count = low + sum(p < 0.05 for p in values), count + len(values)
    assert 1 <= alarms <= 17
    assert 0.03 < low / count < 0.07


@pytest.mark.parametrize(
    ("code", "options"),
    [
        ("repeat_creep", {"resonance": 1.0 - 0.01 * np.linspace(0, 1, 5)}),
        ("repeat_outlier", {"resonance": [1, 1, 1.01, 1, 1]}),
        ("repeat_drift", {"gain": np.array([1.0, 1.051, 1.099, 1.149, 1.201])}),
        ("repeat_outlier", {"gain": np.array([1.0, 1.001, 0.7, 1.002, 0.9995])}),
    ],
)
@pytest.mark.parametrize("sd", [True, False])
def test_one_fault_is_one_finding(code, options, sd):
    measurement, _ = measured(3, repeats(5), sd=sd, **options)
    report = pool_repeats(measurement).repeats[0]
    assert [code_of(test) for test in report.found] == [code]
    assert report.verdict == code
    assert report.found[0].p_value < 0.01
    if code == "repeat_outlier":
        assert report.takes[report.found[0].take].repeat == "3"
    assert pool_repeats(measurement).measurement.notices[0].code == code


def levels(count=2, values=(1.0, 2.0, 4.0)):
    return [Take("1", str(k + 1), level) for level in values for k in range(count)]


def test_response_that_depends_on_level():
    takes = levels()
    level = np.array([take.level for take in takes])
    gain = level * np.array([1.01, 0.99, 1.0, 1.02, 0.99, 1.0])
    linear, _ = measured(5, takes, gain)
    assert findings(linear) == []
    soft, _ = measured(5, takes, gain, 1.0 - 0.02 * np.log(level) / np.log(4.0))
    assert findings(soft) == ["level_nonlinear"]
    compressed, _ = measured(5, takes, gain * level**-0.2)
    assert findings(compressed) == ["level_gain"]
    said = pool_repeats(compressed).measurement.notices[0].text
    assert re.search(r"amplitude grows as level to the power 0\.(79|80)", said)


def test_a_moving_resonance_is_measured():
    moved = 1.0 + np.array([0.0, -0.004, -0.008, -0.012, -0.016])
    report = pool_repeats(measured(3, repeats(5), resonance=moved, snr=300.0)[0]).repeats[0]
    assert np.allclose(report.shift - report.shift[0], np.log(moved), atol=8e-4)
    assert report.shift_share > 0.5
    assert re.search(r"as if resonances moved by -1\.[67] %", report.summary)
    still = pool_repeats(measured(3, repeats(5), snr=300.0)[0]).repeats[0]
    assert np.max(np.abs(still.shift)) < 3e-4
    assert "moved" not in still.summary


def test_levels_are_pooled_at_the_highest():
    takes = levels()
    level = np.array([take.level for take in takes])
    measurement, truth = measured(6, takes, level * 1.0, snr=1e4)
    made = pool_repeats(measurement).measurement
    assert np.allclose(made.bodies[0].displacement[0], 4e-9 * truth[0], rtol=2e-3, atol=1e-12)


def test_pooled_values_are_as_uncertain_as_they_say():
    for sd in (True, False):
        squares = []
        for seed in range(30):
            measurement, truth = measured(seed, repeats(4), sd=sd)
            made = pool_repeats(measurement).measurement
            value = np.concatenate([body.displacement[0] for body in made.bodies])
            spread = np.concatenate([body.sd[0] for body in made.bodies])
            true = np.concatenate(truth)
            power = np.sum(np.abs(true / spread) ** 2, axis=0)
            own = np.sum(true.conj() * value / spread**2, axis=0) / power
            error = np.abs((value - own * true) / spread) ** 2
            squares.append(np.sum(error, axis=0) / (2.0 * (len(true) - 1)))
        assert np.mean(squares) == pytest.approx(1.0, abs=0.03)


def test_repeats_that_differ_at_all_lines_alike_are_as_uncertain_as_they_say():
    scores = []
    for seed in range(40):
        measurement, truth = measured(seed, repeats(5), lines=100, sd=False)
        rng = np.random.default_rng([seed, 5])
        changed = []
        for body in measurement.bodies:
            shape = body.displacement.shape[:2]
            factor = 1.0 + 0.05 * (rng.normal(size=shape) + 1j * rng.normal(size=shape))
            changed.append(replace(body, displacement=body.displacement * factor[:, :, None]))
        made = pool_repeats(replace(measurement, bodies=tuple(changed))).measurement
        value = 1e9 * np.concatenate([body.displacement[0] for body in made.bodies])
        sd = 1e9 * np.concatenate([body.sd[0] for body in made.bodies])
        true = np.concatenate(truth)
        own = np.sum(true.conj() * value / sd**2, axis=0) / np.sum(np.abs(true) ** 2 / sd**2, axis=0)
        scores.append(np.mean(np.abs(value - own * true) ** 2 / (2.0 * sd**2)))
    assert 0.8 < np.mean(scores) < 1.15


def test_pooling_piece_by_piece_takes_little_memory_and_gives_the_same(monkeypatch):
    from legacy.kinematics.repeats import repeat_shapes

    measurement = measured(3, repeats(4), lines=2000)[0]
    spoiled = measurement.bodies[0].displacement
    spoiled[1, 2, 5:40] = np.nan
    made = []
    for values in (100, 10**9):
        monkeypatch.setattr(repeat_shapes, "_VALUES", values)
        made.append(pool_repeats(measurement))
    for one, two in zip(made[0].measurement.bodies, made[1].measurement.bodies, strict=True):
        np.testing.assert_allclose(one.displacement, two.displacement, rtol=1e-9)
        np.testing.assert_allclose(one.sd, two.sd, rtol=1e-9)
    for one, two in zip(made[0].repeats[0].tests, made[1].repeats[0].tests, strict=True):
        assert (one.name, one.take) == (two.name, two.take)
        assert one.size == pytest.approx(two.size, rel=1e-6)
    np.testing.assert_allclose(made[0].repeats[0].shift, made[1].repeats[0].shift, rtol=1e-6)
    monkeypatch.undo()
    tracemalloc.start()
    measurement = measured(3, repeats(4), lines=20000)[0]
    held = sum(body.displacement.nbytes for body in measurement.bodies)
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    pool_repeats(measurement)
    peak = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    assert peak < 1.5 * held


def test_sd_of_the_pooled_falls_with_the_number_of_repeats():
    one, _ = measured(2, repeats(2), gain=np.ones(2))
    many, _ = measured(2, repeats(8), gain=np.ones(8))
    ratio = pool_repeats(one).measurement.bodies[0].sd / pool_repeats(many).measurement.bodies[0].sd
    assert np.allclose(ratio, 2.0, rtol=0.02)


def test_an_excitation_of_random_phase_does_not_cancel():
    turned = np.exp(2j * np.pi * np.array([0.0, 0.3, 0.7, 0.5]))
    measurement, truth = measured(2, repeats(4), gain=turned)
    made = pool_repeats(measurement).measurement
    assert np.median(np.abs(made.bodies[1].displacement)) == pytest.approx(1e-9, rel=0.01)
    assert np.allclose(made.bodies[0].displacement[0] / made.bodies[1].displacement[0, 0], truth[0], atol=0.2)


def test_bodies_measured_in_some_repeats_only():
    measurement, truth = measured(4, repeats(4), snr=1e4)
    measurement.bodies[1].displacement[2:] = np.nan
    measurement.bodies[0].displacement[1, 4, 10:20] = np.nan
    made = pool_repeats(measurement).measurement
    for body, true in zip(made.bodies, truth, strict=True):
        assert np.all(np.isfinite(body.sd))
        size = body.displacement[0] / true
        assert np.allclose(size / size[0], 1.0, atol=3e-3)
    ratio = made.bodies[1].sd[0, 0] / made.bodies[0].sd[0, 0]
    assert np.median(ratio) == pytest.approx(np.sqrt(2.0), rel=0.05)


def test_runs_keep_their_own_repeats():
    takes = [*repeats(3), Take("2", "1")]
    measurement, _ = measured(4, takes)
    made = pool_repeats(measurement)
    assert made.measurement.runs == ("1", "2")
    assert [report.run for report in made.repeats] == ["1"]
    last = measurement.bodies[0].displacement[3]
    assert np.array_equal(made.measurement.bodies[0].displacement[1], last)


def test_a_repeat_that_holds_nothing_is_left_out():
    for nothing in (0.0, np.nan):
        measurement, _ = measured(4, repeats(4))
        for body in measurement.bodies:
            body.displacement[2] = nothing
        made = pool_repeats(measurement)
        assert [take.repeat for take in made.repeats[0].takes] == ["1", "2", "4"]
        assert [notice.code for notice in made.measurement.notices] == ["repeat_empty"]


def test_too_little_to_compare_is_said():
    measurement, _ = measured(4, repeats(2), sd=False)
    report = pool_repeats(measurement).repeats[0]
    assert report.verdict == "repeats_untested"
    assert "too few lines, channels or repeats" in report.summary


def table(folder, count=4, resonance=1.0, gain_sd=0.04, seed=3):
    """Write a table of two rigid bodies in several repeats, without sd."""
    rng = np.random.default_rng(seed)
    made = {name: scene(5 + k, lines=40, count=5) for k, name in enumerate(("stapes", "base"))}
    rows = []
    for repeat in range(count):
        gain = np.exp(gain_sd * rng.normal())
        for name, body in made.items():
            stretch = 1.0 + (resonance - 1.0) * repeat / (count - 1) if name == "stapes" else 1.0
            q = np.column_stack([np.interp(body.freq_hz * stretch, body.freq_hz, part) for part in body.q.T])
            clean = readings(body.positions_mm, body.directions, q)
            noise = body.sd * (rng.normal(size=(*clean.shape, 2)) @ np.array([1.0, 1j]))
            value = (gain * clean + noise) * 2j * np.pi * body.freq_hz
            for c, point in enumerate(body.points):
                place = ",".join(f"{x:.9g}" for x in (*body.positions_mm[c], *body.directions[c]))
                for f, v in zip(body.freq_hz, value[c], strict=True):
                    rows.append(f"{name},{point},{place},{f:.12g},{v.real:.12g},{v.imag:.12g},{repeat + 1}")
    path = folder / "ldv.csv"
    path.write_text("\n".join([HEADER.replace("sd_m_s", "repeat"), *rows]) + "\n")
    return path


def test_command_prints_the_verdict(tmp_path, monkeypatch):
    monkeypatch.setattr("legacy.kinematics.cli._write", lambda *_: [])
    path = table(tmp_path)
    _, outcome = work([str(path), "--out", str(tmp_path / "dof.csv")])
    said = dict(outcome.rows)["repeats"]
    assert said.startswith("4 repeats agree in shape (amplitudes scatter by")
    (report,) = outcome.result["repeats"]
    assert report["verdict"] == "repeats_agree"
    assert [take["repeat"] for take in report["takes"]] == ["1", "2", "3", "4"]
    assert json.loads(json.dumps(report)) == report
    _, outcome = work([str(table(tmp_path, resonance=1.03)), "--out", str(tmp_path / "dof.csv")])
    assert "the responses change relative to each other by" in dict(outcome.rows)["repeats"]
    assert "repeat_creep" in [notice.code for notice in outcome.notices]


def test_gain_scatter_is_an_error_that_all_lines_share(tmp_path):
    measurement = read_ldv(table(tmp_path, gain_sd=0.05))
    result = points2dof(measurement)
    assert result.motion.runs == ("1",)
    place = result.motion.shared.names.index("repeats.1.gain")
    sd = np.sqrt(result.motion.shared.covariance[place, place])
    gains = np.log(result.repeats[0].gain)
    assert sd == pytest.approx(np.std(gains, ddof=1) / 2.0)
    assert np.array_equal(result.motion.shared.derivatives[place], result.motion.q)
    ratio = points2dof(measurement, options=Options(reference="base:y"))
    moved = np.abs(ratio.motion.shared.derivatives[place])
    assert np.max(moved) < 1e-9 * np.max(np.abs(ratio.motion.q))


def test_level_columns(tmp_path):
    head = "body,point,x_mm,y_mm,z_mm,dir,freq_hz,re_m_s,im_m_s,level_db"
    rows = [f"s,1,0,0,0,y,100,{k + 1},0,{k * 20}" for k in range(3)]
    path = tmp_path / "ldv.csv"
    path.write_text("\n".join([head, *rows]) + "\n")
    assert [take.level for take in read_ldv(path).takes] == [1.0, 10.0, 100.0]
    path.write_text("\n".join([head.replace("_db", "_pa"), *rows]) + "\n")
    with pytest.raises(ValueError, match=r"level_pa must be positive and finite; got 0 \(ldv.csv, line 2"):
        read_ldv(path)
    path.write_text("\n".join([head + ",level", *(row + ",1" for row in rows)]) + "\n")
    with pytest.raises(ValueError, match="the level of excitation must be given once; got level_db, level"):
        read_ldv(path)
    path.write_text("\n".join([head.replace("level_db", "repeat"), rows[0], rows[0]]) + "\n")
    with pytest.raises(ValueError, match=r"same as in line 2 .*Number repeats in a column repeat"):
        read_ldv(path)


def test_takes_kept_separate_are_compared_all_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr("legacy.kinematics.cli._write", lambda *_: [])
    path = table(tmp_path, count=3, resonance=1.03)
    _, outcome = work([str(path), "--repeats", "separate", "--dof", "x,y,z,alpha,beta,gamma"])
    assert outcome.result["runs"] == ["1 repeat 1", "1 repeat 2", "1 repeat 3"]
    said = dict(outcome.rows)["repeats of 1"]
    assert said.startswith("3 repeats were kept separate and disagree: the responses change relative")
    assert "repeat_creep" in [notice.code for notice in outcome.notices]
    with pytest.raises(ValueError, match="--repeats must be one of pool, separate; got mean"):
        Options(repeats="mean")


@pytest.mark.parametrize(("gain", "percent", "degrees"), [(1.06, 6.0, 0.0), (-1.0, 0.0, 180.0)])
def test_one_of_three_repeats_that_stands_apart_is_named(gain, percent, degrees):
    measurement, _ = measured(6, repeats(3), gain=np.array([1.0, 1.0003, gain], dtype=complex))
    (notice,) = pool_repeats(measurement).measurement.notices
    assert notice.code == "repeat_outlier"
    found = re.search(r"repeat 3 differs by (\S+) % in amplitude and (\S+) degrees", notice.text)
    assert found is not None
    assert float(found[1]) == pytest.approx(percent, abs=0.5)
    assert abs(float(found[2])) == pytest.approx(degrees, abs=0.5)


def test_sd_of_three_averages_are_no_scatter_of_the_repeats():
    """They scatter as chi2 of 4 degrees of freedom: sd alone, without the number of averages, show it."""
    alarms, scores = 0, []
    for seed in range(40):
        made, _ = measured(seed, repeats(3))
        rng = np.random.default_rng(seed)
        rough = [
            replace(body, sd=body.sd * np.sqrt(rng.chisquare(4, body.sd.shape) / 4)) for body in made.bodies
        ]
        result = pool_repeats(replace(made, bodies=tuple(rough)))
        alarms += bool(result.repeats[0].found)
        assert abs(result.repeats[0].sd_factor - 1.0) < 0.15
        body = result.measurement.bodies[1]
        left = body.displacement[0] - np.mean(body.displacement[0], axis=0)
        scores.append(np.mean(np.abs(left) ** 2 / 2.0 / body.sd[0] ** 2) * 6 / 5)
    assert alarms <= 6
    assert abs(np.mean(scores) - 1.0) < 0.08


@pytest.mark.parametrize("freedom", [4, 18, np.inf])
def test_freedom_of_stated_noise_is_told_by_its_scatter(freedom):
    rng = np.random.default_rng(3)
    shape = (4, 12, 300)
    scatter = 1.0 if np.isinf(freedom) else rng.chisquare(freedom, shape) / freedom
    logs = np.log(rng.uniform(0.5, 2.0, (4, 1, 1)) * rng.uniform(0.1, 9.0, (1, 12, 300)) * scatter)
    assert stated_freedom(iter([logs])) == pytest.approx(freedom, rel=0.1)


@pytest.mark.parametrize(("freedom", "takes"), [(4, 3), (6, 2), (18, 5)])
def test_mean_of_true_over_estimated_noise_power(freedom, takes):
    rng = np.random.default_rng(4)
    drawn = np.exp(-np.mean(np.log(rng.chisquare(freedom, (400_000, takes)) / freedom), axis=1))
    mean, doubt = inverse_moments(freedom, takes)
    assert mean == pytest.approx(np.mean(drawn), rel=0.01)
    assert doubt == pytest.approx(np.var(drawn) / np.mean(drawn) ** 2, rel=0.1)


def test_channels_that_differ_between_repeats_have_the_noise_that_shows():
    """A change of every channel from repeat to repeat is larger where it moves more."""
    held = []
    for seed in range(20):
        made, truth = measured(seed, repeats(5))
        rng = np.random.default_rng([seed, 8])
        bodies = [
            replace(body, displacement=body.displacement * (1.0 + 0.1 * change[:, :, None]))
            for body in made.bodies
            for change in [rng.normal(size=(*body.displacement.shape[:2], 2)) @ [1.0, 1j]]
        ]
        result = pool_repeats(replace(made, bodies=tuple(bodies))).measurement
        value = np.concatenate([body.displacement[0] for body in result.bodies])
        sd = np.concatenate([body.sd[0] for body in result.bodies])
        true = np.concatenate(truth)
        weight = 1.0 / sd**2
        total = np.sum(weight * np.abs(true) ** 2, axis=0)
        error = value - true * np.sum(weight * true.conj() * value, axis=0) / total
        held.append(
            np.mean(np.abs(error.real) < 1.96 * sd * np.sqrt(1.0 - weight * np.abs(true) ** 2 / total))
        )
    assert 0.935 < np.mean(held) < 0.965
