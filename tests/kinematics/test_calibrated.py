"""Calibrated numbers: each has its population, and code and file name the same ones."""

import re
from pathlib import Path

import kinematics
from kinematics.calibrated import calibrated

ROOM = Path(kinematics.__file__).parent


def test_every_number_is_used_and_every_use_has_a_number():
    uses = re.compile(r'\bcalibrated\(\s*"([^"]+)"')
    used = {name for file in ROOM.rglob("*.py") for name in uses.findall(_code(file))}
    assert used == set(calibrated.entries)


def test_every_number_says_what_it_means_and_on_what_it_was_fitted():
    for name, entry in calibrated.entries.items():
        assert len(entry.meaning) > 20, name
        assert entry.fitted_on in calibrated.populations, name
        assert entry.fitted_on != "none", name
        assert entry.checked_on in calibrated.populations, name


def test_a_check_uses_other_specimens_than_the_fit():
    for name, entry in calibrated.entries.items():
        assert entry.checked_on != entry.fitted_on, name


def test_populations_are_dated():
    for name, population in calibrated.populations.items():
        assert population.description
        assert name == "none" or re.fullmatch(r"\d{4}-\d{2}-\d{2}", population.date), name


def _code(file: Path) -> str:
    """Return a module without its first docstring."""
    return re.sub(r'\A""".*?"""', "", file.read_text(encoding="utf-8"), flags=re.DOTALL)
