"""Errors that all lines share: derivatives against perturbed fits, maps, patterns, lasers, calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kinematics.fit.beams import beam_set
from kinematics.fit.rigid_fit import fit_lines
from kinematics.joint.expected import lasers_of, stated_errors
from kinematics.joint.tangents import BEAM_U, DELAY, GAIN, PHASE, SHIFT, TURN, Geometry, Parameters
from kinematics.measurement import BodyChannels, Measurement
from kinematics.place import shared_errors as shared
from kinematics.place.errors import estimate_errors
from kinematics.place.placement import Placement
from simulate import Experiment, MeasurementFault, measure_motion, resonant_motion, scattered_points
from stapeskit.spatial import DOF_NAMES, point_rows
from tests.motion_command.ears import error_in_sd, measured, rewrite, simulated

SUBSET = ("y", "alpha", "gamma")


def measurement(seed=0, points=6, lines=20, position_sd=1e-5) -> Measurement:
    """Return one body, exact values, three lasers."""
    rng = np.random.default_rng(seed)
    experiment = Experiment(lines=lines, in_footplate=True, exact=True, position_sd_mm=0.0, seed=seed)
    motion = resonant_motion(rng, experiment.freq_hz)[None]
    told = measure_motion({"stapes": motion}, {"stapes": scattered_points(rng, points)}, experiment)
    parts = {
        "points": tuple(told.point),
        "positions_m": 1e-3 * told.position_mm,
        "directions": told.direction,
        "value": told.velocity_m_s,
        "sd": np.full(told.velocity_m_s.shape, 1e-6)
        * np.random.default_rng(seed + 1).uniform(0.5, 2.0, (1, len(told.point), 1)),
        "position_sd_m": np.full(len(told.point), position_sd),
    }
    return Measurement("footplate", ("1",), told.freq_hz, (BodyChannels("stapes", **parts),))


def fitted(placed: Measurement, dof=DOF_NAMES):
    body = placed.bodies[0]
    beams = beam_set(body.body, body.arms_m, body.directions, dof)
    return {(0, 0): fit_lines(beams, body.value[0], body.sd[0], placed.per_displacement)}


def with_error(placed: Measurement, mask, tangent, size):
    """Return the measurement that is assumed when a parameter of it has an error."""
    body = placed.bodies[0]
    geometry = Geometry(body.arms_m, body.directions, np.ones((1, len(body.points)), dtype=complex))
    parameters = Parameters(np.asarray(mask, dtype=float)[None], np.array([tangent]), np.array([np.inf]))
    omega = 2.0 * np.pi * placed.freq_hz
    moved = geometry.moved(parameters, np.array([size]), np.zeros(len(omega)), omega)
    changed = replace(
        body, positions_m=moved.positions_m, directions=moved.directions, value=body.value / moved.factor.T
    )
    return replace(placed, bodies=(changed,))


@pytest.mark.parametrize("dof", [DOF_NAMES, SUBSET])
@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("tangent", [GAIN, PHASE, DELAY, BEAM_U, SHIFT[1], TURN[2]])
def test_derivatives_are_those_of_perturbed_fits(tangent, missing, dof):
    placed = measurement()
    if missing:
        value = placed.bodies[0].value.copy()
        value[:, 3, 4:9] = np.nan
        placed = replace(placed, bodies=(replace(placed.bodies[0], value=value),))
    if dof != DOF_NAMES:  # what a subset cannot fit must not be there
        body = placed.bodies[0]
        rows = point_rows(body.arms_m, body.directions)[:, [1, 3, 5]]
        q = np.linalg.lstsq(rows, np.nan_to_num(body.value[0]), rcond=None)[0]
        value = np.where(np.isnan(body.value[0]), np.nan, rows @ q)[None]
        placed = replace(placed, bodies=(replace(body, value=value),))
    own = [0, 3, 6]
    mask = np.isin(np.arange(len(placed.bodies[0].points)), own)
    step = 1e-7 if tangent != DELAY else 1e-10
    plus, minus = (fitted(with_error(placed, mask, tangent, sign * step), dof)[0, 0].q for sign in (1, -1))
    rows = shared.tangent_rows(placed.bodies[0], own, tangent)
    moved, _ = shared.sensitivity(fitted(placed, dof)[0, 0], rows[None])
    if tangent == DELAY:
        moved = moved * (2j * np.pi * placed.freq_hz)[:, None]
    slope = (plus - minus) / (2.0 * step)
    scale = np.max(np.abs(slope), axis=0)
    assert np.max(np.abs(moved[0] - slope) / scale) < 2e-4


def as_stated(placed):
    return estimate_errors(placed, stated_errors(placed.bodies, {}), {})


def test_maps_make_the_derivatives():
    placed = measurement()
    fits = fitted(placed)
    found = shared.shared_errors(placed, fits, Placement(transform_to_itself()), as_stated(placed))
    assert found.names[:2] == ("position.stapes.1.x", "position.stapes.1.y")
    made = np.einsum("pbij,rblj->prbli", found.maps, fits[0, 0].q[None, None])
    scale = np.max(np.abs(found.derivatives), axis=(1, 2, 3, 4), keepdims=True)
    assert np.max(np.abs(made - found.derivatives) / scale) < 1e-9


def transform_to_itself():
    from stapeskit.frames import RigidTransform

    return RigidTransform.identity("footplate", "footplate")


def test_patterns_of_many_points_have_the_effect_of_all_of_them(monkeypatch):
    placed = measurement(points=30)
    fits, pose = fitted(placed), Placement(transform_to_itself())
    named = shared.shared_errors(placed, fits, pose, as_stated(placed))
    monkeypatch.setattr(shared, "_MOST_BYTES", 0)
    patterns = shared.shared_errors(placed, fits, pose, as_stated(placed))
    assert len(patterns.names) <= 18 < len(named.names)

    def covariance(found):
        flat = found.derivatives.reshape(len(found.names), -1)
        return flat.conj().T @ found.covariance @ flat

    whole, few = covariance(named), covariance(patterns)
    assert np.max(np.abs(whole - few)) / np.max(np.abs(whole)) < 1e-3


def off_lasers(folder, gain, phase_deg=0.0, bodies=("stapes", "base")):
    """Multiply what one laser reads of bodies."""
    import pandas as pd

    table = pd.read_csv(folder / "ldv.csv")
    beam = table[["dir_x", "dir_y", "dir_z"]].round(6).apply(tuple, axis=1)
    own = (beam == beam.iloc[0]) & table.body.isin(bodies)
    value = (table.re_m_s + 1j * table.im_m_s) * np.where(
        own, (1 + gain) * np.exp(1j * np.deg2rad(phase_deg)), 1.0
    )
    table["re_m_s"], table["im_m_s"] = value.to_numpy().real, value.to_numpy().imag
    table.to_csv(folder / "ldv.csv", index=False)
    return beam.iloc[0]


def test_errors_of_a_laser_are_estimated_and_the_motion_is_corrected(tmp_path):
    truth = simulated(tmp_path, in_footplate=True, seed=7, noise=0.0005, position_sd_mm=0.0)
    beam = off_lasers(tmp_path, 0.015, 0.8)
    result = measured(tmp_path)
    lasers = result.errors.shown
    groups, beams = lasers_of(result.measurement.bodies)
    count = len(beams)
    every = np.concatenate([body.directions for body in result.measurement.bodies])
    own = int(np.argmin([np.linalg.norm(every[group[0]] - beam) for group in groups]))
    mean_free = np.eye(count) - 1.0 / count
    gain, phase = (mean_free @ part for part in lasers.values.reshape(3, count)[:2])
    assert gain[own] == pytest.approx(0.015 * (1.0 - 1.0 / count), abs=4.0 * lasers.sd[own])
    assert gain[own] > 2.0 * np.max(np.delete(gain, own))
    assert phase[own] > np.max(np.delete(phase, own))
    plain = measured(tmp_path, gain_sd=0)
    assert plain.errors is None
    true = np.stack([truth.motion_m[body] for body in result.motion.bodies], axis=1)
    left, before = (np.sum(np.abs((r.motion.q - true)[..., 3:]) ** 2) for r in (result, plain))
    assert left < 0.7 * before
    assert np.max(np.abs(error_in_sd(result, truth))) < 6.0


def test_a_laser_that_is_corrected_is_not_corrected_once_more(tmp_path):
    late = MeasurementFault(kind="laser_delay", size=2e-5)
    truth = simulated(tmp_path, seed=33, lines=72, in_footplate=True, faults=(late,))
    result = measured(tmp_path, correct=True)
    assert {notice.code for notice in result.notices} == {"channel_gain", "corrected"}
    assert np.sqrt(np.mean(error_in_sd(result, truth) ** 2)) < 1.3


def test_lasers_are_compared_by_the_noise_that_there_is(tmp_path):
    simulated(tmp_path, seed=22, in_footplate=True)

    def shrink(table):
        table["sd_m_s"] *= 0.1

    rewrite(tmp_path / "ldv.csv", shrink)
    assert {notice.code for notice in measured(tmp_path).notices} == {"noise_level"}


def test_lasers_that_agree_as_stated_raise_no_alarm(tmp_path):
    chances = []
    for seed in range(10):
        folder = tmp_path / str(seed)
        simulated(folder, in_footplate=True, seed=seed, lines=16)
        off_lasers(folder, float(0.01 * np.random.default_rng(seed).normal()))
        chances.append(measured(folder).errors.shown.p_value)
    assert min(chances) > 1e-3
    assert max(chances) > 0.3


@pytest.mark.parametrize("own", [False, True])
def test_a_fault_of_a_laser_is_corrected_on_every_body_that_it_measures(own, tmp_path):
    """The noisy base does not show 6 % of gain; where its values exclude the fault, it is the stapes' own."""
    truth = simulated(tmp_path, seed=41, lines=80, in_footplate=True, noise=0.003)
    off_lasers(tmp_path, 0.06, bodies=("stapes",) if own else ("stapes", "base"))

    def blur(table):
        rows = np.flatnonzero(table.body == "base")
        size = 40.0 * table.sd_m_s[rows].to_numpy()
        for part, noise in zip(
            ("re_m_s", "im_m_s"), np.random.default_rng(3).normal(size=(2, len(rows))), strict=True
        ):
            table.loc[rows, part] += size * noise
        table.loc[rows, "sd_m_s"] = size

    if not own:
        rewrite(tmp_path / "ldv.csv", blur)
    result = measured(tmp_path, correct=True)
    texts = [notice.text for notice in result.notices if notice.code == "corrected"]
    assert sum("as body stapes shows" in text for text in texts) == (not own)
    shared = result.motion.shared
    place = next(k for k, name in enumerate(shared.names) if name.startswith("correction."))
    assert np.any(shared.derivatives[place, :, 1]) == (not own)
    assert np.sqrt(np.mean(error_in_sd(result, truth) ** 2)) < 1.3
