"""Expected standard deviations: against scatter, against more data, and faults of plan.toml."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from legacy.fitting.cli import parser, work
from legacy.fitting.errors import FittingError
from legacy.fitting.estimators import ml
from legacy.fitting.estimators.base import EstimatorOptions
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.damping import VISCOUS
from legacy.fitting.model.observation import observe
from legacy.fitting.model.point_layout import Layout
from legacy.fitting.model.scaled_lines import Scale, assemble
from legacy.fitting.options import KDOptions
from legacy.fitting.plan.plan import STATED_MASS, Plan, expect, planned_motion
from legacy.fitting.plan.plan_file import read_plan
from legacy.fitting.plan.plan_options import PLAN_EXAMPLE
from legacy.fitting.plan.planned_errors import PlannedErrors, shared_errors
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.spatial import DOF_NAMES
from tests.fitting.cases import DOF, M, six_dof_mass, six_dof_matrices

# Places of DOF among x, y, z, alpha, beta, gamma.
USED = [DOF_NAMES.index(name) for name in DOF]


def write(folder: Path, text: str) -> Path:
    path = folder / "plan.toml"
    path.write_text(text, encoding="utf-8")
    return path


def planned_fit(plan: Plan) -> KDFit:
    """The fit of a plan, without its improvements."""
    return fit_kd(planned_motion(plan), plan.mass, KDOptions(dof=plan.dof, bands=0, profile=False))


def test_expected_sd_is_the_scatter_of_fits() -> None:
    plan = Plan(noise_relative=0.05, lines=100)
    expected = np.sqrt(np.diag(planned_fit(plan).noise_covariance))
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
        plan = Plan(DOF_NAMES, six_dof_mass(), stiffness, damping, directions=tuple(directions), lines=40)
        worst.append(planned_fit(plan).identifiability.worst)
    assert worst[0] > 3.0 * worst[1] > 9.0 * worst[2]


def misread(q, points_mm, shift=0.0, turned=None, moved=0.0, laser=1.0):
    """Motion (lines, 3 or 6) that wrong points, frames and lasers, taken for right, make of a true one."""
    used = USED if q.shape[1] == len(USED) else range(6)
    turned = Rotation.identity() if turned is None else turned
    stated = 1e-3 * points_mm
    # the true point and beam behind what is stated in a frame that is shifted and turned
    seen = turned.inv().apply(stated + moved) + shift
    beams = turned.inv().as_matrix().T
    true = np.array([[*d, *np.cross(p, d)] for p in seen for d in beams])
    believed = np.array([[*d, *np.cross(p, d)] for p in stated for d in np.eye(3)])
    readings = (q @ true[:, used].T) * laser * np.ones(len(true))
    return (readings @ np.linalg.pinv(believed).T)[:, used]


def test_shared_errors_are_what_misread_points_frames_and_lasers_make() -> None:
    stated = PlannedErrors(0.03, 0.02, 0.1, 2.0, 0.5, 3.0)
    rng = np.random.default_rng(4)
    points = rng.normal(0.0, 1.0, (2, 4, 3))
    freq = np.array([400.0, 1000.0, 5000.0])
    size = np.array([1e-7] * 3 + [1e-4] * 3)
    q = size * (rng.standard_normal((1, 2, 3, 6, 2)) @ [1.0, 1.0j])
    omega = 2.0 * np.pi * freq[:, None]
    steps = {
        "registration": 1e-6,
        "position": 1e-6,
        "laser_gain": 1e-3,
        "laser_phase": 1e-3,
        "laser_delay": 1e-9,
    }
    found = shared_errors(stated, DOF_NAMES, tuple(map(Layout, points)), freq, q)
    assert len(found.names) == 15 + 3 * 2 * 4
    for name, slope, variance in zip(found.names, found.derivatives, np.diag(found.covariance), strict=True):
        kind, *place, axis = name.split(".")
        along = np.eye(3)["xyz".index(axis[-1])]

        def made(body: int, size: float, kind=kind, place=place, axis=axis, along=along) -> np.ndarray:
            if kind == "position":
                moved = np.zeros((4, 3))
                moved[int(place[1])] = size * along * (int(place[0]) == body)
                return misread(q[0, body], points[body], moved=moved)
            if axis.startswith("turn"):
                return misread(q[0, body], points[body], turned=Rotation.from_rotvec(size * along))
            if kind == "registration":  # a frame off by s has its points off by -s
                return misread(q[0, body], points[body], shift=-size * along)
            factor = {"gain": size, "phase": 1j * size, "delay": -1j * omega * size}[kind[6:]]
            return misread(q[0, body], points[body], laser=1.0 + factor * np.tile(along, 4))

        step = steps[kind]
        for body in range(2):
            change = (made(body, step) - made(body, -step)) / (2.0 * step)
            scale = np.abs(q[0, body]).max(axis=0) / np.sqrt(variance)
            assert np.abs((slope[0, body] - change) / scale).max() < 1e-6, name
    units = {"position": 3e-5, "registration": 2e-5, "laser_gain": 0.02, "laser_delay": 3e-6}
    for name, variance in zip(found.names, np.diag(found.covariance), strict=True):
        sd = units.get(name.split(".")[0], np.radians(0.5))
        assert np.sqrt(variance) == pytest.approx(np.radians(0.1) if "turn" in name else sd), name


def test_shared_errors_are_the_scatter_of_readings_with_such_errors() -> None:
    """Readings are made from wrong points, frames and lasers, and fitted as if all were right."""
    errors = PlannedErrors(0.05, 0.05, 0.5, 2.0, 0.5, 1.0, 0.0)
    plan = Plan(noise_m_s=2e-5, lines=40, errors=errors)
    fit = planned_fit(plan)
    expected = np.sqrt(np.diag(fit.covariance - fit.noise_covariance))
    motion, mass = planned_motion(plan), np.asarray(plan.mass)
    rng = np.random.default_rng(3)
    omega = 2.0 * np.pi * motion.freq_hz[:, None]
    found = []
    for _ in range(150):
        shift = rng.normal(0.0, 1e-3 * errors.registration_sd_mm, 3)
        turned = Rotation.from_rotvec(rng.normal(0.0, np.radians(errors.registration_sd_deg), 3))
        gain = 1.0 + rng.normal(0.0, 1e-2 * errors.gain_sd_percent, 3)
        phase = rng.normal(0.0, np.radians(errors.phase_sd_deg), 3)
        delay = rng.normal(0.0, 1e-6 * errors.delay_sd_us, 3)
        laser = gain * np.exp(1j * (phase - omega * delay))
        moved = motion.q[0].copy()
        for body, points_mm in enumerate((plan.structure_mm, plan.base_mm)):
            off = rng.normal(0.0, 1e-3 * errors.position_sd_mm, points_mm.shape)
            moved[body] = misread(
                motion.q[0, body], points_mm, shift, turned, off, np.tile(laser, len(points_mm))
            )
        wrong = replace(motion, q=moved[None], shared=None)
        observation = observe(wrong, DOF)
        scale = Scale.of(observation, mass)
        lines = assemble(observation, mass, scale, VISCOUS)
        units = scale.parameter_units(VISCOUS)
        found.append(ml.estimate(lines, EstimatorOptions()).parameters * units)
    assert np.std(found, axis=0) == pytest.approx(expected, rel=0.2)


def test_a_mass_error_scales_all_entries_and_no_frequency() -> None:
    exact = PlannedErrors(**{error.name: 0.0 for error in fields(PlannedErrors)})
    planned = expect(Plan(errors=replace(exact, mass_sd_percent=3.0), noise_m_s=2e-6)).planned
    stiffness, _ = planned.standard_deviation
    assert np.diag(stiffness) == pytest.approx(0.03 * np.diag(planned.fit.stiffness), rel=1e-3)
    assert STATED_MASS in planned.sources
    diagonal = [name[1] == name[2] for name in planned.fit.parameters]
    assert planned.relative_of_all[diagonal] == pytest.approx(0.03, rel=1e-2)
    assert {"K11", "D33"} <= set(replace(planned, mass_sd=0.11).weak_entries)
    assert replace(planned, mass_sd=0.09).weak_entries == ()
    assert planned.fit.derived.frequency_sd_hz.max() < 1.0


def test_halves_of_stated_errors_stand_among_the_changes() -> None:
    found = expect(Plan(noise_m_s=2e-6))
    names = [option.name for option in found.options]
    sources = {option.name: option.sources for option in found.options}
    assert "band up to 10000 Hz, same spacing" in names
    for name, source in (
        ("points known twice as well", "position"),
        ("registration twice as good", "registration"),
        ("lasers calibrated twice as well", "laser_gain"),
        ("density or mass known twice as well", STATED_MASS),
    ):
        assert np.diag(sources[name][source]) == pytest.approx(
            np.diag(sources["as planned"][source]) / 4.0, rel=1e-6
        )
    without = expect(Plan(errors=PlannedErrors(position_sd_mm=0.0)))
    assert "points known twice as well" not in [option.name for option in without.options]
    assert len(names) == len(without.options) + 1


def test_errors_of_lasers_are_those_of_points2dof() -> None:
    from legacy.kinematics.registration.laser_errors import LaserPriors

    defaults = {error.name: error.default for error in fields(PlannedErrors)}
    for name in ("gain_sd_percent", "phase_sd_deg", "delay_sd_us"):
        assert defaults[name] == getattr(LaserPriors(), name)


def test_example_of_the_help_runs(tmp_path: Path, monkeypatch) -> None:
    assert PLAN_EXAMPLE in parser().format_help()
    path = write(tmp_path, PLAN_EXAMPLE)
    monkeypatch.chdir(tmp_path)
    _, outcome = work(["--plan", str(path)])
    content = json.loads((tmp_path / "plan.json").read_text(encoding="utf-8"))
    assert content["schema"] == "stapeskit.plan/1"
    assert content["options"][0]["name"] == "as planned"
    assert np.array(content["expected_stiffness_sd_si"]).shape == (3, 3)
    assert len(outcome.rows) <= 20
    assert set(content["errors"]) == {error.name for error in fields(PlannedErrors)}
    assert set(content["budget"]) >= {"channel_noise", "position", "registration", "laser_gain", STATED_MASS}
    html = (tmp_path / "plan.html").read_text(encoding="utf-8")
    for words in ("as planned", "one more run, rocked about x", "What limits the entries", "K, assumed"):
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
        ("band_hz = [5000, 400]", "the lower first"),
        ("noise_m_s = 0", "noise_m_s must be a positive number"),
        ("noise_m_s = 1e-6\nnoise_relative = 0.1", "got both"),
        ("rocking = -1", "zero or positive"),
        ("gain_sd_percent = -1", "gain_sd_percent must be a number, zero or positive"),
        ('mass = "mass.json"\nmass_sd_percent = 1', "left out when a mass.json is given"),
        ("directions = []", "out of the plan's dof, y, alpha, gamma; got none"),
        ("band_hz = [0, 500]", "band_hz must be two frequencies above 0 Hz"),
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
        ('damping_law = "odd"', "one of viscous, hysteretic"),
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
    for words in ("Did you mean directions", "the lower first", "lines must be", "noise_m_s must be", "foo"):
        assert words in told
    assert len(told.splitlines()) == 5


def test_faults_of_the_command(tmp_path: Path) -> None:
    with pytest.raises(StapeskitError, match="existing TOML file"):
        work(["--plan", str(tmp_path / "none.toml")])
    path = write(tmp_path, "lines = 50")
    with pytest.raises(StapeskitError, match="DOF must be left out when --plan is given"):
        work(["dof.csv", "--plan", str(path)])
    with pytest.raises(StapeskitError, match=r"ends with \.json"):
        work(["--plan", str(path), "--out", "plan.txt"])
    with pytest.raises(StapeskitError, match="DOF"):
        work(["--mass", "M.csv"])
    with pytest.raises(StapeskitError, match="--mass"):
        work(["dof.csv"])
