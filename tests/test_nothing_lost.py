"""Whatever inputs, outputs, links and foreign files are combined: no command loses what it did not make."""

from __future__ import annotations

import os
import random
import shutil
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import legacy.stapeskit as api
from legacy.ct_inertia.cli import work as ct2mass
from legacy.ct_inertia.options import MassOptions
from legacy.fitting.cli import work as dof2kd
from legacy.fitting.options import KDFiles, KDOptions
from legacy.kinematics.cli import work as points2dof
from legacy.kinematics.options import LdvOptions, PointsFiles
from legacy.pipeline.cli import work as scan2kd
from legacy.pipeline.runners.child_process import run_child
from legacy.pipeline.runners.study_process import End
from legacy.pipeline.sample_study import FILES as SAMPLE
from legacy.pipeline.scan2kd import output_set
from legacy.pipeline.stapeskit_command import work as stapeskit
from legacy.pipeline.study import TABLES, read_study
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.option_values import toml
from legacy.stapeskit.options import declared
from legacy.stapeskit.own_files import RECORDS, OutputSet
from legacy.stapeskit.page import page
from legacy.stapeskit.records.motion_files import write_motion
from tests.fitting.cases import M, paper_motion
from tests.pipeline.conftest import undraw
from tests.pipeline.ears import make_ear


@dataclass(frozen=True)
class Case:
    """A command, the words that it needs, what it may write, and how often it is tried.

    ``place`` is the option that names the folder; ``partly``: a refusal may leave a part of the results.
    """

    work: object
    given: tuple[str, ...]
    names: tuple[str, ...]
    seeds: int
    more: tuple[str, ...] = ()
    file: str = ""
    place: str = "--out"
    partly: bool = False


MORE = "more"
COHORT = ("cohort.csv", "cohort.html", "cohort.json", "cohort.log", "study/kd.json", "second/mass.json")
STUDY = "sub-earone/sub-earone_hemi-L_study.toml"
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
        more=("--calibrate",),
        file="dof.csv",
    ),
    "dof2kd": Case(
        dof2kd,
        ("motion.csv", "--mass", "M.csv", "--bands", "0", "--estimator", "pinv"),
        ("kd.json", "kd.html", "kd.mat", "kd.entries.csv", "kd.xml"),
        6,
        more=("--export", "all"),
        file="kd.json",
    ),
    "plan": Case(dof2kd, ("--plan", "plan.toml"), ("plan.json", "plan.html"), 6, file="plan.json"),
    "sample": Case(stapeskit, ("sample",), SAMPLE, 6, place=""),
    "figures": Case(
        stapeskit, ("figures", "page.html"), ("axes_1.svg", "axes_1.pdf", "table_axes_1.csv"), 8, place=""
    ),
    "cohort": Case(
        scan2kd,
        ("study.toml", "second.toml", "--quiet"),
        (*COHORT, "cohort_laws.csv", "cohort.xlsx"),
        2,
        more=("--export", "csv,xlsx"),
        partly=True,
    ),
    "bids": Case(
        scan2kd,
        ("study.toml", "second.toml", "--quiet"),
        ("participants.tsv", "dataset_description.json", STUDY, "derivatives/stapeskit/cohort.csv"),
        2,
        place="--bids",
        partly=True,
    ),
    "scan2kd": Case(
        scan2kd,
        ("study.toml", "--quiet"),
        ("mass.json", "labels.nrrd", "dof.csv", "kd.json", "report.html"),
        2,
    ),
}


SVG = (
    b'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9">'
    b'<path d="M 1 1 L 8 8" style="stroke: #000000"/></svg>'
)


