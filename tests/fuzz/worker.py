"""The process that reads cases: one of many inputs, with a limit on memory, that may crash or hang.

It is forked from the process that watches it, says over a pipe which case begins and how it ended, and looks
after each case at what stayed behind.
"""

from __future__ import annotations

import faulthandler
import gc
import importlib
import itertools
import json
import os
import random
import shutil
import signal
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from legacy.stapeskit.faults import LONGEST, StapeskitError
from tests.fuzz.case import Case
from tests.fuzz.targets import TARGETS

BLOCK = 100
"""Cases that follow from one state of the random numbers."""
LIMIT_S = 10
_COLLECTED = 10  # cases between two collections of garbage, which take as long as a case
ROOT = Path(__file__).resolve().parents[2]
_ROOMS = ("stapeskit", "kinematics", "ct_inertia", "fitting", "pipeline")


@dataclass(frozen=True)
class Place:
    """Where a case comes from: everything that is needed to make it again."""

    maker: str
    seed: int
    block: int
    number: int = 0

    def __str__(self) -> str:
        return f"{self.maker}:{self.seed}:{self.block}:{self.number}"

    @classmethod
    def of(cls, text: str) -> Place:
        """Read what ``str`` writes."""
        maker, *numbers = text.split(":")
        return cls(maker, *map(int, numbers))

    def cases(self) -> Iterator[tuple[int, Case]]:
        """Make the cases of the block from ``number`` on, with their numbers."""
        rng = random.Random(f"{self.maker} {self.seed} {self.block}")
        made = importlib.import_module(f"tests.fuzz.{self.maker}").cases(rng)
        return itertools.islice(enumerate(made), self.number, BLOCK)


def work(start: Place, until: int, folder: Path, pipe: int) -> None:
    """Run the rest of a block; write a line when a case begins and one when it ends.

    Parameters
    ----------
    start : Place
        The first case.
    until : int
        The first number that is not run any more.
    folder : Path
        An empty folder.
    pipe : int
        File descriptor of the reports.
    """
    import resource  # of POSIX systems only, as fork is

    log = (folder / "log").open("w+b")
    quiet = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(quiet, stream)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    faulthandler.enable(log)
    # a hang leaves its traceback after nearly all of its processor time, written by the thread that hangs
    faulthandler.register(signal.SIGPROF, file=log, all_threads=False)
    gc.freeze()  # what was imported is not looked at again after each case
    limit = resource.getrlimit(resource.RLIMIT_AS)
    for number, case in start.cases():
        if number >= until:
            break
        _send(pipe, {"begin": number, "name": case.name})
        log.truncate(0)
        log.seek(0)
        signal.setitimer(signal.ITIMER_PROF, LIMIT_S - 1)
        resource.setrlimit(resource.RLIMIT_AS, (_address_space() + case.memory, limit[1]))
        try:
            found = run(case, folder / "case")
        except BaseException:
            # a fault of the harness itself, or of what runs after the reader
            log.write(traceback.format_exc().encode())
            log.flush()
            raise
        finally:
            resource.setrlimit(resource.RLIMIT_AS, limit)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
        _send(pipe, {"end": number, **found})
        if number % _COLLECTED == 0:
            gc.collect()
    os._exit(0)


def _send(pipe: int, message: dict[str, object]) -> None:
    os.write(pipe, json.dumps(message).encode() + b"\n")


def _address_space() -> int:
    with open("/proc/self/statm", "rb") as stream:
        return int(stream.read().split()[0]) * os.sysconf("SC_PAGESIZE")


def run(case: Case, folder: Path) -> dict[str, str]:
    """Write the files of a case, read them and return how that ended: ``kind`` and, unless well, more.

    A ``kind`` of "done" or "refused" is as it should be.
    """
    shutil.rmtree(folder, ignore_errors=True)
    inside = folder / "in"
    for name, content in case.files.items():
        path = inside / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if name.endswith("/"):
            path.mkdir()
        else:
            path.write_bytes(content)
    here = Path.cwd()
    os.chdir(inside)
    found = {"kind": "done"}
    try:
        TARGETS[case.arguments[0]](*case.arguments[1:])
    except StapeskitError as fault:
        found = _refused(fault)
    except BaseException as fault:
        kind = "memory" if isinstance(fault, MemoryError) else "error"
        found = {"kind": kind, "signature": signature(fault), "text": traceback.format_exc()[-4000:]}
    finally:
        os.chdir(here)
    return _left(case, folder, found) or found


def _refused(fault: StapeskitError) -> dict[str, str]:
    text = str(fault)
    if len(text) > LONGEST:
        return {"kind": "message", "signature": signature(fault), "text": text}
    behind: BaseException | None = fault
    while behind is not None:
        if isinstance(behind, MemoryError):
            return {"kind": "memory", "signature": signature(behind), "text": text}
        behind = behind.__cause__ or behind.__context__
    return {"kind": "refused"}


def signature(fault: BaseException) -> str:
    """Return the kind of an error and the line of ours that is nearest to it."""
    frames = traceback.extract_tb(fault.__traceback__)
    ours = [frame for frame in frames if _is_ours(Path(frame.filename))]
    frame = (ours or frames or [None])[-1]
    if frame is None:
        return type(fault).__name__
    name = Path(frame.filename)
    place = name.relative_to(ROOT) if name.is_relative_to(ROOT) else name.name
    return f"{type(fault).__name__} at {place}:{frame.lineno} in {frame.name}"


def _is_ours(file: Path) -> bool:
    return file.is_relative_to(ROOT) and file.relative_to(ROOT).parts[0] in _ROOMS


def _left(case: Case, folder: Path, found: dict[str, str]) -> dict[str, str] | None:
    """Look for changed inputs and for what a case left behind."""
    inside = folder / "in"
    for name, content in case.files.items():
        path = inside / name
        if (path.is_file() and path.read_bytes() == content) or (name.endswith("/") and path.is_dir()):
            continue
        return {"kind": "input", "signature": f"input changed by {case.arguments[0]}", "text": name}
    names = {path.relative_to(inside).as_posix() for path in inside.rglob("*")}
    outside = [path.name for path in folder.iterdir() if path.name != "in"]
    hidden = [name for name in names if ".stapeskit-" in name]
    if found["kind"] != "done":
        parents = {parent.as_posix() for name in case.files for parent in Path(name).parents}
        hidden += sorted(names - {name.rstrip("/") for name in case.files} - parents)
    if outside or hidden:
        text = ", ".join([*outside, *hidden])[:500]
        return {"kind": "left", "signature": f"left behind by {case.arguments[0]}", "text": text}
    return None


def last_words(folder: Path) -> str:
    """Return the traceback that a crash or a hang left in the log."""
    try:
        return (folder / "log").read_text(errors="replace")[-6000:]
    except OSError:
        return ""


def place_in(log: str) -> str:
    """Return the innermost line of ours in such a traceback."""
    for line in log.splitlines():
        for room in _ROOMS:
            mark = f"{ROOT}{os.sep}{room}{os.sep}"
            if mark in line:
                return line.strip().replace(f"{ROOT}{os.sep}", "")
    return "unknown place"
