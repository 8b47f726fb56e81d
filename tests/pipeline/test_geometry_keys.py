"""The keys of [ldv] on where the vibrometer stood."""

from __future__ import annotations

import pytest

from legacy.kinematics.fit_options import fit_options
from legacy.pipeline.errors import PipelineError
from legacy.pipeline.study import parse_study

STUDY = """
[scan]
file = "scan.tif"
density_kg_m3 = 1900

[ldv]
file = "ldv.csv"
"""


def parsed(tmp_path, *lines):
    return parse_study(STUDY + "\n".join(lines) + "\n", tmp_path, check_files=False)


def test_the_keys_become_options(tmp_path):
    files = ['plate_points = "plate.csv"', 'bone_points = "bone.csv"']
    numbers = ["calibrate = true", "axes_sd_deg = 2", "gain_sd_percent = 0.5"]
    study = parsed(tmp_path, *files, *numbers, 'mirror_points = "z"')
    priors = fit_options(study.ldv).calibrate
    assert (priors.axes_sd_deg, priors.beam_sd_deg, priors.gain_sd_percent) == (2.0, 0.5, 0.5)
    assert study.ldv.plate_points == tmp_path / "plate.csv"
    assert study.ldv.mirror_points == "z"
    assert fit_options(parsed(tmp_path).ldv).calibrate is None


@pytest.mark.parametrize(
    ("lines", "match"),
    [
        (["axes_sd_deg = 1"], "ldv.axes_sd_deg must be given with ldv.calibrate; got it alone"),
        (
            ['plate_points = "p.csv"', 'frame = "scan"'],
            "ldv.frame must be left out when ldv.plate_points is given",
        ),
        (["calibrate = 1"], "calibrate must be true or false"),
        (['mirror_points = "w"'], "mirror_points must be one of x, y, z"),
        (['plate_point = "p.csv"'], "Did you mean plate_points"),
    ],
)
def test_faulty_keys_are_told(tmp_path, lines, match):
    with pytest.raises(PipelineError, match=match):
        parsed(tmp_path, *lines)
