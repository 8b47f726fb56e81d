"""What README and docs say can be typed runs as it is printed, on the files of the sample."""

from __future__ import annotations

import doctest
import importlib
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from legacy.fitting.plan.plan_options import PLAN_EXAMPLE
from legacy.pipeline.sample_study import FILES, copy_sample
from legacy.pipeline.stapeskit_command import COMMANDS
from sample_volumes.old_study import make_study
from sample_volumes.phantom import Ear
from sample_volumes.vibrometer import Vibrometry

ROOT = Path(__file__).resolve().parents[1]
PAGES = {path.stem: path for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
# Pages whose commands run on the sample study; tests/kinematics/test_guide.py runs those on exports.
CHAIN = ("README", "first_ear", "commands")


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGES[page].read_text(encoding="utf-8"), re.DOTALL)


def lines(page: str) -> list[str]:
    """Command lines of a page, as they are inside the folder of the ear."""
    printed = [line.split("#")[0].strip() for block in blocks(page, "sh") for line in block.splitlines()]
    return [line.replace("ear/", "") for line in printed if line]


def run(line: str, folder: Path) -> None:
    """Run a command line by the entry point that pyproject.toml declares."""
    words = shlex.split(line)
    target = None
    if ">" in words:
        target = folder / words[-1]
        words = words[:-2]
    module, function = PROJECT["scripts"][words[0]].split(":")
    done = subprocess.run(
        [sys.executable, "-c", f"from {module} import {function}; {function}()", *words[1:]],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, (line, done.stderr)
    assert "Traceback" not in done.stderr
    if target:
        target.write_text(done.stdout, encoding="utf-8")


def run_here(line: str) -> None:
    """Run a command line in this process and the current folder."""
    name, *words = shlex.split(line)
    importlib.import_module(COMMANDS[name]).work(words)


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A folder as a user has it: scan, vibrometer table, points, fiducials, study."""
    folder = tmp_path_factory.mktemp("lab")
    truth = make_study(folder / "ear", Ear(voxel_mm=(0.05,) * 3), Vibrometry(lines=60), "ear")
    (folder / "ear" / "plan.toml").write_text(blocks("plan_a_measurement", "toml")[0], encoding="utf-8")
    return folder, truth


def test_commands_and_notebook_of_the_pages_run_as_they_are_printed(lab, monkeypatch, undrawn, capsys):
    """The whole chain runs as a process and draws; the three steps, which would draw the same, run here."""
    folder, truth = lab[0] / "ear", lab[1]
    monkeypatch.chdir(folder)
    wanted = dict.fromkeys(line for page in CHAIN for line in lines(page))
    chain = [line for line in wanted if not line.startswith(("pip ", "cd ", "stapeskit sample "))]
    commands = {"ct2mass", "points2dof", "dof2kd", "scan2kd", "stapeskit"}
    assert {shlex.split(line)[0] for line in chain} == commands
    first = next(line for line in chain if line.startswith("ct2mass"))
    given = [line for line in chain if line.startswith(first + " --labels ")]
    assert len(given) == 1
    steps = [line for line in chain if line.startswith(("ct2mass ", "points2dof ", "dof2kd "))]
    for line in chain:
        if line not in steps:
            run(line, folder)
        elif line not in given:
            run_here(line)
    labels = (folder / "scan_mass" / "labels.nrrd").read_bytes()
    run_here(given[0] + " --no-report")
    assert (folder / "scan_mass" / "labels.nrrd").read_bytes() == labels
    mass = json.loads((folder / "scan_mass" / "mass.json").read_text(encoding="utf-8"))
    assert mass["labels_file"] != "labels.nrrd"
    for kd in (folder / "results" / "kd.json", folder / "kd.json"):
        stiffness = json.loads(kd.read_text(encoding="utf-8"))["stiffness_si"][0][0]
        assert stiffness == pytest.approx(truth["stiffness_si"][0][0], rel=0.05)
    assert (folder / "my_study.toml").is_file()
    notebook(lab, monkeypatch, capsys)


def notebook(lab, monkeypatch, capsys):
    """From scan to stiffness in memory, with the numbers of the commands."""
    folder, truth = lab
    monkeypatch.chdir(folder)
    names: dict[str, object] = {}
    (source,) = blocks("README", "python")
    assert len(source.strip().splitlines()) <= 10
    capsys.readouterr()
    exec(compile(source, "README.md", "exec"), names)
    printed = capsys.readouterr().out
    assert len(printed.splitlines()) < 40
    assert len(printed) < 4000
    assert names["mass"].matrix.matrix[0, 0] == pytest.approx(truth["volume_m3"] * 1394.4, rel=5e-3)
    assert (folder / "results_kd" / "kd.html").is_file()
    kd = json.loads((folder / "ear" / "kd.json").read_text(encoding="utf-8"))
    for key in ("stiffness_si", "damping_si", "stiffness_sd_si", "damping_sd_si", "covariance_si"):
        np.testing.assert_allclose(names["fit"].content()[key], kd[key], rtol=1e-12, err_msg=key)
    for name in ("mass", "motion", "fit"):
        assert "<table" in names[name]._repr_html_()
        assert np.all(np.isfinite(np.linalg.eigvalsh(names["mass"].matrix.matrix)))


def test_the_plan_of_the_page_runs(lab):
    run(*lines("plan_a_measurement"), lab[0] / "ear")
    assert (lab[0] / "ear" / "plan.html").is_file()
    shown = blocks("plan_a_measurement", "toml")[0]
    assert set(tomllib.loads(shown)) == set(tomllib.loads(PLAN_EXAMPLE))


def test_the_sample_is_copied_whole(tmp_path):
    files = copy_sample(tmp_path / "ear")
    assert [path.relative_to(tmp_path / "ear").as_posix() for path in files] == list(FILES)
    for name, path in zip(FILES, files, strict=True):
        assert path.read_bytes() == (ROOT / "sample_volumes" / name).read_bytes()
    study = tomllib.loads((tmp_path / "ear" / "study.toml").read_text(encoding="utf-8"))
    first = lines("README")
    assert "stapeskit sample ear" in first
    assert f"+-{study['scan']['density_kg_m3'].split('+-')[1]}" in " ".join(lines("first_ear"))
    included = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]
    packed = included["targets"]["wheel"]["force-include"]
    assert sorted(packed.values()) == sorted(f"pipeline/sample_study/{name}" for name in FILES)


def test_the_front_page_is_short():
    assert len(PAGES["README"].read_text(encoding="utf-8").split()) <= 1200


def test_every_file_that_a_page_names_exists():
    for page in PAGES.values():
        text = page.read_text(encoding="utf-8")
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), (page.name, target)
        for script in re.findall(r"(?:python|tools/) (benchmarks/\w+\.py)", text):
            assert (ROOT / script).is_file(), script
        for module in re.findall(r"python -m ([\w.]+)", text):
            assert (ROOT / (module.replace(".", "/") + ".py")).is_file() or (
                ROOT / module.replace(".", "/") / "__main__.py"
            ).is_file(), module


def test_every_link_into_a_page_has_its_heading():
    def anchors(page: Path) -> set[str]:
        headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
        return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}

    for page in PAGES.values():
        for target, anchor in re.findall(r"\]\(([^)#:]*)#([^)]+)\)", page.read_text(encoding="utf-8")):
            assert anchor in anchors(page.parent / target if target else page), (page.name, anchor)


def test_examples_of_docstrings_print_what_they_say():
    rooms = ("stapeskit", "ct_inertia", "kinematics", "fitting", "pipeline")
    files = [path for room in rooms for path in sorted((ROOT / room).rglob("*.py"))]
    shown = [path for path in files if ">>> " in path.read_text(encoding="utf-8")]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in shown]
    results = [doctest.testmod(importlib.import_module(name)) for name in names]
    assert sum(result.attempted for result in results) >= 10
    assert not any(result.failed for result in results)


def test_the_website_has_every_page():
    listed = re.findall(r": (\w+)\.md$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted([*listed, "README"]) == sorted(PAGES)


def test_version_and_citation_agree():
    from legacy import stapeskit

    version = PROJECT["version"]
    assert stapeskit.__version__ == version
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert json.loads((ROOT / "codemeta.json").read_text(encoding="utf-8"))["version"] == version
