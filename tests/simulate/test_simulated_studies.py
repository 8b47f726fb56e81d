"""Whole simulated studies: files, truth, the bytes of the sample, cohorts, recordings in every format."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import simulate
from simulate import Ear, Experiment, Population, Scan
from simulate.ligament import PAPER_STIFFNESS

SAMPLE = Path(simulate.__file__).resolve().parents[1] / "sample_volumes"
QUICK = Experiment(lines=20, seed=3)


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sample")
    truth = simulate.simulate_study(Ear(), Scan(), Experiment(), folder, name="sample ear")
    return folder, truth


@pytest.mark.parametrize("name", ["ldv.csv", "points.csv", "fiducials.csv"])
def test_the_sample_study_is_written_as_it_stands(sample, name):
    folder, _ = sample
    assert (folder / name).read_bytes() == (SAMPLE / name).read_bytes()


def test_the_sample_study_adds_only_what_was_confirmed(sample):
    folder, _ = sample
    made, stands = (tomllib.loads((place / "study.toml").read_text()) for place in (folder, SAMPLE))
    assert set(stands["study"].pop("confirmed")) == {"handedness_unconfirmed"}
    assert made == stands


def test_the_sample_scan_and_truth_are_those_that_stand(sample):
    import tifffile

    folder, _ = sample
    made, stands = tifffile.imread(folder / "scan.tif"), tifffile.imread(SAMPLE / "scan.tif")
    difference = np.abs(made.astype(int) - stands.astype(int))
    assert difference.max() <= 1  # another make of processor rounds a few grey values the other way
    assert np.count_nonzero(difference) < 200
    now, then = (json.loads((place / "truth.json").read_text()) for place in (folder, SAMPLE))
    assert list(now) == list(then)
    for key, value in then.items():
        if isinstance(value, list) and not isinstance(value[0], str):
            scale = np.abs(value).max()
            assert np.abs(np.array(now[key]) - value).max() <= 1e-12 * scale, key


def test_frames_hang_together():
    truth = simulate.simulate_truth(Ear(), Scan(seed=7))
    both = truth.scan_from_plate @ truth.plate_from_footplate
    assert np.abs(both.matrix - truth.scan_from_footplate.matrix).max() < 1e-12
    assert truth.scan_from_plate.rotation[0, 0] > 0.0
    recording = simulate.simulate_recording(truth, Experiment(exact=True, lines=5))
    pose = recording.vibrometer_from_footplate @ truth.plate_from_footplate.inverse()
    for _, seen, place in recording.fiducials:
        assert seen == pytest.approx(pose.points(place), abs=1e-9)
    named = truth.placed.fiducials_mm()
    assert len({tuple(np.round(mark, 6)) for mark in named.values()}) == 6


def test_cohort_follows_its_law():
    population = Population(ears=120, pairs=20, stretch=0.0, size=0.2)
    members = list(simulate.cohort(population))
    whole = population.ear.mass().mass_kg
    mass = np.log([whole * np.prod(member.ear.stapes.stretch) for member in members])
    assert members[0].ear.mass().mass_kg == pytest.approx(np.exp(mass[0]), rel=1e-9)
    first = [member.ear.ligament for member in members]
    for entry, exponent in ((0, 1.0), (1, 5.0 / 3.0)):
        response = np.log([ligament.stiffness_si[entry, entry] for ligament in first])
        slope, _ = np.polyfit(mass, response, 1)
        spread = population.intrinsic_sd / (np.std(mass) * np.sqrt(120))
        assert abs(slope - exponent) < 4.0 * spread
    assert {member.ear.side for member in members} == {"left", "right"}
    pair = [member for member in members if member.subject == "P01"]
    assert [member.ear.side for member in pair] == ["left", "right"]
    right = pair[1].ear.ligament.stiffness_si
    assert np.sign(right[0, 1]) == -np.sign(PAPER_STIFFNESS[0, 1])
    assert np.sign(right[0, 2]) == np.sign(PAPER_STIFFNESS[0, 2])


@pytest.fixture(scope="module")
def recording():
    return simulate.simulate_recording(simulate.simulate_truth(Ear()), replace(QUICK, excitations=("y", "x")))


def test_tidy_table_holds_the_recording(recording, tmp_path):
    table = pd.read_csv(simulate.write_recording(tmp_path, recording))
    shape = recording.velocity_m_s.shape
    value = (table["re_m_s"] + 1j * table["im_m_s"]).to_numpy().reshape(shape)
    assert value == pytest.approx(recording.velocity_m_s, rel=1e-6, abs=1e-12)
    assert table["sd_m_s"].to_numpy().reshape(shape) == pytest.approx(recording.sd_m_s, rel=1e-4)
    assert table["run"].unique().tolist() == ["y", "x"]
    points = pd.read_csv(tmp_path / "points.csv")
    assert len(points) == 19
    assert np.linalg.norm(table[["dir_x", "dir_y", "dir_z"]], axis=1) == pytest.approx(1.0, abs=1e-9)


def _axes(recording):
    """Velocities (P, 3, L) along x, y, z of the first run, from the beams."""
    count = len(recording.point) // 3
    beams = recording.direction.reshape(count, 3, 3)
    return np.linalg.solve(beams, recording.velocity_m_s[0].reshape(count, 3, -1))


def test_universal_files_are_read_by_pyuff(recording, tmp_path):
    import pyuff

    sets = pyuff.UFF(str(simulate.write_recording(tmp_path, recording, "uff"))).read_sets()
    expected = _axes(recording)
    spectra = [one for one in sets if one["type"] == 58]
    assert len(spectra) == expected.shape[0] * 3
    for one in spectra:
        seen = expected[int(one["rsp_node"]) - 1, int(one["rsp_dir"]) - 1]
        assert np.abs(one["data"] - seen).max() < 2e-6 * np.abs(expected).max()
    nodes = next(one for one in sets if one["type"] == 15)
    assert np.array(nodes["x"]) == pytest.approx(recording.position_mm[::3, 0], abs=1e-4)


def test_the_example_of_the_package_runs(tmp_path, monkeypatch):
    lines = simulate.__doc__.split("One study in one call:")[1].split("It writes scan.tif")[0]
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec("\n".join(line.removeprefix("    ") for line in lines.splitlines()), names)
    truth = names["truth"]
    assert {path.name for path in (tmp_path / "ear2").iterdir()} == {
        "scan.tif",
        "ldv.csv",
        "points.csv",
        "fiducials.csv",
        "study.toml",
        "truth.json",
    }
    (culprit,) = truth.recording.culprits
    assert (truth.recording.point[culprit], truth.recording.laser[culprit]) == ("3", 1)
    assert truth.motion_m["stapes"].shape == (1, 60, 6)
