"""Run one study in a separate process: a crash or lack of memory ends that study alone."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_PATIENCE_S = 20.0  # for the process to clean up after it was asked to leave
_ASK_AGAIN_S = 3.0  # not sooner: a second signal would interrupt the cleaning up
# Pause between two looks at the process.
_POLL_S = 0.02
_MEMORY_POLLS = 10  # memory is looked at once in so many polls
# One thread each: sums then have one order, and the numbers do not depend on how many studies run at a time.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
AGAIN = "Run the same command again: finished ears are reused"


@dataclass(frozen=True)
class Task:
    """A study to be run: a study file in, a folder out.

    Attributes
    ----------
    name : str
        Of its folder in the cohort.
    study, folder : Path
        Absolute.
    force : bool
        Make every stage anew.
    program : str
        The module that runs it, called with the study file, the folder and perhaps ``--force``.
    """

    name: str
    study: Path
    folder: Path
    force: bool = False
    program: str = "legacy.pipeline.runners.child_process"


@dataclass(frozen=True)
class End:
    """How a study ended.

    Attributes
    ----------
    code : int
        0 done, 2 its input or its memory is at fault, 1 a bug, 130 interrupted.
    name : str
        Name of the finished study.
    fault : str
        Why it failed.
    """

    code: int
    name: str = ""
    fault: str = ""


def run_task(
    task: Task,
    tell: Callable[[str], None],
    stopped: Callable[[], bool] = lambda: False,
    memory_bytes: float | None = None,
) -> End:
    """Run a study in a separate process and wait until it ends.

    Parameters
    ----------
    tell : callable
        Gets each line of progress.
    stopped : callable
        Whether to stop the study.
    memory_bytes : float, optional
        Limit of the memory of the study; the study is ended above it.
    """
    process = _start(task)
    output: dict[str, str] = {}

    def forward() -> None:
        lines = []
        for line in process.stderr or ():
            lines.append(line)
            tell(line.rstrip())
        output["stderr"] = "".join(lines[-20:])

    def keep() -> None:
        output["stdout"] = process.stdout.read() if process.stdout else ""

    readers = [threading.Thread(target=work, daemon=True) for work in (forward, keep)]
    for reader in readers:
        reader.start()
    too_large = False
    try:
        polls = 0
        while process.poll() is None:
            if stopped():
                _end_process(process)
                break
            polls += 1
            if memory_bytes and polls % _MEMORY_POLLS == 0 and _resident_bytes(process.pid) > memory_bytes:
                too_large = True
                process.kill()
            time.sleep(_POLL_S)
    except BaseException:
        _end_process(process)
        raise
    finally:
        process.wait()
        for reader in readers:
            reader.join()
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()
    if too_large and memory_bytes:
        limit = f"{memory_bytes / 2**30:.2g} GiB that a study may take on this worker"
        return End(2, fault=f"it needs more memory than the {limit}. Start workers with more. {AGAIN}.")
    return _read_end(process.returncode, output)


def _start(task: Task) -> subprocess.Popen[str]:
    """Start a study in its own session, so that an interruption reaches it once, from here."""
    words = [sys.executable, "-P", "-m", task.program, str(task.study), str(task.folder)]
    root = str(Path(__file__).resolve().parents[3])
    search_path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        [*words, *(["--force"] if task.force else [])],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | dict.fromkeys(_THREADS, "1") | {"PYTHONPATH": search_path},
        start_new_session=True,
    )


def _read_end(code: int, output: dict[str, str]) -> End:
    """Return how a study ended; one that died without a word is named by its signal."""
    with suppress(ValueError, IndexError, TypeError):
        return End(**json.loads(output["stdout"].strip().splitlines()[-1]))
    if code in (-signal.SIGKILL, -signal.SIGTERM):
        text = f"its process was killed (signal {-code}), most often because memory ran out. {AGAIN}"
        return End(2, fault=f"{text}, with fewer --jobs or more memory.")
    how = f"signal {-code}" if code < 0 else f"exit code {code}"
    return End(1, fault=f"the process of this study ended by {how}.\n{output['stderr']}".strip())


def _end_process(process: subprocess.Popen[str]) -> None:
    """Ask a process to clean up and leave, again after a while, and end it when it does not.

    Once is not enough: an exception that a signal raises within a callback of the import machinery is lost.
    """
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(_ASK_AGAIN_S)
            return
    process.kill()


def _resident_bytes(pid: int) -> float:
    """Return the memory that a process holds; 0 where it cannot be known."""
    with suppress(OSError, ValueError, IndexError):
        pages = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]
        return float(pages) * os.sysconf("SC_PAGE_SIZE")
    return 0.0
