"""Read JSON and TOML files with a sentence for what is none, and turn results into JSON values."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stapeskit.faults import StapeskitError

_LONGEST_TOML = 10_000_000  # bytes: a thousand times the longest study


def read_json(path: Path, what: str, made_by: str) -> dict[str, Any]:
    """Return the object of a JSON file; ``what`` it is, and ``made_by``, what to do, are for the message.

    Raises
    ------
    StapeskitError
        The file is missing or holds no JSON object.
    """
    path = Path(path)
    if not path.is_file():
        raise StapeskitError.of(what, "an existing JSON file", path, next_step=made_by)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise StapeskitError.of(what, "a JSON object", error, path.name, made_by) from error
    if not isinstance(content, dict):
        raise StapeskitError.of(what, "a JSON object", type(content).__name__, path.name, made_by)
    return content


def read_toml(path: Path, next_step: str = "") -> dict[str, Any]:
    """Return the content of a TOML file; ``next_step`` is what to do where it is none.

    Raises
    ------
    StapeskitError
        There is no such file, or it is no TOML in UTF-8, with the line where it fails.
    """
    import tomllib

    path = Path(path)
    if not path.is_file():
        step = next_step or "Check its name and folder"
        raise StapeskitError.of("the TOML file", "an existing file", path, "", step)
    try:
        data = path.read_bytes()
        if len(data) > _LONGEST_TOML:
            raise ValueError(f"{len(data)} bytes")
        return tomllib.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # TOMLDecodeError and UnicodeDecodeError are ValueErrors
        got = "other bytes" if isinstance(error, UnicodeDecodeError) else error
        step = next_step or ("Save it as UTF-8" if got != error else "")
        raise StapeskitError.of("the file", "TOML in UTF-8", got, path.name, step) from None


def as_json(value: Any) -> Any:
    """Return a JSON value: arrays as lists, -0 as 0, numbers that are not finite as null."""
    if isinstance(value, Mapping):
        return {str(key): as_json(entry) for key, entry in value.items()}
    if hasattr(value, "tolist"):  # of numpy
        return as_json(value.tolist())
    if isinstance(value, list | tuple):
        return [as_json(entry) for entry in value]
    if isinstance(value, float):
        return value + 0.0 if math.isfinite(value) else None
    return value
