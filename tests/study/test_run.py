"""A study is right, keeps what is finished, repeats nothing, and gives one verdict everywhere."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pandas as pd
import pytest

from ct_inertia.options import MassOptions
from kinematics.options import MotionOptions
from pipeline.report import summary_rows, write_figures
from pipeline.run import FILES, StudyResult, check_study, run_study, scan2kd
from pipeline.study import TABLES, in_keys, read_study
from simulate import Truth
from stapeskit.faults import StapeskitError
from stapeskit.outputs import MANIFEST
from stapeskit.report import page
from stapeskit.warnings import Notice
from tests.scenes.chain import Outcome, fit_distance


def test_k_and_d_lie_within_their_uncertainty(finished: StudyResult, small: tuple[Path, Truth]) -> None:
    kd = json.loads((finished.out / "kd.json").read_text())
    distance, limit = fit_distance(Outcome(small[1], kd=kd))
    assert distance < limit


def test_every_file_that_is_promised_and_one_record(finished: StudyResult) -> None:
    promised = {name for stage in FILES.values() for name in stage}
    assert {path.name for path in finished.out.iterdir()} == promised | {MANIFEST}
    table = pd.read_csv(finished.out / "kd.csv").set_index("entry")
    kd = json.loads((finished.out / "kd.json").read_text())
    assert table["value"]["K11"] == pytest.approx(kd["stiffness_si"][0][0], rel=1e-8)


def test_one_verdict_in_the_same_words_everywhere(finished: StudyResult, tmp_path: Path) -> None:
    level = finished.fit.verdict.level
    kd = json.loads((finished.out / "kd.json").read_text())
    assert kd["verdict"]["level"] == level
    assert dict(summary_rows(finished))["verdict"] == finished.fit.verdict.sentence
    assert finished.fit.verdict.sentence in repr(finished.fit)
    (page_file,) = finished.write(tmp_path)
    assert level in page_file.read_text(encoding="utf-8")
    assert finished.fit.verdict.sentence in repr(finished)
    assert finished.to_frame().equals(finished.fit.to_frame())
    assert finished.plot().axes


def copied(small: tuple[Path, Truth], folder: Path, fit: str = "", study: str = "") -> Path:
    """Return the study in another folder, with further keys."""
    for path in small[0].iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    file = folder / "study.toml"
    text = file.read_text().replace("[fit]", f"[fit]\n{fit}").replace("[study]", f"[study]\n{study}")
    file.write_text(text)
    return file


def test_what_is_finished_stays_when_a_later_stage_fails(
    small: tuple[Path, Truth], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study, out = copied(small, tmp_path, "band_hz = [6000, 7000]"), tmp_path / "out"
    reported: list[Notice] = []
    with pytest.raises(StapeskitError) as raised:
        run_study(study, out, tell=reported.extend)
    assert raised.value.faults[0].thing == "the band"
    assert {notice.code for notice in reported} >= {"plate_axis_sign"}
    made = {path.name for path in out.iterdir()}
    assert {"mass.json", "dof.csv", "dof.h5"} <= made
    assert "kd.json" not in made
    written = (out / "mass.json").stat().st_mtime_ns
    copied(small, tmp_path)

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("fitting.dof2kd.fit_of", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_study(study, out)
    result = run_study(study, out)
    assert result.reused == ("scan",)
    assert (out / "mass.json").stat().st_mtime_ns == written
    assert (out / "report.html").exists()


def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_computed(
    small: tuple[Path, Truth], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.access", lambda _path, _mode: False)  # root may write everywhere
    monkeypatch.setattr("ct_inertia.ct2mass.measure_mass", None)
    with pytest.raises(StapeskitError) as raised:
        scan2kd(small[0] / "study.toml", out=tmp_path / "closed" / "out")
    assert {fault.thing for fault in raised.value.faults} == {"the output folder"}


def test_faults_of_a_study_name_its_keys(small: tuple[Path, Truth], tmp_path: Path) -> None:
    copied(small, tmp_path)
    study = tmp_path / "study.toml"
    raw = study.read_text().replace('"scan.nrrd"', '"scan.raw"')
    (tmp_path / "scan.raw").write_bytes(b"voxels")
    study.write_text(raw)
    with pytest.raises(StapeskitError) as raised:
        check_study(read_study(study))
    (fault,) = raised.value.faults
    assert "scan.dtype" in fault.next_step
    assert "--" not in fault.next_step


def test_warnings_of_a_study_name_its_keys(finished: StudyResult) -> None:
    """The scan's warnings advise a coat: in a study that is a key of its table."""
    flags = {entry.flag for table in TABLES.values() for entry in table.entries()}
    for notice in finished.notices:
        assert not flags & set(re.findall(r"--[a-z-]+", notice.text))
    texts = {notice.code: notice.text for notice in finished.notices}
    assert "scan.coat_um" in texts["bare_bone_assumed"]
    ambiguous = Notice("x", "--mirror, --damping and --inplane load; --force")
    own = [in_keys([ambiguous], table)[0].text for table in (MassOptions, MotionOptions)]
    keys = "fit.damping and fit.inplane load; --force"
    assert own == [f"scan.mirror, {keys}", f"ldv.mirror, {keys}"]


