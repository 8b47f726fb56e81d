"""Units of causes: those of kd.json and of the fit, whatever people are shown."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
from legacy.stapeskit.page import quantities
quantities.MASS = quantities.ShownUnit("ug", 1e9)
from legacy.fitting.causes.catalogue import CAUSES, shown_unit
print(*(f"{CAUSES[name].unit} {CAUSES[name].per_unit:g}" for name in ("fluid", "head_mass")))
print(shown_unit("mg").text(1.5), shown_unit("us").text(2.0))
"""


def test_another_shown_unit_of_mass_changes_neither_parameters_nor_files():
    told = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert told.stdout.splitlines() == ["mg 1e-06 mg 1e-06", "1500 ug 2 us"]
