"""The surface shown and exported: lighter and calmer, closed, and with its price told."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from legacy.ct_inertia.cli import work
from legacy.ct_inertia.ct2mass import ct2mass
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.mass.mass_properties import footplate_mass_matrix, from_density
from legacy.ct_inertia.options import MassOptions
from legacy.ct_inertia.surface.display_surface import check_request, display_mesh
from legacy.ct_inertia.surface.surface import read_surface, write_surface
from legacy.stapeskit.frames import RigidTransform
from tests.ct_inertia.shapes import moved, stapes

FAR = (40.0, -25.0, 60.0)


@pytest.fixture(scope="module")
def surface():
    return moved(stapes(0.05), np.eye(3), FAR)


def test_thinning_reaches_the_number_and_stays_closed_with_its_hole(surface):
    made = display_mesh(surface, faces=3000)
    assert len(made.surface.faces) == pytest.approx(3000, rel=0.01)
    assert made.surface.euler_characteristic == surface.euler_characteristic == 0
    assert made.surface.volume_mm3 == pytest.approx(surface.volume_mm3, rel=0.02)
    assert np.allclose(made.surface.vertices_mm.mean(axis=0), FAR, atol=3.0)


def test_smoothing_keeps_the_faces(surface):
    made = display_mesh(surface, smooth=10)
    assert np.array_equal(made.surface.faces, surface.faces)
    assert not np.array_equal(made.surface.vertices_mm, surface.vertices_mm)


def test_each_step_tells_its_own_change(surface):
    both = display_mesh(surface, smooth=30, faces=1500)
    smoothed = display_mesh(surface, smooth=30)
    assert [step.name for step in both.steps] == ["smooth", "faces"]
    for step, before, after in zip(
        both.steps, (surface, smoothed.surface), (smoothed.surface, both.surface), strict=True
    ):
        old, new = before.moments(), after.moments()
        assert step.mass_change == pytest.approx(new.volume_mm3 / old.volume_mm3 - 1.0, rel=1e-9)
        assert np.allclose(step.center_of_mass_change_mm, new.centroid_mm - old.centroid_mm, atol=1e-12)
        # the matrix of both about the old centre of mass, by the library's own way to a mass matrix
        pose = np.eye(4)
        pose[:3, 3] = old.centroid_mm
        frame = RigidTransform(pose, "scan", "footplate")
        first, second = (
            footplate_mass_matrix(from_density(m, 1900.0, None), frame, np.zeros((6, 6))).matrix
            for m in (old, new)
        )
        root = np.sqrt(np.diag(first))
        assert step.matrix_change == pytest.approx(
            np.max(np.abs(second - first) / np.outer(root, root)), rel=1e-6
        )
    assert abs(both.steps[0].mass_change) > 1e-5


def test_nothing_asked_changes_nothing(surface):
    made = display_mesh(surface, smooth=0, faces=10**9)
    assert made.surface is surface
    assert made.steps == ()


@pytest.mark.parametrize(
    ("smooth", "faces", "message"),
    [(-1, None, "--smooth must be from 0 to 500"), (None, 12, "--faces must be at least 100; got 12")],
)
def test_impossible_requests_are_told(smooth, faces, message):
    with pytest.raises(CtInertiaError, match=message):
        check_request(smooth, faces)


def test_a_missing_pymeshlab_is_refused_before_any_work(monkeypatch, tmp_path):
    scan = tmp_path / "scan.tif"
    scan.write_bytes(b"not looked at")
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    with pytest.raises(CtInertiaError) as caught:
        work([str(scan), "--density", "1900", "--faces", "5000"])
    (fault,) = caught.value.faults
    assert fault.thing == "{faces}"
    assert "pymeshlab" in fault.next_step
    check_request(None, None)


def test_the_command_shows_it_and_measures_the_other(surface, tmp_path):
    path = tmp_path / "s.ply"
    write_surface(path, surface)
    words = f"{path} --density 1900 --anterior 1,0,0 --no-report --out {tmp_path / 'o'}".split()
    plain = ct2mass(MassOptions(path, density=(1900.0, None), anterior=(1.0, 0.0, 0.0)))
    given = work([*words, "--smooth", "20", "--faces", "2000", "--export", "stl"])[1]
    assert given.result["mass_kg"] == plain.body.mass_kg
    assert len(read_surface(tmp_path / "o" / "stapes.ply").faces) == len(surface.faces)
    for name in ("stapes_display.ply", "stapes.stl"):
        assert len(read_surface(tmp_path / "o" / name).faces) == pytest.approx(2000, rel=0.01)
    told = given.result["display_mesh"]["steps"]
    assert [step["step"] for step in told] == ["smooth", "faces"]
    assert given.result["exports"] == {"stl": {"length": "mm", "coordinates": "scan"}}
    table = dict(given.rows)
    assert f"{told[0]['mass_change_percent']:+.3f} %" in table["display: smooth 20"]
    written = sorted(path.name for path in given.files)
    assert [".stapeskit", *written] == sorted(path.name for path in (tmp_path / "o").iterdir())
