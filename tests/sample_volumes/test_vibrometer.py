"""The simulated measurement obeys the equation of motion, in its own frame, and its files say so."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_STIFFNESS
from legacy.stapeskit.frames import RigidTransform
from sample_volumes.old_study import make_study
from sample_volumes.phantom import Ear, scene, truth
from sample_volumes.vibrometer import Vibrometry, base_motion, record, stapes_motion

EAR = Ear(voxel_mm=(0.1, 0.1, 0.1))


@pytest.fixture(scope="module")
def behind():
    return truth(scene(EAR))


def recorded(behind, how):
    pose = RigidTransform(np.array(behind["plate_from_footplate"]), "plate", "footplate").inverse()
    marks = [(name, np.array(place)) for name, place in behind["fiducials_in_plate_mm"].items()]
    return record(np.array(behind["mass_matrix_si"]), pose, how, marks)


def test_stapes_obeys_newton_in_all_ligament_directions(behind):
    mass = np.array(behind["mass_matrix_si"])
    freq_hz = np.linspace(400.0, 5000.0, 50)
    base = base_motion(freq_hz, "y")
    stapes = stapes_motion(freq_hz, base, mass, PAPER_STIFFNESS, PAPER_DAMPING_CORRECTED)
    w = 2.0 * np.pi * freq_hz
    moved = (stapes - base)[:, [1, 3, 5]]
    ligament = moved @ PAPER_STIFFNESS.T + 1j * w[:, None] * (moved @ PAPER_DAMPING_CORRECTED.T)
    inertia = w[:, None] ** 2 * (stapes @ mass.T)[:, [1, 3, 5]]
    assert np.abs(ligament - inertia).max() < 1e-12 * np.abs(ligament).max()
    assert np.abs((stapes - base)[:, [0, 2, 4]]).max() == 0.0


def test_stapes_lags_the_driving_bone_above_resonance(behind):
    freq_hz = np.array([400.0, 5000.0])
    base = base_motion(freq_hz, "y")
    mass = np.array(behind["mass_matrix_si"])
    ratio = stapes_motion(freq_hz, base, mass, PAPER_STIFFNESS, PAPER_DAMPING_CORRECTED)[:, 1] / base[:, 1]
    assert abs(ratio[0]) > 1.0
    assert np.all(np.angle(ratio) < 0.0)


def test_noise_free_channels_are_the_rigid_motion_of_their_points(behind):
    how = Vibrometry(noise_free=True, lines=5)
    seen = recorded(behind, how)
    body = np.array(seen.body)
    for name in ("stapes", "base"):
        here = body == name
        arms, beams = seen.position_mm[here] * 1e-3, seen.direction[here]
        rows = np.hstack([beams, np.cross(arms, beams)])
        _, residual, rank, _ = np.linalg.lstsq(rows, seen.velocity_m_s[0, here], rcond=None)
        assert rank == 6
        assert np.all(np.abs(residual) < 1e-24)


def test_noise_and_position_errors_have_their_stated_sizes(behind):
    how = Vibrometry(lines=400, seed=5)
    clean, noisy = (recorded(behind, replace(how, noise_free=flag)) for flag in (True, False))
    error = (noisy.velocity_m_s - clean.velocity_m_s) / noisy.sd_m_s[:, :, None]
    assert error.real.std() == pytest.approx(1.0, abs=0.01)
    assert error.imag.std() == pytest.approx(1.0, abs=0.01)


def test_mirrored_scanner_flips_positions_beams_and_fiducials(behind):
    plain = recorded(behind, Vibrometry(lines=3))
    flipped = recorded(behind, Vibrometry(lines=3, mirror="x"))
    np.testing.assert_array_equal(flipped.position_mm[:, 0], -plain.position_mm[:, 0])
    np.testing.assert_array_equal(flipped.direction[:, 1:], plain.direction[:, 1:])
    np.testing.assert_array_equal(flipped.velocity_m_s, plain.velocity_m_s)
    assert flipped.fiducials[0][1][0] == -plain.fiducials[0][1][0]


def test_study_files_are_complete_and_the_same_every_time(tmp_path):
    how = Vibrometry(lines=4, excitations=("y", "x"))
    for folder in ("a", "b"):
        make_study(tmp_path / folder, EAR, how, "test ear")
    names = ["fiducials.csv", "ldv.csv", "points.csv", "scan.tif", "study.toml", "truth.json"]
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == names
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    with (tmp_path / "a" / "ldv.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 2 * (10 + 9) * 3 * 4
    assert {row["run"] for row in rows} == {"y", "x"}
    behind = json.loads((tmp_path / "a" / "truth.json").read_text(encoding="utf-8"))
    assert behind["stiffness_si"][0][0] == 1722.0
    assert "SIMULATED" in (tmp_path / "a" / "study.toml").read_text(encoding="utf-8")
