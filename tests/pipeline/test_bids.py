"""Ears in the manner of BIDS: written with all their files, read back, run from there."""

import json
import shutil
from dataclasses import replace

import pytest

from legacy.kinematics.readers import recognise_format
from legacy.kinematics.readers.formats import Format
from legacy.pipeline import cli
from legacy.pipeline.bids import derivatives, read_dataset, write_dataset
from legacy.pipeline.errors import PipelineError
from legacy.pipeline.several_studies import folder_names
from legacy.pipeline.study import read_study

STUDY = """[study]
subject = "TB-12"
side = "{side}"
age = 61
truth = "truth.json"
covariates = {{ session = "pre 1", storage_days = 3 }}
[scan]
file = "scan.mhd"
density_kg_m3 = "1900+-60"
[ldv]
file = ["a.csv", "b.csv"]
points = "points.csv"
run = {{ push = "a.csv", pull = "b.csv" }}
"""


@pytest.fixture
def studies(tmp_path):
    for side in ("left", "right"):
        folder = tmp_path / side
        folder.mkdir()
        (folder / "study.toml").write_text(STUDY.format(side=side))
        for name in ("voxels.raw", "a.csv", "a.csv.toml", "b.csv", "points.csv", "truth.json"):
            (folder / name).write_text(f"{side} {name}")
        (folder / "scan.mhd").write_text("NDims = 3\nDimSize = 2 2 2\nElementDataFile = voxels.raw\n")
    return [tmp_path / side / "study.toml" for side in ("left", "right")]


def test_a_dataset_holds_what_the_studies_name(studies, tmp_path):
    dataset = tmp_path / "bids"
    written = write_dataset(studies, dataset)
    assert read_dataset(dataset) == sorted(written)
    assert folder_names(written) == ["sub-TB12_ses-pre1_hemi-L", "sub-TB12_ses-pre1_hemi-R"]
    for source, target in zip(studies, written, strict=True):
        old, new = read_study(source), read_study(target)
        assert replace(new.study, truth=None) == replace(old.study, truth=None)
        assert new.study.truth.read_text() == old.study.truth.read_text()
        assert new.study.truth.parent == target.parent
        for before, after in zip(old.ldv.files, new.ldv.files, strict=True):
            assert after.read_text() == before.read_text()
            assert after.is_relative_to(target.parent / "ldv")
            assert after.name == before.name
        assert new.scan.scan.read_text() == old.scan.scan.read_text()
        assert new.scan.scan.with_name("voxels.raw").exists()
        mapped = new.ldv.files[0]
        assert mapped.with_name(f"{mapped.name}.toml").exists()
    assert json.loads((dataset / "dataset_description.json").read_text())["DatasetType"] == "raw"
    assert (dataset / "participants.tsv").read_text().splitlines()[1] == "sub-TB12\t61.0\tn/a\tn/a"
    assert write_dataset(studies, dataset) == written


def test_companions_of_a_vibrometer_file_keep_their_names(studies, tmp_path, monkeypatch):
    entry = Format(
        "new",
        "invented",
        "",
        lambda head: b" b.csv" in head.content,
        companions=lambda path: [path.with_name("points.csv")],
    )
    monkeypatch.setattr(recognise_format, "FORMATS", (entry, *recognise_format.FORMATS))
    for target in write_dataset(studies, tmp_path / "bids"):
        other = read_study(target).ldv.files[1]
        assert other.with_name("points.csv").exists()
        assert not read_study(target).ldv.files[0].with_name("points.csv").exists()


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


