"""Every script of the gallery prints a number and writes a picture; files for other programs hold."""

from __future__ import annotations

import io
import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import h5py
import numpy as np
import pytest
import SimpleITK as sitk
import yaml
from scipy.io import loadmat

from legacy.ct_inertia.options import MassOptions
from legacy.fitting.cli import work as dof2kd
from legacy.fitting.export_formats import exported
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.options import KDOptions
from legacy.stapeskit.options import declared
from legacy.stapeskit.records.mass_record import read_mass_record
from legacy.stapeskit.records.motion_files import read_motion

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
SCRIPTS = sorted(path.stem for path in EXAMPLES.glob("*.py"))


@pytest.fixture
def undrawn():
    """Leave nothing away here: the scripts draw."""


@pytest.fixture
def results(finished):
    """The folder of a finished study."""
    return finished[1]


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_prints_a_number_and_writes_a_picture(name, results, tmp_path, monkeypatch, capsys):
    picture = tmp_path / "picture.png"
    monkeypatch.setattr(sys, "argv", [f"{name}.py", str(results), str(picture)])
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    assert re.search(r"\d", capsys.readouterr().out)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_gallery_lists_every_script():
    text = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^\| \[(\w+)\.py\]", text, re.MULTILINE)) == SCRIPTS
    for target in re.findall(r"\]\(([^)]+)\)", text):
        assert (EXAMPLES / target).exists(), target


def test_the_octave_script_reads_names_that_exist(results):
    text = (EXAMPLES / "octave" / "redraw_responses.m").read_text(encoding="utf-8")
    kd = json.loads((results / "kd.json").read_text(encoding="utf-8"))
    mass = json.loads((results / "mass.json").read_text(encoding="utf-8"))
    assert set(re.findall(r"\bkd\.(\w+)", text)) - {"json", "mat"} <= set(kd)
    for path in set(re.findall(r"\bmass\.(?!json)([\w.]+)", text)):
        value = mass
        for key in path.split("."):
            value = value[key]
    matrix = read_mass_record(results / "mass.json").mass_matrix
    fit = fit_kd(read_motion(results / "dof.h5"), matrix, KDOptions(bands=0))
    assert set(re.findall(r"\bfit\.(\w+)", text)) == {"K", "D", "M", "dof"} & set(
        loadmat(io.BytesIO(exported(fit, "mat")))
    )
    with h5py.File(results / "dof.h5") as file:
        assert set(re.findall(r"h5read\(file, '/(\w+)'\)", text)) <= set(file)
        members = file["q"].id.get_type()
        assert [members.get_member_name(k) for k in range(2)] == [b"r", b"i"]
    header = (results / "dof.csv").read_text(encoding="utf-8").splitlines()[0].split(",")
    assert {"freq_hz", "body", "y_re_m", "y_im_m", "alpha_re_rad"} <= set(header)


def test_the_page_of_other_programs_runs_as_it_is_printed(results, tmp_path, monkeypatch):
    page = (ROOT / "docs" / "other_programs.md").read_text(encoding="utf-8")
    lines = "".join(re.findall(r"```sh\n(.*?)```", page, re.DOTALL)).splitlines()
    shutil.copytree(results, tmp_path / "results")
    if not (tmp_path / "results" / "labels.nrrd").is_file():  # a study of a surface has none
        sitk.WriteImage(sitk.Image([4, 4, 4], sitk.sitkUInt8), str(tmp_path / "results" / "labels.nrrd"))
    monkeypatch.chdir(tmp_path)
    (fit,) = (shlex.split(line) for line in lines if line.startswith("dof2kd "))
    dof2kd(fit[1:])
    for source in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(source, "other_programs.md", "exec"), {})
    assert (tmp_path / "labels.nii.gz").is_file()
    (octave,) = (shlex.split(line) for line in lines if line.startswith("octave-cli "))
    if shutil.which(octave[0]):
        call = f"{octave[-1]} assert(redraw_responses('results', '', 'models/kd.mat') < 0.1);"
        octave[2:] = [str(EXAMPLES / "octave"), "--eval", call]
        subprocess.run(octave, check=True, capture_output=True, timeout=60)
        assert (tmp_path / "responses.svg").is_file()


def test_the_description_for_slicer_names_options_that_exist():
    tree = ElementTree.parse(EXAMPLES / "slicer" / "ct2mass.xml")
    known = {one.name for one in declared(MassOptions)} | {"out"}
    assert {flag.text for flag in tree.iter("longflag")} <= known


def test_the_napari_reader_lays_labels_on_the_surface(results, monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES / "napari"))
    from stapeskit_napari import get_reader

    manifest = yaml.safe_load(
        (EXAMPLES / "napari" / "stapeskit_napari" / "napari.yaml").read_text(encoding="utf-8")
    )
    assert manifest["contributions"]["commands"][0]["python_name"] == "stapeskit_napari:get_reader"
    assert get_reader("scan.tif") is None
    path = str(results / "mass.json")
    layers = {meta["name"]: (data, meta, kind) for data, meta, kind in get_reader(path)(path)}
    vertices, faces = layers["stapes"][0]
    assert layers["stapes"][2] == "surface"
    assert faces.max() < len(vertices)
    centre = json.loads(Path(path).read_text(encoding="utf-8"))["center_of_mass_in_scan_mm"]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    assert np.all((low < centre[::-1]) & (centre[::-1] < high))
    if "labels" in layers:
        data, meta, _ = layers["labels"]
        middle = np.argwhere(data == 1).mean(axis=0)
        assert meta["affine"][:3, :3] @ middle + meta["affine"][:3, 3] == pytest.approx(
            centre[::-1], abs=0.02
        )
