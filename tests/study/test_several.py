"""Several studies: a folder each; a crash costs one ear; failed ears are listed with their reason."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from pathlib import Path

import pandas as pd
import pytest

from pipeline.cli import work
from pipeline.cluster import run_on_dask
from pipeline.run import StudyResult
from pipeline.several import check_choices, folder_names, read_studies, run_here, run_studies
from pipeline.study import read_study
from simulate import Truth
from stapeskit.faults import StapeskitError


def test_folders_have_different_names() -> None:
    paths = [Path("a/study.toml"), Path("b/study.toml"), Path("c/ear.toml"), Path("d/Ear.toml")]
    assert folder_names(paths) == ["a", "b", "ear", "Ear-2"]
    assert folder_names([Path("cohort.csv.toml"), Path("x/cohort.csv.toml")])[0] != "cohort.csv"


def test_a_failed_ear_stands_in_the_table_with_its_reason(
    small: tuple[Path, Truth], finished: StudyResult, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = []
    for name in ("one", "two"):
        folder = tmp_path / name
        folder.mkdir()
        for path in small[0].iterdir():
            (folder / path.name).write_bytes(path.read_bytes())
        names.append(folder / "study.toml")
    (tmp_path / "two" / "scan.nrrd").write_bytes(b"NRRD0004\nbroken")
    shutil.copytree(finished.out, tmp_path / "out" / "one")  # its scan is not measured again
    pictures = tmp_path / "pictures"
    words = ["--out", str(tmp_path / "out"), "--jobs", "2", "--figures", str(pictures)]
    outcome = work([*map(str, names), *words])
    assert outcome is not None
    assert [path.name for path in pictures.iterdir()] == ["one"]
    assert {path.suffix for path in (pictures / "one").iterdir()} >= {".pdf", ".svg"}
    assert dict(outcome.rows)["failed"] == "two"
    assert len(capsys.readouterr().err.splitlines()) == 2
    table = pd.read_csv(tmp_path / "out" / "cohort.csv", dtype=str).fillna("")
    assert list(table["study"]) == [finished.study.about.name, "two"]
    assert table["error"].iloc[1]
    assert table["verdict"].iloc[0] in ("believe", "check", "do not use")


def test_an_output_folder_around_an_input_is_refused(small: tuple[Path, Truth], tmp_path: Path) -> None:
    shutil.copytree(small[0], tmp_path / "study")
    with pytest.raises(StapeskitError):
        run_studies([tmp_path / "study" / "study.toml"], tmp_path, run_here(1))


def test_what_is_wrong_with_several_studies_is_said_together_before_any_runs(
    small: tuple[Path, Truth], tmp_path: Path
) -> None:
    for name in ("one", "two", "three"):
        shutil.copytree(small[0], tmp_path / name)
    study = tmp_path / "one" / "study.toml"
    for name in ("two", "three"):
        (tmp_path / name / "scan.nrrd").unlink()
    with pytest.raises(StapeskitError) as raised:
        read_studies([tmp_path / name / "study.toml" for name in ("one", "two", "three")])
    assert [Path(str(fault.where)).parent.name for fault in raised.value.faults] == ["two", "three"]
    with pytest.raises(StapeskitError) as raised:
        read_studies([study, study])
    assert raised.value.faults[0].expected == "given once"
    for wrong in ("K99~mass", "K11~masss", "K11"):
        with pytest.raises(StapeskitError) as raised:
            check_choices(read_studies([study]), {"laws": ["K22~mass", wrong]})
        assert raised.value.faults[0].thing == "--laws"
    check_choices(read_studies([study]), {"laws": ["K_principal_2~mass", "D33~gap"]})


def test_the_template_is_read_once_its_files_exist(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert work(["--template"]) is None
    text = capsys.readouterr().out
    for name in ("scan.tif", "ldv.csv", "points.csv", "fiducials.csv"):
        (tmp_path / name).touch()
    (tmp_path / "study.toml").write_text(text, encoding="utf-8")
    study = read_study(tmp_path / "study.toml")
    assert study.scan.file == tmp_path / "scan.tif"
    assert set(study.inputs()) >= {"study", "scan.file", "ldv.file"}


def test_a_check_computes_and_writes_nothing(
    small: tuple[Path, Truth], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ct_inertia.ct2mass.measure_mass", None)
    outcome = work([str(small[0] / "study.toml"), "--check"])
    assert outcome is not None
    assert len(outcome.rows) == 1
    assert not list(tmp_path.iterdir())


_KILLER = """
import os, signal, sys
mark = os.environ.get("KILLED_ONCE", "")
if "killer" in " ".join(sys.orig_argv) and "pipeline.cli" in sys.orig_argv and not os.path.exists(mark):
    open(mark, "w").close()
    os.kill(os.getppid(), signal.SIGKILL)
"""


def test_a_killed_worker_costs_the_time_of_one_ear(
    small: tuple[Path, Truth], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process of one study kills the worker that runs it, once: the study is run again."""
    distributed = pytest.importorskip("distributed")
    studies = []
    for name in ("killer", "other"):
        shutil.copytree(small[0], tmp_path / name)
        (tmp_path / name / "scan.nrrd").write_bytes(b"NRRD0004\nbroken")  # ends at once, with its fault
        studies.append((tmp_path / name / "study.toml").rename(tmp_path / name / f"{name}.toml"))
    (tmp_path / "start").mkdir()
    (tmp_path / "start" / "sitecustomize.py").write_text(_KILLER)
    root = str(Path(__file__).parents[2])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "start"), root]))
    monkeypatch.setenv("KILLED_ONCE", str(tmp_path / "killed"))
    with distributed.LocalCluster(
        1, processes=True, threads_per_worker=1, dashboard_address=None, scheduler_port=0
    ) as cluster:
        result = run_studies(studies, tmp_path / "out", run_on_dask(cluster.scheduler_address))
    assert (tmp_path / "killed").exists()
    assert {name: end.code for name, end in result.ends.items()} == {"killer": 2, "other": 2}
    assert all("scan.nrrd" in end.fault for end in result.ends.values())


def test_an_interruption_ends_the_study_at_work_and_begins_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = tmp_path / "begun"
    program = tmp_path / "program"
    program.write_text(f'#!/bin/sh\necho "$4" >> "{begun}"\nexec sleep 60\n')
    program.chmod(0o755)
    monkeypatch.setattr("sys.executable", str(program))

    def interrupt() -> None:
        while not begun.exists():
            time.sleep(0.02)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    started = time.monotonic()
    threading.Thread(target=interrupt, daemon=True).start()
    studies = {name: tmp_path / name for name in ("one", "two", "three")}
    # a program that a shell starts in the background ignores SIGINT; commands set their own answer to it
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            run_here(1)(studies, tmp_path / "out", False, lambda _name, _end: None)
    finally:
        signal.signal(signal.SIGINT, before)
    assert time.monotonic() - started < 20.0
    assert begun.read_text().splitlines() == [str(tmp_path / "one")]
