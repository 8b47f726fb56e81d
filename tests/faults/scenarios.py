"""The faults: each scenario yields what it did, and what is wrong afterwards or nothing."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import random
import resource
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.own_files import check_whole
from tests.faults.workloads import Workload, start, told

Found = Iterator[tuple[str, str]]
_MOVES = ("rename", "replace", "mkdir", "unlink", "rmdir")
_LIMIT_S = 600.0  # a busy machine takes ten times as long


@dataclass
class Bench:
    """One command in a folder that is set up anew for every fault."""

    workload: Workload
    inputs: Path
    place: Path
    rng: random.Random
    times: int
    hits: int = 0
    """How many processes were ended by the fault, not through before it."""

    def prepare(self) -> None:
        """Run the command once and keep its outputs."""
        self.fresh(existing=False)
        code = self.wait(start(self.workload, self.place))
        if code:
            raise RuntimeError(f"{self.workload.module} ended with {code}: {told(self.place)}")
        shutil.copytree(self.place / "out", self._kept)

    @property
    def _kept(self) -> Path:
        return self.inputs / f"out-{self.workload.module}"

    def fresh(self, existing: bool = True) -> None:
        """Set up the folder; with the outputs of a first run in it, and a file of the user."""
        shutil.rmtree(self.place, ignore_errors=True)
        self.place.mkdir()
        for name in self.workload.inputs:
            shutil.copy2(self.inputs / name, self.place / name)
        if not existing:
            return
        shutil.copytree(self._kept, self.place / "out")
        (self.place / "out" / "notes.txt").write_text("mine")

    def wait(self, child: int, limit_s: float = _LIMIT_S) -> int:
        """Return the exit code of a process; minus the signal that ended it."""
        end = time.monotonic() + limit_s
        while time.monotonic() < end:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.002)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return -999

    def hashes(self) -> dict[str, str]:
        """Return the content of the outputs."""
        return {
            name: hashlib.sha256((self.place / "out" / name).read_bytes()).hexdigest()
            for name in self.workload.outputs
            if (self.place / "out" / name).exists()
        }

    def problem(self, before: dict[str, str], changed: tuple[str, ...] = ()) -> str:
        """Look at the folder after a fault, then run the command again; return what is wrong."""
        for name in self.workload.inputs:
            if name not in changed and (self.place / name).read_bytes() != (self.inputs / name).read_bytes():
                return f"the input {name} was changed"
        mixed = self._mixed(before)
        if mixed:
            return mixed
        if before and (self.place / "out" / "notes.txt").read_text() != "mine":
            return "a file of the user was changed"
        for name in changed:
            self._restore(name)
        for path in self.place.rglob(".stapeskit-*"):
            then = time.time() - 3600.0
            os.utime(path, (then, then))
        code = self.wait(start(self.workload, self.place, second=True))
        if code:
            return f"the next run ended with {code}: {told(self.place)[:300]}"
        left = [path.name for path in self.place.rglob(".stapeskit-*")]
        return f"left behind: {left}" if left else self._mixed(before)

    def _restore(self, name: str) -> None:
        path = self.place / name
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        shutil.copy2(self.inputs / name, path)

    def _mixed(self, before: dict[str, str]) -> str:
        """Look whether outputs are of different runs and readers would not notice."""
        now = self.hashes()
        new = [name for name in self.workload.outputs if now.get(name) != before.get(name)]
        if len(new) in (0, len(self.workload.outputs)):
            return ""
        with contextlib.suppress(StapeskitError):
            check_whole(self.place / "out" / self.workload.outputs[0])
            return f"half a set: only {new} are new"
        return ""

    def ended(self, child: int, codes: tuple[int, ...]) -> str:
        """Wait for a process that must end with one of the codes, and with one message."""
        code = self.wait(child)
        text = told(self.place)
        self.hits += code in (-signal.SIGKILL, 2, 130)
        if code not in codes:
            return f"ended with {code} instead of {codes}: {text[-400:]}"
        if "Traceback" in text or (code == 130 and len(text.splitlines()) != 1):
            return f"{code}, but said: {text[-400:]}"
        return ""


def count_moves(number: int, act: Callable[[], None]) -> Callable[[], None]:
    """Return a hook that acts before the move of that number (counted from 0)."""

    def install() -> None:
        seen = 0
        for name in _MOVES:
            move = getattr(os, name)

            def counted(*given: object, move: Callable[..., object] = move, **more: object) -> object:
                nonlocal seen
                if seen == number:
                    seen += 1
                    act()
                else:
                    seen += 1
                return move(*given, **more)

            setattr(os, name, counted)

    return install


def _every_move(bench: Bench, act: Callable[[], None], codes: tuple[int, ...]) -> Found:
    for existing in (True, False):
        for number in range(bench.rng.randrange(bench.workload.every), 400, bench.workload.every):
            bench.fresh(existing)
            before = bench.hashes()
            hook = count_moves(number, act)
            wrong = bench.ended(start(bench.workload, bench.place, True, hook), codes)
            through = not wrong and bench.hashes() != before and not told(bench.place)
            yield f"at move {number}", wrong or bench.problem(before)
            if through and number > 3:
                break


def kill_moves(bench: Bench) -> Found:
    """Kill the process before every rename, removal or new folder."""
    yield from _every_move(bench, lambda: os.kill(os.getpid(), signal.SIGKILL), (0, -9))


def stop_moves(bench: Bench) -> Found:
    """Interrupt it there."""
    yield from _every_move(bench, lambda: os.kill(os.getpid(), signal.SIGINT), (0, 130))


def _random(bench: Bench, number: int, codes: tuple[int, ...]) -> Found:
    bench.fresh()
    began = time.monotonic()
    bench.wait(start(bench.workload, bench.place, True))
    takes_s = time.monotonic() - began
    for _ in range(bench.times):
        bench.fresh(existing=bench.rng.random() < 0.7)
        before = bench.hashes()
        child = start(bench.workload, bench.place, True)
        delay_s = bench.rng.uniform(0.02, 1.05 * takes_s)
        time.sleep(delay_s)
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, number)
        wrong = bench.ended(child, codes)
        yield f"after {delay_s:.3f} s", wrong or bench.problem(before)


def kill_random(bench: Bench) -> Found:
    """Kill it at any time."""
    yield from _random(bench, signal.SIGKILL, (0, -9))


def stop_random(bench: Bench) -> Found:
    """Interrupt it at any time."""
    yield from _random(bench, signal.SIGINT, (0, 130))


def _limited(bench: Bench, kind: int, values: list[int], codes: tuple[int, ...] = (0, 2)) -> Found:
    for value in values:
        bench.fresh()
        before = bench.hashes()
        hook = partial(resource.setrlimit, kind, (value, value))
        child = start(bench.workload, bench.place, True, hook)
        yield f"limit {value}", bench.ended(child, codes) or bench.problem(before)


def file_limit(bench: Bench) -> Found:
    """Limit the size of files."""
    yield from _limited(bench, resource.RLIMIT_FSIZE, [0, 1, 100, 4096, 20_000, 50_000, 200_000])


def open_limit(bench: Bench) -> Found:
    """Limit the number of open files."""
    yield from _limited(bench, resource.RLIMIT_NOFILE, [8, 12, 16, 24, 40])


def memory(bench: Bench) -> Found:
    """Limit the memory to little more than what is taken already."""
    with open("/proc/self/statm") as stream:
        base = int(stream.read().split()[0]) * os.sysconf("SC_PAGESIZE")
    yield from _limited(bench, resource.RLIMIT_AS, [base + (1 << shift) for shift in range(16, 30)])


def full_disk(bench: Bench) -> Found:
    """Write on a file system that is too small, where one may be mounted."""
    for kilobytes in (4, 16, 40, 64, 100, 160, 260, 400, 1000):
        bench.fresh(existing=False)
        out = bench.place / "out"
        out.mkdir()
        size = f"size={kilobytes}k"
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(out)], check=False, capture_output=True
        )
        if done.returncode:
            return
        try:
            wrong = bench.ended(start(bench.workload, bench.place, True), (0, 2))
            left = sorted(path.name for path in out.iterdir() if path.name != ".stapeskit")
            if not wrong and left and not set(bench.workload.outputs) <= set(left):
                wrong = f"half a set: {left}"
            yield f"{kilobytes} kB", wrong
        finally:
            subprocess.run(["umount", "-l", str(out)], check=False)


def unreadable(bench: Bench) -> Found:
    """Put something that cannot be read in the place of each input."""
    for name in bench.workload.inputs:
        for kind in ("directory", "loop", "pipe", "device", "memory", "foreign"):
            bench.fresh()
            before, path = bench.hashes(), bench.place / name
            path.unlink()
            hook = None
            if kind == "directory":
                path.mkdir()
            elif kind == "pipe":
                os.mkfifo(path)
            elif kind == "foreign":
                shutil.copy2(bench.inputs / name, path)
                path.chmod(0)
                hook = _as_plain_user
            else:
                path.symlink_to({"loop": path.name, "device": "/dev/zero", "memory": "/proc/self/mem"}[kind])
            wrong = bench.ended(start(bench.workload, bench.place, True, hook), (0, 2))
            yield f"{name} {kind}", wrong or bench.problem(before, (name,))


def _as_plain_user() -> None:
    """Let permissions bind root too: drop its capabilities to read and write everything (capset(2))."""
    if os.getuid():
        return
    system = ctypes.CDLL(None, use_errno=True)
    header, sets = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    system.capget(header, sets)
    for place in range(2):  # effective and permitted: CAP_DAC_OVERRIDE is 1, CAP_DAC_READ_SEARCH is 2
        sets[place] &= ~0b110
    if system.capset(header, sets):
        raise OSError(ctypes.get_errno(), "capset")


def changing(bench: Bench) -> Found:
    """Shrink, grow, rewrite or remove each input while it is read."""
    for name in bench.workload.inputs:
        for kind in ("shrink", "grow", "rewrite", "remove"):
            bench.fresh()
            before, path = bench.hashes(), bench.place / name
            content = path.read_bytes()
            child = start(bench.workload, bench.place, True)
            time.sleep(bench.rng.uniform(0.0, 0.2))
            if kind == "shrink":
                os.truncate(path, len(content) // 3)
            elif kind == "grow":
                path.write_bytes(content + content[-100:])
            elif kind == "rewrite":
                path.write_bytes(bytes(reversed(content)))
            else:
                path.unlink()
            wrong = bench.ended(child, (0, 2))
            yield f"{name} {kind}", wrong or bench.problem(before, (name,))


def together(bench: Bench) -> Found:
    """Run the command twice at once into one folder."""
    for number in range(max(5, bench.times // 3)):
        bench.fresh(existing=number % 2 == 0)
        before = bench.hashes()
        first = start(bench.workload, bench.place, True)  # both with other options than the run before
        time.sleep(bench.rng.uniform(0.0, 0.1))
        second = start(bench.workload, bench.place, True)
        codes = (bench.wait(first), bench.wait(second))
        wrong = (
            "" if set(codes) <= {0, 2} and 0 in codes else f"ended with {codes}: {told(bench.place)[-300:]}"
        )
        if not wrong:
            with contextlib.suppress(StapeskitError):
                check_whole(bench.place / "out" / bench.workload.outputs[0])
                wrong = "" if set(bench.hashes()) == set(bench.workload.outputs) else "outputs are missing"
        yield f"pair {number}", wrong or bench.problem(before)


SCENARIOS: dict[str, Callable[[Bench], Found]] = {
    "kill moves": kill_moves,
    "stop moves": stop_moves,
    "kill random": kill_random,
    "stop random": stop_random,
    "file limit": file_limit,
    "open limit": open_limit,
    "memory": memory,
    "full disk": full_disk,
    "unreadable": unreadable,
    "changing": changing,
    "together": together,
}
