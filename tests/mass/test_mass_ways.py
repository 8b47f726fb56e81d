"""Mass properties: identities, three ways to a mass, calibration in closed form, scale, published sizes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ct_inertia.bodies import Moments
from ct_inertia.mass.calibration import Calibration, from_calibration, read_calibration
from ct_inertia.mass.properties import from_density, from_mass, point_masses
from ct_inertia.mass.sizes import PUBLISHED, check_mesh, impossible, unusual_notice
from ct_inertia.mass.ways import MassByWay, disagreements, masses_by_way, not_stated
from ct_inertia.options import ASSUMED_DENSITY
from ct_inertia.surface.surface import Surface
from simulate import Stapes, ellipsoid, point_mass, stapes_solid, uniform_mass
from simulate.solids import joined
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform, rotation_from_vector
from stapeskit.option_types import WithSd
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.spatial import matrix_from_parameters

POSE = RigidTransform.from_parts(
    rotation_from_vector([0.4, -0.9, 1.3]), [31.0, -12.0, 57.0], "scan", "footplate"
)
SOLID = stapes_solid(Stapes())
NO_ERROR = np.zeros((6, 6))


def moments_of(pose: RigidTransform = POSE, contributions: bool = False) -> Moments:
    exact = SOLID.moved(pose).moments()
    parts = {}
    if contributions:
        spread = np.random.default_rng(4).standard_normal((10, 10)) * 1e-3
        parts = {"noise": spread @ spread.T, "levels": np.diag(np.full(10, 1e-6))}
    return Moments(exact.volume_mm3, exact.centroid_mm, exact.second_mm5, parts)


def test_the_mass_matrix_is_the_exact_one_wherever_the_body_lies() -> None:
    exact = uniform_mass(SOLID.moments(), 1900.0).matrix()
    for pose in (POSE, RigidTransform.identity("scan", "footplate")):
        matrix = from_density(moments_of(pose), 1900.0, None).mass_matrix(pose, NO_ERROR).matrix
        root = np.sqrt(np.diag(exact))
        assert np.max(np.abs(matrix - exact) / np.outer(root, root)) < 1e-9


def test_the_covariance_is_that_of_finite_differences() -> None:
    moments = moments_of(contributions=True)
    vector = moments.vector()

    def parameters(values: np.ndarray, mass_kg: float | None) -> np.ndarray:
        volume, centre, second = values[0], values[1:4], values[4:]
        tensor = np.zeros((3, 3))
        for value, (i, j) in zip(second, ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2)), strict=True):
            tensor[i, j] = tensor[j, i] = value
        moved = Moments(volume, centre, tensor)
        body = from_density(moved, 1900.0, None) if mass_kg is None else from_mass(moved, mass_kg, None)
        return body.mass_matrix(POSE, NO_ERROR).parameters

    for mass_kg in (None, 4.2e-6):
        steps = []
        for k in range(10):
            step = np.zeros(10)
            step[k] = 1e-5
            steps.append((parameters(vector + step, mass_kg) - parameters(vector - step, mass_kg)) / 2e-5)
        jacobian = np.column_stack(steps)
        body = from_density(moments, 1900.0, None) if mass_kg is None else from_mass(moments, mass_kg, None)
        matrix = body.mass_matrix(POSE, NO_ERROR)
        for source in ("noise", "levels"):
            expected = jacobian @ moments.contributions[source] @ jacobian.T
            root = np.sqrt(np.diag(expected)) + 1e-9 * np.abs(matrix.parameters)
            assert np.max(np.abs(matrix.contributions[source] - expected) / np.outer(root, root)) < 1e-5


def test_a_density_and_the_mass_that_it_gives_agree() -> None:
    moments = moments_of(contributions=True)
    by_density = from_density(moments, 1900.0, 60.0)
    by_mass = from_mass(moments, by_density.mass_kg, 0.01 * by_density.mass_kg)
    np.testing.assert_allclose(by_mass.parameters, by_density.parameters, rtol=1e-12)
    assert by_mass.contributions["noise"][0, 0] < 1e-9 * by_density.contributions["noise"][0, 0]
    share = np.sqrt(by_density.contributions["density"][0, 0]) / by_density.mass_kg
    assert share == pytest.approx(60.0 / 1900.0)


def test_added_masses_enter_as_points() -> None:
    place = POSE.points([0.3, 2.1, -0.4])
    added = point_masses([(*place, 0.5, 0.05)])
    body = from_density(moments_of(), 1900.0, None).with_added(added)
    exact = uniform_mass(SOLID.moments(), 1900.0).matrix()
    exact = exact + matrix_from_parameters(point_mass(0.5e-6, (0.3, 2.1, -0.4)))
    matrix = body.mass_matrix(POSE, NO_ERROR)
    root = np.sqrt(np.diag(exact))
    assert np.max(np.abs(matrix.matrix - exact) / np.outer(root, root)) < 1e-9
    expected = 0.1 * point_mass(0.5e-6, (0.3, 2.1, -0.4))
    np.testing.assert_allclose(
        np.sqrt(np.diag(matrix.contributions["added_mass"])), np.abs(expected), rtol=1e-9
    )


@pytest.mark.parametrize("by", ["density", "mass"])
def test_the_budget_holds_what_larger_voxels_do(by: str) -> None:
    def body(scale: float, sd: float | None = None) -> MassMatrix:
        exact = SOLID.moments()
        moments = Moments(exact.volume_mm3 * scale**3, exact.centroid_mm * scale, exact.second_mm5 * scale**5)
        found = from_density(moments, 1900.0, None) if by == "density" else from_mass(moments, 4.4e-6, None)
        return found.mass_matrix(RigidTransform.identity("scan", "footplate"), NO_ERROR, sd)

    small = body(1.0, 1e-4).contributions["voxel_size"]
    slope = (body(1.0 + 1e-6).parameters - body(1.0).parameters) / 1e-6
    np.testing.assert_allclose(np.sqrt(np.diag(small)), np.abs(slope) * 1e-4, rtol=1e-4, atol=1e-30)


def test_a_calibration_weighs_two_bones_of_one_body() -> None:
    """Half of a bar has 1800, the other 2200 kg/m3: the line weighs each where it lies."""
    line = Calibration(slope_kg_m3=0.1, intercept_kg_m3=-800.0)  # air at 8000 has no density
    air, bone = 8000.0, 28000.0  # 2000 kg/m3
    half = np.array([0.9, 1.1])  # grey over the mean bone, above air
    volume, width = 2.0, 0.1
    centres = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    own = np.diag([1.0 / 12.0, width, width])
    grey_volume = float(half.sum())
    grey_centre = half @ centres / grey_volume
    away = centres - grey_centre
    grey_second = sum(h * (own + np.outer(a, a)) for h, a in zip(half, away, strict=True))
    shape_second = sum(own + np.outer(c, c) for c in centres)
    grey = Moments(grey_volume, grey_centre, grey_second)
    shape = Moments(volume, np.zeros(3), shape_second)
    body = from_calibration(grey, shape, air, bone, line)
    masses = np.array([1800.0, 2200.0]) * 1e-9
    assert body.mass_kg == pytest.approx(masses.sum())
    assert body.density_kg_m3 == pytest.approx(2000.0)
    np.testing.assert_allclose(body.com_mm, masses @ centres / masses.sum(), atol=1e-12)
    arm = centres - body.com_mm
    tensor = sum(
        m * (np.trace(own) * np.eye(3) - own + a @ a * np.eye(3) - np.outer(a, a)) * 1e-6
        for m, a in zip(masses, arm, strict=True)
    )
    np.testing.assert_allclose(body.parameters[4:7], np.diag(tensor), rtol=1e-9)


def test_a_line_with_an_offset_in_air_weighs_the_shape() -> None:
    exact = SOLID.moments()
    moments = Moments(exact.volume_mm3, exact.centroid_mm, exact.second_mm5)
    line = Calibration(slope_kg_m3=0.05, intercept_kg_m3=500.0, sd_kg_m3=30.0)
    body = from_calibration(moments, moments, 8000.0, 28000.0, line)
    uniform = from_density(moments, line.density(28000.0), None)
    np.testing.assert_allclose(body.parameters, uniform.parameters, rtol=1e-9, atol=1e-25)
    sd = np.sqrt(body.contributions["calibration"][0, 0])
    assert sd / body.mass_kg == pytest.approx(30.0 / line.density(28000.0))


@pytest.mark.parametrize(
    ("text", "slope", "intercept"),
    [
        ("points = [[2000, 0], [20000, 1800]]", 0.1, -200.0),
        (
            "points_mg_ha_cm3 = [[1000, 0], [2000, 500], [3000, 1000]]\nkg_m3_at_zero = 1000\n"
            "kg_m3_per_mg_ha_cm3 = 0.8",
            0.4,
            600.0,
        ),
    ],
)
def test_calibration_files_give_their_line(tmp_path: Path, text: str, slope: float, intercept: float) -> None:
    path = tmp_path / "c.toml"
    path.write_text(text)
    line = read_calibration(path)
    assert line.slope_kg_m3 == pytest.approx(slope)
    assert line.intercept_kg_m3 == pytest.approx(intercept)


@pytest.mark.parametrize(
    ("text", "thing"),
    [
        ("", "--calibration"),
        ("points = [[1, 2]]", "the calibration points"),
        ("points = [[1, 2], [1, 3]]", "the calibration points"),
        ("points = [[1, 20], [2, 3]]", "the calibration line"),
        ("points = [[1, 2], [2, inf]]", "the calibration points"),
        ("pionts = [[1, 2], [2, 3]]", "pionts"),
        ("points_mg_ha_cm3 = [[1, 2], [2, 3]]", "kg_m3_at_zero"),
        ("points = [[1, 2], [2, 3]]\nsd_kg_m3 = -1", "sd_kg_m3"),
        ("points = [[1, 2], [2, 3]]\nsd_kg_m3 = true", "sd_kg_m3"),
        ("points = [[", "the file"),
    ],
)
def test_wrong_calibrations_are_refused(tmp_path: Path, text: str, thing: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(text)
    with pytest.raises(StapeskitError) as error:
        read_calibration(path)
    assert error.value.faults[0].thing == thing


def ways_of(density: WithSd | None, mass_mg: WithSd | None) -> list[MassByWay]:
    found = masses_by_way(moments_of(), density, mass_mg, None, None)
    return [MassByWay(way, body, body.mass_matrix(POSE, NO_ERROR)) for way, body in found.items()]


def test_the_balance_leads_and_a_density_is_assumed_where_nothing_is_given() -> None:
    assert [way.way for way in ways_of(WithSd(1900.0, 60.0), WithSd(4.4, 0.05))] == ["mass", "density"]
    (alone,) = ways_of(None, None)
    assert alone.body.density_kg_m3 == ASSUMED_DENSITY.value
    assert alone.stated


def test_ways_that_differ_beyond_their_sd_are_reported() -> None:
    near = ways_of(WithSd(1900.0, 60.0), WithSd(4.4, 0.05))
    far = ways_of(WithSd(1900.0, 60.0), WithSd(3.4, 0.05))
    vague = ways_of(WithSd(1900.0), WithSd(4.55, 0.001))
    assert not disagreements(near)
    assert [notice.code for notice in disagreements(far)] == ["masses_disagree"]
    assert not disagreements(vague)


@pytest.mark.parametrize(
    ("density", "mass", "option"),
    [(WithSd(1900.0), None, "--density RHO+-SD"), (None, WithSd(4.4), "--mass-mg M+-SD")],
)
def test_a_missing_sd_is_reported(density: WithSd | None, mass: WithSd | None, option: str) -> None:
    (notice,) = not_stated(ways_of(density, mass)[0])
    assert notice.code == "density_sd_not_given"
    assert option in notice.text


def test_a_mass_that_no_bone_of_this_volume_has_is_refused() -> None:
    with pytest.raises(StapeskitError):
        masses_by_way(moments_of(), None, WithSd(44.0), None, None)


def test_a_calibration_needs_grey_values() -> None:
    with pytest.raises(StapeskitError) as error:
        masses_by_way(moments_of(), None, None, Calibration(0.1, 0.0), None)
    assert error.value.faults[0].thing == "--calibration"


def test_published_means_are_usual_and_three_sd_are_not() -> None:
    means = {entry.quantity: entry.mean for entry in PUBLISHED if entry.sd}
    assert not unusual_notice(means)
    assert not impossible({key: means[key] for key in means})
    # 3.02 ± 0.73 mg over 1750 ± 260 kg/m3
    mean = 3.02 / 1.75
    sd = mean * np.hypot(0.725 / 3.02, 260.0 / 1750.0)
    assert unusual_notice({"volume_mm3": mean + 3.1 * sd})
    assert not unusual_notice({"volume_mm3": mean + 2.9 * sd})
    assert not unusual_notice({"volume_mm3": SOLID.moments().volume_mm3})
    assert impossible({**means, "height_mm": 9.0})


def mesh_of(scale: float = 1.0) -> Surface:
    return Surface(SOLID.vertices_mm * scale, SOLID.faces)


@pytest.mark.parametrize(("scale", "unit"), [(1e-3, "metres"), (1e3, "micrometres"), (0.1, "centimetres")])
def test_a_mesh_in_another_unit_is_refused(scale: float, unit: str) -> None:
    with pytest.raises(StapeskitError) as error:
        check_mesh(mesh_of(scale), "a.stl")
    assert unit in error.value.faults[0].got


@pytest.mark.parametrize("sense", [1, -1])
def test_a_mesh_of_two_bodies_is_refused(sense: int) -> None:
    """Also where the other one is wound the other way, as a cavity is: it lies outside."""
    ball = ellipsoid([4.0, 0.0, 0.0], [0.3, 0.3, 0.3])
    both = joined(SOLID, Surface(ball.vertices_mm, ball.faces[:, ::sense]))
    with pytest.raises(StapeskitError) as error:
        check_mesh(Surface(both.vertices_mm, both.faces), "a.stl")
    assert error.value.faults[0].expected == "one closed body, the stapes"
