"""The tables of docs/ that follow from tables of the sources are current."""

from pathlib import Path

import pytest

from tools.doc_tables import DOCS, TABLES, filled

PAGES = {path.name: path.read_text(encoding="utf-8") for path in sorted(Path(DOCS).glob("*.md"))}


@pytest.mark.parametrize("page", PAGES)
def test_tables_of_a_page_are_current(page):
    assert filled(PAGES[page]) == PAGES[page], "run make docs"


@pytest.mark.parametrize("name", TABLES)
def test_every_table_is_on_a_page(name):
    assert sum(f"<!-- table {name} -->" in text for text in PAGES.values()) == 1
