"""The whole way: meshes, labels and scans to files; the loop through labels; refusals; pages drawn again."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest

from ct_inertia.api import ct2mass
from ct_inertia.cli import work
from ct_inertia.exports.labels import write_segmentation
from ct_inertia.exports.write import EXPORTS
from ct_inertia.frames.footplate import footplate_frame
from ct_inertia.frames.gap import window_gap
from ct_inertia.options import EXPORTS as EXPORT_NAMES
from ct_inertia.report.pictured import pictured_from
from ct_inertia.report.sections import mass_page
from ct_inertia.report.window import plotter_of
from ct_inertia.results import MassResult
from ct_inertia.scan.open_scan import open_labels
from ct_inertia.surface.surface import Surface
from simulate import Ear, Scan, Stapes, simulate_study, stapes_solid, write_labels
from simulate.solids import joined
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform, rotation_from_vector
from stapeskit.outputs import MANIFEST
from stapeskit.records.mass_file import read_mass, read_mass_json
from stapeskit.registration import displacement


class Study:
    """A simulated scan with noise that neighbours share, its truth, and what ct2mass makes of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        scan = Scan(voxel_um=32.0, noise=0.06, noise_correlation_voxels=0.8, samples=4, seed=11)
        self.truth = simulate_study(Ear(gap_mm=0.15), scan, None, folder)
        self.labels = write_labels(folder / "truth.nrrd", self.truth.placed)

    def measured(self, **more: object) -> MassResult:
        anterior = tuple(float(v) for v in self.truth.scan_from_footplate.rotation[:, 0])
        given = {"scan": str(self.folder / "scan.tif"), "anterior": anterior, "coat": 0, "side": "left"}
        return ct2mass(**given, density=(1900.0, 60.0), **more)

    @functools.cached_property
    def scanned(self) -> MassResult:
        return self.measured()

    @functools.cached_property
    def written(self) -> Path:
        self.scanned.write(self.folder / "out")
        return self.folder / "out"

    @functools.cached_property
    def labelled(self) -> MassResult:
        return self.measured(labels=str(self.labels))


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    return Study(tmp_path_factory.mktemp("study"))


def test_a_scan_is_measured_within_its_stated_sd(study: Study) -> None:
    result, truth = study.scanned, study.truth
    step = displacement(result.footplate.scan_from_footplate, truth.scan_from_footplate)
    assert np.all(np.abs(step) < 4.0 * np.sqrt(np.diag(result.footplate.covariance)))
    volume = result.moments
    assert abs(volume.volume_mm3 - 1e9 * truth.volume_m3) < 4.0 * volume.volume_sd_mm3
    parts = dict(result.matrix.contributions)
    parts.pop("density")
    sd = np.sqrt(np.diag(sum(parts.values())))
    exact = truth.parameters_si * (1900.0 / truth.ear.density_kg_m3)
    assert np.all(np.abs(result.matrix.parameters - exact) < 4.5 * sd)


def test_labels_in_another_unit_are_refused_before_a_frame_of_metres_is_sought(tmp_path: Path) -> None:
    labels = np.zeros((40, 40, 40), dtype=np.uint8)
    labels[5:-5, 5:-5, 15:-15] = 1
    write_segmentation(tmp_path / "a.seg.nrrd", [labels], labels.shape, np.eye(4))
    with pytest.raises(StapeskitError) as caught:
        ct2mass(labels=tmp_path / "a.seg.nrrd")
    assert caught.value.faults[0].thing == "the stapes"


def test_the_gap_of_the_ligament_lies_within_its_stated_sd(study: Study) -> None:
    """Noise makes both surfaces rough; bumps that are nearest must not count for the gap."""
    stapes, *others = (solid for solid, material in study.truth.placed.solids if material == "bone")
    wall = joined(*others)
    exact = Surface(stapes.vertices_mm, stapes.faces)
    true = window_gap(footplate_frame(exact), exact, Surface(wall.vertices_mm, wall.faces))
    found = study.scanned.gap
    assert abs(found.median_mm - true.median_mm) < 2.5 * found.sd_mm
    assert found.sd_mm < 0.006


def test_fluid_in_the_gap_is_in_its_sd(tmp_path: Path) -> None:
    """In a gap narrower than the blur, fluid looks like bone: the edges of both bones seem closer."""
    ear = Ear(stapes=Stapes(family="foreign base"), gap_mm=0.12, fluid_depth_mm=0.3, plate=False)
    truth = simulate_study(ear, Scan(voxel_um=36.0, soft=0.25, samples=4, seed=5), None, tmp_path)
    anterior = tuple(float(v) for v in truth.scan_from_footplate.rotation[:, 0])
    gap = ct2mass(scan=str(tmp_path / "scan.tif"), anterior=anterior).gap
    assert gap is None or abs(gap.median_mm - 0.12) < 2.5 * gap.sd_mm


