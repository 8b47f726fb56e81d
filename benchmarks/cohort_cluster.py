"""Cohorts on a cluster of this machine: equal results, time on one and two workers, overhead per ear.

    python benchmarks/cohort_cluster.py [--ears 64] [--brief 64]

Runs brief studies without work, for the overhead per ear, and simulated ears (sample_volumes.old_cohort),
here and on 1 and 2 dask workers, and compares all result files but for dates; then the stages of one ear as
tasks of their own, from folder to folder.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from legacy.pipeline.runners import Where, dask_cluster, local
from legacy.pipeline.runners.study_process import Task
from legacy.pipeline.stages import STAGES, run_stage
from sample_volumes.old_cohort import Population, make_cohort
from tests.pipeline.runners.test_dask_cluster import processes

_CHANGING = ("provenance", "seconds", "hash", "modified", "date")


def numbers(folder: Path) -> dict[str, object]:
    """Return the content of every ear's results without dates and hashes of dated files."""
    contents: dict[str, object] = {}
    for path in sorted(folder.glob("*/*")):
        if path.suffix == ".json":
            content = json.loads(path.read_text(encoding="utf-8"))
            contents[str(path.relative_to(folder))] = {k: v for k, v in content.items() if k not in _CHANGING}
        elif path.suffix in (".csv", ".ply"):
            contents[str(path.relative_to(folder))] = path.read_bytes()
    return contents


def timed(run, tasks, out: Path) -> float:
    """Return the seconds of a run whose results go to ``out``."""
    out.mkdir()
    faults = {}
    begun = time.perf_counter()
    placed = [replace(task, folder=out / task.name) for task in tasks]
    run(placed, out, lambda *_: None, lambda name, end: faults.update({name: end.fault} if end.code else {}))
    assert not faults, faults
    return time.perf_counter() - begun


def stages_one_by_one(study: Path, folder: Path, address: str) -> dict[str, object]:
    """Run each stage of a study as a task from folder to folder; return the results of all."""
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        done = folder / "done" / study.parent.name
        done.mkdir(parents=True)
        for stage in STAGES:
            fresh = folder / stage.name
            fresh.mkdir()
            client.submit(run_stage, stage.name, study, done, fresh, pure=False).result()
            shutil.copytree(fresh, done, dirs_exist_ok=True)
    return numbers(folder / "done")


def main() -> None:
    """Print the tables."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--ears", type=int, default=8)
    given.add_argument("--brief", type=int, default=64)
    options = given.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        brief = []
        for k in range(options.brief):
            (folder / f"b{k}.toml").touch()
            program = "tests.pipeline.runners.brief_study"
            brief.append(Task(f"b{k}", folder / f"b{k}.toml", folder, program=program))
        print("| studies | where | seconds | per study |\n|-|-|-|-|")
        runs = [("here, 2 jobs", 0)]
        runs += [("1 worker", 1), ("2 workers", 2)]
        make_cohort(folder / "cohort", Population(ears=options.ears, pairs=0))
        studies = sorted((folder / "cohort" / "ears").glob("*/study.toml"))
        real = [Task(path.parent.name, path, folder) for path in studies]
        for kind, tasks in (("brief", brief), ("ears", real)):
            results = []
            for number, (where, workers) in enumerate(runs):
                out = folder / f"{kind}{number}"
                if not workers:
                    seconds = timed(lambda t, _out, *rest: local.run(t, Where(2), *rest), tasks, out)
                else:
                    (folder / f"c{kind}{number}").mkdir()
                    with processes(folder / f"c{kind}{number}", workers) as (address, _):
                        seconds = timed(
                            lambda t, o, *rest, a=address: dask_cluster.run(t, Where(1, a, o), *rest),
                            tasks,
                            out,
                        )
                results.append(numbers(out))
                print(
                    f"| {len(tasks)} {kind} | {where} | {seconds:.1f} | {seconds / len(tasks):.2f} |",
                    flush=True,
                )
            if kind == "ears":
                print("results equal:", all(outcome == results[0] and outcome for outcome in results))
                (folder / "stages").mkdir()
                with processes(folder / "stages", 2) as (address, _):
                    outcome = stages_one_by_one(studies[0], folder / "stages", address)
                alone = {name: results[0][name] for name in outcome}
                print(
                    f"stages of one ear as tasks of their own, {len(outcome)} files equal:", outcome == alone
                )


if __name__ == "__main__":
    main()
