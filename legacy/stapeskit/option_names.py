"""Names of options in messages: ``--box`` on the terminal, ``scan.box_mm`` in a study, ``box`` in Python.

Texts name an option by `named`, faults by a reference ``{name}``. The edge that a person uses chooses the
words: a command, a study file or a notebook.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Vocabulary = Callable[[str], str]
"""Takes the name of an option, as ``box``, and returns how the reader writes it."""


def as_command(name: str) -> str:
    """Write the name of an option as on the command line."""
    return "--" + name.replace("_", "-")


def as_keyword(name: str) -> str:
    """Write the name of an option as a keyword of a Python function."""
    return name


_REFERENCE = re.compile(r"\{([a-z][a-z0-9_]*)\}")
_VOCABULARY: ContextVar[Vocabulary] = ContextVar("vocabulary", default=as_command)


def named(option: str) -> str:
    """Write the name of an option in the vocabulary of the caller's edge."""
    return _VOCABULARY.get()(option)


def written(text: str, vocabulary: Vocabulary = named) -> str:
    """Write the references ``{name}`` of a text as the reader writes them."""
    return _REFERENCE.sub(lambda match: vocabulary(match[1]), text)


@contextmanager
def use_vocabulary(vocabulary: Vocabulary) -> Iterator[None]:
    """Write the names of options by a vocabulary within the block."""
    token = _VOCABULARY.set(vocabulary)
    try:
        yield
    finally:
        _VOCABULARY.reset(token)


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return a question for the nearest known word, or nothing."""
    import difflib

    close = difflib.get_close_matches(word, list(known), 1)
    return f"Did you mean {close[0]}?" if close else ""