def test_labels_state_no_smaller_sd_than_the_scan_alone(study: Study) -> None:
    by_scan, by_labels = study.scanned, study.labelled
    ratio = np.sqrt(np.diag(by_labels.footplate.covariance) / np.diag(by_scan.footplate.covariance))
    assert np.all(ratio > 0.7)  # the surface is another one by less than its noise
    assert by_labels.moments.volume_sd_mm3 > 0.7 * by_scan.moments.volume_sd_mm3
    assert {"noise", "edges", "resolution"} <= set(by_labels.footplate.contributions)


def test_own_labels_given_back_weigh_the_same(study: Study, tmp_path: Path) -> None:
    first = study.labelled
    first.write(tmp_path / "out", report=False)
    again = study.measured(labels=str(tmp_path / "out" / "labels.seg.nrrd"))
    parts = dict(first.matrix.contributions)
    parts.pop("density")
    sd = np.sqrt(np.diag(sum(parts.values())))
    assert np.max(np.abs(again.matrix.parameters - first.matrix.parameters) / sd) < 0.03


def test_labels_alone_are_the_solid_of_their_voxels(study: Study) -> None:
    folder, truth = study.folder, study.truth
    result = ct2mass(labels=str(folder / "truth.nrrd"), density=1900.0, anterior=(1.0, 0.0, 0.0))
    voxels = result.body.labelled.stapes.sum() * result.scan.voxel_mm3
    assert result.moments.volume_mm3 == pytest.approx(voxels, rel=1e-9)
    assert abs(result.moments.volume_mm3 - 1e9 * truth.volume_m3) < 3.0 * result.moments.volume_sd_mm3
    codes = {notice.code for notice in result.notices}
    assert {"file_read", "density_sd_not_given"} <= codes
    assert "touches_border" not in codes
    sd = np.sqrt(np.diag(result.footplate.covariance))
    step = displacement(result.footplate.scan_from_footplate, truth.scan_from_footplate)
    assert np.all(np.minimum(np.abs(step), np.abs(step[3:].max())) < 5.0 * sd + 1.0)


def test_what_is_written_is_what_was_measured(study: Study) -> None:
    result, names = study.scanned, "mass.json stapes.ply plate.ply labels.seg.nrrd scan_crop.nrrd report.html"
    assert {path.name for path in study.written.iterdir()} == {*names.split(), MANIFEST}
    record = read_mass_json(study.written / "mass.json")
    np.testing.assert_allclose(record.mass_matrix.matrix, result.matrix.matrix, rtol=1e-12)
    np.testing.assert_allclose(record.mass_matrix.covariance, result.matrix.covariance, rtol=1e-9)
    memory = read_mass(result)
    np.testing.assert_array_equal(memory.mass_matrix.parameters, record.mass_matrix.parameters)
    assert set(memory.meshes) == {"stapes", "plate"}
    assert set(np.unique(open_labels(study.written / "labels.seg.nrrd")[0])) == {0, 1, 2, 3}


def test_the_page_is_drawn_again_from_the_folder_and_the_scan(study: Study) -> None:
    out = study.written
    content = read_mass_json(out / "mass.json").raw
    page = mass_page(content, pictured_from(out, content, study.folder / "scan.tif"))
    first = (out / "report.html").read_text(encoding="utf-8")
    assert [section.name for section in page.sections][:2] == ["What was measured", "Mass matrix M"]
    assert all(f'id="{section.id}"' in first for section in (*page.sections, *page.appendix))
    shown = "".join(page.sections[0].blocks)
    assert "towards anterior (+x)" in shown.replace("−", "-")
    assert "towards superior (+z)" in shown
    frames = content["frames"]
    assert frames["anterior_in_words"] in shown
    assert frames["other_choice"] in shown
    without = mass_page(content, pictured_from(out, content))
    assert "".join(without.sections[0].blocks).count("<svg") == shown.count("<svg") - 1


def test_a_plain_affine_turns_x_and_the_line_to_paste_turns_it_back(study: Study, tmp_path: Path) -> None:
    """A NIfTI whose affine is its voxel size alone has x and y that point the other way than the array."""
    import nibabel
    import SimpleITK as sitk

    voxels = sitk.ReadImage(str(study.labels))
    array = np.ascontiguousarray(sitk.GetArrayFromImage(voxels).transpose(2, 1, 0))
    affine = np.diag([*voxels.GetSpacing(), 1.0])
    nibabel.save(nibabel.Nifti1Image(array, affine), tmp_path / "labels.nii.gz")
    first = ct2mass(labels=str(tmp_path / "labels.nii.gz"), density=(1900.0, 60.0))
    words, other = first.anterior
    assert "of the voxel array" in words
    turned = ct2mass(
        labels=str(tmp_path / "labels.nii.gz"), density=(1900.0, 60.0), anterior=other.partition("=")[2]
    )
    assert turned.anterior[0] != words
    # x and z of the footplate frame turn about y: the entries of y with rotations change their signs
    for dof in (3, 5):
        np.testing.assert_allclose(turned.matrix.matrix[1, dof], -first.matrix.matrix[1, dof], rtol=1e-6)
    assert (words, other) == (
        dict(first.summary())["anterior"],
        dict(first.summary())["for the other choice"],
    )


