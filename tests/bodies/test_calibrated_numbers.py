"""calibrated.toml: every entry is used, says what it means, and names the populations behind it."""

import re
import tomllib
from pathlib import Path

import ct_inertia

ROOM = Path(ct_inertia.__file__).parent
TABLE = tomllib.loads((ROOM / "calibrated.toml").read_text(encoding="utf-8"))
POPULATIONS = TABLE["population"]
ENTRIES = {
    f"{subject}.{name}": entry
    for subject, entries in TABLE.items()
    if subject != "population"
    for name, entry in entries.items()
}


def test_every_entry_is_used_and_every_use_has_an_entry():
    used = {
        name
        for path in ROOM.rglob("*.py")
        for name in re.findall(r'calibrated\("([a-z_0-9.]+)"\)', path.read_text(encoding="utf-8"))
    }
    assert used == set(ENTRIES)


def test_every_entry_was_fitted_on_one_population_and_checked_on_another():
    for name, entry in ENTRIES.items():
        assert set(entry) == {"value", "meaning", "fitted_on", "checked_on"}, name
        assert entry["fitted_on"] != entry["checked_on"], name
        for population in (entry["fitted_on"], entry["checked_on"]):
            assert population.split(",")[0] in POPULATIONS, (name, population)


def test_every_population_is_described():
    for population in POPULATIONS.values():
        assert set(population) == {"description", "script", "date"}
        script = population["script"]
        assert not script.endswith(".py") or (ROOM.parent / script).is_file(), script
