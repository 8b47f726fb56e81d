"""Every file of a study is parsed once and hashed once in a run, counted where Python opens files."""

import json
import os
import sys
from collections import Counter
from pathlib import Path

import pytest

from legacy.pipeline.scan2kd import run_study
from legacy.pipeline.stages import STAGES, run_stage
from legacy.stapeskit.provenance import content_hash
from tests.pipeline.ears import make_ear

PARSED_AND_HASHED = 2
HASHED = 1


class Opened:
    """Counts how often files below a folder are opened for reading."""

    def __init__(self):
        self.folder = None
        self.reads = Counter()
        sys.addaudithook(self.hook)

    def hook(self, event, arguments):
        if event != "open" or self.folder is None or not isinstance(arguments[0], str | os.PathLike):
            return
        path, mode, flags = os.fspath(arguments[0]), arguments[1], arguments[2]
        writes = bool(flags & 3) if mode is None else bool(set(mode) & set("wax+"))
        if str(path).startswith(str(self.folder)) and os.path.isfile(path) and not writes:
            self.reads[Path(path).relative_to(self.folder).as_posix()] += 1

    def during(self, folder, work):
        """Return the counts while a function works."""
        self.folder, self.reads = folder, Counter()
        try:
            work()
        finally:
            self.folder = None
        return self.reads


@pytest.fixture(scope="session")
def opened():
    return Opened()


def results(reads, out):
    """Return the counts by name of the results, in the output folder or on their way to it."""
    counts = Counter()
    for name, count in reads.items():
        place = Path(name)
        if place.parts[0] == out or place.parts[0].startswith(".stapeskit"):
            counts[place.name] += count
    return counts


def test_a_first_run_parses_inputs_once_and_its_results_never(tmp_path, opened):
    study = make_ear(tmp_path / "ear")
    reads = opened.during(tmp_path, lambda: run_study(study, tmp_path / "out"))
    assert reads["ear/ldv.csv"] == PARSED_AND_HASHED + 1  # its format is found in its first lines
    for name in ("study.toml", "stapes.ply", "points.csv", "fiducials.csv"):
        assert reads[f"ear/{name}"] == PARSED_AND_HASHED, name
    made = results(reads, "out")
    for name in ("mass.json", "stapes.ply", "dof.csv", "dof.h5", "kd.json", "report.html"):
        assert made[name] == HASHED, name


def test_a_second_run_parses_results_at_most_once(ear, opened):
    study, out = ear
    reads = opened.during(out.parent, lambda: run_study(study, out))
    assert reads["ear1/ldv.csv"] == PARSED_AND_HASHED + 1
    for name in ("mass.json", "stapes.ply", "dof.csv", "dof.h5", "kd.json", "report.html"):
        assert results(reads, "out")[name] <= PARSED_AND_HASHED, name


def test_stages_run_from_a_folder_into_a_folder(finished, tmp_path):
    study, out, _ = finished
    before = tmp_path / "start"
    before.mkdir()
    for number, stage in enumerate(STAGES):
        after = tmp_path / str(number)
        after.mkdir()
        for path in before.iterdir():
            (after / path.name).write_bytes(path.read_bytes())
        names = run_stage(stage.name, study, before, after)
        assert names
        assert all((after / name).is_file() for name in names)
        before = after
    for name in ("dof.csv", "stapes.ply"):
        assert content_hash(before / name) == content_hash(out / name)
    alone, whole = (json.loads((place / "mass.json").read_text()) for place in (before, out))
    assert {**alone, "provenance": 0} == {**whole, "provenance": 0}
