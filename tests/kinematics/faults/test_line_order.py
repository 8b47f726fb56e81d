"""Lines of one body sorted as text: named, put in order on request, never said of clean files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.kinematics.faults.judges.line_order import (
    Reordered,
    put_in_order,
    rate_ratio,
    reordered_bodies,
)
from legacy.kinematics.faults.proposals.line_orders import sorted_as_text
from legacy.kinematics.fit_options import Options
from legacy.kinematics.points2dof import points2dof
from tests.kinematics.faults.test_phase_convention import moved
from tests.kinematics.ligament import study, with_lines

FREQ = np.linspace(200.0, 6000.0, 117)


def spoiled(data, number):
    """Return readings in the order of numbers beside a column of frequencies in that of text."""
    order = np.array(sorted(range(len(data.freq_hz)), key=lambda k: f"{data.freq_hz[k]:.12g}"))
    back = np.argsort(order)
    body = data.bodies[number]
    ratio = (data.freq_hz[back] / data.freq_hz) ** data.order
    value, sd = body.displacement[:, :, back] * ratio, body.sd[:, :, back] * ratio
    bodies = list(data.bodies)
    bodies[number] = replace(body, displacement=value, sd=sd)
    return replace(data, bodies=tuple(bodies))


def told(data, correct=False):
    result = points2dof(data, options=Options(correct=correct))
    return result, [notice for notice in result.notices if notice.code != "neglected_motion"]


@pytest.mark.parametrize("number", [0, 1])
def test_frequencies_of_one_body_sorted_as_text_are_named_and_put_in_order(number):
    for order, seed in ((0, 21), (1, 22)):
        data = replace(study(seed, lines=120), order=order)
        wrong = spoiled(data, number)
        result, (notice,) = told(wrong)
        assert notice.code == "label_swap"
        assert f"the column freq_hz of {data.bodies[number].body} look sorted as text" in notice.text
        right, (corrected,) = told(wrong, correct=True)
        assert corrected.code == "corrected"
        np.testing.assert_allclose(right.motion.q, points2dof(data).motion.q, rtol=1e-6)
        assert np.max(np.abs(result.motion.q / right.motion.q - 1.0)) > 0.1


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("number", [0, 1])
def test_two_exchanged_lines_of_a_body_are_named_and_put_in_order(number, order):
    """What was read is exchanged: displacements made of velocities then are not, but for a factor."""
    data = replace(study(12), order=order)
    body, freq = data.bodies[number], data.freq_hz
    lines = np.arange(len(freq))
    lines[[30, 80]] = [80, 30]
    wrong = with_lines(data, number, range(len(body.points)), lines)
    _, (notice,) = told(wrong)
    assert notice.code == "label_swap"
    assert notice.text.startswith(f"the motion of {body.body} jumps at {freq[30]:.6g} and {freq[80]:.6g} Hz")
    right, (corrected,) = told(wrong, correct=True)
    assert corrected.code == "corrected"
    np.testing.assert_allclose(right.motion.q, points2dof(data).motion.q, rtol=1e-6)


def test_orders_of_text_undo_each_other():
    (one, first), (two, second) = sorted_as_text(FREQ)
    assert (first["what"], second["what"]) == ("the column freq_hz", "the values")
    assert np.array_equal(one[two], np.arange(len(FREQ)))
    assert [f"{value:.12g}" for value in FREQ[one]] == sorted(f"{value:.12g}" for value in FREQ)
    np.testing.assert_allclose(rate_ratio(one, FREQ, 1)[two] * rate_ratio(two, FREQ, 1), 1.0)
    assert not list(sorted_as_text(np.linspace(1000.0, 9000.0, 20)))


def test_lines_of_either_body_sorted_as_text_are_mostly_named_and_no_other_order_is():
    named = 0
    for seed in range(60):
        freq = np.linspace(150.0 + 5.0 * seed, 4000.0 + 100.0 * seed, 80)
        motion = moved(900 + seed, noise=(0.003, 0.01, 0.05)[seed % 3], freq=freq)
        order, words = list(sorted_as_text(freq))[seed % 2]
        what = words["what"]
        back, q, number = np.argsort(order), motion.q.copy(), seed % 2
        q[0, number] = q[0, number][back] * rate_ratio(back, freq, 1)[:, None]
        found = reordered_bodies(replace(motion, q=q), 1)
        assert [(one.body, one.estimate.split(" sorted")[0]) for one in found] in (
            [],
            [(number, what)],
        )
        named += bool(found)
    assert named >= 45


def test_500_clean_motions_are_not_called_sorted():
    rng = np.random.default_rng(8)
    for seed in range(500):
        low, high = rng.uniform(100.0, 900.0), rng.uniform(3000.0, 20000.0)
        freq = (np.linspace, np.geomspace)[seed % 3 == 0](low, high, int(rng.integers(8, 80)))
        noise, scale = np.exp(rng.uniform(np.log([0.002, 0.02]), np.log([0.05, 30.0])))
        motion = moved(2000 + seed, ("y",), float(rng.choice([0.0, 0.1, 0.3])), scale, noise, freq)
        assert not reordered_bodies(motion, 1)


def test_no_other_fault_of_accelerations_is_called_sorted():
    """An order of the readings keeps their size; that of displacements it would change by the frequency^2."""
    for seed in range(30):
        freq = np.round(np.geomspace(200.0 + 20.0 * seed, 4000.0 + 100.0 * seed, 12 + seed), 1)
        motion = moved(7000 + seed, ("y", "x"), noise=0.003, freq=freq)
        q = motion.q.copy()
        q[:, seed % 2] = q[:, seed % 2].conj()
        assert not reordered_bodies(motion, 2)
        assert not reordered_bodies(replace(motion, q=q), 2)


@pytest.mark.parametrize("bodies", [(0,), (1,), (0, 1)])
def test_one_ligament_shows_few_lines_in_the_order_of_text(bodies):
    """Twenty lines over four octaves: no course is smooth enough to tell."""
    freq = np.round(np.geomspace(310.0, 6000.0, 20), 1)
    order, words = next(sorted_as_text(freq))
    back = np.argsort(order)
    for seed in range(6):
        motion = moved(3100 + seed, ("y", "x"), freq=freq)
        assert reordered_bodies(motion, 1) == []
        wrong = motion
        for body in bodies:
            for run in range(2):
                wrong = put_in_order(wrong, [Reordered(run, body, back, "", "")], 1)
        found = reordered_bodies(wrong, 1)
        named = {(one.body, one.estimate.split(" sorted")[0]) for one in found}
        assert named == {(body, words["what"]) for body in bodies}
