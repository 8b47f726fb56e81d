"""Small versions of the Monte Carlo benchmark, and its scripts."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from benchmarks import points_estimation as trial
from benchmarks import points_speed


def test_known_noise_is_used_to_the_bound_with_honest_errors():
    rows = {row.name: row for row in trial.known_noise(4000)}
    for name in (
        "equal noise",
        "channels differ up to 10 x",
        "all values differ",
        "10 % of single values missing",
    ):
        row = rows[name]
        assert np.all(np.abs(row.ratio - 1.0) < 0.06)
        assert abs(np.mean(row.ratio) - 1.0) < 0.03
        assert row.coverage == pytest.approx(0.95, abs=0.01)
        assert row.alarms == pytest.approx(0.05, abs=0.01)
    assert np.mean(rows["channels differ up to 10 x, weights ignored"].ratio) > 1.5


def test_ten_averages_weigh_nearly_as_well_as_known_noise():
    for count, plain in ((10, 1.1), (5, 1.3)):
        stated, steady = trial.averaged(3000, count)
        assert np.mean(stated.ratio) < plain
        assert np.mean(steady.ratio) < 1.05
        assert steady.coverage == pytest.approx(0.95, abs=0.01)
        assert steady.alarms == pytest.approx(0.05, abs=0.01)
    assert np.mean(next(trial.averaged(3000, 3)).ratio) > 1.3


@pytest.mark.parametrize("kind", ["huber", "t4"])
def test_outliers_cost_a_robust_fit_little(kind):
    row = trial.with_outliers(1500, kind, 0.05)
    assert np.max(row.ratio) < 1.6
    assert row.coverage == pytest.approx(0.95, abs=0.015)


def test_raw_beams_of_three_lasers_reach_the_bound():
    for half, least in ((10.0, 2.5), (20.0, 1.5), (30.0, 1.15)):
        loss, raw = trial.cone(3000, half)
        assert loss > least
        assert raw == pytest.approx(1.0, abs=0.06)


def test_common_noise_is_stated_right():
    stated, without = trial.reference_noise(4000, 0.05)
    assert stated == pytest.approx(1.0, abs=0.08)
    assert without < 0.01


def test_the_variance_of_a_ratio_is_right_down_to_ten():
    for snr in (100.0, 10.0):
        ratio, covered = trial.ratio_coverage(20000, snr)
        assert ratio == pytest.approx(1.0, abs=0.06)
        assert covered == pytest.approx(0.95, abs=0.006)


def test_errors_of_geometry_stated_as_priors_are_honest():
    assert trial.nees(150) == pytest.approx(1.0, abs=0.1)
    assert trial.nees(30, stated=False) > 5.0


def test_the_speed_table_runs_without_peers(capsys, monkeypatch):
    monkeypatch.delenv("POINTS_PEERS", raising=False)
    monkeypatch.setattr(sys, "argv", ["points_speed.py", "--points", "5", "--lines", "60", "--repeat", "1"])
    points_speed.main()
    text = capsys.readouterr().out
    assert "pyFBS and sdynpy: not run" in text
    assert "| DOFs, residuals, chi2 and energies per channel |" in text
