"""Every command ends with the exit code of the contract, prints once, and imports little."""

from __future__ import annotations

import inspect
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import stapeskit
from stapeskit.command import progress_line

PROGRAM = """
import sys, time
from pathlib import Path
from stapeskit.command import Outcome, run
from stapeskit.faults import Fault, StapeskitError
from stapeskit.warnings import Notice

def work(words):
    kind = words[0]
    if kind == "fault":
        raise StapeskitError(Fault("density", "positive", -3, "study.toml", "Change it"))
    if kind == "bug":
        raise KeyError("nothing")
    if kind == "missing":
        open("no/such/file")
    if kind == "memory":
        raise MemoryError
    if kind == "interrupt":
        raise KeyboardInterrupt
    if kind == "wait":
        print("ready", flush=True)
        time.sleep(30)
    if kind == "names":
        sys.stderr.write("ear " + words[1] + "\\n")
        if words[2:] == ["bug"]:
            raise KeyError(words[1])
        if words[2:] == ["fault"]:
            raise StapeskitError(Fault(words[1], "a file", words[1], words[1], words[1]))
        notices = [Notice("touches_border", words[1])]
        return Outcome(words[1], [("input", words[1])], notices, [Path(words[1])], {"file": words[1]},
                       json="--json" in words)
    if kind == "long":
        return Outcome("long", [("row", "x" * 50)] * 20000)
    notices = [Notice("touches_border", "The stapes touches the border.")]
    return Outcome("done", [("mass", "3.2 mg")], notices, [Path("a.json")], {"mass_kg": 3.2e-6},
                   json="--json" in words, quiet="--quiet" in words)

run("tool", work)
"""


def ran(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, *words], capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize(
    ("kind", "code"), [("ok", 0), ("fault", 2), ("missing", 2), ("memory", 2), ("bug", 1), ("interrupt", 130)]
)
def test_exit_codes(kind: str, code: int) -> None:
    done = ran(kind)
    assert done.returncode == code
    assert ("Traceback" in done.stderr) == (kind == "bug")
    assert bool(done.stdout) == (code == 0)


def test_json_is_the_whole_result_and_warnings_go_to_standard_error() -> None:
    done = ran("ok", "--json")
    assert json.loads(done.stdout) == {"mass_kg": 3.2e-6}
    assert "[touches_border]" in done.stderr
    quiet = ran("ok", "--quiet")
    assert quiet.stdout == quiet.stderr == ""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_signals_end_with_130(name: str) -> None:
    # a shell that runs the tests in the background has its children ignore the interrupt
    heard = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    with subprocess.Popen(
        [sys.executable, "-c", heard + PROGRAM, "wait"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(getattr(signal, name))
        began = time.monotonic()
        _, errors = process.communicate(timeout=20)
    assert process.returncode == 130
    assert time.monotonic() - began < 10.0
    assert errors.count("\n") == 1


def test_a_reader_that_leaves_early_is_no_fault() -> None:
    command = f"{sys.executable} -c '{PROGRAM}' long | head -1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(
        ["bash", "-c", command.replace("'\"", '"')], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0
    assert done.stderr == ""


def processor_seconds(code: str) -> float:
    """Return the least processor time of two runs."""
    times = []
    for _ in range(2):
        before = os.times()
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, check=True, cwd=Path(__file__).parent
        )
        after = os.times()
        times.append(
            after.children_user + after.children_system - before.children_user - before.children_system
        )
    return min(times)


def test_the_front_door_is_light() -> None:
    bare = processor_seconds("pass")
    assert processor_seconds("import stapeskit") - bare < 0.05


@pytest.mark.parametrize("end", ["", "fault", "bug", "--json"])
def test_names_of_files_cannot_steer_the_terminal(end: str) -> None:
    done = ran("names", "scan\x1b[2J\x07\r\x9b31mµ.tif", end)
    said = done.stdout + done.stderr
    assert "scan?[2J" in said
    assert "µ.tif" in said
    assert not {letter for letter in said if not letter.isprintable()} - {"\n", "\t"}


def test_a_terminal_shows_stage_share_and_time_left_and_is_clean_at_the_end(monkeypatch) -> None:
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr("sys.stderr", terminal)
    times = iter((0.0, 0.0, 10.0))
    with monkeypatch.context() as patch:
        patch.setattr("time.monotonic", lambda: next(times))
        with progress_line() as report:
            report("measuring")
            report("measuring", 0.25)
    *_, shown, end = terminal.getvalue().split("\r")
    assert all(word in shown for word in ("measuring", "25 %", "30 s"))
    assert "measuring" not in end


ROOMS = {"ct2mass": "ct_inertia", "points2dof": "kinematics", "dof2kd": "fitting", "scan2kd": "pipeline"}
HEAVY = {"numpy", "scipy", "pandas", "matplotlib", "pydantic", "h5py", "pyvista"}


@pytest.mark.parametrize("command", ROOMS)
def test_help_loads_no_library_that_computes(command: str) -> None:
    program = (
        "import atexit, sys\n"
        "atexit.register(lambda: sys.stderr.write(' '.join(sys.modules)))\n"
        f"sys.argv = ['{command}', '--help']\n"
        f"from {ROOMS[command]}.cli import main\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stdout.startswith(f"usage: {command}")
    assert not HEAVY & set(done.stderr.split())


@pytest.mark.parametrize("command", ["ct2mass", "points2dof", "dof2kd"])
def test_a_function_shows_every_option_of_its_command(command: str) -> None:
    """`inspect.signature` is what notebooks complete from: names, types, defaults."""
    from pipeline.options_page import COMMANDS

    shown = inspect.signature(getattr(stapeskit, command)).parameters
    table = COMMANDS[command][0]
    entries = [entry for entry in table.entries() if not entry.positional]
    assert len(entries) > 10
    for entry in entries:
        assert shown[entry.name].default == entry.default
        assert shown[entry.name].annotation == entry.annotation
