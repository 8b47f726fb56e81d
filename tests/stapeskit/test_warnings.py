"""Every warning of the sources is in the table, every entry of the table is in the sources."""

import ast
from functools import cache
from pathlib import Path

import pytest

from legacy.stapeskit.warnings import ROOMS, Notice, from_json, page, table, unique

ROOT = Path(__file__).parents[2]
PACKAGES = ("stapeskit", "kinematics", "ct_inertia", "fitting", "pipeline")
ITSELF = ROOT / "stapeskit" / "warnings.py"


def sources():
    """Yield (room, path) of every file that makes a notice."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            if path != ITSELF and "Notice(" in path.read_text(encoding="utf-8"):
                yield package, path


@cache
def tree_of(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def module_of(name):
    """Return the tree of a module of the packages; an empty one for others."""
    path = ROOT.joinpath(*name.split("."))
    files = (path.with_suffix(".py"), path / "__init__.py") if name.split(".")[0] in PACKAGES else ()
    return next((tree_of(file) for file in files if file.is_file()), ast.Module([], []))


@cache
def constants(tree):
    """Return the texts of each module-level name: a string, or the values of a dict of strings."""
    found = {}
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            values = node.value.values if isinstance(node.value, ast.Dict) else [node.value]
            if all(isinstance(value, ast.Constant) and isinstance(value.value, str) for value in values):
                for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                    if isinstance(target, ast.Name):
                        found[target.id] = {value.value for value in values}
    return found


@cache
def entries_below(folder):
    """Return the codes of the table that stand as texts in the sources of a folder."""
    nodes = (node for path in folder.rglob("*.py") for node in ast.walk(tree_of(path)))
    texts = {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    return texts & table().keys()


@cache
def codes():
    """Return {code: rooms that give it} of all sources; fail where a code cannot be read off the source."""
    found = {}
    for room, path in sources():
        tree = tree_of(path)
        names = dict(constants(tree))
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                for alias in node.names:
                    texts = constants(module_of(node.module or "")).get(alias.name)
                    if texts is not None:
                        names[alias.asname or alias.name] = texts
        for node in ast.walk(tree):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
                continue
            if node.func.id != "Notice":
                continue
            first = node.args[0] if node.args else node.keywords[0].value
            if isinstance(first, ast.Constant):
                given = {first.value}
            else:
                name = first.value if isinstance(first, ast.Subscript) else first
                given = names.get(ast.unparse(name))
                # of what was found, by the catalogue or by an alternative: entries of the tables beside it
                if "ADVICE" in ast.unparse(first) or ast.unparse(first).startswith("self.entry."):
                    given = entries_below(path.parent)
            assert given, f"{path}:{node.lineno}: the code must be a text or a module-level constant"
            for code in given:
                found.setdefault(code, set()).add(room)
    return found


def test_sources_and_table_hold_the_same_codes():
    used = codes()
    assert sorted(used.keys() - table().keys()) == [], "add an entry to stapeskit/warnings.toml"
    assert sorted(table().keys() - used.keys()) == [], "no source gives these"
    assert len(used) > 100


def test_every_entry_names_a_room_that_gives_it():
    used = codes()
    assert {code for code, entry in table().items() if entry.room not in used[code]} == set()


@pytest.mark.parametrize("code", sorted(table()))
def test_every_entry_says_what_it_means_and_what_to_do(code):
    entry = table()[code]
    assert entry.room in ROOMS
    for text in (entry.meaning, entry.what_to_do):
        assert len(text) > 7
        assert text.endswith(".")
        assert "|" not in text


def test_the_page_of_warnings_is_current():
    written = (ROOT / "docs" / "warnings.md").read_text(encoding="utf-8")
    assert written == page(), "run make docs"
    assert all(f"| `{code}` |" in written for code in table())


def test_notices_travel_as_json():
    one, two = Notice("a", "first"), Notice("b", "second")
    assert from_json([one.as_json(), two.as_json()]) == (one, two)
    assert unique([one, two, one]) == (one, two)
