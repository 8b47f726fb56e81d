"""The chain: right numbers, stages reused exactly as long as they hold, outputs whole or not at all."""

import io
import json
import re
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_STIFFNESS
from legacy.fitting.fit_files import fit_files
from legacy.fitting.options import KDOptions
from legacy.pipeline import scan2kd, stages
from legacy.pipeline.scan2kd import output_set, run_study
from legacy.pipeline.stage_progress import Progress
from legacy.pipeline.stage_records import StageReport
from legacy.pipeline.study import read_study
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.provenance import content_hash
from legacy.stapeskit.records.motion_files import read_motion

pytestmark = pytest.mark.usefixtures("found_once")

OUTPUTS = {"report.html", "mass.json", "stapes.ply", "dof.csv", "dof.h5", "dof.channels.csv", "kd.json"}


def contents(folder: Path):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def reused(result):
    return {run.name: run.reused for run in result.stages}


def set_run(monkeypatch, name, run):
    """Put another function in place of a stage's own."""
    table = tuple(replace(stage, run=run) if stage.name == name else stage for stage in scan2kd.STAGES)
    monkeypatch.setattr(scan2kd, "STAGES", table)


def edit(path: Path, old: str, new: str):
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new))


def test_the_chain_recovers_stiffness_and_damping(finished):
    kd = finished[2].kd
    upper = np.triu_indices(3)
    truth = np.concatenate([PAPER_STIFFNESS[upper], PAPER_DAMPING_CORRECTED[upper]])
    found = np.concatenate([np.array(kd["stiffness_si"])[upper], np.array(kd["damping_si"])[upper]])
    error = found - truth
    distance = error @ np.linalg.solve(np.array(kd["covariance_si"]), error)
    assert distance < 26.2  # chi2 of 12 degrees of freedom at p = 0.01
    assert np.all(np.abs(np.diag(kd["stiffness_si"]) / np.diag(PAPER_STIFFNESS) - 1.0) < 0.08)


def test_the_outputs_of_the_contract(finished):
    _, out, result = finished
    assert {path.name for path in out.iterdir() if path.is_file()} == OUTPUTS
    assert {path.name for path in result.files} == OUTPUTS
    assert json.loads((out / "kd.json").read_text(encoding="utf-8"))["schema"] == "stapeskit.kd/1"


def test_every_result_names_the_calibrated_numbers_of_its_room(finished):
    out = finished[1]
    blocks = {
        "ct_inertia": json.loads((out / "mass.json").read_text(encoding="utf-8"))["provenance"],
        "kinematics": read_motion(out / "dof.h5").provenance,
        "fitting": json.loads((out / "kd.json").read_text(encoding="utf-8"))["provenance"],
    }
    for room, provenance in blocks.items():
        numbers = import_module(f"legacy.{room}.calibrated").calibrated
        assert numbers.version().items() <= provenance["versions"].items()


def test_the_motion_of_a_study_is_refused_beside_the_mass_of_another(finished, tmp_path):
    out = finished[1]
    record = json.loads((out / "mass.json").read_text(encoding="utf-8"))
    record["frames"]["pose_covariance"]["scan_from_footplate"]["matrix_si"][0][0] *= 1.5  # of another scan
    (tmp_path / "mass.json").write_text(json.dumps(record), encoding="utf-8")
    chosen = KDOptions(dof=("y", "alpha", "gamma"))
    fit_files(out / "dof.csv", out / "mass.json", chosen, tmp_path / "kd.json")
    with pytest.raises(StapeskitError) as caught:
        fit_files(out / "dof.csv", tmp_path / "mass.json", chosen, tmp_path / "other.json")
    assert caught.value.faults[0].thing == "{mass}"


def test_a_second_run_recomputes_nothing(ear):
    study, out = ear
    before = contents(out)
    times = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    result = run_study(study, out)
    assert all(reused(result).values())
    assert contents(out) == before
    assert all(path.stat().st_mtime_ns == times[path] for path in out.rglob("*") if path.is_file())
    assert result.kd["stiffness_si"] == json.loads(before["kd.json"])["stiffness_si"]


def test_another_density_reuses_the_motion(ear):
    study, out = ear
    edit(study, "1382.4+-14", "1400+-14")
    result = run_study(study, out)
    assert reused(result) == {"scan": False, "motion": True, "fit": False, "report": False}
    assert result.mass["density_kg_m3"] == 1400.0
    assert "changed: density_kg_m3" in result.stages[0].reason


def test_other_notes_make_only_the_report_anew(ear):
    study, out = ear
    edit(study, "Incus removed", "Cochlea opened")
    assert reused(run_study(study, out)) == {"scan": True, "motion": True, "fit": True, "report": False}
    assert "Cochlea opened" in (out / "report.html").read_text(encoding="utf-8")


