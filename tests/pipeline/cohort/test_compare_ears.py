"""Several ears: one subfolder each, a table, a plain comparison; a failed study does not lose the others."""

import csv
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from legacy.ct_inertia.options import MassOptions
from legacy.pipeline.cohort.cohort_page import write_cohort_page
from legacy.pipeline.cohort.compare_ears import (
    Ear,
    Quantity,
    labels,
    quantities,
    read_ear,
    source_id,
    write_cohort_csv,
)
from legacy.pipeline.runners.study_process import Task
from legacy.pipeline.several_studies import folder_names, run_studies
from legacy.stapeskit.faults import StapeskitError

ROOT = Path(__file__).parents[2]


def ears_like(finished, count, side="left"):
    one = read_ear(finished[1], "one")
    return [Ear(f"ear {k}", f"ear{k}", side, one.mass, one.kd) for k in range(count)]


def test_cohort_table_has_a_row_per_ear_and_units_in_its_names(finished, tmp_path):
    write_cohort_csv(tmp_path / "cohort.csv", ears_like(finished, 2))
    with (tmp_path / "cohort.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    kd = finished[2].kd
    assert [row["study"] for row in rows] == ["ear 0", "ear 1"]
    for column, value in (
        ("mass_kg", finished[2].mass["mass_kg"]),
        ("mass_sd_kg", finished[2].mass["mass_matrix"]["standard_deviation_si"][0][0]),
        ("K_y_y_n_per_m", kd["stiffness_si"][0][0]),
        ("K_y_y_sd_n_per_m", kd["stiffness_sd_si"][0][0]),
        ("K_y_alpha_n", kd["stiffness_si"][0][1]),
        ("D_gamma_gamma_n_s_m_per_rad", kd["damping_si"][2][2]),
        ("mode2_frequency_hz", kd["modes"][1]["frequency_hz"]),
        ("mode3_damping_ratio", kd["modes"][2]["damping_ratio"]),
    ):
        assert float(rows[1][column]) == pytest.approx(value, rel=1e-12), column


def test_homogeneity_is_cochrans():
    rng = np.random.default_rng(5)
    p = []
    for _ in range(2000):
        sd = rng.uniform(0.5, 2.0, 6)
        p.append(Quantity("a", "", 3.0 + sd * rng.standard_normal(6), sd).homogeneity()[2])
    assert np.mean(np.array(p) < 0.05) == pytest.approx(0.05, abs=0.015)
    shared = Quantity("a", "", np.array([1.0, 1.2]), np.array([0.2, 0.2]), own=np.array([0.1, 0.1]))
    assert shared.homogeneity()[0] == pytest.approx(2.0)
    far = Quantity("a", "", np.array([1.0, 2.0]), np.array([0.1, 0.1])).homogeneity()
    assert far[0] == pytest.approx(50.0)
    assert far[1] == 1
    assert far[2] < 1e-9
    assert np.isnan(Quantity("a", "", np.array([1.0]), np.array([0.1])).homogeneity()[2])


def test_voxel_sizes_are_off_together_on_one_scanner_that_is_known_as_well():
    def ear(scanner: str, percent: float) -> Ear:
        options = MassOptions("scan.tif", density=(1900.0, None), voxel_size_sd_percent=percent)
        mass = {"provenance": {"parameters": options.parameters()}}
        return Ear("one", "one", "left", mass, {}, {"scanner": scanner})

    one = source_id(ear("A", 0.2), "voxel_size")
    assert one == source_id(ear("A", 0.2), "voxel_size")
    assert len({one, source_id(ear("B", 0.2), "voxel_size"), source_id(ear("A", 0.5), "voxel_size")}) == 3


def test_entries_that_turn_with_the_side(finished):
    """A mirror image in the x-y plane turns alpha, beta and z: K' = S K S with S = diag(1, -1, 1)."""
    turns = {one.name for one in quantities(ears_like(finished, 2)) if one.turns}
    sign = np.outer([1, -1, 1], [1, -1, 1])
    names = ("y", "alpha", "gamma")
    wanted = {
        f"{letter}_{names[i]}_{names[j]}"
        for letter in "KD"
        for i in range(3)
        for j in range(i, 3)
        if sign[i, j] < 0
    }
    assert turns == wanted


def test_right_ears_are_compared_as_mirror_images(finished, tmp_path):
    left, right = ears_like(finished, 1)[0], ears_like(finished, 1, "right")[0]
    unknown = ears_like(finished, 1, "")[0]
    write_cohort_page(tmp_path / "same.html", [left, right], {})
    write_cohort_page(tmp_path / "mixed.html", [left, unknown], {"ear 9": "no scan"})
    same, mixed = ((tmp_path / name).read_text(encoding="utf-8") for name in ("same.html", "mixed.html"))
    assert same.count("K(y, alpha)") == 2
    assert mixed.count("K(y, alpha)") == 1
    assert "no scan" in mixed
    assert "http://" not in same
    assert "https://" not in same
    entry = next(one for one in quantities([left, right]) if one.name == "K_y_alpha")
    turned = entry.mirrored(np.array([False, True]))
    assert turned.values[1] == -turned.values[0]


def test_studies_of_one_name_are_told_apart(finished, tmp_path):
    one = read_ear(finished[1], "ear")
    same = [Ear("ear", folder, "left", one.mass, one.kd) for folder in ("a", "b")]
    assert labels([*same, Ear("other", "c", "left", one.mass, one.kd)]) == ["ear (a)", "ear (b)", "other"]
    write_cohort_page(tmp_path / "cohort.html", same, {})
    text = (tmp_path / "cohort.html").read_text(encoding="utf-8")
    assert '<th scope="col">ear (a)</th>' in text
    assert '<th scope="col">ear (b)</th>' in text


def test_folders_are_named_by_file_or_by_place():
    names = folder_names(
        [Path("/a/left.toml"), Path("/b/study.toml"), Path("/c/study.toml"), Path("/d/c/study.toml")]
    )
    assert names == ["left", "b", "c", "c-2"]


def test_names_that_differ_in_capitals_alone_are_two_folders_everywhere():
    studies = [Path("/a/ear.toml"), Path("/b/Ear.toml"), Path("/c/COHORT.CSV.toml")]
    assert folder_names(studies) == ["ear", "Ear-2", "COHORT.CSV-2"]


def test_no_folder_is_a_parent_or_hidden():
    assert folder_names([Path("cohort.csv.toml"), Path("cohort.toml")]) == ["cohort.csv-2", "cohort"]
    assert folder_names([Path("...toml"), Path(".stapeskit.toml"), Path("../..toml")]) == [
        "study",
        "stapeskit",
        "study-2",
    ]


def test_one_failed_study_does_not_lose_the_other(ear, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "legacy.pipeline.several_studies.Task", partial(Task, program="tests.pipeline.settled_child")
    )
    study, out = ear
    (tmp_path / "all").mkdir()
    out.rename(tmp_path / "all" / "ear1")
    broken = tmp_path / "broken" / "study.toml"
    broken.parent.mkdir()
    broken.write_text(study.read_text(encoding="utf-8").replace("[fit]", "[fitt]"))
    lines = []
    result = run_studies([study, broken], tmp_path / "all", jobs=2, tell=lines.append)
    assert [(one.folder, one.name) for one in result.ears] == [("ear1", "ear one")]
    assert result.codes == {"broken": 2}
    assert "Did you mean [fit]?" in result.faults["broken"]
    assert "scan.file must be an existing file" in result.faults["broken"]
    assert not (tmp_path / "all" / "broken").exists()
    with (tmp_path / "all" / "cohort.csv").open() as stream:
        done, failed = csv.DictReader(stream)
    assert (done["study"], done["error"]) == ("ear one", "")
    assert float(done["mass_kg"]) == result.ears[0].mass["mass_kg"]
    assert int(done["warnings"]) == result.ears[0].warnings
    assert (failed["folder"], failed["mass_kg"]) == ("broken", "")
    assert "Did you mean [fit]?" in failed["error"]
    assert "broken" in (tmp_path / "all" / "cohort.html").read_text(encoding="utf-8")
    assert any(line.startswith("ear1: fit") for line in lines)
    log = (tmp_path / "all" / "cohort.log").read_text(encoding="utf-8").splitlines()
    assert any(line.endswith("ear1: done (2 of 2 ears)") or "(1 of 2 ears)" in line for line in log)
    assert {"cohort.csv", "cohort.html", "cohort.json", "cohort.log"} == {file.name for file in result.files}


def test_no_study_writes_over_what_another_reads(ear, tmp_path):
    study, out = ear
    (tmp_path / "all").mkdir()
    out.rename(tmp_path / "all" / "study")
    other = study.with_name("other.toml")
    text = study.read_text(encoding="utf-8")
    other.write_text(text.replace("[ldv]", 'landmarks = "../all/study/dof.csv"\n[ldv]'))
    before = {path: path.read_bytes() for path in (tmp_path / "all").rglob("*") if path.is_file()}
    for force in (False, True):
        with pytest.raises(StapeskitError, match=r"dof\.csv must be another file than the inputs"):
            run_studies([study, other], tmp_path / "all", force=force)
    (tmp_path / "all" / "cohort.csv").write_text("the lab's own list")
    with pytest.raises(StapeskitError, match=r"cohort\.csv, which it is not known to have written"):
        run_studies([study], tmp_path / "all")
    assert {path: path.read_bytes() for path in before} == before


def test_interrupting_several_studies_leaves_nothing(ear, tmp_path):
    study, _ = ear
    second = tmp_path / "ear2"
    study.parent.rename(second)
    other = tmp_path / "ear1"
    other.mkdir()
    for path in second.iterdir():
        (other / path.name).write_bytes(path.read_bytes())
    words = [
        sys.executable,
        "-m",
        "legacy.pipeline.cli",
        str(other / "study.toml"),
        str(second / "study.toml"),
    ]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [*words, "--jobs", "2", "--out", str(tmp_path / "both")],
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
    )
    told = process.stderr.readline()
    assert "vibrometer table" in told
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    _, rest = process.communicate(timeout=60)
    assert process.returncode == 130
    assert rest.count("interrupted") == 1
    assert not (tmp_path / "both").exists()
    assert not list(tmp_path.glob(".stapeskit-*"))
