"""Pictures: the right side from the right direction, the nearer surface in front, light from the lamp."""

import io
from dataclasses import replace

import numpy as np
import pytest

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.report.pictures import (
    VIEWS,
    Body,
    Scene,
    _frame_views,
    _picture_from_scan,
    render_scenes,
)
from legacy.ct_inertia.report.rasterise import rasterise
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector


def box(low, high):
    """A closed box whose faces point outward."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    return np.asarray(low) + corners * (np.asarray(high) - np.asarray(low)), np.array(faces)


@pytest.fixture(scope="module")
def scene():
    """An L-shaped pair of boxes without any symmetry, in a turned and shifted footplate frame."""
    frame = RigidTransform.from_parts(
        rotation_from_vector([0.4, -0.8, 1.1]), [12.0, -7.0, 30.0], "scan", "footplate"
    )
    first, second = box([0, 0, 0], [2.0, 0.4, 1.0]), box([0, 0.4, 0], [0.5, 3.0, 0.6])
    bodies = [Body(frame.points(v), f, name=name) for (v, f), name in ((first, "low"), (second, "high"))]
    return Scene(bodies, frame, side="left")


def panels(scene):
    centres, half = _frame_views(scene)
    return [
        (scene.bodies, _picture_from_scan(scene.frame, view), centre, half)
        for view, centre in zip(VIEWS, centres, strict=True)
    ]


def expected_mask(view_axes, centre, half, pixels):
    """Silhouette of the two boxes from their projected rectangles, exact."""
    right, up = view_axes
    grid = (np.arange(pixels) + 0.5) / pixels * 2.0 - 1.0
    u, v = np.meshgrid(centre[0] + half * grid, centre[1] - half * grid)
    mask = np.zeros((pixels, pixels), dtype=bool)
    for low, high in (([0, 0, 0], [2.0, 0.4, 1.0]), ([0, 0.4, 0], [0.5, 3.0, 0.6])):
        corners = np.array([low, high], dtype=float)
        us, vs = np.sort(corners @ right), np.sort(corners @ up)
        mask |= (u > us[0]) & (u < us[1]) & (v > vs[0]) & (v < vs[1])
    return mask


@pytest.mark.parametrize("smooth", [True, False])
def test_each_view_shows_the_exact_silhouette(scene, smooth):
    pixels = 200
    for view, (bodies, matrix, centre, half) in zip(VIEWS, panels(scene), strict=True):
        truth = expected_mask(view.axes[:2], centre, half, pixels)
        drawn = [replace(body, smooth=smooth) for body in bodies]
        picture = rasterise(drawn, matrix, centre, half, pixels)
        assert picture.shape == (pixels, pixels, 3)
        assert np.mean((picture.min(axis=2) < 250) != truth) < 1e-3


def test_the_nearer_surface_is_in_front_and_shines_through():
    red, blue = (
        Body(*box([0, 0, z], [1, 1, z + 1]), color=colour, smooth=False)
        for z, colour in ((0, "red"), (2, "blue"))
    )
    eye = np.eye(4), np.array([0.5, 0.5]), 1.0, 20
    for bodies in ([red, blue], [blue, red]):
        middle = rasterise(bodies, *eye)[10, 10]
        assert middle[2] > 100
        assert middle[0] == 0
    through = rasterise([replace(blue, opacity=0.25), red], *eye)[10, 10]
    alone = rasterise([red], *eye)[10, 10]
    blue_alone = rasterise([blue], *eye)[10, 10]
    assert np.allclose(through, 0.75 * alone + 0.25 * blue_alone, atol=1.0)
    behind = rasterise([blue, replace(red, opacity=0.25)], *eye)[10, 10]
    assert np.array_equal(behind, blue_alone)


def test_light_comes_from_the_upper_left():
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3)
    picture = rasterise(
        [Body(ball.vertices, ball.faces, color="white")], np.eye(4), np.zeros(2), 1.2, 100
    ).astype(int)
    assert picture[30, 35, 0] > picture[65, 65, 0] + 30
    assert picture[0, 0].tolist() == [255, 255, 255]
    # Means over neighbours: no step from triangle to triangle.
    assert np.abs(np.diff(picture[50, 20:80, 0])).max() < 12


def test_triangles_beyond_the_picture_and_without_area_do_no_harm():
    vertices, faces = box([-50, -50, 0], [50, 50, 1])
    flat = np.array([[0, 0, 1], [0, 1, 1]])
    picture = rasterise([Body(vertices, np.vstack([faces, flat]))], np.eye(4), np.zeros(2), 1.0, 30)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) <= 3
    away = rasterise([Body(vertices + 1000.0, faces)], np.eye(4), np.zeros(2), 1.0, 30)
    assert away.min() == 255


def test_views_are_right_handed():
    for view in VIEWS:
        right, up, eye = view.axes
        np.testing.assert_array_equal(np.cross(right, up), eye)


def test_anatomy_is_named_only_when_known(scene):
    names = scene.directions()
    assert names["+z"].startswith("superior")
    assert names["+x"].startswith("anterior")
    right = Scene(scene.bodies, scene.frame, side="right").directions()
    assert right["+z"].startswith("inferior")
    unknown = Scene(scene.bodies, scene.frame, side="left", anterior_known=False).directions()
    assert unknown["+x"] == "+x"
    assert unknown["+z"] == "+z"
    assert unknown["+y"].startswith("lateral")


def test_png_of_a_scene_with_a_plate_frame(scene):
    plate = RigidTransform(scene.frame.matrix, "scan", "plate")
    (png,) = render_scenes([Scene(scene.bodies, scene.frame, plate, "left")])
    assert png.startswith(b"\x89PNG")
    from matplotlib.image import imread

    picture = imread(io.BytesIO(png))
    assert picture.shape[1] > 2 * picture.shape[0]
    assert picture[..., :3].std() > 0.05


def test_faults():
    vertices, faces = box([0, 0, 0], [1, 1, 1])
    with pytest.raises(CtInertiaError, match="must be indices below 8; got 16"):
        Body(vertices, faces + 9)
    with pytest.raises(CtInertiaError, match="vertices and"):
        Body(vertices[:, :2], faces)
    with pytest.raises(CtInertiaError, match="at least one face"):
        Body(vertices, faces[:0])
    with pytest.raises(CtInertiaError, match="at least one body"):
        render_scenes([Scene([], RigidTransform.identity("scan", "footplate"))])
