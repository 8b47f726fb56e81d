"""The scene of several ears."""

from __future__ import annotations

import json
from pathlib import Path

import pipeline.cli
from sample_volumes.make_cohort import compare, make_cohort
from simulate import Population, Scan


def test_planted_laws_are_found_within_their_intervals(tmp_path: Path) -> None:
    """Six ears, two of one person, from scans and vibrometer files to the laws."""
    make_cohort(tmp_path, Population(ears=6, pairs=1, size=0.12), Scan(voxel_um=48.0))
    studies = sorted(str(path) for path in (tmp_path / "ears").glob("*/study.toml"))
    pipeline.cli.work([*studies, "--out", str(tmp_path / "out"), "--quiet"])
    assert json.loads((tmp_path / "out" / "cohort.json").read_text())["excluded"] == []
    laws = compare(tmp_path)
    assert len(laws) == 6
    for law in laws:
        # Twice the interval: one of six right laws falls outside in one of 1500 cohorts.
        assert abs(law["found"] - law["planted"]) < law["high_95"] - law["low_95"]
