"""A number or sign that is changed in a kernel is noticed by the tests.

Each row changes one in a copy of the packages and runs the file of tests that is responsible, until the first
failure; where all pass, the other files of its folder.

    python -m benchmarks.mutations
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks._table import NOTHING, print_table

ROOT = Path(__file__).resolve().parents[1]

MUTATIONS: dict[str, tuple[tuple[str, str, str], ...]] = {
    # file of tests, or one of its tests: (file, text, what takes its place), ...
    "ground/test_records_mass.py": (
        ("stapeskit/spatial.py", "-r @ cross_matrix(shift_m)", "r @ cross_matrix(shift_m)"),
        ("stapeskit/spatial.py", "- mass * arm @ arm.T", "- 0.99 * mass * arm @ arm.T"),
    ),
    "ground/test_registration_fit.py": (
        ("stapeskit/frames.py", "0.5 * half * half", "0.51 * half * half"),
        ("stapeskit/registration.py", "weights * 1e6, rows", "weights * 1.2e6, rows"),
    ),
    "bodies/test_partial_volume_moments.py": (
        ("ct_inertia/body_moments.py", "-moment_xy - volume", "-moment_xy + volume"),
        ("ct_inertia/body_moments.py", "[1, x, y, z, y * y", "[1, x, y, z, 1.1 * y * y"),
        ("ct_inertia/grey/moments.py", "axes.T / 12.0", "axes.T / 10.0"),
        ("ct_inertia/grey/moments.py", "2.0 * moments.volume_mm3", "3.0 * moments.volume_mm3"),
    ),
    "mass/test_mass_surfaces.py": (("ct_inertia/surface/surface.py", "second / 120.0", "second / 118.0"),),
    "mass/test_mass_frames.py": (
        ("ct_inertia/frames/footplate_face.py", "FACE_ANGLE_DEG = 60.0", "FACE_ANGLE_DEG = 57.0"),
    ),
    "mass/test_mass_plate.py": (("ct_inertia/frames/gap.py", "level = sum(", "level = 1.5 * sum("),),
    "motion/test_joint_estimate.py": (
        ("kinematics/joint/tangents.py", "1.0 + sums[GAIN] +", "1.02 + sums[GAIN] +"),
        ("kinematics/joint/tangents.py", "np.exp(-1j * sums[DELAY]", "np.exp(1j * sums[DELAY]"),
    ),
    "motion_files/test_estimates_of_signals.py": (
        ("kinematics/signals/frf.py", "1.0 / (2.0 * max(averages", "1.0 / (2.4 * max(averages"),
    ),
    "motion/test_least_squares.py": (
        ("kinematics/fit/noise.py", "/ (2.0 * np.log(2.0)) if", "/ (2.4 * np.log(2.0)) if"),
    ),
    "fit/test_likelihood.py": (
        ("fitting/likelihood.py", "added += 2.0 * (spread", "added += 1.6 * (spread"),
    ),
    "fit/test_verdict_and_result.py::test_standard_deviations_of_modes_are_those_of_draws_of_k_and_d": (
        ("fitting/uncertainty.py", "imag, eigen.imag) / (2.0", "imag, eigen.imag) / (2.2"),
    ),
    "fit/test_estimators.py": (("fitting/textbook.py", "own = 0.5 * np.einsum", "own = 0.6 * np.einsum"),),
    "fit/test_causes_and_laws.py": (
        ("fitting/laws.py", "1j * w / (1.0 + 1j * w * a)", "1j * w / (1.0 - 1j * w * a)"),
    ),
    "cohort/test_law.py": (("pipeline/cohort/law.py", "max(2.0 * (value - self", "max(1.0 * (value - self"),),
}


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
    first = f"tests/{tests}"
    file_of_tests = first.partition("::")[0]
    rest = (str(Path(first).parent), f"--ignore={file_of_tests}")
    name = failing(copy, first) or failing(copy, *rest)
    (copy / file).write_text(source, encoding="utf-8")
    return name


def failing(copy: Path, *words: str) -> str:
    """Return file and name of the first of some tests that fails, or "" when all pass."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *words]
    path = {**os.environ, "PYTHONPATH": str(copy)}
    printed = subprocess.run(command, cwd=copy, env=path, capture_output=True, text=True, check=False).stdout
    failed = [line for line in printed.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return failed[0].split(" ")[1].removeprefix("tests/") if failed else ""


if __name__ == "__main__":
    ignored = shutil.ignore_patterns(".git", ".venv", "demo", "site", "__pycache__", ".*_cache")
    rows = list[tuple[str, str, str]]()
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "copy"
        shutil.copytree(ROOT, target, ignore=ignored, symlinks=True)
        for tests, file, text, other in ((name, *row) for name, own in MUTATIONS.items() for row in own):
            test = noticed(target, file, text, other, tests).partition("[")[0].replace(".py::", ": ")
            rows.append((f"`{file}`", f"`{text}`", f"`{test}`" if test else NOTHING))
            print(*rows[-1], file=sys.stderr, flush=True)
    print_table(("file", "number or sign", "first test that failed, or file that did not load"), rows)
    print(f"{sum(row[-1] != NOTHING for row in rows)} of {len(rows)} noticed.")
