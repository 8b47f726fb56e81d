"""Meshes that people bring: mended where that is safe, else refused with the place, or closed when asked."""

import numpy as np
import pytest
import trimesh

from ct_inertia.surface.repair import mend, open_walks, read_mesh
from ct_inertia.surface.surface import enclosed_moments
from ct_inertia.surface.winding import winding_number
from stapeskit.faults import StapeskitError

RNG = np.random.default_rng(7)


def ring():
    """A body with one hole, as a stapes is one: torus, 3 mm wide, far from the origin."""
    mesh = trimesh.creation.torus(1.2, 0.4, major_sections=40, minor_sections=20)
    return mesh.vertices + np.array([30.0, -20.0, 10.0]), np.asarray(mesh.faces, dtype=np.int64)


def signed_volume(vertices, faces):
    return enclosed_moments(vertices, faces)[0]


VERTICES, FACES = ring()
VOLUME = signed_volume(VERTICES, FACES)


def read_as(mesh):
    """Return the one text that says how a mesh was read."""
    (notice,) = mesh.notices
    assert notice.code == "file_read"
    return notice.text


def assert_whole(mesh, rel=1e-6):
    assert open_walks(mesh.faces) == 0
    assert signed_volume(mesh.vertices_mm, mesh.faces) == pytest.approx(VOLUME, rel=rel)


def test_the_volume_of_known_bodies():
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    assert signed_volume(box.vertices + 100.0, box.faces) == pytest.approx(6.0)
    assert signed_volume(box.vertices, box.faces[:, ::-1]) == pytest.approx(-6.0)
    # Of a torus of 40 x 20 flat faces, the prism of each section on its chord (Pappus).
    section = 0.5 * 20 * 0.4**2 * np.sin(2 * np.pi / 20)
    assert pytest.approx(section * 1.2 * 40 * np.sin(2 * np.pi / 40), rel=2e-3) == VOLUME


@pytest.mark.parametrize("ending", ["stl", "ply", "obj", "glb"])
def test_sound_meshes_of_every_format(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    trimesh.Trimesh(VERTICES, FACES, process=False).export(path)
    mesh = read_mesh(path)
    assert_whole(mesh, 1e-5)
    assert len(mesh.faces) == len(FACES)
    assert mesh.vertices_mm.mean(axis=0) == pytest.approx(VERTICES.mean(axis=0), abs=1e-5)
    if mesh.notices:  # a file that stores each triangle alone
        assert read_as(mesh).startswith(f"{3 * len(FACES) - len(VERTICES)} corners")


def test_faces_wound_the_other_way_are_turned():
    faces = FACES.copy()
    wrong = RNG.permutation(len(faces))[:60]
    faces[wrong] = faces[wrong][:, ::-1]
    mesh = mend(VERTICES, faces, "a.stl")
    assert_whole(mesh)
    assert read_as(mesh).startswith("60 of")
    assert_whole(mend(VERTICES, FACES[:, ::-1], "a.stl"))


def test_a_void_inside_keeps_its_sense_when_faces_are_turned():
    outer, inner = trimesh.creation.icosphere(2, 1.5), trimesh.creation.icosphere(2, 0.5)
    faces = np.vstack([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)])
    faces[:5] = faces[:5, ::-1]
    mesh = mend(np.vstack([outer.vertices, inner.vertices]), faces, "a.stl")
    assert signed_volume(mesh.vertices_mm, mesh.faces) == pytest.approx(outer.volume - inner.volume)


def test_corners_that_differ_by_rounding_are_joined():
    soup = VERTICES[FACES].reshape(-1, 3) + RNG.uniform(-4e-7, 4e-7, (3 * len(FACES), 3))
    mesh = mend(soup, np.arange(3 * len(FACES)).reshape(-1, 3), "a.stl")
    assert_whole(mesh, 1e-5)
    assert read_as(mesh).startswith(f"{3 * len(FACES) - len(VERTICES)} corners")
    assert len(mesh.vertices_mm) == len(VERTICES)


def test_corners_without_faces_do_not_count_to_the_size():
    mesh = mend(np.vstack([[[900.0, 0.0, 0.0]], VERTICES]), FACES + 1, "a.ply")
    assert_whole(mesh)
    assert mesh.notices == ()
    assert len(mesh.vertices_mm) == len(VERTICES)


def test_doubled_faces_count_once_and_touching_bodies_stay():
    mesh = mend(VERTICES, np.vstack([FACES, FACES[:9], FACES[20:23, ::-1]]), "a.stl")
    assert_whole(mesh)
    assert read_as(mesh).startswith("12 faces")
    one, two = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1))
    two.apply_translation([1, 0, 0])
    both = trimesh.util.concatenate(one, two)
    touching = mend(np.asarray(both.vertices), np.asarray(both.faces), "a.stl")
    assert signed_volume(touching.vertices_mm, touching.faces) == pytest.approx(2.0)


def with_hole(count=12):
    """The ring without the faces nearest to its outermost corner along x."""
    middle = VERTICES[FACES].mean(axis=1)
    place = VERTICES[np.argmax(VERTICES[:, 0])]
    away = np.linalg.norm(middle - place, axis=1)
    return np.delete(FACES, np.argsort(away)[:count], axis=0), place


