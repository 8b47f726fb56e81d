"""Numbers that were calibrated on simulated measurements: values and populations are in calibrated.toml."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from typing import Any


@cache
def _table() -> dict[str, Any]:
    return tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def calibrated(name: str) -> float:
    """Return the value of ``section.entry`` of calibrated.toml."""
    section, entry = name.split(".")
    return float(_table()[section][entry]["value"])
