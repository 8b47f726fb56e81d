"""What a change does to a response: limits at low and high frequencies, a closed form, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fitting.unknowns import point
from pipeline.cohort.ears import Ear, read_ears
from pipeline.compare import write_comparison
from pipeline.run import StudyResult
from pipeline.what_if import effect, read_change
from stapeskit.faults import StapeskitError
from stapeskit.spatial import matrix_from_parameters

K, D, M = 1700.0, 0.02, 3e-6


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
    found = effect(piston(law), Path(), read_change("K*10"))
    omega = 2.0 * np.pi * found.freq_hz
    loss = 1j * omega * D if law == "viscous" else 300.0j
    before, after = (1.0 / (factor * K + loss - omega**2 * M) for factor in (1.0, 10.0))
    assert found.change_db == pytest.approx(20.0 * np.log10(np.abs(after / before)), abs=1e-9)


def test_the_interval_is_that_of_the_stiffness() -> None:
    found = effect(piston(sd=0.03), Path(), read_change("D*3"))
    stiffer, softer = (effect(_scaled(factor), Path(), read_change("D*3")) for factor in (1.03, 0.97))
    spread = 0.5 * np.abs(stiffer.change_db - softer.change_db)
    steep = spread > 0.5 * spread.max()
    half = 0.5 * (found.high_db - found.low_db) / 1.96
    assert half[steep] == pytest.approx(spread[steep], rel=0.3)


def _scaled(factor: float) -> Ear:
    ear = piston()
    ear.kd["stiffness_si"][0][0] *= factor  # type: ignore[index]
    return ear


def test_an_added_mass_at_the_centre_weighs_at_high_frequencies() -> None:
    found = effect(piston(), Path(), read_change("mass+6mg@0,0,0"))
    omega = 2.0 * np.pi * found.freq_hz[-1]
    exact = np.abs((K + 1j * omega * D - omega**2 * M) / (K + 1j * omega * D - omega**2 * 3.0 * M))
    assert found.change_db[-1] == pytest.approx(20.0 * np.log10(exact), abs=1e-9)


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
    effects = [effect(ear, finished.out, read_change(one)) for one in ("K*10", "mass+5mg@head")]
    assert effects[0].change_db[0] == pytest.approx(-20.0, abs=0.3)
    assert np.all(effects[0].low_db <= effects[0].high_db)
    files = write_comparison(effects, tmp_path / "out", [finished.out / "kd.json"])
    table = pd.read_csv(next(path for path in files if path.suffix == ".csv"))
    assert set(table["change"]) == {"K*10", "mass+5mg@head"}
    with pytest.raises(StapeskitError):
        read_ears([(tmp_path, "none", {})])
