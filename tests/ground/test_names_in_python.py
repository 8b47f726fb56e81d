"""A user's file with the name of a room neither hides the room nor fails without its path."""

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def run(folder: Path, text: str) -> subprocess.CompletedProcess[str]:
    """Run a text as a notebook does: the user's folder comes first in the search path."""
    words = [sys.executable, "-c", f"import sys; sys.path[1:1] = [{str(ROOT)!r}]\n{text}"]
    return subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)


def test_users_files_do_not_hide_a_room(tmp_path: Path) -> None:
    for room in ("fitting", "pipeline", "kinematics", "ct_inertia", "simulate"):
        (tmp_path / f"{room}.py").write_text("mine = 1\n")
    text = "import stapeskit as sk; sk.dof2kd, sk.scan2kd, sk.points2dof, sk.ct2mass; import simulate.ear"
    assert run(tmp_path, text).returncode == 0


def test_a_users_module_that_was_imported_before_is_named(tmp_path: Path) -> None:
    (tmp_path / "fitting.py").write_text("mine = 1\n")
    result = run(tmp_path, "import fitting, stapeskit as sk; sk.dof2kd")
    assert result.returncode != 0
    assert str(tmp_path / "fitting.py") in result.stderr.splitlines()[-1]


def test_every_package_tells_type_checkers_that_it_is_typed() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    for package in project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]:
        assert (ROOT / package / "py.typed").is_file(), package
