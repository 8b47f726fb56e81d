"""What tests of several rooms share."""

from __future__ import annotations

import gc

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin each half with tests of readers, whose forks cost little while a process has few libraries.

    Two processes get a half each. The longest tests, whole chains, follow in the first half: begun last, they
    would keep one processor waiting.
    """

    def of(*folders: str) -> list[pytest.Item]:
        return [item for item in items if set(folders) & set(item.path.parts)]

    first, second = of("scan_files") + of("scenes", "study", "docs"), of("motion_files")
    placed = set(first + second)
    others = [item for item in items if item not in placed]
    middle = max(len(items) // 2 - len(first), 0)
    items[:] = first + others[:middle] + second + others[middle:]


def pytest_collection_finish() -> None:
    """Leave modules and tests out of the search for garbage, which would look at all of them each time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000)
