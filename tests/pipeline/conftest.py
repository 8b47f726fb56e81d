"""One ear, run once for all tests of this room."""

import shutil

import pytest

from legacy.pipeline.scan2kd import run_study
from tests.conftest import leave_drawing
from tests.pipeline.ears import make_ear


def settle(patch):
    """Draw by matplotlib, the same on every machine, and take the code as one that nobody edits meanwhile."""
    patch.setattr("legacy.pipeline.stage_records.code_hash", lambda rooms: "code of " + " ".join(rooms))


def undraw(patch):
    """Settle a test that looks at what is written, and leave drawings and the page of the motion away."""
    settle(patch)
    leave_drawing(patch)
    patch.setattr("legacy.kinematics.report.sections.write_report", lambda path, *_: path.write_text("page"))


@pytest.fixture(autouse=True)
def settled(monkeypatch, undrawn):
    """Settle every test of this room, and leave the drawing away, which `finished` has done once."""
    settle(monkeypatch)


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """A study file and the folder of its finished run."""
    with pytest.MonkeyPatch.context() as patch:
        settle(patch)
        folder = tmp_path_factory.mktemp("ear")
        study = make_ear(folder / "ear1")
        result = run_study(study, folder / "out")
    return study, folder / "out", result


@pytest.fixture
def ear(finished, tmp_path):
    """A copy of the finished study that a test may change: study file and output folder."""
    study, out, _ = finished
    shutil.copytree(study.parent, tmp_path / "ear1")
    shutil.copytree(out, tmp_path / "out")
    return tmp_path / "ear1" / "study.toml", tmp_path / "out"
