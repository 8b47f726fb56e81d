"""Monte Carlo against the linear propagation of every source at once."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from legacy.fitting.cli import work
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.montecarlo import monte_carlo
from legacy.fitting.options import KDOptions
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.records.mass_record import frame_derivative
from legacy.stapeskit.records.motion_files import write_motion
from tests.fitting.cases import M, paper_motion, six_dof_mass, six_dof_motion, six_dof_parameters
from tests.fitting.uncertainty.test_uncertainty import with_frame_errors


@pytest.mark.parametrize(("inplane", "refits", "tolerance"), [("load", 800, 0.10), ("auto", 150, 0.25)])
def test_scatter_of_refits_is_the_stated_sd(inplane: str, refits: int, tolerance: float) -> None:
    """Noise, mass and a frame that moves motion and mass together, in one draw."""
    pose = np.diag([1e-9, 4e-10, 1e-9, 1e-4, 1e-4, 1e-4])
    parameters = six_dof_parameters()
    slope = frame_derivative(parameters)
    contributions = {
        "frame": slope @ pose @ slope.T,
        "density": 0.02**2 * np.outer(parameters, parameters),
    }
    motion = with_frame_errors(six_dof_motion(0.02, 0, lines=60), pose)
    fit = fit_kd(motion, six_dof_mass(contributions), KDOptions(inplane=inplane))
    assert {"footplate_frame", "mass.density", "channel_noise"} <= set(fit.budget.sources)
    found = monte_carlo(fit, refits)
    assert found.failed == 0
    stated = np.sqrt(np.diag(fit.covariance))
    assert found.standard_deviation == pytest.approx(stated, rel=tolerance)
    assert found.frequencies_hz.std(axis=0) == pytest.approx(fit.derived.frequency_sd_hz, rel=tolerance)
    width = np.diff(found.intervals)[:, 0]
    assert width == pytest.approx(2.0 * 1.96 * stated, rel=1.5 * tolerance)


@pytest.mark.parametrize(("estimator", "tolerance"), [("ml", 0.15), ("irls", 0.4)])
def test_noise_alone(estimator: str, tolerance: float) -> None:
    fit = fit_kd(paper_motion(0.05, 0, 60), M, KDOptions(estimator=estimator))
    found = monte_carlo(fit, 400)
    assert found.standard_deviation == pytest.approx(np.sqrt(np.diag(fit.noise_covariance)), rel=tolerance)


def test_same_seed_same_result() -> None:
    fit = fit_kd(paper_motion(0.05, 0, 40), M)
    assert np.array_equal(monte_carlo(fit, 5, 3).estimates, monte_carlo(fit, 5, 3).estimates)
    assert not np.array_equal(monte_carlo(fit, 5, 3).estimates, monte_carlo(fit, 5, 4).estimates)


@pytest.mark.usefixtures("undrawn")
def test_command_writes_the_scatter(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.savetxt("M.csv", M, delimiter=",")
    from dataclasses import replace

    motion = paper_motion(0.05, 0, 40)
    ones = np.ones_like(motion.chi2)
    write_motion(tmp_path, "dof", replace(motion, chi2=42.0 * ones, n_dof=42.0 * ones))
    work(["dof.csv", "--mass", "M.csv", "--monte-carlo", "30"])
    content = json.loads(Path("kd.json").read_text(encoding="utf-8"))["monte_carlo"]
    assert content["refits"] == 30
    assert set(content["sd_over_linear_propagation"]) == set(content["sd_si"])
    assert "Monte Carlo" in Path("kd.html").read_text(encoding="utf-8")
    with pytest.raises(StapeskitError, match="whole number from 20"):
        work(["dof.csv", "--mass", "M.csv", "--monte-carlo", "3"])
