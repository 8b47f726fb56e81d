"""Read JSON files with a sentence for what is no JSON, and turn results into JSON values."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stapeskit.faults import StapeskitError


def read_json(path: Path, what: str, made_by: str) -> dict[str, Any]:
    """Return the object of a JSON file.

    Parameters
    ----------
    what : str
        What the file is, for the message: ``the mass file``.
    made_by : str
        What the user can do: ``Make the file with ct2mass``.

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


def as_json(value: Any) -> Any:
    """Return a JSON value: arrays as lists, -0 as 0, numbers that are not finite as null."""
    if isinstance(value, Mapping):
        return {str(key): as_json(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return as_json(value.tolist())
    if isinstance(value, list | tuple):
        return [as_json(entry) for entry in value]
    if isinstance(value, float):
        return value + 0.0 if np.isfinite(value) else None
    return value
