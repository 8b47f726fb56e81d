"""Read JSON and TOML that may come from anywhere: every fault of the text is a ValueError."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any, TypeGuard

DEEPEST = 100
"""Brackets within each other at most: what people and programs write has less than ten."""

_LONGEST_TOML = 10_000_000  # characters; a second or two of reading
# Strings that do not end reach to the end of the line or text: nothing is looked at twice.
_TOKEN = re.compile(
    r'"""(?:\\.|[^\\])*?(?:"""|\Z)|\'\'\'.*?(?:\'\'\'|\Z)|"(?:\\.|[^"\\\n])*"?|\'[^\'\n]*\'?|#[^\n]*|[\[\]{}.=,\n]',
    re.DOTALL,
)


def is_finite_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a number that a float can hold; whole ones may have any length."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def parse_json(text: str) -> Any:
    """Return what a JSON text holds.

    Raises
    ------
    ValueError
        It is no JSON, nested too deeply, or holds a whole number of thousands of digits.
    """
    try:
        return json.loads(text)
    except RecursionError as fault:
        raise ValueError("its brackets are nested too deeply") from fault


def read_json(path: Path) -> dict[str, Any]:
    """Return the JSON object that a file holds.

    Raises
    ------
    OSError
    ValueError
        It holds no JSON object in UTF-8.
    """
    content = parse_json(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise ValueError(f"{type(content).__name__} and no object")
    return content


def parse_toml(text: str) -> dict[str, Any]:
    """Return what a TOML text holds.

    Raises
    ------
    ValueError
        It is no TOML, nested too deeply, too long, or holds a whole number of thousands of digits.
    """
    import tomllib

    if len(text) > _LONGEST_TOML:
        raise ValueError(f"it has {len(text)} characters, and {_LONGEST_TOML} at most are read")
    depth = dots = 0
    for token in _TOKEN.finditer(text):
        sign = token[0]
        depth += {"[": 1, "{": 1, "]": -1, "}": -1}.get(sign, 0)
        if depth > DEEPEST:
            raise ValueError("its brackets are nested too deeply")
        # parts of a key; tomllib takes time that grows with their square
        dots = dots + 1 if sign == "." else dots * (sign[0] in "\"'#")
        if dots > DEEPEST:
            raise ValueError("its keys are nested too deeply")
    return tomllib.loads(text)
