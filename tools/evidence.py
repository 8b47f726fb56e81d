"""Fill the tables of docs/evidence.md, each by the command in its mark; no figure is typed.

    python -m tools.evidence [WORD ...]      run the commands that hold one of the words; all without words
    python -m tools.evidence --pages         only write the page, from the results of the last runs

A block begins with ``<!-- benchmarks.NAME ... -->`` and ends with ``<!-- end -->``. What its
command prints is kept in ``benchmarks/results`` with the date and the processor time.
"""

from __future__ import annotations

import json
import re
import resource
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE, RESULTS = ROOT / "docs" / "evidence.md", ROOT / "benchmarks" / "results"
BLOCK = re.compile(r"<!-- benchmarks\.(\w[^\n]*?) -->\n(.*?)<!-- end -->", re.DOTALL)


def result_file(command: str) -> Path:
    """Return the file that holds what ``NAME ...`` printed."""
    return RESULTS / (re.sub(r"\W+", "_", command) + ".json")


def measure(command: str) -> None:
    """Run a command; keep what it prints, the date and the processor time."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    words = [sys.executable, "-m", *shlex.split(f"benchmarks.{command}")]
    printed = subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    result = {
        "command": f"python -m benchmarks.{command}",
        "date": datetime.now(UTC).date().isoformat(),
        "processor_s": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime),
        "printed": printed.strip().splitlines(),
    }
    result_file(command).write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def filled(block: re.Match[str]) -> str:
    """Return a block with the last result of its command; as it is where there is none yet."""
    path = result_file(block[1])
    if not path.exists():
        return block[0]
    result = json.loads(path.read_text(encoding="utf-8"))
    spent = f"`{result['command']}`, {result['date']}, {result['processor_s']} s"
    lines = "\n".join(result["printed"])
    return f"<!-- benchmarks.{block[1]} -->\n{lines}\n\n*{spent}*\n<!-- end -->"


if __name__ == "__main__":
    wanted = sys.argv[1:]
    for match in BLOCK.finditer(PAGE.read_text(encoding="utf-8")):
        if wanted != ["--pages"] and (not wanted or any(word in match[1] for word in wanted)):
            measure(match[1])
    PAGE.write_text(BLOCK.sub(filled, PAGE.read_text(encoding="utf-8")), encoding="utf-8")
