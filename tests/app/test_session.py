"""From scan to K and D as the page does it, without a browser; ``scan2kd`` repeats its numbers."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile
from scipy.spatial import cKDTree

from app import steps, tables
from app.grey import grey_values
from app.session import Session
from app.steps import STEPS, Job
from app.study_file import StudyFile
from ct_inertia.scan.open_scan import open_labels
from pipeline.new_study import LAYOUT, SPACING
from pipeline.run import scan2kd
from simulate import Ear, Experiment, Scan, simulate_study
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

FILES = ("scan.nrrd", "ldv.csv", "points.csv", "fiducials.csv")


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A folder where a study was begun and its mass was found, and its truth."""
    made = tmp_path_factory.mktemp("made")
    folder = tmp_path_factory.mktemp("ear")
    experiment = Experiment(lines=24, stapes_points=6, bone_points=6, seed=2)
    truth = simulate_study(Ear(), Scan(voxel_um=52.0, samples=6, format="nrrd", seed=2), experiment, made)
    for name in FILES:
        shutil.copy(made / name, folder / name)
    session = opened(folder / "scan.nrrd")
    session.set_scan("ear1", f"{truth.ear.density_kg_m3}+-20", truth.ear.side)
    run(session, "found")
    return folder, truth


@pytest.fixture
def session(measured, tmp_path):
    folder = tmp_path / "Ohr 1 ä"
    shutil.copytree(measured[0], folder)
    return opened(folder / "ear1.toml")


def opened(path: Path) -> Session:
    session = Session(StudyFile(path.with_name(".none.toml")))
    session.open(path)
    return session


def run(session: Session, step: str) -> None:
    """Do a step in this process: a new one would only load everything again."""
    session.study.put("scan")
    STEPS[step][1](StudyFile.read(session.study.path))
    session.take_results()


def behead(session: Session, pen: int) -> None:
    drawing = session.drawing
    top = np.argwhere(drawing.shown == 1)[:, 0].max()
    at = np.argwhere(drawing.shown[top - 5 :] == 1)[:, ::-1].mean(axis=0)
    at[2] += top - 5
    drawing.paint(at, pen, 8)
    session.end_stroke()


def test_the_scan_is_shown_before_anything_is_measured(measured):
    session = opened(measured[0] / "scan.nrrd")
    shown, affine = grey_values(session.scan)
    assert shown.dtype == np.uint8
    assert shown.max() == 255
    corner = affine @ [0, 0, 0, 1] * [-1.0, -1.0, 1.0, 1.0]
    assert np.linalg.norm(session.scan.index_points(corner[:3]) - (session.scan.size - 1) * [1, 1, 0]) < 3.0
    assert session.study.tables["ldv"] == {
        "file": "ldv.csv", "points": "points.csv", "fiducials": "fiducials.csv"
    }  # fmt: skip
    assert not session.study.path.exists()


def test_labels_lie_on_the_grey_values_of_the_picture(session):
    drawing = session.drawing
    shown, _ = grey_values(session.scan, drawing)
    assert shown.shape == drawing.shown.shape
    assert np.median(shown[drawing.shown == 1]) > 2 * np.median(shown[drawing.shown == 0]) + 50


def test_strokes_change_the_mass_and_undo_gives_the_same_study_back(session):
    before = session.study.path.read_bytes()
    mass = session.mass["found"]["mass_kg"]
    behead(session, 3)
    hand = session.study.file("scan", "labels")
    assert np.array_equal(open_labels(hand)[0], session.drawing.labels)
    run(session, "cut")
    assert session.mass["cut"]["mass_kg"] < 0.97 * mass
    kept = hand.read_bytes()
    run(session, "found")
    assert session.mass["found"]["mass_kg"] == mass
    assert hand.read_bytes() == kept
    shown = str(tables.mass_table(session.mass))
    assert shown.index("as found") < shown.index("corrected")
    session.undo()
    assert session.drawing.as_found
    assert session.study.path.read_bytes() == before
    with pytest.raises(StapeskitError):
        session.start("cut")


