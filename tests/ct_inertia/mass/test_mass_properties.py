"""Mass properties and mass matrices against closed forms, identities and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.anatomy import AnatomyHints
from legacy.ct_inertia.frames.footplate import footplate_frame
from legacy.ct_inertia.mass.calibration import Calibration, from_calibration, read_calibration
from legacy.ct_inertia.mass.mass_properties import (
    PointMass,
    footplate_mass_matrix,
    from_density,
    from_mass,
    plate_axes_mass_matrix,
    with_added,
)
from legacy.ct_inertia.surface.moments import Moments
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector
from tests.ct_inertia.shapes import box, moved, stapes

SIDES = np.array([3.0, 0.4, 1.4])
DENSITY = 1900.0
MASS = DENSITY * 3.0 * 0.4 * 1.4 * 1e-9
NO_FRAME_ERROR = np.zeros((6, 6))


def about_lower_face(mass, a, b, c):
    """6x6 of a box of sides a, b, c (m) about the middle of its lower face (y = -b/2), in its own axes."""
    matrix = np.diag(
        [mass] * 3
        + [
            mass * (b * b / 3.0 + c * c / 12.0),
            mass * (a * a + c * c) / 12.0,
            mass * (a * a / 12.0 + b * b / 3.0),
        ]
    )
    first = mass * b / 2.0
    matrix[0, 5] = matrix[5, 0] = -first
    matrix[2, 3] = matrix[3, 2] = first
    return matrix


def scaled_difference(one, other):
    root = np.sqrt(np.diag(other))
    return np.max(np.abs(one - other) / np.outer(root, root))


def lower_face(rotation=None, shift=(0.0, 0.0, 0.0)):
    rotation = np.eye(3) if rotation is None else rotation
    return RigidTransform.from_parts(rotation, rotation @ [0.0, -0.2, 0.0] + shift, "scan", "footplate")


class TestABox:
    @settings(max_examples=20, deadline=None)
    @given(st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.tuples(*[st.floats(-20.0, 20.0)] * 3))
    def test_has_the_matrix_of_a_box_in_any_pose(self, vector, shift):
        rotation = rotation_from_vector(vector)
        body = from_density(moved(box(SIDES), rotation, shift).moments(), DENSITY, None)
        matrix = footplate_mass_matrix(body, lower_face(rotation, np.array(shift)), NO_FRAME_ERROR)
        assert scaled_difference(matrix.matrix, about_lower_face(MASS, *SIDES * 1e-3)) < 1e-9
        assert body.mass_kg == pytest.approx(MASS, rel=1e-12)

    def test_first_moments_stand_where_the_paper_has_them(self):
        """M(y, alpha) = -m z_c and M(y, gamma) = +m x_c (paper, section 4)."""
        body = from_density(box(SIDES, (0.1, 1.0, 0.3)).moments(), DENSITY, None)
        matrix = footplate_mass_matrix(
            body, RigidTransform.identity("scan", "footplate"), NO_FRAME_ERROR
        ).matrix
        assert matrix[1, 3] == pytest.approx(-MASS * 0.3e-3)
        assert matrix[1, 5] == pytest.approx(MASS * 0.1e-3)

    def test_a_measured_mass_gives_the_same_as_its_density(self):
        by_density = from_density(box(SIDES).moments(), DENSITY, 50.0)
        by_mass = from_mass(box(SIDES).moments(), MASS, MASS * 50.0 / DENSITY)
        assert np.allclose(by_mass.parameters, by_density.parameters, rtol=1e-12)
        assert by_mass.density_kg_m3 == pytest.approx(DENSITY)
        assert np.allclose(by_mass.contributions["mass"], by_density.contributions["density"], rtol=1e-9)

    def test_an_added_mass_obeys_the_parallel_axis_theorem(self):
        bead = PointMass(np.array([1.0, 0.5, -0.3]), 2e-7, 1e-8)
        body = with_added(from_density(box(SIDES).moments(), DENSITY, None), [bead])
        matrix = footplate_mass_matrix(body, lower_face(), NO_FRAME_ERROR)
        x, y, z = np.array([1.0, 0.7, -0.3]) * 1e-3
        lever = np.array([[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 1, y, -x, 0]])
        expected = about_lower_face(MASS, *SIDES * 1e-3) + 2e-7 * lever.T @ lever
        assert scaled_difference(matrix.matrix, expected) < 1e-9
        assert matrix.standard_deviation[0, 0] == pytest.approx(1e-8)
        assert matrix.standard_deviation[5, 1] == pytest.approx(1e-8 * x, rel=1e-6)


class TestTheFoundFrame:
    def test_rotating_the_mesh_leaves_the_matrix_and_turns_the_tensor(self):
        rotation, shift = rotation_from_vector([0.4, -1.1, 2.0]), np.array([4.0, -7.0, 30.0])
        still, turned = stapes(0.06), moved(stapes(0.06), rotation, shift)
        matrices, bodies = [], []
        for surface, anterior in ((still, (1.0, 0.0, 0.0)), (turned, rotation[:, 0])):
            body = from_density(surface.moments(), DENSITY, 40.0)
            frame = footplate_frame(surface, AnatomyHints(anterior=anterior))
            matrix = footplate_mass_matrix(body, frame.scan_from_footplate, frame.covariance)
            matrices.append(matrix.matrix)
            bodies.append(body)
        assert scaled_difference(matrices[1], matrices[0]) < 1e-4
        expected = rotation @ bodies[0].inertia_about_com @ rotation.T
        assert np.allclose(bodies[1].inertia_about_com, expected, rtol=1e-9, atol=1e-22)


class TestCovariance:
    """Linear propagation against finite differences through the same public functions."""

    def moments(self, step):
        vector = np.array([1.7, 0.1, 0.2, 0.3, 1.0, 0.5, 1.2, 0.1, -0.05, 0.2]) + step
        second = np.array(
            [
                [vector[4], vector[7], vector[9]],
                [vector[7], vector[5], vector[8]],
                [vector[9], vector[8], vector[6]],
            ]
        )
        return vector, second

    @pytest.mark.parametrize("known_by", ["density", "mass"])
    def test_of_moments(self, known_by):
        rng = np.random.default_rng(2)
        root = rng.normal(size=(10, 10)) * 1e-3
        covariance = root @ root.T

        def matrix(step, parts):
            vector, second = self.moments(step)
            moments = Moments(vector[0], vector[1:4], second, parts)
            body = (
                from_density(moments, 1900.0, None)
                if known_by == "density"
                else from_mass(moments, 3.2e-6, None)
            )
            frame = RigidTransform.from_parts(
                rotation_from_vector([0.2, 0.5, -1.0]), [1.0, 2.0, 3.0], "scan", "footplate"
            )
            return footplate_mass_matrix(body, frame, NO_FRAME_ERROR)

        found = matrix(np.zeros(10), {"levels": covariance})
        columns = [(matrix(s, {}).parameters - matrix(-s, {}).parameters) / 2e-6 for s in np.eye(10) * 1e-6]
        jacobian = np.column_stack(columns)
        expected = jacobian @ covariance @ jacobian.T
        size = np.sqrt(np.diag(expected))
        assert (size[0] > 0.0) == (known_by == "density")
        size[0] = max(size[0], 1e-12)
        assert np.max(np.abs(found.contributions["levels"] - expected) / np.outer(size, size)) < 1e-4

    def test_of_the_frame(self):
        body = from_density(box(SIDES, (0.1, 1.0, 0.3)).moments(), DENSITY, None)
        frame = RigidTransform.from_parts(
            rotation_from_vector([0.2, 0.1, 0.0]), [0.1, 0.2, 0.3], "scan", "footplate"
        )
        pose = np.diag([1e-6, 2e-6, 3e-6, 1e-3, 2e-3, 3e-3]) ** 2
        found = footplate_mass_matrix(body, frame, pose)
        rng = np.random.default_rng(3)
        draws = [
            footplate_mass_matrix(
                body, frame.perturbed(rng.normal(size=6) * np.sqrt(np.diag(pose))), NO_FRAME_ERROR
            )
            for _ in range(400)
        ]
        scatter = np.std([draw.matrix for draw in draws], axis=0)
        stated = found.standard_deviation
        large = stated > 1e-3 * stated.max()
        assert np.allclose(scatter[large], stated[large], rtol=0.2)

    @pytest.mark.parametrize("known", ["density", "mass"])
    @pytest.mark.parametrize("bead_mg", [0.0, 30.0])
    def test_of_the_voxel_size(self, known, bead_mg):
        def matrix(scale, sd=None):
            moments = box(SIDES * scale, np.array([0.1, 1.0, 0.3]) * scale).moments()
            body = (
                from_density(moments, DENSITY, None) if known == "density" else from_mass(moments, MASS, None)
            )
            if bead_mg:
                place = np.array([0.3, 2.5, -0.4]) * scale
                body = with_added(body, [PointMass(place, bead_mg * 1e-6, 0.0)])
            frame = RigidTransform.from_parts(
                np.eye(3), np.array([0.2, -0.3, 0.1]) * scale, "scan", "footplate"
            )
            return footplate_mass_matrix(body, frame, NO_FRAME_ERROR, sd)

        step = 1e-5
        change = (matrix(1.0 + step).matrix - matrix(1.0 - step).matrix) / (2.0 * step) * 0.003
        assert np.allclose(matrix(1.0, 0.003).standard_deviation, np.abs(change), rtol=1e-6)

    def test_in_plate_axes_uses_the_plate_for_axes_and_the_footplate_for_the_point(self):
        body = from_density(box(SIDES, (0.1, 1.0, 0.3)).moments(), DENSITY, None)
        footplate = RigidTransform.from_parts(
            rotation_from_vector([0.2, 0.1, 0.0]), [0.1, 0.2, 0.3], "scan", "footplate"
        )
        plate = RigidTransform.from_parts(
            rotation_from_vector([-0.3, 0.2, 0.4]), [0.0, -1.0, 0.0], "scan", "plate"
        )
        own, other = np.diag([1e-6, 2e-6, 3e-6, 1e-3, 2e-3, 3e-3]) ** 2, np.diag([9e-6] * 3 + [2e-3] * 3) ** 2
        matrix = footplate_mass_matrix(body, footplate, own)
        found = plate_axes_mass_matrix(matrix, plate.inverse() @ footplate, own, other)
        rng = np.random.default_rng(5)
        draws = []
        for _ in range(400):
            a = footplate.perturbed(rng.normal(size=6) * np.sqrt(np.diag(own)))
            b = plate.perturbed(rng.normal(size=6) * np.sqrt(np.diag(other)))
            mixed = RigidTransform.from_parts(b.rotation, a.translation_mm, "scan", "footplate")
            draws.append(footplate_mass_matrix(body, mixed, NO_FRAME_ERROR).matrix)
        stated = found.standard_deviation
        large = stated > 1e-3 * stated.max()
        assert np.allclose(np.std(draws, axis=0)[large], stated[large], rtol=0.2)
        assert scaled_difference(np.mean(draws, axis=0), found.matrix) < 2e-3


class TestCalibration:
    def test_a_line_through_air_is_the_uniform_density(self):
        grey = box(SIDES).moments()
        line = Calibration(2000.0 / 20000.0, -0.1 * 1000.0, None)
        body = from_calibration(grey, grey, 1000.0, 20000.0, line)
        assert np.allclose(
            body.parameters, from_density(grey, 1900.0, None).parameters, rtol=1e-9, atol=1e-22
        )

    def test_dense_bone_at_one_end_moves_the_centre_of_mass(self):
        """Two boxes side by side, of densities 1500 and 2100 kg/m3 by their grey values."""
        shape = box((2.0, 1.0, 1.0)).moments()
        air, bone = 100.0, 1100.0
        line = Calibration(2.0, 300.0, 20.0)
        greys = {-0.5: (1500.0 - 300.0) / 2.0, 0.5: (2100.0 - 300.0) / 2.0}
        parts = [
            (box((1.0, 1.0, 1.0), (x, 0.0, 0.0)).moments(), (g - air) / (bone - air))
            for x, g in greys.items()
        ]
        volume = sum(m.volume_mm3 * w for m, w in parts)
        centre = sum(m.volume_mm3 * w * m.centroid_mm for m, w in parts) / volume
        second = sum(
            w * (m.second_mm5 + m.volume_mm3 * np.outer(m.centroid_mm - centre, m.centroid_mm - centre))
            for m, w in parts
        )
        body = from_calibration(Moments(volume, centre, second), shape, air, bone, line)
        assert body.mass_kg == pytest.approx(3600e-9)
        assert body.com_mm == pytest.approx([600.0 * 0.5 / 3600.0, 0.0, 0.0])
        assert body.inertia_about_com[0, 0] == pytest.approx(3600e-9 * 1e-6 / 6.0)
        assert body.density_kg_m3 == pytest.approx(1800.0)
        assert np.sqrt(body.contributions["calibration"][0, 0]) == pytest.approx(3600e-9 * 20.0 / 1800.0)

    @pytest.mark.parametrize(
        "points",
        ["[[0, 0], [inf, 1]]", "[[0, 0], [1, nan]]", "[[0, 0], [1e-320, 1]]", f"[[0, 0], [1, 1{'0' * 400}]]"],
    )
    def test_impossible_points_are_refused(self, tmp_path, points):
        (tmp_path / "c.toml").write_text(f"points = {points}\n")
        with pytest.raises(CtInertiaError) as refused:
            read_calibration(tmp_path / "c.toml")
        assert refused.value.faults[0].thing == "the calibration points"

    def test_a_negative_standard_deviation_is_refused(self, tmp_path):
        (tmp_path / "c.toml").write_text("points = [[0, 0], [1, 1]]\nsd_kg_m3 = -1\n")
        with pytest.raises(CtInertiaError) as refused:
            read_calibration(tmp_path / "c.toml")
        assert refused.value.faults[0].thing == "sd_kg_m3"

    def test_reads_densities_and_mineral(self, tmp_path):
        path = tmp_path / "c.toml"
        path.write_text("points = [[0, 0], [10000, 1000], [20000, 2000]]\nsd_kg_m3 = 15\n")
        line = read_calibration(path)
        assert line.density(15000.0) == pytest.approx(1500.0)
        assert line.sd_kg_m3 == 15.0
        path.write_text(
            "points_mg_ha_cm3 = [[0, 0], [1000, 800]]\nkg_m3_at_zero = 1000\nkg_m3_per_mg_ha_cm3 = 0.9\n"
        )
        assert read_calibration(path).density(500.0) == pytest.approx(1000.0 + 0.9 * 400.0)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("points = [[0, 0]]", "at least two pairs"),
            ("points = [[0, 0], [0, 5]]", "at least two pairs"),
            ("points = 5", "at least two pairs"),
            ("points = [[0, 10], [5, 0]]", "rising with the grey value"),
            ("", "either points or points_mg_ha_cm3; got neither"),
            ("points = [[0,0],[1,1]]\npoints_mg_ha_cm3 = [[0,0],[1,1]]", "got both"),
            ("points_mg_ha_cm3 = [[0,0],[1,1]]", "kg_m3_at_zero must be a number; got None"),
            ("points = [[0,0],[1,1]]\nslope = 1", "a key of --calibration must be one of points"),
            ("points = [", "valid TOML"),
        ],
    )
    def test_a_faulty_file_is_told(self, tmp_path, text, message):
        path = tmp_path / "c.toml"
        path.write_text(text)
        with pytest.raises(CtInertiaError, match=message):
            read_calibration(path)

    def test_a_missing_file_is_told(self, tmp_path):
        with pytest.raises(CtInertiaError, match="--calibration must be an existing TOML file"):
            read_calibration(tmp_path / "none.toml")


class TestImpossibleValues:
    def test_a_density_in_another_unit(self):
        with pytest.raises(CtInertiaError, match=r"--density must be between 500 and 4000 kg/m3; got 1\.9"):
            from_density(box(SIDES).moments(), 1.9, None)

    def test_a_mass_that_does_not_fit_the_volume(self):
        with pytest.raises(CtInertiaError, match=r"--mass-mg must be a mass that gives .* got 3.2e\+06 mg"):
            from_mass(box(SIDES).moments(), 3.2, None)

    def test_an_added_mass_that_is_not_positive(self):
        with pytest.raises(CtInertiaError, match="--add-mass must be a positive mass in mg; got -1 mg"):
            PointMass(np.zeros(3), -1e-6)
