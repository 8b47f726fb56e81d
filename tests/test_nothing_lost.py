"""Whatever inputs, outputs, links and foreign files are combined: no command loses what it did not make."""

from __future__ import annotations

import os
import random
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from ct_inertia.cli import work as ct2mass
from fitting.cli import work as dof2kd
from kinematics.cli import work as points2dof
from pipeline.cli import work as scan2kd
from stapeskit.faults import StapeskitError
from stapeskit.own_files import RECORDS
from stapeskit.records.motion_files import write_motion
from tests.conftest import leave_drawing
from tests.fitting.cases import M, paper_motion
from tests.pipeline.conftest import settle
from tests.pipeline.ears import make_ear

pytestmark = pytest.mark.usefixtures("undrawn")


@dataclass(frozen=True)
class Case:
    """A command, the words that it needs, what it may write, and how often it is tried."""

    work: object
    given: tuple[str, ...]
    names: tuple[str, ...]
    seeds: int
    more: tuple[str, ...] = ()
    file: str = ""


CASES = {
    "ct2mass": Case(
        ct2mass,
        ("stapes.ply", "--density", "1900", "--no-report"),
        ("mass.json", "stapes.ply", "plate.ply", "labels.nrrd", "labels.measured.nrrd", "stapes.stl"),
        16,
        more=("--export", "stl"),
    ),
    "points2dof": Case(
        points2dof,
        ("ldv.csv", "--points", "points.csv"),
        ("dof.csv", "dof.h5", "dof.channels.csv", "dof.html"),
        16,
        file="dof.csv",
    ),
    "dof2kd": Case(
        dof2kd,
        ("motion.csv", "--mass", "M.csv", "--bands", "0", "--estimator", "pinv"),
        ("kd.json", "kd.html"),
        6,
        file="kd.json",
    ),
    "scan2kd": Case(
        scan2kd,
        ("study.toml", "--quiet"),
        ("mass.json", "labels.nrrd", "dof.csv", "kd.json", "report.html"),
        2,
    ),
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Small inputs of every command."""
    folder = tmp_path_factory.mktemp("inputs")
    make_ear(folder)
    motion = paper_motion(0.05, 0)
    ones = np.ones_like(motion.chi2)
    write_motion(folder, "motion", replace(motion, chi2=42.0 * ones, n_dof=42.0 * ones))
    np.savetxt(folder / "M.csv", M, delimiter=",")
    return folder


@pytest.fixture(autouse=True)
def undrawn(monkeypatch):
    """Leave the drawing away; what is written stays as it is otherwise."""
    settle(monkeypatch)
    leave_drawing(monkeypatch)
    monkeypatch.setattr("kinematics.report.sections.write_report", lambda path, *_: path.write_text("page"))


def contents(folder: Path) -> dict[Path, bytes]:
    """Every file, and every link by what it points to; the records are the program's own."""
    found = {}
    for top, _, names in os.walk(folder):
        for path in (Path(top, name) for name in names):
            if RECORDS not in path.parts:
                found[path] = os.readlink(path).encode() if path.is_symlink() else path.read_bytes()
    return found


def disturb(rng: random.Random, case: Case, out: Path) -> None:
    """Do what a user may do in an output folder."""
    out.mkdir(exist_ok=True)
    target = out / rng.choice(case.names)
    inputs = [path for path in out.parent.iterdir() if path.is_file()]
    kind = rng.choice(["nothing", "nothing", "foreign", "edit", "symlink", "hard link", "remove", "empty"])
    if kind in ("symlink", "hard link") and not os.path.lexists(target) and inputs:
        source = rng.choice(inputs)
        (target.symlink_to if kind == "symlink" else target.hardlink_to)(source)
    elif kind == "foreign" or (kind == "edit" and not target.exists()):
        target.unlink(missing_ok=True)
        target.write_text(f"the user's own {rng.random()}")
    elif kind == "edit":
        copy = target.read_bytes() + b"\n"
        target.unlink()
        target.write_bytes(copy)
    elif kind == "remove":
        target.unlink(missing_ok=True)
    elif kind == "empty":
        target.unlink(missing_ok=True)
        target.touch()


def disguised(rng: random.Random, word: str, folder: Path, out: Path, case: Case) -> str:
    """Name an input otherwise: absolutely, by a link, or as a copy that has the name of an output."""
    source = folder / word
    kind = rng.choice(["as it is", "as it is", "absolute", "symlink", "hard link", "copy", "output"])
    like = [name for name in case.names if name.endswith(source.suffix)]
    if kind == "absolute":
        return str(source)
    if kind in ("symlink", "hard link"):
        other = folder / f"other_{rng.randrange(10**6)}_{word}"
        (other.symlink_to if kind == "symlink" else other.hardlink_to)(source)
        if source.with_suffix(".h5").exists():
            shutil.copy(source.with_suffix(".h5"), other.with_suffix(".h5"))
        return other.name
    if kind in ("copy", "output") and like:
        other = out / rng.choice(like)
        if not os.path.lexists(other):
            shutil.copy(source, other)
        if kind == "copy" and other.read_bytes() != source.read_bytes():
            return word
        return os.path.relpath(other, folder)
    return word


def words_of(rng: random.Random, case: Case, folder: Path, out: Path) -> tuple[list[str], list[Path]]:
    """Return a command line and the files that it reads."""
    fixed = [word for word in case.given if not (folder / word).is_file()]
    words, read = [], []
    for word in case.given:
        named = word if word in fixed or word.endswith(".toml") else disguised(rng, word, folder, out, case)
        words.append(named)
        read += [] if word in fixed else [folder / named]
    words += case.more if rng.random() < 0.5 else ()
    place = rng.choice([out.name, f"./{out.name}", str(out)]) if out != folder else "."
    return [*words, "--out", f"{place}/{case.file}" if case.file else place], read


def tried(case: Case, words: list[str], read: list[Path], made: dict[Path, bytes], force: bool) -> str:
    """Run a command and look what became of all files; return its refusal, or nothing."""
    folder = Path.cwd()
    before, given = contents(folder), [path.read_bytes() for path in read]
    refused = ""
    try:
        case.work([*words, "--force"] if force else words)
    except StapeskitError as fault:
        refused = str(fault)
    after = contents(folder)
    assert not refused or after == before, (words, refused)
    assert [path.read_bytes() for path in read] == given, words
    for path in [path for path in {*before, *after} if after.get(path) != before.get(path)]:
        own = path not in before or made.get(path) == before[path]
        assert own or (force and path.name in case.names and path in after), (words, path)
    made.update({path: text for path, text in after.items() if before.get(path) != text})
    assert not list(folder.rglob(".stapeskit-*"))
    return refused


@pytest.mark.parametrize("name", CASES)
def test_no_command_loses_what_it_did_not_make(name, inputs, tmp_path, monkeypatch):
    case = CASES[name]
    ends = {"done": 0, "refused": 0}
    for seed in range(case.seeds):
        rng = random.Random(f"{name} {seed}")
        folder = tmp_path / str(seed)
        shutil.copytree(inputs, folder)
        monkeypatch.chdir(folder)
        out = folder if name != "scan2kd" and rng.random() < 0.2 else folder / "out"
        if out != folder and rng.random() < 0.2:
            (folder / "real").mkdir()
            out.symlink_to("real")
        made: dict[Path, bytes] = {}
        for _ in range(3):
            disturb(rng, case, out)
            words, read = words_of(rng, case, folder, out)
            force = rng.random() < 0.25
            refused = tried(case, words, read, made, force)
            ends["refused" if refused else "done"] += 1
            if not force and not refused and rng.random() < 0.3:
                # a plain rerun of one's own command needs no --force
                assert not tried(case, words, read, made, False), (seed, words)
    assert min(ends.values()) >= case.seeds // 2, ends
