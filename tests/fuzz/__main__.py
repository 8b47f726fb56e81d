"""Feed damaged files to every reader: python -m tests.fuzz, or make fuzz MINUTES=120.

    make fuzz                                  one minute
    make fuzz MINUTES=240 SEED=7               other cases, by hand
    make fuzz ARGS="--only scans"              one maker of cases (scans, meshes, vibrometer, records ...)
    make fuzz ARGS="--replay records:1:0:17"   a case again, with its traceback
    make fuzz ARGS="--save NAME --replay ..."  its files into tests/fuzz/corpus/NAME, which the tests replay

A case is well when it is read or refused by a StapeskitError of at most 4000 characters, within 10 s, in
memory of twice what it declares and 300 MB, and nothing stays behind. Each maker of cases is a module of this
folder with a function ``cases(random) -> Iterator[Case]``, and each gets the same time.
"""

from __future__ import annotations

import argparse
import collections
import importlib
import json
import os
import select
import shutil
import signal
import sys
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

from tests.fuzz.case import Finding
from tests.fuzz.corpus import save
from tests.fuzz.targets import preload
from tests.fuzz.worker import BLOCK, LIMIT_S, Place, last_words, place_in, run, work

HERE = Path(__file__).resolve().parent
PATIENCE_S = 6 * LIMIT_S
"""Waited for a case that waits for something; `LIMIT_S` is processor time."""
MAKERS = sorted(path.stem for path in HERE.glob("*.py") if "\ndef cases(" in path.read_text(encoding="utf-8"))


@dataclass
class Tally:
    """What became of the cases so far."""

    ends: collections.Counter[str] = field(default_factory=collections.Counter)
    findings: dict[str, list[Finding]] = field(default_factory=dict)
    longest_s: float = 0.0

    def add(self, finding: Finding) -> None:
        """Count a finding; say so when it is the first of its kind."""
        key = f"{finding.kind}: {finding.signature}"
        known = self.findings.setdefault(key, [])
        known.append(finding)
        if len(known) == 1:
            print(
                f"\n{finding.kind}: {finding.signature}\n  {finding.place} {finding.name}\n{finding.text}",
                flush=True,
            )


class Watch:
    """Runs blocks of cases in forked processes."""

    def __init__(self, folder: Path, end: float) -> None:
        self._folder, self._end = folder, end
        self.tally = Tally()

    def block(self, start: Place, until: int = BLOCK) -> None:
        """Run the cases of a block, in a new process after each that crashed or hung."""
        while start.number < until and time.monotonic() < self._end:
            done = self._process(start, until)
            if done is None:
                return
            start = replace(start, number=done + 1)

    def _process(self, start: Place, until: int) -> int | None:
        """Run cases in one process; return the number of that which ended it, or None when all are done."""
        folder = Path(tempfile.mkdtemp(dir=self._folder))
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                os.close(reader)
                work(start, until, folder, writer)
            finally:
                os._exit(77)
        os.close(writer)
        try:
            return self._follow(start, child, reader, folder)
        finally:
            os.close(reader)
            shutil.rmtree(folder, ignore_errors=True)

    def _follow(self, start: Place, child: int, reader: int, folder: Path) -> int | None:
        rest, number, name, began = b"", start.number - 1, "", time.monotonic()
        running, spent, waited_s = False, 0.0, 0.0
        while True:
            limit = LIMIT_S / 4 if running else 120.0
            ready, _, _ = select.select([reader], [], [], limit)
            # what was waited, not the clock: the whole machine may have been stopped meanwhile
            waited_s = 0.0 if ready else waited_s + limit
            if not ready and running and waited_s < PATIENCE_S and _cpu_s(child) - spent < LIMIT_S:
                continue
            if not ready or (not running and time.monotonic() > self._end):
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)
                if ready or not running:
                    return None
                self._ended_by(start, number, name, "hang", last_words(folder))
                return number
            piece = os.read(reader, 65536)
            if not piece:
                break
            *lines, rest = (rest + piece).split(b"\n")
            for message in map(json.loads, lines):
                running = "begin" in message
                if running:
                    number, name, began = message["begin"], message["name"], time.monotonic()
                    spent = _cpu_s(child)
                else:
                    self._ended(replace(start, number=number), name, message, time.monotonic() - began)
        _, status = os.waitpid(child, 0)
        if not running and status == 0:
            return None
        if not running:
            raise SystemExit(f"the maker of cases {start.maker} failed after {replace(start, number=number)}")
        code = os.waitstatus_to_exitcode(status)
        self._ended_by(start, number, name, "crash", f"{last_words(folder)}\nexit code {code}")
        return number

    def _ended(self, place: Place, name: str, message: dict[str, str], seconds: float) -> None:
        kind = message["kind"]
        self.tally.ends[kind] += 1
        self.tally.longest_s = max(self.tally.longest_s, seconds)
        if kind not in ("done", "refused"):
            self.tally.add(Finding(kind, message["signature"], str(place), name, message["text"]))

    def _ended_by(self, start: Place, number: int, name: str, kind: str, log: str) -> None:
        self.tally.ends[kind] += 1
        place = str(replace(start, number=number))
        self.tally.add(Finding(kind, place_in(log), place, name, log))