def test_a_closed_tab_loses_no_stroke_and_a_new_study_spares_its_labels(session):
    behead(session, 3)
    behead(session, 2)
    again = opened(session.study.path)
    assert np.array_equal(again.drawing.labels, session.drawing.labels)
    assert not again.drawing.as_found
    drawn, kept = again.drawing.labels.copy(), again.study.file("scan", "labels")
    again.reset()
    assert again.drawing.as_found
    assert "labels" not in again.study.tables["scan"]
    assert np.array_equal(open_labels(kept)[0], drawn)  # one wrong click costs nothing
    again.undo()
    assert np.array_equal(again.drawing.labels, drawn)
    assert np.array_equal(open_labels(again.study.file("scan", "labels"))[0], drawn)


def test_labels_on_other_voxels_than_the_picture_are_named(session):
    behead(session, 3)
    hand = session.study.file("scan", "labels")
    kept = hand.read_bytes()
    shown = session.study.found / "shown.npz"
    with np.load(shown) as content:
        changed = {**content, "scan_from_index": content["scan_from_index"] + 0.001 * np.eye(4)}
    np.savez(shown, **changed)
    again = Session(StudyFile(session.study.path.with_name(".none.toml")))
    assert str(hand) in again.open(session.study.path)
    behead(again, 2)
    assert again.study.file("scan", "labels") != hand
    assert hand.read_bytes() == kept


def test_a_second_tab_cannot_write_over_the_strokes_of_the_first(session):
    behead(session, 3)
    second = opened(session.study.path)
    behead(session, 2)
    with pytest.raises(StapeskitError):
        behead(second, 1)
    assert np.array_equal(open_labels(session.study.file("scan", "labels"))[0], session.drawing.labels)


@pytest.fixture
def no_pictures(monkeypatch):
    """Reports without pictures: to draw them would take twice as long as to compute what is in them."""
    page = SimpleNamespace(write=lambda path: path.write_text("a report"))
    monkeypatch.setattr("pipeline.report.study_page", lambda _: page)


def test_scan2kd_repeats_the_numbers_of_a_corrected_study_to_the_last_digit(session, measured, no_pictures):
    truth = measured[1]
    session.set_measurement("fiducials", "fiducials.csv")
    foot = np.array(session.mass["found"]["frames"]["scan_from_footplate"])
    session.marks.put("anterior", foot[:3, 3] + foot[:3, 0])
    drawing = session.drawing
    edge = np.argwhere(drawing.shown == 1)[:, ::-1][0]
    drawing.paint(edge, 3, 1)
    session.end_stroke()
    run(session, "cut")
    run(session, "points")
    assert list(session.pages) == ["measurement"]
    assert session.outgrown == []
    assert {verdict for _, verdict, _ in session.content("measured")["points"]} == {"ok"}
    run(session, "fit")
    assert list(session.pages) == ["K and D", "measurement"]
    again = scan2kd(session.study.path, out=session.study.path.parent / "again")
    folder = session.study.path.parent
    ours, theirs = (json.loads((folder / name / "kd.json").read_text()) for name in ("ear1_out", "again"))
    assert {key for key in ours if ours[key] != theirs[key]} <= {"provenance"}
    assert again.mass["mass_kg"] == session.mass["cut"]["mass_kg"]
    assert again.mass["mass_matrix"] == session.mass["cut"]["mass_matrix"]
    value, sd = (ours[key][0][0] for key in ("stiffness_si", "stiffness_sd_si"))
    assert abs(value - truth.stiffness_si[0, 0]) < 3.5 * sd
    reasons = [reason["code"] for reason in ours["verdict"]["reasons"]]
    assert session.choices("study", "confirmed") == (reasons, [])
    assert len(session.responses) == 2 * 3 * 24
    for motion in {row["motion"] for row in session.responses}:
        phases = [
            row["phase"] for row in session.responses if (row["motion"], row["kind"]) == (motion, "fitted")
        ]
        assert np.abs(np.diff(phases)).max() < 180.0
    left_out = [name for name in session.choices("ldv", "leave_out")[0] if name.count(":") == 2][:1]
    assert session.outgrown == []
    session.study.put("ldv", leave_out=left_out)
    assert session.outgrown == ["measurement (4)", "K and D (5)"]
    scan2kd(session.study.path, out=session.study.out)
    assert session.responses == []  # those of the fit before
    run(session, "points")
    assert session.choices("ldv", "leave_out")[1] == left_out
    assert list(session.pages) == ["measurement", "K and D"]  # both stay in the page
    assert session.outgrown == []
    run(session, "cut")
    assert session.outgrown == ["measurement (4)"]  # points lie where an earlier mass has put them
    session.study.put("scan", density_kg_m3="1500+-15")
    assert "mass (1 or 2)" in session.outgrown


