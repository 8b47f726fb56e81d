"""Write the page of an example: ``python -m fitting.examples.NAME OUT.html [COUNT] [--force]``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.own_files import OutputSet
from legacy.stapeskit.page.page import Page


def write_page(
    name: str, arguments: Sequence[str], build: Callable[[int], Page], count: int | None = None
) -> int:
    """Write a page to the path given; return the exit code.

    Parameters
    ----------
    name : str
        Of the module, for the usage.
    build : callable
        Gets the count and returns the page.
    count : int, optional
        Default of COUNT, repetitions; None where there is no such argument.
    """
    words = [word for word in arguments if word != "--force"]
    counted = count is not None and len(words) == 2 and words[1].isdigit() and int(words[1]) > 0
    if len(words) != 1 and not counted:
        more = "" if count is None else " [repetitions]"
        sys.stderr.write(f"usage: python -m fitting.examples.{name} OUT.html{more} [--force]\n")
        return 2
    out = Path(words[0])
    outputs = OutputSet(name, out.parent, (out.name,), force="--force" in arguments)
    try:
        outputs.check()
        with outputs.staged() as folder:
            build(int(words[1]) if counted else count or 0).write(folder / out.name)
    except StapeskitError as fault:
        sys.stderr.write(f"{fault}\n")
        return 2
    return 0
