"""Make the tables of the documentation anew that stand between marks, each by the command in its mark.

    python tools/evidence.py [WORD ...]      run the commands that hold one of the words; all without words
    python tools/evidence.py --pages         only write the pages, from the results of the last runs

A block begins with ``<!-- python benchmarks/NAME.py -->`` and ends with ``<!-- end -->``. What its command
prints is kept in ``benchmarks/results`` with the date and the processor time; the lines of the block are made
from that file, so that no figure is typed.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from legacy.stapeskit.page.numbers import printed  # noqa: E402

RESULTS = ROOT / "benchmarks" / "results"
BLOCK = re.compile(r"<!-- python (benchmarks/\w+\.py[^\n]*?) -->\n(.*?)<!-- end -->", re.DOTALL)


def commands(text: str) -> list[str]:
    """Return the commands of the blocks of a page."""
    return [match[1] for match in BLOCK.finditer(text)]


def result_file(command: str) -> Path:
    """Return the file that holds what a command printed."""
    return RESULTS / (re.sub(r"\W+", "_", command.replace("benchmarks/", "").replace(".py", "")) + ".json")


def measure(command: str) -> None:
    """Run the command of a block and keep what it prints, the date and the processor time.

    Raises
    ------
    subprocess.CalledProcessError
        If the command fails. Its earlier result stays.

    """
    printed_text, processor_s = timed([sys.executable, *shlex.split(command)])
    result = {
        "command": f"python {command}",
        "date": datetime.now(UTC).date().isoformat(),
        "processor_s": max(1, round(processor_s)),
        "printed": printed_text.strip().splitlines(),
    }
    RESULTS.mkdir(exist_ok=True)
    text = json.dumps(result, indent=1, ensure_ascii=False)
    result_file(command).write_text(text + "\n", encoding="utf-8")


def timed(words: list[str]) -> tuple[str, float]:
    """Run a command; return what it prints and its processor time, that of its own children included.

    Notes
    -----
    Where the signal of ended children is ignored, which is inherited, the system does not count their time,
    and a failure looks like success.
    """
    before = signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    try:
        with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True) as running:
            text = running.stdout.read() if running.stdout is not None else ""
            _, status, used = os.wait4(running.pid, 0)
            running.returncode = os.waitstatus_to_exitcode(status)
    finally:
        signal.signal(signal.SIGCHLD, before)
    if running.returncode:
        raise subprocess.CalledProcessError(running.returncode, words)
    return text, used.ru_utime + used.ru_stime


def block(command: str) -> str:
    """Return the block of a command with its last result."""
    result = json.loads(result_file(command).read_text(encoding="utf-8"))
    lines = "\n".join(printed(line) for line in result["printed"])
    return f"<!-- python {command} -->\n{lines}\n\n{_measure(result)}\n<!-- end -->"


def with_results(text: str) -> str:
    """Return a page whose blocks hold the last results of their commands."""
    return BLOCK.sub(lambda match: block(match[1]), text)


def _measure(result: dict[str, Any]) -> str:
    text = f"`{result['command']}`, {result['date']}"
    if seconds := result["processor_s"]:
        spent = f"{seconds} s" if seconds < 100 else f"{seconds / 60:.0f} minutes"
        text += f", {spent} of processor time"
    return f"*{text}*"


if __name__ == "__main__":
    wanted = sys.argv[1:]
    for page in sorted((ROOT / "docs").glob("*.md")):
        for command in commands(page.read_text(encoding="utf-8")):
            if wanted != ["--pages"] and (not wanted or any(word in command for word in wanted)):
                measure(command)
        # Read again: hours later somebody may have edited it.
        page.write_text(with_results(page.read_text(encoding="utf-8")), encoding="utf-8")
