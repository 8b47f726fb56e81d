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
        "An option has one name: `--box` on the command line, `box=` in Python; a study file adds its unit, "
        "`box_mm`, and writes underscores. Every command also takes `--config FILE.toml` (options by name), "
        "`--version`, `--json` (result as JSON), `--quiet` (errors only) and `--force`: replace files that "
        "it did not write; `dof2kd` also uses another mass.json, `scan2kd` repeats every stage.",
    ]
    for command, tables in COMMANDS.items():
        lines += ["", f"## {command}"]
        last = ""
        for table in tables:
            where = f"Keys of `[{table.table}]` in a study file:" if table.table else "Not in a study file:"
            head, rule, *rows = markdown_table(table, table is not About, COMMON).splitlines()
            lines += rows if where == last else ["", where, "", head, rule, *rows]
            last = where
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(options_page())
