"""The study file and the marks: what is written, what is kept, what is refused."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest

from app.marks import Marks
from app.study_file import StudyFile
from ct_inertia.frames.fiducials import read_plate_fiducials
from ct_inertia.frames.landmarks import read_landmarks
from stapeskit.faults import StapeskitError

FIDUCIALS = """name,x_mm,y_mm,z_mm,x_ref_mm,y_ref_mm,z_ref_mm,frame
a,1,0,0,-2,0,-1,plate
b,4,0,0,2,0,-1,plate
c,4,0,3,2,0,1,plate
d,1,0,3,-2,0,1,plate
"""


@pytest.fixture
def folder(tmp_path):
    for name in ("scan.nrrd", "ldv.csv", "points.csv"):
        (tmp_path / name).write_text("x\n")
    (tmp_path / "fiducials.csv").write_text(FIDUCIALS)
    return tmp_path


@pytest.fixture
def study(folder):
    made = StudyFile.new(folder, "ear1")
    made.put("scan", file=folder / "scan.nrrd", density_kg_m3="1900+-60")
    made.put("ldv", file=folder / "ldv.csv", points="points.csv", fiducials="fiducials.csv")
    return made


def test_every_key_comes_back_and_those_the_page_does_not_show_stay(study, folder):
    text = study.path.read_text()
    study.path.write_text(text + '\n[fit]\nunknowns = ["none"]\nband_hz = [400.0, 5000.0]\n')
    again = StudyFile.read(study.path)
    again.put("scan", side="left", anterior=[1.0, 0.0, 0.0])
    content = tomllib.loads(study.path.read_text())
    assert content["fit"] == {"unknowns": ["none"], "band_hz": [400.0, 5000.0]}
    assert content["scan"]["file"] == "scan.nrrd"
    assert content["scan"]["side"] == "left"
    again.put("scan", side=None)
    assert "side" not in tomllib.loads(study.path.read_text())["scan"]


def test_a_value_that_the_command_would_refuse_leaves_the_file_as_it_was(study):
    before = study.path.read_bytes()
    with pytest.raises(StapeskitError) as raised:
        study.put("scan", density_kg_m3="bone")
    assert raised.value.faults[0].thing == "scan.density_kg_m3"
    assert study.path.read_bytes() == before
    assert study.get("scan", "density_kg_m3") == "1900+-60"


def test_a_study_with_wrong_values_is_refused_with_all_of_them(folder):
    text = '[scan]\nfile = "scan.nrrd"\nseed_mm = [1.0, 2.0]\nbox_mm = "x"\n[fit]\ndamping = "none"\n'
    (folder / "study.toml").write_text(text)
    with pytest.raises(StapeskitError) as raised:
        StudyFile.read(folder / "study.toml")
    things = {fault.thing for fault in raised.value.faults}
    assert things == {"scan.seed_mm", "scan.box_mm", "fit.damping"}


def test_a_study_whose_measurement_was_moved_is_opened(folder):
    (folder / "study.toml").write_text('[scan]\nfile = "scan.nrrd"\n[ldv]\nfile = "moved.csv"\n')
    assert StudyFile.read(folder / "study.toml").get("ldv", "file") == "moved.csv"


def test_comments_and_order_of_a_study_written_by_hand_are_kept(folder):
    other = folder / "study.toml"
    text = '# mine\n[study]\nnotes = "n"  # incus gone\n\n[scan]\n# from May\nfile = "scan.nrrd"\n'
    other.write_text(text)
    study = StudyFile.read(other)
    study.put("scan", side="right")
    assert other.read_text() == text + 'side = "right"\n'
    study.put("scan", side=None)
    assert other.read_text() == text


def test_what_another_tab_has_saved_is_not_written_over(study):
    here, there = StudyFile.read(study.path), StudyFile.read(study.path)
    there.put("scan", side="left")
    kept = study.path.read_bytes()
    with pytest.raises(StapeskitError) as raised:
        here.put("scan", side="right")
    assert raised.value.faults[0].expected == "as this page left it"
    assert study.path.read_bytes() == kept


def test_labels_take_the_place_of_seed_and_box_and_give_it_back(study, folder):
    study.put("scan", seed_mm=[1.0, 2.0, 3.0], box_mm=[0.0, 0.0, 0.0, 5.0, 5.0, 5.0])
    hand = study.kept / "labels.seg.nrrd"
    study.found.mkdir(parents=True)
    hand.write_text("x")
    used = study.mass_options(hand_work=False).given()
    (study.found / "mass.json").write_text(json.dumps({"provenance": {"parameters": used}}))
    study.put_labels(hand)
    again = StudyFile.read(study.path)
    assert again.mass_options(hand_work=True).labels == hand
    assert again.mass_options(hand_work=True).seed_mm is None
    found = again.mass_options(hand_work=False)
    assert (found.labels, found.seed_mm) == (None, (1.0, 2.0, 3.0))
    again.put_labels(None)
    assert again.get("scan", "box_mm") == [0.0, 0.0, 0.0, 5.0, 5.0, 5.0]


def test_marks_are_saved_one_by_one_and_read_by_the_commands(study):
    marks = Marks(study)
    assert marks.names[-4:] == ["a", "b", "c", "d"]
    marks.put("anterior", np.array([1.23456, 2.0, 3.0]))
    marks.put("head", [0.0, 1.0, 2.0])
    points = read_landmarks(study.file("scan", "landmarks"))
    assert np.allclose(points["anterior"], [1.2346, 2.0, 3.0])
    marks.put("a", [0.0, 0.0, 0.0])
    marks.put("b", [4.0, 0.0, 0.0])
    assert study.get("scan", "plate_fiducials") is None
    assert len(Marks(StudyFile.read(study.path)).points["plate_fiducials"]) == 2
    marks.put("c", [4.0, 0.0, 2.0])
    known = read_plate_fiducials(study.file("scan", "plate_fiducials"))
    assert known.names == ("a", "b", "c")
    assert np.allclose(known.plate_mm, [[-2, 0, -1], [2, 0, -1], [2, 0, 1]])
    again = Marks(StudyFile.read(study.path))
    assert again.placed == marks.placed
    again.put("head", None)
    again.put("anterior", None)
    assert again.study.get("scan", "landmarks") is None


def test_landmarks_of_another_program_are_taken_over_and_their_file_stays(study, folder):
    given = folder / "given.fcsv"
    given.write_text("# CoordinateSystem = LPS\n# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label\n"
                     "1,1,2,3,0,0,0,1,1,1,0,anterior\n")  # fmt: skip
    study.put("scan", landmarks=given)
    before = given.read_bytes()
    marks = Marks(study)
    marks.put("superior", [0.0, 0.0, 9.0])
    assert given.read_bytes() == before
    assert set(read_landmarks(study.file("scan", "landmarks"))) == {"anterior", "superior"}
