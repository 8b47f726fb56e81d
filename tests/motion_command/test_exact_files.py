"""Files without noise that state how well their points are known end in a result, not in a traceback."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from kinematics.cli import work
from simulate import Ear, Experiment, simulate_study


@pytest.mark.parametrize("sd_mm", [1e-4, 0.02, 1.0])
def test_positions_with_a_stated_sd_and_readings_without_noise(tmp_path: Path, sd_mm: float) -> None:
    experiment = Experiment(lines=20, in_footplate=True, exact=True, seed=31)
    truth = simulate_study(Ear(), None, experiment, tmp_path)
    points = pd.read_csv(tmp_path / "points.csv").assign(sd_mm=sd_mm)
    points.to_csv(tmp_path / "points.csv", index=False)
    work([str(tmp_path / "ldv.csv"), "--out", str(tmp_path / "dof.csv"), "--quiet"])
    motion = pd.read_csv(tmp_path / "dof.csv")
    stapes = motion[motion["body"] == "stapes"]
    found = stapes["y_re_m"].to_numpy() + 1j * stapes["y_im_m"].to_numpy()
    assert np.allclose(found, truth.motion_m["stapes"][0, :, 1], rtol=1e-9)
    assert set(pd.read_csv(tmp_path / "dof.channels.csv")["verdict"]) == {"ok"}