def test_a_mesh_without_a_plate_is_refused_before_it_is_measured(
    small: tuple[Path, Truth], finished: StudyResult, tmp_path: Path
) -> None:
    copied(small, tmp_path)
    shutil.copyfile(finished.out / "stapes.ply", tmp_path / "stapes.ply")
    study = tmp_path / "study.toml"
    study.write_text(study.read_text().replace('"scan.nrrd"', '"stapes.ply"'))
    with pytest.raises(StapeskitError) as raised:
        check_study(read_study(study))
    (fault,) = raised.value.faults
    assert (fault.got, fault.where) == ("plate", "fiducials.csv")


def test_an_output_that_is_an_input_is_refused(small: tuple[Path, Truth], tmp_path: Path) -> None:
    shutil.copytree(small[0], tmp_path / "ear")
    (tmp_path / "ear" / "dof.csv").write_text("mine\n")
    with pytest.raises(StapeskitError):
        scan2kd(tmp_path / "ear" / "study.toml", out=tmp_path / "ear")
    assert (tmp_path / "ear" / "dof.csv").read_text() == "mine\n"


def test_confirmed_warnings_do_not_lower_the_verdict(
    small: tuple[Path, Truth], finished: StudyResult, tmp_path: Path
) -> None:
    codes = [reason.code for reason in finished.fit.verdict.reasons]
    listed = ", ".join(f'"{code}"' for code in codes)
    study = copied(small, tmp_path, study=f"confirmed = [{listed}]")
    shutil.copytree(finished.out, tmp_path / "out")
    assert run_study(study, tmp_path / "out").fit.verdict.level == "believe"
    asked = [Notice("handedness_unconfirmed", "turned?")]  # on the page, too, by its first words
    assert page.notices(asked, ["handedness"]) == page.notices(asked, ["handedness_unconfirmed"])
    assert page.notices(asked, ["handedness"]) != page.notices(asked)


def test_every_figure_of_the_report_as_pdf_and_svg(finished: StudyResult, tmp_path: Path) -> None:
    names = {path.name for path in write_figures(finished, tmp_path / "figures")}
    drawn = {"responses_run_1", "footplate", "residuals", "medial", "motion", "channel_residuals"}
    assert {f"{name}.{kind}" for name in drawn for kind in ("pdf", "svg")} <= names
    assert (tmp_path / "figures" / "residuals.pdf").read_bytes().startswith(b"%PDF")


def test_the_stiffness_in_the_plane_is_measured_and_not_assumed(finished: StudyResult) -> None:
    assert finished.fit.plane is not None
    assert finished.fit.plane.determined
