"""x, y, z computed from three beams: their noise differs by axis and is estimated so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kinematics.fit.triads import triad_axes
from kinematics.measurement import from_arrays
from kinematics.points2dof import Options, points2dof
from kinematics.registration.lasers import LaserPriors
from tests.kinematics.simulated import scene as simulated
from tests.kinematics.simulated import three_beams

EXACT = Options(lasers=LaserPriors(0.0, 0.0, 0.0))


def triads(seed, cone_deg=15.0, lines=60):
    """Readings x, y, z of points, computed from three beams of equal noise on a cone around y."""
    made = simulated(seed, lines=lines, snr=np.inf)
    rng = np.random.default_rng(seed)
    beams = three_beams(cone_deg)
    places = made.positions_mm[::3]
    velocity = made.q[:, None, :3] + np.cross(made.q[:, None, 3:], places * 1e-3)
    read = velocity @ beams.T
    sd = 0.01 * np.sqrt(np.mean(np.abs(read) ** 2))
    read = read + sd * (rng.normal(size=(*read.shape, 2)) @ [1.0, 1j])
    axes = read @ np.linalg.inv(beams).T
    value = axes.transpose(1, 2, 0).reshape(-1, lines)
    body = {
        "points": made.points,
        "positions_mm": made.positions_mm,
        "directions": np.tile(np.eye(3), (len(places), 1)),
        "value": value,
    }
    found = from_arrays({"stapes": body}, made.freq_hz, order=0)
    return replace(found, bodies=(replace(found.bodies[0], computed_axes=True),)), made.q


def test_the_sd_of_every_motion_is_that_of_its_axes():
    ratio = []
    for seed in range(12):
        measurement, true = triads(seed)
        motion = points2dof(measurement, options=EXACT).motion
        sd = np.sqrt(0.5 * np.real(np.diagonal(motion.covariance[0, 0], axis1=1, axis2=2)))
        error = motion.q[0, 0] - true
        ratio.append(np.mean(np.abs(error) ** 2, axis=0) / np.mean(2.0 * sd**2, axis=0))
    spread = np.sqrt(np.mean(ratio, axis=0))
    assert spread == pytest.approx(np.ones(6), abs=0.25)


def test_single_beams_are_no_triads():
    measurement, _ = triads(1)
    body = measurement.bodies[0]
    assert triad_axes(body).tolist() == [0, 1, 2] * 9
    oblique = replace(body, reported_directions=np.tile(three_beams(), (9, 1)))
    assert triad_axes(oblique) is None
    few = replace(body, points=tuple(str(k) for k in range(27)))
    assert triad_axes(few) is None