def in_this_process(tasks, _where, tell, ended):
    """Run the studies of a cohort one after the other, without processes."""
    for task in tasks:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("sys.argv", ["scan2kd", task.study.name])
            end = run_child([str(task.study), str(task.folder), *(["--force"] if task.force else [])])
        tell(task.name, "over")
        ended(task.name, End(**end))


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Small inputs of every command."""
    folder = tmp_path_factory.mktemp("inputs")
    make_ear(folder)
    motion = paper_motion(0.05, 0)
    ones = np.ones_like(motion.chi2)
    write_motion(folder, "motion", replace(motion, chi2=42.0 * ones, n_dof=42.0 * ones))
    np.savetxt(folder / "M.csv", M, delimiter=",")
    text = (folder / "study.toml").read_text(encoding="utf-8")
    second = text.replace("ear one", "ear two")
    assert second != text
    more = folder / MORE
    more.mkdir()
    (more / "second.toml").write_text(second, encoding="utf-8")
    (more / "plan.toml").write_text("lines = 20\n", encoding="utf-8")
    sheet = page.Page("an ear")
    picture = page.image(SVG, "caption", "a line", "svg")
    sheet.section("axes", picture, page.table(("a", "b"), [("1", "2"), ("3", "4")]))
    sheet.write(more / "page.html")
    return folder


def laid_out(inputs: Path, folder: Path, words: tuple[str, ...]) -> None:
    """Copy the inputs, of further ones those that the words name."""
    shutil.copytree(inputs, folder, dirs_exist_ok=True)
    for path in (folder / MORE).iterdir():
        if path.name in words:
            shutil.move(path, folder / path.name)
    shutil.rmtree(folder / MORE)


@pytest.fixture(autouse=True)
def undrawn(monkeypatch):
    """Leave the drawing away; what is written stays as it is otherwise."""
    undraw(monkeypatch)
    monkeypatch.setattr("legacy.pipeline.several_studies.runner_of", lambda _address: in_this_process)


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
    target.parent.mkdir(parents=True, exist_ok=True)
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
    option = [case.place] if case.place else []
    return [*words, *option, f"{place}/{case.file}" if case.file else place], read


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
    assert not refused or case.partly or after == before, (words, refused)
    assert [path.read_bytes() for path in read] == given, words
    for path in [path for path in {*before, *after} if after.get(path) != before.get(path)]:
        own = path not in before or made.get(path) == before[path]
        replaced = force and path in after and any(path.match(name) for name in case.names)
        assert own or replaced, (words, path)
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
        laid_out(inputs, folder, case.given)
        monkeypatch.chdir(folder)
        out = folder if case.work is not scan2kd and rng.random() < 0.2 else folder / "out"
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


class Looked(Exception):
    """The check of the outputs was reached."""


FILES = {
    "ct2mass": (ct2mass, ("scan.tif", "--density", "1900"), (MassOptions,)),
    "points2dof": (points2dof, ("ldv.csv",), (LdvOptions, PointsFiles)),
    "dof2kd": (dof2kd, ("motion.csv", "--mass", "M.csv"), (KDFiles, KDOptions)),
}
NEEDED = {"plate_points": ("--mass", "M.csv"), "bone_points": ("--mass", "M.csv")}
NEEDED |= dict.fromkeys(("steps",), ("--channels", "points.csv"))
ALONE = {"plan": ()}  # takes the place of the other words


@pytest.mark.parametrize(
    ("command", "entry"),
    [
        pytest.param(name, entry, id=f"{name} {entry.flag}")
        for name, (_, _, tables) in FILES.items()
        for entry in (entry for table in tables for entry in declared(table))
        if entry.kind.is_file
    ]
    + [pytest.param(name, None, id=f"{name} --config") for name in FILES],
)
def test_every_file_of_an_option_counts_as_read(command, entry, inputs, tmp_path, monkeypatch):
    laid_out(inputs, tmp_path, ())
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scan.tif").write_bytes(b"no scan: it is not read")
    work, words, _ = FILES[command]
    given = tmp_path / "given.toml"
    given.write_text("")
    name = "config" if entry is None else entry.name
    if entry is not None and entry.positional:
        given = tmp_path / words[0]
    elif name in ALONE:
        given.write_text("lines = 20\n")
        words = ("--plan", given.name)
    elif f"--{name}" in words:
        given = tmp_path / words[words.index(f"--{name}") + 1]
    else:
        words = (*words, *NEEDED.get(name, ()), f"--{name.replace('_', '-')}", given.name)
    seen = []

    def look(outputs):
        seen.append({Path(path).resolve() for path in outputs.inputs})
        raise Looked

    monkeypatch.setattr(OutputSet, "check", look)
    with pytest.raises(Looked):
        work(list(words))
    assert given.resolve() in seen[0]


@pytest.mark.parametrize(
    ("table", "key"),
    [(name, entry.key) for name, kind in TABLES.items() for entry in declared(kind) if entry.kind.is_file],
)
def test_every_file_of_a_study_counts_as_read(table, key, inputs, tmp_path):
    laid_out(inputs, tmp_path, ())
    study = tmp_path / "study.toml"
    tables = tomllib.loads(study.read_text(encoding="utf-8"))
    if key not in tables[table]:
        (tmp_path / "given.toml").write_text("")
        tables[table][key] = "given.toml"
    if table == "scan":
        (tmp_path / "scan.tif").write_bytes(b"no scan: it is not read")
        tables["scan"]["file"] = "scan.tif"
    if key in ("plate_points", "steps"):
        tables["ldv"].pop("fiducials")
        tables["ldv"] |= {"channels": "points.csv"} if key == "steps" else {}
    given = {tmp_path / str(name) for name in np.ravel(tables[table][key])}
    lines = [
        line
        for name, values in tables.items()
        for line in (f"[{name}]", *(f"{word} = {toml(value)}" for word, value in values.items()))
    ]
    study.write_text("\n".join(lines) + "\n", encoding="utf-8")
    outputs = output_set(study, read_study(study), tmp_path / "out")
    assert given | {study} <= set(outputs.inputs)


def test_results_know_their_inputs_wherever_the_process_goes(inputs, tmp_path, monkeypatch):
    laid_out(inputs, tmp_path, ())
    monkeypatch.chdir(tmp_path)
    shutil.copy("ldv.csv", "dof.csv")
    shutil.copy("M.csv", "kd.json")
    results = (
        api.ct2mass("stapes.ply", density=1900),
        api.points2dof("dof.csv", points="points.csv"),
        api.dof2kd("motion.csv", mass="M.csv", estimator="pinv", bands=0),
    )
    (tmp_path / "elsewhere").mkdir()
    before = contents(tmp_path)
    monkeypatch.chdir("elsewhere")
    for result in results[:2]:
        with pytest.raises(StapeskitError, match="another file than the inputs"):
            result.write("..", force=True)
    for name in ("../kd.json", str(tmp_path / "kd.json"), "motion.csv", ""):
        with pytest.raises(StapeskitError):
            results[2].write("new", force=True, name=name)
    assert {path: text for path, text in contents(tmp_path).items() if path in before} == before


def test_a_study_is_not_written_over_what_it_was_made_from(inputs, tmp_path, monkeypatch):
    laid_out(inputs, tmp_path, ())
    monkeypatch.chdir(tmp_path)
    result = api.scan2kd("study.toml")
    before = contents(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    with pytest.raises(StapeskitError, match="another file than the inputs"):
        result.write("..", force=True)
    assert contents(tmp_path) == before
