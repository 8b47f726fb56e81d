"""Errors common to all lines: derivatives exact, propagation coherent; ratios with their covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.fit.frf_ratio import per_reference
from legacy.kinematics.fit.rigid_fit import fit_lines
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import Measurement
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.registration.fiducials import Fiducials
from legacy.kinematics.registration.laser_errors import LaserPriors
from legacy.kinematics.registration.placement import Placement, place
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector
from legacy.stapeskit.records.motion import RigidMotion
from legacy.stapeskit.records.motion_files import line_covariance
from legacy.stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import body, scene

POSE = RigidTransform.from_parts(
    rotation_from_vector([0.4, -0.9, 1.6]), [4.0, -7.0, 60.0], "footplate", "vibrometer"
)
MARKS = np.array([[-8.0, -1, -6], [8, -1, -6], [8, -1, 6], [-8, -1, 6], [0, 3, 0]])
EXACT = LaserPriors(0.0, 0.0, 0.0)
SUBSETS = [DOF_NAMES, ("y", "alpha", "gamma")]


def seen_by_vibrometer(*bodies, freq_hz):
    """The scene, given in the footplate frame, in vibrometer coordinates."""
    data = Measurement("footplate", ("1",), freq_hz, tuple(bodies), 0)
    return data.mapped(POSE.inverse())


def uneven(seed=3, lines=2):
    """Two bodies with noise that differs between channels and lines, and a hole."""
    rng = np.random.default_rng(seed)
    parts = []
    for number, name in enumerate(("stapes", "base")):
        made = scene(seed + number, lines=lines)
        made.sd = made.sd * 10.0 ** rng.uniform(-0.5, 0.5, made.sd.shape)
        made.value[4 + number, 1] = np.nan
        parts.append(body(name, made, 0.05 if name == "stapes" else np.nan))
    return seen_by_vibrometer(*parts, freq_hz=made.freq_hz)


@pytest.mark.parametrize("dof", SUBSETS)
@pytest.mark.parametrize("reference", ["", "base:y"])
def test_pose_derivatives_are_finite_differences_of_the_whole_fit(dof, reference):
    data = uneven()
    names = tuple(f"registration.{name}" for name in ("x", "y", "z", "alpha", "beta", "gamma"))
    placement = Placement(POSE, names, np.eye(6), np.eye(6))
    options = Options(dof, reference, lasers=EXACT)
    shared = points2dof(data, placement, options).motion.shared
    assert shared.names[:6] == names
    expected = []
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        plus, minus = (
            points2dof(data, replace(placement, transform=POSE.perturbed(sign * step)), options).motion.q
            for sign in (1.0, -1.0)
        )
        expected.append((plus - minus) / 2e-6)
    size = np.max(np.abs(expected), axis=(1, 3), keepdims=True)[:, :, :, None][:, :, :, 0]
    length = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])[:, None, None, None, None]
    size = np.max(size * length, axis=0, keepdims=True) / length
    assert np.all(np.abs(shared.derivatives[:6] - expected) < 1e-6 * size + 1e-18)


def test_position_derivatives_are_finite_differences_of_the_whole_fit():
    data = uneven()
    placement = Placement(POSE)
    shared = points2dof(data, placement, Options(lasers=EXACT)).motion.shared
    assert shared.names[0] == "position.stapes.1.x"
    assert len(shared.names) == 27
    assert np.allclose(np.diag(shared.covariance), (0.05e-3) ** 2)
    stapes = data.bodies[0]
    mine = np.array([name == "3" for name in stapes.points])
    for axis in range(3):
        moved = []
        for sign in (1.0, -1.0):
            places = stapes.positions_mm.copy()
            places[mine] += sign * 1e-4 * POSE.rotation[axis]
            changed = replace(data, bodies=(replace(stapes, positions_mm=places), data.bodies[1]))
            moved.append(points2dof(changed, placement, Options(lasers=EXACT)).motion.q)
        expected = (moved[0] - moved[1]) / 2e-7
        found = shared.derivatives[shared.names.index(f"position.stapes.3.{'xyz'[axis]}")]
        assert np.nanmax(np.abs(found - expected)) < 1e-6 * np.nanmax(np.abs(expected))
        assert np.nanmax(np.abs(found[:, 1])) == 0.0


def test_registration_errors_propagate_coherently():
    """Refit the fiducials many times: q scatters together at all lines, as derivatives and covariance say."""
    rng = np.random.default_rng(8)
    made = scene(5, lines=6, snr=np.inf)
    made.sd = np.full(made.sd.shape, 1e-10)
    data = seen_by_vibrometer(body("stapes", made), freq_hz=made.freq_hz)
    seen = POSE.inverse().points(MARKS)
    fiducials = Fiducials(tuple("abcde"), seen, MARKS, ("footplate",) * 5, np.full(5, 0.03))
    exact = points2dof(data, place(fiducials), Options(lasers=EXACT)).motion
    samples = []
    for _ in range(1000):
        noisy = replace(fiducials, vibrometer_mm=seen + 0.03 * rng.normal(size=seen.shape))
        placed = data.mapped(place(noisy).transform).bodies[0]
        beams = beam_set("stapes", placed.positions_mm, placed.directions, DOF_NAMES)
        samples.append(fit_lines(beams, placed.displacement[0], placed.sd[0]).q - exact.q[0, 0])
    flat = np.array(samples).reshape(1000, -1)
    derivatives = exact.shared.derivatives[:, 0, 0].reshape(6, -1)
    stacked = np.concatenate([derivatives.real, derivatives.imag], axis=1)
    expected = stacked.T @ exact.shared.covariance @ stacked
    parts = np.concatenate([flat.real, flat.imag], axis=1)
    sd = np.sqrt(np.diag(expected))
    assert np.all(np.abs(parts.std(axis=0) / sd - 1.0) < 0.1)
    found = np.corrcoef(parts.T)
    assert np.max(np.abs(found - expected / np.outer(sd, sd))) < 0.15


def test_ratio_has_the_covariance_of_a_ratio():
    rng = np.random.default_rng(3)
    count = 1200
    bodies = []
    for seed, name in ((1, "stapes"), (2, "base")):
        made = scene(seed, lines=2, snr=60.0)
        made.freq_hz = np.linspace(500.0, 600.0, count)
        made.value, made.sd = (np.repeat(part[:, :1], count, axis=1) for part in (made.value, made.sd))
        made.value = made.value + made.sd * (rng.normal(size=(*made.value.shape, 2)) @ [1.0, 1j])
        bodies.append(body(name, made))
    data = Measurement("footplate", ("1",), made.freq_hz, tuple(bodies), 0)
    first = points2dof(data, options=Options(reference="base:y")).motion
    assert first.reference == "base:y"
    assert first.covariance.shape == (1, count, 12, 12)
    samples = first.q[0].transpose(1, 0, 2).reshape(count, 12)
    error = samples - samples.mean(axis=0)
    found = error.T @ error.conj() / count
    claimed = first.covariance[0].mean(axis=0)
    live = [k for k in range(12) if k != 7]
    sd = np.sqrt(np.real(np.diag(claimed)))[live]
    assert np.all(np.abs(np.sqrt(np.real(np.diag(found)))[live] / sd - 1.0) < 0.08)
    pick = np.ix_(live, live)
    assert np.max(np.abs(found[pick] - claimed[pick]) / np.outer(sd, sd)) < 0.12
    assert samples[:, 7] == pytest.approx(1.0, abs=1e-12)
    assert claimed[7, 7] == pytest.approx(0.0, abs=1e-18)
    assert line_covariance(first).shape == (1, 2, count, 6, 6)
    assert first.pair(0, 0, 1)[1].shape == (count, 12, 12)


@pytest.mark.parametrize("text", ["base", "bone:y", "base:q", "base:x"])
def test_impossible_references_are_refused(text):
    made = scene(1, lines=3)
    data = Measurement("footplate", ("1",), made.freq_hz, (body("base", made),), 0)
    with pytest.raises(StapeskitError, match="--reference must be BODY:DOF"):
        points2dof(data, options=Options(("y", "alpha", "gamma"), text))


@pytest.mark.parametrize(
    ("snr", "low", "high"), [(100.0, 0.94, 0.96), (10.0, 0.94, 0.965), (4.0, 0.93, 0.99)]
)
@pytest.mark.parametrize("size", [0.2, 1.0, 5.0])
def test_intervals_of_ratios_hold_with_a_noisy_reference(snr, low, high, size):
    rng = np.random.default_rng(8)
    lines = 6000
    noise = rng.normal(size=(2, lines, 2)) @ [1.0, 1j] / snr
    q = (np.array([1.0, size])[:, None] + noise)[None, :, :, None]
    covariance = np.full((1, 2, lines, 1, 1), 2.0 / snr**2, dtype=complex)
    blank = np.ones((1, 2, lines))
    freq = 100.0 + np.arange(lines)
    motion = RigidMotion(("1",), ("base", "stapes"), ("y",), freq, q, covariance, blank, blank)
    made = per_reference(motion, "base:y")
    error = made.q[0, 1, :, 0] - size
    sd = np.sqrt(made.covariance[0, :, 1, 1].real / 2.0)
    inside = np.mean([np.abs(error.real) < 1.96 * sd, np.abs(error.imag) < 1.96 * sd])
    assert low < inside < high
    assert np.max(np.abs(made.covariance[0, :, 0, :])) < 1e-12


def test_lines_where_the_reference_passes_through_zero_are_named():
    freq = np.arange(100.0, 200.0)
    base = (freq - 150.0) * (freq - 120.3)
    q = np.stack([base, np.ones(100)])[None, :, :, None].astype(complex)
    blank = np.ones((1, 2, 100))
    covariance = np.full((1, 2, 100, 1, 1), 2.0 * 4.0**2, dtype=complex)
    motion = RigidMotion(("1",), ("base", "stapes"), ("y",), freq, q, covariance, blank, blank)
    (notice,) = per_reference(motion, "base:y").notices
    assert "at 5 of 100 lines, 120 to 121 Hz, 149 to 151 Hz;" in notice.text


def test_a_run_without_the_reference_is_named():
    freq = np.arange(100.0, 110.0)
    q = np.ones((2, 2, 10, 1), dtype=complex)
    q[1, 0] = np.nan
    blank, covariance = np.ones((2, 2, 10)), np.full((2, 2, 10, 1, 1), 1e-6, dtype=complex)
    motion = RigidMotion(("push", "pull"), ("base", "stapes"), ("y",), freq, q, covariance, blank, blank)
    (notice,) = per_reference(motion, "base:y").notices
    assert notice.code == "reference_missing"
    assert "at 10 of 20 lines" in notice.text
    assert "100 to 109 Hz in run pull" in notice.text


def test_a_noisy_reference_is_told():
    made = scene(1, lines=10, snr=0.5)
    data = Measurement("footplate", ("1",), made.freq_hz, (body("base", made),), 0)
    codes = [notice.code for notice in points2dof(data, options=Options(reference="base:y")).notices]
    assert "reference_noisy" in codes
