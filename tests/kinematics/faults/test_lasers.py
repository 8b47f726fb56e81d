"""Beams of one head converge to it; the information on their errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kinematics.faults.lasers import lasers_of
from kinematics.faults.nuisance import LaserError, Marginal, Nuisance
from kinematics.faults.packing import Source, initial
from kinematics.faults.state import State, model_of
from kinematics.fit.beams import beam_set
from kinematics.fit.rigid_fit import fit_lines
from stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import body, scene


def towards(heads_mm, points_mm):
    beams = heads_mm[None] - points_mm[:, None]
    return (beams / np.linalg.norm(beams, axis=2, keepdims=True)).reshape(-1, 3)


def test_channels_are_grouped_by_the_heads_that_they_point_to():
    heads = np.array([[60.0, 200.0, 0.0], [-40.0, 200.0, 50.0], [0.0, 180.0, -70.0]])
    points = np.random.default_rng(1).uniform(-5.0, 5.0, (6, 3))
    groups = lasers_of(towards(heads, points), range(18))
    assert groups == [list(range(head, 18, 3)) for head in range(3)]
    assert lasers_of(towards(heads, points), [1, 4, 6]) == [[1, 4], [6]]


def test_opposite_beams_are_two_lasers():
    beam = np.array([0.0, 0.6, 0.8])
    assert lasers_of(np.stack([beam, -beam, beam]), range(3)) == [[0, 2], [1]]


def test_the_information_on_lasers_is_right_where_points_have_noise_in_common():
    made = scene(31)
    beams = beam_set("stapes", made.positions_mm, made.directions, DOF_NAMES)
    some = body("stapes", made)
    fit = fit_lines(beams, made.value, made.sd)
    data = initial(Source.of(fit, some, made.freq_hz, True), some)
    points = np.array(made.points)
    correlation = np.where(points[:, None] == points, 0.4, 0.0) + 0.6 * np.eye(len(points))
    data = data.under(replace(data.assumed, correlation=correlation))
    nuisance = Nuisance.of(
        data,
        np.zeros(len(points)),
        [LaserError(tuple(own), 0.01, 0.01, 0.01) for own in lasers_of(made.directions, range(27))],
    )
    count = len(nuisance.sd)
    assert count == 9
    base, size = model_of(data), 0.1 * nuisance.sd

    def energy(*steps):
        x = sum(sign * size[k] * np.eye(count)[k] for k, sign in steps)
        return State.of(data, nuisance.applied(base, x, data)).energy

    hessian = np.zeros((count, count))
    for i in range(count):
        for j in range(i + 1):
            around = [a * b * energy((i, a), (j, b)) for a in (1, -1) for b in (1, -1)]
            hessian[i, j] = hessian[j, i] = sum(around) / (4.0 * size[i] * size[j])
    information = Marginal(State.of(data), nuisance).information
    np.testing.assert_allclose(0.5 * hessian, information, atol=0.02 * np.max(information))
