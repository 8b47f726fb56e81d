"""Units of causes: those of kd.json and of the fit, whatever people are shown."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
from stapeskit.page import quantities
quantities.MASS = quantities.ShownUnit("ug", 1e9)
from fitting.causes.catalogue import CAUSES
print(*(f"{CAUSES[name].unit} {CAUSES[name].per_unit:g}" for name in ("fluid", "head_mass")))
"""


def test_another_shown_unit_of_mass_changes_neither_parameters_nor_files():
    told = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert told.stdout.split() == ["mg", "1e-06"] * 2
