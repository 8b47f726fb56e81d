"""The command from end to end: every kind of input, the files it writes, the faults it names."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from legacy.ct_inertia.cli import parser, work
from legacy.ct_inertia.ct2mass import ct2mass
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.exports.mass_json import mass_json
from legacy.ct_inertia.mass.mass_properties import footplate_mass_matrix, from_density
from legacy.ct_inertia.options import MassOptions
from legacy.ct_inertia.surface.surface import read_surface, write_surface
from legacy.stapeskit.command import show
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.page.quantities import MASS
from legacy.stapeskit.provenance import content_hash
from legacy.stapeskit.records.mass_record import read_mass_record
from tests.ct_inertia.shapes import box, stapes

pytestmark = pytest.mark.usefixtures("found_once", "undrawn")

DENSITY = 1900.0


def run(arguments):
    """Run the command's work in this process and return its outcome."""
    return work([str(word) for word in arguments])[1]


@pytest.fixture(scope="module")
def mesh(tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "stapes.stl"
    write_surface(path, stapes(0.06))
    return path


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """A stapes over a plate at 50 um voxels with blur and noise, its labels, and its true surface."""
    import SimpleITK as sitk

    from tests.ct_inertia.ears import ear

    made = ear(h=0.05, plate_gap=0.4, seed=3)
    folder = tmp_path_factory.mktemp("scan")
    image = sitk.GetImageFromArray(made.volume.array)
    image.SetSpacing(made.volume.spacing_mm.tolist())
    image.SetOrigin(made.volume.origin_mm.tolist())
    sitk.WriteImage(image, str(folder / "ear.nrrd"))
    return folder, made


@pytest.fixture(scope="module")
def result(scan):
    folder, _ = scan
    out = folder / "out"
    outcome = run([folder / "ear.nrrd", "--density", "1900+-20", "--anterior", "1,0.2,0.1", "--out", out])
    return out, outcome


class TestAScan:
    def test_writes_every_file_and_nothing_else(self, result):
        out, outcome = result
        names = sorted(path.name for path in out.iterdir())
        written = ["labels.nrrd", "labels.seg.nrrd", "mass.json", "plate.ply", "report.html", "stapes.ply"]
        assert names == [".stapeskit", *written]  # no scan_crop.nrrd: NRRD carries its place
        assert sorted(path.name for path in outcome.files) == names[1:]
        assert not list(out.parent.glob(".stapeskit*"))

    def test_gives_the_mass_matrix_of_the_true_body(self, scan, result):
        record = read_mass_record(result[0] / "mass.json")
        exact = from_density(scan[1].stapes.moments(), DENSITY, None)
        truth = footplate_mass_matrix(exact, record.scan_from_footplate, np.zeros((6, 6))).matrix
        root = np.sqrt(np.diag(truth))
        assert np.max(np.abs(record.mass_matrix.matrix - truth) / np.outer(root, root)) < 0.02

    def test_reads_back_as_it_was_written(self, result):
        record = read_mass_record(result[0] / "mass.json")
        content = json.loads((result[0] / "mass.json").read_text(encoding="utf-8"))
        assert np.allclose(record.mass_matrix.matrix, content["mass_matrix"]["matrix_si"], rtol=1e-12)
        stated = np.array(content["mass_matrix"]["standard_deviation_si"])
        assert np.allclose(record.mass_matrix.standard_deviation, stated, rtol=1e-9)
        assert {"levels", "noise", "density", "frame"} <= set(record.mass_matrix.contributions)
        assert record.plate_from_footplate is not None
        assert np.trace(record.footplate_covariance) > 0.0
        assert record.plate_covariance is not None
        total = np.array(content["inertial_parameters"]["covariance_si"])
        assert np.allclose(
            sum(np.array(c) for c in content["inertial_parameters"]["contributions_si"].values()), total
        )

    def test_frames_and_matrices_agree(self, result):
        content = json.loads((result[0] / "mass.json").read_text(encoding="utf-8"))
        frames = {key: np.array(content["frames"][key]) for key in ("scan_from_footplate", "scan_from_plate")}
        between = np.linalg.inv(frames["scan_from_plate"]) @ frames["scan_from_footplate"]
        assert np.allclose(content["frames"]["plate_from_footplate"], between, atol=1e-9)
        turn = np.kron(np.eye(2), between[:3, :3])
        own = np.array(content["mass_matrix"]["matrix_si"])
        expected = turn @ own @ turn.T
        assert np.allclose(
            content["mass_matrix_plate_axes"]["matrix_si"], expected, atol=1e-9 * expected.max()
        )
        reduced = np.array(content["mass_matrix_reduced"]["matrix_si"])
        assert np.array_equal(reduced, own[np.ix_([1, 3, 5], [1, 3, 5])])

    def test_surfaces_lie_on_the_labels(self, scan, result):
        import SimpleITK as sitk

        labels = sitk.ReadImage(str(result[0] / "labels.nrrd"))
        array = sitk.GetArrayFromImage(labels)
        places = np.argwhere(array == 1)[:, ::-1].mean(axis=0)
        middle = np.array(labels.TransformContinuousIndexToPhysicalPoint(places.tolist()))
        surface = read_surface(result[0] / "stapes.ply")
        assert np.linalg.norm(surface.moments().centroid_mm - middle) < 0.02
        assert surface.volume_mm3 == pytest.approx(scan[1].stapes.volume_mm3, rel=0.02)
        assert read_surface(result[0] / "plate.ply").volume_mm3 > 1.0

    def test_report_shows_matrix_pictures_and_hash(self, result):
        page = (result[0] / "report.html").read_text(encoding="utf-8")
        content = json.loads((result[0] / "mass.json").read_text(encoding="utf-8"))
        assert content["provenance"]["inputs"]["scan"]["hash"] in page
        assert page.count("data:image/") >= 3
        assert "Uncertainty budget" in page
        assert "http://" not in page
        assert "https://" not in page
        # To the second digit of its standard deviation, 1 % of the mass.
        assert MASS.with_sd(content["mass_kg"], content["uncertainty"]["total"]["mass_kg"]) in page
        assert content["uncertainty"]["total"]["mass_kg"] == pytest.approx(0.01 * content["mass_kg"], rel=0.1)

    def test_the_table_is_short(self, result, capsys, tmp_path):
        outcome = result[1]
        given = parser().parse([str(tmp_path), "--density", "1900"])
        show(given, outcome)
        assert len(capsys.readouterr().out.splitlines()) <= 15

    def test_labels_alone_and_labels_with_the_scan(self, scan, result, tmp_path):
        folder, made = scan
        labels = result[0] / "labels.nrrd"
        alone = run(["--labels", labels, "--density", "1900", "--no-report", "--out", tmp_path / "a"])
        assert alone.result["volume_m3"] * 1e9 == pytest.approx(made.stapes.volume_mm3, rel=0.05)
        both = run(
            [
                folder / "ear.nrrd",
                "--labels",
                labels,
                "--density",
                "1900",
                "--no-report",
                "--out",
                tmp_path / "b",
            ]
        )
        assert both.result["volume_m3"] * 1e9 == pytest.approx(made.stapes.volume_mm3, rel=0.02)
        assert not (tmp_path / "b" / "report.html").exists()

    def test_labels_corrected_in_place_are_measured_and_stay(self, scan, result, tmp_path):
        import SimpleITK as sitk

        out = tmp_path / "ear_mass"
        shutil.copytree(result[0], out)
        words = [scan[0] / "ear.nrrd", "--density", "1900", "--no-report", "--out", out]
        labels = out / "labels.nrrd"
        run(words)  # nothing edited: a plain rerun
        image = sitk.ReadImage(str(labels))
        corrected = sitk.GetArrayFromImage(image)
        corrected[tuple(np.argwhere(corrected == 1)[0])] = 0
        edited = sitk.GetImageFromArray(corrected)
        edited.CopyInformation(image)
        sitk.WriteImage(edited, str(labels))
        before = labels.read_bytes()
        with pytest.raises(StapeskitError, match=r"labels.nrrd, edited since. Measure .* --labels") as fault:
            run(words)
        assert str(labels) in str(fault.value)
        for _ in range(2):
            made = run([*words, "--labels", labels])
            assert labels.read_bytes() == before
            assert made.result["labels_file"] == "labels.measured.nrrd"
            assert made.result["provenance"]["inputs"]["labels"]["hash"] == content_hash(labels)
            assert {path.name for path in made.files} >= {"labels.measured.nrrd", "mass.json"}
            assert (out / "labels.measured.seg.nrrd").exists()
            assert not (out / "labels.seg.nrrd").exists()  # of the result before
            assert labels not in made.files
        with pytest.raises(StapeskitError, match="edited since"):
            run(words)
        assert run([*words, "--force"]).result["labels_file"] == "labels.nrrd"
        assert labels.read_bytes() != before
        assert not (out / "labels.measured.nrrd").exists()
        assert not (out / "labels.measured.seg.nrrd").exists()

    def test_a_calibration_needs_and_uses_grey_values(self, scan, result, tmp_path):
        folder, made = scan
        line = tmp_path / "line.toml"
        line.write_text("points = [[2000, 0], [20000, 1900]]\nsd_kg_m3 = 10\n")
        found = ct2mass(MassOptions(folder / "ear.nrrd", calibration=line))
        assert found.body.mass_kg == pytest.approx(made.stapes.volume_mm3 * 1.9e-6, rel=0.02)
        assert "calibration" in found.matrix.contributions
        with pytest.raises(CtInertiaError, match="--calibration must be used with grey values"):
            ct2mass(MassOptions(None, labels=result[0] / "labels.nrrd", calibration=line))

    def test_fiducials_override_the_fitted_plate(self, scan, tmp_path):
        path = tmp_path / "f.csv"
        path.write_text("name,x_mm,y_mm,z_mm\na,0,0,0\nb,4,0,0\nc,4,3,0\nd,0,3,0\n")
        found = ct2mass(MassOptions(scan[0] / "ear.nrrd", density=(DENSITY, None), plate_fiducials=path))
        assert found.plate_frame is not None
        assert found.plate_frame.source == "fiducials"
        assert np.allclose(found.plate_frame.scan_from_plate.translation_mm, [2.0, 1.5, 0.0])


class TestAMesh:
    def test_gives_its_own_exact_moments(self, mesh, tmp_path):
        outcome = run(
            [mesh, "--density", "1900+-38", "--anterior", "1,0,0", "--out", tmp_path, "--no-report"]
        )
        assert sorted(path.name for path in tmp_path.iterdir()) == [".stapeskit", "mass.json", "stapes.ply"]
        exact = stapes(0.06).moments()
        assert outcome.result["mass_kg"] == pytest.approx(exact.volume_mm3 * 1.9e-6, rel=1e-5)
        sd = np.array(outcome.result["mass_matrix"]["standard_deviation_si"])
        assert sd[0, 0] == pytest.approx(0.02 * outcome.result["mass_kg"])
        assert outcome.result["frames"]["scan_from_plate"] is None
        assert {"surface_taken_as_exact", "handedness_unconfirmed"} == {
            w["code"] for w in outcome.result["warnings"]
        }
        assert outcome.result["found"]["holes"] == 1

    def test_the_result_of_another_scan_that_is_replaced_is_told(self, mesh, tmp_path):
        other = tmp_path / "other" / mesh.name
        other.parent.mkdir()
        write_surface(other, stapes(0.07))
        words = ["--density", "1900+-38", "--anterior", "1,0,0", "--out", tmp_path / "out", "--no-report"]
        for number, scan in enumerate((mesh, mesh, other)):
            codes = {warning["code"] for warning in run([scan, *words]).result["warnings"]}
            assert ("other_result_replaced" in codes) is (number == 2)

    def test_a_box_has_the_closed_form(self, tmp_path):
        write_surface(tmp_path / "box.ply", box((3.0, 0.4, 1.4), (7.0, 1.0, 2.0)))
        mark = tmp_path / "m.csv"
        mark.write_text("name,x_mm,y_mm,z_mm\nhead,7,1.9,2\nanterior,9,1,2\n")
        outcome = run(
            [tmp_path / "box.ply", "--density", 1900, "--landmarks", mark, "--out", tmp_path, "--no-report"]
        )
        mass = 1900.0 * 3.0 * 0.4 * 1.4 * 1e-9
        matrix = np.array(outcome.result["mass_matrix"]["matrix_si"])
        frame = np.array(outcome.result["frames"]["scan_from_footplate"])
        assert np.allclose(frame[:3, :3], np.eye(3), atol=1e-5)
        height = (1.0 - frame[1, 3]) * 1e-3
        assert height == pytest.approx(0.2e-3, abs=1e-5)
        assert matrix[5, 5] == pytest.approx(mass * (9.0 + 0.16) * 1e-6 / 12.0 + mass * height**2, rel=1e-5)
        assert matrix[2, 3] == pytest.approx(mass * height, rel=1e-5)

    def test_json_holds_the_result_and_added_masses_enter(self, mesh, tmp_path, capsys):
        given, outcome = work(
            f"{mesh} --mass-mg 3.1+-0.1 --add-mass -1,0.2,0,0.4+-0.1 --add-mass=1,0.2,0,0.1 "
            f"--voxel-size-sd 0.2 --out {tmp_path} --no-report --json --quiet --sha256".split()
        )
        show(given, outcome)
        printed = json.loads(capsys.readouterr().out)
        assert printed["mass_kg"] == pytest.approx(3.6e-6)
        assert {"mass", "added_mass", "voxel_size", "frame"} == set(
            printed["inertial_parameters"]["contributions_si"]
        )
        assert printed["uncertainty"]["not_included"] == []
        assert printed["provenance"]["inputs"]["scan"]["hash"].startswith("sha256:")

    def test_no_sd_is_told_in_warnings_and_budget(self, mesh, tmp_path):
        outcome = run([mesh, "--density", "1900", "--out", tmp_path, "--no-report"])
        found = {w["code"] for w in outcome.result["warnings"]}
        assert {"density_sd_not_given", "anterior_not_given"} <= found
        assert "density not included" in outcome.result["uncertainty"]["not_included"]
        rows = dict(outcome.rows)
        assert not any("±" in rows[name] for name in ("volume", "mass", "M(alpha)", "M(y, gamma)"))
        whole = run([mesh, "--density", "1900+-60", "--out", tmp_path / "sd", "--no-report"])
        assert "±" in dict(whole.rows)["mass"]

    def test_a_config_file_stands_in_for_options(self, mesh, tmp_path):
        config = tmp_path / "c.toml"
        config.write_text('density = "1900+-19"\nanterior = [-1, 0.1, 0]\nno-report = true\nside = "left"\n')
        outcome = run([mesh, "--config", config, "--out", tmp_path / "o"])
        assert outcome.result["frames"]["scan_from_footplate"][0][0] < 0.0
        assert outcome.result["frames"]["z_is"] == "superior"
        assert not (tmp_path / "o" / "report.html").exists()

    def test_numbers_in_the_file_are_finite_json(self, mesh):
        content = mass_json(ct2mass(MassOptions(mesh, density=(DENSITY, None))))
        assert json.loads(json.dumps(content, allow_nan=False))["mass_kg"] == content["mass_kg"]
