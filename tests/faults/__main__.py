"""Kill, starve and disturb the commands: python -m tests.faults, or make faults.

    make faults                         every scenario, about 250 kills
    make faults ARGS="--only kill"      scenarios whose names hold this word
    make faults ARGS="--times 500"      random kills of each command

After each fault: inputs and files of the user are unchanged; the outputs are all of one run, or their readers
refuse them; the same command then runs through and leaves no temporary folder; a refusal is exit 2 with one
message, an interruption 130 with one line.
"""

from __future__ import annotations

import argparse
import collections
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
    parser.add_argument("--times", type=int, default=30, help="random kills and interruptions a command")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    preload()
    undrawn()
    counts: collections.Counter[str] = collections.Counter()
    failures: list[str] = []
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        inputs = Path(name) / "inputs"
        make_inputs(inputs)
        for scenario, run in SCENARIOS.items():
            if given.only not in scenario:
                continue
            for command in given.command or WORKLOADS:
                workload = WORKLOADS[command]
                began, before = time.monotonic(), counts[scenario]
                place = Path(name) / "run"
                rng = random.Random(f"{given.seed} {scenario} {command}")
                bench = Bench(workload, inputs, place, rng, given.times)
                for what, problem in run(bench):
                    counts[scenario] += 1
                    if problem:
                        failures.append(f"{scenario} {command} {what}: {problem}")
                        print(failures[-1], flush=True)
                shutil.rmtree(place, ignore_errors=True)
                took_s = time.monotonic() - began
                print(
                    f"{scenario:12} {command:12} {counts[scenario] - before:4d} in {took_s:.0f} s", flush=True
                )
    print(f"\n{sum(counts.values())} faults: " + ", ".join(f"{n} {name}" for name, n in counts.items()))
    print(f"{len(failures)} failures")
    raise SystemExit(1 if failures else 0)


if __name__ == "__main__":
    sys.path.insert(0, os.getcwd())
    try:
        main()
    except Exception:
        traceback.print_exc()
        raise SystemExit(2) from None
