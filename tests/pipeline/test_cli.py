"""The command: quick help, options checked first, exit codes, the template."""

import io
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from legacy.pipeline import cli
from legacy.pipeline.stage_progress import Progress
from legacy.pipeline.template import TEMPLATE
from legacy.stapeskit.faults import StapeskitError

ROOT = Path(__file__).parents[2]
HEAVY = (
    *("numpy", "scipy", "trimesh", "pyvista", "skimage", "matplotlib", "pandas", "tifffile", "SimpleITK"),
    *("h5py", "jinja2", "rich"),
)


def call(*words):
    return subprocess.run(
        [sys.executable, "-m", "legacy.pipeline.cli", *words],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )


def test_help_loads_nothing_heavy():
    code = (
        "import sys; sys.argv = ['scan2kd', '--help']\n"
        "from pipeline.cli import main\n"
        "try: main()\n"
        f"except SystemExit: print('LOADED', [m for m in {HEAVY!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert "LOADED []" in done.stdout
    assert "--template" in done.stdout


def test_template_is_printed_alone():
    done = call("--template")
    assert done.returncode == 0
    assert done.stdout == TEMPLATE
    assert set(tomllib.loads(done.stdout)) == {"study", "scan", "ldv", "fit"}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "scan2kd must be given a study file"),
        (["no.toml"], "STUDY.toml must be an existing TOML file; got no.toml"),
        (["a.toml", "--jobs", "0"], "--jobs must be a whole number, 1 or more; got 0"),
        (["a.toml", "a.toml"], "all different"),
        (["a.toml", "--ot", "x"], "Did you mean --out?"),
        (["a.toml", "--out", "README.md"], "--out must be a folder; got README.md"),
    ],
)
def test_faults_end_with_one_sentence(words, said, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in ("README.md", "a.toml"):
        (tmp_path / name).write_text("")
    with pytest.raises(StapeskitError) as caught:
        cli.work(words)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_fault_exits_with_2_and_no_traceback():
    done = call("no.toml")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


def test_one_study_tells_its_results(ear, capsys):
    study, out = ear
    given, outcome = cli.work([str(study), "--out", str(out), "--quiet"])
    assert given.quiet
    rows = dict(outcome.rows)
    assert rows["K(y)"].endswith("N/m")
    assert len(outcome.rows) <= 15
    result = json.loads(json.dumps(outcome.result))
    assert result["stages"][0]["reused"]
    assert result["stiffness_si"] == json.loads((out / "kd.json").read_text(encoding="utf-8"))["stiffness_si"]
    assert all(Path(name).is_file() for name in result["files"])
    assert capsys.readouterr().err == ""


def test_default_output_folder_is_named_after_the_study_file(ear, monkeypatch, tmp_path):
    study, out = ear
    monkeypatch.chdir(tmp_path)
    out.rename(tmp_path / "study_out")
    _, outcome = cli.work([str(study), "--quiet"])
    assert [stage["reused"] for stage in outcome.result["stages"]] == [True] * 4
    assert Path("study_out/report.html") in outcome.files


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self):
        return True


def test_progress_on_a_terminal_ends_in_the_same_line():
    stream = Terminal()
    with Progress(stream=stream).step("scan") as step:
        step.note = "unchanged, reused"
    last = stream.getvalue().splitlines()[-1]
    assert "scan" in last
    assert last.endswith("unchanged, reused")


def test_a_failed_step_writes_no_line():
    stream = io.StringIO()
    with pytest.raises(ValueError, match="stopped"), Progress(stream=stream).step("scan"):
        raise ValueError("stopped")
    assert stream.getvalue() == ""
