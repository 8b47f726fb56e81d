"""The process of a command, seen from outside: signals, standard streams, limits, exit codes."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

SLEEP = "import time; print('at work', flush=True); time.sleep(30)"
SWALLOW = """
print('at work', flush=True)
while True:
    try:
        __import__('time').sleep(30)
    except KeyboardInterrupt:
        pass
"""
STAGED = """
from pathlib import Path
from legacy.stapeskit.outputs import stage_outputs
with stage_outputs(Path('out')) as stage:
    (stage / 'half').write_text('half')
    print('at work', flush=True)
    while True:
        try:
            __import__('time').sleep(30)
        except KeyboardInterrupt:
            pass
"""
CONVERT = """
print('at work', flush=True)
try:
    __import__('time').sleep(30)
except KeyboardInterrupt:
    raise RuntimeError('Object visitation failed')
"""
LOST = """
class Last:
    def __del__(self):
        print('at work', flush=True)
        __import__('time').sleep(30)
last = Last()
del last
__import__('time').sleep(30)
"""
THREAD = """
from legacy.stapeskit.background import Later
Later(__import__('time').sleep, 30)
print('at work', flush=True)
__import__('time').sleep(30)
"""
STARVED = """
import legacy.stapeskit.process
from legacy import stapeskit
def starved(_fault):
    raise MemoryError
stapeskit.process._sentence = starved
raise MemoryError
"""
HASHED = """
from pathlib import Path
from legacy.stapeskit.faults import Fault, StapeskitError
from legacy.stapeskit.provenance import Hashes
with open('large', 'wb') as stream:
    stream.truncate(1 << 42)
hashes = Hashes([Path('large')])
raise StapeskitError(Fault('it', 'sound', 'damaged'))
"""
PLACING = """
import os, signal
from pathlib import Path
from legacy.stapeskit.outputs import stage_outputs
replace = os.replace
def slow(source, target):
    if target.name == 'b':
        os.kill(os.getpid(), signal.SIGINT)
        __import__('time').sleep(0.05)
    replace(source, target)
os.replace = slow
with stage_outputs(Path('.')) as stage:
    for name in 'abc':
        (stage / name).write_text(name)
"""


def command(body, words=("tool",), before=""):
    """Return what runs ``body`` as the work of a command."""
    lines = "\n".join(f"    {line}" for line in body.strip().splitlines())
    code = f"{before}\nfrom stapeskit.process import run\ndef work(_words):\n{lines}\nrun('tool', work)"
    return [sys.executable, "-c", code, *words[1:]]


def environment(**more):
    return os.environ | {"PYTHONPATH": str(ROOT)} | more


def start(body, folder):
    process = subprocess.Popen(command(body), cwd=folder, env=environment(), text=True, stdout=-1, stderr=-1)
    assert process.stdout.readline() == "at work\n"
    return process


def run(body, folder, **options):
    options = {"stdout": -1, "stderr": -1, "env": environment(), "check": False, "timeout": 60} | options
    return subprocess.run(command(body), cwd=folder, text=True, **options)


@pytest.mark.parametrize("body", [SLEEP, SWALLOW, LOST, CONVERT, STAGED, THREAD])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_ends_every_command_at_once(body, number, tmp_path):
    process = start(body, tmp_path)
    began = time.monotonic()
    process.send_signal(number)
    _, told = process.communicate(timeout=30)
    assert process.returncode == 130
    assert told == "tool: interrupted; nothing was written.\n"
    assert list(tmp_path.iterdir()) == []
    # 0.7 s by itself; the machine may be at other work
    assert time.monotonic() - began < 5.0


def test_an_impatient_user_changes_nothing(tmp_path):
    process = start(STAGED, tmp_path)
    for _ in range(5):
        process.send_signal(signal.SIGINT)
        time.sleep(0.01)
    _, told = process.communicate(timeout=30)
    assert (process.returncode, told) == (130, "tool: interrupted; nothing was written.\n")
    assert list(tmp_path.iterdir()) == []


def test_an_interruption_waits_until_a_set_of_outputs_is_whole(tmp_path):
    ended = run(PLACING, tmp_path)
    assert ended.returncode == 130
    assert ended.stderr == "tool: interrupted; the outputs had been written.\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]


def test_a_refusal_does_not_wait_for_the_hash_of_a_large_file(tmp_path):
    ended = run(HASHED, tmp_path)
    assert (ended.returncode, ended.stderr) == (2, "it must be sound; got damaged.\n")


SAYS = "print('± \\udcff', flush=True)\nprint('more')"


@pytest.mark.parametrize("coding", ["ascii", "latin-1", "utf-8"])
def test_any_character_can_be_printed(coding, tmp_path):
    ended = run(SAYS, tmp_path, env=environment(PYTHONIOENCODING=coding), encoding="latin-1")
    assert ended.returncode == 0
    assert ended.stderr == ""


@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2)])
def test_closed_streams_are_no_fault(closed, tmp_path):
    body = "import sys\nprint('text')\nsys.stderr.write('text')\nopen('result', 'w').write('whole')"
    close = f'exec {" ".join(f"{number}>&-" for number in closed)}; exec "$@"'
    ended = subprocess.run(
        ["sh", "-c", close, "sh", *command(body)], cwd=tmp_path, env=environment(), check=False
    )
    assert ended.returncode == 0
    assert (tmp_path / "result").read_text(encoding="utf-8") == "whole"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no device that is always full")
def test_a_full_standard_output_is_a_fault_of_the_system(tmp_path):
    body = """
