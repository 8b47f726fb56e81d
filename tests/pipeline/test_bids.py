"""Ears in the manner of BIDS: written with all their files, read back, run from there."""

import json

import pytest

from pipeline import cli
from pipeline.bids import derivatives, read_dataset, write_dataset
from pipeline.errors import PipelineError
from pipeline.several import folder_names
from pipeline.study import read_study

STUDY = """[study]
subject = "TB-12"
side = "{side}"
age = 61
covariates = {{ session = "pre 1", storage_days = 3 }}
[scan]
file = "scan.mhd"
density_kg_m3 = "1900+-60"
[ldv]
file = ["a.csv", "b.csv"]
points = "points.csv"
"""


@pytest.fixture
def studies(tmp_path):
    for side in ("left", "right"):
        folder = tmp_path / side
        folder.mkdir()
        (folder / "study.toml").write_text(STUDY.format(side=side))
        for name in ("scan.mhd", "scan.raw", "a.csv", "b.csv", "points.csv"):
            (folder / name).write_text(f"{side} {name}")
    return [tmp_path / side / "study.toml" for side in ("left", "right")]


def test_a_dataset_holds_what_the_studies_name(studies, tmp_path):
    dataset = tmp_path / "bids"
    written = write_dataset(studies, dataset)
    assert read_dataset(dataset) == sorted(written)
    assert folder_names(written) == ["sub-TB12_ses-pre1_hemi-L", "sub-TB12_ses-pre1_hemi-R"]
    for source, target in zip(studies, written, strict=True):
        old, new = read_study(source), read_study(target)
        assert new.study == old.study
        for before, after in zip(old.ldv.files, new.ldv.files, strict=True):
            assert after.read_text() == before.read_text()
            assert after.is_relative_to(target.parent / "ldv")
        assert new.scan.scan.read_text() == old.scan.scan.read_text()
        assert new.scan.scan.with_name("scan.raw").exists()
    assert json.loads((dataset / "dataset_description.json").read_text())["DatasetType"] == "raw"
    assert (dataset / "participants.tsv").read_text().splitlines()[1] == "sub-TB12\t61.0\tn/a\tn/a"
    assert write_dataset(studies, dataset) == written


def test_nothing_is_replaced_and_no_two_ears_have_one_place(studies, tmp_path):
    studies[1].write_text(STUDY.format(side="left"))
    with pytest.raises(PipelineError) as refused:
        write_dataset(studies, tmp_path / "bids")
    assert refused.value.faults[0].got == "sub-TB12_ses-pre1_hemi-L"
    assert not (tmp_path / "bids").exists()
    write_dataset(studies[:1], tmp_path / "bids")
    studies[0].with_name("a.csv").write_text("other values")
    with pytest.raises(PipelineError) as refused:
        write_dataset(studies[:1], tmp_path / "bids")
    assert len(refused.value.faults) == 1
    with pytest.raises(PipelineError) as refused:
        read_dataset(tmp_path / "left")
    assert refused.value.faults[0].thing == "{bids}"


def test_the_command_runs_the_dataset(studies, tmp_path, monkeypatch):
    called = []
    monkeypatch.setattr("pipeline.several.run_studies", lambda *given: called.append(given) or 1 / 0)
    for words in ([*map(str, studies), "--bids", str(tmp_path / "bids")], ["--bids", str(tmp_path / "bids")]):
        with pytest.raises(ZeroDivisionError):
            cli.work(words)
    assert [sorted(one[0]) for one in called] == [read_dataset(tmp_path / "bids")] * 2
    assert called[0][1] == derivatives(tmp_path / "bids")