def test_a_renamed_study_makes_the_report_anew(ear):
    study, out = ear
    renamed = study.rename(study.with_name("renamed.toml"))
    result = run_study(renamed, out)
    assert reused(result) == {"scan": True, "motion": True, "fit": True, "report": False}
    assert "renamed.toml" in (out / "report.html").read_text(encoding="utf-8")
    assert reused(run_study(renamed, out))["report"]


def test_another_estimator_makes_only_fit_and_report_anew(ear):
    study, out = ear
    edit(study, 'dof = "y,alpha,gamma"', 'dof = "y,alpha,gamma"\nestimator = "pinv"')
    result = run_study(study, out)
    assert reused(result) == {"scan": True, "motion": True, "fit": False, "report": False}
    assert result.kd["estimator"] == "pinv"


def test_refits_and_parts_of_the_band_are_in_the_result_and_the_report(ear):
    study, out = ear
    edit(study, 'dof = "y,alpha,gamma"', 'dof = "y,alpha,gamma"\nmonte_carlo = 40\nbands = 3')
    result = run_study(study, out)
    assert result.kd["monte_carlo"]["refits"] == 40
    assert len(result.kd["frequency_dependence"]["bands_hz"]) == 3
    html = (out / "report.html").read_text(encoding="utf-8")
    assert "K and D over the band" in html
    assert "40 simulated repetitions" in html


@pytest.mark.parametrize("name", ["kd.json", "dof.csv", "report.html", ".stapeskit/fit.sections.json"])
def test_a_missing_output_or_an_edited_record_is_made_anew(ear, name):
    study, out = ear
    before = contents(out)
    if name.startswith(".stapeskit"):
        (out / name).write_bytes(before[name][:-20])
        result = run_study(study, out)
        assert not all(reused(result).values())
        assert reused(result)["scan"]
        assert contents(out)[name] != before[name][:-20]
    (out / name).unlink()
    assert not all(reused(run_study(study, out)).values())
    assert (out / name).exists()


@pytest.mark.parametrize("name", ["kd.json", "dof.csv", "report.html"])
def test_an_edited_output_is_replaced_by_force_alone(ear, name):
    study, out = ear
    (out / name).write_bytes(b"edited by hand")
    before = contents(out)
    with pytest.raises(StapeskitError, match=rf"{name}, edited since.*--force"):
        run_study(study, out)
    assert contents(out) == before
    run_study(study, out, force=True)
    assert contents(out)[name] != before[name]
    assert all(reused(run_study(study, out)).values())


def test_outputs_whose_own_record_is_missing_are_known_by_those_of_the_stages(ear):
    study, out = ear
    (out / ".stapeskit" / "scan2kd-report.html.json").unlink()
    assert all(reused(run_study(study, out)).values())
    edit(study, "1382.4+-14", "1400+-14")
    (out / ".stapeskit" / "scan2kd-report.html.json").unlink()
    assert not reused(run_study(study, out))["scan"]


@pytest.mark.parametrize("key", ["landmarks", "plate_fiducials"])
def test_an_output_that_the_study_reads_is_refused(ear, key):
    study, out = ear
    edit(study, "[ldv]", f'{key} = "../out/dof.csv"\n[ldv]')
    before = contents(out)
    for force in (False, True):
        with pytest.raises(StapeskitError, match=r"must be another file than the inputs"):
            run_study(study, out, force=force)
    assert contents(out) == before


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"schema": "stapeskit.stage/1"}'])
def test_a_corrupt_record_is_not_believed(ear, text):
    study, out = ear
    (out / ".stapeskit" / "fit.json").write_text(text)
    result = run_study(study, out)
    assert not reused(result)["fit"]
    assert reused(result)["motion"]


def test_changed_vibrometer_data_make_motion_and_fit_anew(ear):
    study, out = ear
    table = study.parent / "ldv.csv"
    lines = table.read_text(encoding="utf-8").splitlines()
    table.write_text("\n".join(line for line in lines if not line.startswith("stapes,3,")) + "\n")
    assert reused(run_study(study, out)) == {"scan": True, "motion": False, "fit": False, "report": False}


def test_force_makes_everything_anew(ear, monkeypatch):
    study, out = ear
    called = []
    for stage in stages.STAGES:

        def counted(*words, stage=stage):
            called.append(stage.name)
            return stage.run(*words)

        set_run(monkeypatch, stage.name, counted)
    run_study(study, out, force=True)
    assert called == ["scan", "motion", "fit"]


def test_files_among_which_a_run_was_killed_are_made_anew(ear):
    study, out = ear
    path = out / ".stapeskit" / "scan2kd-report.html.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**record, "unfinished": ["mass.json", "kd.json"]}), encoding="utf-8")
    assert not any(reused(run_study(study, out)).values())
    assert "unfinished" not in json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("fault", [KeyboardInterrupt, RuntimeError, StapeskitError])
