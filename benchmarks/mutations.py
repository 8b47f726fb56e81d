"""A number that is changed in a kernel is noticed by the tests of its room.

Each row changes one number or sign in a copy of the packages and runs the tests of the folder that is
responsible, until the first failure.

    python -m benchmarks.mutations
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks._table import print_table

ROOT = Path(__file__).resolve().parents[1]

MUTATIONS: tuple[tuple[str, str, str, str], ...] = (
    # (file, text, what takes its place, tests)
    ("stapeskit/spatial.py", "-r @ cross_matrix(shift_m)", "r @ cross_matrix(shift_m)", "ground"),
    ("stapeskit/spatial.py", "- mass * arm @ arm.T", "- 0.99 * mass * arm @ arm.T", "ground"),
    ("stapeskit/frames.py", "0.5 * half * half", "0.51 * half * half", "ground"),
    ("stapeskit/registration.py", "weights * 1e6, rows", "weights * 1.2e6, rows", "ground"),
    ("ct_inertia/body_moments.py", "-moment_xy - volume", "-moment_xy + volume", "bodies"),
    ("ct_inertia/body_moments.py", "[1, x, y, z, y * y", "[1, x, y, z, 1.1 * y * y", "bodies"),
    ("ct_inertia/grey/moments.py", "axes.T / 12.0", "axes.T / 10.0", "bodies"),
    ("ct_inertia/grey/moments.py", "2.0 * moments.volume_mm3", "3.0 * moments.volume_mm3", "bodies"),
    ("ct_inertia/surface/surface.py", "second / 120.0", "second / 118.0", "mass"),
    ("ct_inertia/frames/footplate_face.py", "FACE_ANGLE_DEG = 60.0", "FACE_ANGLE_DEG = 57.0", "mass"),
    ("ct_inertia/frames/gap.py", "(2.0 * level_sd_mm)", "(3.0 * level_sd_mm)", "mass"),
    ("kinematics/joint/tangents.py", "1.0 + sums[GAIN] +", "1.02 + sums[GAIN] +", "motion"),
    ("kinematics/joint/tangents.py", "np.exp(-1j * sums[DELAY]", "np.exp(1j * sums[DELAY]", "motion"),
    ("kinematics/signals/frf.py", "1.0 / (2.0 * max(averages", "1.0 / (2.4 * max(averages", "motion_files"),
    ("kinematics/fit/noise.py", "/ (2.0 * np.log(2.0)) if", "/ (2.4 * np.log(2.0)) if", "motion"),
    ("fitting/uncertainty.py", "imag, eigen.imag) / (2.0", "imag, eigen.imag) / (2.2", "fit"),
    ("fitting/textbook.py", "own = 0.5 * np.einsum", "own = 0.6 * np.einsum", "fit"),
    ("fitting/likelihood.py", "added += 2.0 * (spread", "added += 1.6 * (spread", "fit"),
    ("fitting/laws.py", "1j * w / (1.0 + 1j * w * a)", "1j * w / (1.0 - 1j * w * a)", "fit"),
    ("pipeline/cohort/law.py", "max(2.0 * (value - self", "max(1.0 * (value - self", "cohort"),
)


def noticed(copy: Path, file: str, text: str, other: str, tests: str) -> str:
    """Return the name of the first test that fails with the change, or "" when all pass.

    Raises
    ------
    ValueError
        The file does not hold the text exactly once.
    """
    source = (ROOT / file).read_text(encoding="utf-8")
    if source.count(text) != 1:
        raise ValueError(f"{file} must hold {text!r} once; got {source.count(text)}. Correct the list.")
    (copy / file).write_text(source.replace(text, other), encoding="utf-8")
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", f"tests/{tests}"]
    path = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    printed = subprocess.run(words, cwd=copy, env=path, capture_output=True, text=True, check=False).stdout
    (copy / file).write_text(source, encoding="utf-8")
    failed = [line for line in printed.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return failed[0].split("::", 1)[-1].split(" - ")[0] if failed else ""


if __name__ == "__main__":
    ignored = shutil.ignore_patterns(".git", ".venv", "demo", "site", "__pycache__", ".*_cache")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "copy"
        shutil.copytree(ROOT, target, ignore=ignored, symlinks=True)
        found = [(change, noticed(target, *change)) for change in MUTATIONS]
    folders = dict.fromkeys(tests for *_, tests in MUTATIONS)
    by_folder = {name: [bool(test) for (*_, tests), test in found if tests == name] for name in folders}
    print_table(
        ("tests", "changes", "noticed"),
        ([f"`tests/{name}`", len(own), sum(own)] for name, own in by_folder.items()),
    )
    missed = [f"`{text}` -> `{other}` in `{file}`" for (file, text, other, _), test in found if not test]
    print(f"{sum(map(sum, by_folder.values()))} of {len(found)}. Not noticed: {'; '.join(missed) or 'none'}.")
