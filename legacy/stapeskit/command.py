"""What the four commands share: a table of the result, its notices and files.

A command is parse -> read -> one library call -> write -> a table; `stapeskit.process.run` runs it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from legacy.stapeskit.run_log import note
from legacy.stapeskit.terminal import plain
from legacy.stapeskit.warnings import Notice


@dataclass(frozen=True)
class Outcome:
    """The result of a command: table rows (label, text), warnings, files written, the full result."""

    title: str
    rows: Sequence[tuple[str, str]]
    notices: Sequence[Notice] = ()
    files: Sequence[Path] = ()
    result: dict[str, Any] = field(default_factory=dict)


def show(options: Any, outcome: Outcome) -> None:
    """Print an outcome: JSON, or a table of its rows; notices go to standard error, all of it to the log."""
    notices = "".join(f"warning [{notice.code}] {notice.text}\n" for notice in outcome.notices)
    width = max((len(label) for label, _ in outcome.rows), default=0)
    lines = [outcome.title, *(f"  {label:<{width}}  {text}" for label, text in outcome.rows)]
    if outcome.files:
        lines.append("  written: " + ", ".join(str(path) for path in outcome.files))
    notices, table = plain(notices), plain("\n".join(lines) + "\n")
    note(notices + table)
    if not options.quiet:
        sys.stderr.write(notices)
    if options.json:
        sys.stdout.write(json.dumps(outcome.result, indent=1) + "\n")
    elif not options.quiet:
        sys.stdout.write(table)