def test_a_table_of_participants_keeps_what_it_holds(studies, tmp_path):
    table = tmp_path / "bids" / "participants.tsv"
    table.parent.mkdir()
    mine = "participant_id\tspecies\tage\tsex\nsub-01\thuman\t70\tF\nsub-TB12\thuman\t61\tn/a\n"
    table.write_text(mine)
    studies[0].write_text(
        STUDY.format(side="left").replace("age = 61", "age = 61\nsex = '=1+cmd'\ngroup = \"a\\tb\\nc\"")
    )
    write_dataset(studies[:1], table.parent)
    rows = [line.split("\t") for line in table.read_text().splitlines()]
    assert rows == [
        ["participant_id", "species", "age", "sex", "group"],
        ["sub-01", "human", "70", "F", "n/a"],
        ["sub-TB12", "human", "61", "'=1+cmd", "a b c"],
    ]
    for text in (mine.replace("61", "62"), "age\n61\n", "participant_id\tage\nsub-01\n", "\n", b"\xff\xfe"):
        table.write_bytes(text if isinstance(text, bytes) else text.encode())
        before = table.read_bytes()
        with pytest.raises(PipelineError):
            write_dataset(studies, table.parent)
        assert table.read_bytes() == before
        assert not list(table.parent.glob("sub-TB12/ses-pre1/*R_study.toml"))


def test_slices_of_another_scan_are_neither_replaced_nor_mixed(studies, tmp_path):
    slices = studies[0].with_name("slices")
    slices.mkdir()
    for number in range(3):
        (slices / f"s{number}.tif").write_text(f"slice {number}")
    studies[0].write_text(STUDY.format(side="left").replace("scan.mhd", "slices"))
    (written,) = write_dataset(studies[:1], tmp_path / "bids")
    copy = read_study(written).scan.scan
    assert sorted(path.name for path in copy.iterdir()) == ["s0.tif", "s1.tif", "s2.tif"]
    assert write_dataset(studies[:1], tmp_path / "bids") == [written]
    (copy / "s3.tif").write_text("mine")
    with pytest.raises(PipelineError):
        write_dataset(studies[:1], tmp_path / "bids")
    (copy / "s3.tif").unlink()
    (copy / "s1.tif").write_text("corrected by hand")
    with pytest.raises(PipelineError):
        write_dataset(studies[:1], tmp_path / "bids")
    assert (copy / "s1.tif").read_text() == "corrected by hand"


@pytest.mark.parametrize("name", ["../data/voxels.raw", "{root}/mine/voxels.raw"])
def test_voxels_outside_the_folder_of_their_header_are_refused(studies, tmp_path, name):
    for folder in ("data", "mine"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "voxels.raw").write_text(folder)
    name = name.format(root=tmp_path)
    header = studies[0].with_name("scan.mhd")
    header.write_text(header.read_text().replace("voxels.raw", name))
    with pytest.raises(PipelineError) as caught:
        write_dataset(studies, tmp_path / "bids")
    (fault,) = caught.value.faults
    assert fault.where == "scan.mhd"
    assert not (tmp_path / "bids").exists()
    assert (tmp_path / "mine" / "voxels.raw").read_text() == "mine"


def test_a_dataset_is_written_whole_and_through_no_link(studies, tmp_path, monkeypatch):
    outside = tmp_path / "mine.csv"
    link = tmp_path / "bids/sub-TB12/ses-pre1/ldv/sub-TB12_ses-pre1_hemi-L_points.csv"
    link.parent.mkdir(parents=True)
    link.symlink_to(outside)
    with pytest.raises(PipelineError):
        write_dataset(studies, tmp_path / "bids")
    assert not outside.exists()
    link.unlink()
    before = sorted(tmp_path.rglob("*"))

    def fail(source, target):
        if source.name == "points.csv":
            raise KeyboardInterrupt
        return copyfile(source, target)

    copyfile = shutil.copyfile
    monkeypatch.setattr("legacy.pipeline.bids.shutil.copyfile", fail)
    with pytest.raises(KeyboardInterrupt):
        write_dataset(studies, tmp_path / "bids")
    assert sorted(tmp_path.rglob("*")) == before


def test_the_command_runs_the_dataset(studies, tmp_path, monkeypatch):
    called = []
    monkeypatch.setattr(
        "legacy.pipeline.several_studies.run_studies", lambda *given: called.append(given) or 1 / 0
    )
    for words in ([*map(str, studies), "--bids", str(tmp_path / "bids")], ["--bids", str(tmp_path / "bids")]):
        with pytest.raises(ZeroDivisionError):
            cli.work(words)
    assert [sorted(one[0]) for one in called] == [read_dataset(tmp_path / "bids")] * 2
    assert called[0][1] == derivatives(tmp_path / "bids")
