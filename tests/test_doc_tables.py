"""The tables of docs/ that follow from tables of the sources are current."""

import re
from pathlib import Path

import pytest

from tools.doc_tables import DOCS, TABLES, fill_tables

_NAMES = re.compile(r"`([\w/]+(?:\.\w+)?)`")
PAGES = {path.name: path.read_text(encoding="utf-8") for path in sorted(Path(DOCS).glob("*.md"))}


@pytest.mark.parametrize("page", PAGES)
def test_tables_of_a_page_are_current(page):
    assert fill_tables(PAGES[page]) == PAGES[page], "run make docs"


@pytest.mark.parametrize("name", TABLES)
def test_every_table_is_on_a_page(name):
    assert sum(f"<!-- table {name} -->" in text for text in PAGES.values()) == 1


def test_the_places_that_contributing_names_exist():
    text = (DOCS.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = [line.split(" | ") for line in text.split("| task |")[1].split("\n\n")[0].splitlines()[2:]]
    assert len(rows) > 15
    packages = ("stapeskit/", "kinematics/", "ct_inertia/", "fitting/", "pipeline/", "docs/", "tests/")
    for _, place, checks in rows:
        names = [name for name in _NAMES.findall(place) if name.startswith(packages)]
        names += [f"tests/{name}" for name in _NAMES.findall(checks)]
        assert [name for name in names if not (DOCS.parent / name).exists()] == []