def _cpu_s(process: int) -> float:
    """Return the processor time of a process: on a busy machine the time on the clock says little."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Run for the given time and leave with 1 when something was found."""
    parser = argparse.ArgumentParser(
        prog="fuzz", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--blocks", type=int, default=0, help=f"at most so many times {BLOCK} cases a maker")
    parser.add_argument("--only", action="append", choices=MAKERS, help="makers of cases")
    parser.add_argument("--replay", metavar="PLACE", help="run one case in this process")
    parser.add_argument("--save", metavar="NAME", help="with --replay: keep it in the corpus")
    parser.add_argument("--results", type=Path, metavar="FILE.json", help="add what was found to this file")
    given = parser.parse_args()
    if given.replay:
        raise SystemExit(_replay(Place.of(given.replay), given.save))
    preload()
    makers = given.only or MAKERS
    for maker in makers:
        getattr(importlib.import_module(f"tests.fuzz.{maker}"), "prepare", lambda: None)()
    began = time.monotonic()
    shared = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=shared if shared.is_dir() else None) as folder:
        watch = Watch(Path(folder), began + 60.0 * given.minutes)
        blocks, spent = dict.fromkeys(makers, 0), dict.fromkeys(makers, 0.0)
        while time.monotonic() < began + 60.0 * given.minutes:
            waiting = [maker for maker in makers if not given.blocks or blocks[maker] < given.blocks]
            if not waiting:
                break
            maker, start = min(waiting, key=spent.__getitem__), time.monotonic()
            watch.block(Place(maker, given.seed, blocks[maker]))
            blocks[maker] += 1
            spent[maker] += time.monotonic() - start
    _report(watch.tally, time.monotonic() - began, given.results)
    raise SystemExit(1 if watch.tally.findings else 0)


def _replay(place: Place, name: str | None) -> int:
    _, case = next(place.cases())
    print(f"{case.name}\n{' '.join(case.arguments)}")
    for file, content in case.files.items():
        print(f"  {file}: {len(content)} bytes {content[:120]!r}")
    if name:
        print(f"saved in {save(case, name)}")
    with tempfile.TemporaryDirectory() as folder:
        found = run(case, Path(folder) / "case")
    print("\n".join(found.values()))
    return 0 if found["kind"] in ("done", "refused") else 1


def _report(tally: Tally, seconds: float, file: Path | None) -> None:
    total = sum(tally.ends.values())
    ends = ", ".join(f"{count} {kind}" for kind, count in tally.ends.most_common())
    print(f"\n{total} inputs in {seconds:.0f} s: {ends or 'none'}; the longest took {tally.longest_s:.1f} s")
    for key, known in sorted(tally.findings.items()):
        print(f"  {len(known):5d}  {key}  e.g. {known[0].place}")
    if file is not None:
        before = json.loads(file.read_text()) if file.exists() else []
        entry = {
            "inputs": total,
            "seconds": round(seconds),
            "ends": dict(tally.ends),
            "longest_s": round(tally.longest_s, 2),
            "findings": {key: len(known) for key, known in tally.findings.items()},
        }
        file.write_text(json.dumps([*before, entry], indent=1) + "\n")


if __name__ == "__main__":
    sys.path.insert(0, str(HERE.parents[1]))
    main()
