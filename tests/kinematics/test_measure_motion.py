"""The files of a measurement: every option that names one is hashed, watched, and an input of its stage."""

from __future__ import annotations

from pathlib import Path

from legacy.kinematics.measure_motion import MotionInputs
from legacy.kinematics.options import LdvOptions


def test_every_option_that_names_a_file_is_an_input():
    named = LdvOptions(ldv=(Path("a.uff"),)).input_files()
    assert set(MotionInputs((Path("a.uff"),)).by_role) == {"ldv", *named}
