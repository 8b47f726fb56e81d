"""Every scene: the result lies within its sd of the truth, the sd has not grown, the warnings are right."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.scenes import chain
from tests.scenes.record import BARS
from tests.scenes.scenes import SCENES, USUAL

GROWTH = 1.25
"""Stated standard deviations over those that version 0.2 stated, at most."""
WORST_SD = 4.5
"""Largest of ten parameters from the truth, in standard deviations: by chance once in 15 000 scenes."""
WORST_MOTION_SD = 6.0
"""Largest of some thousand real and imaginary parts, in standard deviations."""


@pytest.mark.parametrize("name", SCENES)
def test_scene(name: str, tmp_path: Path) -> None:
    scene, bars = SCENES[name], json.loads(BARS.read_text(encoding="utf-8"))
    found = chain.run(scene, tmp_path)
    assert found.refused == ""
    if found.mass is not None:
        assert chain.worst_parameter(found) < WORST_SD
    if found.channels is not None:
        assert verdicts(found.channels) == expected_verdicts(found)
        if not scene.experiment.faults:
            assert chain.worst_motion(found) < WORST_MOTION_SD
    if found.kd is not None:
        distance, limit = chain.fit_distance(found)
        assert distance < limit
    for quantity, stated in found.stated().items():
        bar = np.array(bars[name][quantity])
        if quantity == "motion" and "noise_estimated" in found.codes()["points2dof"]:
            bar = np.maximum(bar, chain.least_motion_sd(found))
        growth = np.array(stated) / bar
        assert np.max(growth) < GROWTH, f"{quantity}: {growth}"
    wanted = {
        command: USUAL[command] - set(scene.without) | set(scene.codes.get(command, ())) for command in USUAL
    }
    for command, codes in found.codes().items():
        if getattr(found, {"ct2mass": "mass", "points2dof": "motion", "dof2kd": "kd"}[command]) is not None:
            assert codes == wanted[command]


def verdicts(path: Path) -> dict[tuple[str, str], str]:
    """Return the verdict of every point that has another one than ok."""
    table = pd.read_csv(path, dtype=str).fillna("")
    odd = table[table["verdict"] != "ok"]
    return {(row.body, row.point): row.verdict for row in odd.itertuples()}


def expected_verdicts(found: chain.Outcome) -> dict[tuple[str, str], str]:
    """Return the verdict that each point at fault must have."""
    recording = found.truth.recording
    assert recording is not None
    return {
        (recording.body[channel], recording.point[channel]): verdict
        for channel, verdict in recording.culprits.items()
    }
