"""Calibrated numbers of every room: each has its population, and code and file name the same ones."""

import re
from importlib import import_module
from pathlib import Path

import pytest

ROOMS = ("ct_inertia", "kinematics", "fitting")


@pytest.fixture(params=ROOMS)
def room(request):
    """A room's folder and its calibrated numbers."""
    folder = Path(import_module(request.param).__file__).parent
    return folder, import_module(f"legacy.{request.param}.calibrated").calibrated


def test_rooms_with_calibrated_numbers_are_all_here():
    root = Path(__file__).resolve().parents[1]
    assert {file.parent.name for file in root.glob("*/calibrated.toml")} == set(ROOMS)


def test_every_number_is_used_and_every_use_has_a_number(room):
    folder, numbers = room
    uses = re.compile(r'\bcalibrated\(\s*"([^"]+)"')
    used = {name for file in folder.rglob("*.py") for name in uses.findall(_code(file))}
    assert used == set(numbers.entries)


def test_every_number_says_what_it_means_and_on_what_it_was_fitted(room):
    numbers = room[1]
    for name, entry in numbers.entries.items():
        assert len(entry.meaning) > 20, name
        assert entry.fitted_on in numbers.populations, name
        assert entry.fitted_on != "none", name
        assert entry.checked_on in numbers.populations, name


def test_a_check_uses_other_specimens_than_the_fit(room):
    for name, entry in room[1].entries.items():
        assert entry.checked_on != entry.fitted_on, name


def test_populations_are_dated(room):
    for name, population in room[1].populations.items():
        assert population.description
        assert name == "none" or re.fullmatch(r"\d{4}-\d{2}-\d{2}", population.date), name


def _code(file: Path) -> str:
    """Return a module without its first docstring."""
    return re.sub(r'\A""".*?"""', "", file.read_text(encoding="utf-8"), flags=re.DOTALL)
