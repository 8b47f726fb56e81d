"""Benchmarks: figures of 0.2 are found, peers measure known bodies, pages are filled from results."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks._table import NOTHING, RESULTS, Before
from benchmarks.peers import measures
from tools import doc_tables, evidence

ROOT = Path(__file__).resolve().parents[1]
SIDES_MM = np.array([1.23, 0.83, 0.63])


@pytest.fixture
def cuboid() -> tuple[np.ndarray, float]:
    """Grey values (z, y, x) of a cuboid in air by exact partial volumes, and the voxel size, mm."""
    spacing, count = 0.05, 40
    edges = [
        np.clip((SIDES_MM[axis] / 2.0 - np.abs(np.arange(count) * spacing - 1.0)) / spacing + 0.5, 0.0, 1.0)
        for axis in range(3)
    ]
    return 1e4 * np.einsum("i,j,k->kji", *edges), spacing


@pytest.mark.parametrize(
    "way", ["voxel_count", "marching_cubes", "vtk_flying_edges", "simpleitk_otsu", "surface_nets"]
)
def test_a_peer_measures_a_cuboid_to_a_fifth(way: str, cuboid: tuple[np.ndarray, float]) -> None:
    grey, spacing = cuboid
    volume, centre, second = getattr(measures, way)(grey, spacing, 5e3)
    assert volume == pytest.approx(np.prod(SIDES_MM), rel=0.2)
    assert centre == pytest.approx(np.ones(3), abs=1e-3)
    assert np.diag(second) == pytest.approx(np.prod(SIDES_MM) * SIDES_MM**2 / 12.0, rel=0.35)


def test_a_figure_of_before_is_found_by_row_and_column() -> None:
    before = Before("fitting_estimators_100_20")
    assert before.cell("coverage 95 %", "5 %, 200 lines", "ml") == "0.958"
    assert before.cell("coverage 95 %", "5 %, 200 lines", "another") == NOTHING
    assert Before("nothing").cell("coverage 95 %") == NOTHING


def test_every_table_that_a_script_names_is_there() -> None:
    tables = json.loads((RESULTS / "before.json").read_text(encoding="utf-8"))["tables"]
    new = [
        path for path in (ROOT / "benchmarks").glob("*.py") if "_table" in path.read_text(encoding="utf-8")
    ]
    named = {
        name for path in new for name in re.findall(r'Before\("(\w+)"\)', path.read_text(encoding="utf-8"))
    }
    assert named
    assert named <= set(tables)


def test_every_command_of_the_evidence_is_a_script_with_those_options() -> None:
    for match in evidence.BLOCK.finditer(evidence.PAGE.read_text(encoding="utf-8")):
        name, *words = match[1].split()
        module = importlib.import_module(f"benchmarks.{name}")
        source = Path(str(module.__file__)).read_text(encoding="utf-8")
        for option in (word[2:].replace("-", "_") for word in words if word.startswith("--")):
            assert re.search(rf"arguments\(__doc__.*\b{option}=", source), f"{name} --{option}"


def test_a_block_is_filled_from_its_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evidence, "RESULTS", tmp_path)
    result = {"command": "python -m benchmarks.some --of 3", "date": "2026-11-27", "processor_s": 5}
    evidence.result_file("some --of 3").write_text(json.dumps({**result, "printed": ["| a |", "|-|"]}))
    page = "<!-- python -m benchmarks.some --of 3 -->\nold\n<!-- end -->"
    filled = evidence.BLOCK.sub(evidence.filled, page)
    assert "| a |\n|-|" in filled
    assert "old" not in filled
    assert evidence.BLOCK.sub(evidence.filled, filled) == filled


def test_tables_of_formats_have_a_row_an_entry() -> None:
    for rows in doc_tables.TABLES.values():
        assert len(doc_tables.markdown(rows).splitlines()) == len(rows) + 1
        assert all(len(row) == len(rows[0]) for row in rows)
