"""Everything that a user can get wrong is refused by its cause: one row of refusals.toml each.

A row names a command, how its inputs are changed, and what the fault must name. Faults are compared by
their fields, never by the words of a sentence.
"""

from __future__ import annotations

import shutil
import tomllib
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulate import Ear, Experiment, Scan, motion_of, simulate_study
from stapeskit.faults import Fault, Place, StapeskitError
from stapeskit.records.motion_file import write_motion

ROWS = tomllib.loads(Path(__file__).with_name("refusals.toml").read_text(encoding="utf-8"))
COMMANDS = {
    "ct2mass": "ct_inertia.cli",
    "points2dof": "kinematics.cli",
    "dof2kd": "fitting.cli",
    "scan2kd": "pipeline.cli",
    "stapeskit": "pipeline.stapeskit_command",
}


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of small inputs that every command takes: scan, ldv.csv, points.csv, motion.csv, M.csv, ..."""
    folder = tmp_path_factory.mktemp("good")
    experiment = Experiment(lines=12, in_footplate=True, stapes_points=5, bone_points=5, seed=1)
    truth = simulate_study(Ear(), Scan(voxel_um=60.0, samples=3, format="nrrd", seed=1), experiment, folder)
    assert truth.recording is not None
    write_motion(folder, "motion", motion_of(truth.recording))
    np.savetxt(folder / "M.csv", truth.ear.moving_mass_si(), delimiter=",", fmt="%.17g")
    (folder / "plan.toml").write_text("", encoding="utf-8")
    return folder


@pytest.mark.parametrize("name", ROWS)
def test_refused(name: str, good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = ROWS[name]
    folder = tmp_path / "work"
    shutil.copytree(good, folder)
    monkeypatch.chdir(folder)
    for kind, file, *rest in row.get("changes", ()):
        CHANGES[kind](folder / file, *rest)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    command, *words = row["command"].split(" ")
    with pytest.raises(StapeskitError) as raised:
        import_module(COMMANDS[command]).work(words)
    found = [fault for fault in raised.value.faults if agrees(fault, row)]
    assert found, str(raised.value)
    after = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert after == before, "a refused command changes nothing"


def agrees(fault: Fault, row: dict[str, Any]) -> bool:
    """Return whether a fault names what the row says: thing, file and line."""
    whole = " ".join((fault.thing, fault.expected, fault.got, fault.next_step)).lower()
    if not all(word.lower() in whole for word in row.get("names", ())):
        return False
    if "thing" in row and row["thing"].lower() not in fault.thing.lower():
        return False
    where = fault.where
    if "file" in row and row["file"] not in str(where) + fault.got + fault.thing:
        return False
    return "line" not in row or (isinstance(where, Place) and row["line"] in where.numbers)


def cell(path: Path, line: int, column: str, value: str) -> None:
    """Put a value into the cell of a line (from 1, the header) and a named column."""
    lines = path.read_text(encoding="utf-8").splitlines()
    place = lines[0].split(",").index(column)
    cells = lines[line - 1].split(",")
    cells[place] = value
    lines[line - 1] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def column(path: Path, name: str, value: str) -> None:
    """Put a value into every cell of a column."""
    lines = path.read_text(encoding="utf-8").splitlines()
    place = lines[0].split(",").index(name)
    changed = [lines[0]]
    for line in lines[1:]:
        cells = line.split(",")
        cells[place] = value
        changed.append(",".join(cells))
    path.write_text("\n".join(changed) + "\n", encoding="utf-8")


def scale(path: Path, name: str, factor: float) -> None:
    """Multiply every number of a column."""
    lines = path.read_text(encoding="utf-8").splitlines()
    place = lines[0].split(",").index(name)
    rows = [line.split(",") for line in lines[1:]]
    for row in rows:
        row[place] = repr(factor * float(row[place]))
    text = "\n".join([lines[0], *(",".join(row) for row in rows)])
    path.write_text(f"{text}\n", encoding="utf-8")


def drop_column(path: Path, name: str) -> None:
    """Remove a column."""
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    place = rows[0].index(name)
    text = "\n".join(",".join(row[:place] + row[place + 1 :]) for row in rows)
    path.write_text(f"{text}\n", encoding="utf-8")


def replace(path: Path, old: str, new: str) -> None:
    """Replace a text wherever it stands."""
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def repeat_line(path: Path, line: int) -> None:
    """Append a copy of a line."""
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join([*lines, lines[line - 1]]) + "\n", encoding="utf-8")


def keep_lines(path: Path, count: int) -> None:
    """Keep the first lines only."""
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join(lines[:count]) + "\n", encoding="utf-8")


def write(path: Path, text: str) -> None:
    """Write a text."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def cut(path: Path, share: float) -> None:
    """Keep a share of the bytes."""
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])


def volume(path: Path, kind: str) -> None:
    """Write a TIFF that is no scan."""
    import tifffile

    rng = np.random.default_rng(0)
    arrays = {
        "2d": rng.integers(0, 9, (40, 40)).astype(np.uint16),
        "constant": np.full((20, 20, 20), 7, np.uint16),
        "complex": np.ones((12, 12, 12), np.complex64),
        "noise": rng.integers(0, 999, (40, 40, 40)).astype(np.uint16),
        "nan": np.where(rng.random((40, 40, 40)) < 0.5, np.nan, 1.0).astype(np.float32),
    }
    if kind == "rgb":
        tifffile.imwrite(path, rng.integers(0, 9, (20, 30, 30, 3)).astype(np.uint8), photometric="rgb")
        return
    tifffile.imwrite(path, arrays[kind])


def mesh(path: Path, kind: str) -> None:
    """Write a surface that is no closed body."""
    import trimesh

    ball = trimesh.creation.icosphere(2, 1.5)
    if kind == "open":
        ball.update_faces(np.arange(len(ball.faces)) > 40)
    if kind == "empty":
        path.write_text("solid nothing\nendsolid nothing\n", encoding="utf-8")
        return
    ball.export(path)


CHANGES = {
    "cell": cell,
    "column": column,
    "scale": scale,
    "drop_column": drop_column,
    "replace": replace,
    "repeat_line": repeat_line,
    "keep_lines": keep_lines,
    "write": write,
    "cut": cut,
    "volume": volume,
    "mesh": mesh,
    "remove": lambda path: path.unlink(),
    "folder": lambda path: path.mkdir(),
}
