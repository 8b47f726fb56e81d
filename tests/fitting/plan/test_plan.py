"""Expected standard deviations: against scatter, against more data, and faults of plan.toml."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fitting.cli import parser, work
from fitting.errors import FittingError
from fitting.estimators import ml
from fitting.estimators.base import EstimatorOptions
from fitting.model.damping import VISCOUS
from fitting.model.lines import Scale, assemble
from fitting.model.observation import observe
from fitting.plan.plan import Plan, expect, planned_motion
from fitting.plan.plan_example import PLAN_EXAMPLE
from fitting.plan.plan_file import read_plan
from stapeskit.faults import StapeskitError
from stapeskit.spatial import DOF_NAMES
from tests.fitting.cases import DOF, M, six_dof_mass, six_dof_matrices


def write(folder: Path, text: str) -> Path:
    path = folder / "plan.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_expected_sd_is_the_scatter_of_fits() -> None:
    plan = Plan(noise_relative=0.05, lines=100)
    expected = np.sqrt(np.diag(expect(plan).planned.covariance))
    observation = observe(planned_motion(plan), DOF)
    scale = Scale.of(observation, M)
    units = scale.parameter_units(VISCOUS)
    root = np.linalg.cholesky(observation.covariance)
    rng = np.random.default_rng(5)
    found = []
    for _ in range(400):
        draw = rng.standard_normal((2, *observation.q.shape)) * np.sqrt(0.5)
        noisy = observation.shifted(np.einsum("lij,lj->li", root, draw[0] + 1j * draw[1]))
        lines = assemble(noisy, M, scale, VISCOUS)
        found.append(ml.estimate(lines, EstimatorOptions()).parameters * units)
    assert np.std(found, axis=0) == pytest.approx(expected, rel=0.15)


def test_improvements_improve() -> None:
    found = expect(Plan(noise_m_s=2e-5))
    names = [option.name for option in found.options]
    assert names[0] == "as planned"
    planned = found.options[0].relative
    for option in found.options[1:]:
        assert np.all(option.relative <= planned * (1.0 + 1e-6)), option.name
    half = next(option for option in found.options if option.name.startswith("half"))
    assert half.relative == pytest.approx(planned / 2.0, rel=1e-3)
    twice = next(option for option in found.options if option.name.startswith("twice"))
    assert twice.relative == pytest.approx(planned / np.sqrt(2.0), rel=0.05)


def test_six_degrees_of_freedom_need_more_directions() -> None:
    _, stiffness, damping = six_dof_matrices()
    worst = []
    for directions in ("y", "yx", "yxz"):
        plan = Plan(DOF_NAMES, six_dof_mass(), stiffness, damping, directions=tuple(directions))
        worst.append(expect(plan).planned.identifiability.worst)
    assert worst[0] > 3.0 * worst[1] > 9.0 * worst[2]


def test_example_of_the_help_runs(tmp_path: Path, monkeypatch) -> None:
    assert PLAN_EXAMPLE in parser().format_help()
    path = write(tmp_path, PLAN_EXAMPLE)
    monkeypatch.chdir(tmp_path)
    _, outcome = work(["--plan", str(path)])
    content = json.loads((tmp_path / "plan.json").read_text(encoding="utf-8"))
    assert content["schema"] == "stapeskit.plan/1"
    assert content["options"][0]["name"] == "as planned"
    assert np.array(content["expected_stiffness_sd_si"]).shape == (3, 3)
    assert len(outcome.rows) <= 15
    html = (tmp_path / "plan.html").read_text(encoding="utf-8")
    for words in ("as planned", "one more run, rocked about x", "mass_uncertainty_not_given", "K, assumed"):
        assert words in html
    assert [file.name for file in outcome.files] == ["plan.json", "plan.html"]


def test_commented_keys_of_the_example_are_known(tmp_path: Path) -> None:
    """Every key that stands behind a comment sign is one, and its value is taken."""
    text = "\n".join(
        line.removeprefix("# ").removeprefix("#") if line.startswith("#") else line
        for line in PLAN_EXAMPLE.splitlines()
        if "mass.json" not in line
    )
    plan, _ = read_plan(write(tmp_path, text))
    assert len(plan.structure_mm) == 4
    assert plan.stiffness[0, 0] == 1722.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("dof = ", "valid TOML"),
        ("lnes = 3", "Did you mean lines"),
        ("lines = 1", "lines must be a whole number"),
        ("lines = 2.5", "lines must be a whole number"),
        ("band_hz = [5000, 400]", "low before high"),
        ("noise_m_s = 0", "noise_m_s must be a positive number"),
        ("noise_m_s = 1e-6\nnoise_relative = 0.1", "got both"),
        ("rocking = -1", "zero or positive"),
        ('directions = ["x"]', "out of the plan's dof"),
        ('directions = ["q"]', "directions must be different names out of the plan's dof"),
        ('directions = ["y", "y"]', "directions must be different names"),
        (
            'dof = ["y", "gamma", "alpha"]',
            'Write dof = \\["y", "alpha", "gamma"\\] and order the matrices so',
        ),
        ('dof = ["y"]', "mass must be given when dof"),
        ('dof = ["y"]\nmass = [[3e-6]]', "stiffness must be given when dof"),
        ('dof = ["y"]\nmass = [[-3e-6]]', "positive"),
        ("stiffness = [[1, 2], [3, 4]]", "a 3 x 3 matrix"),
        ("stiffness = [[1, 9, 0], [9, 1, 0], [0, 0, 1]]", "positive"),
        ('damping_law = "odd"', "viscous or hysteretic"),
        ("structure_points_mm = [[1, 2]]", "a list of points"),
        ("base_points_mm = [[0, 0, 0]]", "enough points"),
    ],
)
def test_faults_of_a_plan_are_one_sentence(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(FittingError, match=message):
        read_plan(write(tmp_path, text))


def test_all_faults_of_a_plan_stand_in_one_message(tmp_path: Path) -> None:
    text = 'directons = ["y"]\nband_hz = [9, 1]\nlines = -5\nnoise_m_s = 0\ndof = ["foo"]\n'
    with pytest.raises(FittingError) as fault:
        read_plan(write(tmp_path, text))
    told = str(fault.value)
    for words in ("Did you mean directions", "low before high", "lines must be", "noise_m_s must be", "foo"):
        assert words in told
    assert len(told.splitlines()) == 5


def test_faults_of_the_command(tmp_path: Path) -> None:
    with pytest.raises(StapeskitError, match="existing TOML file"):
        work(["--plan", str(tmp_path / "none.toml")])
    path = write(tmp_path, "lines = 50")
    with pytest.raises(StapeskitError, match="DOF must be left out beside --plan"):
        work(["dof.csv", "--plan", str(path)])
    with pytest.raises(StapeskitError, match=r"ends with \.json"):
        work(["--plan", str(path), "--out", "plan.txt"])
    with pytest.raises(StapeskitError, match="DOF"):
        work(["--mass", "M.csv"])
    with pytest.raises(StapeskitError, match="--mass"):
        work(["dof.csv"])
