"""Motion that a fitted subset neglects: how much of it enters, and whether it is there."""

from __future__ import annotations

import re

import numpy as np
import pytest

from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.fit.neglected_motion import leaks
from legacy.kinematics.fit.rigid_fit import fit_lines
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.kinematics.points2dof import points2dof
from tests.kinematics.simulated import readings, smooth_motion, stapes_points

PAPER_DOF = ("y", "alpha", "gamma")
FREQ = np.linspace(400.0, 5000.0, 60)


def told(beams, q, *, sd=1e-10, count=9, seed=1, dof=PAPER_DOF):
    """Warnings of a body read by the same beams at every point, and the fitted motion."""
    rng = np.random.default_rng(seed)
    beams = np.atleast_2d(beams)
    places = np.repeat(stapes_points(rng, count), len(beams), axis=0)
    directions = np.tile(beams, (count, 1))
    value = readings(places, directions, q)
    value = value + sd * (rng.normal(size=(*value.shape, 2)) @ [1.0, 1j])
    names = tuple(str(c // len(beams)) for c in range(len(places)))
    body = BodyChannels("stapes", names, places, directions, value[None], np.full((1, *value.shape), sd))
    result = points2dof(Measurement("footplate", ("1",), FREQ, (body,), 0), options=Options(dof))
    return [n.text for n in result.notices if n.code == "neglected_motion"], result.motion.q[0, 0]


def oblique(angle_deg, towards="x"):
    angle = np.radians(angle_deg)
    return [np.sin(angle) * (towards == "x"), np.cos(angle), np.sin(angle) * (towards == "z")]


@pytest.mark.parametrize("towards", ["x", "z"])
@pytest.mark.parametrize(("angle", "printed"), [(15.0, "5.4"), (30.0, "12"), (45.0, "20")])
def test_the_bias_of_one_oblique_beam_is_the_tangent(angle, printed, towards):
    q = np.zeros((60, 6), dtype=complex)
    q[:, 1], q[:, "xyz".index(towards)] = 1e-7, 2e-8
    (text,), fitted = told(oblique(angle, towards), q, sd=1e-13)
    assert f"the beams cannot tell {towards} from the fitted motion" in text
    assert f" {100.0 * np.tan(np.radians(angle)):.0f} % of it enters y" in text
    assert f"(if {towards} is a fifth of y, that is {printed} % of y)" in text
    assert np.allclose(fitted[:, 0] / 1e-7 - 1.0, 0.2 * np.tan(np.radians(angle)), rtol=1e-4)


def test_a_leak_is_what_the_fit_makes_of_one_unit_of_a_motion():
    rng = np.random.default_rng(7)
    places = np.repeat(stapes_points(rng, 9), 2, axis=0)
    beams = beam_set("stapes", places, np.tile([oblique(30.0), oblique(20.0, "z")], (9, 1)), PAPER_DOF)
    sd = np.repeat(np.geomspace(1e-11, 1e-9, 18)[:, None], 6, axis=1)
    fit = fit_lines(beams, beams.all_rows.astype(complex), sd)
    assert leaks(fit, sd[:, 0] ** -2.0) == pytest.approx(fit.q.T.real, rel=1e-9, abs=1e-9)


def test_a_rotation_that_enters_is_told_per_unit():
    q = smooth_motion(np.random.default_rng(3), FREQ)
    (text,), _ = told(oblique(30.0), q)
    slope = re.search(r"tell beta from .*?([\d.e-]+) (nm|urad|%)", text)
    assert slope is not None


@pytest.mark.parametrize("angle", [15.0, 30.0, 45.0])
def test_motion_that_further_beams_show_is_tested_and_estimated(angle):
    q = np.zeros((60, 6), dtype=complex)
    q[:, 1] = 1e-7 * np.exp(1j * FREQ / 2000.0)
    q[:, 0] = 2e-8
    beams = [oblique(angle), oblique(0.0)]
    (text,), fitted = told(beams, q, sd=2e-10)
    size, spread = map(float, re.search(r"x ([\d.]+) \+- ([\d.e-]+) nm rms", text).groups())
    assert abs(size - 20.0) < 4.0 * spread < 1.0
    entering = float(re.search(r"nm rms \(.*?([\d.]+) % of it enters y", text).group(1))
    expected = np.sqrt(np.mean(np.abs(fitted[:, 0] - q[:, 1]) ** 2)) / 2e-8
    assert entering == pytest.approx(100.0 * expected, rel=0.05)
    assert "the probability of these data is" in text


def test_oblique_beams_without_such_motion_raise_nothing():
    q = smooth_motion(np.random.default_rng(4), FREQ)
    q[:, [0, 2, 4]] = 0.0
    for seed in range(5):
        texts, _ = told([oblique(30.0), oblique(0.0), oblique(30.0, "z")], q, seed=seed)
        assert texts == []


def test_aligned_beams_raise_nothing_whatever_moves():
    for seed in range(10):
        texts, _ = told(oblique(0.0), smooth_motion(np.random.default_rng(seed), FREQ), seed=seed)
        assert texts == []
