"""One small study, run once for all tests of the folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.run import StudyResult, scan2kd
from simulate import Ear, Experiment, Scan, Truth, simulate_study

EXPERIMENT = Experiment(lines=60, stapes_points=6, bone_points=6, seed=2)


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Truth]:
    """A folder with a study of coarse voxels, and its truth."""
    folder = tmp_path_factory.mktemp("small")
    truth = simulate_study(
        Ear(),
        Scan(voxel_um=40.0, samples=6, format="nrrd", seed=2),
        EXPERIMENT,
        folder,
        about={"subject": "s1"},
    )
    return folder, truth


@pytest.fixture(scope="session")
def finished(small: tuple[Path, Truth], tmp_path_factory: pytest.TempPathFactory) -> StudyResult:
    """The same study after it has run."""
    return scan2kd(small[0] / "study.toml", out=tmp_path_factory.mktemp("results") / "out")
