"""The page for a first measurement: its commands run as they are printed."""

from __future__ import annotations

import csv
import re
import shlex
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from legacy.ct_inertia.cli import parser as ct_parser
from legacy.fitting.api import dof2kd
from legacy.kinematics.cli import parser, work
from legacy.kinematics.measure_motion import motion_inputs, read_inputs
from legacy.kinematics.options import LdvOptions
from tests.kinematics.records import write_record

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "sample_volumes"
GUIDE = (ROOT / "docs" / "export_from_psv.md").read_text(encoding="utf-8")


def commands():
    blocks = "".join(re.findall(r"```sh\n(.*?)```", GUIDE, re.DOTALL))
    return [shlex.split(line) for line in blocks.splitlines() if line.strip()]


def test_the_commands_of_the_guide_run_on_the_exports_of_the_sample(tmp_path, monkeypatch, undrawn):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(SAMPLE / "exports", tmp_path / "exports")
    (tmp_path / "fiducials.csv").write_bytes((SAMPLE / "fiducials.csv").read_bytes())
    (tmp_path / "mass").mkdir()
    write_record(tmp_path / "mass")
    scan, *points, fit = commands()
    (tmp_path / "scan.tif").touch()
    assert str(ct_parser().parse(scan[1:]).out) == "mass"
    assert [words[0] for words in points] == ["points2dof"] * 4
    assert {Path(words[1]).name for words in points} == {"scan.uff", "fastscan.txt", "scan.mat", "wide.csv"}
    for words in points[1:]:  # read as they are printed; what they read is the same, see readers/test_wide.py
        inputs = motion_inputs(parser().parse(words[1:]).make(LdvOptions))
        measurement = read_inputs(inputs).measurement
        assert [len(body.points) for body in measurement.bodies] == [30, 27]
    _, outcome = work(points[0][1:])
    assert outcome.result["lines"] == 200
    assert (tmp_path / "dof.html").is_file()
    assert fit[0] == "dof2kd"
    assert Path(fit[1]).is_file()
    (notebook,) = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)
    names: dict[str, Any] = {}
    monkeypatch.setattr(
        "legacy.stapeskit.dof2kd", partial(dof2kd, band_hz=(400.0, 1000.0))
    )  # few lines: soon fitted
    exec(compile(notebook, "export_from_psv.md", "exec"), names)
    assert names["wrong"] == []
    with (tmp_path / "dof.csv").open(encoding="utf-8") as file:
        table = [row for row in csv.DictReader(file) if row["body"] == "stapes"]
    written = np.array([float(row["y_re_m"]) + 1j * float(row["y_im_m"]) for row in table])
    assert np.allclose(names["piston"], written, rtol=1e-9, atol=0.0)
    with h5py.File(tmp_path / "dof.h5") as file:
        assert file["covariance"].shape == (1, 2, 200, 6, 6)
        assert file["covariance"].dtype.names is None
        assert file["covariance"].id.get_type().get_member_name(0) == b"r"
    others = (ROOT / "docs" / "other_programs.md").read_text(encoding="utf-8")
    (matlab,) = re.findall(r"```matlab\n(.*?)```", others, re.DOTALL)
    assert {"body", "freq_hz", *re.findall(r"T\.(\w+)", matlab)} <= set(table[0])


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
