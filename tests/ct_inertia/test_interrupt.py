"""Ctrl-C while `ct2mass` works: exit code 130, and nothing left behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCAN = ROOT / "sample_volumes" / "scan.tif"


@pytest.mark.parametrize("after_s", [0.2, 1.0])
def test_an_interrupted_run_leaves_nothing(tmp_path, after_s):
    words = [sys.executable, "-c", "from ct_inertia.cli import main; print(1, flush=True); main()", str(SCAN)]
    process = subprocess.Popen(
        [*words, "--density", "1900", "--anterior", "1,0,0", "--out", str(tmp_path / "out")],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
    )
    assert process.stdout.readline() == "1\n"
    time.sleep(after_s)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted" in told
    assert "Traceback" not in told
    assert list(tmp_path.iterdir()) == []
