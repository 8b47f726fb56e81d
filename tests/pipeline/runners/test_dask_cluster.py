"""A cluster on loopback: a scheduler and two workers, one of which is killed in the middle of its study."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from distributed import KilledWorker

from legacy.pipeline.errors import PipelineError
from legacy.pipeline.runners import Where, dask_cluster, local
from legacy.pipeline.runners.dask_cluster import _end_of, _Order, _refusal
from legacy.pipeline.runners.study_process import Task
from legacy.pipeline.several_studies import run_studies
from legacy.pipeline.stage_records import code_hash
from tests.pipeline.runners.helpers import Report, results, tasks

ROOT = Path(__file__).parents[3]


@contextmanager
def processes(folder, workers=2, memory="auto"):
    """Run a scheduler and workers; yield the address and the processes, the scheduler first."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "DASK_TEMPORARY_DIRECTORY": str(folder)}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment, "cwd": folder}
    file = folder / "scheduler.json"
    common = [sys.executable, "-m", "dask"], ["--no-dashboard", "--scheduler-file", str(file)]

    def start(*words):
        return subprocess.Popen([*common[0], *words, *common[1]], **quiet)

    started = [start("scheduler", "--host", "127.0.0.1", "--port", "0")]
    one = ("worker", "--nthreads", "1", "--no-nanny", "--memory-limit", memory)
    started += [start(*one, "--name", f"w{k}") for k in range(workers)]
    try:
        wait_for("scheduler.json", folder)
        yield json.loads(file.read_text())["address"], started
    finally:
        for process in started:
            process.kill()
        for process in started:
            process.wait()


def wait_for(pattern, folder, count=1):
    for _ in range(1500):
        if len(list(folder.glob(pattern))) >= count:
            return
        time.sleep(0.02)
    raise AssertionError(pattern)


def wait_for_end_of_one(pattern, folder):
    """Wait until one of the studies that have started has ended with its worker."""
    numbers = [int(path.name.rsplit("-", 1)[1]) for path in folder.glob(pattern)]
    with suppress(ProcessLookupError):
        for _ in range(1500):
            for number in numbers:
                os.kill(number, 0)
            time.sleep(0.02)
        raise AssertionError("a study outlives its worker")


class Asked(Report):
    """A cohort that runs on a cluster, in a thread."""

    def __init__(self, folder, plans, address):
        super().__init__()
        where = Where(address=address, shared=folder / "out")
        arguments = (tasks(folder, plans), where, self.tell, self.ended)
        self.thread = threading.Thread(target=dask_cluster.run, args=arguments)
        self.thread.start()

    def codes(self):
        self.thread.join(60)
        assert not self.thread.is_alive()
        return {name: end.code for name, end in self.ends.items()}


def test_a_killed_worker_and_a_lost_scheduler(tmp_path, monkeypatch):
    monkeypatch.setattr("legacy.pipeline.stage_records.code_hash", code_hash)
    plans = {"a": 'after = "go"', "b": 'after = "go" #', "c": "", "d": 'fails = "input"'}
    folder, quiet = tmp_path / "there", tmp_path / "here"
    folder.mkdir()
    quiet.mkdir()
    with processes(tmp_path) as (address, (scheduler, first, _)):
        cohort = Asked(folder, plans, address)
        wait_for("started-[ab]-*", folder / "out", 2)
        first.send_signal(signal.SIGKILL)
        first.wait()
        wait_for_end_of_one("started-[ab]-*", folder / "out")
        (folder / "go").touch()
        (quiet / "go").touch()
        local.run(tasks(quiet, plans), Where(4), Report().tell, Report().ended)
        assert cohort.codes() == {"a": 0, "b": 0, "c": 0, "d": 2}
        assert results(folder) == results(quiet)
        assert len(list((folder / "out").glob("started-[ab]-*"))) == 3
        assert ("c", "scan 0.1 s") in cohort.lines
        more = Asked(folder, {"h": "seconds = 20"}, address)
        wait_for("started-h-*", folder / "out")
        scheduler.kill()
        assert more.codes() == {"h": 2}
    assert "scheduler was lost" in more.ends["h"].fault
    assert not list((folder / "out").glob("cluster-*"))
    rest = Report()
    local.run(tasks(folder, {"a": "", "c": "", "h": ""}), Where(3), rest.tell, rest.ended)
    assert [rest.ends[name].name for name in "ach"] == ["reused", "reused", "h"]


def test_an_ear_beyond_the_memory_of_its_worker_has_its_sentence_in_the_cohort(ear, tmp_path, monkeypatch):
    monkeypatch.setattr("legacy.pipeline.stage_records.code_hash", code_hash)
    program = "tests.pipeline.runners.heavy_child"
    monkeypatch.setattr("legacy.pipeline.several_studies.Task", partial(Task, program=program))
    study, out = ear
    (tmp_path / "all").mkdir()
    out.rename(tmp_path / "all" / "ear1")
    heavy = study.parent.with_name("heavy")
    shutil.copytree(study.parent, heavy)
    with processes(tmp_path, memory="700 MiB") as (address, _):
        result = run_studies([study, heavy / "study.toml"], tmp_path / "all", scheduler=address)
    assert [one.folder for one in result.ears] == ["ear1"]
    assert result.codes == {"heavy": 2}
    with (tmp_path / "all" / "cohort.csv").open() as stream:
        done, failed = csv.DictReader(stream)
    assert (done["folder"], done["error"]) == ("ear1", "")
    assert failed["folder"] == "heavy"
    assert "0.68 GiB that a study may take on this worker. Start workers with more." in failed["error"]
    assert not (tmp_path / "all" / "heavy").exists()


def test_no_scheduler_is_a_fault(tmp_path, monkeypatch):
    monkeypatch.setattr("legacy.pipeline.runners.dask_cluster._CONNECT_S", 0.3)
    with pytest.raises(PipelineError) as refused:
        dask_cluster.run([], Where(address="tcp://127.0.0.1:9", shared=tmp_path), print, print)
    assert refused.value.faults[0].thing == "{scheduler}"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("address", ["host", "tcp://host", "host:port"])
def test_an_address_without_a_port_is_refused_at_once(address, tmp_path):
    with pytest.raises(PipelineError) as refused:
        dask_cluster.run([], Where(address=address, shared=tmp_path), print, print)
    assert refused.value.faults[0].got == address


def test_a_study_that_takes_its_workers_down_is_named():
    fault = KilledWorker("a", SimpleNamespace(address="tcp://10.0.0.2:1"), 3)
    end = _end_of(SimpleNamespace(status="error", exception=lambda: fault), disconnected=False)
    assert end.code == 2
    assert "tcp://10.0.0.2:1" in end.fault


@pytest.mark.parametrize("wrong", ["versions", "mark", "study"])
def test_a_worker_refuses_what_it_cannot_do_alike(wrong, tmp_path):
    task = tasks(tmp_path, {"a": ""})[0]
    order = _Order(task, {"numpy": "0"} if wrong == "versions" else {}, tmp_path, "topic")
    if wrong == "mark":
        order = _Order(task, {}, tmp_path / "elsewhere", "topic")
    if wrong == "study":
        task.study.unlink()
    assert _refusal(order)
    (tmp_path / "a.toml").touch()
    assert not _refusal(_Order(task, {}, tmp_path, "topic"))
