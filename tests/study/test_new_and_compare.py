"""A study file from a folder of files, and two results side by side."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest

from pipeline.compare import compare, write_comparison
from pipeline.new_study import look, needs, new_study
from pipeline.run import StudyResult
from pipeline.stapeskit_command import work
from pipeline.study import read_study
from simulate import Truth
from stapeskit.faults import StapeskitError


@pytest.fixture
def files(small: tuple[Path, Truth], tmp_path: Path) -> Path:
    for name in ("scan.nrrd", "ldv.csv", "points.csv", "fiducials.csv"):
        shutil.copyfile(small[0] / name, tmp_path / name)
    return tmp_path


def test_files_are_recognised_and_the_study_can_be_read(files: Path) -> None:
    found = look(files)
    assert [path.name for path in found.scans] == ["scan.nrrd"]
    assert [path.name for path in found.measurements] == ["ldv.csv"]
    study = read_study(new_study(files))
    assert study.scan.file == files / "scan.nrrd"
    assert study.ldv.points == files / "points.csv"
    assert study.scan.density_kg_m3 is None  # assumed, and reported as assumed in every result


def test_what_no_file_says_is_asked_and_a_wrong_answer_asked_again(
    files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = iter(["heavy", "1850+-40", "upper", "right", "0,0,0", "-1,0.2,0"])
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda _question: next(answers))
    work(["new", str(files)])
    assert next(answers, None) is None
    scan = read_study(files / "study.toml").scan
    assert (scan.density_kg_m3.value, scan.density_kg_m3.sd) == (1850.0, 40.0)
    assert (scan.side, scan.anterior) == ("right", (-1.0, 0.2, 0.0))
    work(["new", str(files), "--yes"])
    assert read_study(files / "study.toml").scan.side is None


def test_of_two_measurements_the_answer_names_one(files: Path) -> None:
    for name in ("first.csv", "second.csv"):
        shutil.copyfile(files / "ldv.csv", files / name)
    (files / "ldv.csv").unlink()
    answers = iter(["2", "", "", ""])
    assert read_study(new_study(files, lambda _question: next(answers))).ldv.file == (files / "second.csv",)


WRONG = [
    "app --port", "app --port abc", "app --port=99999", "app --nope", "app nowhere --no-browser",
    "compare", "compare nowhere elsewhere", "compare nowhere --what-if K", "compare a b --out --force",
    "sample", "sample a b", "sample --yes a", "sample scan.nrrd",
    "new nowhere", "new scan.nrrd", "new --nope", "new empty",
]  # fmt: skip


@pytest.mark.parametrize("words", WRONG)
def test_what_is_wrong_is_refused_in_a_sentence(
    words: str, files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (files / "empty").mkdir()
    monkeypatch.chdir(files)
    before = sorted(files.rglob("*"))
    with pytest.raises(StapeskitError) as refused:  # exit code 2, as `stapeskit.command` has it
        work(words.split())
    for fault in refused.value.faults:
        assert fault.thing
        assert fault.expected
        assert str(fault.got)
    assert sorted(files.rglob("*")) == before


def test_a_folder_without_a_scan_is_refused_and_a_study_of_mine_is_kept(files: Path) -> None:
    (files / "study.toml").write_text("mine")
    with pytest.raises(StapeskitError):
        new_study(files)
    assert (files / "study.toml").read_text() == "mine"
    (files / "scan.nrrd").unlink()
    with pytest.raises(StapeskitError) as raised:
        new_study(files, force=True)
    assert "scan" in raised.value.faults[0].expected


def test_a_result_does_not_differ_from_itself(finished: StudyResult, tmp_path: Path) -> None:
    shutil.copytree(finished.out, tmp_path / "again")
    found = compare(finished.out, tmp_path / "again")
    assert not found.differences[:, 0].any()
    paths = write_comparison(found, tmp_path / "out", [finished.out / "kd.json"])
    table = pd.read_csv(next(path for path in paths if path.suffix == ".csv"))
    assert {"K_y_y", "D_y_y", "mass"} <= set(table["quantity"])
    assert (table["p_value"].dropna() == 1.0).all()
    for other in (tmp_path, finished.out):
        with pytest.raises(StapeskitError):
            compare(finished.out, other)
    kd = json.loads((tmp_path / "again" / "kd.json").read_text())
    kd["model"] |= {"damping_law": "hysteretic", "damping_exponent": 0.0}
    (tmp_path / "again" / "kd.json").write_text(json.dumps(kd))
    found = compare(finished.out, tmp_path / "again")  # D in N s/m and in N/m
    assert not [row.name for row in found.quantities if row.name.startswith("D")]
    assert found.remark


def test_results_of_earlier_commands_are_no_inputs_of_a_new_study(files: Path, finished: StudyResult) -> None:
    shutil.copytree(finished.out, files / "scan_mass")
    for name in ("dof.csv", "dof.h5", "kd.mat", ".stapeskit.json"):
        shutil.copyfile(finished.out / name, files / name)
    (files / "photos").mkdir()
    (files / "notes.txt").write_text("Left ear, incus removed.\nKept at 4 degrees for 2 days, 2024-05-06.\n")
    (files / "log.txt").write_text("")
    found = look(files)
    assert [path.name for path in found.scans] == ["scan.nrrd"]
    assert [path.name for path in found.measurements] == ["ldv.csv"]


def test_the_layout_of_raw_voxels_is_asked_for_and_then_their_size(files: Path) -> None:
    import SimpleITK as sitk

    image = sitk.ReadImage(files / "scan.nrrd")
    (files / "scan.nrrd").unlink()
    sitk.GetArrayFromImage(image).tofile(files / "probe.raw")
    study = new_study(files)
    assert "scan.shape" in needs(study)  # the keys of a study, where there are no flags
    assert "--shape" not in needs(study)
    size = ",".join(map(str, image.GetSize()))
    answers = iter(["7,8", f"{size} uint16", "0.04", "", "left", ""])
    study = new_study(files, lambda _question: next(answers))
    assert next(answers, None) is None
    scan = read_study(study).scan
    assert (scan.shape, scan.dtype, scan.side) == (image.GetSize(), "uint16", "left")
    assert needs(study) == ""
    sitk.WriteImage(image, files / "probe.mhd")  # the header makes the raw file a part of it
    assert [path.name for path in look(files).scans] == ["probe.mhd"]
