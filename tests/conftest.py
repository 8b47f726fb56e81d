"""What tests of several rooms share."""

from __future__ import annotations

import gc

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest tests, whole chains: begun last, they would keep one processor waiting."""
    items.sort(key=lambda item: not {"scenes", "study"} & set(item.path.parts))


def pytest_collection_finish() -> None:
    """Leave modules and tests out of the search for garbage, which would look at all of them each time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000)