@pytest.mark.parametrize("where", [0, 2])
def test_an_interrupted_run_leaves_nothing(ear, tmp_path, monkeypatch, fault, where):
    study, out = ear
    before = contents(tmp_path)
    edit(study, "1382.4+-14", "1390+-14")
    changed = contents(tmp_path)

    def stop(*_):
        raise fault("stopped")

    if where == 2:
        fake = json.loads((out / "mass.json").read_text(encoding="utf-8")) | {"warnings": []}

        def scan(_study, work):
            (work.fresh / "mass.json").write_text(json.dumps(fake))
            (work.fresh / "stapes.ply").write_bytes((out / "stapes.ply").read_bytes())
            return ["mass.json", "stapes.ply"], StageReport()

        set_run(monkeypatch, "scan", scan)
    set_run(monkeypatch, stages.STAGES[where].name, stop)
    with pytest.raises(fault):
        run_study(study, out)
    assert contents(tmp_path) == changed
    assert set(before) == set(changed)
    with pytest.raises(fault):
        run_study(study, tmp_path / "new" / "deep")
    assert not (tmp_path / "new").exists()


def test_labels_of_the_output_folder_that_the_study_names_are_no_output(ear):
    study, out = ear
    (out / "labels.nrrd").write_bytes(b"corrected by hand")
    with pytest.raises(StapeskitError, match=r"labels\.nrrd, which it is not known to have written"):
        run_study(study, out)
    edit(study, 'file = "stapes.ply"', 'labels = "../out/labels.nrrd"')
    made = output_set(study, read_study(study), out)
    made.check()
    assert "labels.nrrd" not in made.names
    assert "labels.measured.nrrd" in made.names
    assert out / "labels.nrrd" in {path.resolve() for path in made.inputs}


def test_outputs_that_no_longer_belong_are_removed(ear):
    study, out = ear
    record = out / ".stapeskit" / "scan.json"
    content = json.loads(record.read_text(encoding="utf-8"))
    (out / "plate.ply").write_bytes(b"of another scan")
    content["outputs"]["plate.ply"] = content_hash(out / "plate.ply")
    record.write_text(json.dumps(content))
    (out / "mine.txt").write_text("the user's own")
    edit(study, "1382.4+-14", "1400+-14")
    runs = {run.name: run.reused for run in run_study(study, out).stages}
    assert runs["motion"]  # which depends on the surfaces of the scan as it is now
    assert not (out / "plate.ply").exists()
    assert (out / "mine.txt").exists()


def test_faults_of_the_table_are_told_before_the_scan_is_read(ear, monkeypatch):
    study, out = ear
    edit(study, 'dof = "y,alpha,gamma"', 'dof = "y,alpha,gamma"\nstructure = "stirrup"')
    table = study.parent / "fiducials.csv"
    set_run(monkeypatch, "scan", lambda *_: pytest.fail("the scan was read"))
    with pytest.raises(StapeskitError, match=r"the body stirrup must be among .*with fit.structure"):
        run_study(study, out)
    table.write_text(table.read_text(encoding="utf-8").replace("f1,", "f1,oops"))
    with pytest.raises(StapeskitError, match=r"fiducials\.csv"):
        run_study(study, out, force=True)


def test_dof_of_the_fit_must_be_measured(ear):
    study, out = ear
    edit(study, 'points = "points.csv"', 'points = "points.csv"\ndof = "x,y,z"')
    with pytest.raises(StapeskitError, match=r"fit.dof must be among ldv.dof, x, y, z; got alpha, gamma"):
        run_study(study, out)


def test_progress_is_one_line_a_stage_where_there_is_no_terminal(ear):
    study, out = ear
    stream = io.StringIO()
    run_study(study, out, progress=Progress(stream=stream))
    lines = stream.getvalue().splitlines()
    assert len(lines) == 5
    assert all(re.search(r"\d+\.\d s", line) for line in lines)
    assert sum("reused" in line for line in lines) == 4
    assert "\x1b" not in stream.getvalue()


def test_a_table_that_is_corrected_while_the_scan_is_measured_counts_as_it_is_then(
    ear, tmp_path, monkeypatch
):
    study, out = ear
    points = study.parent / "points.csv"
    first = points.read_text(encoding="utf-8")
    header, row, *rest = first.splitlines()
    cells = row.split(",")
    place = header.split(",").index("x_mm")
    cells[place] = f"{float(cells[place]) + 0.01:.4f}"
    corrected = "\n".join([header, ",".join(cells), *rest]) + "\n"
    whole = stages.STAGES[0].run

    def scan(study_, work):
        points.write_text(corrected)
        return whole(study_, work)

    set_run(monkeypatch, "scan", scan)
    run_study(study, out, force=True)
    monkeypatch.undo()
    points.write_text(corrected)
    (tmp_path / "again").mkdir()
    stages.run_stage("motion", study, out, tmp_path / "again")
    assert (out / "dof.csv").read_bytes() == (tmp_path / "again" / "dof.csv").read_bytes()
