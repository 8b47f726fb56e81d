"""What a change does to a response: limits at low and high frequencies, a closed form, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fitting.unknowns import point
from pipeline.cohort.ears import Ear, read_ears
from pipeline.run import StudyResult
from pipeline.stapeskit_command import work
from pipeline.what_if import change_db, read_change
from stapeskit.faults import StapeskitError
from stapeskit.spatial import matrix_from_parameters

K, D, M = 1700.0, 0.02, 3e-6
FREQ = np.geomspace(200.0, 5000.0, 50)


def changed(ear: Ear, words: str) -> np.ndarray:
    """Change of the response and its limits, dB."""
    return change_db(ear, Path(), read_change(words), FREQ)


def piston(law: str = "viscous", sd: float = 0.0) -> Ear:
    """An ear that only moves as a piston."""
    kd = {
        "dof": ["y"],
        "stiffness_si": [[K]],
        "damping_si": [[D if law == "viscous" else 300.0]],
        "mass_matrix_si": [[M]],
        "covariance_si": [[sd**2 * K**2, 0.0], [0.0, 0.0]],
        "model": {"damping_law": law, "damping_exponent": 1.0 if law == "viscous" else 0.0},
    }
    return Ear("piston", "piston", "", {}, kd)


@pytest.mark.parametrize("law", ["viscous", "hysteretic"])
def test_a_piston_changes_as_its_closed_form_says(law: str) -> None:
    omega = 2.0 * np.pi * FREQ
    loss = 1j * omega * D if law == "viscous" else 300.0j
    before, after = (1.0 / (factor * K + loss - omega**2 * M) for factor in (1.0, 10.0))
    expected = 20.0 * np.log10(np.abs(after / before))
    assert changed(piston(law), "K*10")[0] == pytest.approx(expected, abs=1e-9)


def test_the_interval_is_that_of_the_stiffness() -> None:
    _, low, high = changed(piston(sd=0.03), "D*3")
    stiffer, softer = (changed(_scaled(factor), "D*3")[0] for factor in (1.03, 0.97))
    spread = 0.5 * np.abs(stiffer - softer)
    steep = spread > 0.5 * spread.max()
    half = 0.5 * (high - low) / 1.96
    assert half[steep] == pytest.approx(spread[steep], rel=0.3)


def _scaled(factor: float) -> Ear:
    ear = piston()
    ear.kd["stiffness_si"][0][0] *= factor  # type: ignore[index]
    return ear


def test_an_added_mass_at_the_centre_weighs_at_high_frequencies() -> None:
    omega = 2.0 * np.pi * FREQ[-1]
    exact = np.abs((K + 1j * omega * D - omega**2 * M) / (K + 1j * omega * D - omega**2 * 3.0 * M))
    found = changed(piston(), "mass+6mg@0,0,0")[0, -1]
    assert found == pytest.approx(20.0 * np.log10(exact), abs=1e-9)


def test_a_point_mass_has_the_energy_of_its_velocity() -> None:
    place, q = np.array([0.3e-3, 3e-3, -0.2e-3]), np.array([1.0, -2.0, 0.5, 300.0, 100.0, -200.0])
    velocity = q[:3] + np.cross(q[3:], place)
    assert q @ matrix_from_parameters(point(place, 5e-6)) @ q == pytest.approx(5e-6 * velocity @ velocity)


@pytest.mark.parametrize("words", ["K10", "K*-2", "K*0", "mass+5@head", "mass-5mg@head", "mass+5mg@1,2", ""])
def test_what_is_no_change_is_refused(words: str) -> None:
    with pytest.raises(StapeskitError) as raised:
        read_change(words)
    assert raised.value.faults[0].thing == "--what-if"


def test_a_finished_study_answers(finished: StudyResult, tmp_path: Path) -> None:
    (ear,) = read_ears([(finished.out, "ear", {})])
    fixed = change_db(ear, finished.out, read_change("K*10"), [200.0])
    assert fixed[0] == pytest.approx(-20.0, abs=0.3)
    assert fixed[1] <= fixed[2]
    outcome = work(["compare", str(finished.out), "--what-if", "K*10", "--what-if", "mass+5mg@head"])
    assert outcome is not None
    assert sum("dB" in text for _, text in outcome.rows) == 10
    with pytest.raises(StapeskitError):
        read_ears([(tmp_path, "none", {})])
