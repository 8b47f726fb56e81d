"""What the front page says can be typed runs as it stands."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sample_volumes.make_sample import make_study
from sample_volumes.phantom import Ear
from sample_volumes.vibrometer import Vibrometry

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BIN = Path(sys.executable).parent


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A folder as a user has it: scan, vibrometer table, points, fiducials, study."""
    folder = tmp_path_factory.mktemp("lab")
    truth = make_study(folder, Ear(voxel_mm=(0.05,) * 3), Vibrometry(lines=60), "ear")
    return folder, truth


def test_the_four_commands_run_as_they_are_printed(lab):
    folder, truth = lab
    lines = [line.split("#")[0].strip() for line in blocks("sh")[1].splitlines() if line.strip()]
    assert [shlex.split(line)[0] for line in lines] == ["ct2mass", "points2dof", "dof2kd", "scan2kd"]
    for line in lines:
        words = shlex.split(line)
        done = subprocess.run(
            [str(BIN / words[0]), *words[1:]],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert "Traceback" not in done.stderr
    kd = json.loads((folder / "study_out" / "kd.json").read_text(encoding="utf-8"))
    assert kd["stiffness_si"][0][0] == pytest.approx(truth["stiffness_si"][0][0], rel=0.05)
    assert (folder / "kd.json").is_file()


def test_a_cut_is_corrected_as_it_is_printed(lab):
    folder, _ = lab
    labels = folder / "scan_mass" / "labels.nrrd"
    (line,) = blocks("sh")[2].splitlines()
    first, _, given = line.partition(" --labels ")
    assert given == "scan_mass/labels.nrrd"
    before = b""
    for words in (shlex.split(first), shlex.split(line)):
        done = subprocess.run(
            [str(BIN / words[0]), *words[1:], "--no-report"],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        before = labels.read_bytes() if words == shlex.split(first) else before
    assert labels.read_bytes() == before
    assert json.loads((labels.parent / "mass.json").read_text(encoding="utf-8"))["labels_file"] != labels.name


def test_the_notebook_example_goes_from_scan_to_stiffness(lab, monkeypatch, capsys):
    folder, truth = lab
    monkeypatch.chdir(folder)
    names: dict[str, object] = {}
    exec(compile(blocks("python")[0], "README.md", "exec"), names)
    matrix = names["mass"].matrix.matrix
    assert matrix.shape == (6, 6)
    assert matrix[0, 0] == pytest.approx(truth["volume_m3"] * 1900.0, rel=5e-3)
    assert np.all(np.linalg.eigvalsh(matrix) > 0.0)
    stiffness = names["result"].stiffness
    assert str(stiffness) in capsys.readouterr().out
    assert stiffness.shape == (3, 3)


def test_every_file_that_the_page_names_exists():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if not target.startswith("http"):
            assert (ROOT / target).exists(), target
    for script in re.findall(r"python (benchmarks/\w+\.py)", README):
        assert (ROOT / script).is_file(), script
