"""The scene of several ears."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.run import run_study
from pipeline.several import End, run_studies
from sample_volumes.make_cohort import compare, make_cohort
from simulate import Ear, Population, Scan


def test_planted_laws_are_found_within_their_intervals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five ears, two of one person, from surfaces and vibrometer files to the laws.

    The studies run in this process, and the picture of each report is left out: both have tests of their own,
    as has the way from a scan to a surface. Laws of the mass alone are fitted: those are planted.
    """

    def run_in_turn(studies, out, force, ended) -> None:
        for name, path in studies.items():
            run_study(path, out / name, force=force)
            ended(name, End(0))

    page = SimpleNamespace(write=lambda path: path.write_text("a report"))
    monkeypatch.setattr("pipeline.report.study_page", lambda _: page)
    monkeypatch.setattr("pipeline.cohort.laws.product", lambda names, _: [(one, "mass_kg") for one in names])
    population = Population(ears=5, pairs=1, size=0.12, ear=Ear(plate=False))
    make_cohort(tmp_path, population, Scan(format="ply"))
    studies = sorted((tmp_path / "ears").glob("*/study.toml"))
    run_studies(studies, tmp_path / "out", run_in_turn)
    assert json.loads((tmp_path / "out" / "cohort.json").read_text())["excluded"] == []
    laws = compare(tmp_path)
    assert len(laws) == 6
    for law in laws:
        # Twice the interval: one of six right laws falls outside in one of 1500 cohorts.
        assert abs(law["found"] - law["planted"]) < law["high_95"] - law["low_95"]
