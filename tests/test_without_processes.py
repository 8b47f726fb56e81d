"""What a browser offers is enough for motion, K and D: no VTK, no threads, no processes, no compiled code."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from legacy.stapeskit.records.motion_files import write_motion
from tests.fitting.cases import K, M, paper_motion
from tests.kinematics.records import write_record

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "sample_volumes"
# Packages without a build for Pyodide 314, and what its process lacks.
CHAIN = """
import ctypes, os, subprocess, sys, threading, types

for name in ("vtk", "vtkmodules", "SimpleITK", "imagecodecs", "trimesh", "pymeshlab"):
    sys.modules[name] = None

def missing(*_words, **_more):
    raise RuntimeError("can't start new thread")

def unsupported(*_words, **_more):
    raise OSError(138, "Not supported")

threading.Thread.start = os.fork = missing
ctypes.CDLL = subprocess.Popen.__init__ = unsupported
import legacy.stapeskit as sk
from legacy.stapeskit import guard

guard.sys = types.SimpleNamespace(platform="emscripten")

read = sk.points2dof("ldv.csv", points="points.csv", fiducials="fiducials.csv", mass="mass.json")
fit = sk.dof2kd("paper.h5", mass="M.csv", bands=0)
print(read.motion.chi2.sum() / read.motion.n_dof.sum(), fit.stiffness[0, 0])
"""


def test_motion_and_stiffness_come_out_as_anywhere_else(tmp_path):
    for name in ("points.csv", "fiducials.csv"):
        (tmp_path / name).write_bytes((SAMPLE / name).read_bytes())
    header, *rows = (SAMPLE / "ldv.csv").read_text(encoding="utf-8").splitlines()
    (tmp_path / "ldv.csv").write_text("\n".join([header, *rows[::5]]) + "\n", encoding="utf-8")
    write_record(tmp_path)
    motion = paper_motion(noise=1e-3)
    none = np.zeros(motion.q.shape[:3])
    write_motion(tmp_path, "paper", replace(motion, chi2=none, n_dof=none.astype(int)))
    np.savetxt(tmp_path / "M.csv", M, delimiter=",")
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{CHAIN}"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    rigid, stiffness = map(float, done.stdout.split())
    assert rigid == pytest.approx(1.0, abs=0.1)
    assert stiffness == pytest.approx(K[0, 0], rel=0.01)
