"""Read the numbers that were calibrated on simulated scans: calibrated.toml."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any


@cache
def _table() -> dict[str, dict[str, dict[str, Any]]]:
    import tomllib

    return tomllib.loads(Path(__file__).with_name("calibrated.toml").read_text(encoding="utf-8"))


def calibrated(name: str) -> Any:
    """Return the value of an entry ``SUBJECT.NAME`` of calibrated.toml."""
    subject, entry = name.split(".")
    return _table()[subject][entry]["value"]
