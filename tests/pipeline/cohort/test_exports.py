"""Exports of a cohort: every entry of the table writes its files, and what they hold."""

import csv
import json
import re
from pathlib import Path
from zipfile import ZipFile

import h5py
import numpy as np
import pytest

from legacy.pipeline.cohort.cohort_files import write_cohort
from legacy.pipeline.cohort.cohort_laws import cohort_laws_or_notice
from legacy.pipeline.cohort.exports import EXPORTS
from tests.pipeline.cohort.simulated_ears import ear


@pytest.fixture(scope="module")
def written(studied, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cohort")
    names = write_cohort(folder, studied, {}, {}, {}, tuple(EXPORTS))
    return folder, names


def test_every_export_writes_what_its_entry_lists(written):
    folder, names = written
    for entry in EXPORTS.values():
        assert set(entry.files) <= set(names)
    assert {path.name for path in folder.iterdir()} == set(names)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_cohorts_of_too_few_ears_for_laws_are_exported_too(count, tmp_path):
    rng = np.random.default_rng(1)
    few = cohort_laws_or_notice([ear(k, rng) for k in range(count)], {})
    assert not few.laws
    assert set(write_cohort(tmp_path, few, {}, {}, {}, tuple(EXPORTS))) == {
        p.name for p in tmp_path.iterdir()
    }


def test_the_table_of_laws_has_an_end_of_an_interval_a_column(written, studied):
    with (written[0] / "cohort_laws.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(studied.laws)
    law = studied.law("K11", "mass")
    row = next(row for row in rows if (row["response"], row["predictor"]) == ("K11", "mass_kg"))
    assert float(row["exponent_low_95"]) == pytest.approx(law.law.interval[0])


def test_the_workbook_has_a_sheet_for_each_table(written):
    with ZipFile(written[0] / "cohort.xlsx") as book:
        sheets = re.findall(r'sheet name="(\w+)"', book.read("xl/workbook.xml").decode())
        text = book.read("xl/worksheets/sheet1.xml").decode()
    assert sheets == ["ears", "laws", "components", "excluded", "warnings"]
    assert "<f>" not in text


def test_matrices_come_back_from_hdf5(written, studied):
    with h5py.File(written[0] / "cohort.h5") as file:
        assert file["kd/stiffness"][3] == pytest.approx(np.array(studied.ears[3].kd["stiffness_si"]))
        assert file["kd/covariance"].shape == (9, 12, 12)
        assert file["logarithms/values"].shape == studied.table.values.shape
        assert json.loads(file["cohort_json"][()])["schema"] == "stapeskit.cohort/1"


def test_the_crate_lists_every_file(written):
    folder, names = written
    graph = json.loads((folder / "ro-crate-metadata.json").read_text())["@graph"]
    described = {entry["@id"]: entry for entry in graph}
    others = set(names) - {"ro-crate-metadata.json"}
    assert others <= set(described)
    assert {part["@id"] for part in described["./"]["hasPart"]} >= others
    assert all(int(described[name]["contentSize"]) == Path(folder, name).stat().st_size for name in others)
