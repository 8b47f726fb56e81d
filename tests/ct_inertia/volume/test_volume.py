"""The volume: where voxels lie, what is refused."""

import numpy as np
import pytest

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.volume.volume import Volume
from tests.ct_inertia.solids import random_rotation


def make(array=None, spacing=(0.1, 0.2, 0.3), origin=(1.0, 2.0, 3.0), direction=None):
    array = np.arange(4 * 5 * 6, dtype=np.uint16).reshape(4, 5, 6) if array is None else array
    return Volume(array, np.array(spacing), np.array(origin), np.eye(3) if direction is None else direction)


def test_index_zero_is_the_centre_of_the_first_voxel():
    volume = make()
    assert volume.scan_points([0, 0, 0]) == pytest.approx([1.0, 2.0, 3.0])
    assert volume.scan_points([5, 4, 3]) == pytest.approx([1.5, 2.8, 3.9])
    assert volume.size.tolist() == [6, 5, 4]
    assert volume.voxel_mm3 == pytest.approx(0.006)


def test_index_and_scan_are_inverse_under_any_direction():
    volume = make(direction=random_rotation(5))
    index = np.random.default_rng(0).uniform(-5, 10, (20, 3))
    assert volume.index_points(volume.scan_points(index)) == pytest.approx(index, abs=1e-12)
    homogeneous = np.c_[index, np.ones(20)] @ volume.scan_from_index.T
    assert homogeneous[:, :3] == pytest.approx(volume.scan_points(index), abs=1e-12)


@pytest.mark.parametrize(("axis", "number"), [("x", 2), ("y", 1), ("z", 0)])
def test_mirror_reverses_that_axis_and_keeps_the_place(axis, number):
    volume = make()
    turned = volume.mirrored(axis)
    assert np.array_equal(turned.array, np.flip(volume.array, number))
    assert turned.origin_mm == pytest.approx(volume.origin_mm)
    assert np.array_equal(turned.mirrored(axis).array, volume.array)


def test_a_crop_keeps_scan_coordinates():
    volume = make(direction=random_rotation(2))
    corners = volume.scan_points([[1, 1, 1], [4, 3, 2]])
    part = volume.cropped(corners.ravel())
    inside = np.argwhere(part.array == volume.array[2, 3, 4])[0][::-1]
    assert part.scan_points(inside) == pytest.approx(volume.scan_points([4, 3, 2]))
    with pytest.raises(CtInertiaError, match="--box must be a box that overlaps the scan"):
        volume.cropped([50, 50, 50, 60, 60, 60])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"array": np.zeros((4, 5), np.uint8)}, "three-dimensional; got an image of shape 5 x 4"),
        ({"array": np.zeros((1, 5, 6), np.uint8)}, "three-dimensional"),
        ({"array": np.zeros((4, 5, 6, 3), np.uint8)}, "colour"),
        ({"array": np.zeros((4, 5, 6), complex)}, "complex"),
        ({"array": np.zeros((4, 5, 6), bool)}, "integers or floating point"),
        ({"spacing": (0.1, 0.0, 0.1)}, "three positive numbers"),
        ({"spacing": (0.1, 0.1)}, "three positive numbers"),
        ({"origin": (0.1, np.nan, 0.1)}, "origin"),
        ({"direction": np.diag([1.0, 1.0, -1.0])}, "right-handed .* got the left-handed"),
        ({"direction": np.eye(3) + 0.01}, "orthonormal"),
        ({"direction": np.eye(2)}, "finite 3x3"),
    ],
)
def test_refusals(change, message):
    with pytest.raises(CtInertiaError, match=message):
        make(**change)


def test_rounded_directions_become_exact_rotations():
    rough = np.round(random_rotation(7), 6)
    direction = make(direction=rough).direction
    assert direction.T @ direction == pytest.approx(np.eye(3), abs=1e-14)
    assert direction == pytest.approx(rough, abs=1e-5)


def test_mirror_needs_an_axis():
    with pytest.raises(CtInertiaError, match="--mirror must be x, y or z; got w"):
        make().mirrored("w")
