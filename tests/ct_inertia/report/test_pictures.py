"""Pictures: the right side from the right direction, by either renderer, and never a crash."""

import io
import os
import subprocess
import sys

import numpy as np
import pytest

from ct_inertia.errors import CtInertiaError
from ct_inertia.report.offscreen import draw_offscreen
from ct_inertia.report.painter import paint_bodies
from ct_inertia.report.pictures import (
    VIEWS,
    Body,
    Scene,
    _framing,
    _picture_from_scan,
    render_scenes,
    render_views,
)
from stapeskit.frames import RigidTransform, rotation_from_vector


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
    centres, half = _framing(scene)
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


def painted(panel, pixels):
    """The same panel by matplotlib, as pixels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    bodies, matrix, centre, half = panel
    drawing = Figure(figsize=(4, 4), dpi=pixels / 4)
    FigureCanvasAgg(drawing)
    axes = drawing.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    paint_bodies(axes, bodies, matrix)
    axes.set(xlim=(centre[0] - half, centre[0] + half), ylim=(centre[1] - half, centre[1] + half))
    drawing.canvas.draw()
    return np.asarray(drawing.canvas.buffer_rgba())[..., :3]


def works_here():
    """Whether pyvista can draw anything at all off-screen on this machine."""
    code = "import pyvista as p; q = p.Plotter(off_screen=True); q.add_mesh(p.Cube()); q.screenshot(None)"
    environment = os.environ | {"VTK_DEFAULT_OPENGL_WINDOW": "vtkEGLRenderWindow"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=False)
    return done.returncode == 0


def test_each_view_shows_the_exact_silhouette_by_both_renderers(scene):
    pixels = 200
    rasters, reason = draw_offscreen(panels(scene), pixels)
    assert rasters is not None or not works_here(), reason
    for place, (view, panel) in enumerate(zip(VIEWS, panels(scene), strict=True)):
        truth = expected_mask((view.right, view.up), panel[2], panel[3], pixels)
        drawn = [painted(panel, pixels)] + ([] if rasters is None else [rasters[place]])
        for picture in drawn:
            wrong = np.mean((picture.min(axis=2) < 250) != truth)
            assert wrong < 0.012, (place, reason)


def test_views_are_right_handed():
    for view in VIEWS:
        np.testing.assert_array_equal(np.cross(view.right, view.up), view.eye)


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


def test_png_of_a_scene_with_a_plate_frame(scene, monkeypatch):
    monkeypatch.setenv("STAPESKIT_OFFSCREEN", "0")
    plate = RigidTransform(scene.frame.matrix, "scan", "plate")
    png, notices = render_views(scene.bodies, scene.frame, plate, "left")
    assert png.startswith(b"\x89PNG")
    assert [notice.code for notice in notices] == ["pictures_by_matplotlib"]
    from matplotlib.image import imread

    picture = imread(io.BytesIO(png))
    assert picture.shape[1] > 2 * picture.shape[0]
    assert picture[..., :3].std() > 0.05


def test_a_renderer_that_dies_by_a_signal_costs_only_a_notice(scene, monkeypatch, tmp_path):
    crash = tmp_path / "python"
    crash.write_text(f"#!/bin/sh\nexec {sys.executable} -c 'import os; os.kill(os.getpid(), 11)'\n")
    crash.chmod(0o755)
    monkeypatch.setattr("ct_inertia.report.offscreen.sys.executable", str(crash))
    pictures, notices = render_scenes([scene])
    assert pictures[0].startswith(b"\x89PNG")
    assert [notice.code for notice in notices] == ["pictures_by_matplotlib"]
    assert "signal 11" in notices[0].text


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
