"""Keyword arguments of Python for the options of a command, by the same names."""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stapeskit.faults import Fault, StapeskitError, raise_all

if TYPE_CHECKING:
    from stapeskit.command import Parser

_OF_WRITING = ("out", "force", "no_report", "export", "smooth", "faces", "sha256", "quiet", "json")
_OF_WRITING_STEP = "Write files with .write(folder) of the result"


def words_of(parser: Parser, first: Sequence[Any], keywords: Mapping[str, Any]) -> list[str]:
    """Return the words of a command line that give the same options.

    Parameters
    ----------
    parser : Parser
        Of the command.
    first : sequence
        Files that the command takes without a name; None is left out.
    keywords : mapping
        Values by the names of options, with underscores: numbers, texts, paths, sequences of numbers,
        (value, standard deviation) where the command has ``VALUE+-SD``, mappings where it has ``NAME=VALUE``.
        None and False are the same as leaving an option out.

    Raises
    ------
    StapeskitError
        A keyword is unknown (the nearest is named), or belongs to writing; all of them together.
    """
    actions = {
        option[2:].replace("-", "_"): action
        for action in parser._actions
        for option in action.option_strings
        if option.startswith("--")
    }
    known = [name for name in actions if name not in (*_OF_WRITING, "help", "version")]
    faults = []
    for name in keywords:
        if name in _OF_WRITING and name in actions:
            faults.append(Fault("an option", "one of measuring", name, parser.prog, _OF_WRITING_STEP))
        elif name not in known:
            close = difflib.get_close_matches(name, known, 1)
            step = f"Did you mean {close[0]}?" if close else f"Its options are {', '.join(known)}"
            faults.append(Fault("an option", "a known one", name, parser.prog, step))
    raise_all(StapeskitError, faults)
    words = [str(value) for value in first if value is not None]
    for name, value in keywords.items():
        words += _option_words(actions[name], value)
    return words


def _option_words(action: argparse.Action, value: Any) -> Iterator[str]:
    """Return the words of one option."""
    option = next(text for text in action.option_strings if text.startswith("--"))
    if value is None or value is False:
        return
    if action.nargs == 0:
        if value is not True:
            raise StapeskitError(Fault(f"{option[2:].replace('-', '_')}=", "True or False", value))
        yield option
        return
    for entry in _entries(action, value):
        yield f"{option}={_text(action, entry)}"


def _entries(action: argparse.Action, value: Any) -> list[Any]:
    """Return the values of an option that may be given several times, or the one value of another."""
    if isinstance(value, Mapping):
        return [f"{name}={_joined(entry)}" for name, entry in value.items()]
    repeated = isinstance(action, argparse._AppendAction)
    if repeated and not isinstance(value, str | Path) and not _is_numbers(value):
        return list(value)
    return [value]


def _text(action: argparse.Action, value: Any) -> str:
    from stapeskit.command import value_with_sd

    if action.type is value_with_sd and not isinstance(value, str) and hasattr(value, "__len__"):
        return "+-".join(_joined(part) for part in value if part is not None)
    return _joined(value)


def _joined(value: Any) -> str:
    """Return a value as the command takes it: sequences as comma lists."""
    if isinstance(value, str | Path) or not hasattr(value, "__len__"):
        return str(value)
    return ",".join(_joined(entry) for entry in value)


def _is_numbers(value: Any) -> bool:
    return all(isinstance(entry, int | float) for entry in value)
