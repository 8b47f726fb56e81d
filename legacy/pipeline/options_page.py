"""The page of all options: ``python -m pipeline.options_page > docs/options.md``."""

from __future__ import annotations

import sys

from legacy.ct_inertia.options import MassOptions, MassOutputs
from legacy.fitting.options import KDFiles, KDOptions
from legacy.kinematics.options import LdvOptions, PointsFiles
from legacy.pipeline.command_options import StudyOptions
from legacy.pipeline.study import About
from legacy.stapeskit.option_docs import page
from legacy.stapeskit.option_parser import Terminal
from legacy.stapeskit.options import OptionTable

COMMANDS: dict[str, tuple[type[OptionTable], ...]] = {
    "ct2mass": (MassOptions, MassOutputs),
    "points2dof": (LdvOptions, PointsFiles),
    "dof2kd": (KDFiles, KDOptions),
    "scan2kd": (StudyOptions,),
    "every command": (Terminal,),
}


def options_page() -> str:
    """Return the page in Markdown."""
    return page(COMMANDS, (About,))


if __name__ == "__main__":
    sys.stdout.write(options_page())
