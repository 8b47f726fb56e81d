"""From the tables of a study file to what the rooms take, and back to words a study file knows."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

from pipeline.study import words
from stapeskit.faults import Fault
from stapeskit.options import in_words

if TYPE_CHECKING:
    from stapeskit.page.page import Section

_OPTION = re.compile(r"--[a-z]+(?:-[a-z]+)*")


def in_study_words(text: str, table: str = "scan") -> str:
    """Name the keys of a study file where a text of a room names the options of its command.

    Parameters
    ----------
    text : str
    table : str
        Where a key is looked for first, ``scan``, ``ldv`` or ``fit``: some are in more than one.
    """
    vocabulary = words(table)

    def key(match: re.Match[str]) -> str:
        place = vocabulary(match.group()[2:].replace("-", "_"))
        return place if "." in place else match.group()

    return _OPTION.sub(key, text)


def faults_in_study_words(faults: Iterable[Fault], table: str) -> list[Fault]:
    """Return faults that name the keys of a study file where they name options."""
    return [
        Fault(
            in_study_words(fault.thing, table),
            in_study_words(fault.expected, table),
            in_study_words(str(fault.got), table),
            fault.where,
            in_study_words(fault.next_step, table),
        )
        for fault in (in_words(fault, words(table)) for fault in faults)
    ]


def section_in_study_words(section: Section, table: str) -> Section:
    """Return a section of a page whose texts name the keys of a study file."""
    from markupsafe import Markup

    return replace(section, blocks=[Markup(in_study_words(str(block), table)) for block in section.blocks])
