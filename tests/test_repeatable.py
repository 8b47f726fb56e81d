"""The same inputs give the same JSON to the last byte but for date and command, compiled and in numpy."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from legacy.ct_inertia.cli import work as ct2mass
from legacy.fitting.cli import work as dof2kd
from legacy.kinematics.cli import work as points2dof
from legacy.pipeline.cli import work as scan2kd
from tests.pipeline.conftest import undraw
from tests.pipeline.ears import make_ear

SAMPLE_SCAN = Path(__file__).resolve().parents[1] / "sample_volumes" / "scan.tif"
CT = ["stapes.ply", "--density", "1900+-60", "--anterior", "1,0,0", "--no-report"]
RUNS = {
    "ct2mass": (ct2mass, [*CT, "--out", "out"]),
    "points2dof": (points2dof, ["ldv.csv", "--points", "points.csv", "--out", "out/dof.csv"]),
    "dof2kd": (dof2kd, ["dof.csv", "--mass", "mass.json", "--bands", "0", "--out", "out/kd.json"]),
    "scan2kd": (scan2kd, ["study.toml", "--quiet", "--out", "out"]),
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    with pytest.MonkeyPatch.context() as patch:
        undraw(patch)
        patch.chdir(folder)
        make_ear(folder)
        ct2mass([*CT, "--out", "made"])
        tied = ["--fiducials", "fiducials.csv", "--mass", "made/mass.json", "--out", "made/dof.csv"]
        points2dof(["ldv.csv", "--points", "points.csv", *tied])
        for name in ("mass.json", "dof.csv", "dof.h5"):
            shutil.move(folder / "made" / name, folder / name)
        shutil.rmtree(folder / "made")
    return folder


DATED = ("date", "command", "seconds")
OF_DATED_FILES = ("hash", "modified")  # of the mass.json and dof.h5 that a study makes on its way to kd.json


def without_date(text: str, left_out=DATED) -> str:
    """Leave out of a JSON text what may differ: dates, commands and how long it took."""

    def cleaned(value):
        if isinstance(value, dict):
            return {key: cleaned(entry) for key, entry in value.items() if key not in left_out}
        return [cleaned(entry) for entry in value] if isinstance(value, list) else value

    return json.dumps(cleaned(json.loads(text)), indent=1)


def documents(folder: Path, left_out=DATED) -> dict[str, str]:
    return {
        path.name: without_date(path.read_text(encoding="utf-8"), left_out)
        for path in sorted(folder.glob("*.json"))
        if ".stapeskit" not in path.parts
    }


@pytest.mark.parametrize(
    ("name", "kernels"),
    [
        *((name, kernels) for name in list(RUNS)[:3] for kernels in ("compiled", "numpy")),
        ("scan2kd", "compiled"),
    ],
)
def test_the_same_inputs_give_the_same_documents(name, kernels, inputs, tmp_path, monkeypatch):
    undraw(monkeypatch)
    if kernels == "numpy":
        monkeypatch.setenv("STAPESKIT_KERNELS", "numpy")
    monkeypatch.chdir(inputs)
    work, words = RUNS[name]
    made = []
    left_out = (*DATED, *OF_DATED_FILES) if name == "scan2kd" else DATED
    for _ in range(2):
        _, outcome = work(words)
        made.append(
            {**documents(inputs / "out", left_out), "--json": without_date(json.dumps(outcome.result))}
        )
        shutil.rmtree(inputs / "out")
    assert made[0] == made[1]
    assert len(made[0]) >= 1
    if name != "points2dof":
        assert len(made[0]) >= 2


def test_kernels_and_numpy_give_the_same_poses(tmp_path, monkeypatch):
    undraw(monkeypatch)
    masses = []
    for kernels in ("", "numpy"):
        monkeypatch.setenv("STAPESKIT_KERNELS", kernels)
        out = tmp_path / f"mass_{kernels}"
        ct2mass([str(SAMPLE_SCAN), "--density", "1382.4+-14", "--no-report", "--quiet", "--out", str(out)])
        masses.append(json.loads((out / "mass.json").read_text(encoding="utf-8")))
    one, other = masses
    assert one["mass_kg"] == pytest.approx(other["mass_kg"], rel=1e-12)
    for pose in ("scan_from_plate", "scan_from_footplate"):
        spreads = [np.sqrt(np.diag(mass["frames"]["pose_covariance"][pose]["matrix_si"])) for mass in masses]
        np.testing.assert_allclose(*spreads, rtol=1e-4, err_msg=pose)  # was 3.4 % for the plate
        frames = [np.array(mass["frames"][pose]) for mass in masses]
        np.testing.assert_allclose(*frames, atol=1e-6, err_msg=pose)
