"""The scripts of the sample study and the sample cohort take their settings and write what they say."""

from __future__ import annotations

import json
import tomllib

import pandas as pd
import pytest

import simulate
from sample_volumes.make_cohort import compare, make_cohort
from sample_volumes.make_sample import main


def test_settings_reach_the_files(tmp_path):
    ear, scan = (
        ["--ear", "gap_mm=0.1", "stapes.scale=0.9"],
        ["--scan", "voxel_um=[80,90,100]", "mirror=z", "samples=1"],
    )
    how = ["--experiment", "lines=12", 'excitations=["y","x"]', "stated=coherence"]
    main(["--out", str(tmp_path), "--seed", "3", "--exports", *ear, *scan, *how])
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert truth["gap_mm"] == 0.1
    assert truth["mass_kg"] == pytest.approx(3.2e-6 * 0.9**3, rel=1e-3)
    assert truth["voxel_mm"] == pytest.approx([0.08, 0.09, 0.1])
    table = pd.read_csv(tmp_path / "ldv.csv")
    assert table["run"].unique().tolist() == ["y", "x"]
    assert table["freq_hz"].nunique() == 12
    assert "coherence" in table
    assert tomllib.loads((tmp_path / "study.toml").read_text())["scan"]["mirror"] == "z"
    names = {path.name for path in (tmp_path / "exports").iterdir()}
    assert names == {"points.csv", "scan.uff", "fastscan.txt", "scan.mat", "wide.csv"}


def test_unknown_setting_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["--out", str(tmp_path), "--ear", "gap=0.1"])
    assert "gap_mm" in capsys.readouterr().err


def test_cohort_is_written_and_compared(tmp_path):
    population = simulate.Population(ears=3, pairs=1, ear=simulate.Ear(plate=False))
    truth = make_cohort(tmp_path, population, simulate.Scan(format="ply"))
    assert [ear["folder"] for ear in truth["ears"]] == ["ear01", "ear02", "ear03"]
    studies = [
        tomllib.loads((tmp_path / "ears" / ear["folder"] / "study.toml").read_text()) for ear in truth["ears"]
    ]
    assert studies[0]["study"]["subject"] == studies[1]["study"]["subject"]
    assert len({study["scan"]["density_kg_m3"] for study in studies}) == 3
    law = {
        "response": "K11",
        "predictor": "mass_kg",
        "exponent": 1.1,
        "exponent_interval_95": [0.5, None],
        "intrinsic_sd_log": 0.1,
        "intrinsic_sd_log_interval_95": [0.05, 0.2],
    }
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "cohort.json").write_text(json.dumps({"laws": [law, {**law, "predictor": "gap_m"}]}))
    (row,) = compare(tmp_path)
    assert row["inside"]
    assert row["scatter_inside"]
    assert row["planted"] == 1.0