from argparse import Namespace
from legacy.stapeskit.command import Outcome
return Namespace(quiet=False, json=False), Outcome('title', [])
"""
    with open("/dev/full", "w") as full:
        ended = run(body, tmp_path, stdout=full)
    assert ended.returncode == 2
    assert "standard output must be writable" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_reader_that_leaves_is_no_fault(tmp_path):
    body = "import sys\nsys.stdout.write('x' * 10**6)"
    with subprocess.Popen(command(body), cwd=tmp_path, env=environment(), stdout=-1, stderr=-1) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == 0


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("open('missing/file')", "missing/file must be readable"),
        ("import os\nos.symlink('loop', 'loop')\nopen('loop')", "loop must be readable"),
        ("open('.')", ". must be readable"),
        ("open('x' * 300, 'w')", "Choose a shorter name"),
        ("raise MemoryError", "not enough memory"),
        ('raise RuntimeError("can\'t start new thread")', "not enough memory"),
        ("raise SystemError('error return without exception set')", "not enough memory"),
        ("raise SystemError('<f> returned NULL without setting an exception')", "not enough memory"),
        (STARVED, "not enough memory"),
    ],
)
def test_faults_of_the_system_are_no_bugs(body, words, tmp_path):
    ended = run(body, tmp_path)
    assert ended.returncode == 2
    assert words in ended.stderr
    assert len(ended.stderr.splitlines()) == 1


def test_a_command_that_may_start_no_thread_still_runs(tmp_path):
    before = 'import threading\ndef start(_):\n    raise RuntimeError("can\'t start new thread")\n'
    before += "threading.Thread.start = start"
    ended = subprocess.run(
        command("print('done')", before=before),
        cwd=tmp_path, env=environment(), text=True, capture_output=True, check=False,
    )  # fmt: skip
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "done\n", "")


def test_a_limit_on_the_size_of_files_leaves_the_old_outputs(tmp_path):
    (tmp_path / "a").write_text("old")
    body = (
        "from pathlib import Path\nfrom stapeskit.outputs import stage_outputs\n"
        "with stage_outputs(Path('.')) as stage:\n"
    )
    body += "    (stage / 'a').write_bytes(bytes(100_000))"
    ended = run(
        body, tmp_path, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
    )
    assert ended.returncode == 2
    assert "ulimit -f" in ended.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").read_text(encoding="utf-8") == "old"


def test_a_bug_stays_a_bug(tmp_path):
    ended = run("{}['key']", tmp_path)
    assert ended.returncode == 1
    assert "KeyError" in ended.stderr
    assert "this is a bug in stapeskit" in ended.stderr


def test_a_style_of_the_working_folder_counts_for_nothing(tmp_path):
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nlines.linewidth: 9\n", encoding="utf-8")
    body = """
import matplotlib
read = matplotlib.rcParams['text.usetex']
from legacy.stapeskit.page.page import new_figure
new_figure(1.0, 1.0)
print(read, matplotlib.rcParams['text.usetex'], matplotlib.rcParams['lines.linewidth'])
"""
    assert run(body, tmp_path).stdout == "True False 1.5\n"


def test_linear_algebra_of_a_command_runs_in_one_thread(tmp_path):
    """Threads of OpenBLAS beside other programs make a fit six times slower."""
    body = "import os, sys\nprint(os.environ['OPENBLAS_NUM_THREADS'], 'numpy' in sys.modules)"
    free = {name: value for name, value in environment().items() if name != "OPENBLAS_NUM_THREADS"}
    assert run(body, tmp_path, env=free).stdout == "1 False\n"
