"""The script's options reach the files, and every file of a study is read by the commands' own readers."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import tifffile

from legacy.ct_inertia.read_scan import read_volume
from legacy.kinematics.tidy.ldv_csv import read_ldv
from legacy.pipeline.study import read_study
from sample_volumes.old_study import main, reseeded, study_text
from sample_volumes.phantom import Ear, scene
from sample_volumes.vibrometer import Vibrometry


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    ear = "--voxel-um 100 --gap-um 60 --bridges 2 --incus-gap-um 80 --dust 2 --mirror z --phantom analytic"
    how = "--seed 7 --pose-seed 3 --excitations y,z"
    main([*ear.split(), *how.split(), "--out", str(folder)])
    return folder


def test_every_file_is_read_by_the_project(study):
    read = read_study(study / "study.toml")
    assert read.scan.mirror == "z"
    assert read.scan.side == "left"
    assert "SIMULATED: the stapes is a made one" in read.study.notes
    assert "Incus attached" in read.study.notes
    volume = read_volume(study / "scan.tif")
    np.testing.assert_allclose(volume.spacing_mm, 0.1, rtol=1e-6)
    assert volume.array.shape == tifffile.memmap(study / "scan.tif", mode="r").shape
    read_ldv(study / "ldv.csv", study / "points.csv")


def test_stated_density_is_drawn_around_the_true_one():
    placed = scene(Ear(voxel_mm=(0.1, 0.1, 0.1)))
    stated = []
    for seed in range(300):
        text = study_text("ear", replace(placed.ear, noise_seed=seed), placed, Vibrometry())
        value, sd = tomllib.loads(text)["scan"]["density_kg_m3"].split("+-")
        stated.append((float(value) - 1382.4) / float(sd))
    assert abs(np.mean(stated)) < 0.17
    assert np.std(stated) == pytest.approx(1.0, abs=0.12)


def test_parts_can_be_made_alone_and_without_a_plate_the_scan_is_the_reference(tmp_path):
    main(["--voxel-um", "120", "--only", "scan", "--out", str(tmp_path / "a"), "--no-plate"])
    main(["--only", "ldv", "--out", str(tmp_path / "b"), "--no-plate"])
    assert not (tmp_path / "a" / "ldv.csv").exists()
    assert not (tmp_path / "b" / "scan.tif").exists()
    rows = (tmp_path / "b" / "fiducials.csv").read_text(encoding="utf-8").splitlines()
    assert len(rows) == 7
    assert all(row.split(",")[7] == "scan" for row in rows[1:])


def test_anisotropic_voxels_shape_and_plate_reach_the_files(tmp_path):
    scan = ["--voxel-um", "90,100,110", "--shape", "60,70,80", "--bone-reach", "2"]
    plate = ["--plate-tilt-deg=-2,5", "--plate-turn-deg", "80", "--plate-distance-mm", "0.6"]
    main([*scan, *plate, "--only", "scan", "--out", str(tmp_path)])
    assert tifffile.memmap(tmp_path / "scan.tif", mode="r").shape == (80, 70, 60)
    behind = json.loads((tmp_path / "truth.json").read_text(encoding="utf-8"))
    assert behind["voxel_mm"] == [0.09, 0.1, 0.11]
    assert behind["plate_from_footplate"][1][3] == pytest.approx(0.6)


def test_reseeding_changes_pose_noise_and_errors():
    ear, how = reseeded(Ear(), Vibrometry(), 9)
    assert (ear.pose_seed, ear.noise_seed, how.seed) == (9, 9, 9)


def test_a_left_handed_scanner_is_named_in_the_study_file():
    placed = scene(Ear(voxel_mm=(0.1, 0.1, 0.1)))
    study = tomllib.loads(study_text("ear", placed.ear, placed, Vibrometry(mirror="x")))
    assert study["ldv"]["mirror"] == "x"


def test_noise_free_fiducials_agree_in_both_frames_to_rounding(tmp_path):
    main(["--only", "ldv", "--noise-free", "--out", str(tmp_path)])
    rows = [
        line.split(",") for line in (tmp_path / "fiducials.csv").read_text(encoding="utf-8").splitlines()[1:]
    ]
    seen, reference = (np.array([row[a : a + 3] for row in rows], dtype=float) for a in (1, 4))
    lengths = [np.linalg.norm(part[:, None] - part[None], axis=2) for part in (seen, reference)]
    np.testing.assert_allclose(lengths[0], lengths[1], atol=1e-12)
