"""The page of all options: ``python -m pipeline.options_page > docs/options.md``."""

from __future__ import annotations

import sys

from ct_inertia.options import MassOptions, MassOutputs
from fitting.options import KDFiles, KDOptions
from kinematics.options import MotionFiles, MotionOptions
from pipeline.command_options import CohortOptions, RunOptions
from pipeline.study import About
from stapeskit.options import Options, markdown_table

COMMANDS: dict[str, list[type[Options]]] = {
    "ct2mass": [MassOptions, MassOutputs],
    "points2dof": [MotionOptions, MotionFiles],
    "dof2kd": [KDOptions, KDFiles],
    "scan2kd": [RunOptions, CohortOptions],
    "study files only": [About],
}

COMMON = ("force", "json", "quiet")
"""Options of all commands, described once."""


def options_page() -> str:
    """Return the page as Markdown."""
    lines = [
        "# Options",
        "",
        "An option has one name: `--box` on the command line, `box=` in Python, and in a study file "
        "the same with its unit, `box_mm`, and underscores. Every command also takes `--config FILE.toml` "
        "(options by name), `--version`, `--json` (print the result as JSON), `--quiet` (print nothing but "
        "errors) and `--force`: replace files that it did not write; `dof2kd` also uses another mass.json, "
        "and `scan2kd` repeats every stage. Defaults are in brackets.",
    ]
    for command, tables in COMMANDS.items():
        lines += ["", f"## {command}"]
        for table in tables:
            where = f"Keys of `[{table.table}]` in a study file:" if table.table else "Not in a study file:"
            lines += ["", where, "", markdown_table(table, table is not About, COMMON).rstrip()]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(options_page())
