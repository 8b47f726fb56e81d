"""Studies on this machine: each on its own, several at a time, every end named."""

import threading
import time

import pytest

from legacy.pipeline.runners import Where
from legacy.pipeline.runners.local import run
from legacy.pipeline.runners.study_process import run_task
from tests.pipeline.runners.helpers import Report, results, tasks


def test_every_study_ends_and_a_second_run_does_what_is_left(tmp_path):
    plans = {"a": "", "b": 'fails = "input"', "c": 'fails = "killed"'}
    report = Report()
    run(tasks(tmp_path, plans), Where(3), report.tell, report.ended)
    assert {name: end.code for name, end in report.ends.items()} == {"a": 0, "b": 2, "c": 2}
    assert report.ends["a"].name == "a"
    assert "signal 9" in report.ends["c"].fault
    assert ("a", "scan 0.1 s") in report.lines
    assert list(results(tmp_path)) == ["a"]
    again = Report()
    run(tasks(tmp_path, {"a": "", "c": ""}), Where(2), again.tell, again.ended)
    assert again.ends["a"].name == "reused"
    assert list(results(tmp_path)) == ["a", "c"]


def test_a_crash_stays_a_bug(tmp_path):
    end = run_task(tasks(tmp_path, {"a": 'fails = "crash"'})[0], lambda _: None)
    assert end.code == 1
    assert "signal 6" in end.fault


def test_a_study_beyond_its_memory_is_ended(tmp_path):
    task = tasks(tmp_path, {"a": "mebibytes = 200\nseconds = 30"})[0]
    begun = time.monotonic()
    end = run_task(task, lambda _: None, memory_bytes=150 * 2**20)
    assert time.monotonic() - begun < 15
    assert end.code == 2
    assert "0.15 GiB" in end.fault
    assert not results(tmp_path)


def test_a_study_that_is_given_up_leaves(tmp_path):
    stop = threading.Event()
    task = tasks(tmp_path, {"a": "seconds = 30"})[0]
    threading.Timer(1.0, stop.set).start()
    begun = time.monotonic()
    assert run_task(task, lambda _: None, stop.is_set).code == 2
    assert time.monotonic() - begun < 10


def test_an_error_of_the_listener_ends_all(tmp_path):
    def broken(_name, _end):
        raise ValueError("no more")

    begun = time.monotonic()
    with pytest.raises(ValueError, match="no more"):
        run(tasks(tmp_path, {"a": "", "b": "seconds = 30"}), Where(2), Report().tell, broken)
    assert time.monotonic() - begun < 10