def test_points_lie_in_the_scan_where_they_were_measured(session):
    run(session, "points")
    places = session.content("measured")["points"]
    stapes = np.array([place for body, _, place in places if body == "stapes"])
    corners = session.surfaces()["stapes"].reshape(-1, 3)
    assert np.max(cKDTree(corners).query(stapes)[0]) < 0.1


def test_a_seed_and_a_box_are_marks_and_what_is_not_there_yet_is_said(measured, tmp_path):
    session = Session(StudyFile(tmp_path / ".none.toml"))
    for action in (lambda: session.start("found"), lambda: session.marks.put("anterior", [1.0, 2.0, 3.0])):
        with pytest.raises(StapeskitError, match="Choose a scan"):
            action()
    shutil.copy(measured[0] / "scan.nrrd", tmp_path / "other.nrrd")
    session.open(tmp_path / "other.nrrd")
    with pytest.raises(StapeskitError, match="vibrometer"):
        session.start("fit")
    session.marks.put("in the stapes", [1.0, 2.0, 3.0])
    session.marks.put("a corner of a box", [0.0, 5.0, 0.0])
    assert session.study.get("scan", "box_mm") is None
    session.marks.put("the opposite corner", [4.0, 1.0, 6.0])
    assert session.study.get("scan", "box_mm") == [0.0, 1.0, 0.0, 4.0, 5.0, 6.0]
    again = opened(session.study.path)
    assert again.marks.placed["in the stapes"] == (1.0, 2.0, 3.0)
    for name in ("in the stapes", "a corner of a box"):
        again.marks.put(name, None)
    assert set(again.study.tables["scan"]) == {"file"}


def test_a_refusal_comes_from_the_child_in_the_words_of_the_command_and_no_traceback(measured, tmp_path):
    folder = tmp_path / "Ohr 2 ü"
    folder.mkdir()
    shutil.copy(measured[0] / "ldv.csv", folder / "scan.nrrd")
    study = StudyFile.new(folder, "schön")
    study.put("scan", file="scan.nrrd")
    job = Job("found", study)
    fault = job.fault()
    assert "must be" in fault
    assert "Traceback" not in fault
    assert not Path(study.found / "mass.json").exists()


def test_warnings_of_one_code_all_come_from_the_child_and_each_once(capsysbinary):
    told = [Notice("file_read", "skipped"), Notice("file_read", "turned"), Notice("noise_level", "none")]
    for part in (told, [Notice("file_read", "mass: turned")]):
        steps._warn(part)
    job = Job.__new__(Job)
    job.notices, job._fault = (), ""
    job._process = SimpleNamespace(stdout=capsysbinary.readouterr().out.splitlines())
    job._read()
    assert list(job.notices) == told
    shown = tables.status("<i>.tif opened.", job.notices)
    assert "3 warnings" in shown
    assert "<i>" not in shown


