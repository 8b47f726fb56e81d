"""Surfaces: exact moments, refusals, files."""

import numpy as np
import pytest

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.surface.surface import Surface, count_open_edges, read_surface, write_surface
from tests.ct_inertia.solids import (
    box_surface,
    implicit_surface,
    joined,
    moved,
    random_rotation,
    stapes_surface,
)
from tests.oracles import box_moments, ellipsoid_moments


def ellipsoid(axes, step):
    axes = np.asarray(axes, float)
    r = axes.max() * 1.2
    return implicit_surface(lambda p: np.linalg.norm(p / axes, axis=-1) - 1.0, (-r,) * 3, (r,) * 3, step)


def test_moments_of_a_box_are_exact():
    exact = box_moments((1.0, 2.0, 3.0))
    m = box_surface((1.0, 2.0, 3.0), (10.0, -20.0, 30.0)).moments()
    assert m.volume_mm3 == pytest.approx(exact.volume, rel=1e-14)
    assert m.centroid_mm == pytest.approx([10.0, -20.0, 30.0], rel=1e-13)
    assert m.second_mm5 == pytest.approx(exact.second, abs=1e-12)
    assert m.inertia_mm5 == pytest.approx(exact.inertia)


def test_moments_of_an_ellipsoid_converge_with_the_square_of_the_mesh():
    axes = np.array([0.7, 0.5, 0.4])
    exact = ellipsoid_moments(axes)
    volume, second = exact.volume, np.diag(exact.second)
    errors = []
    for step in (0.08, 0.04, 0.02):
        m = ellipsoid(axes, step).moments()
        errors.append([abs(m.volume_mm3 / volume - 1), np.abs(np.diag(m.second_mm5) / second - 1).max()])
    order = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(order > 1.8)
    assert np.all(order < 2.2)


def test_rotating_the_mesh_rotates_the_tensor_and_a_far_origin_loses_nothing():
    surface = stapes_surface(0.06)
    rotation = random_rotation(3)
    here = surface.moments()
    there = moved(surface, rotation, (3e4, -2e4, 1e4)).moments()
    assert there.volume_mm3 == pytest.approx(here.volume_mm3, rel=1e-9)
    assert there.second_mm5 == pytest.approx(rotation @ here.second_mm5 @ rotation.T, abs=1e-8)


def test_a_hollow_box_is_the_difference_of_two():
    outer, inner = box_surface((2.0, 2.0, 2.0)), box_surface((1.0, 1.0, 1.0), (0.2, 0.0, 0.0))
    vertices = np.vstack([outer.vertices_mm, inner.vertices_mm])
    hollow = Surface(vertices, np.vstack([outer.faces, inner.faces[:, ::-1] + len(outer.vertices_mm)]))
    assert hollow.volume_mm3 == pytest.approx(7.0)
    assert hollow.moments().centroid_mm == pytest.approx([-0.2 / 7.0, 0.0, 0.0])


def test_topology_of_a_stapes_is_one_hole():
    assert stapes_surface(0.06).euler_characteristic == 0
    assert box_surface((1, 1, 1)).euler_characteristic == 2
    assert joined(box_surface((1, 1, 1)), box_surface((1, 1, 1), (3, 0, 0))).euler_characteristic == 4


def test_refusals():
    box = box_surface((1, 1, 1))
    with pytest.raises(CtInertiaError, match="closed and consistently oriented; got 3 edges"):
        Surface(box.vertices_mm, box.faces[1:])
    flipped = box.faces.copy()
    flipped[0] = flipped[0, ::-1]
    with pytest.raises(CtInertiaError, match="closed and consistently oriented"):
        Surface(box.vertices_mm, flipped)
    with pytest.raises(CtInertiaError, match="oriented outward"):
        Surface(box.vertices_mm, box.faces[:, ::-1])
    with pytest.raises(CtInertiaError, match="mesh with triangles"):
        Surface(np.zeros((0, 3)), np.zeros((0, 3), int))
    with pytest.raises(CtInertiaError, match="indices below 8; got 9"):
        Surface(box.vertices_mm, np.where(box.faces == 7, 9, box.faces))
    with pytest.raises(CtInertiaError, match="finite"):
        Surface(np.where(box.vertices_mm > 0, np.nan, box.vertices_mm), box.faces)
    with pytest.raises(CtInertiaError, match="vertices \\(n, 3\\)"):
        Surface(np.zeros((4, 2)), np.zeros((4, 3), int))


def test_open_edges_are_counted_by_direction():
    faces = np.array([[0, 1, 2], [0, 1, 3]])
    assert count_open_edges(faces) == 5


@pytest.mark.parametrize(
    ("suffix", "tolerance"), [(".ply", 0.0), (".stl", 1e-6), (".obj", 1e-6), (".glb", 1e-6)]
)
def test_files_round_trip(tmp_path, suffix, tolerance):
    surface = moved(stapes_surface(0.08), random_rotation(1), (5.0, 6.0, 7.0))
    path = tmp_path / f"s{suffix}"
    write_surface(path, surface)
    again = read_surface(path)
    assert again.volume_mm3 == pytest.approx(surface.volume_mm3, rel=max(tolerance, 1e-12))
    assert again.moments().centroid_mm == pytest.approx(surface.moments().centroid_mm, rel=1e-6)
    assert again.euler_characteristic == 0
    assert again.notices == ()


def test_an_inward_file_is_turned_and_told(tmp_path):
    import trimesh

    box = box_surface((1, 2, 3))
    trimesh.Trimesh(box.vertices_mm, box.faces[:, ::-1], process=False).export(tmp_path / "in.stl")
    surface = read_surface(tmp_path / "in.stl")
    assert surface.volume_mm3 == pytest.approx(6.0)
    assert [n.code for n in surface.notices] == ["surface_turned"]


def test_bad_surface_files(tmp_path):
    box = box_surface((1, 2, 3))
    with pytest.raises(CtInertiaError, match="an existing file"):
        read_surface(tmp_path / "none.stl")
    (tmp_path / "a.xyz").write_text("x")
    with pytest.raises(CtInertiaError, match="STL, PLY, OBJ or GLB"):
        read_surface(tmp_path / "a.xyz")
    (tmp_path / "junk.ply").write_text("ply\nnonsense")
    with pytest.raises(CtInertiaError, match="readable PLY"):
        read_surface(tmp_path / "junk.ply")
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    with pytest.raises(CtInertiaError, match=r"triangles"):
        read_surface(tmp_path / "points.obj")
    write_surface(tmp_path / "box.ply", box)
    text = (tmp_path / "box.obj").with_suffix(".obj")
    lines = [f"v {x} {y} {z}" for x, y, z in box.vertices_mm]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in box.faces[:-1]]
    text.write_text("\n".join(lines))
    with pytest.raises(CtInertiaError) as caught:
        read_surface(text)
    (fault,) = caught.value.faults
    assert (fault.thing, fault.where) == ("the surface", "box.obj")
    with pytest.raises(CtInertiaError, match="STL, PLY, OBJ or GLB"):
        write_surface(tmp_path / "b.vtk", box)
