"""Three ways to a mass, several at once, and what is glued to the bone."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from legacy.ct_inertia.cli import work
from legacy.ct_inertia.ct2mass import ct2mass
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.exports.body import body_of
from legacy.ct_inertia.options import MassOptions
from legacy.ct_inertia.surface.surface import write_surface
from legacy.stapeskit.spatial import matrix_from_parameters
from tests.ct_inertia.ears import AIR, BONE
from tests.ct_inertia.shapes import box, stapes
from tests.ct_inertia.solids import filled, grey_volume, imaged, random_rotation, stapes_surface
from tests.ct_inertia.solids import moved as placed

pytestmark = pytest.mark.usefixtures("found_once", "undrawn")

STEP = 0.03
ANTERIOR = (1.0, 0.2, 0.1)


def run(words):
    return work([str(word) for word in words])[1]


@pytest.fixture(scope="module")
def mesh(tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "stapes.ply"
    write_surface(path, stapes(0.08))
    return path


def weighed(surface, density):
    """Mass, centre (mm) and tensor (kg mm2) of a body whose density is linear: exact on tetrahedra."""
    middle = surface.vertices_mm.mean(axis=0)
    corners = np.concatenate(
        [np.zeros((len(surface.faces), 1, 3)), surface.vertices_mm[surface.faces] - middle], 1
    )
    six = np.linalg.det(corners[:, 1:])
    points = [np.full(4, 0.25), *(np.full(4, 1 / 6) + np.eye(4)[k] / 3 for k in range(4))]
    weights = [-0.8, 0.45, 0.45, 0.45, 0.45]  # exact for cubic polynomials
    mass, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    for place, weight in zip(points, weights, strict=True):
        r = np.einsum("k,fki->fi", place, corners)
        dm = weight * six / 6.0 * density(r + middle) * 1e-9
        mass, first, second = mass + dm.sum(), first + dm @ r, second + (r * dm[:, None]).T @ r
    centre = first / mass
    second -= mass * np.outer(centre, centre)
    return mass, centre + middle, np.trace(second) * np.eye(3) - second


@lru_cache(maxsize=1)
def graded():
    """A scan of a stapes whose bone is 5 % denser at one end of its height than in the middle."""
    surface = placed(stapes_surface(0.05), random_rotation(4))
    up = random_rotation(4) @ [0.0, 1.0, 0.0]
    low = surface.vertices_mm.min(axis=0) - 0.5
    count = np.ceil((np.ptp(surface.vertices_mm, axis=0) + 1.0) / STEP).astype(int)
    heights = surface.vertices_mm @ up
    middle, half = 0.5 * (heights.min() + heights.max()), 0.5 * np.ptp(heights)

    def brighter(points):
        return 1.0 + 0.05 * (points @ up - middle) / half

    share = filled(surface, count, STEP, low, 6)
    z, y, x = np.meshgrid(*(np.arange(n) for n in count[::-1]), indexing="ij")
    grey = imaged(share * brighter(np.stack([x, y, z], axis=-1) * STEP + low), 1.2)
    rng = np.random.default_rng(4)
    grey = AIR + (BONE - AIR) * (grey + 0.04 * rng.standard_normal(grey.shape))
    return surface, brighter, grey_volume(grey, STEP, low)


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    import SimpleITK as sitk

    _, _, volume = graded()
    path = tmp_path_factory.mktemp("scan") / "graded.nrrd"
    image = sitk.GetImageFromArray(volume.array)
    image.SetSpacing(volume.spacing_mm.tolist())
    image.SetOrigin(volume.origin_mm.tolist())
    sitk.WriteImage(image, str(path))
    return path


class TestCalibration:
    @pytest.mark.parametrize(
        ("text", "at_air"),
        [
            ("points = [[2000, 0], [20000, 1900]]", 0.0),
            (
                "points_mg_ha_cm3 = [[2000, -200], [11000, 500], [20000, 1200]]\n"
                "kg_m3_at_zero = 1000\nkg_m3_per_mg_ha_cm3 = 0.75",
                850.0,
            ),
        ],
        ids=["two points, no density at air", "hydroxyapatite, a density at air"],
    )
    def test_bone_that_varies_is_weighed_where_it_lies(self, scan, tmp_path, text, at_air):
        surface, brighter, _ = graded()
        line = tmp_path / "line.toml"
        line.write_text(text)
        found = ct2mass(MassOptions(scan, calibration=line, density=(1900.0, 30.0), anterior=ANTERIOR))
        mass, centre, tensor = weighed(surface, lambda r: at_air + (1900.0 - at_air) * brighter(r))
        plain_mass, plain_centre, _ = weighed(surface, lambda r: np.full(len(r), 1900.0))
        root = np.sqrt(np.diag(tensor))
        off = (found.body.inertia_about_com * 1e6 - tensor) / np.outer(root, root)
        assert found.ways[0].way == "calibration"
        # Uneven bone is a doubt for one density alone.
        uneven = ["inhomogeneity" in way.matrix.contributions for way in found.ways]
        assert uneven == [False, True]
        assert found.body.mass_kg == pytest.approx(mass, rel=5e-4)
        assert np.linalg.norm(found.body.com_mm - centre) < 0.6e-3
        assert np.max(np.abs(off)) < 1.5e-3
        # which is further from bone of one density than every error above
        assert np.linalg.norm(centre - plain_centre) > 12e-3
        assert plain_mass == pytest.approx(found.ways[1].body.mass_kg, rel=0.02)

    def test_a_line_for_other_grey_values_is_told(self, scan, tmp_path):
        line = tmp_path / "line.toml"
        line.write_text("points = [[20, 0], [200, 1900]]")
        with pytest.raises(
            CtInertiaError, match="--calibration must be a line that gives the stapes a density"
        ):
            ct2mass(MassOptions(scan, calibration=line))


class TestSeveralWays:
    def test_a_measured_mass_leads_and_the_density_stands_beside_it(self, mesh, tmp_path):
        volume = stapes(0.08).volume_mm3
        words = [mesh, "--mass-mg", "3.0+-0.3", "--density", "1900+-60", "--anterior", "1,0,0"]
        outcome = run([*words, "--no-report", "--out", tmp_path])
        content = outcome.result
        assert content["mass_known_by"] == "mass"
        assert content["mass_kg"] == pytest.approx(3.0e-6)
        (other,) = content["mass_alternatives"]
        assert other["by"] == "density"
        assert other["density_kg_m3"] == 1900.0
        assert other["mass_kg"] == pytest.approx(1900.0 * volume * 1e-9, rel=1e-9)
        assert other["mass_sd_kg"] == pytest.approx(60.0 * volume * 1e-9, rel=1e-6)
        # one shape, two densities: every entry scales alike, the centre stays
        factor = 1900.0 * volume * 1e-3 / 3.0
        leading = np.array(content["mass_matrix"]["matrix_si"])
        assert np.allclose(other["matrix_si"], factor * leading, rtol=1e-9, atol=1e-22)
        change = np.array(other["matrix_change_percent"])
        assert np.allclose(np.diag(change), 100.0 * (factor - 1.0), rtol=1e-9)
        assert np.allclose(other["center_of_mass_change_m"], 0.0, atol=1e-15)
        assert content["density_kg_m3"] == pytest.approx(3.0e3 / volume)
        assert "density" not in content["inertial_parameters"]["contributions_si"]
        assert "by density instead" in dict(outcome.rows)

    def test_one_way_has_no_alternatives(self, mesh):
        found = ct2mass(MassOptions(mesh, density=(1900.0, None)))
        assert [way.way for way in found.ways] == ["density"]
        assert found.ways[0].matrix is found.matrix

    @pytest.mark.parametrize(
        ("mass", "density", "told"),
        [
            ("2.9+-0.05", "1900+-30", False),
            ("3.6+-0.05", "1900+-30", True),
            ("3.6+-0.5", "1900+-30", False),
            ("2.95", "1900", False),
            ("3.6", "1900", True),
        ],
    )
    def test_masses_that_disagree_are_told(self, mesh, tmp_path, mass, density, told):
        content = run(
            [mesh, "--mass-mg", mass, "--density", density, "--no-report", "--out", tmp_path]
        ).result
        assert ("masses_disagree" in {warning["code"] for warning in content["warnings"]}) is told


class TestAddedMasses:
    def test_a_bead_on_a_box_has_the_closed_form_everywhere(self, tmp_path):
        """Density leads to mass 3.192 mg of bone; the bead sits 2 mm above the footplate centre."""
        path, a, b, c = tmp_path / "box.ply", 3.0, 0.4, 1.4
        write_surface(path, box((a, b, c), (0.0, b / 2, 0.0)))
        mark = tmp_path / "m.csv"
        mark.write_text("name,x_mm,y_mm,z_mm\nhead,0,0.4,0\nanterior,1.4,0,0\n")
        bead, place = 0.5e-6, np.array([0.2, 2.0, -0.1])
        found = ct2mass(
            MassOptions(
                path,
                density=(1900.0, 19.0),
                mass_mg=(3.0, 0.03),
                landmarks=mark,
                add_mass=((*place, bead * 1e6, 0.05),),
            )
        )
        frame = found.footplate.scan_from_footplate
        seen = frame.inverse()
        for way, bone, sd in (("mass", 3.0e-6, 0.03e-6), ("density", 1900e-9 * a * b * c, 19e-9 * a * b * c)):
            entry = next(e for e in found.ways if e.way == way)
            middle = seen.points(np.array([0.0, b / 2, 0.0])) * 1e-3
            inertia = bone * np.diag([b * b + c * c, a * a + c * c, a * a + b * b]) * 1e-6 / 12.0
            inertia = frame.rotation.T @ inertia @ frame.rotation
            arm = seen.points(place) * 1e-3
            first = bone * middle + bead * arm
            for mass, r in ((bone, middle), (bead, arm)):
                inertia = inertia + mass * (r @ r * np.eye(3) - np.outer(r, r))
            packed = [inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))]
            truth = matrix_from_parameters([bone + bead, *first, *packed])
            assert np.allclose(entry.matrix.matrix, truth, rtol=1e-9, atol=1e-20)
            assert entry.matrix.standard_deviation[0, 0] == pytest.approx(np.hypot(sd, 0.05e-6), rel=1e-9)
            assert entry.body.density_kg_m3 == pytest.approx(bone / (a * b * c) * 1e9)
        # the budget and the files of other programs hold the whole
        assert {"mass", "added_mass"} <= set(found.matrix.contributions)
        body = body_of(found)
        assert body.mass_kg == pytest.approx(3.5e-6)
        expected = (3.0 * seen.points(np.array([0.0, b / 2, 0.0])) + 0.5 * seen.points(place)) / 3.5 * 1e-3
        assert np.allclose(body.com_m, expected, rtol=1e-9, atol=1e-15)
