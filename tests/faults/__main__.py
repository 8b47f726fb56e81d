"""Kill, starve and disturb the commands: python -m tests.faults, or make faults.

    make faults                         every scenario
    make faults ARGS="--only kill"      scenarios whose names hold this word
    make faults ARGS="--times 500"      random kills of each command

After each fault: inputs and files of the user are unchanged; the outputs are all of one run, or their readers
refuse them; the same command then runs through and leaves no temporary folder; a refusal is exit 2 with one
message, an interruption 130 with one line.
"""

from __future__ import annotations

import argparse
import collections
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import time
import traceback
from pathlib import Path

from tests.faults.scenarios import SCENARIOS, Bench
from tests.faults.workloads import WORKLOADS, make_inputs, undrawn
from tests.fuzz.targets import preload


def main() -> None:
    """Run the scenarios and leave with 1 when one found something."""
    parser = argparse.ArgumentParser(
        prog="faults", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="scenarios whose names hold this word")
    parser.add_argument("--command", action="append", choices=list(WORKLOADS))
    parser.add_argument("--times", type=int, default=40, help="random kills and interruptions a command")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    preload()
    undrawn()
    done, failures = collections.Counter[str](), list[str]()
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        make_inputs(Path(name) / "inputs")
        tasks = [
            (Path(name), scenario, command, given.times, given.seed)
            for scenario in SCENARIOS
            for command in given.command or WORKLOADS
            if given.only in scenario
        ]
        for command in dict.fromkeys(task[2] for task in tasks):
            _bench(Path(name), "first", command, 0, 0).prepare()
        with multiprocessing.get_context("fork").Pool(given.jobs) as pool:
            for scenario, command, tried, hits, found, took_s in pool.imap_unordered(_run, tasks):
                done[f"{scenario}"] += hits
                done["tried"] += tried
                failures += found
                line = f"{scenario:12} {command:12} {tried:4d}, {hits:4d} in effect, in {took_s:.0f} s"
                print("\n".join([line, *found]), flush=True)
    tried = done.pop("tried")
    print(f"\n{tried} faults in {time.monotonic() - began:.0f} s; in effect: "
          + ", ".join(f"{count} {scenario}" for scenario, count in done.items()))  # fmt: skip
    print(f"{len(failures)} failures")
    raise SystemExit(1 if failures else 0)


def _bench(folder: Path, scenario: str, command: str, times: int, seed: int) -> Bench:
    place = folder / f"{scenario}-{command}".replace(" ", "-")
    return Bench(
        WORKLOADS[command], folder / "inputs", place, random.Random(f"{seed} {scenario} {command}"), times
    )


def _run(task: tuple[Path, str, str, int, int]) -> tuple[str, str, int, int, list[str], float]:
    """Run a scenario with a command; return how many faults were tried, took effect, and what was wrong."""
    _, scenario, command, *_ = task
    began, bench, tried = time.monotonic(), _bench(*task), 0
    failures = []
    for what, problem in SCENARIOS[scenario](bench):
        tried += 1
        if problem:
            failures.append(f"{scenario} {command} {what}: {problem}")
    shutil.rmtree(bench.place, ignore_errors=True)
    return scenario, command, tried, bench.hits, failures, time.monotonic() - began


if __name__ == "__main__":
    sys.path.insert(0, os.getcwd())
    try:
        main()
    except Exception:
        traceback.print_exc()
        raise SystemExit(2) from None
