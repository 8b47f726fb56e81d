"""What beams do not see is refused and described; oblique beams report what they pick up besides."""

import numpy as np
import pytest

from kinematics.fit.beams import beam_set, observable_dof, unseen_motions
from kinematics.fit.neglected import neglected_notice
from kinematics.fit.reference import per_reference
from kinematics.joint.expected import laser_numbers
from simulate import motion_of
from simulate.vibrometer import laser_directions
from stapeskit.faults import StapeskitError
from stapeskit.spatial import DOF_NAMES
from tests.motion.bodies import as_measurement, fitted, recorded


def test_basis_and_columns_are_those_of_the_rows():
    rng = np.random.default_rng(0)
    arms, directions = rng.normal(size=(12, 3)) * 1e-3, np.tile(np.eye(3), (4, 1))
    beams = beam_set("a", arms, directions, DOF_NAMES)
    assert np.allclose(beams.basis.T @ beams.basis, np.eye(6), atol=1e-12)
    assert np.allclose(beams.rows @ beams.to_dof, beams.basis, atol=1e-9)


def test_parallel_beams_see_three_motions_and_say_so():
    rng = np.random.default_rng(1)
    arms = rng.normal(size=(8, 3)) * 1e-3
    directions = np.tile([0.0, 1.0, 0.0], (8, 1))
    assert observable_dof(arms, directions) == ("y", "alpha", "gamma")
    with pytest.raises(StapeskitError) as error:
        beam_set("a", arms, directions, DOF_NAMES)
    fault = error.value.faults[0]
    assert "body a" in fault.thing
    assert "y,alpha,gamma" in fault.next_step
    assert "translation along the x axis" in fault.got
    assert "piston axis" in fault.got
    assert len(unseen_motions(arms, directions)) == 3


def test_points_on_a_line_do_not_show_its_rotation():
    along = np.outer(np.linspace(0.0, 2e-3, 5), [0.0, 0.0, 1.0])
    arms, directions = np.repeat(along, 3, axis=0), np.tile(np.eye(3), (5, 1))
    (motion,) = unseen_motions(arms, directions)
    assert "z axis" in motion
    free = observable_dof(arms, directions)
    assert "gamma" not in free
    assert len(free) == 5


@pytest.mark.parametrize("cone", [5.0, 20.0])
def test_parallel_beams_of_three_heads_are_three_lasers_however_close(cone):
    directions = np.tile(laser_directions(3, cone), (6, 1))
    assert laser_numbers(directions).tolist() == [0, 1, 2] * 6


def test_beams_of_a_scanning_head_are_one_laser():
    rng = np.random.default_rng(2)
    places = rng.uniform(-2.0, 2.0, (30, 3))
    heads = 150.0 * laser_directions(3, 25.0)
    directions = (heads[None] - places[:, None]).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    assert laser_numbers(directions).tolist() == [0, 1, 2] * 30


def test_oblique_beams_report_motion_outside_the_chosen_degrees_of_freedom():
    measurement = as_measurement(recorded(1))
    body, (fit,) = fitted(measurement, ("y", "alpha", "gamma"))
    (notice,) = neglected_notice(fit, body)
    assert notice.code == "neglected_motion"
    body, (fit,) = fitted(measurement)
    assert neglected_notice(fit, body) == []


def test_responses_per_reference_state_their_sd():
    misses = []
    for seed in range(6):
        motion = motion_of(recorded(seed, lines=300, noise=0.002))
        ratio = per_reference(motion, "stapes:y")
        truth = recorded(seed, lines=300, noise=0.002).motion_m["stapes"]
        want = (truth / truth[..., 1:2])[0]
        error = np.delete(ratio.q[0, 0] - want, 1, axis=1)
        spread = np.sqrt(np.diagonal(ratio.covariance[0], axis1=1, axis2=2).real)
        misses.append(np.mean(np.abs(error) ** 2 / np.delete(spread, 1, axis=1) ** 2))
        assert np.all(ratio.q[0, 0, :, 1] == 1.0)
    assert abs(np.mean(misses) - 1.0) < 0.05
