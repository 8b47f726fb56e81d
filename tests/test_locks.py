"""The packages that make demo and make test install: pinned with hashes, and what pyproject.toml asks for."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
GROUPS = PROJECT["dependency-groups"]


def name_of(requirement):
    return re.split(r"[^\w.-]", requirement)[0].lower().replace("_", "-")


def locked(file):
    """Requirements of a lock by name: version, and how many hashes it has."""
    text = (ROOT / "locks" / file).read_text(encoding="utf-8").replace("\\\n", " ")
    entries = [line for line in text.splitlines() if line and not line.startswith("#")]
    return {name_of(line): (line.split("==")[1].split()[0], line.count("--hash=sha256:")) for line in entries}


@pytest.mark.parametrize(
    ("file", "wanted"),
    [
        ("run.txt", [*PROJECT["project"]["dependencies"], *GROUPS["build"], "pymeshlab", "distributed"]),
        ("dev.txt", [part for part in GROUPS["dev"] if isinstance(part, str)]),
        ("docs.txt", GROUPS["docs"]),
    ],
)
def test_locks_hold_what_the_project_asks_for_with_hashes(file, wanted):
    entries = locked(file)
    assert {name_of(requirement) for requirement in wanted} <= set(entries)
    assert all(hashes > 0 for _, hashes in entries.values())


def test_locks_agree_with_each_other():
    run, dev, docs = (locked(file) for file in ("run.txt", "dev.txt", "docs.txt"))
    assert set(run) <= set(dev)
    for other in (run, docs):
        assert {name: other[name] for name in other if name in dev} == {
            name: dev[name] for name in other if name in dev
        }