@pytest.mark.parametrize("damage", ["missing", "cut", "of another mass"])
def test_labels_of_another_mass_than_that_of_the_study_are_not_shown(session, damage):
    """A step that was killed between its files: the study opens, and says what to do."""
    shown, mass = (session.study.found / name for name in ("shown.npz", "mass.json"))
    if damage == "missing":
        shown.unlink()
    elif damage == "cut":
        shown.write_bytes(shown.read_bytes()[:900])
    else:
        mass.write_text(mass.read_text().replace("stapeskit", "stapeskit ", 1))
    again = Session(StudyFile(session.study.path.with_name(".none.toml")))
    assert "press Measure" in again.open(session.study.path)
    assert again.drawing is None
    assert again.surfaces() == {}


def test_a_scan_that_does_not_say_its_spacing_is_asked_for_it(measured, tmp_path):
    """A TIFF without a resolution, and raw voxels: the sentence, the keys to fill in, then the picture."""
    voxels = sitk.GetArrayFromImage(sitk.ReadImage(measured[0] / "scan.nrrd"))
    tifffile.imwrite(tmp_path / "plain.tif", voxels, photometric="minisblack")
    voxels.tofile(tmp_path / "plain.raw")
    session = Session(StudyFile(tmp_path / ".none.toml"))
    lacks = session.open(tmp_path / "plain.tif")
    assert "the voxel spacing must be" in lacks
    assert "scan.spacing_mm" in lacks
    assert (session.scan, session.lacking) == (None, SPACING)
    with pytest.raises(StapeskitError):
        session.set_voxels(spacing_mm="twenty")
    assert session.set_voxels(spacing_mm="0.052") == ""
    assert session.scan.spacing_mm == pytest.approx([0.052] * 3)
    assert not session.study.path.exists()
    session.set_scan("ear 7", "1900+-200", None)
    assert StudyFile.read(tmp_path / "ear 7.toml").get("scan", "spacing_mm") == "0.052"
    session.set_voxels(spacing_mm="0.026")  # the picture, and every place that is clicked, follows
    assert session.scan.spacing_mm == pytest.approx([0.026] * 3)
    assert session.drawing is None
    session.open(tmp_path / "plain.raw")
    assert session.lacking == LAYOUT
    shape = ",".join(map(str, voxels.shape[::-1]))
    assert "spacing" in session.set_voxels(shape=shape, dtype=voxels.dtype.name)
    assert session.set_voxels(spacing_mm="0.052") == ""
    assert session.scan.shape == voxels.shape
    session.start("found")
    session.job.stop()
    assert "Stopped" in session.finish()


def test_a_surface_mesh_is_measured_without_labels(measured, tmp_path):
    shutil.copy(measured[0] / "ear1_app" / "found" / "stapes.ply", tmp_path / "stapes.ply")
    session = Session(StudyFile(tmp_path / ".none.toml"))
    session.open(tmp_path / "stapes.ply")
    run(session, "found")
    assert session.mass["found"]["mass_kg"] > 0.0
    assert session.drawing is None
    assert set(session.surfaces()) == {"stapes"}


def test_a_scan_that_was_begun_before_names_the_study_to_go_on_with(session):
    study = session.study.path
    shutil.copy(study, study.with_name("scan.toml"))
    again = Session(StudyFile(study.with_name(".none.toml")))
    assert "scan.toml" in again.open(study.with_name("scan.nrrd"))
    assert again.study.path.name == "scan_2.toml"
    assert again.open(study.with_name("scan.toml")) == ""


def test_labels_that_somebody_else_made_are_neither_written_over_nor_forgotten(session):
    given = session.study.path.parent / "ear1_labels.seg.nrrd"
    shutil.copy(session.study.found / "labels.seg.nrrd", given)
    session.study.put("scan", labels=given)
    run(session, "found")
    before, kept = session.study.path.read_bytes(), given.read_bytes()
    behead(session, 3)
    assert session.study.labels_are_ours
    assert given.read_bytes() == kept
    session.undo()
    assert session.study.file("scan", "labels") == given
    assert session.study.path.read_bytes() == before
