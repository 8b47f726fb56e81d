"""docs/cluster/Snakefile, run by snakemake with a stand-in for scan2kd that notes how it is called."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
SCAN2KD = """#!/bin/sh
echo "$@" >> calls
case "$*" in *broken.toml\\ --out*) [ $# = 3 ] && exit 2;; esac
mkdir -p out
[ $# -gt 3 ] && touch out/cohort.html
exit 0
"""


def test_each_ear_is_a_job_and_the_cohort_comes_last(tmp_path):
    program = tmp_path / "bin" / "scan2kd"
    program.parent.mkdir()
    program.write_text(SCAN2KD)
    program.chmod(0o755)
    (tmp_path / "ears").mkdir()
    for name in ("left", "broken"):
        (tmp_path / "ears" / f"{name}.toml").touch()
    words = ["--snakefile", str(ROOT / "docs/cluster/Snakefile"), "--cores", "1", "--quiet", "all"]
    environment = os.environ | {"PATH": f"{program.parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", *words, "--config", "studies=ears/*.toml", "out=out"],
        cwd=tmp_path,
        env=environment | {"HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    calls = (tmp_path / "calls").read_text().splitlines()
    assert sorted(calls[:2]) == ["ears/broken.toml --out out/broken", "ears/left.toml --out out/left"]
    assert calls[2:] == ["ears/broken.toml ears/left.toml --out out"]
