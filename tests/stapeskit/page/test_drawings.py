"""Pictures: the sides are right, no peak is lost, nearer things hide what is behind them."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.report.draw_geometry import placement_figure
from legacy.kinematics.report.draw_motion import (
    SHARE,
    displacement_of,
    full_motion,
    moment,
    shown_points,
    surface_body,
)
from legacy.kinematics.report.draw_residuals import channel_labels, residual_figure, residual_map
from legacy.kinematics.report.stapes_surface import Scenery, coarse, scenery_of
from legacy.stapeskit.page.drawings import (
    amplitude_axis,
    decimate_lines,
    distinct_short_names,
    line_words,
    log_spaced,
    shorten_name,
    unit,
)
from legacy.stapeskit.page.page import new_figure
from legacy.stapeskit.page.shaded_surface import View, shade, silhouette, views
from tests.kinematics.simulated import body, measurement, scene


def sphere(radius=1.0, rings=60, centre=(0.0, 0.0, 0.0)):
    """Closed outward sphere from a grid of angles."""
    polar = np.linspace(0.0, np.pi, rings + 1)[1:-1]
    turn = np.linspace(0.0, 2.0 * np.pi, 2 * rings, endpoint=False)
    p, t = np.meshgrid(polar, turn, indexing="ij")
    ring = np.stack([np.sin(p) * np.cos(t), np.sin(p) * np.sin(t), np.cos(p)], axis=-1).reshape(-1, 3)
    vertices = np.vstack([ring, [[0.0, 0.0, 1.0]], [[0.0, 0.0, -1.0]]])
    n, faces = len(turn), []
    for i in range(len(polar) - 1):
        for j in range(n):
            a, b, c, d = i * n + j, i * n + (j + 1) % n, (i + 1) * n + j, (i + 1) * n + (j + 1) % n
            faces += [(a, c, b), (b, c, d)]
    top, bottom, last = len(ring), len(ring) + 1, (len(polar) - 1) * n
    for j in range(n):
        faces += [(top, j, (j + 1) % n), (bottom, last + (j + 1) % n, last + j)]
    return radius * vertices + np.array(centre), np.array(faces)


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.sum(np.einsum("ij,ij->i", a, np.cross(b, c))) / 6.0)


@pytest.fixture(scope="module")
def result():
    one, two = scene(3, "gain", lines=80), scene(4, lines=80)
    return points2dof(measurement(body("stapes", one), body("base", two), freq_hz=one.freq_hz))


def test_every_view_is_right_handed_and_lies_as_in_the_other_reports():
    for view in views():
        right, up, eye = view.axes
        assert np.array_equal(np.cross(right, up), eye)
    along, _, lateral = views()
    assert (along.eye, lateral.eye) == ("+z", "+y")
    assert along.right == lateral.right == "+x"


def test_the_axes_of_every_panel_count_the_way_they_are_drawn(result):
    figure = placement_figure(result, Scenery(z_is="superior"))
    assert [view.get_title() for view in figure.axes] == [
        "seen from superior (+z)",
        "seen from anterior (+x)",
        "seen from lateral (+y)",
    ]
    figure.canvas.draw()
    for panel, view in zip(figure.axes, views(), strict=True):
        for axis, signed in ((panel.xaxis, view.right), (panel.yaxis, view.up)):
            ticks = axis.get_ticklocs()
            words = [label.get_text().replace("−", "-") for label in axis.get_ticklabels()]
            numbers = [float(word) for word in words if word]
            sign = 1.0 if signed[0] == "+" else -1.0
            assert np.allclose(numbers, sign * ticks[: len(numbers)])
            assert axis.get_label_text().startswith(signed[1])
    assert figure.axes[2].get_xlabel() == "x (mm), anterior +"
    assert figure.axes[2].get_ylabel() == "z (mm), superior +"


def test_a_side_that_nobody_stated_is_not_named():
    assert Scenery().side("+z") == ""
    assert Scenery(anterior_known=False).side("+x") == ""
    assert Scenery(z_is="inferior").side("-z") == "superior"
    assert Scenery().side("-y") == "medial"


def test_the_surface_lies_in_the_footplate_frame_whatever_the_scan():
    vertices, faces = sphere(rings=8)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, (5.0, 6.0, 7.0)
    frames = {"scan_from_footplate": matrix.tolist(), "z_is": "superior", "anterior_from": "direction"}
    outline = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    scanned = vertices @ turn.T + matrix[:3, 3]
    made = scenery_of(frames, {"footplate_outline_in_footplate_mm": outline}, scanned, faces)
    assert np.allclose(made.vertices_mm, vertices)
    assert np.allclose(made.outline_mm, outline)
    assert made.z_is == "superior"


def test_a_shaded_sphere_has_its_size_depth_and_light():
    vertices, faces = sphere(2.0, centre=(1.0, -3.0, 0.5))
    for view in views():
        drawn = shade(vertices, faces, view, pixels=200)
        left, right, bottom, top = drawn.extent
        rows, columns = drawn.depth.shape
        pixel = (right - left) / columns
        assert pixel == pytest.approx((top - bottom) / rows)
        assert np.sum(drawn.image[..., 3]) * pixel**2 == pytest.approx(np.pi * 4.0, rel=0.02)
        centre = view.flat(np.array([1.0, -3.0, 0.5]))
        nearest = centre + np.array([0.0, 0.0, 2.0])
        assert np.max(drawn.depth) == pytest.approx(nearest[2], abs=0.01)
        inside, before = centre[None], (nearest + np.array([0.0, 0.0, 0.2]))[None]
        assert drawn.hides(inside, 0.1)[0]
        assert not drawn.hides(before, 0.1)[0]
        assert not drawn.hides((centre + np.array([5.0, 0.0, 0.0]))[None], 0.1)[0]
        bright = drawn.image[..., 0] * (drawn.image[..., 3] == 1.0)
        half = rows // 2
        assert bright[:half, : columns // 2].sum() > bright[half:, columns // 2 :].sum()


def test_the_edge_of_a_silhouette_is_where_the_sphere_ends():
    across, up, covered = silhouette(*sphere(1.5), View("+z", "+x", "+y"), 150)
    middle = covered[np.argmin(np.abs(up))]
    edges = across[np.flatnonzero(np.diff((middle > 0.5).astype(int)))]
    assert edges == pytest.approx([-1.5, 1.5], abs=0.03)


@pytest.mark.parametrize("most", [200, 800, 3000])
def test_a_coarse_surface_keeps_shape_and_sense(most):
    vertices, faces = sphere()
    few, triangles = coarse(vertices, faces, most)
    assert len(triangles) <= most
    assert volume(few, triangles) == pytest.approx(volume(vertices, faces), rel=12.0 / np.sqrt(most) / 2.0)
    assert np.max(np.linalg.norm(few, axis=1)) <= 1.0 + 1e-12
    assert len(coarse(vertices, faces, len(faces))[0]) == len(vertices)


@pytest.mark.parametrize(("lines", "most"), [(5000, 300), (301, 300), (4001, 40), (10, 300)])
def test_thinned_curves_keep_every_peak_and_trough(lines, most):
    size = np.abs(np.random.default_rng(lines).normal(size=lines))
    size[lines // 3] = 50.0
    size[2 * lines // 3] = 1e-9
    size[lines // 2] = np.nan
    kept = decimate_lines(size, most)
    assert len(kept) <= most + 2
    assert np.all(np.diff(kept) > 0)
    assert kept[0] == 0
    assert kept[-1] == lines - 1
    assert {lines // 3, 2 * lines // 3} <= set(kept.tolist())


def test_lines_are_drawn_on_the_axis_on_which_they_are_even():
    assert log_spaced(np.geomspace(100.0, 1e4, 50))
    assert not log_spaced(np.linspace(100.0, 1e4, 50))
    assert not log_spaced(np.array([100.0, 200.0]))


def test_the_residual_map_shows_the_largest_of_neighbouring_lines(result):
    fit, freq = result.fits[0, 0], result.motion.freq_hz
    whole = residual_map(fit, freq)
    assert whole.lines == 1
    expected = np.abs(fit.residual) / fit.sd
    assert np.allclose(whole.size, expected)
    few = residual_map(fit, freq, columns=7)
    borders = np.linspace(0, len(freq), 8).round().astype(int)
    for column in range(7):
        own = expected[:, borders[column] : borders[column + 1]]
        assert np.allclose(few.size[:, column], own.max(axis=1))
    assert few.lines == 12
    assert few.edges_hz[0] <= freq[0]
    assert few.edges_hz[-1] >= freq[-1]


def test_the_level_of_noise_in_a_thinned_map_is_what_noise_gives():
    rng = np.random.default_rng(8)
    size = np.abs(rng.normal(size=(4000, 25, 2)) @ np.array([1.0, 1j]))
    one = residual_map_of_noise(25)
    assert one == pytest.approx(np.median(size.max(axis=1)), rel=0.02)


def residual_map_of_noise(lines):
    from legacy.kinematics.report.draw_residuals import ResidualMap

    return ResidualMap(np.zeros((1, 1)), np.zeros(2), lines, np.zeros(1)).noise


def test_the_largest_motion_fills_its_share_of_the_picture(result):
    now = moment(result, Scenery(), 0, 30)
    clouds = shown_points(result, Scenery())
    sizes = [np.linalg.norm(np.abs(displacement_of(now.q[k], c)), axis=1).max() for k, c in enumerate(clouds)]
    assert max(sizes) == pytest.approx(now.largest_m)
    span = np.max(np.ptp(np.concatenate(clouds), axis=0)) * 1e-3
    assert now.exaggeration * now.largest_m == pytest.approx(SHARE * span, rel=0.06)


def test_points_move_as_a_rigid_body(result):
    q = full_motion(result.motion)[0, 0, 10]
    points = result.measurement.bodies[0].positions_mm[::3]
    for point, moved in zip(points, displacement_of(q, points), strict=True):
        x, y, z = point * 1e-3
        expected = [
            q[0] + q[4] * z - q[5] * y,
            q[1] + q[5] * x - q[3] * z,
            q[2] + q[3] * y - q[4] * x,
        ]
        assert np.allclose(moved, expected, rtol=1e-12)


def test_the_surface_moves_with_the_stapes_or_with_the_only_body():
    assert surface_body(("base", "Stapes")) == 1
    assert surface_body(("left ossicle",)) == 0
    assert surface_body(("incus", "base")) is None


def test_names_are_short_and_still_told_apart(result):
    long = [f"measurement point no. {k} on the footplate" for k in (1, 2, 31)]
    assert list(distinct_short_names(long).values()) == ["1", "2", "31"]
    same = ["aaaaaaaaaaaaaaaaaaaa", "bbbbbbbbbbbbbbbbbbbb"]
    assert len(set(distinct_short_names(same).values())) == 2
    assert all(len(name) <= 10 for name in distinct_short_names(same).values())
    assert shorten_name("short") == "short"
    labels = channel_labels(result.measurement.bodies[0])
    assert labels[:4] == ["1, beam 1", "1, beam 2", "1, beam 3", "2, beam 1"]


def test_units_of_what_is_drawn():
    assert unit("y") == (1e9, "nm")
    assert unit("alpha") == (1e6, "µrad")
    assert unit("y", "base:y") == (1.0, "1")
    assert unit("alpha", "base:y") == (1.0, "rad/m")


def test_maps_of_few_wide_or_logarithmic_lines_are_drawn():
    for freq in (np.array([100.0]), np.array([100.0, 5000.0]), np.geomspace(10.0, 1e4, 40)):
        one = scene(4, lines=len(freq))
        two = scene(6, lines=len(freq))
        made = points2dof(measurement(body("stapes", one), body("base", two), freq_hz=freq))
        figure, first = residual_figure(made)
        figure.canvas.draw()
        maps = figure.axes[0], figure.axes[2]
        assert {view.get_xscale() for view in maps} == {"log" if len(freq) == 40 else "linear"}
        assert {view.get_xlim() for view in maps} == {(first.edges_hz[0] / 1e3, first.edges_hz[-1] / 1e3)}
        assert first.edges_hz[0] > 0.0


@pytest.mark.parametrize(("low", "high"), [(0.4, 3.0), (40.0, 300.0), (0.02, 60.0), (1e-3, 1e4)])
def test_ticks_of_amplitudes_are_plain_numbers(low, high):
    figure = new_figure(4.0, 2.0)
    view = figure.subplots()
    view.plot([1.0, 2.0], [low, high])
    amplitude_axis(view)
    figure.canvas.draw()
    words = [one.get_text() for which in ("major", "minor") for one in view.yaxis.get_ticklabels(which=which)]
    shown = [word for word in words if word]
    assert len(shown) > 1
    assert [f"{float(word):g}" for word in shown] == shown


def test_lines_are_counted_in_words():
    assert line_words(np.array([100.0, 200.0])) == "2, 100 to 200 Hz"
    assert line_words(np.array([862.3])) == "1, at 862.3 Hz"