def test_a_hole_is_refused_with_its_place_or_closed_when_asked():
    faces, place = with_hole()
    with pytest.raises(StapeskitError) as caught:
        mend(VERTICES, faces, "a.stl")
    fault = caught.value.faults[0]
    assert fault.got.startswith("1 hole (")
    named = [float(word) for word in fault.got.split(" at ")[1].split(" mm")[0].split(", ")]
    assert named == pytest.approx(place, abs=0.15)
    assert "--close" in fault.next_step
    mesh = mend(VERTICES, faces, "a.stl", close=True)
    assert_whole(mesh, 5e-3)
    assert "--close" in read_as(mesh)


def test_a_closed_hole_is_in_the_budget():
    """A ball without a cap: the flat cap misses a dome, which a surface that bends on evenly would add."""
    ball = trimesh.creation.uv_sphere(1.5, count=[64, 64])
    for height in (1.3, 1.0):
        faces = ball.faces[ball.triangles_center[:, 2] < height]
        moments = mend(ball.vertices, faces, "a.stl", close=True).moments()
        assert set(moments.contributions) == {"border"}
        missing = ball.volume - moments.volume_mm3
        assert moments.volume_sd_mm3 == pytest.approx(missing, rel=0.3)  # the rims are ragged


@pytest.mark.parametrize("half", [0, 1, 2])
def test_a_body_that_is_cut_off_is_refused(half):
    """A flat cap on half a ring is as smooth as the ring: nothing shows how much is missing."""
    faces = FACES[(VERTICES[FACES].mean(axis=1) - VERTICES.mean(axis=0))[:, half] < 0.05]
    with pytest.raises(StapeskitError) as caught:
        mend(VERTICES, faces, "a.stl", close=True)
    assert "cut off" in caught.value.faults[0].got


def halves_of_a_box(reach):
    """Half of a box from one mesh, half from another, each with one end and sides to ``reach``."""
    box = trimesh.creation.box((3.0, 1.0, 1.0)).subdivide().subdivide()
    middle = box.triangles_center[:, 0]
    left, right = box.faces[middle < reach], box.faces[middle > -reach]
    vertices = np.vstack([box.vertices, box.vertices * [1.0, 1.001, 1.001]])
    return vertices, np.vstack([left, right + len(box.vertices)])


def test_open_pieces_are_measured_by_their_winding_number():
    """Halves that overlap enclose the box; between halves with a gap, what is missing is in the budget."""
    mesh = mend(*halves_of_a_box(0.3), "a.stl", close=True)
    assert open_walks(mesh.faces) == 0
    assert mesh.moments().volume_mm3 == pytest.approx(3.0, rel=0.05)
    assert mesh.moments().volume_sd_mm3 < 0.05
    assert "--close" in read_as(mesh)
    moments = mend(*halves_of_a_box(-0.4), "a.stl", close=True).moments()
    assert abs(moments.volume_mm3 - 3.0) < 2.5 * moments.volume_sd_mm3
    assert moments.volume_sd_mm3 < 1.0


def test_pieces_that_enclose_nothing_are_refused():
    vertices, faces = halves_of_a_box(-1.2)
    with pytest.raises(StapeskitError):
        mend(vertices, faces, "a.stl", close=True)


def test_the_winding_number_is_one_inside_and_zero_outside():
    points = VERTICES.mean(axis=0) + RNG.uniform(-1.7, 1.7, (400, 3)) * [1, 1, 0.4]
    away = points - VERTICES.mean(axis=0)
    depth = 0.4 - np.hypot(np.hypot(away[:, 0], away[:, 1]) - 1.2, away[:, 2])
    number = winding_number(VERTICES, FACES, points)
    clear = np.abs(depth) > 0.02
    assert number[clear] == pytest.approx((depth[clear] > 0).astype(float), abs=0.05)


EMPTY = [b"", b"solid x\nendsolid x\n", b"ply\nformat ascii 1.0\n", bytes(84), b"glTF" + bytes(40)]


@pytest.mark.parametrize("content", EMPTY)
def test_files_that_are_no_meshes(tmp_path, content):
    for ending in ("stl", "ply", "obj", "glb"):
        path = tmp_path / f"a.{ending}"
        path.write_bytes(content)
        with pytest.raises(StapeskitError) as caught:
            read_mesh(path)
        assert caught.value.faults[0].where == path.name
    for path in (tmp_path / "none.stl", tmp_path):
        with pytest.raises(StapeskitError):
            read_mesh(path)


@pytest.mark.parametrize("ending", ["stl", "ply", "obj", "glb"])
def test_damaged_meshes_give_a_mesh_or_one_error(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    trimesh.creation.icosphere(1, 1.5).export(path)
    whole = path.read_bytes()
    for seed in range(6):
        rng = np.random.default_rng(seed)
        content = bytearray(whole)
        for _ in range(3):
            place = int(rng.integers(min(len(content), 300 if rng.random() < 0.5 else len(content))))
            content[place : place + 2] = rng.integers(0, 256, 2).astype("u1").tobytes()
        path.write_bytes(content[: int(rng.integers(len(content)))] if seed % 5 == 0 else content)
        try:
            mesh = read_mesh(path)
        except StapeskitError:
            continue
        assert signed_volume(mesh.vertices_mm, mesh.faces) > 0.0
