"""Commands and Python blocks of README and docs run as they are printed, on the files of the sample."""

import json
import re
import shlex
import shutil
import tomllib
from pathlib import Path

import jsonschema
import pytest

import stapeskit
from ct_inertia.scan.formats import FORMATS as SCANS
from fitting.plan import Plan
from kinematics.readers.formats import FORMATS as RECORDINGS
from pipeline.options_page import options_page
from pipeline.sample import copy_sample
from pipeline.stapeskit_command import work
from stapeskit import warnings
from tools.evidence import BLOCK, filled

ROOT = Path(__file__).resolve().parents[2]
PAGES = {path.stem: path for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))}
COMMANDS = ("ct2mass", "points2dof", "dof2kd", "scan2kd")


def blocks(page, language):
    return re.findall(rf"```{language}\n(.*?)```", PAGES[page].read_text(encoding="utf-8"), re.DOTALL)


def lines(page):
    """The command lines of a page that a user runs in the folder of an ear."""
    printed = [line.split("#")[0].strip() for block in blocks(page, "sh") for line in block.splitlines()]
    return [line.replace("ear/", "") for line in printed if line.startswith(COMMANDS)]


def run(line):
    """Run a command line in the current folder, by the door that all commands share."""
    words = shlex.split(line)
    if ">" in words:
        words = words[: words.index(">")]
    return work(words)


@pytest.fixture(scope="module")
def ear(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lab") / "ear"
    copy_sample(folder)
    (folder / "plan.toml").write_text(blocks("plan_a_measurement", "toml")[0], encoding="utf-8")
    return folder


@pytest.fixture
def here(ear, monkeypatch):
    monkeypatch.chdir(ear)
    return ear


@pytest.fixture(scope="module")
def weighed(ear):
    """The ear with scan_mass as the page of the first ear makes it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ear)
        run(lines("first_ear")[0])
    return ear


def test_the_first_screen_has_the_two_set_up_commands():
    assert [line.split("#")[0].strip() for line in blocks("README", "sh")[0].splitlines()] == [
        "make demo",
        "make test",
    ]


def test_commands_of_readme_and_first_ear_run(weighed, here):
    truth = json.loads((here / "truth.json").read_text(encoding="utf-8"))
    wanted = dict.fromkeys([*lines("README"), *lines("first_ear")])
    assert {shlex.split(line)[0] for line in wanted} == set(COMMANDS)
    for line in wanted:
        if line not in (lines("first_ear")[0], "scan2kd study.toml"):  # the same with --out is run
            run(line)
    kd = json.loads((here / "kd.json").read_text(encoding="utf-8"))
    off = kd["stiffness_si"][0][0] - truth["stiffness_si"][0][0]
    assert abs(off) < 3.0 * kd["stiffness_sd_si"][0][0]
    for name, file in (("mass", "scan_mass/mass.json"), ("kd", "kd.json"), ("kd", "results/kd.json")):
        schema = json.loads((ROOT / f"docs/schemas/{name}.schema.json").read_text(encoding="utf-8"))
        jsonschema.validate(json.loads((here / file).read_text(encoding="utf-8")), schema)


def test_python_of_the_notebook_page_runs(here, capsys):
    names = {}
    first, *others = blocks("notebook", "python")
    readme = blocks("README", "python")[0]
    assert set(readme.splitlines()[:-1]) <= set(first.splitlines())
    for source in (first, readme.splitlines()[-1], *others):
        exec(compile(source, "notebook.md", "exec"), names)
    assert len(capsys.readouterr().out.splitlines()) < 40
    assert names["motion"].motion.q.shape == (1, 2, 200, 6)
    assert names["wrong"] == []
    assert (here / "results_kd" / "kd.mat").is_file()


def test_exports_of_the_sample_are_read_as_the_page_says(weighed, here):
    assert lines("first_ear")[0] + " --out mass" in lines("export_from_psv")
    shutil.copytree(here / "scan_mass", here / "mass")
    first, *others = (line for line in lines("export_from_psv") if line.startswith("points2dof"))
    run(first.replace("--out ", "--force --out "))
    for line in others:
        assert stapeskit.read_vibrometer(shlex.split(line)[1]).velocity.shape == (57, 200)


def test_labels_are_corrected_by_the_script_of_the_page(weighed, tmp_path, monkeypatch):
    shutil.copytree(weighed / "scan_mass", tmp_path / "scan_mass")
    (tmp_path / "scan.tif").symlink_to(weighed / "scan.tif")
    monkeypatch.chdir(tmp_path)
    exec(compile(blocks("correct_the_cut", "python")[0], "correct_the_cut.md", "exec"), {})
    edited = (tmp_path / "scan_mass" / "labels.seg.nrrd").read_bytes()
    run(lines("correct_the_cut")[-1] + " --no-report")
    assert (tmp_path / "scan_mass" / "labels.seg.nrrd").read_bytes() == edited
    mass = json.loads((tmp_path / "scan_mass" / "mass.json").read_text(encoding="utf-8"))
    assert mass["labels_file"] == "labels.measured.seg.nrrd"


def test_the_plan_of_the_page_runs(here):
    assert run(*lines("plan_a_measurement")).rows
    assert set(tomllib.loads(blocks("plan_a_measurement", "toml")[0])) <= set(Plan.key_names())
    schema = json.loads((ROOT / "docs/schemas/plan.schema.json").read_text(encoding="utf-8"))
    jsonschema.validate(json.loads((here / "plan.json").read_text(encoding="utf-8")), schema)


def test_a_vibrometer_file_that_python_writes_is_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(blocks("vibrometer_files", "python")[0], "vibrometer_files.md", "exec"), {})
    assert stapeskit.read_vibrometer("ldv.h5").velocity.shape == (3, 200)


@pytest.mark.parametrize("page", PAGES)
def test_every_file_and_heading_that_a_page_names_exists(page):
    def anchors(path):
        headings = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
        return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}

    path, text = PAGES[page], PAGES[page].read_text(encoding="utf-8")
    for target, anchor in re.findall(r"\]\(([^)#:]*)(?:#([^)]+))?\)", text):
        file = path.parent / target if target else path
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), anchor
    for module in re.findall(r"python -m ([a-z][\w.]+)", text):
        assert (ROOT / (module.replace(".", "/") + ".py")).is_file(), module
    for file in re.findall(r"\b((?:docs/examples|tests|benchmarks)/[\w/]+(?:\.py)?)", text):
        assert (ROOT / file).exists(), file
    for source in blocks(page, "python"):
        compile(source, path.name, "exec")
    for source in blocks(page, "toml"):
        tomllib.loads(source)


def test_every_format_is_on_its_page():
    scans = PAGES["formats"].read_text(encoding="utf-8")
    for entry in SCANS:
        assert (
            f"| {entry.title} | {', '.join(f'`{end}`' for end in entry.suffixes)} | {entry.reads} |" in scans
        )
    recordings = PAGES["vibrometer_files"].read_text(encoding="utf-8")
    for entry in RECORDINGS:
        assert f"| {entry.words} | {entry.reads} |" in recordings


def test_pages_that_are_made_from_the_sources_are_those_of_now():  # make docs writes them
    evidence = PAGES["evidence"].read_text(encoding="utf-8")
    assert PAGES["warnings"].read_text(encoding="utf-8") == warnings.page()
    assert PAGES["options"].read_text(encoding="utf-8") == options_page()
    assert BLOCK.sub(filled, evidence) == evidence


def test_the_website_has_every_page():
    listed = re.findall(r": (\w+)\.md$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted([*listed, "README"]) == sorted(PAGES)
