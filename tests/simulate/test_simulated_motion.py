"""Simulated measurements: equation of motion, rigid readings, noise as stated, faults, gaps and series."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import simulate
from simulate import KINDS, LAWS, Ear, Experiment, Ligament, MeasurementFault, Ring, Scan
from stapeskit.frames import cross_matrix
from stapeskit.spatial import DOF_NAMES, dof_indices, twist_transfer

QUICK = Experiment(lines=24, exact=True)


@pytest.fixture(scope="module")
def truth():
    return simulate.simulate_truth(Ear(ligament=simulate.ring_ligament()), Scan(voxel_um=60.0))


def record(truth, **options):
    return simulate.simulate_recording(truth, replace(QUICK, **options))


def reaction(freq_hz, motion, base, mass_si, ligament):
    """Return what is left (L, n) of the equation of motion in the degrees of freedom of the ligament, SI."""
    r = dof_indices(ligament.dof)
    pull = np.einsum("lij,lj->li", ligament.dynamic_stiffness(freq_hz), motion[:, r] - base[:, r])
    return (2.0 * np.pi * freq_hz)[:, None] ** 2 * (motion @ mass_si[r].T) - pull


@pytest.mark.parametrize("law", LAWS)
def test_motion_satisfies_the_equation_of_motion(law):
    piston, full = Ligament(), simulate.ring_ligament()
    for ligament in (simulate.damped_alike(piston, law), simulate.damped_alike(full, law)):
        ligament = replace(ligament, fluid_mass_kg=2e-7)
        ear = Ear(ligament=ligament)
        motion = record(simulate.simulate_truth(ear)).motion_m
        freq, mass = QUICK.freq_hz, ear.moving_mass_si()
        left = reaction(freq, motion["stapes"][0], motion["base"][0], mass, ligament)
        load = (2.0 * np.pi * freq)[:, None] ** 2 * np.abs(motion["stapes"][0] @ mass.T)
        used = [DOF_NAMES.index(name) for name in ligament.dof]
        assert np.abs(left / load[:, used].max(axis=0)).max() < 1e-12
        free = [place for place in range(6) if place not in used]
        assert np.array_equal(motion["stapes"][..., free], motion["base"][..., free])


def test_single_degree_of_freedom_has_the_closed_form():
    ligament = Ligament(stiffness_si=np.array([[1700.0]]), damping_si=np.array([[0.02]]), dof=("y",))
    mass, freq = np.diag([3e-6, 3e-6, 3e-6, 1e-11, 1e-11, 1e-11]), np.linspace(100.0, 6000.0, 30)
    base = np.zeros((30, 6), dtype=complex)
    base[:, 1] = 1e-7
    motion = simulate.stapes_motion(freq, base, mass, ligament)[:, 1]
    w = 2.0 * np.pi * freq
    dynamic = 1700.0 + 0.02j * w
    assert motion == pytest.approx(1e-7 * dynamic / (dynamic - 3e-6 * w**2), rel=1e-13)


def test_laws_damp_alike_at_one_frequency():
    size = {
        law: abs(
            (simulate.damped_alike(Ligament(), law).damping_factor(np.array([2.0 * np.pi * 2200.0]))[0])
            * simulate.damped_alike(Ligament(), law).damping_si[0, 0]
        )
        for law in ("viscous", "hysteretic", "fractional")
    }
    assert size["hysteretic"] == pytest.approx(size["viscous"], rel=1e-12)
    assert size["fractional"] == pytest.approx(size["viscous"], rel=1e-12)


def test_ring_has_closed_form_and_moves_with_its_plane():
    ring = Ring(centre_mm=(0.0, 0.0, 0.0), half_axes_mm=(1.0, 1.0), pieces=720)
    matrix = ring.matrix(3.0, 2.0, 5.0)
    around = 2.0 * np.pi * 1e-3  # length of the rim, m
    assert np.diag(matrix)[:3] == pytest.approx([around * 2.5, around * 5.0, around * 2.5], rel=1e-5)
    assert np.diag(matrix)[3:] == pytest.approx(
        [around * 1e-6 * 2.5, around * 1e-6 * 2.0, around * 1e-6 * 2.5], rel=1e-5
    )
    assert np.abs(matrix - np.diag(np.diag(matrix))).max() < 1e-9
    shift = np.array([-0.2, 0.1, 0.05])
    moved = replace(ring, centre_mm=tuple(shift)).matrix(3.0, 2.0, 5.0)
    transfer = np.linalg.inv(twist_transfer(np.eye(3), -shift * 1e-3))
    assert moved == pytest.approx(transfer.T @ matrix @ transfer, rel=1e-9, abs=1e-15)
    drawn = simulate.ring_ligament(simulate.draw_ring(np.random.default_rng(2)), law="hysteretic")
    assert drawn.law == "hysteretic"
    assert np.linalg.eigvalsh(drawn.stiffness_si)[0] > 0.0


def test_readings_are_those_of_rigid_bodies(truth):
    recording = record(truth)
    pose = recording.vibrometer_from_footplate.inverse()
    for channel in (0, 17, 40):
        q = recording.motion_m[recording.body[channel]][0]
        arm = pose.points(recording.position_mm[channel]) * 1e-3
        beam = pose.vectors(recording.direction[channel])
        moved = q[:, :3] - q[:, 3:] @ cross_matrix(arm).T
        expected = 2j * np.pi * recording.freq_hz * (moved @ beam)
        assert recording.velocity_m_s[0, channel] == pytest.approx(expected, rel=1e-10, abs=1e-18)


def test_exact_motion_is_found_by_least_squares(truth):
    for options in ({}, {"in_footplate": True}, {"head_distance_mm": 120.0}, {"missing": 0.1}):
        motion = simulate.motion_of(record(truth, **options))
        for place, body in enumerate(motion.bodies):
            size = np.abs(motion.q[0, place]).max(axis=0)
            exact = record(truth, **options).motion_m[body][0]
            assert np.abs((motion.q[0, place] - exact) / size).max() < 1e-10


def test_noise_has_the_stated_covariance(truth):
    experiment = Experiment(lines=200, position_sd_mm=0.0)
    recording = simulate.simulate_recording(truth, experiment)
    motion = simulate.motion_of(recording)
    error = np.stack([motion.q[0, k] - recording.motion_m[body][0] for k, body in enumerate(motion.bodies)])
    square = np.einsum("bli,blij,blj->bl", error.conj(), np.linalg.inv(motion.covariance[0]), error).real
    # 2 q^H C^-1 q is chi-square with 12 degrees of freedom.
    assert chi2.cdf(2.0 * square.sum(), 12 * square.size) == pytest.approx(0.5, abs=0.4999)
    low, high = chi2.ppf([0.0005, 0.9995], motion.n_dof.sum())
    assert low < motion.chi2.sum() < high


def test_shared_errors_explain_wrong_positions_and_pose(truth):
    recording = record(truth, exact=False, noise=1e-6, position_sd_mm=0.02)
    motion = simulate.motion_of(recording, registration_sd=(2e-5, 3e-3))
    assert len(motion.shared.names) == 3 * 19 + 6
    error = np.stack(
        [motion.q[:, k] - recording.motion_m[body] for k, body in enumerate(motion.bodies)], axis=1
    )
    slopes = motion.shared.derivatives.reshape(len(motion.shared.names), -1)
    scale = np.repeat(np.abs(motion.q).max(axis=(0, 2)), 24, axis=0).ravel()
    share = slopes * np.sqrt(np.diag(motion.shared.covariance))[:, None] / scale
    both = np.concatenate([share.real, share.imag], axis=1)
    wrong = np.concatenate([(error.ravel() / scale).real, (error.ravel() / scale).imag])
    size, *_ = np.linalg.lstsq(both.T, wrong, rcond=1e-9)
    assert np.linalg.norm(wrong - both.T @ size) < 0.03 * np.linalg.norm(wrong)
    derivative = motion.shared.maps[-1, 0] @ motion.q[0, 0].T
    assert pytest.approx(motion.shared.derivatives[-1, 0, 0], rel=1e-9) == derivative.T


@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_changes_its_culprits_only(truth, kind):
    plain, faulty = record(truth), record(truth, faults=(MeasurementFault(kind=kind),))
    assert np.array_equal(plain.position_mm, faulty.position_mm)
    assert np.array_equal(plain.direction, faulty.direction)
    change = np.abs(faulty.velocity_m_s - plain.velocity_m_s) > 1e-12 * np.abs(plain.velocity_m_s).max()
    changed = set(np.flatnonzero(np.any(change, axis=(0, 2))).tolist())
    assert changed <= set(faulty.culprits)
    assert faulty.culprits
    assert changed or kind == "noise"


def test_factors_are_as_large_as_they_say(truth):
    plain, freq = record(truth), QUICK.freq_hz
    for kind, size, factor in (
        ("gain", 0.07, 1.07),
        ("phase", 4.0, np.exp(1j * np.radians(4.0))),
        ("delay", 2e-5, np.exp(-2j * np.pi * freq * 2e-5)),
        ("sign", None, -1.0),
        ("zeros", None, 0.0),
        ("drift", 0.1, 1.0 + 0.1 * np.linspace(0.0, 1.0, 24)),
    ):
        for prefix in ("", "point_", "laser_", "body_"):
            fault = MeasurementFault(kind=prefix + kind, size=size, point="3", laser=1)
            faulty = record(truth, faults=(fault,))
            hit = sorted(faulty.culprits)
            assert np.allclose(faulty.velocity_m_s[:, hit], plain.velocity_m_s[:, hit] * factor, rtol=1e-12)
