"""Make the tables of the documentation anew that stand between marks, each by the command in its mark.

    python tools/evidence.py [WORD ...]      commands that hold one of the words; all of them without words

A block begins with ``<!-- python benchmarks/NAME.py -->`` and ends with ``<!-- end -->``; what the command
prints takes the place of the lines between.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"<!-- python (benchmarks/\w+\.py[^\n]*?) -->\n(.*?)<!-- end -->", re.DOTALL)


def commands(text: str) -> list[str]:
    """Return the commands of the blocks of a page."""
    return [match[1] for match in BLOCK.finditer(text)]


def made_anew(text: str, words: list[str]) -> str:
    """Return a page with the blocks made anew whose commands hold one of the words."""

    def one(match: re.Match[str]) -> str:
        if words and not any(word in match[1] for word in words):
            return match[0]
        done = subprocess.run(
            [sys.executable, *shlex.split(match[1])], cwd=ROOT, capture_output=True, text=True, check=True
        )
        return f"<!-- python {match[1]} -->\n{done.stdout.strip()}\n<!-- end -->"

    return BLOCK.sub(one, text)


if __name__ == "__main__":
    for page in sorted((ROOT / "docs").glob("*.md")):
        before = page.read_text(encoding="utf-8")
        page.write_text(made_anew(before, sys.argv[1:]), encoding="utf-8")
