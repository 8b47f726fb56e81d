"""A damaged file neither holds up nor ends the program: libraries read it in a child process."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from stapeskit import sandbox
from stapeskit.faults import Fault, StapeskitError
from stapeskit.sandbox import Session, read_apart


@pytest.fixture
def path(tmp_path: Path) -> Path:
    found = tmp_path / "scan.h5"
    found.write_bytes(b"content")
    return found


def children() -> set[str]:
    """Return the processes that were started here and have not been waited for."""
    tasks = Path("/proc/self/task").iterdir()
    return {child for task in tasks for child in (task / "children").read_text().split()}


def open_numbers():
    """Describe a source and answer with so many numbers; -1 crashes, -2 raises, -3 needs memory, -4 hangs."""

    def answer(request):
        if request == -1:
            os.kill(os.getpid(), signal.SIGSEGV)
        if request == -2:
            return np.zeros(1) + np.zeros((2, 2)) @ np.zeros(3)
        if request == -3:
            return np.ones(1 << 32, dtype=np.uint8)
        if request == -4:
            time.sleep(60.0)
        return np.arange(request)

    return {"name": "numbers"}, answer


def spin() -> None:
    while True:
        pass


@pytest.fixture(params=[True, False], ids=["forked", "in the process"])
def forked(request, monkeypatch) -> bool:
    if not request.param:
        monkeypatch.setattr(sandbox, "can_fork", lambda: False)
    return request.param


def test_results_come_back_as_they_were(path: Path, forked: bool) -> None:
    def content():
        turned = np.arange(6.0).reshape(2, 3).T
        return {"a": np.arange(5), "t": turned, "part": turned[::2], "text": "a", "none": np.zeros((0, 3))}

    direct, apart = content(), read_apart(content, path, "a file")
    assert list(apart) == list(direct)
    for name in ("a", "t", "part", "none"):
        assert np.array_equal(apart[name], direct[name])
        assert apart[name].dtype == direct[name].dtype
        assert apart[name].flags.writeable
    assert apart["text"] == "a"


@pytest.mark.parametrize(
    "work", [spin, lambda: time.sleep(60.0), lambda: os.kill(os.getpid(), signal.SIGSEGV), os.abort]
)
def test_what_hangs_or_crashes_is_refused_and_leaves_no_process(work, path: Path, monkeypatch) -> None:
    monkeypatch.setattr(sandbox, "CLOCK", 20.0)
    before = children()
    with pytest.raises(StapeskitError) as found:
        read_apart(work, path, "an HDF5 file", limit_s=0.1)
    (fault,) = found.value.faults
    assert (fault.thing, fault.expected, fault.where) == ("an HDF5 file", "readable", "scan.h5")
    assert children() <= before


def test_too_much_memory_stays_in_the_child(path: Path) -> None:
    with pytest.raises(StapeskitError) as found:
        read_apart(lambda: np.zeros(1 << 30, dtype=np.uint8) + 1, path, "a file")
    assert "MB" in found.value.faults[0].got


def test_faults_pass_as_they_are_and_other_errors_become_one(path: Path, forked: bool) -> None:
    def refuse():
        raise StapeskitError(Fault("a", "b", "c"), Fault("d"))

    with pytest.raises(StapeskitError) as refused:
        read_apart(refuse, path, "a file")
    assert refused.value.faults == (Fault("a", "b", "c"), Fault("d"))
    with pytest.raises(StapeskitError) as library:
        read_apart(lambda: 1 / 0, path, "a file")
    (fault,) = library.value.faults
    assert (fault.thing, fault.where) == ("a file", "scan.h5")
    assert fault.got.startswith("ZeroDivisionError")
    assert "test_sandbox.py" in library.value.__notes__[0]


def test_a_session_answers_requests_of_several_threads(path: Path, forked: bool) -> None:
    with Session(open_numbers, path, "the scan") as session:
        assert session.opened == {"name": "numbers"}
        answers: dict[int, np.ndarray] = {}

        def work(size: int) -> None:
            answers[size] = session.ask(size)

        threads = [threading.Thread(target=work, args=(size,)) for size in range(1, 12)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert all(np.array_equal(answer, np.arange(size)) for size, answer in answers.items())
    assert len(answers) == 11


def test_a_fault_of_one_request_leaves_the_session_open_and_a_crash_ends_it(path: Path, monkeypatch) -> None:
    monkeypatch.setattr(sandbox, "CLOCK", 1.0)
    before = children()
    session = Session(open_numbers, path, "the scan", limit_s=1.0)
    for request in (-2, -3):
        with pytest.raises(StapeskitError):
            session.ask(request)
        assert len(session.ask(3)) == 3
    with pytest.raises(StapeskitError) as crashed:
        session.ask(-1)
    assert "crash" in crashed.value.faults[0].got
    with pytest.raises(StapeskitError):
        session.ask(3)
    with pytest.raises(StapeskitError), Session(open_numbers, path, "the scan", limit_s=1.0) as hanging:
        hanging.ask(-4)
    assert children() <= before


def test_a_child_ends_with_its_parent(path: Path) -> None:
    """Also when the parent is killed while a second session is open."""
    reader, writer = os.pipe()
    parent = os.fork()
    if parent == 0:
        first, second = Session(open_numbers, path, "a"), Session(open_numbers, path, "b")
        os.write(writer, f"{first._child} {second._child}".encode())
        os.kill(os.getpid(), signal.SIGKILL)
    children = [int(word) for word in os.read(reader, 100).split()]
    os.waitpid(parent, 0)
    os.close(reader), os.close(writer)
    limit = time.monotonic() + 5.0
    while any(Path(f"/proc/{child}/cmdline").is_file() and _runs(child) for child in children):
        assert time.monotonic() < limit
        time.sleep(0.02)


def _runs(child: int) -> bool:
    try:
        return Path(f"/proc/{child}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
