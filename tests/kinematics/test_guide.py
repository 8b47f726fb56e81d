"""The page for a first measurement: its commands run as they are printed."""

from __future__ import annotations

import csv
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ct_inertia.cli import parser as ct_parser
from kinematics.cli import work
from kinematics.tidy.ldv_csv import read_ldv
from tests.kinematics.records import write_record
from tests.kinematics.rewritten import write_three_ways

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "sample_volumes"
GUIDE = (ROOT / "docs" / "export_from_psv.md").read_text(encoding="utf-8")


def commands():
    blocks = "".join(re.findall(r"```sh\n(.*?)```", GUIDE, re.DOTALL))
    return [shlex.split(line) for line in blocks.splitlines() if line.strip()]


def test_the_commands_of_the_guide_run_on_exports_of_the_sample(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    read = read_ldv(SAMPLE / "ldv.csv", SAMPLE / "points.csv", "vibrometer")
    bodies = tuple(
        replace(b, displacement=b.displacement[:, :, ::4], sd=b.sd[:, :, ::4]) for b in read.bodies
    )
    write_three_ways(tmp_path, replace(read, bodies=bodies, freq_hz=read.freq_hz[::4]))
    (tmp_path / "xyz.uff").rename(tmp_path / "scan.uff")
    (tmp_path / "xyz").rename(tmp_path / "fastscan")
    (tmp_path / "fiducials.csv").write_bytes((SAMPLE / "fiducials.csv").read_bytes())
    (tmp_path / "mass").mkdir()
    write_record(tmp_path / "mass")
    scan, *points = commands()
    (tmp_path / "scan.tif").touch()
    assert str(ct_parser().parse(scan[1:]).out) == "mass"
    assert [words[0] for words in points] == ["points2dof", "points2dof"]
    for words in points:
        _, outcome = work(words[1:])
        assert outcome.result["bodies"]["stapes"]["channels"] == 30
        assert outcome.result["bodies"]["base"]["channels"] == 27
        assert outcome.result["lines"] == 50
    for name in ("dof.html", "fastscan_dof.html"):
        assert (tmp_path / name).is_file()


def test_the_sections_of_the_guide_are_those_of_the_page():
    named = re.findall(r"^\| ([A-Z][\w ]+?) \|", GUIDE, re.MULTILINE)
    source = "".join(
        path.read_text(encoding="utf-8") for path in (ROOT / "kinematics" / "report").rglob("*.py")
    )
    assert len(named) == 7
    for heading in named:
        assert f'"{heading}"' in source
    for target in re.findall(r"\]\(([^)#]+)\)", GUIDE):
        assert (ROOT / "docs" / target).exists()


def test_the_notebook_of_the_guide_gives_what_the_command_writes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("points.csv", "fiducials.csv"):
        (tmp_path / name).write_bytes((SAMPLE / name).read_bytes())
    header, *rows = (SAMPLE / "ldv.csv").read_text(encoding="utf-8").splitlines()
    (tmp_path / "ldv.csv").write_text("\n".join([header, *rows[::5]]) + "\n", encoding="utf-8")
    (tmp_path / "mass").mkdir()
    write_record(tmp_path / "mass")
    (source,) = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)
    seen: dict[str, Any] = {}
    exec(source, seen)
    files = ["--points", "points.csv", "--fiducials", "fiducials.csv", "--mass", "mass/mass.json"]
    work(["ldv.csv", *files])
    with (tmp_path / "dof.csv").open(encoding="utf-8") as file:
        table = [row for row in csv.DictReader(file) if row["body"] == "stapes"]
    written = np.array([float(row["y_re_m"]) + 1j * float(row["y_im_m"]) for row in table])
    assert len(written) == 40
    assert np.allclose(seen["piston"], written, rtol=1e-9, atol=0.0)
    with h5py.File(tmp_path / "dof.h5") as file:
        assert file["covariance"].shape == (1, 2, 40, 6, 6)
        assert file["covariance"].dtype.names is None
        assert file["covariance"].id.get_type().get_member_name(0) == b"r"
    (matlab,) = re.findall(r"```matlab\n(.*?)```", GUIDE, re.DOTALL)
    assert {"body", "freq_hz", *re.findall(r"T\.(\w+)", matlab)} <= set(table[0])