def test_the_result_prints_draws_and_tabulates_itself(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    result = study.scanned
    names = [name for name, _ in result.summary()]
    assert names[:2] == ["volume", "mass"]
    assert "anterior" in names
    assert len(repr(result).splitlines()) < 30
    frame = result.to_frame()
    assert len(frame) == 21
    assert frame["standard_deviation_si"].notna().all()
    figure = result.plot()
    assert figure.axes
    assert hasattr(figure, "_repr_png_")
    assert "<table>" in result._repr_html_()
    monkeypatch.setattr("pyvista.OFF_SCREEN", True)
    plotter = plotter_of(result)
    assert {"stapes", "plate"} <= set(plotter.actors)
    plotter.close()


def test_without_density_one_is_assumed_and_reported_first(tmp_path: Path) -> None:
    solid = stapes_solid(Stapes())
    path = tmp_path / "stapes.ply"
    Surface(solid.vertices_mm, solid.faces).write(path)
    result = ct2mass(str(path), anterior=(1.0, 0.0, 0.0))
    assert result.summary()[0][0] == "density"
    assert result.notices[0].code == "density_assumed"
    share = result.matrix.standard_deviation[0, 0] / result.matrix.matrix[0, 0]
    assert share == pytest.approx(200.0 / 1900.0, rel=1e-9)
    exact = solid.moments()
    assert result.moments.volume_mm3 == pytest.approx(exact.volume_mm3, rel=1e-12)


@pytest.fixture
def mesh(tmp_path: Path) -> Path:
    solid = stapes_solid(Stapes())
    path = tmp_path / "stapes.ply"
    Surface(solid.vertices_mm, solid.faces).write(path)
    return path


def test_a_plate_by_its_fiducials_and_a_mass_by_two_ways(mesh: Path, tmp_path: Path) -> None:
    pose = RigidTransform.from_parts(
        rotation_from_vector([0.2, 0.1, -0.1]), [0.0, -1.0, 0.2], "scan", "plate"
    )
    corners = np.array([[2.2, 0.0, 1.5], [-2.2, 0.0, 1.5], [-2.2, 0.0, -1.5], [2.2, 0.2, -1.5]])
    pairs = np.hstack([pose.points(corners), corners])
    rows = [f"{k}," + ",".join(map(str, row)) for k, row in enumerate(pairs)]
    marks = tmp_path / "plate.csv"
    marks.write_text("\n".join(["name,x_mm,y_mm,z_mm,x_ref_mm,y_ref_mm,z_ref_mm", *rows]))
    words = ["--density", "1900+-60", "--mass-mg", "4.4+-0.05", "--plate-fiducials", str(marks)]
    outcome = work([str(mesh), *words, "--out", str(tmp_path / "out")])
    assert "plate_not_found" not in {notice.code for notice in outcome.notices}
    record = read_mass_json(tmp_path / "out" / "mass.json")
    assert record.scan_from_plate is not None
    np.testing.assert_allclose(record.scan_from_plate.matrix, pose.matrix, atol=1e-9)
    assert record.mass_matrix.parameters[0] == pytest.approx(4.4e-6, rel=1e-9)
    assert (tmp_path / "out" / "report.html").is_file()


def test_every_export_is_written(mesh: Path, tmp_path: Path) -> None:
    assert set(EXPORTS) == set(EXPORT_NAMES)
    kinds = [name for name in EXPORTS if name != "crop"]
    out = tmp_path / "out"
    words = [str(mesh), "--density", "1900", "--no-report", "--export", ",".join(kinds), "--out", str(out)]
    outcome = work(words)
    assert {path.name for path in outcome.files} >= {EXPORTS[name][0] for name in kinds}
    from scipy.io import loadmat

    content = loadmat(out / "mass.mat")
    record = read_mass_json(out / "mass.json")
    np.testing.assert_allclose(content["M"], record.mass_matrix.matrix)
    assert np.all(np.isnan(content["M_sd"]))  # the density has no sd: none of M is whole
    import trimesh

    assert trimesh.load(out / "stapes.stl").is_watertight
