"""The three-dimensional scene: surfaces keep their topology and shape, numbers arrive as they were given."""

import base64
import json

import numpy as np
import pytest

from stapeskit.frames import RigidTransform, rotation_from_vector
from stapeskit.report.scene3d import Line, Mesh, Motion, Point, Scene, decimate


def unpacked(text, kind):
    return np.frombuffer(base64.b64decode(text), dtype=kind)


def vertices_of(mesh):
    return mesh["low"] + mesh["step"] * unpacked(mesh["vertices"], "<i2").reshape(-1, 3)


def solid(name):
    """A surface of pyvista, which is loaded here: forks of a process that has it cost more."""
    import pyvista as pv

    if name == "torus":
        return pv.ParametricTorus(ringradius=1.0, crosssectionradius=0.15, u_res=200, v_res=100)
    if name == "ball":
        return pv.Sphere(radius=1.0)
    end = 90.0 if name == "half a sphere" else 180.0
    return pv.Sphere(radius=1.0, theta_resolution=140, phi_resolution=140, end_phi=end)


@pytest.mark.parametrize("name", ["sphere", "torus", "half a sphere"])
def test_a_decimated_surface_has_the_shape_of_the_given_one(name):
    given = solid(name).triangulate().clean(tolerance=1e-6)
    vertices, faces = decimate(given.points, given.regular_faces, 6000)
    coarse = type(given).from_regular_faces(vertices, faces)
    assert 2000 < coarse.n_cells < 8000
    cell = np.sqrt(2.2 * given.area / 6000)
    for one, other in ((coarse, given), (given, coarse)):
        _, near = other.find_closest_cell(one.points, return_closest_point=True)
        assert np.max(np.linalg.norm(near - one.points, axis=1)) < cell
    assert coarse.area == pytest.approx(given.area, rel=0.03)


def test_everything_is_shown_in_the_frame_of_the_axes():
    random = np.random.default_rng(3)
    axes = RigidTransform.from_parts(
        rotation_from_vector([0.3, -0.9, 0.4]), [5.0, -2.0, 7.0], "scan", "footplate"
    )
    ball = solid("ball")
    place = random.standard_normal(3)
    shown = Scene(
        [Mesh("stapes", axes.points(ball.points), ball.regular_faces, "#b06f12")],
        [Point("head", axes.points(place), "stapes", "sign")],
        axes,
        lines=[
            Line("beam", axes.points(np.array([[0.0, 0.0, 0.0], place])), "#c81e3a", "beams", shown=False)
        ],
    )
    data = json.loads(shown.content())
    np.testing.assert_allclose(vertices_of(data["meshes"][0]), ball.points, atol=2e-4)
    np.testing.assert_array_equal(
        unpacked(data["meshes"][0]["faces"], "<u2").reshape(-1, 3), ball.regular_faces
    )
    np.testing.assert_allclose(data["points"][0]["at"], place, atol=1e-5)
    np.testing.assert_allclose(data["lines"][-1]["at"][1], place, atol=1e-5)
    np.testing.assert_allclose(data["middle"], 0.0, atol=1e-3)
    assert data["reach"] == pytest.approx(np.sqrt(3.0), rel=0.01)
    assert {group["name"]: group["shown"] for group in shown.groups} == {
        "stapes": True,
        "axes": True,
        "points": True,
        "beams": False,
    }


def test_motions_arrive_line_by_line_with_real_before_imaginary_parts():
    random = np.random.default_rng(4)
    amplitudes = random.standard_normal((7, 6)) + 1j * random.standard_normal((7, 6))
    amplitudes[3] *= 100.0
    motion = Motion("measured", {"stapes": amplitudes, "base": 0.1 * amplitudes}, np.arange(1.0, 8.0), True)
    content = motion.content()
    sent = unpacked(content["bodies"]["stapes"], "<f4").reshape(7, 12)
    np.testing.assert_allclose(sent[:, :6] + 1j * sent[:, 6:], amplitudes, rtol=1e-6)
    assert content["start"] == 3
    assert content["hz"] == list(np.arange(1.0, 8.0))
    alone = Motion("mode", amplitudes[0], 1962.0).content()
    assert list(alone["bodies"]) == ["stapes"]
    assert len(unpacked(alone["bodies"]["stapes"], "<f4")) == 12


def test_the_view_at_the_start_holds_every_surface_and_keeps_the_first_one_seen():
    ball = solid("ball")
    stapes = Mesh("stapes", ball.points, ball.regular_faces, "#b06f12")
    plate = Mesh("plate", ball.points + np.array([0.0, -1.5, 0.0]), ball.regular_faces, "#9aa7b4", 0.3)
    alone, both = (json.loads(Scene(surfaces).content()) for surfaces in ([stapes], [stapes, plate]))
    assert both["reach"] > alone["reach"]
    assert both["middle"][1] == pytest.approx(alone["middle"][1] - 0.75, abs=0.01)
    huge = Mesh("plate", 50.0 * ball.points, ball.regular_faces, "#9aa7b4", 0.3)
    assert json.loads(Scene([stapes, huge]).content())["reach"] < 3.5 * alone["reach"]
