"""Points on a surface: nearest points exact, the pose found from anywhere, its covariance true."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from legacy.kinematics.registration.icp import fit_to_surface
from legacy.kinematics.registration.icp_refine import Cloud
from legacy.kinematics.registration.mesh_distance import TriangleSurface
from legacy.kinematics.registration.surface_points import mirrored, read_surface_points
from legacy.stapeskit.alignment.registration import displacement
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector
from tests.kinematics.surfaces import box, on_faces, wedge

WEDGE = wedge()
UP = np.array([0.3, 0.9, 0.3])


def pose_of(seed):
    rng = np.random.default_rng([seed, 3])
    return RigidTransform.from_parts(
        rotation_from_vector(rng.uniform(-1.8, 1.8, 3)), rng.uniform(-40.0, 40.0, 3), "scan", "vibrometer"
    )


def measured(surface, seed, count=40, sd=0.01, **more):
    """Return a cloud on a surface as the vibrometer sees it, its true pose, and the way to the heads."""
    rng = np.random.default_rng([seed, 11])
    pose = pose_of(seed)
    seen = pose.inverse().points(on_faces(surface, rng, count, **more)) + sd * rng.normal(size=(count, 3))
    names = tuple(str(place) for place in range(count))
    towards = pose.inverse().vectors(UP / np.linalg.norm(UP))
    return Cloud(names, seen, np.full(count, sd) if sd else None), pose, towards


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_nearest_points_are_those_of_a_search_through_all_triangles(seed):
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(60, 3)) * [1.0, 1.0, 0.1]
    faces = rng.integers(0, 60, (80, 3))
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])]
    surface = TriangleSurface(vertices, faces)
    points = 2.0 * rng.normal(size=(15, 3))
    near, distance, triangle = surface.closest(points)
    corners = surface.vertices_mm[surface.faces]
    for k, point in enumerate(points):
        every = trimesh.triangles.closest_point(corners, np.tile(point, (len(corners), 1)))
        assert distance[k] == pytest.approx(np.min(np.linalg.norm(every - point, axis=1)), abs=1e-12)
        assert np.allclose(every[triangle[k]], near[k], atol=1e-9)


def test_no_point_of_the_surface_is_nearer_than_the_nearest():
    surface = box([0, 0, 0], [1, 2, 3])
    points = 2.0 * np.random.default_rng(5).normal(size=(200, 3))
    _, distance, _ = surface.closest(points)
    samples, _ = surface.samples(4000)
    other = np.linalg.norm(samples[None] - points[:, None], axis=2).min(axis=1)
    assert np.all(distance <= other + 1e-12)
    assert np.median(other - distance) < 0.1


def test_distances_outside_are_positive():
    surface = box([0, 0, 0], [1, 2, 3])
    signed, normal, _ = surface.signed(np.array([[0.5, 1.0, 3.2], [0.5, 1.0, 2.9], [1.3, 1.0, 1.0]]))
    assert np.allclose(signed, [0.2, -0.1, 0.3])
    assert np.allclose(normal, [[0, 0, 1], [0, 0, 1], [1, 0, 0]])


@pytest.mark.parametrize("seed", range(4))
def test_the_pose_is_found_from_anywhere(seed):
    cloud, pose, towards = measured(WEDGE, seed)
    fit = fit_to_surface(cloud, WEDGE, towards=towards)
    error = displacement(fit.registration.transform, pose)
    assert error @ np.linalg.solve(fit.registration.covariance_si, error) < 25.0
    assert np.linalg.det(fit.registration.transform.rotation) == pytest.approx(1.0)
    assert np.all(fit.near)
    assert not fit.unseen


def test_covariance_chi2_and_target_error_hold():
    """Monte Carlo of the noise of 60 points, from a first guess that is too weak to count."""
    distances, chi2, free, misses, said = [], [], [], [], []
    for seed in range(40):
        cloud, pose, _ = measured(WEDGE, seed, 60)
        guess = (pose.perturbed([1e-4, -1e-4, 1e-4, 1e-3, -2e-3, 1e-3]), np.diag([1.0] * 3 + [10.0] * 3))
        fit = fit_to_surface(cloud, WEDGE, guess=guess, surface_sd_mm=0.0).registration
        error = displacement(fit.transform, pose)
        distances.append(error @ np.linalg.solve(fit.covariance_si, error))
        chi2.append(fit.chi2)
        free.append(fit.n_dof - 6)
        target = pose.inverse().points([[0.0, 1.0, 0.0]])
        misses.append(np.linalg.norm(fit.transform.points(target) - [[0.0, 1.0, 0.0]]))
        said.append(fit.target_registration_error(target)[0])
    assert np.mean(distances) / 6.0 == pytest.approx(1.0, abs=0.25)
    assert np.mean(chi2) == pytest.approx(np.mean(free), rel=0.1)
    assert np.sqrt(np.mean(np.square(misses))) == pytest.approx(np.mean(said), rel=0.15)


def test_outliers_are_left_out_and_named():
    cloud, pose, towards = measured(WEDGE, 2)
    off = cloud.points_mm.copy()
    off[[5, 17]] += pose.inverse().vectors([[0.0, 0.3, 0.0], [0.0, 0.5, 0.0]])
    fit = fit_to_surface(Cloud(cloud.names, off, cloud.sd_mm), WEDGE, towards=towards)
    assert set(np.flatnonzero(~fit.near)) <= {5, 17}
    text = next(n.text for n in fit.registration.notices if n.code == "surface_points_off")
    assert "17 (+" in text
    error = displacement(fit.registration.transform, pose)
    assert error @ np.linalg.solve(fit.registration.covariance_si, error) < 25.0


def test_noise_is_estimated_when_not_stated():
    cloud, _, towards = measured(WEDGE, 3, 200, 0.02)
    fit = fit_to_surface(Cloud(cloud.names, cloud.points_mm), WEDGE, towards=towards).registration
    assert fit.sd_mm[0] == pytest.approx(0.02, rel=0.2)
    assert np.isnan(fit.chi2)


def test_half_turns_of_a_box_are_refused_or_told_apart_by_other_points():
    plate = box([-2.1, -1.0, -1.4], [2.1, 0.0, 1.4])
    cloud, pose, towards = measured(plate, 1, 60)
    with pytest.raises(StapeskitError, match=r"one placement fits best; got 4 that fit alike.*180 degrees"):
        fit_to_surface(cloud, plate, towards=towards)
    stapes = box([0.3, 0.5, -0.4], [1.9, 3.0, 0.2])
    known = pose.inverse().points(on_faces(stapes, np.random.default_rng(8), 8))
    fit = fit_to_surface(cloud, plate, towards=towards, witnesses=[(known, stapes)]).registration
    error = displacement(fit.transform, pose)
    assert error @ np.linalg.solve(fit.covariance_si, error) < 25.0
    assert fit.notices[0].code == "registration_ambiguous"


@pytest.mark.parametrize(
    ("sides", "match"),
    [
        (((1, 1.0),), "a slide along x of the scan; a slide along z of the scan"),
        (((1, 1.0), (0, 1.0)), "points that leave open: a slide along z of the scan"),
    ],
)
def test_slides_that_the_points_leave_open_are_named(sides, match):
    plate = box([-2.1, -1.0, -1.4], [2.1, 0.0, 1.4])
    cloud, pose, towards = measured(plate, 4, 60, sides=sides)
    stapes = box([0.3, 0.5, -0.4], [1.9, 3.0, 0.2])
    known = pose.inverse().points(on_faces(stapes, np.random.default_rng(8), 8))
    with pytest.raises(StapeskitError, match=r"leave open|fit alike") as told:
        fit_to_surface(cloud, plate, towards=towards, witnesses=[(known, stapes)])
    guess = (pose.perturbed([2e-5, 1e-5, 2e-5, 1e-3, 0.0, 1e-3]), np.diag([4e-10] * 3 + [4e-6] * 3))
    fit = fit_to_surface(cloud, plate, guess=guess)
    assert "unobservable" in [notice.code for notice in fit.registration.notices]
    if "leave open" in str(told.value):
        assert match.split(": ")[-1].split(";")[0] in str(told.value)
    assert match.split(": ")[-1].split(";")[0] in "; ".join(fit.unseen)
    sd = np.sqrt(np.diag(pose.rotation @ fit.registration.target_covariance(cloud.points_mm[:1])[0]
                         @ pose.rotation.T))  # fmt: skip
    assert np.all(np.isfinite(sd))


def test_a_guess_counts_by_its_covariance():
    """Joint estimate of points and guess: errors of both, many times."""
    rng = np.random.default_rng(6)
    plate = box([-2.1, -1.0, -1.4], [2.1, 0.0, 1.4])
    spread = np.array([2e-5] * 3 + [5e-3] * 3)
    distances = []
    for seed in range(40):
        cloud, pose, _ = measured(plate, seed, 40, sides=((1, 1.0),))
        guess = (pose.perturbed(spread * rng.normal(size=6)), np.diag(spread**2))
        cloud = Cloud(cloud.names, cloud.points_mm, cloud.sd_mm)
        fit = fit_to_surface(cloud, plate, guess=guess, surface_sd_mm=0.0).registration
        error = displacement(fit.transform, pose)
        distances.append(error @ np.linalg.solve(fit.covariance_si, error))
    assert np.mean(distances) / 6.0 == pytest.approx(1.0, abs=0.25)


def test_mirrored_coordinates_are_refused():
    cloud, _, _ = measured(WEDGE, 5, 80)
    flipped = mirrored(cloud, "y")
    with pytest.raises(StapeskitError, match=r"fit only as a mirror image|fit alike|that fit, "):
        fit_to_surface(flipped, WEDGE)


@pytest.mark.parametrize(
    ("factor", "match"),
    [(1e-3, "vibrometer coordinates seem to be in m"), (1e3, "vibrometer coordinates seem to be in um")],
)
def test_other_units_are_refused(factor, match):
    cloud, _, towards = measured(WEDGE, 0)
    with pytest.raises(StapeskitError, match=match):
        fit_to_surface(Cloud(cloud.names, factor * cloud.points_mm), WEDGE, towards=towards)


def test_impossible_clouds_are_refused():
    cloud, _, _ = measured(WEDGE, 0)
    with pytest.raises(StapeskitError, match="the plate points must be at least 7"):
        fit_to_surface(Cloud(cloud.names[:5], cloud.points_mm[:5]), WEDGE)
    with pytest.raises(StapeskitError, match="finite"):
        fit_to_surface(Cloud(cloud.names, cloud.points_mm * np.nan), WEDGE)
    with pytest.raises(StapeskitError, match="made of triangles with finite corners"):
        TriangleSurface(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    lost = np.random.default_rng(3).normal(size=(40, 3))
    with pytest.raises(StapeskitError, match=r"the plate points .*must be"):
        fit_to_surface(Cloud(cloud.names, lost, cloud.sd_mm), WEDGE)


def test_surface_points_are_read(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text(
        "body,point,x_mm,y_mm,z_mm,sd_mm\nstapes,1,0,0,0,\nplate,a,1,2,3,0.01\nPlate,b,4,5,6,0.02\n"
    )
    cloud = read_surface_points(path, "plate")
    assert cloud.names == ("a", "b")
    assert cloud.points_mm.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.sd_mm.tolist() == [0.01, 0.02]
    path.write_text("x_mm,y_mm,z_mm\n1,2,3\n4,5,6\n")
    assert read_surface_points(path, "bone").names == ("line 2", "line 3")
    assert mirrored(cloud, "z").points_mm[0].tolist() == [1, 2, -3]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("x_mm,y_mm\n1,2\n", "no column z_mm"),
        ("x_mm,y_mm,z_mm\n1,2,a\n", r'z_mm must be a number; got "a" \(points.csv, line 2\)'),
        ("x_mm,y_mm,z_mm\n1,2,\n", r"z_mm must be a finite number.*line 2"),
        (
            "name,x_mm,y_mm,z_mm\na,1,2,3\na,1,2,4\n",
            "name of a point must be given, and different; got a again",
        ),
        ("x_mm,y_mm,z_mm,sd_mm\n1,2,3,0.1\n1,2,4,\n", "stated for all points or for none"),
        ("x_mm,y_mm,z_mm,sd_mm\n1,2,3,-1\n", "sd_mm must be positive"),
        ("body,x_mm,y_mm,z_mm\nstapes,1,2,3\n", "body must be plate in some rows; got stapes"),
    ],
)
def test_faulty_surface_points_are_named(tmp_path, text, match):
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(StapeskitError, match=match):
        read_surface_points(path, "plate")
