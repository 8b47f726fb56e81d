"""A fault changes what it names and nothing else; the lasers see the points they are said to see."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.stapeskit.frames import RigidTransform
from sample_volumes import bodies
from sample_volumes.faults import KINDS, Fault, faulty
from sample_volumes.phantom import Ear, scene, truth
from sample_volumes.vibrometer import Vibrometry, laser_directions, record, visible_points


@pytest.fixture(scope="module")
def clean():
    behind = truth(scene(Ear(voxel_mm=(0.1, 0.1, 0.1))))
    pose = RigidTransform(np.array(behind["plate_from_footplate"]), "plate", "footplate").inverse()
    marks = [(name, np.array(place)) for name, place in behind["fiducials_in_plate_mm"].items()]
    return record(np.array(behind["mass_matrix_si"]), pose, Vibrometry(lines=6), marks)


def changed(first, second):
    """Channels in which anything differs."""
    return np.flatnonzero(
        np.any(first.velocity_m_s != second.velocity_m_s, axis=(0, 2))
        | np.any(first.position_mm != second.position_mm, axis=1)
        | np.any(first.direction != second.direction, axis=1)
    ).tolist()


@pytest.mark.parametrize("kind", ["gain", "sign", "direction", "noise", "drift", "zeros"])
def test_a_fault_of_a_channel_touches_that_channel_alone(clean, kind):
    seen = faulty(clean, Fault(kind, "base", "3", 1, 2.0))
    assert changed(clean, seen) == [3 * 10 + 3 * 2 + 1]


def test_a_fault_of_a_point_touches_its_three_beams(clean):
    moved = faulty(clean, Fault("position", "stapes", "4", size=0.2))
    assert changed(clean, moved) == [9, 10, 11]
    shift = np.linalg.norm(moved.position_mm - clean.position_mm, axis=1)
    np.testing.assert_allclose(shift[9:12], 0.2, rtol=1e-9)


def test_swapped_labels_exchange_positions_and_keep_velocities(clean):
    seen = faulty(clean, Fault("label_swap", "stapes", "1", other="5"))
    assert changed(clean, seen) == [0, 1, 2, 12, 13, 14]
    np.testing.assert_array_equal(seen.position_mm[0], clean.position_mm[12])
    np.testing.assert_array_equal(seen.velocity_m_s, clean.velocity_m_s)


def test_sizes_are_as_stated(clean):
    gain = faulty(clean, Fault("gain", size=0.05)).velocity_m_s[:, 0] / clean.velocity_m_s[:, 0]
    np.testing.assert_allclose(gain, 1.05, rtol=1e-12)
    tilted = faulty(clean, Fault("direction", size=3.0)).direction[0]
    assert np.degrees(np.arccos(tilted @ clean.direction[0])) == pytest.approx(3.0, rel=1e-6)
    drift = faulty(clean, Fault("drift", size=0.1)).velocity_m_s[0, 0] / clean.velocity_m_s[0, 0]
    np.testing.assert_allclose(drift[[0, -1]], [1.0, 1.1], rtol=1e-12)
    other = faulty(clean, Fault("conjugate")).velocity_m_s
    np.testing.assert_array_equal(other, clean.velocity_m_s.conj())


def test_unknown_faults_points_and_beams_are_refused(clean):
    with pytest.raises(ValueError, match=r"the fault must be one of gain, sign"):
        faulty(clean, Fault("hum"))
    for kind in KINDS[:-1]:
        with pytest.raises(ValueError, match=r"the point must be one of the recording; got stapes 99"):
            faulty(clean, Fault(kind, point="99"))
    with pytest.raises(ValueError, match=r"the beam must be one of 0 to 2; got 3"):
        faulty(clean, Fault("sign", beam=3))


def test_points_lie_on_the_stapes_where_all_lasers_reach_them():
    import pyvista

    stapes = bodies.stapes_in_footplate()
    beams = laser_directions(20.0)[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    points = visible_points(stapes, 10, beams)
    assert len(np.unique(points, axis=0)) == 10
    assert np.ptp(points[:, 1]) > 2.5
    mesh = pyvista.PolyData.from_regular_faces(stapes.vertices_mm, stapes.faces)
    for beam in beams:
        for point in points:
            assert np.linalg.norm(stapes.vertices_mm - point, axis=1).min() == 0.0
            met, _ = mesh.ray_trace(point + 1e-4 * beam, point + 20.0 * beam)
            assert len(met) == 0


def test_more_points_keep_the_first_ones():
    stapes, beams = bodies.stapes_in_footplate(), np.array([[0.0, 1.0, 0.0]])
    few, many = visible_points(stapes, 9, beams), visible_points(stapes, 14, beams)
    np.testing.assert_array_equal(few, many[:9])
