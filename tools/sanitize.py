"""Run the tests of the kernels under gcc's sanitizers: python tools/sanitize.py, or make sanitize.

The sources are copied and compiled for each instruction set that this processor has (the libraries that users
get choose one at load), with the address and undefined behaviour sanitizers, and once with the thread
sanitizer.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("stapeskit", "kinematics", "ct_inertia", "fitting", "pipeline", "sample_volumes", "tests")
TESTS = (
    "tests/kinematics/fit/test_kernels.py",
    "tests/ct_inertia/volume/test_native.py",
    "tests/fitting/estimators/test_native.py",
)
SETS = {"default": [], "fma": ["-mfma", "-mavx2"], "avx512f": ["-mavx512f", "-mfma"]}
SANITIZERS = {"address,undefined": "libasan.so", "thread": "libtsan.so"}
_CLONES = re.compile(rb"__attribute__\(\(target_clones\([^)]*\)\)\)")


def main() -> int:
    """Return 0 when all tests pass under every sanitizer."""
    parser = argparse.ArgumentParser(prog="sanitize", description=__doc__)
    parser.add_argument("--only", default="", help="runs whose names hold this word: thread, fma ...")
    given = parser.parse_args()
    flags = Path("/proc/cpuinfo").read_text(encoding="utf-8").split()
    here = [name for name in SETS if name == "default" or name in flags]
    runs = [("address,undefined", name) for name in here] + [("thread", "default")]
    failed = []
    for sanitizer, instructions in runs:
        name = f"{sanitizer} {instructions}"
        if given.only in name:
            sys.stdout.write(f"== {name}\n")
            sys.stdout.flush()
            failed += [name] if _run(sanitizer, SETS[instructions]) else []
    sys.stdout.write(f"{len(failed)} of {len(runs)} runs failed {' '.join(failed)}\n")
    return 1 if failed else 0


def _run(sanitizer: str, flags: list[str]) -> int:
    with tempfile.TemporaryDirectory(prefix="sanitize-") as name:
        copy = Path(name)
        for package in PACKAGES:
            shutil.copytree(
                ROOT / package, copy / package, ignore=shutil.ignore_patterns("kernels-*", "*.tif")
            )
        for file in ("hatch_build.py", "pyproject.toml"):
            shutil.copy(ROOT / file, copy / file)
        for source in copy.glob("*/native/*.[ch]"):
            source.write_bytes(_CLONES.sub(b"", source.read_bytes()))
        more = ["-g", "-O1", f"-fsanitize={sanitizer}", "-fno-sanitize-recover=undefined", *flags]
        build = {"CC": " ".join(["gcc", *more])}
        done = subprocess.run(
            [sys.executable, "hatch_build.py"], cwd=copy, env=os.environ | build, check=False
        )
        if done.returncode:
            return done.returncode
        settings = {
            "LD_PRELOAD": _library(SANITIZERS[sanitizer]),
            "ASAN_OPTIONS": "detect_leaks=0",  # those of the interpreter
            "TSAN_OPTIONS": "report_bugs=1:exitcode=66:ignore_noninstrumented_modules=1",
            "PYTHONPATH": str(copy),
            "PYTHONMALLOC": "malloc",
            "OPENBLAS_NUM_THREADS": "1",
        }
        words = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *TESTS]
        return subprocess.run(words, cwd=copy, env=os.environ | settings, check=False).returncode


def _library(name: str) -> str:
    done = subprocess.run(["gcc", f"-print-file-name={name}"], capture_output=True, text=True, check=True)
    return done.stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
